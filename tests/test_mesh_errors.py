"""Bad meshes: each defect in each format gives an error that names file, element or node, and value."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from mesh_writers import FORMATS, Parts, write

from warpfea.base.errors import MeshError, MeshWarning
from warpfea.mesh import Mesh, box, check, cylinder, read, sphere

# the defects: each takes the parts of a 6-element T10 box and returns a pattern for the message


def base() -> Parts:
    return Parts.of(box((1.0, 2.0, 3.0), cells=(1, 1, 1)))


def _swap(cells, rows):
    """Swap corners 0 and 1, and the mid-edge nodes that go with it."""
    cells[rows] = cells[rows][:, [1, 0, 2, 3, 4, 6, 5, 8, 7, 9]]


def inverted(p):
    _swap(p.blocks[0][1], [2])
    return r"element 2 is inverted: smallest det J0 = -6 m\^3"


def all_inverted(p):
    _swap(p.blocks[0][1], np.arange(6))
    return r"all 6 elements are inverted .*-6 m\^3.*left-handed"


def too_curved(p):
    e = p.blocks[0][1][0]
    p.points[e[4]] = 0.95 * p.points[e[0]] + 0.05 * p.points[e[1]]
    return r"element \d is inverted at a corner, mid-edge or quadrature point .*det J0 = -\d"


def zero_volume(p):
    linear = box((1.0, 2.0, 3.0), cells=(1, 1, 1), element="T4")
    points = np.vstack([linear.points, [[0.5, 0.5, 0.0]]])
    cells = np.vstack([linear.cells, [[0, 1, 2, 8]]])
    p.points, p.blocks = points, [("tetra", cells, "body")]
    return r"element 6 has zero volume \(0 m\^3, longest edge 2.24 m; 1 such element\)"


def mid_order(p):
    cells = p.blocks[0][1]
    cells[3, [5, 6]] = cells[3, [6, 5]]
    return r"element 3, mid-side nodes out of order: node \d+ stands for edge 12 .* edge 20, 0 m against"


def gmsh_order(p):
    cells = p.blocks[0][1]
    cells[:, [8, 9]] = cells[:, [9, 8]]
    return r"element 0, mid-side nodes out of order.*Gmsh's own order"


def coincident(p):
    p.points = np.vstack([p.points, p.points[13] + 1e-11])
    cells = p.blocks[0][1]
    cells[5][cells[5] == 13] = 27
    return r"nodes 13 and 27 coincide at \(0.5, 1, 1.5\), 1.73e-11 m apart \(1 such pair\)"


def nan(p):
    p.points[7, 2] = np.nan
    return r"node 7 has the coordinates \(0.5, 2, nan\)"


def infinite(p):
    p.points[4] = (np.inf, 0.0, 0.0)
    return r"node 4 has the coordinates \(inf, 0, 0\)"


def out_of_range(p):
    p.blocks[0][1][1, 6] = 998
    return r"refers to node 99[89], "


def repeated(p):
    e = p.blocks[0][1][4]
    e[5] = e[4]
    return rf"element 4 holds node {e[4]} twice"


def hexahedron(p):
    p.blocks.append(("hexahedron", np.array([[0, 2, 8, 6, 18, 20, 26, 24]]), None))
    return r"holds 6 tetra10, .*1 hexahedron; all solid cells must be of one type"


def wedge(p):
    p.blocks.append(("wedge", np.array([[0, 2, 6, 18, 20, 24], [2, 8, 6, 20, 26, 24]]), None))
    return r"unknown cell type 'wedge' \(2 cells\)"


def pyramid(p):
    p.blocks.append(("pyramid", np.array([[0, 2, 8, 6, 26]]), None))
    return r"unknown cell type 'pyramid' \(1 cells\)"


def mixed(p):
    p.blocks.append(("tetra", p.blocks[0][1][:2, :4], None))
    return r"holds 6 tetra10, .*2 tetra; all tetrahedra must be of one type"


def flat(p):
    p.blocks = p.blocks[1:2]
    return r"no tetrahedra, the file holds 2 triangle6: is this a 2D mesh"


def lines_only(p):
    p.blocks = [("line", np.array([[0, 1], [1, 2]]), None)]
    return r"no tetrahedra, the file holds 2 line$"


def lost_triangle(p):
    p.blocks[1][1][1, :3] = (2, 6, 26)
    return r"surface 'x-': triangle 1 with nodes \[2, 6, 26\] is not the face of a tetrahedron"


def lost_face_node(p):
    p.blocks[1] = ("line", np.array([[0, 500]]), "edge")
    return r"node:? 50[01]"


DEFECTS = [
    inverted, all_inverted, too_curved, zero_volume, mid_order, gmsh_order, coincident, nan, infinite,
    out_of_range, repeated, hexahedron, wedge, pyramid, mixed, flat, lines_only, lost_triangle,
    lost_face_node,
]  # fmt: skip


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("defect", DEFECTS, ids=lambda d: d.__name__)
def test_defect(defect, form, tmp_path, capfd):
    parts = base()
    pattern = defect(parts)
    path = write(parts, tmp_path / "bad", form)
    with pytest.raises(MeshError, match=pattern) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert capfd.readouterr() == ("", "")
    assert sorted(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("form", FORMATS)
def test_orphans_are_kept_and_warned_of(form, tmp_path):
    parts = base()
    parts.points = np.vstack([[[9.0, 9.0, 9.0]], parts.points, [[8.0, 8.0, 8.0]]])
    parts.blocks = [(kind, cells + 1, name) for kind, cells, name in parts.blocks]
    path = write(parts, tmp_path / "orphans", form)
    with pytest.warns(MeshWarning, match=r"orphans\.\w+: 2 orphan nodes .*\(first: 0, 28\)"):
        mesh = read(path)
    np.testing.assert_array_equal(mesh.orphan_nodes, [0, 28])
    np.testing.assert_array_equal(mesh.points, parts.points)
    assert len(mesh.used_nodes) == 27


@pytest.mark.parametrize("form", FORMATS)
def test_duplicate_elements(form, tmp_path):
    parts = base()
    parts.blocks.append(("tetra10", parts.blocks[0][1][2:3], "again"))
    path = write(parts, tmp_path / "twice", form)
    if "22" in form:  # there it means membership in two groups
        mesh = read(path)
        assert len(mesh.cells) == 6
        np.testing.assert_array_equal(mesh.elements("again"), [2])
        np.testing.assert_array_equal(mesh.elements("body"), np.arange(6))
    else:
        with pytest.raises(MeshError, match=r"twice\.\w+: elements 2 and 6 have the same corners"):
            read(path)


@pytest.mark.parametrize("form", FORMATS)
def test_truncated(form, tmp_path, capfd):
    path = write(base(), tmp_path / "cut", form)
    data = path.read_bytes()
    for part in (0.2, 0.6, 0.9):
        cut = int(part * len(data))
        if form == "inp":  # has no end marks: cut inside an element
            cut = data.rindex(b",", 0, data.index(b"STRI65") - 60) + 1
        path.write_bytes(data[:cut])
        with pytest.raises(MeshError, match=r"damaged|truncated") as caught:
            read(path)
        assert str(caught.value).startswith(f"{path}: ")
        assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "content", [b"", b"\x00\xff garbage \x80" * 40, b"solid facet\n 1 2 3\n"], ids=["empty", "bytes", "text"]
)
@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".inp"])
def test_garbage(suffix, content, tmp_path, capfd):
    path = tmp_path / f"garbage{suffix}"
    path.write_bytes(content)
    with pytest.raises(MeshError) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert capfd.readouterr() == ("", "")


def _msh(tmp_path, text):
    path = tmp_path / "a.msh"
    path.write_text(text)
    return path


def _edited(tmp_path, form, old, new):
    path = write(base(), tmp_path / "edited", form)
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("make", "pattern"),
    [
        (lambda t: t / "nowhere.msh", "no such mesh file"),
        (lambda t: t, "unknown mesh format"),
        (lambda t: write(base(), t / "a", "vtu").rename(t / "a.stl"), r"unknown mesh format '\.stl', known are \.msh"),
        (lambda t: write(base(), t / "a", "vtu").rename(t / "a.msh"), r"not a Gmsh file"),
        (lambda t: _edited(t, "msh22", b"2.2 0 8", b"4.0 0 8"), r"Gmsh format 4\.0 is not supported"),
        (lambda t: _edited(t, "msh22", b"2.2 0 8", b"1.0 0 8"), r"Gmsh format 1\.0 is not supported"),
        (lambda t: _edited(t, "msh22", b"\n1 11 2", b"\n1 140 2"), r"unknown Gmsh element type 140"),
        (lambda t: _edited(t, "msh41", b"$Entities", b"$PartitionedEntities"), r"partitioned"),
        (lambda t: _edited(t, "msh22", b"$EndPhysicalNames", b"$Other"), r"section \$PhysicalNames is not closed"),
        (lambda t: _edited(t, "vtu", b"<Piece", b"<!-- <Piece --><Piece"), r"several pieces"),
        (
            lambda t: _edited(t, "vtu", b'"types" format="ascii">24', b'"types" format="ascii">11'),
            r"unknown VTK cell type 11",
        ),
        (lambda t: _edited(t, "vtu", b"UnstructuredGrid", b"PolyData"), r"damaged"),
        (lambda t: _edited(t, "inp", b"C3D10", b"C3D10XYZ7"), r"unknown element type 'C3D10XYZ7' \(12 lines\)"),
        (lambda t: _edited(t, "inp", b"C3D10", b"MASS"), r"unknown element type 'MASS'"),
        (lambda t: _edited(t, "inp", b"*NODE\n1,", b"*NODE\n2,"), r"node id 2 is defined twice"),
        (lambda t: _edited(t, "inp", b"*NODE\n1,", b"*NODE\none,"), r"bad line .*'one'"),
        (lambda t: _edited(t, "inp", b"** comment", b"*INCLUDE, INPUT=b.inp"), r"\*INCLUDE is not supported"),
        (lambda t: _edited(t, "inp", b"** comment", b"*INSTANCE, NAME=i\n1, 0, 0"), r"instance 'i' is moved"),
        (
            lambda t: _edited(t, "inp", b"*ELEMENT", b"*NSET, NSET=n\n1, 777\n*ELEMENT"),
            r"node set 'n' refers to node 777",
        ),
        (
            lambda t: _edited(t, "inp", b"*ELEMENT", b"*ELSET, ELSET=e\nother\n*ELEMENT"),
            r"\*ELSET, e: unknown set 'other'",
        ),
        (lambda t: _edited(t, "inp", b"*ELEMENT", b"*SURFACE, NAME=s\n1, S9\n*ELEMENT"), r"unknown face label 'S9'"),
        (
            lambda t: _edited(t, "inp", b"*ELEMENT", b"*SURFACE, NAME=s\n7, S1\n*ELEMENT"),
            r"surface 's' holds faces of cells",
        ),
    ],
)
def test_bad_file(make, pattern, tmp_path):
    path = make(tmp_path)
    with pytest.raises(MeshError, match=pattern) as caught:
        read(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("options", "pattern"),
    [
        ({"scale": 0.0}, r"scale must be a positive number, got 0\.0"),
        ({"scale": -1e-3}, r"got -0\.001"),
        ({"scale": np.nan}, r"got nan"),
        ({"scale": "mm"}, r"got 'mm'"),
        ({"transform": np.diag([-1.0, 1.0, 1.0, 1.0])}, r"is a reflection \(determinant -1\)"),
        ({"transform": (np.diag([1.0, 1.0, 0.0]), np.zeros(3))}, r"is singular \(determinant 0\)"),
        ({"transform": np.eye(3)}, r"transform must be a finite 4x4 matrix"),
        ({"transform": np.full((4, 4), np.nan)}, r"transform must be"),
        ({"transform": (np.eye(3), np.zeros(2))}, r"transform must be"),
        ({"cell_type": "tetra"}, r"holds 6 tetra10, .*cell_type='tetra' was asked for"),
        ({"cell_type": "hexahedron"}, r"holds 6 tetra10, .*cell_type='hexahedron' was asked for"),
        ({"cell_type": "wedge"}, r"unknown cell_type 'wedge'"),
    ],
)
def test_bad_option(options, pattern, tmp_path):
    path = write(base(), tmp_path / "ok", "msh22")
    with pytest.raises(MeshError, match=pattern) as caught:
        read(path, **options)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("data", [b"*NODE\n1, 0, 0\n2, 1, 0\n3, 0, 1\n*ELEMENT, TYPE=CPS3\n1, 1, 2, 3\n"])
def test_two_coordinates(data, tmp_path):
    path = tmp_path / "plane.inp"
    path.write_bytes(data)
    with pytest.raises(MeshError, match=r"plane\.inp: .*\[3\] numbers.*2D mesh"):
        read(path)


@pytest.mark.parametrize(
    ("make", "pattern"),
    [
        (lambda: box((1, 0, 1), cells=(1, 1, 1)), r"box: size must be positive"),
        (lambda: box((1, 1), cells=(1, 1, 1)), r"box: size: expected 3 numbers"),
        (lambda: box((1, 1, 1), cells=(1, 0, 1)), r"box: cells must be integers of at least 1"),
        (lambda: box((1, 1, 1), cells=(1, 1.5, 1)), r"box: cells must be integers"),
        (lambda: box((1, 1, 1), cells=(1, 1, 1), element="T20"), r"box: unknown element 'T20'"),
        (lambda: box((1, 1, 1), cells=(1, 1, 1), origin=(0, 0, np.nan)), r"box: origin must be finite"),
        (lambda: cylinder(-1, 1, cells=(2, 1)), r"cylinder: radius must be positive, got \[-1.0\]"),
        (lambda: cylinder(1, np.inf, cells=(2, 1)), r"cylinder: length must be finite"),
        (lambda: cylinder(1, 1, cells=(3, 1)), r"must be an even number, got 3"),
        (lambda: sphere(0, cells=2), r"sphere: radius must be positive"),
        (lambda: sphere(1, cells=3), r"sphere: cells must be an even number, got 3"),
    ],
)
def test_bad_generator_argument(make, pattern):
    with pytest.raises(MeshError, match=pattern):
        make()


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        ({"cell_type": "tetra20"}, r"body: unknown cell type 'tetra20'"),
        ({"points": np.zeros((27, 2))}, r"points have shape \(27, 2\)"),
        ({"cells": np.zeros((3, 4), dtype=int)}, r"cells have shape \(3, 4\), expected \(M, 10\)"),
        ({"cells": np.full((3, 10), 27)}, r"body: cells: 27 is out of range 0 \.\. 26"),
        ({"cells": np.zeros((3, 10))}, r"expected integers, got float64"),
        ({"node_sets": {"a": [0, -1]}}, r"node_sets\['a'\]: -1 is out of range"),
        ({"element_sets": {"a": [6]}}, r"element_sets\['a'\]: 6 is out of range"),
        ({"surface_sets": {"a": [[0, 4]]}}, r"surface_sets\['a'\]: 4 is out of range 0 \.\. 3"),
    ],
)
def test_bad_mesh_object(change, pattern):
    good = box((1, 1, 1), cells=(1, 1, 1))
    arguments = {"points": good.points, "cells": good.cells, "cell_type": good.cell_type, "name": "body", **change}
    with pytest.raises(MeshError, match=pattern):
        Mesh(**arguments)


@pytest.mark.parametrize(
    ("select", "pattern"),
    [
        (lambda m: m.nodes("left"), r"box: no node set named 'left'; there are: 'x\+', 'x-'"),
        (lambda m: m.elements("left"), r"box: no element set named 'left'; there are: none"),
        (lambda m: m.surface("left"), r"box: no surface set named 'left'"),
        (lambda m: m.nodes([0, 99]), r"box: nodes: 99 is out of range 0 \.\. 26"),
        (lambda m: m.nodes([0.5]), r"1D array of integers"),
        (lambda m: m.nodes(np.ones(3, dtype=bool)), r"mask for nodes has 3 entries, expected 27"),
        (lambda m: m.nodes(lambda X: X[:, 0]), r"predicate for nodes must return a bool array of shape \(27,\)"),
        (lambda m: m.surface([0, 1]), r"a surface is an integer array \(K, 2\)"),
        (lambda m: m.surface([[6, 0]]), r"surface, element: 6 is out of range"),
    ],
)
def test_bad_selection(select, pattern):
    with pytest.raises(MeshError, match=pattern):
        select(box((1, 1, 1), cells=(1, 1, 1)))


def test_a_good_mesh_gives_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = box((1, 1, 1), cells=(2, 1, 1))
        assert check(mesh) is mesh
