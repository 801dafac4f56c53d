"""Reading of mesh files by meshio, by which `outputs` writes VTU files, too; its fork was measured (MESHES.md).

Workarounds for defects of meshio 5.3.5. Gmsh: sets are built from the tags, keyed by (dimension, tag),
because its `cell_sets` are empty for MSH 2.2, lack unnamed groups, keep one of two groups that share a name,
and 4.1 files with ungrouped entities fail; `$PhysicalNames` and `$Entities` are parsed here and meshio reads
nodes and elements. Missing end markers (a truncated file) are only a warning there. VTU: cell types it skips
and files of several pieces, of which it keeps the last, are refused. Its printing and `sys.exit` on errors
become :class:`MeshError`. Abaqus files are read by :mod:`warpfea.mesh.abaqus`: meshio loses all but the last
*NODE block and attaches sets to the wrong *ELEMENT block.
"""

import contextlib
import io
import os
import re
import struct
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import MeshError
from ..base.lazy import meshio
from . import abaqus
from .assemble import RawMesh, assemble_mesh
from .cells import FILE_CELLS, cell_dimension
from .checks import check
from .mesh import Mesh, transformation
from .split import corners_only, split_cells

__all__ = ["FORMATS", "from_meshio", "is_meshio", "read", "read_triangles"]

FORMATS = {".msh": "Gmsh 2.2 and 4.1", ".vtu": "VTK", ".inp": "Abaqus"}
"""Supported mesh files."""


def read(
    path: str | os.PathLike[str], scale: float = 1.0, transform: Any = None, cell_type: str | None = None,
    corners: bool = False,
) -> Mesh:  # fmt: skip
    """Read and check a mesh of tetrahedra, hexahedra or quads.

    The cells of the highest dimension are the body. Next to solids, surface cells are boundary faces; a file with
    no solids but quads only is a surface in space, for shells.

    Parameters
    ----------
    path : Gmsh .msh (2.2, 4.1; ASCII, binary), VTK .vtu or Abaqus .inp
    scale : metres per unit of the file
    transform : 4x4 matrix or (3x3, 3): X' = A (scale X) + t, in metres; no reflection
    cell_type : "tetra", "tetra10", "hexahedron" or "quad" required cell type
    corners : read cells of higher order (hexahedron20, hexahedron27, quad8, quad9, tetra10, ...) by their corners

    Prisms and pyramids become tetrahedra that match at shared faces, and hexahedra beside them, too.

    Sets
    ----
    Gmsh: a physical group of the body's cells becomes an element and a node set, of faces of solids a surface
    and a node set, lower ones (edges and points of a shell too) a node set; unnamed groups are called
    "physical_<dim>_<tag>". Abaqus: *NSET, *ELSET, and *SURFACE of type ELEMENT, labels S1 .. S4 of tetrahedra,
    S1 .. S6 of hexahedra, E1 .. E4 (edges) of shells. VTU: an integer cell or point array with values 0 and 1
    only is the set of its ones under its own name; another one gives a set "<name>_<value>" per positive value
    ("physical_<dim>_<value>" for "gmsh:physical"); float arrays, vectors, and arrays with more than 256
    values are left out. A boundary cell has to be the face of a solid cell; one between two belongs to the one
    out of which the boundary cell's own normal points.

    Raises
    ------
    MeshError
        A missing or unreadable file, solids of other types or of two types, or no solids and
        surface cells other than quads, or a failed check of :func:`warpfea.mesh.check`.

    Warns
    -----
    MeshWarning
        Unused nodes; they keep their numbers.
    """
    file = Path(path)
    label = str(file)
    affine = _check_arguments(label, scale, transform, cell_type)
    if not file.exists():
        raise MeshError(f"{label}: no such mesh file")
    suffix = file.suffix.lower()
    if suffix not in FORMATS or not file.is_file():
        raise MeshError(
            f"{label}: unknown mesh format {suffix!r}, known are {', '.join(FORMATS)}; wf.mesh.from_surface "
            "meshes STL, OBJ and PLY, wf.mesh.from_cad STEP, IGES, BREP and .geo"
        )
    readers = {".msh": _read_gmsh, ".vtu": _read_vtu, ".inp": abaqus.read_inp}
    with meshio_errors(label):
        raw = readers[suffix](file)
        raw = split_cells(corners_only(raw) if corners else raw)
    return check(assemble_mesh(raw, file, cell_type).transformed(transform=affine))


