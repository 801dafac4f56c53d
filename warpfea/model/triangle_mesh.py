"""Rigid triangle meshes as obstacles: requirements and contact search tables."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..base.checks import is_number
from ..base.errors import MeshError, ModelError
from ..kernels.contact.collider_mesh import BOUNDARY, FLAT, SHARP
from ..kernels.contact.collider_shapes import MESH
from ..mesh.adapter import read_triangles
from .shapes import Shape, set_checked

__all__ = ["TriMesh", "TriangleTables"]

MIN_HEIGHT_RATIO = 1e-10
"""Minimum height of a triangle over its longest edge."""
MAX_FLAT_SINE = 1e-12
"""Sine of the angle up to which triangles count as coplanar."""
MIN_FOLD_NORMAL_SUM = 1e-6
"""Minimum length of the sum of the normals at an edge."""
MAX_LEAF_TRIANGLES = 4
"""Maximum triangles per leaf."""
WELD_RATIO = 1e-6
"""Distance of points that are one, over the size of the mesh: files round coordinates to float32 or six digits."""


@dataclass(frozen=True)
class TriangleTables:
    """Device tables of a triangle mesh in local coordinates (BVH, normals, edge kinds); see
    kernels/contact/collider_mesh.py.

    Attributes:
        low, high: (boxes, 3) m, of a balanced tree.
        start: (leaves + 1,) first triangle of each leaf; last: total number.
        corner: (3, triangles, 3) m, in the order of the leaves.
        normal: (7, triangles, 3) of face, edges ab, bc, ca and corners a, b, c.
        border: (7, triangles) FLAT, SHARP or BOUNDARY.
    """

    low: np.ndarray
    high: np.ndarray
    start: np.ndarray
    corner: np.ndarray
    normal: np.ndarray
    border: np.ndarray


@dataclass(frozen=True, eq=False)
class TriMesh(Shape):
    """Solid within a closed triangle mesh, or a sheet of zero thickness.

    A mesh in which each edge has two triangles is closed, and solid behind its triangles. Any other is a sheet with
    contact on both sides; a body that starts on it is in front. Points within 1e-6 of the size are welded to the
    first of them, and triangles left without three corners are dropped.

    Args:
        points: (n, 3), m over `scale`, or a file that meshio reads, such as .stl, .obj, .ply, .vtk or .msh.
        triangles: (m, 3) point numbers, seen from the front counter-clockwise; None with a file.
        scale: m per unit of the points.

    Raises:
        ModelError: a file that can't be read, no triangles, a triangle without an area, a point number out of range or
            a value that is not finite; an edge of more than two triangles, inconsistent orientation, or coincident
            triangles at an edge; an inverted closed mesh.
    """

    points: Any
    triangles: Any = None
    scale: float = 1.0
    kind: ClassVar[int] = MESH

    def __post_init__(self) -> None:
        if not is_number(self.scale) or not self.scale > 0.0:
            raise ModelError(f"TriMesh: scale = {self.scale!r} must be a positive finite number")
        points, triangles = self.points, self.triangles
        if isinstance(points, (str, os.PathLike)):
            if triangles is not None:
                raise ModelError(f"TriMesh: triangles = must be left out where a file is given ({points})")
            try:
                points, triangles = read_triangles(points)
            except MeshError as error:
                raise ModelError(f"TriMesh: {error}") from None
        points = float(self.scale) * _points(points)
        triangles = _triangles(triangles, points)
        points, triangles = _weld(points, triangles)
        set_checked(self, points=points, triangles=triangles, scale=float(self.scale))
        self._neighbours  # noqa: B018  (checks edges)
        if self.closed and not self.volume > 0.0:
            raise ModelError(
                f"TriMesh: the mesh is closed and inside out, its volume is {self.volume:.3g} m^3: turn the triangles "
                "round, [:, ::-1]"
            )

    def __repr__(self) -> str:
        used = self.points[self.triangles.ravel()]
        box = " x ".join(f"{side:.4g}" for side in used.max(axis=0) - used.min(axis=0))
        kind = f"closed, {self.volume:.4g} m^3" if self.closed else "a sheet"
        return f"TriMesh({len(self.points)} points, {len(self.triangles)} triangles, {box} m, {kind})"

    def frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre of the bounding box, and global axes."""
        used = self.points[self.triangles.ravel()]
        return 0.5 * (used.min(axis=0) + used.max(axis=0)), np.eye(3)

    @property
    def sizes(self) -> np.ndarray:
        """(3,) diagonal of the bounding box, thickness 2 V/A (of a sheet the diagonal), m, and 1 if closed."""
        used = self.points[self.triangles.ravel()]
        size = float(np.linalg.norm(used.max(axis=0) - used.min(axis=0)))
        area = 0.5 * float(np.linalg.norm(self._double_area_normals, axis=1).sum())
        return np.array([size, 2.0 * self.volume / area if self.closed else size, float(self.closed)])

    def mesh(self, resolution: int = 24) -> tuple[np.ndarray, np.ndarray]:
        """Points and triangles, unchanged."""
        return self.points, self.triangles

    @property
    def closed(self) -> bool:
        """True if each edge has two triangles."""
        return bool((self._neighbours >= 0).all())

    @cached_property
    def part_count(self) -> int:
        """Number of parts that share no edge."""
        one, edge = np.nonzero(self._neighbours >= 0)
        graph = coo_matrix((np.ones(len(one)), (one, self._neighbours[one, edge])), shape=(len(self.triangles),) * 2)
        return int(connected_components(graph, directed=False, return_labels=False))

    @property
    def volume(self) -> float:
        """Volume of a closed mesh, m^3."""
        a, b, c = np.moveaxis(self._corners, 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

    @cached_property
    def _corners(self) -> np.ndarray:
        """(m, 3, 3) corners of the triangles about the centre, m."""
        return self.points[self.triangles] - self.frame()[0]

    @property
    def _double_area_normals(self) -> np.ndarray:
        """(m, 3) normals of length 2 x area, m^2."""
        p = self._corners
        return np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])

    @cached_property
    def _merged_triangles(self) -> np.ndarray:
        """(m, 3) triangles by merged point indices."""
        _, number = np.unique(self.points, axis=0, return_inverse=True)
        return np.asarray(number.reshape(-1)[self.triangles])

    @cached_property
    def _neighbours(self) -> np.ndarray:
        """(m, 3) neighbour across each edge ab, bc, ca, or -1. ModelError names an invalid edge."""
        t = self._merged_triangles
        start, end = t.ravel(), np.roll(t, -1, axis=1).ravel()
        low, high = np.minimum(start, end), np.maximum(start, end)
        order = np.lexsort((high, low))
        low, high = low[order], high[order]
        same = (low[1:] == low[:-1]) & (high[1:] == high[:-1])
        for k in np.flatnonzero(same[1:] & same[:-1])[:1]:
            found = ", ".join(str(int(e) // 3) for e in order[k : k + 3])
            raise ModelError(f"TriMesh: {self._edge_text(order[k])} has more than two triangles ({found}, ...)")
        one, other = order[:-1][same], order[1:][same]
        for k in np.flatnonzero(start[one] == start[other])[:1]:
            raise ModelError(
                f"TriMesh: inconsistent orientation of triangles {one[k] // 3} and {other[k] // 3} at "
                f"{self._edge_text(one[k])}: flip one"
            )
        normal = self._double_area_normals / np.linalg.norm(self._double_area_normals, axis=1, keepdims=True)
        folded = np.linalg.norm(normal[one // 3] + normal[other // 3], axis=1) < MIN_FOLD_NORMAL_SUM
        for k in np.flatnonzero(folded)[:1]:
            raise ModelError(f"TriMesh: coincident triangles {one[k] // 3} and {other[k] // 3} at "
                             f"{self._edge_text(one[k])}: the surface folds back on itself")  # fmt: skip
        out = np.full(t.size, -1)
        out[one], out[other] = other // 3, one // 3
        return out.reshape(-1, 3)

    def _edge_text(self, number: int) -> str:
        """Text of an edge (3 x triangle + edge): the points at its ends."""
        triangle, k = divmod(int(number), 3)
        a, b = self.triangles[triangle, [k, (k + 1) % 3]]
        return f"the edge between points {a} and {b}"

    @cached_property
    def tables(self) -> TriangleTables:
        """Contact search tables."""
        normal, border = self._feature_normals()
        order, start, low, high = build_bvh(self._corners)
        corner = np.moveaxis(self._corners[order], 1, 0)
        return TriangleTables(low, high, start, corner, normal[:, order], border[:, order])

    def _feature_normals(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit normals (7, m, 3), of edges and corners by the angles of their faces, and kinds of border (7, m)."""
        face = self._double_area_normals / np.linalg.norm(self._double_area_normals, axis=1, keepdims=True)
        beyond, t, p = self._neighbours, self._merged_triangles, self._corners
        normal, border = np.repeat(face[None], 7, axis=0), np.full((7, len(face)), FLAT)
        places = int(t.max()) + 1
        first = np.zeros((places, 3))
        first[t.ravel()] = np.repeat(face, 3, axis=0)
        total, bent, rim = np.zeros((places, 3)), np.zeros(places, dtype=bool), np.zeros(places, dtype=bool)
        for k in range(3):
            out, back = p[:, (k + 1) % 3] - p[:, k], p[:, (k + 2) % 3] - p[:, k]
            angle = np.arctan2(np.linalg.norm(np.cross(out, back), axis=1), np.einsum("ij,ij->i", out, back))
            np.add.at(total, t[:, k], angle[:, None] * face)
            bent[t[np.linalg.norm(face - first[t[:, k]], axis=1) > MAX_FLAT_SINE, k]] = True
            alone = beyond[:, k] < 0
            rim[t[alone][:, [k, (k + 1) % 3]].ravel()] = True
            other = np.where(alone[:, None], face, face[beyond[:, k]])
            sharp = np.linalg.norm(face - other, axis=1) > MAX_FLAT_SINE
            mean = 0.5 * (face + other)
            normal[1 + k] = np.where(sharp[:, None], mean / np.linalg.norm(mean, axis=1, keepdims=True), face)
            border[1 + k] = np.where(alone, BOUNDARY, np.where(sharp, SHARP, FLAT))
        length = np.linalg.norm(total, axis=1, keepdims=True)
        mean = np.where(length > 1e-9, total / np.maximum(length, 1e-300), first)
        for k in range(3):
            at = t[:, k]
            normal[4 + k] = np.where(bent[at][:, None], mean[at], face)
            border[4 + k] = np.where(rim[at], BOUNDARY, np.where(bent[at], SHARP, FLAT))
        return normal, border


def build_bvh(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Balanced bounding volume hierarchy: order of the triangles, start of leaves, low and high corners of boxes.

    Each box is split at the median triangle centre along the longest axis.

    Args:
        corners: (m, 3, 3) m.
    """
    count = len(corners)
    levels = max(0, int(np.ceil(np.log2(count / MAX_LEAF_TRIANGLES))))
    middle, order = corners.mean(axis=1), np.arange(count)
    for level in range(levels):
        start = np.arange((1 << level) + 1) * count >> level
        part = np.repeat(np.arange(1 << level), np.diff(start))
        spread = np.maximum.reduceat(middle[order], start[:-1]) - np.minimum.reduceat(middle[order], start[:-1])
        axis = spread.argmax(axis=1)[part]
        order = order[np.lexsort((order, middle[order, axis], part))]
    start = np.arange((1 << levels) + 1) * count >> levels
    lows = [np.minimum.reduceat(corners[order].min(axis=1), start[:-1])]
    highs = [np.maximum.reduceat(corners[order].max(axis=1), start[:-1])]
    for _ in range(levels):
        lows.insert(0, np.minimum(lows[0][::2], lows[0][1::2]))
        highs.insert(0, np.maximum(highs[0][::2], highs[0][1::2]))
    return order, start, np.concatenate(lows), np.concatenate(highs)


def _points(values: Any) -> np.ndarray:
    """(n, 3) finite numbers."""
    try:
        out = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise ModelError(f"TriMesh: points = {values!r} must be (n, 3) numbers, m, or a file") from None
    if out.ndim != 2 or out.shape[1] != 3:
        raise ModelError(f"TriMesh: points have shape {out.shape}, expected (n, 3), m")
    for k in np.flatnonzero(~np.isfinite(out).all(axis=1))[:1]:
        raise ModelError(f"TriMesh: point {k} = {out[k].tolist()} is not finite")
    return out


def _triangles(values: Any, points: np.ndarray) -> np.ndarray:
    """(m, 3) point indices of non-degenerate triangles."""
    count = len(points)
    out = np.array([] if values is None else values)
    if not out.size:
        raise ModelError("TriMesh: there are no triangles; give (m, 3) point numbers")
    if out.ndim != 2 or out.shape[1] != 3 or not np.issubdtype(out.dtype, np.integer):
        raise ModelError(
            f"TriMesh: triangles have shape {out.shape} and type {out.dtype}, expected (m, 3) whole numbers"
        )
    for k in np.flatnonzero(((out < 0) | (out >= count)).any(axis=1))[:1]:
        raise ModelError(f"TriMesh: triangle {k} = {out[k].tolist()} has a point number out of range, 0 .. {count - 1}")
    edges = points[np.roll(out, -1, axis=1)] - points[out]
    longest = np.einsum("tki,tki->tk", edges, edges).max(axis=1)
    flat = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) <= MIN_HEIGHT_RATIO * longest
    for k in np.flatnonzero(flat)[:1]:
        raise ModelError(f"TriMesh: triangle {k} = {out[k].tolist()} has no area ({int(flat.sum())} such)")
    return out.astype(np.int64)


def _weld(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points, each at the first of those within `WELD_RATIO` of it, and the triangles that keep three corners."""
    used = points[triangles.ravel()]
    near = WELD_RATIO * float(np.linalg.norm(np.ptp(used, axis=0)))
    first, number = np.unique(points, axis=0, return_index=True, return_inverse=True)[1:]
    pairs = cKDTree(points[first]).query_pairs(near, output_type="ndarray")
    if not len(pairs):
        return points, triangles
    ones = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(first), len(first)))
    group = connected_components(ones, directed=False)[1][number.reshape(-1)]
    out = points[np.unique(group, return_index=True)[1]][group]
    corner = group[triangles]
    kept = (corner != np.roll(corner, 1, axis=1)).all(axis=1)
    return out, _triangles(triangles[kept], out)
