"""Meshes: reading, sets, generators, geometry."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import mesh_writers as writers
import numpy as np
import pytest
from mesh_writers import FORMATS, Parts, write

import warpfea
from warpfea.base.errors import MeshError
from warpfea.mesh import CELL_TYPES, Mesh, box, check, cylinder, read, sphere

HERE = Path(__file__).parent
SCENES = Path(warpfea.__file__).parent.parent / "scenes"


def same_sets(a: dict, b: dict):
    assert sorted(a) == sorted(b)
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])


# reference meshes and the hook

REFERENCE = [  # nodes, elements, volume (m^3) and size (m), as the reference results state them
    ("S1_cantilever_coarse", 715, 384, 0.01, (1.0, 0.1, 0.1)),
    ("S1_cantilever_medium", 1496, 801, 0.01, (1.0, 0.1, 0.1)),
    ("S2_cube", 231, 100, 1.0, (1.0, 1.0, 1.0)),
    ("S3_cantilever", 350, 181, 0.005, (0.5, 0.1, 0.1)),
]


@pytest.mark.parametrize(("name", "nodes", "elements", "volume", "size"), REFERENCE)
def test_reference_meshes(name, nodes, elements, volume, size):
    mesh = read(HERE / "data" / f"{name}.msh")
    assert (len(mesh.points), len(mesh.cells), mesh.cell_type) == (nodes, elements, "tetra10")
    assert (mesh.name, mesh.orphan_nodes.size) == (name, 0)
    assert mesh.volume() == pytest.approx(volume, rel=1e-13)
    assert mesh.straight_sided().all()
    np.testing.assert_allclose(mesh.bounding_box(), [(0.0, 0.0, 0.0), size], atol=1e-15)


def test_same_as_meshio():
    meshio = pytest.importorskip("meshio")
    path = HERE / "data" / "S3_cantilever.msh"
    mesh, other = read(path), meshio.read(path)
    np.testing.assert_array_equal(mesh.points, other.points)
    np.testing.assert_array_equal(mesh.cells, other.cells_dict["tetra10"])


def test_hook():
    mesh = read(SCENES / "hook.msh")
    assert 3000 <= len(mesh.cells) <= 4500
    assert mesh.cell_type == "tetra10"
    assert (SCENES / "hook.msh").stat().st_size < 1.5e6
    assert sorted(mesh.surface_sets) == ["fixed", "pull"]
    np.testing.assert_array_equal(mesh.elements("body"), np.arange(len(mesh.cells)))
    low, high = mesh.bounding_box()
    assert high[2] - low[2] == pytest.approx(0.2, abs=1e-4)
    np.testing.assert_array_equal(mesh.points[mesh.nodes("fixed"), 2], 0.2)
    normals = area_vectors(mesh, "pull")
    assert (normals[:, 2] > 0.0).all()  # the saddle faces up, so a load along -z presses on it
    assert normals.sum(axis=0)[2] > 0.9 * np.linalg.norm(normals, axis=1).sum() * np.cos(np.pi / 4)
    assert 0.2 < mesh.straight_sided().mean() < 0.9
    boundary = {tuple(row) for row in mesh.boundary()}
    assert {tuple(row) for name in ("fixed", "pull") for row in mesh.surface(name)} <= boundary


def area_vectors(mesh: Mesh, surface) -> np.ndarray:
    """Outward area vectors (m^2) of the faces' flat triangles."""
    x = mesh.points[mesh.faces(surface)[:, :3]]
    return 0.5 * np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])


# the same mesh through every format


@pytest.fixture(scope="module", params=["T4", "T10"])
def small(request) -> Mesh:
    return box((1.0, 2.0, 3.0), cells=(2, 1, 1), element=request.param, origin=(0.1, -0.7, 1 / 3))


@pytest.mark.parametrize("form", FORMATS)
def test_round_trip(small, form, tmp_path):
    mesh = read(write(Parts.of(small), tmp_path / "part", form))
    np.testing.assert_array_equal(mesh.points, small.points)
    np.testing.assert_array_equal(mesh.cells, small.cells)
    assert (mesh.cell_type, mesh.name) == (small.cell_type, "part")
    assert mesh.path == str(tmp_path / f"part{writers.SUFFIX[form]}")
    same_sets(mesh.surface_sets, small.surface_sets)
    same_sets(mesh.node_sets, {**small.node_sets, "body": np.arange(len(small.points))})
    same_sets(mesh.element_sets, {"body": np.arange(len(small.cells))})


