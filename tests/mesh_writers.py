"""Small mesh-file writers for the tests, independent of meshio."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from warpfea.mesh import Mesh

GMSH = {"line": 1, "triangle": 2, "tetra": 4, "hexahedron": 5, "wedge": 6, "pyramid": 7, "triangle6": 9, "tetra10": 11}
VTK = {
    "line": 3,
    "triangle": 5,
    "tetra": 10,
    "hexahedron": 12,
    "wedge": 13,
    "pyramid": 14,
    "triangle6": 22,
    "tetra10": 24,
}
ABAQUS = {
    "line": "T3D2",
    "triangle": "S3",
    "tetra": "C3D4",
    "hexahedron": "C3D8",
    "wedge": "C3D6",
    "pyramid": "C3D5",
    "triangle6": "STRI65",
    "tetra10": "C3D10",
}
DIMENSION = {"line": 1, "triangle": 2, "triangle6": 2}
FORMATS = ("msh22", "msh22b", "msh41", "msh41b", "vtu", "inp")
SUFFIX = {f: ".msh" if f.startswith("msh") else "." + f for f in FORMATS}


class Parts:
    """Points, and cell blocks (type, nodes, group name or None)."""

    def __init__(self, points, blocks):
        self.points = np.array(points, dtype=float)
        self.blocks = [(kind, np.array(cells), name) for kind, cells, name in blocks]

    @classmethod
    def of(cls, mesh: Mesh, body: str | None = "body"):
        """The mesh as one block, and one block of triangles per surface set."""
        faces = "triangle6" if mesh.cell_type == "tetra10" else "triangle"
        surfaces = [(faces, mesh.faces(name), name) for name in mesh.surface_sets]
        return cls(mesh.points, [(mesh.cell_type, mesh.cells, body), *surfaces])

    def groups(self):
        """{(dimension, tag): name}; tags start again in each dimension."""
        out: dict[tuple[int, int], str] = {}
        for kind, _, name in self.blocks:
            dim = DIMENSION.get(kind, 3)
            if name is not None and name not in [n for (d, _), n in out.items() if d == dim]:
                out[dim, 1 + sum(d == dim for d, _ in out)] = name
        return out

    def tag(self, k):
        kind, _, name = self.blocks[k]
        dim = DIMENSION.get(kind, 3)
        return next((t for (d, t), n in self.groups().items() if d == dim and n == name), 0)

    def gmsh_cells(self, k):
        kind, cells, _ = self.blocks[k]
        return cells[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]] if kind == "tetra10" else cells


def write(parts: Parts, path: Path, form: str) -> Path:
    path = path.with_suffix(SUFFIX[form])
    writer = _msh22 if "22" in form else _msh41 if "41" in form else _vtu if form == "vtu" else _inp
    path.write_bytes(writer(parts, form))
    return path


def _names(parts):
    rows = "".join(f'{d} {t} "{n}"\n' for (d, t), n in parts.groups().items())
    return f"$PhysicalNames\n{len(parts.groups())}\n{rows}$EndPhysicalNames\n".encode()


def _head(version, binary):
    one = struct.pack("=i", 1) + b"\n" if binary else b""
    return f"$MeshFormat\n{version} {int(binary)} 8\n".encode() + one + b"$EndMeshFormat\n"


def _msh22(parts, form):
    binary = form.endswith("b")
    out = _head("2.2", binary) + _names(parts) + f"$Nodes\n{len(parts.points)}\n".encode()
    for i, x in enumerate(parts.points.tolist(), 1):
        out += struct.pack("=i3d", i, *x) if binary else f"{i} {x[0]!r} {x[1]!r} {x[2]!r}\n".encode()
    out += b"$EndNodes\n$Elements\n%d\n" % sum(len(c) for _, c, _ in parts.blocks)
    number = 0
    for k, (kind, cells, _) in enumerate(parts.blocks):
        if binary:
            out += struct.pack("=3i", GMSH[kind], len(cells), 2)
        for row in parts.gmsh_cells(k):
            number += 1
            values = [number, parts.tag(k), k + 1, *(row + 1)]
            if binary:
                out += struct.pack(f"={len(values)}i", *values)
            else:
                values[1:1] = [GMSH[kind], 2]
                out += (" ".join(map(str, values)) + "\n").encode()
    return out + b"$EndElements\n"


def _msh41(parts, form):
    binary = form.endswith("b")

    def put(code, *values):
        if binary:
            return struct.pack("=" + code, *values)
        return (" ".join(repr(float(v)) if c == "d" else str(int(v)) for c, v in zip(code, values)) + "\n").encode()

    dims = [DIMENSION.get(kind, 3) for kind, _, _ in parts.blocks]
    body = [k for k, d in enumerate(dims) if d == 3]
    out = _head("4.1", binary) + _names(parts) + b"$Entities\n" + put("QQQQ", *(dims.count(d) for d in range(4)))
    for d in range(1, 4):
        for k in [k for k, dim in enumerate(dims) if dim == d]:
            physical = [parts.tag(k)] if parts.tag(k) else []
            out += put(
                "i" + 6 * "d" + "Q" + len(physical) * "i" + "Q", k + 1, *(6 * [0.0]), len(physical), *physical, 0
            )
    n, total = len(parts.points), sum(len(c) for _, c, _ in parts.blocks)
    out += b"$EndEntities\n$Nodes\n" + put("QQQQ", 1, n, 1, n) + put("iiiQ", 3, (body or [0])[0] + 1, 0, n)
    out += b"".join(put("Q", i) for i in range(1, n + 1)) + b"".join(put("ddd", *x) for x in parts.points)
    out += b"$EndNodes\n$Elements\n" + put("QQQQ", len(parts.blocks), total, 1, total)
    number = 0
    for k, (kind, cells, _) in enumerate(parts.blocks):
        out += put("iiiQ", dims[k], k + 1, GMSH[kind], len(cells))
        for row in parts.gmsh_cells(k):
            number += 1
            out += put("Q" * (len(row) + 1), number, *(row + 1))
    return out + b"$EndElements\n"


def _vtu(parts, form):
    cells = [row for _, block, _ in parts.blocks for row in block]
    types = [VTK[kind] for kind, block, _ in parts.blocks for _ in block]

    def array(name, kind, values, components=1):
        extra = f' NumberOfComponents="{components}"' if components > 1 else ""
        text = " ".join(map(str, values))
        return f'<DataArray type="{kind}" Name="{name}"{extra} format="ascii">{text}</DataArray>'

    marks = ""
    for name in dict.fromkeys(n for _, _, n in parts.blocks if n is not None):
        marks += array(name, "Int32", [int(n == name) for _, block, n in parts.blocks for _ in block])
    return (
        '<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian"><UnstructuredGrid>'
        f'<Piece NumberOfPoints="{len(parts.points)}" NumberOfCells="{len(cells)}"><Points>'
        + array("Points", "Float64", parts.points.ravel(), 3)
        + "</Points><Cells>"
        + array("connectivity", "Int64", [n for row in cells for n in row])
        + array("offsets", "Int64", np.cumsum([len(row) for row in cells]))
        + array("types", "UInt8", types)
        + f"</Cells><CellData>{marks}</CellData></Piece></UnstructuredGrid></VTKFile>"
    ).encode()


def _inp(parts, form):
    lines = ["*HEADING", "a test", "** comment", "*NODE"]
    lines += [f"{i}, {x[0]}, {x[1]}, {x[2]}" for i, x in enumerate(parts.points, 1)]
    number = 0
    for kind, block, name in parts.blocks:
        lines.append(f"*ELEMENT, TYPE={ABAQUS[kind]}" + (f", ELSET={name}" if name else ""))
        for row in block:
            number += 1
            values = [number, *(row + 1)]
            lines += (
                [", ".join(map(str, values[:8])) + ",", ", ".join(map(str, values[8:]))]
                if len(values) > 8
                else [", ".join(map(str, values))]
            )
    return "\n".join([*lines, ""]).encode()
