"""Meshes of CAD files by Gmsh (extra "cad")."""

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..base.errors import MeshError
from .adapter import read
from .arguments import positive_numbers
from .mesh import Mesh
from .surface import with_flat_sides

__all__ = ["CAD_FORMATS", "from_cad"]

CAD_FORMATS = {".step": "STEP", ".stp": "STEP", ".iges": "IGES", ".igs": "IGES", ".brep": "BREP", ".geo": "Gmsh"}
"""Supported files of shapes."""
ELEMENTS = {"T4": (3, 1), "T10": (3, 2), "quad": (2, 1)}
"""Dimension and order of what Gmsh meshes."""
SIDE_TOL = 1e-9
"""Distance of nodes from a flat side over the size of a part."""


def from_cad(
    path: str | os.PathLike[str], *, size: float | None = None, element: str = "T10", scale: float = 1.0, name: str = ""
) -> Mesh:
    """Mesh of a CAD file: solids by tetrahedra, or surfaces by quads for shells.

    Sets are the physical groups of a .geo file. Other files: "solid_1", ... and "face_1", ... in Gmsh's numbers, and
    "x-", ... "z+", flat sides on the bounding box. Solids that touch share their nodes.

    Parameters
    ----------
    path : STEP, IGES, BREP or Gmsh .geo file. STEP and IGES tell their unit, others count in metres over `scale`.
    size : largest length of the edges, m; a .geo file may have its own
    element : "T4", "T10" with the nodes on curved surfaces, or "quad"
    scale : further factor on the lengths of the file

    Raises
    ------
    MeshError
        Without the extra "cad"; a file that Gmsh cannot read or mesh, or IGES faces that enclose no solid; elements
        that fail :func:`warpfea.mesh.check`.
    """
    file = Path(path)
    if not file.is_file():
        raise MeshError(f"{file}: no such file")
    suffix = file.suffix.lower()
    if suffix not in CAD_FORMATS:
        raise MeshError(f"{file}: unknown format {suffix!r} of shapes, known are {', '.join(CAD_FORMATS)}")
    if element not in ELEMENTS:
        raise MeshError(f"{file}: element = {element!r} must be one of {', '.join(map(repr, ELEMENTS))}")
    if size is None and suffix != ".geo":
        raise MeshError(f"{file}: give size=, the length of the edges in m, such as 2e-3 (--size 2e-3)")
    quads = element == "quad"
    options: dict[str, float] = {"Mesh.ElementOrder": ELEMENTS[element][1], "Mesh.HighOrderOptimize": 2}
    if size is not None:
        edge, unit = positive_numbers(f"{file}: size, scale", (size, scale), 2)
        options["Mesh.MeshSizeMax"] = edge / unit * (2.0 if quads else 1.0)
    if quads:  # the triangles left are cut in three, and quads in four
        options |= {"Mesh.RecombineAll": 1, "Mesh.Algorithm": 8, "Mesh.SubdivisionAlgorithm": 1}
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / f"{file.stem}.msh"
        grouped = _write_mesh(file, target, ELEMENTS[element][0], options)
        try:
            mesh = replace(read(target, scale=scale), name=name or file.stem, path=str(file))
        except MeshError as error:
            raise MeshError(str(error).replace(str(target), str(file))) from None
    if grouped or quads:
        return mesh
    flat = with_flat_sides(mesh, SIDE_TOL * max(mesh.bounding_box()[1] - mesh.bounding_box()[0]))
    return replace(flat, surface_sets=mesh.surface_sets | flat.surface_sets, node_sets=mesh.node_sets | flat.node_sets)


@contextlib.contextmanager
def _printing_to_stderr() -> Iterator[None]:
    """Send what compiled code prints to stderr: stdout may hold results."""
    sys.stdout.flush()
    own = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(own, 1)
        os.close(own)


def _write_mesh(file: Path, target: Path, dimension: int, options: dict[str, Any]) -> bool:
    """Mesh of a CAD file as .msh; True if the file has physical groups. MeshError."""
    try:
        import gmsh

        running = gmsh.isInitialized()
    except (ImportError, OSError, AttributeError) as error:  # a library of the system, or Gmsh's own, is missing
        raise MeshError(f"{file}: a mesh of a CAD file needs gmsh: pip install 'warpfea[cad]' ({error})") from error
    if running:
        raise MeshError(f"{file}: Gmsh is in use in this process; call gmsh.finalize() first")
    suffix = file.suffix.lower()
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setString("Geometry.OCCTargetUnit", "M")
        with _printing_to_stderr():
            gmsh.open(str(file))
        model = gmsh.model
        if dimension == 3 and suffix in (".iges", ".igs"):
            _sew(file, model)
        if len(model.getEntities(3)) > 1 and suffix != ".geo":
            model.occ.removeAllDuplicates()
            model.occ.synchronize()
        for key, value in options.items():
            gmsh.option.setNumber(key, value)
        if not model.getEntities(dimension):
            raise MeshError(f"{file}: holds no {'closed solids' if dimension == 3 else 'surfaces'}")
        grouped = bool(model.getPhysicalGroups())
        if not grouped:
            for kind, tag in model.getEntities(2) + (model.getEntities(3) if dimension == 3 else []):
                model.addPhysicalGroup(kind, [tag], name=f"{'solid' if kind == 3 else 'face'}_{tag}")
        model.mesh.generate(dimension)
        gmsh.write(str(target))
        return grouped
    except MeshError:
        raise
    except Exception as error:  # gmsh raises Exception
        raise MeshError(f"{file}: can't be meshed by Gmsh ({' '.join(str(error).split())})") from error
    finally:
        gmsh.finalize()


def _sew(file: Path, model: Any) -> None:
    """Make solids of the faces of an IGES file. MeshError for faces that enclose none, which a mesh would lose."""
    given = len(model.getEntities(2))
    model.occ.healShapes(sewFaces=True, makeSolids=True)
    model.occ.synchronize()
    used = sum(len(model.getAdjacencies(2, tag)[0]) > 0 for _, tag in model.getEntities(2))
    if used < given:
        raise MeshError(f"{file}: {given - used} of its {given} faces enclose no solid: export it as STEP")