def _check_arguments(label: str, scale: float, transform: Any, cell_type: str | None) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and translation of the arguments of :func:`read`. MeshError."""
    affine = transformation(scale, transform, label)
    if cell_type is not None and cell_type not in FILE_CELLS:
        raise MeshError(f"{label}: unknown cell_type {cell_type!r}, known are {sorted(FILE_CELLS)}")
    return affine


def read_triangles(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and triangles (m, 3) of any file that meshio reads; quads are split in two, other cells ignored.

    Raises
    ------
    MeshError
        A missing or unreadable file, or no triangles.
    """
    file = Path(path)
    if not file.is_file():
        raise MeshError(f"{file}: no such mesh file")
    with meshio_errors(str(file)):
        mesh = meshio.read(file)
    halves = {"triangle": ([0, 1, 2],), "quad": ([0, 1, 2], [0, 2, 3])}
    parts = [block.data[:, half] for block in mesh.cells for half in halves.get(block.type, ())]
    if not sum(map(len, parts)):
        found = ", ".join(sorted({block.type for block in mesh.cells}))
        raise MeshError(f"{file}: has no triangles{', but ' if found else ''}{found}")
    points = np.asarray(mesh.points, dtype=float)
    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    return points, np.concatenate(parts).astype(np.int64)


def is_meshio(mesh: Any) -> bool:
    """True for a meshio.Mesh, or one of its fork meshlane; neither is imported."""
    kind = type(mesh)
    return kind.__name__ == "Mesh" and kind.__module__.partition(".")[0] in ("meshio", "meshlane")


def from_meshio(
    mesh: Any, scale: float = 1.0, transform: Any = None, cell_type: str | None = None, corners: bool = False
) -> Mesh:
    """The mesh of a meshio.Mesh, checked; arguments as of :func:`read`.

    Sets
    ----
    Its `cell_sets` and `point_sets`; Gmsh's physical groups by their names in `field_data`; other integer cell and
    point arrays as of a VTU file. Groups dropped by meshio are missing: :func:`read` reads the file itself.

    Raises
    ------
    MeshError
        Not a meshio.Mesh, or as :func:`read`.
    """
    label = "meshio.Mesh"
    if not is_meshio(mesh):
        raise MeshError(f"from_meshio: expected a meshio.Mesh, got {type(mesh).__module__}.{type(mesh).__qualname__}")
    affine = _check_arguments(label, scale, transform, cell_type)
    raw = _raw_mesh(mesh)
    raw.duplicates = "gmsh:physical" in mesh.cell_data  # MSH 2.2 repeats cells of two groups
    for name, arrays in mesh.cell_sets.items():
        if not name.startswith("gmsh:"):
            for k, numbers in enumerate(arrays):
                if numbers is not None and len(numbers):
                    raw.groups.append((str(name), k, np.asarray(numbers, dtype=np.int64)))
    for name, nodes in mesh.point_sets.items():
        raw.node_groups[str(name)] = np.unique(np.asarray(nodes, dtype=np.int64))
    found = assemble_mesh(split_cells(corners_only(raw) if corners else raw), Path(label), cell_type)
    return check(replace(found.transformed(transform=affine), name="mesh", path=None))


