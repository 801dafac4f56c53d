"""Structured sheets of quads for shells, deterministic, with named edges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .arguments import PointMap, counts, finite, mapped, positive
from .cells import Floats, Ints
from .checks import COINCIDENT, check
from .mesh import Mesh

__all__ = ["grid"]


def grid(
    size: Sequence[float],
    *,
    cells: Sequence[int],
    origin: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    map: PointMap | None = None,
    name: str = "plate",
) -> Mesh:
    """A rectangle of ``cells`` = (nx, ny) quads in the x-y plane, from ``origin`` to ``origin + size`` (m).

    Normals along +z; node sets "x-", "x+", "y-", "y+" of the edges. Nodes are numbered with x running fastest.

    Parameters
    ----------
    size : (lx, ly) in m
    origin : (3,) in m
    map : function X (n, 3) -> (n, 3), or None
        Moves the nodes (m), to roll or twist the sheet; the mesh is then checked. Opposite edges that coincide node
        by node are joined: they share the nodes of the seam, which are in both sets.

    Raises
    ------
    MeshError
        Non-positive size, fewer than one cell; a map without (n, 3) finite values, or with a mesh that fails
        :func:`warpfea.mesh.check`, e.g. with an edge collapsed to a point.
    """
    lx, ly = positive("grid: size", size, 2)
    nx, ny = counts("grid: cells", cells, 2)
    low = finite("grid: origin", origin, 3)
    x, y = np.meshgrid(np.arange(nx + 1) / nx, np.arange(ny + 1) / ny)
    flat = low + np.column_stack([lx * x.ravel(), ly * y.ravel(), np.zeros(x.size)])
    points = mapped("grid: map", flat, map)
    at = np.arange(x.size).reshape(ny + 1, nx + 1)
    if map is not None:
        points, at = _joined(points, at)
    quads = np.stack([at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]], axis=-1).reshape(-1, 4)
    edges = {"x-": at[:, 0], "x+": at[:, -1], "y-": at[0], "y+": at[-1]}
    mesh = Mesh(points, quads, "quad", node_sets={key: np.unique(nodes) for key, nodes in edges.items()}, name=name)
    return mesh if map is None else check(mesh)


def _joined(points: Floats, at: Ints) -> tuple[Floats, Ints]:
    """Points, and node numbers of the lattice ``at`` (ny + 1, nx + 1), with coincident opposite edges joined."""
    tolerance = COINCIDENT * np.linalg.norm(np.ptp(points, axis=0))
    at = at.copy()
    for edge, other in ((at[:, -1], at[:, 0]), (at[-1], at[0])):
        if np.linalg.norm(points[edge] - points[other], axis=1).max() <= tolerance:
            edge[:] = other
    kept, numbers = np.unique(at, return_inverse=True)
    return points[kept], numbers.reshape(at.shape)