@pytest.mark.parametrize("form", FORMATS)
def test_groups(small, form, tmp_path):
    """Two volumes with the name of a surface, an ungrouped volume, an edge set."""
    parts = Parts.of(small)
    kind, cells, _ = parts.blocks[0]
    edge = ("line", np.array([[0, 1]]), "edge")
    rest = [(kind, cells[2:5], "x-"), edge, (kind, cells[:2], "b"), (kind, cells[5:], None)]
    parts.blocks = rest + parts.blocks[1:2]
    mesh = read(write(parts, tmp_path / "groups", form))
    np.testing.assert_array_equal(mesh.cells, np.concatenate([cells[2:5], cells[:2], cells[5:]]))
    np.testing.assert_array_equal(mesh.elements("x-"), [0, 1, 2])
    np.testing.assert_array_equal(mesh.elements("b"), [3, 4])
    np.testing.assert_array_equal(mesh.nodes("edge"), [0, 1])
    assert list(mesh.surface_sets) == ["x-"]
    np.testing.assert_array_equal(np.unique(mesh.faces("x-")), small.nodes("x-"))
    both = np.union1d(np.unique(cells[2:5]), small.nodes("x-"))
    np.testing.assert_array_equal(mesh.nodes("x-"), both)
    assert sorted(mesh.element_sets) == ["b", "x-"]


@pytest.mark.parametrize("form", [f for f in FORMATS if f.startswith("msh")])
def test_unnamed_groups_of_gmsh(small, form, tmp_path):
    path = write(Parts.of(small), tmp_path / "unnamed", form)
    data = path.read_bytes()
    start, end = (data.index(b"$PhysicalNames"), data.index(b"$EndPhysicalNames\n") + len(b"$EndPhysicalNames\n"))
    path.write_bytes(data[:start] + data[end:])
    mesh = read(path)
    assert list(mesh.element_sets) == ["physical_3_1"]
    assert sorted(mesh.surface_sets) == [f"physical_2_{k}" for k in range(1, 7)]


def test_vtu_arrays(tmp_path):
    meshio = pytest.importorskip("meshio")
    small = box((1, 1, 1), cells=(1, 1, 1), element="T4")
    material = np.array([1, 1, 2, 2, 3, 0], dtype=np.int32)
    mesh = meshio.Mesh(
        small.points,
        [("tetra", small.cells)],
        cell_data={"material": [material], "gmsh:physical": [material], "temperature": [material * 0.5]},
        point_data={"held": (small.points[:, 0] == 0).astype(np.int8), "id": np.arange(8), "u": np.zeros((8, 3))},
    )
    meshio.vtu.write(tmp_path / "a.vtu", mesh)
    got = read(tmp_path / "a.vtu")
    assert sorted(got.element_sets) == [f"{n}_{v}" for n in ("material", "physical_3") for v in (1, 2, 3)]
    np.testing.assert_array_equal(got.elements("material_2"), [2, 3])
    np.testing.assert_array_equal(got.nodes("held"), small.nodes("x-"))
    np.testing.assert_array_equal(got.nodes("id_5"), [5])


INP = """*HEADING
*PART, NAME=P
*NODE, NSET=ALL
10, 0, 0, 0
20, 1, 0, 0
*NODE
30, 0, 1, 0
40, 0, 0, 1,
50, 1, 1, 1
*Element, type=C3D4, elset=ONE
7, 10, 20, 30, 40
*ELEMENT, TYPE=C3D4H,
 ELSET=TWO
9, 20, 50, 30, 40
*NSET, NSET=line, GENERATE
10, 30, 10
*NSET, NSET="big one"
line, 50
*ELSET, ELSET=both
ONE, 9
*ELSET, ELSET=range, GENERATE
7, 9, 2
*SURFACE, TYPE=ELEMENT, NAME=skin
ONE, S1
9, S4
*END PART
*ASSEMBLY, NAME=A
*INSTANCE, NAME=I, PART=P
*END INSTANCE
*NODE
1, 5, 5, 5
*NSET, NSET=held, INSTANCE=I
10, 40
*END ASSEMBLY
"""


