"""Normals of triangle meshes, and grouping of triangle corners by shared normal."""

from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["scatter_rows", "smooth_corners", "unit_rows", "vertex_normals"]

Array = npt.NDArray[Any]


def vertex_normals(points: Array, triangles: Array) -> npt.NDArray[np.float32]:
    """(P, 3) unit normals, area-weighted over the triangles of each point; (0, 0, 1) for points without."""
    points = points - points.mean(axis=0)
    corner = [points[triangles[:, k]] for k in range(3)]
    area = np.cross(corner[1] - corner[0], corner[2] - corner[0])
    return unit_rows(scatter_rows(triangles.ravel(), np.repeat(area, 3, axis=0), len(points)))


def scatter_rows(index: Array, rows: Array, count: int) -> npt.NDArray[np.float64]:
    """(count, 3) sums of `rows` (n, 3) that share an index, in a fixed order."""
    return np.stack([np.bincount(index, weights=rows[:, k], minlength=count) for k in range(3)], axis=1)


def unit_rows(rows: Array) -> npt.NDArray[np.float32]:
    """(n, 3) rows scaled to length one; a zero row becomes (0, 0, 1)."""
    scale = float(np.abs(rows).max(initial=0.0)) or 1.0
    rows = rows / scale
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    good = length > 1e-20
    return np.asarray(np.where(good, rows / np.where(good, length, 1.0), (0.0, 0.0, 1.0)), dtype=np.float32)


def smooth_corners(
    points: Array, triangles: npt.NDArray[np.integer[Any]], angle: float = 40.0
) -> tuple[npt.NDArray[np.int64], int]:
    """Groups of triangle corners that share a normal: (3 T,) group of each corner, number of groups.

    Corners at a point share one if their triangles are connected by edges flatter than `angle` (degrees).
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    t = np.asarray(triangles, dtype=np.int64)
    p = points[t]
    normal = unit_rows(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]))
    face = np.tile(np.arange(len(t)), 3)
    first = np.repeat([0, 1, 2], len(t))
    ends = np.stack([t[face, first], t[face, (first + 1) % 3]], axis=1)
    corner = np.stack([3 * face + first, 3 * face + (first + 1) % 3], axis=1)
    swap = ends[:, 0] > ends[:, 1]
    ends[swap], corner[swap] = ends[swap][:, ::-1], corner[swap][:, ::-1]
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    ends, corner, face = ends[order], corner[order], face[order]
    same = (ends[1:] == ends[:-1]).all(axis=1)
    flat = np.einsum("ij,ij->i", normal[face[1:]], normal[face[:-1]]) > np.cos(np.radians(angle))
    link = np.nonzero(same & flat)[0]
    a, b = corner[link].ravel(), corner[link + 1].ravel()
    graph = coo_matrix((np.ones(len(a), dtype=np.int8), (a, b)), shape=(3 * len(t), 3 * len(t)))
    count, group = connected_components(graph, directed=False)
    return group.astype(np.int64), int(count)