@contextlib.contextmanager
def meshio_errors(label: str) -> Iterator[io.StringIO]:
    """Suppress printing, warnings and exits of meshio; its errors become a MeshError naming the file."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield said
    except MeshError as error:
        raise error if str(error).startswith(label) else MeshError(f"{label}: {error}") from None
    except OSError as error:
        raise MeshError(f"{label}: can't be read: {error}") from error
    except ImportError:
        raise
    except (Exception, SystemExit) as error:
        told = str(error) and not isinstance(error, SystemExit)
        reason = " ".join(said.getvalue().split()) or (f"{type(error).__name__}: {error}" if told else "bad content")
        raise MeshError(f"{label}: can't be read, the file is damaged or of another format ({reason})") from error


# Gmsh


def _read_gmsh(file: Path) -> RawMesh:
    data = file.read_bytes()
    before = rb"\s*(?:\$Comments.*?\$EndComments\s*)?"
    header = re.match(before + rb"\$MeshFormat\s+([\d.]+)\s+([01])\s+(\d+)", data, re.DOTALL)
    if header is None:
        raise MeshError("not a Gmsh file: it does not begin with $MeshFormat")
    version, is_ascii, size = header[1].decode(), header[2] == b"0", int(header[3])
    new = version in ("4", "4.1")
    if not new and not version.startswith("2"):
        raise MeshError(f"Gmsh format {version} is not supported: save as 4.1 or 2.2")
    if b"$PartitionedEntities" in data:
        raise MeshError("partitioned Gmsh meshes are not supported: save without partitions")
    start = data.find(b"$Nodes")
    for section in (b"Nodes", b"Elements"):
        if data.find(b"$" + section) < 0 or data.find(b"$End" + section, start) < 0:
            raise MeshError(f"damaged or truncated: section ${section.decode()} is missing or not closed")
    names = _gmsh_section(data[:start], b"PhysicalNames")
    entities = _gmsh_section(data[:start], b"Entities")
    named = {
        (int(d), abs(int(t))): name.decode(errors="replace")
        for d, t, name in re.findall(rb'^\s*(\d)\s+(-?\d+)\s+"(.*)"', names, re.MULTILINE)
    }
    mesh = _read_gmsh_cells(file, start, new, is_ascii, size)
    physical = mesh.cell_data.get("gmsh:physical")
    entity = mesh.cell_data.get("gmsh:geometrical")
    tags_of = _entity_groups(entities, is_ascii, size) if new and entities else {}
    raw = RawMesh(mesh.points, [(c.type, np.asarray(c.data, dtype=np.int64)) for c in mesh.cells], duplicates=not new)
    for k, (kind, cells) in enumerate(raw.blocks):
        dim, every = cell_dimension(kind), np.arange(len(cells))
        if new:
            known = () if entity is None or not len(cells) else tags_of.get((dim, entity[k][0]), ())
            of_group = dict.fromkeys(known, every)
        else:
            tags = np.zeros(0) if physical is None else np.abs(physical[k])
            if len(tags) not in (0, len(cells)):
                raise MeshError(f"{len(tags)} physical tags for {len(cells)} cells of type {kind}")
            of_group = {int(t): np.flatnonzero(tags == t) for t in np.unique(tags) if t}
        for tag, numbers in of_group.items():
            raw.groups.append((named.get((dim, tag), f"physical_{dim}_{tag}"), k, numbers))
    return raw


def _read_gmsh_cells(file: Path, start: int, new: bool, is_ascii: bool, size: int) -> Any:
    """meshio's mesh of a Gmsh file of format 4.1, or 2.2 unless `new`, read from the byte `start` on."""
    with open(file, "rb") as stream:
        stream.seek(start)
        try:
            return (meshio.gmsh._gmsh41 if new else meshio.gmsh._gmsh22).read_buffer(stream, is_ascii, size)
        except IndexError as error:
            number = re.search(r"index (\d+) is out of bounds for axis 0 with size", str(error))
            if number is None:
                raise
            raise MeshError(f"an element refers to node {int(number[1]) + 1}, which $Nodes does not define") from None
        except KeyError as error:
            raise MeshError(f"unknown Gmsh element type {error}") from None


