"""Faces of a body, and its drawn geometry by the shape functions: curved faces, sections, thickness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..base.errors import ModelError
from ..base.names import did_you_mean
from .discretisation import Discretisation, element_functions

__all__ = [
    "Drawing",
    "Skin",
    "face_centroids",
    "make_drawing",
    "make_skin",
    "measure_to_skin",
    "reference_points",
    "sparse_weights",
]


@dataclass(frozen=True, eq=False)
class Skin:
    """The drawn surface of a body.

    Attributes:
        triangles: (T, 3) indices of the skin's points, outward by the right hand.
        slot_weights: sparse (points, slots): skin positions from slot values.
        node_weights: sparse (points, mesh nodes x samples): skin fields from fields at the nodes' samples.
        edges: (E, 2) indices of the points along the edges of elements.
    """

    triangles: np.ndarray
    slot_weights: sp.csr_matrix
    node_weights: sp.csr_matrix
    edges: np.ndarray


@dataclass(frozen=True, eq=False)
class Drawing:
    """A body as cells of VTK.

    Attributes:
        cell_type: of all cells, by its name in meshio.
        cells: (C, n) indices of the drawing's points.
        element: (C,) element of each cell.
        slot_weights, node_weights: as of Skin.
    """

    cell_type: str
    cells: np.ndarray
    element: np.ndarray
    slot_weights: sp.csr_matrix
    node_weights: sp.csr_matrix


def named_faces(body: Discretisation) -> dict[str, np.ndarray]:
    """Named faces of beams ("start", "end", "side-", "side+", "normal-", "normal+"; "side" and "bore" of
    sections that are no rectangles) and shells ("top", "bottom", and
    the strip over each named edge)."""
    mesh = body.mesh
    faces = body.boundary
    if mesh.cell_type == "line":
        names = np.array(body.family.face_names)
        return {str(name): faces[names[faces[:, 1]] == name] for name in dict.fromkeys(body.family.face_names)}
    out = {"bottom": faces[faces[:, 1] == 0], "top": faces[faces[:, 1] == 1]}
    strips = faces[faces[:, 1] > 1]
    ends = np.array([(0, 1), (1, 2), (2, 3), (3, 0)])[strips[:, 1] - 2]
    nodes = mesh.cells[strips[:, 0, None], ends]
    for name, members in mesh.node_sets.items():
        inside = np.isin(nodes, members).all(axis=1)
        if inside.any() and name not in out:
            out[name] = strips[inside]
    return out


def select_faces(body: Discretisation, selection: Any) -> np.ndarray:
    """Rows (element, local face) of a surface given by name, by a predicate of outer faces' centroids, or as rows.

    Raises:
        ModelError: an unknown name (lists the names), a predicate without a mask, or rows out of range.
    """
    if body.family.solid:
        return body.mesh.surface(selection)
    label = f"body {body.name!r}"
    if isinstance(selection, str):
        named = named_faces(body)
        if selection not in named:
            hint = did_you_mean(selection, named)
            raise ModelError(f"{label}: no surface named {selection!r}; there are: {', '.join(map(repr, named))}{hint}")
        return named[selection]
    if callable(selection):
        mask = np.asarray(selection(face_centroids(body, body.boundary)))
        if mask.shape != (len(body.boundary),) or mask.dtype != bool:
            raise ModelError(f"{label}: the predicate must return a bool array of shape ({len(body.boundary)},)")
        return body.boundary[mask]
    rows = np.asarray(selection)
    limits = (len(body.mesh.cells), len(body.family.faces))
    if rows.ndim != 2 or rows.shape[1] != 2 or rows.dtype.kind not in "iu":
        raise ModelError(f"{label}: a surface is a name, a predicate, or integer rows (element, local face)")
    if np.any(rows < 0) or np.any(rows >= limits):
        raise ModelError(f"{label}: surface rows must lie below (elements, faces) = {limits}")
    return rows.astype(np.int64)


def face_centroids(body: Discretisation, faces: np.ndarray) -> np.ndarray:
    """(K, 3) reference point in the middle of each face, m."""
    out = np.empty((len(faces), 3))
    for face, rows in _rows_by_local_face(faces):
        middle = np.full((1, 2), 1.0 / 3.0 if len(body.family.faces[face]) == 3 else 0.5)
        xi, _ = body.family.face_points(face, middle)
        s, _ = element_functions(body, faces[rows, 0], xi)
        E = body.reference[body.connectivity[faces[rows, 0]]]
        out[rows] = np.einsum("es,esk->ek", np.broadcast_to(s[:, 0], E.shape[:2]), E) + body.origin
    return out


def _rows_by_local_face(faces: np.ndarray) -> list[tuple[int, np.ndarray]]:
    return [(int(k), np.flatnonzero(faces[:, 1] == k)) for k in np.unique(faces[:, 1])]


def _subdivide(corners: int, parts: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Points (P, 2) of the unit triangle or square cut into parts, and the triangles (T, 3) over them."""
    na, nb = parts
    if corners == 4:
        a, b = np.meshgrid(np.linspace(0, 1, na + 1), np.linspace(0, 1, nb + 1), indexing="ij")
        k = np.arange(a.size).reshape(a.shape)
        p, q, r, s = (x.ravel() for x in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
        return np.column_stack([a.ravel(), b.ravel()]), np.concatenate([np.c_[p, q, r], np.c_[p, r, s]])
    grid = [(i, j) for i in range(na + 1) for j in range(na + 1 - i)]
    number = {ij: k for k, ij in enumerate(grid)}
    triangles = []
    for i, j in grid:
        if i + j < na:
            triangles.append((number[i, j], number[i + 1, j], number[i, j + 1]))
        if i + j < na - 1:
            triangles.append((number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]))
    return np.array(grid, dtype=float) / na, np.array(triangles)


