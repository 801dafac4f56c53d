"""Normals of triangle meshes, and grouping of triangle corners by shared normal."""

from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

__all__ = ["CornerNormals", "smooth_corners", "unit_rows", "vertex_normals"]

Array = npt.NDArray[Any]


class CornerNormals:
    """Unit normals of groups of corners of triangles, area-weighted; (0, 0, 1) for groups without a triangle.

    Args:
        triangles: (T, 3). group: (3 T,) of each corner, such as its point. count: number of groups.
    """

    def __init__(self, triangles: Array, group: Array, count: int) -> None:
        self.corners = np.ascontiguousarray(np.asarray(triangles, dtype=np.int64).T)
        number = len(triangles)
        entries = np.ones(3 * number), (group, np.repeat(np.arange(number), 3))
        self.sums = sp.csr_matrix(entries, shape=(count, number))

    def at(self, points: Array) -> npt.NDArray[np.float32]:
        """(count, 3) normals for points (P, 3)."""
        a, b, c = (np.stack([axis[corner] for axis in np.ascontiguousarray(points.T)]) for corner in self.corners)
        u, v = b - a, c - a
        area = np.stack([u[i] * v[j] - u[j] * v[i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)
        return unit_rows(self.sums @ area)


def vertex_normals(points: Array, triangles: Array) -> npt.NDArray[np.float32]:
    """(P, 3) unit normals, area-weighted over the triangles of each point; (0, 0, 1) for points without."""
    return CornerNormals(triangles, triangles.ravel(), len(points)).at(points - points.mean(axis=0))


def unit_rows(rows: Array) -> npt.NDArray[np.float32]:
    """(n, 3) rows scaled to length one; a zero row becomes (0, 0, 1)."""
    scale = float(np.abs(rows).max(initial=0.0)) or 1.0
    rows = rows / scale
    length = np.sqrt(np.einsum("nk,nk->n", rows, rows))[:, None]
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
