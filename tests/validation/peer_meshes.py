"""The unstructured meshes of `warpfea bench --peer`, tests/data/bar_*.npz: counts, and files where `folder` is set.

A box of 3 x 2 x 1 m in tetrahedra of second order with straight edges, by Gmsh (4.15.2 for the committed files; not one
of the project's requirements). The peer's meshes are not published; their counts (4567 elements, 9050 nodes; 20 829 and
39 442) are those of a fine surface around a coarse inside, so the triangles of the surface are made first, of one size,
and the inside, optimised by Netgen, may be coarser. Sizes are those that come closest in elements and nodes together.

points  (nodes, 3) float32, m: corners on multiples of 2^-20, so that the middles of edges are exact too
cells   (elements, 10) int32: in the order of mesh.Mesh
"""

from __future__ import annotations

import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from warpfea.base.errors import UsageError
from warpfea.base.writer import check_folder

from .table import Row, Run, Table

__all__ = ["TABLE", "second_order", "tetrahedra"]

SIZES = {"bar_4752": (0.14476, 3.0), "bar_20822": (0.0678, 0.39)}
"""Name of the file: size of the surface's triangles and largest size inside, m."""
EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))


def tetrahedra(gmsh: Any, surface: float, inside: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners (n, 3), m, and cells (elements, 4) of the box, by the module `gmsh`; largest sizes in m."""
    option = gmsh.option.setNumber
    gmsh.clear()
    gmsh.model.occ.addBox(0, 0, 0, 3, 2, 1)
    gmsh.model.occ.synchronize()
    option("Mesh.MeshSizeMax", surface)
    option("Mesh.MeshSizeExtendFromBoundary", 0)
    option("Mesh.Optimize", 1)
    option("Mesh.OptimizeNetgen", 1)
    gmsh.model.mesh.generate(2)
    option("Mesh.MeshSizeMax", inside)
    gmsh.model.mesh.generate(3)
    tags, flat, _ = gmsh.model.mesh.getNodes()
    _, cells = gmsh.model.mesh.getElementsByType(gmsh.model.mesh.getElementType("tetrahedron", 1))
    used, numbers = np.unique(cells, return_inverse=True)
    place = np.zeros(int(tags.max()) + 1, dtype=int)
    place[tags] = np.arange(len(tags))
    return flat.reshape(-1, 3)[place[used]], numbers.reshape(-1, 4)


def second_order(corners: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and cells (elements, 10) with a node in the middle of each edge."""
    corners = np.round(corners * 2.0**20) / 2.0**20
    pairs = np.sort(cells[:, EDGES].reshape(-1, 2), axis=1)
    edges, numbers = np.unique(pairs, axis=0, return_inverse=True)
    points = np.concatenate([corners, corners[edges].mean(axis=1)])
    return points, np.concatenate([cells, len(corners) + numbers.reshape(-1, len(EDGES))], axis=1)


def rows(run: Run) -> Iterator[Row]:
    """Elements and nodes of each mesh."""
    try:
        import gmsh
    except ImportError as error:
        raise UsageError(f"peer_meshes makes its meshes with Gmsh: pip install gmsh ({error})") from error
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    for name, sizes in SIZES.items():
        points, cells = second_order(*tetrahedra(gmsh, *sizes))
        stored = points.astype(np.float32)
        assert np.array_equal(stored, points)
        if run.options["folder"]:
            folder = pathlib.Path(run.options["folder"])
            check_folder(folder, folder)
            np.savez_compressed(folder / f"{name}.npz", points=stored, cells=cells.astype(np.int32))
        yield {"mesh": name, "elements": len(cells), "nodes": len(points)}
    gmsh.finalize()


TABLE = Table(about=__doc__, parts={"rows": rows}, options={"folder": ""}, takes="seconds")
