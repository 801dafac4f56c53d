"""Tetrahedra inside a closed surface, by fTetWild (extra "mesh")."""

import contextlib
import importlib.util
import os
import sys
import tempfile
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import MeshError
from .adapter import read_triangles
from .arguments import positive_numbers
from .cells import TET_EDGES
from .checks import check
from .mesh import Mesh

__all__ = ["from_surface", "surface_arrays", "with_flat_sides", "with_mid_nodes"]

MAX_VOLUME_CHANGE = 0.02
"""Largest relative difference of the volumes of mesh and surface. A bound: the default tolerance is 1 % of the volume
of a cube, a part that the mesher loses is more."""


def from_surface(
    surface: Any, *, size: float, element: str = "T10", scale: float = 1.0, tolerance: float = 1e-3, name: str = ""
) -> Mesh:
    """Mesh of the inside of a closed surface. Flat sides on its bounding box are the sets "x-", "x+", ... "z+".

    Parameters
    ----------
    surface : STL, OBJ or PLY file, or (points (n, 3), triangles (m, 3)) with normals outward
    size : length of the edges, m
    element : "T4", or "T10" with straight edges
    scale : metres per unit of the file
    tolerance : largest distance of the mesh from the surface, over the diagonal of its box

    Raises
    ------
    MeshError
        Without the extra "mesh"; an unreadable or open surface; a mesh whose volume differs by more than 2 % from that
        of the surface.
    """
    label = str(surface) if isinstance(surface, (str, os.PathLike)) else "from_surface"
    points, triangles = surface_arrays(surface, "from_surface")
    points = scale * points
    (length,) = positive_numbers(f"{label}: size", (size,), 1)
    if element not in ("T4", "T10"):
        raise MeshError(f"{label}: element = {element!r} must be 'T4' or 'T10'")
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    if length > diagonal:
        raise MeshError(f"{label}: size = {length:g} m is more than the whole surface, {diagonal:.3g} m, has")
    x = points[triangles]
    wanted = float(np.linalg.det(x - x.mean(axis=(0, 1))).sum()) / 6.0
    vector = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    if not np.linalg.norm(vector.sum(axis=0)) < 1e-3 * np.linalg.norm(vector, axis=1).sum():
        raise MeshError(f"{label}: the surface is open: a mesh of its inside needs a closed one")
    if not wanted > 0.0:
        raise MeshError(f"{label}: the surface encloses {wanted:.3g} m^3: its triangles must turn outward")
    pytetwild = _mesher(label)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # the mesher leaves a file there
        nodes, cells = pytetwild.tetrahedralize(
            points / diagonal, triangles.astype(np.int32), edge_length_abs=length / diagonal, epsilon=tolerance,
            vtk_ordering=True,
        )  # fmt: skip
    mesh = Mesh(diagonal * np.asarray(nodes), np.asarray(cells), "tetra", name=name or _stem(surface))
    found = mesh.volume()
    if abs(found - wanted) > MAX_VOLUME_CHANGE * wanted:
        raise MeshError(
            f"{label}: the mesh has {found:.4g} m^3, the surface encloses {wanted:.4g}: it has holes, crosses itself, "
            f"or is thinner than tolerance = {tolerance:g} of its size"
        )
    mesh = with_flat_sides(mesh, tolerance * diagonal)
    return check(with_mid_nodes(mesh) if element == "T10" else mesh)


def _mesher(label: str) -> Any:
    """pytetwild. It imports pyvista, 600 MB with VTK, for a method of its own meshes: an empty module does instead."""
    stands_in = "pyvista" not in sys.modules and importlib.util.find_spec("pyvista") is None
    try:
        if stands_in:
            sys.modules["pyvista"] = types.ModuleType("pyvista")
        return importlib.import_module("pytetwild")
    except ImportError as error:
        raise MeshError(
            f"{label}: a mesh of the inside of a surface needs pytetwild: pip install 'warpfea[mesh]' ({error})"
        ) from error
    finally:
        if stands_in:
            del sys.modules["pyvista"]


def surface_arrays(surface: Any, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and triangles (m, 3) of a file or a pair of them. MeshError for anything else."""
    if isinstance(surface, (str, os.PathLike)):
        points, triangles = read_triangles(surface)
        if not np.isfinite(points).all():
            raise MeshError(f"{surface}: has points that are not finite")
        return points, triangles
    try:
        points, triangles = (np.asarray(part) for part in surface)
        good = points.shape[1:] == triangles.shape[1:] == (3,) and triangles.dtype.kind in "iu" and len(triangles)
        if good and triangles.min() >= 0 and triangles.max() < len(points) and np.isfinite(points).all():
            return points.astype(float), triangles
        got = f"shapes {points.shape} and {triangles.shape}{', not all finite' if good else ''}"
    except (TypeError, ValueError):
        got = repr(surface)
    raise MeshError(f"{what}: a surface is a file, or points (n, 3) and triangles (m, 3) of their numbers, got {got}")


def with_flat_sides(mesh: Mesh, distance: float) -> Mesh:
    """Surface and node sets "x-", ... "z+" of the faces on the sides of the bounding box, of those that have any."""
    low, high = mesh.bounding_box()
    faces = mesh.boundary()
    nodes = mesh.faces(faces)
    surfaces = {}
    for axis, name in enumerate("xyz"):
        for end, sign in ((low, "-"), (high, "+")):
            own = (np.abs(mesh.points[nodes, axis] - end[axis]) <= 2.0 * distance).all(axis=1)
            if own.any():
                surfaces[name + sign] = faces[own]
    sets = {name: np.unique(mesh.faces(rows)) for name, rows in surfaces.items()}
    return replace(mesh, surface_sets=surfaces, node_sets=sets)


def _stem(surface: Any) -> str:
    return Path(surface).stem if isinstance(surface, (str, os.PathLike)) else "surface"


def with_mid_nodes(mesh: Mesh) -> Mesh:
    """T4 mesh as T10 with straight edges; node sets gain the nodes between two of theirs."""
    pairs = np.sort(mesh.cells[:, TET_EDGES].reshape(-1, 2), axis=1)
    edges, number = np.unique(pairs, axis=0, return_inverse=True)
    first = len(mesh.points)
    points = np.concatenate([mesh.points, mesh.points[edges].mean(axis=1)])
    cells = np.hstack([mesh.cells, first + number.reshape(-1, 6)])
    sets = {
        key: np.concatenate([nodes, first + np.flatnonzero(np.isin(edges, nodes).all(axis=1))])
        for key, nodes in mesh.node_sets.items()
    }
    return replace(mesh, points=points, cells=cells, cell_type="tetra10", node_sets=sets)
