"""The table of cell types (nodes, corners, edges, faces) and the geometry of one cell.

A new cell type is one more row of :data:`CELL_TYPES`, with its shape functions. Node order is meshio's. A local
face of a solid lists its corners so that their right-hand normal points out of a cell with det J0 > 0, then its
mid-edge nodes in the order of its edges (01, 12, 20); the "faces" of a quad are its edges, in the sense in which it
runs through them. Face k holds the nodes of Abaqus's label S(k+1), or E(k+1) for quads.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

__all__ = [
    "CELL_TYPES", "CENTROID", "ELEMENT_CELLS", "FILE_CELLS", "HEX_CORNERS", "HEX_FACES", "TET14_ORBITS", "TET_EDGES",
    "TET_FACES", "CellType", "barycentric", "cell_dimension", "det_j0", "edge_orbit", "element_volumes", "row_keys",
    "tet4_gradients", "tet10_gradients", "vertex_orbit",
]  # fmt: skip


@dataclass(frozen=True)
class CellType:
    """Properties of one cell type.

    ``nodes``: nodes per cell; ``corners``: number of corner nodes, which come first; ``edges``: corner pairs, the
    mid-edge node of edge k is ``corners + k`` if the type has any; ``faces``: local node numbers, outward;
    ``face_corners``: corners per face; ``gradients(xi)``: (P, nodes, d) shape derivatives
    at xi (P, d), d the dimension; ``rule``: points (P, d) and weights (P,) exact for the volume of a curved
    cell; ``check_points``: points (P, d) where det J0 must be positive.
    """

    name: str
    nodes: int
    corners: int
    edges: Ints
    faces: Ints
    face_corners: int
    gradients: Callable[[Floats], Floats]
    rule: tuple[Floats, Floats]
    check_points: Floats

    @property
    def has_mid_nodes(self) -> bool:
        """True for second-order cells: one node per edge after the corners."""
        return self.nodes == self.corners + len(self.edges)

    @property
    def dimension(self) -> int:
        """1 for lines, 2 for surfaces, 3 for solids."""
        return cell_dimension(self.name)


TET_EDGES = np.array([(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)], dtype=np.int64)
TET_FACES = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)], dtype=np.int64)
_TET10_FACES = np.array(
    [(0, 2, 1, 6, 5, 4), (0, 1, 3, 4, 8, 7), (1, 2, 3, 5, 9, 8), (0, 3, 2, 7, 9, 6)], dtype=np.int64
)
_BARYCENTRIC_GRADIENTS = np.array([(-1.0, -1.0, -1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])  # dL_i/dxi


def barycentric(xi: Floats) -> Floats:
    """Barycentric coordinates (P, 4) of xi (P, 3)."""
    return np.column_stack([1.0 - xi.sum(axis=1), xi])


def tet4_gradients(xi: Floats) -> Floats:
    """ds_i/dxi of T4: (P, 4, 3)."""
    return np.broadcast_to(_BARYCENTRIC_GRADIENTS, (len(xi), 4, 3))


def tet10_gradients(xi: Floats) -> Floats:
    """ds_i/dxi of T10, (P, 10, 3): corners s = L (2 L - 1), mid-edges s = 4 L_a L_b."""
    lam = barycentric(xi)
    a, b = TET_EDGES.T
    corner = (4.0 * lam - 1.0)[:, :, None] * _BARYCENTRIC_GRADIENTS
    mid = 4.0 * (lam[:, a, None] * _BARYCENTRIC_GRADIENTS[b] + lam[:, b, None] * _BARYCENTRIC_GRADIENTS[a])
    return np.concatenate([corner, mid], axis=1)


def vertex_orbit(a: float) -> Floats:
    """The four points (4, 3) with one barycentric coordinate 1 - 3 a and three a; that of corner k comes k-th."""
    b = 1.0 - 3.0 * a
    return np.array([(a, a, a), (b, a, a), (a, b, a), (a, a, b)])


def edge_orbit(a: float) -> Floats:
    """The six points (6, 3) with two barycentric coordinates a and two 1/2 - a."""
    c = 0.5 - a
    return np.array([(c, a, a), (a, c, a), (a, a, c), (c, c, a), (c, a, c), (a, c, c)])


CENTROID = np.full((1, 3), 0.25)
_FIVE_POINT_RULE = (
    np.concatenate([CENTROID, vertex_orbit(1.0 / 6.0)]),
    np.array([-4.0 / 5.0, *(4 * [9.0 / 20.0])]) / 6.0,
)  # degree 3: exact for det J0 of a T10, which is cubic; for volumes only, never for a mass matrix
_ONE_POINT_RULE = (CENTROID, np.array([1.0 / 6.0]))
TET14_ORBITS = (0.31088591926330060980, 0.092735250310891226402, 0.045503704125649649492)
"""Barycentric coordinates of the rule tet14: two orbits of vertices, one of edges."""
_TET10_CHECK_POINTS = np.concatenate([
    vertex_orbit(0.0), edge_orbit(0.0), CENTROID,  # corners, mid-edges
    vertex_orbit((5.0 - 5.0**0.5) / 20.0), vertex_orbit(1.0 / 6.0),  # tet4, tet5_paper
    *map(vertex_orbit, TET14_ORBITS[:2]), edge_orbit(TET14_ORBITS[2]),
])  # fmt: skip

_TET_FACE_NODES = np.column_stack([TET_FACES, np.arange(4, 8)])  # node 4 + k is the centroid of face k


def tet_faces_gradients(xi: Floats) -> Floats:
    """ds_i/dxi of T4 with four more nodes at the face centroids, which carry no geometry: (P, 8, 3)."""
    return np.concatenate([tet4_gradients(xi), np.zeros((len(xi), 4, 3))], axis=1)


# corners, edges and faces of the unit line, square and cube

_LINE_CORNERS = np.array([(0.0,), (1.0,)])
_LINE_EDGES = np.array([(0, 1)], dtype=np.int64)
_LINE_FACES = np.empty((0, 2), dtype=np.int64)
_QUAD_CORNERS = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
_QUAD_EDGES = np.array([(0, 1), (1, 2), (2, 3), (3, 0)], dtype=np.int64)
HEX_CORNERS = np.array([(*corner, z) for z in (0.0, 1.0) for corner in _QUAD_CORNERS])
_HEX_EDGES = np.array(
    [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)], dtype=np.int64
)
HEX_FACES = np.array(
    [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)], dtype=np.int64
)


def _multilinear_gradients(corners: Floats, xi: Floats) -> Floats:
    """ds_i/dxi of s_i = product over the axes of xi or 1 - xi, whichever is 1 at corner i: (P, corners, d)."""
    sign = 2.0 * corners - 1.0
    factor = 1.0 - corners + sign * xi[:, None, :]
    others = [np.prod(np.delete(factor, k, axis=2), axis=2) for k in range(corners.shape[1])]
    return sign * np.stack(others, axis=2)


line_gradients, quad_gradients, hex_gradients = (
    partial(_multilinear_gradients, corners) for corners in (_LINE_CORNERS, _QUAD_CORNERS, HEX_CORNERS)
)
"""ds_i/dxi of the linear line, the bilinear quadrilateral and the trilinear hexahedron on the unit interval, square and
cube: (P, 2, 1), (P, 4, 2), (P, 8, 3)."""


def _gauss_rule(dimension: int) -> tuple[Floats, Floats]:
    """Two Gauss points per axis of the unit line, square or cube; exact for det J0 of a hexahedron."""
    one = 0.5 + np.array([-0.5, 0.5]) / 3.0**0.5
    points = np.stack(np.meshgrid(*(dimension * [one]), indexing="ij"), axis=-1).reshape(-1, dimension)
    return points, np.full(len(points), 1.0 / len(points))


_LINE_RULE, _QUAD_RULE, _HEX_RULE = _gauss_rule(1), _gauss_rule(2), _gauss_rule(3)
_HEX_CHECK_POINTS = np.concatenate([HEX_CORNERS, [(0.5, 0.5, 0.5)], _HEX_RULE[0]])

_CELL_TYPE_ROWS = (
    CellType("tetra", 4, 4, TET_EDGES, TET_FACES, 3, tet4_gradients, _ONE_POINT_RULE, _ONE_POINT_RULE[0]),
    CellType("tetra10", 10, 4, TET_EDGES, _TET10_FACES, 3, tet10_gradients, _FIVE_POINT_RULE, _TET10_CHECK_POINTS),
    CellType("hexahedron", 8, 8, _HEX_EDGES, HEX_FACES, 4, hex_gradients, _HEX_RULE, _HEX_CHECK_POINTS),
    CellType("quad", 4, 4, _QUAD_EDGES, _QUAD_EDGES, 2, quad_gradients, _QUAD_RULE, _QUAD_RULE[0]),
    CellType("line", 2, 2, _LINE_EDGES, _LINE_FACES, 2, line_gradients, _LINE_RULE, _LINE_RULE[0]),
    CellType(
        "tetra_faces", 8, 4, TET_EDGES, _TET_FACE_NODES, 3, tet_faces_gradients, _ONE_POINT_RULE, _ONE_POINT_RULE[0]
    ),
)
CELL_TYPES: dict[str, CellType] = {row.name: row for row in _CELL_TYPE_ROWS}
FILE_CELLS = ("tetra", "tetra10", "hexahedron", "quad")
"""Cell types in files; "line" (beams) and "tetra_faces" (ENMC) are generated."""
ELEMENT_CELLS = {
    "T4": "tetra",
    "T10": "tetra10",
    **dict.fromkeys(("ENMC", "FN", "FN18"), "tetra"),
    "H3843": "hexahedron",
}
"""Solid element name in the API -> cell type of its mesh."""

_DIMENSION_PATTERNS = {
    0: "vertex|empty",
    1: "line|VTK_(LAGRANGE|BEZIER)_CURVE",
    2: "triangle|quad|polygon|pixel|VTK_(LAGRANGE|BEZIER)_(TRI|QUAD)",
}
"""Beginnings of cell types."""


def cell_dimension(name: str) -> int:
    """Dimension 0 .. 3 of a meshio cell type; anything but a point, line or surface counts as 3."""
    return next((dim for dim, pattern in _DIMENSION_PATTERNS.items() if re.match(pattern, name)), 3)


def det_j0(points: Floats, cells: Ints, kind: CellType, xi: Floats) -> Floats:
    """det J0 of every cell at every parent point, (M, P): m^3; |X_xi x X_eta| (m^2) of quads, |X_xi| (m) of lines."""
    out = np.empty((len(cells), len(xi)))
    coordinates = points[cells]
    for p, gradient in enumerate(kind.gradients(xi)):
        j = np.einsum("mik,il->mkl", coordinates, gradient)
        if kind.dimension == 3:
            out[:, p] = np.einsum("mk,mk->m", j[:, :, 0], np.cross(j[:, :, 1], j[:, :, 2]))
        else:
            out[:, p] = np.linalg.norm(j[:, :, 0] if kind.dimension == 1 else np.cross(j[:, :, 0], j[:, :, 1]), axis=1)
    return out


def element_volumes(points: Floats, cells: Ints, kind: CellType) -> Floats:
    """Volume (m^3), area (m^2) or length (m) of every cell, (M,); negative for an inverted solid.

    Exact for curved sides of solids too; for a non-planar quad that of the bilinear surface by 2 x 2 points.
    """
    xi, weights = kind.rule
    return det_j0(points, cells, kind, xi) @ weights


def row_keys(rows: Ints, bound: int) -> Ints:
    """One integer per row of ``rows`` (K, n), 0 <= entries < ``bound``: equal keys mean equal rows."""
    key = rows[:, 0].astype(np.int64)
    top = int(bound)
    for column in rows.T[1:]:
        if top * int(bound) >= 2**62:  # too large to pack: number the distinct keys so far
            unique, key = np.unique(key, return_inverse=True)
            top = len(unique)
        key = key * np.int64(bound) + column
        top *= int(bound)
    return key
