"""Meshes of hexahedra and of quads from files: cells, sets, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from quad_meshes import FORMATS, Parts, Q, area_vectors, brick, plate, shell_parts, write, writers

from warpfea.base.errors import MeshError
from warpfea.mesh import CELL_TYPES, Mesh, box, check, read
from warpfea.mesh.cells import det_j0

SOLIDS = ("tetra", "tetra10", "hexahedron", "tetra_faces")


def brick_parts() -> Parts:
    m = brick()
    sides = [("quad", m.faces(name), name) for name in m.surface_sets]
    return Parts(m.points, [("hexahedron", m.cells, "body"), *sides])


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
    with pytest.raises(MeshError, match="surface 'F': faces of prisms and pyramids, which are cut, have no number"):
        read(path)


# files that are refused


def _tets(*more):
    m = box((1, 1, 1), cells=(1, 1, 1), element="T4")
    return Parts(m.points, [("tetra", m.cells, "body"), *more])


def _shell(*blocks):
    return Parts(plate().points, blocks)


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