def test_abaqus_keywords(tmp_path):
    path = tmp_path / "a.INP"
    path.write_text(INP)
    mesh = read(path)
    np.testing.assert_array_equal(mesh.cells, [[0, 1, 2, 3], [1, 4, 2, 3]])
    assert len(mesh.points) == 5
    for name, numbers in {"ONE": [0], "TWO": [1], "both": [0, 1], "range": [0, 1]}.items():
        np.testing.assert_array_equal(mesh.elements(name), numbers)
    for name, numbers in {"ALL": [0, 1], "line": [0, 1, 2], "big one": [0, 1, 2, 4], "held": [0, 3]}.items():
        np.testing.assert_array_equal(mesh.nodes(name), numbers)
    np.testing.assert_array_equal(mesh.surface("skin"), [[0, 0], [1, 3]])
    np.testing.assert_array_equal(np.sort(mesh.faces("skin"), axis=1), [[0, 1, 2], [1, 2, 3]])


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("form", FORMATS)
def test_interior_surface_takes_the_side_its_normal_leaves(form, flip, tmp_path):
    mesh = box((2.0, 1.0, 1.0), cells=(2, 1, 1), element="T4")
    inner = [f for f in mesh.faces([[e, f] for e in range(6) for f in range(4)]) if (mesh.points[f, 0] == 1.0).all()]
    assert len(inner) == 2  # seen from the left cell: normals along +x
    triangles = np.array(inner)[:, ::-1] if flip else np.array(inner)
    parts = Parts(mesh.points, [("tetra", mesh.cells, None), ("triangle", triangles, "middle")])
    got = read(write(parts, tmp_path / "inner", form))
    assert (got.surface("middle")[:, 0] >= 6).all() == flip
    assert (np.sign(area_vectors(got, "middle")[:, 0]) == (-1 if flip else 1)).all()


# scale and transform


def test_scale_and_transform(tmp_path):
    small = box((1.0, 2.0, 3.0), cells=(1, 1, 1))
    path = write(Parts.of(small), tmp_path / "mm", "msh41b")
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    shift = np.array([0.5, 0.25, -1.0])
    expected = 1e-3 * small.points @ turn.T + shift
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = turn, shift
    for transform in (whole, (turn, shift)):
        mesh = read(path, scale=1e-3, transform=transform)
        np.testing.assert_allclose(mesh.points, expected, atol=1e-15)
        assert mesh.volume() == pytest.approx(6e-9, rel=1e-12)
        same_sets(mesh.surface_sets, small.surface_sets)
    np.testing.assert_allclose(small.transformed(scale=1e-3, transform=whole).points, expected, atol=1e-15)


def test_a_mesh_far_from_the_origin_is_still_straight():
    mesh = box((1, 0.1, 0.1), cells=(10, 1, 1), origin=(1e4, -1e4, 3e3))
    assert check(mesh).straight_sided().all()


# the mesh object


def test_arrays_are_read_only_copies():
    points, cells = np.eye(4, 3, k=-1), np.array([[0, 1, 2, 3]])
    mesh = Mesh(points, cells, "tetra", node_sets={"a": np.array([1, 2])})
    points[:] = 9.0
    assert mesh.volume() == pytest.approx(1 / 6)
    for array in (mesh.points, mesh.cells, mesh.node_sets["a"], mesh.used_nodes, mesh.boundary()):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    assert "1 tetra" in repr(mesh)


@pytest.mark.parametrize("element", ["T4", "T10"])
def test_faces_point_outward_and_close(element):
    mesh = box((1.0, 2.0, 3.0), cells=(2, 3, 2), element=element)
    everything = np.argwhere(np.ones((len(mesh.cells), 4), dtype=bool))
    out = mesh.face_centroids(everything) - mesh.centroids()[everything[:, 0]]
    assert (np.einsum("ki,ki->k", out, area_vectors(mesh, everything)) > 0).all()
    vectors = area_vectors(mesh, mesh.boundary())
    np.testing.assert_allclose(vectors.sum(axis=0), 0.0, atol=1e-14)
    assert np.linalg.norm(vectors, axis=1).sum() == pytest.approx(22.0)
    if element == "T10":
        faces = mesh.points[mesh.faces(mesh.boundary())]
        np.testing.assert_allclose(faces[:, 3:], 0.5 * (faces[:, :3] + faces[:, [1, 2, 0]]), atol=1e-15)


