"""Handles that a builder returns: bodies, sets of nodes, faces and elements, material points, drawn surfaces."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from .elements import Family
from .errors import ModelError
from .materials import Material
from .mesh import Mesh

__all__ = ["Body", "ElementSet", "MaterialPoint", "NodeSet", "Skin", "SurfaceSet"]


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
        """(n, 3 or 6) node indices of each face, outward."""
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
    """

    body: Body
    slots: np.ndarray
    weights: np.ndarray
    X: np.ndarray
    element: int = -1


@dataclass(frozen=True, eq=False)
class Skin:
    """The drawn surface of a body.

    Attributes:
        triangles: (T, 3) indices of skin points, outward.
        slot_weights: sparse (points, slots): skin positions from slot values.
        node_weights: sparse (points, mesh nodes): skin fields from nodal fields.
    """

    triangles: np.ndarray
    slot_weights: sp.csr_matrix
    node_weights: sp.csr_matrix


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
        origin: (3,) body origin; device positions are relative to it.
        slots: (used nodes x slots per node) model slots in body order, set at finalize; -1 before.
    """

    name: str
    mesh: Mesh
    family: Family
    materials: list[tuple[str, Material]]
    material_of: np.ndarray
    rule: str
    curved_rule: str
    initial: np.ndarray | None = None
    index: int = -1
    slot_offset: int = -1
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
        """(nodes,) first body slot of each mesh node, -1 for unused nodes."""
        counts = self.node_slot_count
        first = np.concatenate([[0], np.cumsum(counts)[:-1]])
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
        """(slots,) 0 for positions, 1..3 for gradients d/dX_k."""
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
        """(slots, 3) reference slot values E_i: positions relative to the origin, gradients the unit vectors."""
        E = self.mesh.points[self.slot_node] - self.origin
        for k in (1, 2, 3):
            E[self.slot_kind == k] = np.eye(3)[k - 1]
        return E

    @property
    def slots(self) -> np.ndarray:
        """(slots,) indices of the body's slots in the model. Raises ModelError before finalize."""
        if self.slot_offset < 0:
            raise ModelError(f"body {self.name!r}: slots are numbered by ModelBuilder.finalize")
        return self.slot_offset + np.arange(self.slot_count)

    # named sets

    def nodes(self, selection: Any) -> NodeSet:
        """Nodes by group name, predicate of X (n, 3) -> mask, or indices. MeshError lists the names there are."""
        return NodeSet(self, self.mesh.nodes(selection), _label(selection))

    def surface(self, selection: Any) -> SurfaceSet:
        """Faces by group name, predicate of face centroids, or rows (element, local face)."""
        return SurfaceSet(self, self.mesh.surface(selection), _label(selection))

    def elements(self, selection: Any) -> ElementSet:
        """Elements by group name, predicate of centroids, or indices."""
        return ElementSet(self, self.mesh.elements(selection), _label(selection))

    def at(self, X: Any) -> MaterialPoint:
        """The material point at the reference position X (3,), m. Raises ModelError if X lies outside of the body."""
        return locate(self, np.asarray(X, dtype=float))

    # drawing

    @cached_property
    def skin(self) -> Skin:
        """Drawn surface: the outer faces, quadratic ones as four triangles."""
        faces = self.mesh.faces(self.mesh.boundary())
        if faces.shape[1] == 6:
            parts = [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)]
            triangles = np.concatenate([faces[:, p] for p in parts])
        else:
            triangles = faces
        used, local = np.unique(triangles, return_inverse=True)
        rows = np.arange(len(used))
        ones = np.ones(len(used))
        return Skin(
            triangles=local.reshape(triangles.shape),
            slot_weights=sp.csr_matrix((ones, (rows, self.node_slot[used])), shape=(len(used), self.slot_count)),
            node_weights=sp.csr_matrix((ones, (rows, used)), shape=(len(used), len(self.mesh.points))),
        )


def _label(selection: Any) -> str:
    return selection if isinstance(selection, str) else ""


def locate(body: Body, X: np.ndarray) -> MaterialPoint:
    """Find the element that holds X and the parent coordinates there, by Newton's method."""
    if X.shape != (3,) or not np.all(np.isfinite(X)):
        raise ModelError(f"body {body.name!r}: a point must be three finite numbers (m), got {X!r}")
    mesh, family = body.mesh, body.family
    coords = mesh.points[mesh.cells]
    low, high = coords.min(axis=1), coords.max(axis=1)
    size = float(np.max(high - low))
    near = np.flatnonzero(np.all((low - 0.1 * size <= X) & (high + 0.1 * size >= X), axis=1))
    tolerance = 1e-9
    best = (np.inf, -1, np.zeros(3))
    if len(near):
        nodes = coords[near]
        xi = np.full((len(near), 3), 0.25)
        corner = np.concatenate([1 - xi.sum(1, keepdims=True), xi], axis=1)
        for _ in range(20):
            s, ds = _point_functions(family, xi, nodes)
            residual = np.einsum("en,enk->ek", s, nodes) - X
            J = np.einsum("enk,enl->ekl", nodes, ds)
            xi = np.clip(xi - np.linalg.solve(J, residual[:, :, None])[:, :, 0], -1.0, 2.0)
        corner = np.concatenate([1 - xi.sum(1, keepdims=True), xi], axis=1)
        s, _ = _point_functions(family, xi, nodes)
        miss = np.linalg.norm(np.einsum("en,enk->ek", s, nodes) - X, axis=1) / size
        outside = np.maximum(-corner.min(axis=1), 0.0) + miss
        k = int(np.argmin(outside))
        best = (float(outside[k]), int(near[k]), xi[k])
    if best[0] > max(tolerance, 1e-12 * float(np.abs(X).max()) / size):
        a, b = mesh.bounding_box()
        raise ModelError(
            f"body {body.name!r}: point {X.tolist()} lies outside of it (bounding box {np.asarray(a).tolist()} to "
            f"{np.asarray(b).tolist()} m)"
        )
    elem, xi_e = best[1], best[2]
    s, _ = family.shape(xi_e[None], coords[elem][None])
    return MaterialPoint(body, body.connectivity[elem], s[0, 0].copy(), X, elem)


def _point_functions(family: Family, xi: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Geometry functions of each element at its own point: the position part of the slots."""
    position = family.slot_kind == 0
    s = np.empty((len(xi), int(position.sum())))
    ds = np.empty((len(xi), int(position.sum()), 3))
    if len(nodes) and family.shape(xi[:1], nodes[:1])[0].shape[0] == 1:
        a, b = family.shape(xi, nodes[:1])
        return a[0][:, position], b[0][:, position]
    for e in range(len(xi)):
        a, b = family.shape(xi[e : e + 1], nodes[e : e + 1])
        s[e], ds[e] = a[0, 0, position], b[0, 0, position]
    return s, ds
