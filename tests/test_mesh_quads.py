"""Meshes of hexahedra and of quads: reading, sets, checks, generators; conversions between cell types."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from warpfea.base.errors import MeshError
from warpfea.mesh import (
    CELL_TYPES,
    Mesh,
    box,
    check,
    cylinder,
    grid,
    linear,
    read,
    sphere,
)
from warpfea.mesh.cells import ELEMENT_CELLS, det_j0
from warpfea.mesh.convert import with_face_nodes


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
SOLIDS = ("tetra", "tetra10", "hexahedron", "tetra_faces")


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


def brick_parts() -> Parts:
    m = brick()
    sides = [("quad", m.faces(name), name) for name in m.surface_sets]
    return Parts(m.points, [("hexahedron", m.cells, "body"), *sides])


def area_vectors(mesh: Mesh, surface) -> np.ndarray:
    """Outward area vectors (m^2) of the faces of hexahedra."""
    x = mesh.points[mesh.faces(surface)]
    return 0.5 * np.cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 1])


# the table


@pytest.mark.parametrize("kind", CELL_TYPES.values(), ids=CELL_TYPES)
def test_cell_table(kind):
    d = kind.dimension
    assert d == {"quad": 2, "line": 1}.get(kind.name, 3)
    assert kind.has_mid_nodes == (kind.name == "tetra10")
    xi = np.random.default_rng(1).random((5, d)) / 3
    assert kind.gradients(xi).shape == (5, kind.nodes, d)
    np.testing.assert_allclose(kind.gradients(xi).sum(axis=1), 0.0, atol=1e-15)
    simplex = kind.corners == d + 1 > 2
    assert kind.rule[1].sum() == pytest.approx(1 / 6 if simplex else 1.0, rel=1e-14)
    # the parent cell in space: the gradients know its linear coordinates, det J0 is 1
    corners = {3: [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]}.get(d) if simplex else None
    if corners is None:
        corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)][: 2**d], dtype=float)
        corners = np.concatenate([corners, corners + (0, 0, 1)]) if d == 3 else corners
    points = np.zeros((kind.nodes, 3))
    points[: kind.corners] = corners
    if kind.has_mid_nodes:
        points[4:] = points[kind.edges].mean(axis=1)
    np.testing.assert_allclose(det_j0(points, np.arange(kind.nodes)[None], kind, xi), 1.0, rtol=1e-14)
    assert kind.faces.dtype == kind.edges.dtype == np.int64


@pytest.mark.parametrize("name", SOLIDS)
def test_faces_of_a_cell_point_outward_and_close(name):
    kind = CELL_TYPES[name]
    hexahedron = name == "hexahedron"
    mesh = box((1, 2, 3), cells=(1, 1, 1), element="H3843" if hexahedron else "T4")
    x = mesh.points[mesh.cells[0]]
    corners = x[kind.faces[:, : kind.face_corners]]
    vectors = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if hexahedron:
        vectors += 0.5 * np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 0])
    np.testing.assert_allclose(vectors.sum(axis=0), 0.0, atol=1e-14)
    assert (np.einsum("ki,ki->k", vectors, corners.mean(axis=1) - x[: kind.corners].mean(axis=0)) > 0).all()


def test_measures_of_lines_and_warped_quads():
    line = Mesh(np.array([(0, 0, 0), (3, 4, 0), (3, 4, 1.0)]), np.array([(0, 1), (1, 2)]), "line")
    np.testing.assert_allclose(line.volumes(), [5.0, 1.0], rtol=1e-15)
    assert line.boundary().shape == (0, 2)
    assert check(line) is line
    saddle = Mesh(np.array([(0, 0, 0), (1, 0, 0), (1, 1, 1), (0, 1, 0.0)]), np.array([(0, 1, 2, 3)]), "quad")
    assert saddle.volume() == pytest.approx(1.2807904, rel=2e-4)  # integral of sqrt(1 + x^2 + y^2)
    trapezoid = Mesh(np.array([(0, 0, 0), (0, 3, 0), (0, 2, 2), (0, 0, 2.0)]), np.array([(0, 1, 2, 3)]), "quad")
    assert trapezoid.volume() == pytest.approx(5.0, rel=1e-15)


def test_volume_of_a_frustum_of_hexahedra_is_exact():
    taper = lambda X: X * np.column_stack([1 - X[:, 2] / 4, 1 - X[:, 2] / 4, 1 + 0 * X[:, 2]])  # noqa: E731
    mesh = box((1, 1, 2), cells=(1, 1, 1), element="H3843", map=taper)
    assert mesh.volume() == pytest.approx(2 / 3 * (1 + 0.25 + 0.5), rel=1e-14)


# shells from files


@pytest.mark.parametrize("form", FORMATS)
def test_read_a_shell(form, tmp_path):
    mesh = read(write(shell_parts(), tmp_path / "plate", form))
    assert (mesh.cell_type, mesh.name, mesh.surface_sets) == ("quad", "plate", {})
    np.testing.assert_array_equal(mesh.points, plate().points)
    np.testing.assert_array_equal(mesh.cells, plate().cells[[2, 0, 1, 3]])
    np.testing.assert_array_equal(mesh.elements("top"), [0, 3])
    np.testing.assert_array_equal(mesh.elements("bottom"), [1, 2])
    assert sorted(mesh.element_sets) == ["bottom", "top"]
    np.testing.assert_array_equal(mesh.nodes("top"), [3, 4, 5, 6, 7, 8])
    np.testing.assert_array_equal(mesh.nodes("bottom"), [0, 1, 2, 3, 4, 5])
    np.testing.assert_array_equal(mesh.nodes("left"), [0, 3, 6])
    assert mesh.volume() == pytest.approx(2.0, rel=1e-14)
    same = read(tmp_path / f"plate{writers.SUFFIX[form]}", cell_type="quad", scale=0.1)
    assert same.volume() == pytest.approx(0.02, rel=1e-14)


@pytest.mark.parametrize("form", ["msh22", "msh22b", "vtu"])
def test_a_point_and_an_edge_with_the_name_of_quads(form, tmp_path):
    parts = shell_parts()
    parts.blocks += [("vertex", np.array([[8]]), "tip"), ("line", np.array([[0, 1]]), "top")]
    mesh = read(write(parts, tmp_path / "plate", form))
    np.testing.assert_array_equal(mesh.nodes("tip"), [8])
    np.testing.assert_array_equal(mesh.elements("top"), [0, 3])
    np.testing.assert_array_equal(mesh.nodes("top"), [0, 1, 3, 4, 5, 6, 7, 8])


def test_a_quad_in_two_groups_of_msh22(tmp_path):
    parts = shell_parts()
    parts.blocks.append(("quad", parts.blocks[0][1], "patch"))
    mesh = read(write(parts, tmp_path / "twice", "msh22"))
    assert len(mesh.cells) == 4
    np.testing.assert_array_equal(mesh.elements("patch"), [0])


INP = """*NODE
1, 0, 0, 0
2, 1, 0, 0
3, 1, 1, 0
4, 0, 1, 0
5, 2, 0, 0.5
6, 2, 1, 0.5
*ELEMENT, TYPE=S4, ELSET=A
10, 1, 2, 3, 4
*ELEMENT, TYPE=S4R, ELSET=B
20, 2, 5, 6, 3
*NSET, NSET=HELD
1, 4
*SURFACE, TYPE=ELEMENT, NAME=RIM
A, E1
20, {label}
"""


def test_abaqus_shell(tmp_path):
    path = tmp_path / "s.inp"
    path.write_text(INP.format(label="E2"))
    mesh = read(path)
    np.testing.assert_array_equal(mesh.cells, [[0, 1, 2, 3], [1, 4, 5, 2]])
    np.testing.assert_array_equal(mesh.elements("B"), [1])
    np.testing.assert_array_equal(mesh.nodes("HELD"), [0, 3])
    np.testing.assert_array_equal(mesh.faces("RIM"), [[0, 1], [4, 5]])
    np.testing.assert_array_equal(mesh.nodes("RIM"), [0, 1, 4, 5])
    for label in ("SPOS", "S1", "E5"):
        path.write_text(INP.format(label=label))
        with pytest.raises(MeshError, match=rf"NAME=RIM: unknown face label '{label}', known are E1 \.\. E4 \(edges\)"):
            read(path)


# hexahedra from files


@pytest.mark.parametrize("form", FORMATS)
def test_read_hexahedra(form, tmp_path):
    mesh = read(write(brick_parts(), tmp_path / "brick", form))
    expected = brick()
    np.testing.assert_array_equal(mesh.points, expected.points)
    np.testing.assert_array_equal(mesh.cells, expected.cells)
    assert mesh.cell_type == "hexahedron"
    assert mesh.volume() == pytest.approx(6.0, rel=1e-14)
    np.testing.assert_array_equal(mesh.elements("body"), [0, 1])
    assert sorted(mesh.surface_sets) == sorted(expected.surface_sets)
    for name in expected.surface_sets:
        np.testing.assert_array_equal(mesh.surface(name), expected.surface(name))
        np.testing.assert_array_equal(mesh.nodes(name), expected.nodes(name))


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("turn", range(4))
def test_interior_quad_takes_the_side_its_normal_leaves(turn, flip, tmp_path):
    m = brick()
    inner = np.roll([1, 4, 10, 7], turn)  # seen from the left cell: normal along +x
    parts = Parts(m.points, [("hexahedron", m.cells, None), ("quad", [inner[::-1] if flip else inner], "middle")])
    got = read(write(parts, tmp_path / "inner", "msh22"))
    assert got.surface("middle")[0, 0] == int(flip)
    np.testing.assert_allclose(area_vectors(got, "middle"), [[-3.0 if flip else 3.0, 0, 0]], atol=1e-15)


def test_face_labels_of_abaqus_hexahedra(tmp_path):
    m = brick()
    path = write(Parts(m.points, [("hexahedron", m.cells[:1], None)]), tmp_path / "h", "inp")
    text = path.read_text()
    labels = "".join(f"*SURFACE, NAME=F{k}, TYPE=ELEMENT\n1, S{k}\n" for k in range(1, 7))
    path.write_text(text + labels)
    with pytest.warns(UserWarning, match="orphan"):
        mesh = read(path)
    # Abaqus, C3D8: face 1 is 1-2-3-4, 2: 5-8-7-6, 3: 1-5-6-2, 4: 2-6-7-3, 5: 3-7-8-4, 6: 4-8-5-1
    manual = {"F1": "1234", "F2": "5876", "F3": "1562", "F4": "2673", "F5": "3784", "F6": "4851"}
    for name, nodes in manual.items():
        expected = m.cells[0, [int(n) - 1 for n in nodes]]
        np.testing.assert_array_equal(np.sort(mesh.faces(name)[0]), np.sort(expected))
    for change, label, pattern in (
        ("C3D8R", "S7", r"unknown face label 'S7', known are S1 \.\. S6$"),
        ("C3D8R", "E1", r"unknown face label 'E1', known are S1 \.\. S6$"),
        ("SC8R", "S5", r"unknown element type 'SC8R'"),
    ):
        path.write_text(text.replace("C3D8R", change) + f"*SURFACE, NAME=F, TYPE=ELEMENT\n1, {label}\n")
        with pytest.raises(MeshError, match=pattern):
            read(path)


def test_other_solids_are_named_before_their_face_labels(tmp_path):
    wedge = Parts(brick().points, [("wedge", [[0, 1, 3, 6, 7, 9]], None)])
    path = write(wedge, tmp_path / "w", "inp")
    path.write_text(path.read_text() + "*SURFACE, NAME=F, TYPE=ELEMENT\n1, S5\n")
    with pytest.raises(MeshError, match=r"unknown cell type 'wedge' \(1 cells\); known are tetra, tetra10, hexahedron"):
        read(path)


# files that are refused


def _tets(*more):
    m = box((1, 1, 1), cells=(1, 1, 1), element="T4")
    return Parts(m.points, [("tetra", m.cells, "body"), *more])


def _shell(*blocks):
    return Parts(plate().points, blocks)


Q = plate().cells
REFUSED = {
    "triangles": (
        lambda: _shell(("triangle", [[0, 1, 4]], "a")),
        {},
        r"no tetrahedra, the file holds 1 triangle: .* A shell needs quads of 4 nodes",
    ),
    "triangles and quads": (
        lambda: _shell(("quad", Q[:2], "a"), ("triangle", [[3, 4, 7], [3, 7, 6]], "a")),
        {},
        r"holds 2 quad, 2 triangle; a shell needs quads of 4 nodes only: recombine",
    ),
    "second-order quads": (
        lambda: _shell(("quad8", [[0, 2, 8, 6, 1, 5, 7, 3]], "a")),
        {},
        r"the file holds 1 quad8: is this a 2D mesh\? A shell needs quads of 4 nodes",
    ),
    "both quads": (
        lambda: _shell(("quad", Q[:1], "a"), ("quad8", [[0, 2, 8, 6, 1, 5, 7, 3]], "a")),
        {},
        r"holds 1 quad, 1 quad8; a shell needs quads of 4 nodes only",
    ),
    "hexahedra and tetrahedra": (
        lambda: _tets(("hexahedron", [[0, 1, 3, 2, 4, 5, 7, 6]], None)),
        {},
        r"holds 6 tetra, 1 hexahedron; all solid cells must be of one type",
    ),
    "quad on tetrahedra": (
        lambda: _tets(("quad", [[0, 1, 3, 2]], "q")),
        {},
        r"surface 'q' holds 1 cells of type 'quad', not faces of tetrahedra",
    ),
    "triangle on hexahedra": (
        lambda: Parts(brick().points, [("hexahedron", brick().cells, None), ("triangle", [[0, 1, 4]], "t")]),
        {},
        r"surface 't' holds 1 cells of type 'triangle', not faces of hexahedra",
    ),
    "lost quad": (
        lambda: Parts(brick().points, [("hexahedron", brick().cells, None), ("quad", [[0, 1, 4, 6]], "t")]),
        {},
        r"surface 't': quad 0 with nodes \[0, 1, 4, 6\] is not the face of a hexahedron \(1 such\)",
    ),
    "asked for quads": (brick_parts, {"cell_type": "quad"}, r"holds 2 hexahedron, .* but cell_type='quad' was asked"),
    "asked for lines": (brick_parts, {"cell_type": "line"}, r"unknown cell_type 'line', known are \['hexahedron', 'q"),
}


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("case", REFUSED)
def test_refused(case, form, tmp_path):
    make, options, pattern = REFUSED[case]
    path = write(make(), tmp_path / "bad", form)
    with pytest.raises(MeshError, match=pattern) as caught:
        read(path, **options)
    assert str(caught.value).startswith(f"{path}: ")


# checks


def _changed(mesh: Mesh, *, move=None, cells=None, name="part") -> Mesh:
    points = mesh.points.copy()
    for node, x in (move or {}).items():
        points[node] = x
    return Mesh(points, mesh.cells if cells is None else np.array(cells), mesh.cell_type, name=name)


def _flat_plate(**change) -> Mesh:
    return _changed(grid((2, 2), cells=(2, 2)), **change)


def _branch() -> Mesh:
    points = np.array([(0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0), (-1, 0, 0), (-1, 1, 0), (0, 0, 1), (0, 1, 1.0)])
    return Mesh(points, np.array([(0, 2, 3, 1), (0, 1, 5, 4), (0, 6, 7, 1)]), "quad", name="part")


ONE = box((1, 1, 1), cells=(1, 1, 1), element="H3843")
BAD = {
    "hex mirrored": (
        lambda: _changed(brick(), cells=brick().cells[:, [4, 5, 6, 7, 0, 1, 2, 3]]),
        r"all 2 elements are inverted \(element 0 has det J0 = -3 m\^3\).*swap the nodes 0 \.\. 3 and 4 \.\. 7",
    ),
    "hex inverted": (
        lambda: _changed(brick(), cells=[brick().cells[0], brick().cells[1, [4, 5, 6, 7, 0, 1, 2, 3]]]),
        r"part: element 1 is inverted: smallest det J0 = -3 m\^3, volume -3 m\^3 \(1 such element, first: 1\)",
    ),
    "hex corner": (  # volume positive, one corner pushed through
        lambda: _changed(ONE, move={7: (0.3, 0.3, 0.3)}),
        r"0 is inverted at a corner, centre or quadrature point \(too distorted\): smallest det J0 = -1\.1 m\^3, "
        r"volume 0\.475 m\^3",
    ),
    "hex flat": (  # all corners in one plane
        lambda: _changed(ONE, move={4 + k: (0.2 + 0.5 * (k % 2), 0.2 + 0.5 * (k // 2), 0) for k in range(4)}),
        r"element 0 has zero volume \(0 m\^3, longest edge 1 m; 1 such element\)",
    ),
    "hex repeated": (
        lambda: _changed(ONE, cells=[[0, 1, 3, 3, 4, 5, 7, 6]]),
        r"element 0 holds node 3 twice: .*; a cell can't be collapsed",
    ),
    "hex twice": (
        lambda: _changed(ONE, cells=[ONE.cells[0], ONE.cells[0, [1, 2, 3, 0, 5, 6, 7, 4]]]),
        r"elements 0 and 1 have the same corners",
    ),
    "quad infinite": (lambda: _flat_plate(move={4: (np.inf, 0, 0)}), r"node 4 has the coordinates \(inf, 0, 0\)"),
    "quad repeated": (lambda: _flat_plate(cells=[[0, 1, 4, 4]]), r"element 0 holds node 4 twice: \[0, 1, 4, 4\]; a ce"),
    "quad twice": (
        lambda: _flat_plate(cells=[*Q, [3, 4, 1, 0]]),
        r"elements 0 and 4 have the same corners \[0, 1, 4, 3\] \(1 duplicate element\)",
    ),
    "quad coincident": (
        lambda: _flat_plate(move={8: (2, 1, 0)}),
        r"nodes 5 and 8 coincide at \(2, 1, 0\), 0 m apart",
    ),
    "quad without area": (
        lambda: _flat_plate(move={0: (0.2, 1, 0), 1: (0.7, 1, 0)}),
        r"quad 0 has zero area \(0 m\^2, longest edge 1 m; 1 such quad\)",
    ),
    "quad not convex": (
        lambda: _flat_plate(move={8: (1.2, 1.2, 0)}),
        r"part: quad 3 is not convex: at corner 2 \(node 8\) the edges span -0\.6 m\^2",
    ),
    "quad with a straight corner": (
        lambda: _flat_plate(move={8: (1.5, 1.5, 0)}),
        r"quad 3 is not convex: at corner 2 \(node 8\) the edges span \S+ m\^2 along the mean normal",
    ),
    "bow tie": (lambda: _flat_plate(cells=[*Q[:3], [4, 5, 7, 8]]), r"quad 3 is not convex: .* order of a walk around"),
    "flipped": (
        lambda: _flat_plate(cells=[Q[0], Q[1][::-1], Q[2], Q[3]]),
        r"quads 0 and 1 both run from node 1 to node 4 through the edge they share, .*\(2 such edges\): flip one",
    ),
    "branching": (
        _branch,
        r"edge between nodes 1 and 0 is shared by 3 quads \(0, 1, 2; 1 such edge\): .* one body per sheet",
    ),
    "no quads": (lambda: _flat_plate(cells=np.empty((0, 4), dtype=int)), r"part: no elements \(0 of type quad\)"),
    "line without length": (
        lambda: Mesh(np.array([(0, 0, 0), (1, 0, 0), (1, 0, 1e-15)]), np.array([(0, 1), (1, 2)]), "line", name="part"),
        r"nodes 1 and 2 coincide",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_check(case):
    make, pattern = BAD[case]
    with pytest.raises(MeshError, match=pattern) as caught:
        check(make())
    assert str(caught.value).startswith("part: ")


@pytest.mark.parametrize("form", ["msh41", "vtu", "inp"])
def test_what_is_read_is_checked(form, tmp_path):
    parts = shell_parts()
    parts.blocks[3] = ("quad", parts.blocks[3][1][:, ::-1], "top")
    path = write(parts, tmp_path / "flipped", form)
    with pytest.raises(MeshError, match=r"flipped\.\w+: quads 0 and 3 both run from node 4 to node 7") as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_distorted_hexahedron_may_be_fine():
    assert check(_changed(ONE, move={7: (0.7, 0.7, 0.7)})).volume() > 0.5


# generators


def test_grid():
    mesh = grid((4, 2), cells=(5, 3), origin=(1, 2, 3))
    assert check(mesh) is mesh
    assert (mesh.cell_type, mesh.name, mesh.orphan_nodes.size, mesh.surface_sets) == ("quad", "plate", 0, {})
    assert (len(mesh.cells), len(mesh.points)) == (15, 24)
    np.testing.assert_allclose(mesh.volumes(), 8 / 15, rtol=1e-14)
    np.testing.assert_array_equal(mesh.bounding_box(), [(1, 2, 3), (5, 4, 3)])
    x = mesh.points[mesh.cells]
    normal = np.cross(x[:, 1] - x[:, 0], x[:, 3] - x[:, 0])
    np.testing.assert_allclose(normal, np.tile([0, 0, 8 / 15], (15, 1)), atol=1e-14)
    for name, axis, value in (("x-", 0, 1), ("x+", 0, 5), ("y-", 1, 2), ("y+", 1, 4)):
        np.testing.assert_array_equal(mesh.nodes(name), np.flatnonzero(mesh.points[:, axis] == value))
    assert sorted(mesh.node_sets) == ["x+", "x-", "y+", "y-"]


def test_boundary_of_quads_is_the_rim_walked_around_once():
    mesh = plate()
    rim = mesh.faces(mesh.boundary())
    assert rim.shape == (8, 2)
    np.testing.assert_array_equal(np.sort(rim[:, 0]), [0, 1, 2, 3, 5, 6, 7, 8])
    np.testing.assert_array_equal(np.sort(rim[:, 1]), [0, 1, 2, 3, 5, 6, 7, 8])
    np.testing.assert_allclose(mesh.face_centroids(mesh.boundary())[0], (0.6, -0.7, 1 / 3))
    left = mesh.surface(lambda X: X[:, 0] < 0.1 + 1e-9)
    np.testing.assert_array_equal(np.unique(mesh.faces(left)), mesh.nodes("x-"))


def tube(turns: float):
    """Roll the unit square about the y axis, so that the normals point outward."""
    return lambda X: np.column_stack(
        [np.cos(2 * np.pi * turns * X[:, 0]), X[:, 1], -np.sin(2 * np.pi * turns * X[:, 0])]
    )


def test_grid_rolled_to_a_tube_is_closed():
    half, full = (grid((1, 1), cells=(40, 3), map=tube(t)) for t in (0.5, 1.0))
    chord = 2 * np.sin(np.pi / 40)
    assert len(half.points) == 41 * 4
    assert len(half.boundary()) == 2 * (40 + 3)
    assert (len(full.points), len(full.cells), len(full.boundary())) == (40 * 4, 120, 80)
    assert full.volume() == pytest.approx(40 * chord, rel=1e-13)
    np.testing.assert_array_equal(full.nodes("x-"), full.nodes("x+"))
    assert len(full.nodes("y-")) == 40
    rim = np.unique(full.faces(full.boundary()))
    np.testing.assert_array_equal(rim, np.union1d(full.nodes("y-"), full.nodes("y+")))
    x = full.points[full.cells]
    outward = np.cross(x[:, 1] - x[:, 0], x[:, 3] - x[:, 0])
    middle = full.centroids() * (1, 0, 1)
    assert (np.einsum("mi,mi->m", outward, middle) > 0).all()


def test_a_torus_has_no_rim():
    def torus(X):
        a, b = 2 * np.pi * X[:, 0], 2 * np.pi * X[:, 1]
        return np.column_stack([(2 + np.cos(b)) * np.cos(a), (2 + np.cos(b)) * np.sin(a), np.sin(b)])

    mesh = grid((1, 1), cells=(24, 16), map=torus)
    assert (len(mesh.points), len(mesh.boundary())) == (24 * 16, 0)
    assert mesh.volume() == pytest.approx(8 * np.pi**2, rel=0.02)


def test_a_moebius_band_is_refused():
    def band(X):
        a, s = 2 * np.pi * X[:, 0], X[:, 1] - 0.5
        r = 2 + s * np.cos(a / 2)
        return np.column_stack([r * np.cos(a), r * np.sin(a), s * np.sin(a / 2)])

    with pytest.raises(MeshError, match=r"plate: nodes \d+ and \d+ coincide"):
        grid((1, 1), cells=(20, 2), map=band)


@pytest.mark.parametrize(("element", "cell_type"), ELEMENT_CELLS.items())
def test_box_of_each_element(element, cell_type):
    mesh = check(box((1.0, 0.5, 0.2), cells=(4, 3, 2), element=element, origin=(1, 2, 3)))
    assert (
        mesh.cell_type
        == cell_type
        == ("hexahedron" if element == "H3843" else "tetra10" if "10" in element else "tetra")
    )
    assert len(mesh.cells) == (24 if element == "H3843" else 6 * 24)
    assert mesh.volume() == pytest.approx(0.1, rel=1e-13)


def test_box_of_hexahedra():
    mesh = box((1.0, 0.5, 0.2), cells=(4, 3, 2), element="H3843", origin=(1, 2, 3))
    np.testing.assert_array_equal(
        mesh.points, box((1, 0.5, 0.2), cells=(4, 3, 2), element="T4", origin=(1, 2, 3)).points
    )
    np.testing.assert_array_equal(mesh.cells[0], [0, 1, 6, 5, 20, 21, 26, 25])
    areas = {"x": 0.1, "y": 0.2, "z": 0.5}
    for k, axis in enumerate("xyz"):
        for sign, end in (("-", 0), ("+", 1)):
            vector = area_vectors(mesh, axis + sign).sum(axis=0)
            np.testing.assert_allclose(vector, (2 * end - 1) * areas[axis] * np.eye(3)[k], atol=1e-15)
            at = mesh.bounding_box()[end][k]
            np.testing.assert_array_equal(mesh.nodes(axis + sign), np.flatnonzero(mesh.points[:, k] == at))
    table = np.concatenate(list(mesh.surface_sets.values()))
    np.testing.assert_array_equal(table[np.lexsort(table.T[::-1])], mesh.boundary())


def ring(X):
    """Radius 1 + x, angle y, height z."""
    return np.column_stack([(1 + X[:, 0]) * np.cos(X[:, 1]), (1 + X[:, 0]) * np.sin(X[:, 1]), X[:, 2]])


@pytest.mark.parametrize(("element", "order"), [("H3843", 2.0), ("T4", 2.0), ("T10", 4.0)])
def test_mapped_box_converges(element, order):
    exact = np.pi / 4 * (4 - 1)
    error = [
        abs(1 - box((1, np.pi / 2, 1), cells=(n, 2 * n, 1), element=element, map=ring).volume() / exact) for n in (2, 4)
    ]
    assert np.log2(error[0] / error[1]) == pytest.approx(order, abs=0.2)


@pytest.mark.parametrize(
    ("make", "pattern"),
    [
        (lambda: grid((1, 0), cells=(1, 1)), r"^grid: size must be positive, got \[1\.0, 0\.0\]"),
        (lambda: grid((1, 1, 1), cells=(1, 1)), r"grid: size: expected 2 numbers"),
        (lambda: grid((1, 1), cells=4), r"grid: cells: expected 2 numbers, got 4"),
        (lambda: grid((1, 1), cells=(2, 1.5)), r"grid: cells must be integers of at least 1"),
        (lambda: grid((1, 1), cells=(1, 1), origin=(0, 0, np.nan)), r"grid: origin must be finite"),
        (lambda: grid((1, 1), cells=(1, 1), map=3), r"grid: map must be a function .*, got int"),
        (
            lambda: grid((1, 1), cells=(1, 1), map=lambda X: X[:, :2]),
            r"grid: map must return .* shape \(4, 3\), got shape",
        ),
        (lambda: grid((1, 1), cells=(1, 1), map=lambda X: None), r"grid: map must return numbers of shape \(4, 3\)"),
        (lambda: grid((1, 1), cells=(1, 1), map=lambda X: X / np.where(X > 2, 1.0, np.nan)), r"of the point \[0\.0"),
        (lambda: grid((1, 1), cells=(2, 2), map=lambda X: 0 * X), r"plate: elements 0 and 1 have the same"),
        (lambda: grid((1, 1), cells=(2, 2), map=lambda X: X * X[:, :1]), r"plate: nodes 0 and 3 coincide"),
        (lambda: box((1, 1, 1), cells=(1, 1, 1), element="H20"), r"unknown element 'H20', known are T4, .*, H3843$"),
        (lambda: box((1, 1, 1), cells=(1, 1, 1), map=lambda X: -X), r"box: all 6 elements are inverted .* is mirrored"),
        (
            lambda: box((1, 1, 1), cells=(2, 1, 1), element="H3843", map=lambda X: X * (X - 0.9)),
            r"box: element 0 is inverted: smal",
        ),
        (
            lambda: box((1, 1, 1), cells=(1, 1, 1), map=lambda X: X[0]),
            r"box: map must return .* \(27, 3\), got shape \(3,\)",
        ),
        (lambda: cylinder(1, 1, cells=(2, 1), element="H3843"), r"cylinder: element 'H3843' isn't available"),
        (lambda: sphere(1, cells=2, element="H3843"), r"sphere: element 'H3843' isn't available"),
    ],
)
def test_bad_generator_argument(make, pattern):
    with pytest.raises(MeshError, match=pattern), np.errstate(all="ignore"):
        make()


# conversions


def test_linear():
    fine = box((1, 2, 3), cells=(2, 2, 1))
    mixed = Mesh(
        np.vstack([[(9.0, 9, 9)], fine.points]),
        fine.cells + 1,
        "tetra10",
        node_sets={"mid": fine.cells[:2, 7] + 1, "some": [0, 1, 2, 3], **{k: v + 1 for k, v in fine.node_sets.items()}},
        element_sets={"half": np.arange(12)},
        surface_sets=fine.surface_sets,
        name="part",
        path="part.msh",
    )
    mesh, expected = linear(mixed), box((1, 2, 3), cells=(2, 2, 1), element="T4")
    assert (mesh.cell_type, mesh.name, mesh.path) == ("tetra", "part", "part.msh")
    np.testing.assert_array_equal(mesh.points, np.vstack([[(9.0, 9, 9)], expected.points]))
    np.testing.assert_array_equal(mesh.cells, expected.cells + 1)
    np.testing.assert_array_equal(mesh.orphan_nodes, [0])
    assert mesh.nodes("mid").size == 0
    np.testing.assert_array_equal(mesh.nodes("some"), [0, 1, 2])  # node 2 of the file is a mid-edge node
    np.testing.assert_array_equal(mesh.elements("half"), np.arange(12))
    for name in expected.surface_sets:
        np.testing.assert_array_equal(mesh.nodes(name), expected.nodes(name) + 1)
        np.testing.assert_array_equal(mesh.surface(name), expected.surface(name))
    assert linear(mesh) is mesh


def test_linear_refuses():
    with pytest.raises(MeshError, match=r"plate: linear\(\) takes tetra10 \(or tetra\) cells, the mesh has quad"):
        linear(plate())
    # corners 0 and 1 change places: the bent edges could hold this together, straight ones can't
    cells = box((1, 1, 1), cells=(1, 1, 1)).cells.copy()
    cells[2, :2] = cells[2, 1::-1]
    twisted = Mesh(box((1, 1, 1), cells=(1, 1, 1)).points, cells, "tetra10", name="part")
    with pytest.raises(MeshError, match=r"part: element 2 is inverted.*straight edges between the corners"):
        linear(twisted)


@pytest.fixture
def block() -> Mesh:
    mesh = box((2, 1, 1), cells=(2, 2, 1), element="T4", name="block")
    inner = mesh.nodes(lambda X: X[:, 0] == 1.0)
    return Mesh(
        mesh.points,
        mesh.cells,
        "tetra",
        node_sets={
            **mesh.node_sets,
            "inner": inner,
            "left": np.unique(mesh.cells[:12]),
            "loose": mesh.nodes("x-"),
            "edge": mesh.nodes(lambda X: X[:, 0] + X[:, 1] == 0.0),
            "part": mesh.nodes("z+"),
        },
        element_sets={"left": np.arange(12)},
        surface_sets={**mesh.surface_sets, "part": mesh.surface("z+")[:3]},
        name="block",
    )


def test_face_nodes_are_shared(block):
    mesh = with_face_nodes(block)
    assert (mesh.cell_type, mesh.name) == ("tetra_faces", "block")
    n = len(block.points)
    corners = np.sort(block.cells[:, CELL_TYPES["tetra"].faces].reshape(-1, 3), axis=1)
    assert len(mesh.points) - n == len(np.unique(corners, axis=0)) == (4 * 24 + len(block.boundary())) // 2
    np.testing.assert_array_equal(mesh.points[:n], block.points)
    np.testing.assert_array_equal(mesh.cells[:, :4], block.cells)
    np.testing.assert_allclose(
        mesh.points[mesh.cells[:, 4:]].reshape(-1, 3), block.points[corners].mean(axis=1), atol=1e-15
    )
    uses = np.bincount(mesh.cells[:, 4:].ravel() - n)
    assert sorted(np.unique(uses)) == [1, 2]
    np.testing.assert_array_equal(np.sort(mesh.cells[:, 4:].ravel()[:4]), n + np.arange(4))  # as the elements come
    assert check(mesh).volume() == pytest.approx(2.0, rel=1e-14)
    np.testing.assert_array_equal(mesh.boundary(), block.boundary())
    on_sides = mesh.faces("x+")
    assert on_sides.shape[1] == 4
    np.testing.assert_array_equal(mesh.points[on_sides[:, 3], 0], 2.0)
    again = with_face_nodes(block)
    np.testing.assert_array_equal(again.cells, mesh.cells)


def test_face_nodes_in_sets(block):
    mesh = with_face_nodes(block)
    n = len(block.points)
    added = lambda name: mesh.nodes(name)[len(block.nodes(name)) :]  # noqa: E731
    for name in block.node_sets:
        np.testing.assert_array_equal(mesh.nodes(name)[: len(block.nodes(name))], block.nodes(name))
        assert (added(name) >= n).all()
        assert (np.diff(mesh.nodes(name)) > 0).all()
    for name, axis, value in (("x-", 0, 0), ("x+", 0, 2), ("y-", 1, 0), ("z+", 2, 1)):
        at = np.flatnonzero(np.abs(mesh.points[:, axis] - value) < 1e-12)
        np.testing.assert_array_equal(mesh.nodes(name), at)
    assert len(added("inner")) == 0  # no surface of that name, and inside
    np.testing.assert_array_equal(added("loose"), added("x-"))  # outer faces
    assert len(added("edge")) == 0
    np.testing.assert_array_equal(added("part"), np.sort(mesh.faces("part")[:, 3]))  # 3 of the 8 of z+
    np.testing.assert_array_equal(added("left"), np.unique(mesh.cells[:12, 4:]))  # all faces of its elements
    for name in block.surface_sets:
        np.testing.assert_array_equal(mesh.surface(name), block.surface(name))
    np.testing.assert_array_equal(mesh.elements("left"), np.arange(12))


def test_face_points_of_a_curved_source(block):
    corners = block.points[block.cells[:, CELL_TYPES["tetra"].faces]]
    curved = corners.mean(axis=2) + 0.01 * np.sin(corners.mean(axis=2))
    mesh = with_face_nodes(block, face_points=curved)
    np.testing.assert_allclose(mesh.points[mesh.cells[:, 4:]], curved, atol=1e-14)
    lost, torn = curved.copy(), curved.copy()
    lost[3, 2, 1] = np.nan
    inner = np.argwhere(np.bincount(mesh.cells[:, 4:].ravel())[mesh.cells[:, 4:]] == 2)[0]
    torn[tuple(inner)] += (0, 0, 0.1)
    for points, pattern in (
        (curved[:, :3], r"block: face_points have shape \(24, 3, 3\), expected \(24, 4, 3\)"),
        (lost, r"block: face_points of element 3, face 2 are \[.*nan.*\]: not finite"),
        (torn, r"block: face_points differ by 0\.1 m between face \d of element \d+ and face \d of element \d+"),
    ):
        with pytest.raises(MeshError, match=pattern):
            with_face_nodes(block, face_points=points)
    with pytest.raises(MeshError, match=r"box: face nodes need tetra cells, the mesh has tetra10"):
        with_face_nodes(box((1, 1, 1), cells=(1, 1, 1)))