def test_selections():
    mesh = box((1.0, 2.0, 3.0), cells=(2, 2, 2))
    left = mesh.nodes(lambda X: X[:, 0] == 0.0)
    np.testing.assert_array_equal(left, mesh.nodes("x-"))
    np.testing.assert_array_equal(mesh.nodes(mesh.points[:, 0] == 0.0), left)
    np.testing.assert_array_equal(mesh.nodes([3, 1]), [3, 1])
    assert mesh.nodes([]).size == 0
    assert mesh.nodes(lambda X: X[:, 0] < 0.0).size == 0
    np.testing.assert_array_equal(mesh.surface(lambda X: X[:, 2] > 3 - 1e-9), mesh.surface("z+"))
    np.testing.assert_array_equal(mesh.surface(mesh.surface("z+")), mesh.surface("z+"))
    assert mesh.surface([]).shape == (0, 2)
    assert len(mesh.elements(lambda X: X[:, 0] < 0.5)) == 24
    orphaned = Mesh(np.vstack([mesh.points, [[0.0, 0.0, 9.0]]]), mesh.cells, mesh.cell_type)
    np.testing.assert_array_equal(orphaned.nodes(lambda X: X[:, 0] == 0.0), left)
    np.testing.assert_array_equal(orphaned.orphan_nodes, [125])
    assert orphaned.bounding_box()[1][2] == 3.0


def test_cell_table():
    rng = np.random.default_rng(1)
    for kind in (CELL_TYPES["tetra"], CELL_TYPES["tetra10"]):  # the others: test_mesh_quads.py
        xi = rng.random((5, 3)) / 3
        np.testing.assert_allclose(kind.gradients(xi).sum(axis=1), 0.0, atol=1e-15)
        assert kind.rule[1].sum() == pytest.approx(1 / 6, rel=1e-14)
        assert kind.nodes == kind.corners + kind.has_mid_nodes * len(kind.edges)
        edges = [set(edge) for edge in kind.edges.tolist()]
        for face in kind.faces.tolist() if kind.has_mid_nodes else []:
            corners = face[: kind.face_corners]
            for k, mid in enumerate(face[kind.face_corners :]):
                assert edges[mid - kind.corners] == {corners[k], corners[(k + 1) % len(corners)]}


def test_volume_of_a_curved_element_is_exact():
    """X = xi + a quadratic map has a known integral of det J0: compare with a rule of many points."""
    mesh = box((1, 1, 1), cells=(1, 1, 1))
    x, y, z = mesh.points.T
    bent = Mesh(np.column_stack([x + 0.1 * y * z, y + 0.2 * x**2, z - 0.1 * y**2]), mesh.cells, "tetra10")
    check(bent)
    assert not bent.straight_sided().any()
    # det = 1 + 0.02 x z ... by hand: rows (1, .1 z, .1 y), (.4 x, 1, 0), (0, -.2 y, 1)
    # det = 1 - .1 z * .4 x + .1 y * (.4 x * -.2 y) -> 1 - .04 x z - .008 x y^2
    assert bent.volume() == pytest.approx(1 - 0.04 / 4 - 0.008 / 6, rel=1e-13)


# generators


@pytest.mark.parametrize("element", ["T4", "T10"])
def test_box(element):
    mesh = check(box((1.0, 0.5, 0.2), cells=(4, 3, 2), element=element, origin=(1, 2, 3), name="beam"))
    assert len(mesh.cells) == 6 * 24
    assert len(mesh.points) == (5 * 4 * 3 if element == "T4" else 9 * 7 * 5)
    assert (mesh.name, mesh.path, mesh.label) == ("beam", None, "beam")
    assert mesh.orphan_nodes.size == 0
    assert mesh.volume() == pytest.approx(0.1, rel=1e-13)
    assert mesh.straight_sided().all()
    areas = {"x": 0.1, "y": 0.2, "z": 0.5}
    for k, axis in enumerate("xyz"):
        for sign, end in (("-", 0), ("+", 1)):
            at = mesh.bounding_box()[end][k]
            vector = area_vectors(mesh, axis + sign).sum(axis=0)
            np.testing.assert_allclose(vector, (2 * end - 1) * areas[axis] * np.eye(3)[k], atol=1e-15)
            np.testing.assert_array_equal(mesh.nodes(axis + sign), np.flatnonzero(mesh.points[:, k] == at))
    table = np.concatenate(list(mesh.surface_sets.values()))
    np.testing.assert_array_equal(table[np.lexsort(table.T[::-1])], mesh.boundary())