class _PointMerger:
    """Collects material points of elements, and merges those with equal weights on the same slots."""

    def __init__(self, body: Discretisation) -> None:
        self.body = body
        low, high = body.mesh.bounding_box()
        size = float(np.max(high - low)) or 1.0
        hashes = np.random.default_rng(0).integers(1, 2**62, body.slot_count, dtype=np.int64)
        self._slot_hashes = hashes.astype(np.uint64)
        self._slot_scale = np.where(body.slot_kind > 0, size, 1.0)
        self._parts: list[tuple[np.ndarray, ...]] = []
        self._keys: list[np.ndarray] = []
        self.count = 0

    def add(self, elements: np.ndarray, xi: np.ndarray, label: int) -> np.ndarray:
        """Add the points xi (P, 3) of each element; returns their (E, P) indices before merging.

        Points of different `label` are not merged.
        """
        body = self.body
        s, _ = element_functions(body, elements, xi)
        conn = body.connectivity[elements]
        E, P, S = len(elements), len(xi), conn.shape[1]
        w = np.broadcast_to(s, (E, P, S))
        slots = np.broadcast_to(conn[:, None, :], (E, P, S))
        rounded = np.round(w / self._slot_scale[slots] * 1e6).astype(np.int64).astype(np.uint64)
        key = (rounded * self._slot_hashes[slots]).sum(axis=2, dtype=np.uint64) + np.uint64(label << 56)
        samples = body.family.sample_weights(xi)
        k = body.family.node_samples.shape[1]
        at = (body.mesh.cells[elements][:, :, None] * k + np.arange(k)).reshape(E, 1, -1)
        self._parts.append(
            (
                w.reshape(E * P, S),
                slots.reshape(E * P, S),
                np.broadcast_to(samples, (E, *samples.shape)).reshape(E * P, -1),
                np.broadcast_to(at, (E, P, at.shape[2])).reshape(E * P, -1),
            )
        )
        self._keys.append(key.ravel())
        first = self.count
        self.count += E * P
        return first + np.arange(E * P).reshape(E, P)

    def merge(self) -> tuple[np.ndarray, sp.csr_matrix, sp.csr_matrix]:
        """Merged index of each point, and slot and sample weights of the merged points."""
        _, first, inverse = np.unique(np.concatenate(self._keys), return_index=True, return_inverse=True)
        rank = np.empty(len(first), dtype=np.int64)
        rank[np.argsort(first)] = np.arange(len(first))
        chosen = np.sort(first)
        w, slots, samples, at = (np.concatenate([p[k] for p in self._parts])[chosen] for k in range(4))
        nodes = len(self.body.mesh.points) * self.body.family.node_samples.shape[1]
        return (
            rank[inverse.ravel()],
            sparse_weights(w, slots, self.body.slot_count),
            sparse_weights(samples, at, nodes),
        )


