"""Meshes of quads and hexahedra, and files of them."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np

from warpfea.mesh import Mesh, box, grid


def _load(name):
    """Another file of this folder, which is no package."""
    spec = importlib.util.spec_from_file_location(f"_{name}", Path(__file__).parent / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


writers = _load("mesh_writers")
Parts, write, FORMATS = writers.Parts, writers.write, writers.FORMATS
# the writers' own tables know tetrahedra; this is a copy of that module
writers.GMSH.update(quad=3, quad8=16, vertex=15)
writers.VTK.update(quad=9, quad8=23, vertex=1)
writers.ABAQUS.update(quad="S4R", quad8="S8R", hexahedron="C3D8R")
writers.DIMENSION.update(quad=2, quad8=2, vertex=0)


def plate() -> Mesh:
    """2 x 2 quads, nodes 0 .. 8 with x fastest, quads 0143, 1254, 3476, 4587."""
    return grid((2.0, 1.0), cells=(2, 2), origin=(0.1, -0.7, 1 / 3))


def shell_parts() -> Parts:
    m = plate()
    return Parts(
        m.points,
        [
            ("quad", m.cells[2:3], "top"),
            ("line", [[0, 3], [3, 6]], "left"),
            ("quad", m.cells[:2], "bottom"),
            ("quad", m.cells[3:], "top"),
        ],
    )


def brick() -> Mesh:
    """2 x 1 x 1 hexahedra, nodes 0 .. 11 with x fastest."""
    return box((2.0, 1.0, 3.0), cells=(2, 1, 1), element="H3843", name="brick")


def area_vectors(mesh: Mesh, surface) -> np.ndarray:
    """Outward area vectors (m^2) of the faces of hexahedra."""
    x = mesh.points[mesh.faces(surface)]
    return 0.5 * np.cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 1])


Q = plate().cells
