"""Host tables of a model: geometry, mass, connectivity. Everything here is numpy and scipy in float64."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from .bodies import Body, SurfaceSet
from .elements.quadrature import Rule, triangle_6
from .errors import MeshError, ModelError

__all__ = ["BlockKey", "HostBlock", "body_mass", "facet_tables", "gather_table", "host_blocks", "rigid_modes"]

CHUNK = 20000
"""Elements handled at once where a table per element would be large."""


@dataclass(frozen=True)
class BlockKey:
    """What elements must share to be done by one kernel."""

    family: str
    rule: str
    law: str
    damping: str | None
    affine: bool


@dataclass(eq=False)
class HostBlock:
    """Elements with one key, of one body.

    Attributes:
        body: the body.
        elements: (E,) element indices in the body.
        conn: (E, S) body slots.
        material: (E,) index into the body's materials.
        density: (E, Qm) kg/m^3 at the points of the mass rule.
    """

    key: BlockKey
    body: Body
    elements: np.ndarray

    @property
    def conn(self) -> np.ndarray:
        return self.body.connectivity[self.elements]

    @property
    def nodes(self) -> np.ndarray:
        """(E, n, 3) reference node positions relative to the body origin."""
        return self.body.mesh.points[self.body.mesh.cells[self.elements]] - self.body.origin


def geometry(
    body: Body, elements: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Functions and J0 at parent points.

    Returns:
        s (E or 1, Q, S), ds (E or 1, Q, S, 3), J0 (E, Q, 3, 3) = sum E_i ds_i^T, det J0 (E, Q).
    """
    nodes = body.mesh.points[body.mesh.cells[elements]] - body.origin
    s, ds = body.family.shape(points, nodes)
    E = body.reference[body.connectivity[elements]]
    subscripts = "esk,qsl->eqkl" if len(ds) == 1 else "esk,eqsl->eqkl"
    J0 = np.einsum(subscripts, E, ds[0] if len(ds) == 1 else ds, optimize=True)
    return s, ds, J0, np.linalg.det(J0)


def gradients(ds: np.ndarray, J0: np.ndarray) -> np.ndarray:
    """h_i = J0^-T ds_i/dxi, (E, Q, S, 3)."""
    inverse = np.linalg.inv(J0)
    return np.einsum("eqlk,eqsl->eqsk", inverse, np.broadcast_to(ds, (len(J0), *ds.shape[1:])), optimize=True)


def straight(body: Body) -> np.ndarray:
    """(E,) whether an element has one J0."""
    if not body.family.affine:
        return np.zeros(len(body.mesh.cells), dtype=bool)
    return body.mesh.straight_sided()


def mass_rule(body: Body, affine: bool) -> Rule:
    """The rule that integrates the mass: exact, also with curved sides; richer with a density that varies in space."""
    varying = any(callable(m.density) for _, m in body.materials)
    return body.family.mass_rule if affine and not varying else body.family.curved_mass_rule


def density_at(body: Body, elements: np.ndarray, s: np.ndarray, conn: np.ndarray) -> np.ndarray:
    """(E, Q) density of elements at points."""
    out = np.empty((len(elements), s.shape[1]))
    index = body.material_of[elements]
    for k, (_, material) in enumerate(body.materials):
        rows = np.flatnonzero(index == k)
        if not len(rows):
            continue
        if callable(material.density):
            position = body.slot_kind[conn[rows]] == 0
            E = body.reference[conn[rows]] + position[:, :, None] * body.origin
            table = np.broadcast_to(s, (len(elements), *s.shape[1:]))[rows]
            X = np.einsum("eqs,esk->eqk", table, E)
            values = np.asarray(material.density(X.reshape(-1, 3)), dtype=float).reshape(X.shape[:2])
            if not np.all(np.isfinite(values) & (values > 0.0)):
                raise ModelError(f"body {body.name!r}: density f(X) is not positive and finite everywhere")
            out[rows] = values
        elif np.ndim(material.density) == 1:
            out[rows] = np.asarray(material.density, dtype=float)[elements[rows], None]
        else:
            out[rows] = float(material.density)
    return out