def _orders(errors):
    return np.log2(np.array(errors[:-1]) / np.array(errors[1:]))


@pytest.mark.parametrize(("element", "order"), [("T4", 2.0), ("T10", 4.0)])
def test_cylinder(element, order):
    errors = []
    for n in (2, 4, 8, 16):
        mesh = check(cylinder(0.5, 2.0, cells=(n, 2), element=element, origin=(1.0, 2.0, 3.0)))
        errors.append(1.0 - mesh.volume() / (0.5 * np.pi))
        side = mesh.points[mesh.nodes("side")] - (1.0, 2.0, 3.0)
        np.testing.assert_allclose(np.hypot(side[:, 0], side[:, 1]), 0.5, rtol=1e-14)
        np.testing.assert_array_equal(mesh.points[mesh.nodes("bottom"), 2], 3.0)
        np.testing.assert_allclose(mesh.points[mesh.nodes("top"), 2], 5.0, rtol=1e-15)
        assert sum(len(s) for s in mesh.surface_sets.values()) == len(mesh.boundary())
    assert min(errors) > 0
    np.testing.assert_allclose(_orders(errors), order, atol=0.15)
    if element == "T10":
        assert errors[-1] < 1e-6
        assert 0.8 < mesh.straight_sided().mean() < 1.0


@pytest.mark.parametrize(("element", "order"), [("T4", 2.0), ("T10", 4.0)])
def test_sphere(element, order):
    errors = []
    for n in (2, 4, 8, 16):
        mesh = check(sphere(2.0, cells=n, element=element, center=(0.0, 1.0, 0.0)))
        assert len(mesh.cells) == 6 * n**3
        errors.append(1.0 - mesh.volume() / (4 / 3 * np.pi * 8.0))
        radius = np.linalg.norm(mesh.points[mesh.nodes("surface")] - (0.0, 1.0, 0.0), axis=1)
        np.testing.assert_allclose(radius, 2.0, rtol=1e-14)
        np.testing.assert_array_equal(mesh.surface("surface"), mesh.boundary())
    assert min(errors) > 0
    np.testing.assert_allclose(_orders(errors)[1:], order, atol=0.2)


def test_generators_are_deterministic():
    for make in (
        lambda: box((1, 1, 1), cells=(2, 2, 2)),
        lambda: cylinder(1, 1, cells=(2, 1)),
        lambda: sphere(1, cells=2),
    ):
        a, b = make(), make()
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.cells, b.cells)
        same_sets(a.surface_sets, b.surface_sets)


def lines_run(call):
    """Result of a call, and the number of Python lines run in it."""
    count = 0

    def trace(frame, event, arg):
        nonlocal count
        count += event == "line"
        return trace

    outer = sys.gettrace()
    sys.settrace(trace)
    try:
        return call(), count
    finally:
        sys.settrace(outer)


def test_a_million_unknowns_take_no_more_python_than_a_thousand():
    """Nothing loops over nodes or elements: seconds, not minutes, for a large mesh."""
    build = lambda cells: lambda: check(box((3.0, 2.0, 1.0), cells=cells)).boundary()  # noqa: E731
    build((6, 4, 2))()  # what runs once
    _, few = lines_run(build((6, 4, 2)))
    faces, many = lines_run(build((60, 40, 20)))
    assert len(faces) == 2 * 2 * (2400 + 1200 + 800)
    assert 0 < many < 1.5 * few
    assert 3 * len(box((3.0, 2.0, 1.0), cells=(60, 40, 20)).points) > 1e6


def test_import_loads_no_optional_reader():
    code = "import sys, warpfea.mesh; print([m for m in ('meshio', 'pxr', 'PIL', 'rich') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=SCENES.parent, check=True)
    assert out.stdout.strip() == "[]"


def test_reference_node_order():
    mesh = read(HERE / "data" / "S1_cantilever_coarse.msh")
    np.testing.assert_array_equal(mesh.points[5], (1.0, 0.0, 0.0))  # "corner_node_at_1_0_0": index0 = 5
    assert len(mesh.nodes(lambda X: np.abs(X[:, 0]) < 1e-9)) == 13  # "clamped_nodes"
    with pytest.raises(MeshError, match="physical_3_1"):
        mesh.elements("body")
