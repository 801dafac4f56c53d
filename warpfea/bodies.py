"""Handles that a builder returns: bodies, sets of nodes, faces and elements, material points."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from . import surfaces
from .elements import Family
from .errors import ModelError
from .materials import Material
from .mesh import Mesh
from .partition import morton_order

__all__ = ["Body", "ElementSet", "MaterialPoint", "NodeSet", "SurfaceSet"]

LARGE = 20000
"""Nodes from which a body's slots and elements are ordered by place; smaller ones fit into caches anyway."""


@dataclass(frozen=True, eq=False)
class NodeSet:
    """Nodes of a body, by index in the mesh file's order (n,)."""

    body: Body
    indices: np.ndarray
    name: str = ""

    def __len__(self) -> int:
        return len(self.indices)


@dataclass(frozen=True, eq=False)
class SurfaceSet:
    """Faces of a body, rows (element, local face) (n, 2)."""

    body: Body
    faces: np.ndarray
    name: str = ""

    def __len__(self) -> int:
        return len(self.faces)

    @property
    def nodes(self) -> np.ndarray:
        """(n, 3, 4 or 6) node indices of each face of a solid, outward."""
        return self.body.mesh.faces(self.faces)


@dataclass(frozen=True, eq=False)
class ElementSet:
    """Elements of a body by index (n,)."""

    body: Body
    indices: np.ndarray
    name: str = ""

    def __len__(self) -> int:
        return len(self.indices)


@dataclass(frozen=True, eq=False)
class MaterialPoint:
    """A material point X = sum weights_i X_i of a body, held by body slots.

    Attributes:
        body: the body.
        slots: (n,) body slots.
        weights: (n,) shape functions at the point.
        X: (3,) reference position, m.
        gradients: (n, 3) dweights/dX, 1/m: the deformation gradient is sum e_i gradients_i^T.
        axes: (3, 3) columns: of a beam axis, width, height there; of a shell two tangents and the director; else
            global.
    """

    body: Body
    slots: np.ndarray
    weights: np.ndarray
    X: np.ndarray
    gradients: np.ndarray
    axes: np.ndarray
    element: int = -1


