"""Structured sheets of quads for shells, deterministic, with named edges."""

from collections.abc import Sequence

import numpy as np

from .arguments import PointMap, cell_counts, finite_numbers, map_points, positive_numbers
from .cells import Floats, Ints
from .checks import COINCIDENCE_TOL, check
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
        by node are joined: they share the nodes of the seam, which belong to the node sets of both edges.

    Raises
    ------
    MeshError
        Non-positive size, fewer than one cell; a map without (n, 3) finite values, or with a mesh that fails
        :func:`warpfea.mesh.check`, e.g. with an edge collapsed to a point.
    """
    lx, ly = positive_numbers("grid: size", size, 2)
    nx, ny = cell_counts("grid: cells", cells, 2)
    low = finite_numbers("grid: origin", origin, 3)
    x, y = np.meshgrid(np.arange(nx + 1) / nx, np.arange(ny + 1) / ny)
    flat = low + np.column_stack([lx * x.ravel(), ly * y.ravel(), np.zeros(x.size)])
    points = map_points("grid: map", flat, map)
    node_numbers = np.arange(x.size).reshape(ny + 1, nx + 1)
    if map is not None:
        points, node_numbers = _join_edges(points, node_numbers)
    quads = np.stack(
        [node_numbers[:-1, :-1], node_numbers[:-1, 1:], node_numbers[1:, 1:], node_numbers[1:, :-1]], axis=-1
    ).reshape(-1, 4)
    edges = {"x-": node_numbers[:, 0], "x+": node_numbers[:, -1], "y-": node_numbers[0], "y+": node_numbers[-1]}
    mesh = Mesh(points, quads, "quad", node_sets={key: np.unique(nodes) for key, nodes in edges.items()}, name=name)
    return mesh if map is None else check(mesh)


def _join_edges(points: Floats, node_numbers: Ints) -> tuple[Floats, Ints]:
    """Points, and node numbers (ny + 1, nx + 1) of the lattice, with coincident opposite edges joined."""
    tolerance = COINCIDENCE_TOL * np.linalg.norm(np.ptp(points, axis=0))
    node_numbers = node_numbers.copy()
    for edge, other in ((node_numbers[:, -1], node_numbers[:, 0]), (node_numbers[-1], node_numbers[0])):
        if np.linalg.norm(points[edge] - points[other], axis=1).max() <= tolerance:
            edge[:] = other
    kept, numbers = np.unique(node_numbers, return_inverse=True)
    return points[kept], numbers.reshape(node_numbers.shape)
