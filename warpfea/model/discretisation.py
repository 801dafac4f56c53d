"""Discretised body: mesh, element family and slots; basis of the model tables."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..elements import Family
from ..materials import Material
from ..mesh import Mesh
from .partition import morton_order

__all__ = ["Discretisation", "PointMass", "element_functions"]

ORDERED_NODES = 20000
"""Node count above which slots and elements are ordered spatially; smaller bodies fit into caches."""


@dataclass(frozen=True, eq=False)
class PointMass:
    """Mass at a point x = sum weights e with F = sum e gradients^T.

    Attributes:
        slots, weights, gradients: body slots (n,), (n,), (n, 3).
        mass, inertia: kg; the moment of inertia about every axis of the point, kg m^2.
    """

    slots: np.ndarray
    weights: np.ndarray
    gradients: np.ndarray
    mass: float
    inertia: float

    @property
    def matrix(self) -> np.ndarray:
        """(n, n) scalar mass matrix, kg: of a spin w the columns of F have w^2 in each two directions, 2 w^2 in all."""
        w, g = self.weights, self.gradients
        return self.mass * np.outer(w, w) + 0.5 * self.inertia * (g @ g.T)


@dataclass(eq=False)
class Discretisation:
    """Meshed body with its slots (3-vector unknowns: node positions and position gradients).

    Nodes and elements are numbered as in its mesh.

    Attributes:
        name: unique in its model.
        mesh: reference mesh, m.
        family: element family.
        materials: distinct materials with the names of their groups.
        material_of: (elements,) index into materials.
        rule: name of the force quadrature rule.
        curved_rule: force rule of elements with curved sides.
        frames: (elements, n, 3, 3) parent gradients dX/dxi at the element nodes, in the axes of the node, m; of
            families with gradient slots.
        section: section of a beam.
        node_axes: (nodes, 3, 3) orthonormal axes (columns) of each node's gradient slots; None: the global ones.
        elastic: False for a rigid part whose contacts take the stiffness of the other side.
        index: number of the body in its builder, -1 before it is added.
        slot_offset, element_offset: slots and elements of the bodies before it, set at finalize; -1 before.
        point_masses: of points, added to the mass matrix.
        velocity, initial_displacement: (slots, 3) initial values, m/s and m; None: zero.
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
    elastic: bool = True
    index: int = -1
    slot_offset: int = -1
    element_offset: int = -1
    point_masses: list[PointMass] = field(default_factory=list, repr=False)
    velocity: np.ndarray | None = field(default=None, repr=False)
    initial_displacement: np.ndarray | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {self.family.name}, {len(self.mesh.cells)} elements)"

    # numbering

    @cached_property
    def origin(self) -> np.ndarray:
        """(3,) middle of the bounding box, m; positions on the device are relative to it."""
        low, high = self.mesh.bounding_box()
        return 0.5 * (np.asarray(low) + np.asarray(high))

    @cached_property
    def node_slot_count(self) -> np.ndarray:
        """(nodes,) number of slots of each mesh node; 0 for unused nodes."""
        counts = np.zeros(len(self.mesh.points), dtype=np.int64)
        per_node = np.array([len(kinds) for kinds in self.family.node_slots])
        counts[self.mesh.cells] = per_node[None, :]
        return counts

    @cached_property
    def node_slot(self) -> np.ndarray:
        """(nodes,) first body slot of each mesh node, -1 for unused nodes.

        Slots of large bodies are numbered along a space-filling curve, for memory locality.
        """
        counts = self.node_slot_count
        order = morton_order(self.mesh.points) if len(counts) > ORDERED_NODES else np.arange(len(counts))
        first = np.empty(len(counts), dtype=np.int64)
        first[order] = np.concatenate([[0], np.cumsum(counts[order])[:-1]])
        return np.where(counts > 0, first, -1)

    @property
    def rigid(self) -> bool:
        """True for a rigid part."""
        return self.family.rigid

    @property
    def rigid_depth(self) -> float | None:
        """Depth of a rigid part behind its faces, m; None for flexible bodies, whose elements have theirs."""
        return None

    @property
    def slot_count(self) -> int:
        """Number of slots of the body."""
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
        """(slots, 3) reference slot values E_i: positions relative to the origin (m), gradients as the node's axes."""
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

    @property
    def slot_range(self) -> slice:
        """The body's slots in the model, in the order of `connectivity`, `reference` and all weights of slots."""
        return slice(self.slot_offset, self.slot_offset + self.slot_count)

    def at_nodes(self, values: np.ndarray) -> np.ndarray:
        """Values (..., nodes, 3) at mesh nodes from those of the slots (..., slots, 3); 0 at unused nodes."""
        out = np.zeros((*values.shape[:-2], len(self.mesh.points), values.shape[-1]))
        used = self.mesh.used_nodes
        out[..., used, :] = values[..., self.node_slot[used], :]
        return out

    def node_functions(self, node: int) -> tuple[np.ndarray, np.ndarray]:
        """Body slots (n,) and weights (n,) of the position of a mesh node; none for an unused node."""
        slot = self.node_slot[node : node + 1]
        return slot[slot >= 0], np.ones(int(slot[0] >= 0))

    @cached_property
    def surface_nodes(self) -> np.ndarray:
        """Mesh nodes with a slot that acts on an outer face."""
        touched = np.zeros(self.slot_count, dtype=bool)
        for face in np.unique(self.boundary[:, 1]):
            xi, _ = self.family.face_points(int(face), np.array([(0.25, 0.25), (0.5, 0.25), (0.25, 0.5)]))
            rows = self.boundary[self.boundary[:, 1] == face, 0]
            shape, _ = element_functions(self, rows, xi)
            used = np.any(np.abs(np.broadcast_to(shape, (len(rows), *shape.shape[1:]))) > 1e-12, axis=1)
            touched[self.connectivity[rows][used]] = True
        nodes = self.mesh.used_nodes
        return nodes[touched[self.node_slot[nodes]]]

    @cached_property
    def element_order(self) -> np.ndarray:
        """(elements,) processing order: along a space-filling curve in large bodies."""
        if len(self.mesh.points) <= ORDERED_NODES:
            return np.arange(len(self.mesh.cells))
        return morton_order(self.mesh.points[self.mesh.cells].mean(axis=1))

    @cached_property
    def boundary(self) -> np.ndarray:
        """(K, 2) outer faces, rows (element, local face): of solids those of the mesh, of beams and shells their
        own."""
        mesh = self.mesh
        if self.family.solid:
            return mesh.boundary()
        every = np.arange(len(mesh.cells))
        if mesh.cell_type == "line":
            uses = np.bincount(mesh.cells.ravel(), minlength=len(mesh.points))
            tips = {name: every[uses[mesh.cells[:, k]] == 1] for k, name in enumerate(("start", "end"))}
            own = [(tips.get(name, every), k) for k, name in enumerate(self.family.face_names)]
            return np.concatenate([np.column_stack([e, np.full(len(e), k)]) for e, k in own])
        wide = [np.column_stack([every, np.full(len(every), k)]) for k in (0, 1)]
        return np.concatenate([*wide, mesh.boundary() + np.array([0, 2])])

    @cached_property
    def element_boxes(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Lower and upper corners (E, 3) of the bounding boxes of elements in the reference, and their longest side, m,
        for point location."""
        E = self.reference[self.connectivity] + (self.slot_kind[self.connectivity] == 0)[:, :, None] * self.origin
        if self.family.has_gradients:
            s, _ = element_functions(self, np.arange(len(E)), self.family.vtk_subdivision.points)
            E = np.einsum("eps,esk->epk", s, E, optimize=True)
        low, high = E.min(axis=1), E.max(axis=1)
        return low, high, float(np.max(high - low))


def element_functions(body: Discretisation, elements: np.ndarray, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """s (E or 1, Q, S) and ds/dxi (E or 1, Q, S, 3) of elements at parent points (Q, 3)."""
    nodes = body.mesh.points[body.mesh.cells[elements]] - body.origin
    extra = () if body.frames is None else (body.frames[elements],)
    return body.family.shape(xi, nodes, *extra)