@dataclass(eq=False)
class Body:
    """A flexible body. Made by ModelBuilder; nodes and elements are counted as in its mesh.

    Attributes:
        name: unique in its model.
        mesh: reference mesh, m.
        family: element family.
        materials: distinct materials with the names of their groups.
        material_of: (elements,) index into materials.
        rule: name of the force quadrature rule.
        curved_rule: the same of elements with curved sides.
        frames: (elements, n, 3, 3) parent gradients dX/dxi at the element nodes, in the axes of the node, m; of
            families with gradient slots.
        section: section of a beam.
        node_axes: (nodes, 3, 3) orthonormal axes (columns) of each node's gradient slots; None: the global ones.
        origin: (3,) body origin; device positions are relative to it.
        element_offset: number of elements of the bodies before it, set at finalize.
        slots: (used nodes x slots per node) model slots in body order, set at finalize; -1 before.
    """

    name: str
    mesh: Mesh
    family: Family
    materials: list[tuple[str, Material]]
    material_of: np.ndarray
    rule: str
    curved_rule: str
    frames: np.ndarray | None = field(default=None, repr=False)
    node_axes: np.ndarray | None = field(default=None, repr=False)
    section: Any = None
    index: int = -1
    slot_offset: int = -1
    element_offset: int = -1
    velocity: np.ndarray | None = field(default=None, repr=False)
    initial_displacement: np.ndarray | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        return f"Body({self.name!r}, {self.family.name}, {len(self.mesh.cells)} elements)"

    # numbering

    @cached_property
    def origin(self) -> np.ndarray:
        low, high = self.mesh.bounding_box()
        return 0.5 * (np.asarray(low) + np.asarray(high))

    @cached_property
    def node_slot_count(self) -> np.ndarray:
        """(nodes,) slots of each mesh node; 0 for nodes that no element uses."""
        counts = np.zeros(len(self.mesh.points), dtype=np.int64)
        per_node = np.array([len(kinds) for kinds in self.family.node_slots])
        counts[self.mesh.cells] = per_node[None, :]
        return counts

    @cached_property
    def node_slot(self) -> np.ndarray:
        """(nodes,) first body slot of each mesh node, -1 for unused nodes.

        Large bodies number them along a curve that fills space, so that neighbours lie close in memory.
        """
        counts = self.node_slot_count
        order = morton_order(self.mesh.points) if len(counts) > LARGE else np.arange(len(counts))
        first = np.empty(len(counts), dtype=np.int64)
        first[order] = np.concatenate([[0], np.cumsum(counts[order])[:-1]])
        return np.where(counts > 0, first, -1)

    @property
    def slot_count(self) -> int:
        """Slots of the body."""
        return int(self.node_slot_count.sum())

    @cached_property
    def connectivity(self) -> np.ndarray:
        """(elements, slots per element) body slots."""
        node = self.family.slot_node
        within = np.concatenate([np.arange(len(kinds)) for kinds in self.family.node_slots])
        return self.node_slot[self.mesh.cells[:, node]] + within[None, :]

    @cached_property
    def slot_kind(self) -> np.ndarray:
        """(slots,) 0 for positions, 1..3 for gradients along the node's axes."""
        kinds = np.zeros(self.slot_count, dtype=np.int64)
        kinds[self.connectivity] = self.family.slot_kind[None, :]
        return kinds

    @cached_property
    def slot_node(self) -> np.ndarray:
        """(slots,) mesh node of each slot."""
        nodes = np.zeros(self.slot_count, dtype=np.int64)
        nodes[self.connectivity] = self.mesh.cells[:, self.family.slot_node]
        return nodes

    @cached_property
    def reference(self) -> np.ndarray:
        """(slots, 3) reference slot values E_i: positions relative to the origin, gradients the node's axes."""
        E = self.mesh.points[self.slot_node] - self.origin
        for k in (1, 2, 3):
            rows = self.slot_kind == k
            E[rows] = np.eye(3)[k - 1] if self.node_axes is None else self.node_axes[self.slot_node[rows], :, k - 1]
        return E

    @property
    def slots(self) -> np.ndarray:
        """(slots,) indices of the body's slots in the model, nodes in mesh order. Raises ModelError before finalize."""
        if self.slot_offset < 0:
            raise ModelError(f"body {self.name!r}: slots are numbered by ModelBuilder.finalize")
        counts = self.node_slot_count
        within = np.arange(self.slot_count) - np.repeat(np.cumsum(counts) - counts, counts)
        return self.slot_offset + np.repeat(self.node_slot, counts) + within

    @cached_property
    def element_order(self) -> np.ndarray:
        """(elements,) the order that elements are computed in: large bodies as their nodes are numbered."""
        if len(self.mesh.points) <= LARGE:
            return np.arange(len(self.mesh.cells))
        return morton_order(self.mesh.points[self.mesh.cells].mean(axis=1))

    # named sets

    def nodes(self, selection: Any) -> NodeSet:
        """Nodes by group name, predicate of X (n, 3) -> mask, or indices. MeshError lists the names there are."""
        return NodeSet(self, self.mesh.nodes(selection), _label(selection))

    def surface(self, selection: Any) -> SurfaceSet:
        """Faces by group name, predicate of face centroids, or rows (element, local face).

        Beams name "start", "end", "side-", "side+", "normal-", "normal+"; shells "top", "bottom" and the strips over
        their named edges.
        """
        return SurfaceSet(self, surfaces.select_faces(self, selection), _label(selection))

    def elements(self, selection: Any) -> ElementSet:
        """Elements by group name, predicate of centroids, or indices."""
        return ElementSet(self, self.mesh.elements(selection), _label(selection))

    def at(self, X: Any) -> MaterialPoint:
        """The material point at the reference position X (3,), m. Raises ModelError if X lies outside of the body."""
        from .locate import locate

        return locate(self, X)

    @property
    def start(self) -> NodeSet:
        """First node of a beam. MeshError for other bodies."""
        return self.nodes("start")

    @property
    def end(self) -> NodeSet:
        """Last node of a beam."""
        return self.nodes("end")

    def edge(self, name: str) -> NodeSet:
        """Nodes of a named edge of a shell."""
        return self.nodes(name)

    @cached_property
    def element_boxes(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Boxes of the elements, for finding points."""
        from .locate import element_boxes

        return element_boxes(self)

    @cached_property
    def boundary(self) -> np.ndarray:
        """(K, 2) all outer faces, rows (element, local face)."""
        return surfaces.boundary_faces(self)

    @cached_property
    def skin(self) -> surfaces.Skin:
        """Drawn surface."""
        return surfaces.make_skin(self)

    @cached_property
    def drawing(self) -> surfaces.Drawing:
        """Drawn cells."""
        return surfaces.make_drawing(self)


def _label(selection: Any) -> str:
    return selection if isinstance(selection, str) else ""