def sparse_weights(values: np.ndarray, columns: np.ndarray, width: int) -> sp.csr_matrix:
    """Matrix (rows, width) of values (rows, n) in columns (rows, n), without round-off."""
    values = np.where(np.abs(values) < 1e-14, 0.0, values)
    rows = np.repeat(np.arange(len(values)), values.shape[1])
    out = sp.csr_matrix((values.ravel(), (rows, columns.ravel())), shape=(len(values), width))
    out.eliminate_zeros()
    return out


def make_skin(body: Discretisation) -> Skin:
    """Outer faces as triangles; faces of beams and shells share no points, for sharp edges."""
    points = _PointMerger(body)
    triangles, edges = [], []
    for face, rows in _rows_by_local_face(body.boundary):
        corners = body.family.faces[face]
        ab, cut = _subdivide(len(corners), body.family.face_divisions[face])
        xi, _ = body.family.face_points(face, ab)
        number = points.add(body.boundary[rows, 0], xi, 0 if body.family.solid else face + 1)
        triangles.append(number[:, cut].reshape(-1, 3))
        sides = np.sort(cut[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        outline, count = np.unique(sides, axis=0, return_counts=True)
        edges.append(number[:, outline[count == 1]].reshape(-1, 2))
    new, slot_weights, node_weights = points.merge()
    outlines = np.unique(np.sort(new[np.concatenate(edges)], axis=1), axis=0)
    return Skin(new[np.concatenate(triangles)], slot_weights, node_weights, outlines)


def make_drawing(body: Discretisation) -> Drawing:
    """All elements as cells of VTK."""
    lattice = body.family.vtk_subdivision
    elements = np.arange(len(body.mesh.cells))
    points = _PointMerger(body)
    number = points.add(elements, lattice.points, 0)
    new, slot_weights, node_weights = points.merge()
    cells = new[number[:, lattice.cells]].reshape(-1, lattice.cells.shape[1])
    return Drawing(lattice.cell_type, cells, np.repeat(elements, len(lattice.cells)), slot_weights, node_weights)


def reference_points(body: Discretisation, weights: sp.csr_matrix) -> np.ndarray:
    """(P, 3) reference positions, m, of points given by their weights (P, slots) on slots."""
    return weights @ body.reference + np.asarray(weights @ (body.slot_kind == 0))[:, None] * body.origin


def measure_to_skin(
    body: Discretisation, kernel: Any, x: np.ndarray, *vectors: np.ndarray, u: np.ndarray | None = None
) -> np.ndarray:
    """Distances (n,), m, that a kernel (mesh, points, vectors, out) measures from points x (n, 3), m, to the skin of a
    body; `vectors`: of unit length, (n, 3); u: displacements of the body's slots, by default 0."""
    import warp as wp

    drawn = make_skin(body)
    skin = reference_points(body, drawn.slot_weights)
    if u is not None:
        skin = skin + drawn.slot_weights @ u.astype(float)
    center, size = skin.mean(axis=0), float(np.ptp(skin, axis=0).max())
    with wp.ScopedDevice("cpu"):
        mesh = wp.Mesh(
            wp.array((skin - center) / size, dtype=wp.vec3),
            wp.array(drawn.triangles.ravel(), dtype=wp.int32),
            support_winding_number=u is not None,
        )
        out = wp.zeros(len(x), dtype=float)
        args: list[Any] = [wp.array(values, dtype=wp.vec3) for values in ((x - center) / size, *vectors)]
        wp.launch(kernel, len(x), [mesh.id, *args, out], device="cpu")
        return np.asarray(out.numpy(), dtype=float) * size