def _gmsh_section(data: bytes, name: bytes) -> bytes:
    """Body of a section, or b""."""
    at = data.find(b"$" + name)
    if at < 0:
        return b""
    end = data.find(b"$End" + name, at)
    if end < 0:
        raise MeshError(f"damaged or truncated: section ${name.decode()} is not closed")
    return data[data.index(b"\n", at) + 1 : end]


def _entity_groups(body: bytes, is_ascii: bool, size: int) -> dict[tuple[int, int], list[int]]:
    """(dimension, entity) -> physical tags, from the $Entities section of MSH 4.1."""
    words = iter(body.split()) if is_ascii else iter(())
    at = 0

    def take_values(code: str, count: int) -> list[float]:
        nonlocal at
        if is_ascii:
            return [float(next(words)) for _ in range(count)]
        values = struct.unpack_from(f"={count}{code}", body, at)
        at += struct.calcsize(f"={count}{code}")
        return list(values)

    unsigned = {4: "I", 8: "Q"}[size]
    groups: dict[tuple[int, int], list[int]] = {}
    try:
        for dim, count in enumerate(take_values(unsigned, 4)):
            for _ in range(int(count)):
                tag = int(take_values("i", 1)[0])
                take_values("d", 3 if dim == 0 else 6)
                groups[dim, tag] = [abs(int(t)) for t in take_values("i", int(take_values(unsigned, 1)[0]))]
                if dim:
                    take_values("i", int(take_values(unsigned, 1)[0]))
    except (StopIteration, struct.error):
        raise MeshError("damaged or truncated: section $Entities ends early") from None
    return groups


# VTU


def _read_vtu(file: Path) -> RawMesh:
    if file.read_bytes().count(b"<Piece") > 1:
        raise MeshError("a VTU file of several pieces is not supported: merge them")
    with meshio_errors(str(file)) as said:
        mesh = meshio.read(file, file_format="vtu")
    skipped = re.search(r"cannot handle \(type (\d+)\)", " ".join(said.getvalue().split()))
    if skipped:
        raise MeshError(f"unknown VTK cell type {skipped[1]}")
    return _raw_mesh(mesh)


def _raw_mesh(mesh: Any) -> RawMesh:
    """Points, cells, and groups from integer arrays of a meshio.Mesh."""
    named = {}
    for name, value in (mesh.field_data or {}).items():
        if np.size(value) == 2:  # of Gmsh: tag and dimension
            named[int(value[1]), int(value[0])] = str(name)
    points = np.asarray(mesh.points, dtype=float)
    raw = RawMesh(points, [(c.type, np.asarray(c.data).astype(np.int64)) for c in mesh.cells])
    for name, arrays in mesh.cell_data.items():
        flat = [np.asarray(a).reshape(len(a), -1) for a in arrays]
        if all(a.shape[1] == 1 for a in flat) and name != "gmsh:geometrical":
            joined = np.concatenate([a[:, 0] for a in flat])
            for value, suffix in _values_of_sets(joined):
                for k, column in enumerate(flat):
                    numbers = np.flatnonzero(column[:, 0] == value)
                    if numbers.size:
                        dim = cell_dimension(raw.blocks[k][0])
                        group = named.get((dim, value), f"physical_{dim}_{value}")
                        raw.groups.append((group if name == "gmsh:physical" else name + suffix, k, numbers))
    for name, array in (mesh.point_data or {}).items():
        column = np.asarray(array).reshape(len(points), -1)
        if column.shape[1] == 1:
            for value, suffix in _values_of_sets(column[:, 0]):
                raw.node_groups[name + suffix] = np.flatnonzero(column[:, 0] == value)
    return raw


def _values_of_sets(array: np.ndarray) -> list[tuple[int, str]]:
    """Positive values of an integer array with the suffix of their sets' names; none if too many."""
    if array.dtype.kind not in "iub" or not array.size:
        return []
    values = np.unique(array)
    if values[0] >= 0 and values[-1] <= 1:
        return [(1, "")] if values[-1] == 1 else []
    return [(int(v), f"_{v}") for v in values if v > 0] if len(values) <= 256 else []