def body_mass(body: Body) -> sp.csr_matrix:
    """Consistent scalar mass matrix m_ij = int rho s_i s_j dV (Eq. 20), body slots, kg."""
    flat = straight(body)
    n = body.slot_count
    total = sp.csr_matrix((n, n))
    for affine in (True, False):
        chosen = np.flatnonzero(flat == affine)
        rule = mass_rule(body, affine)
        for first in range(0, len(chosen), CHUNK):
            part = chosen[first : first + CHUNK]
            conn = body.connectivity[part]
            s, _, _, det = geometry(body, part, rule.points)
            w = density_at(body, part, s, conn) * det * rule.weights
            subscripts = "eq,qi,qj->eij" if len(s) == 1 else "eq,eqi,eqj->eij"
            table = s[0] if len(s) == 1 else s
            local = np.einsum(subscripts, w, table, table, optimize=True)
            S = conn.shape[1]
            rows = np.repeat(conn, S, axis=1).ravel()
            cols = np.tile(conn, (1, S)).ravel()
            total = total + sp.csr_matrix((local.ravel(), (rows, cols)), shape=(n, n))
    return total


def host_blocks(body: Body, *, tables: bool) -> Iterator[HostBlock]:
    """Split a body's elements by what a kernel must know. `tables`: straight elements take the table path too."""
    flat = straight(body)
    for k, (_, material) in enumerate(body.materials):
        damping = material.damping.form if material.damping else None
        if material.damping and material.damping.eta == 0.0 and material.damping.lambda_v == 0.0:
            damping = None
        for is_flat, rule in ((True, body.rule), (False, body.curved_rule)):
            members = np.flatnonzero((body.material_of == k) & (flat == is_flat))
            if len(members):
                key = BlockKey(body.family.name, rule, material.law, damping, is_flat and not tables)
                yield HostBlock(key, body, members)


def check_orientation(body: Body, rule: Rule) -> None:
    """Raise MeshError where det J0 <= 0 at a force point."""
    for first in range(0, len(body.mesh.cells), CHUNK):
        part = np.arange(first, min(first + CHUNK, len(body.mesh.cells)))
        det = geometry(body, part, rule.points)[3]
        bad = np.flatnonzero((det <= 0.0).any(axis=1))
        if len(bad):
            raise MeshError(
                f"body {body.name!r} ({body.mesh.label}): element {int(part[bad[0]])} has det J0 = "
                f"{det[bad[0]].min():.3g} <= 0 at a quadrature point: it is inverted"
            )


def gather_table(conn: list[np.ndarray], slots: int) -> tuple[np.ndarray, np.ndarray]:
    """Who contributes to each slot: CSR start (slots + 1,) and entries, entry k of [local, elem] in order of `conn`."""
    flat = np.concatenate([c.T.ravel() for c in conn]) if conn else np.zeros(0, dtype=np.int64)
    order = np.argsort(flat, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=slots))])
    return start.astype(np.int32), order.astype(np.int32)


def facet_tables(surface: SurfaceSet) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Faces as triangles in their own coordinates.

    Returns:
        conn (F, n) body slots, s (Q, n), ds/dxi (Q, n), ds/deta (Q, n), weights (Q,); n = 3 or 6, outward.
    """
    body = surface.body
    if np.any(body.family.slot_kind > 0):
        raise NotImplementedError(f"surface loads on element {body.family.name} are not part of this version")
    conn = body.node_slot[surface.nodes]
    rule = triangle_6()
    L = np.column_stack([1.0 - rule.points.sum(axis=1), rule.points])
    dL = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    if conn.shape[1] == 3:
        s, ds = L, np.broadcast_to(dL, (len(L), 3, 2))
    else:
        s = np.empty((len(L), 6))
        ds = np.empty((len(L), 6, 2))
        s[:, :3] = L * (2.0 * L - 1.0)
        ds[:, :3] = (4.0 * L - 1.0)[:, :, None] * dL
        for k, (a, b) in enumerate(((0, 1), (1, 2), (2, 0)), start=3):
            s[:, k] = 4.0 * L[:, a] * L[:, b]
            ds[:, k] = 4.0 * (L[:, a, None] * dL[b] + L[:, b, None] * dL[a])
    return conn, s, ds[:, :, 0].copy(), ds[:, :, 1].copy(), rule.weights


def rigid_modes(x: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Six rigid motions on slots with values x: (6, slots, 3), rotations about the mean position."""
    modes = np.zeros((6, len(x), 3))
    position = kind == 0
    arm = x.copy()
    arm[position] -= x[position].mean(axis=0)
    for k in range(3):
        modes[k, position, k] = 1.0
        axis = np.zeros(3)
        axis[k] = 1.0
        modes[3 + k] = np.cross(axis, arm)
    return modes


def components_of(graph: Any) -> np.ndarray:
    """Connected component of each row of a sparse matrix."""
    return sp.csgraph.connected_components(graph, directed=False)[1]
