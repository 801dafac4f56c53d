"""Meshes in: prisms and pyramids as tetrahedra, corners of cells of higher order, closed surfaces."""

import importlib.util
import itertools
import json
import pathlib
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from cli_runs import run
from mesh_writers import Parts, write

import warpfea as wf
from warpfea.base.errors import MeshError
from warpfea.mesh import from_meshio, from_surface, read

meshio = pytest.importorskip("meshio")
HERE = pathlib.Path(__file__).resolve().parent
BRICK = wf.mesh.box((3, 2, 1), cells=(3, 2, 1), element="H3843")


def mixed(seed):
    """Points and cells of a brick whose hexahedra stay, become two prisms, or six pyramids; nodes in a random order."""
    points = [*BRICK.points]
    cells = {"hexahedron": [], "wedge": [], "pyramid": []}
    for k, c in enumerate(BRICK.cells):
        if k % 3 == 0:
            cells["hexahedron"].append(c)
        elif k % 3 == 1:
            cells["wedge"] += [c[[0, 1, 2, 4, 5, 6]], c[[0, 2, 3, 4, 6, 7]]]
        else:
            points.append(BRICK.points[c].mean(axis=0))
            cells["pyramid"] += [[*c[list(face[::-1])], len(points) - 1] for face in BRICK.kind.faces]
    order = np.random.default_rng(seed).permutation(len(points))
    number = np.argsort(order)
    return np.array(points)[order], {kind: number[np.array(rows)] for kind, rows in cells.items()}


@pytest.mark.parametrize("seed", range(4))
def test_prisms_and_pyramids_become_tetrahedra_with_matching_faces(seed, tmp_path):
    points, cells = mixed(seed)
    front = [c[list(f)] for c in BRICK.cells for f in BRICK.kind.faces if (BRICK.points[c[list(f)], 1] == 0.0).all()]
    found = from_meshio(meshio.Mesh(points, list(cells.items())))
    assert found.cell_type == "tetra"
    assert found.volume() == pytest.approx(6.0, rel=1e-13)
    assert found.volumes().min() > 0.0
    corners = found.points[found.faces(found.boundary())]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(22.0, rel=1e-13)  # nothing but the outer surface: faces match
    if seed == 0:
        order = {tuple(x): k for k, x in enumerate(points)}
        quads = np.array([[order[tuple(BRICK.points[n])] for n in face] for face in front])
        blocks = [(kind, rows, kind) for kind, rows in cells.items()] + [("quad", quads, "front")]
        path = tmp_path / "mixed.vtu"
        tags = [np.full(len(rows), k + 1) for k, (_, rows, _) in enumerate(blocks)]
        data = {"part": tags}
        meshio.Mesh(points, [(kind, rows) for kind, rows, _ in blocks], cell_data=data).write(path)
        mesh = read(path)
        assert mesh.volumes()[mesh.element_sets["part_2"]].sum() == pytest.approx(2.0)  # prisms
        assert len(mesh.surface_sets["part_4"]) == 2 * len(quads)
        b = wf.ModelBuilder()
        assert b.add_solid(str(path), material=wf.SVK(E=1e6, nu=0.3, density=1.0)).family.name == "T4"


def raised(kind, base, count):
    """A mesh of one cell of higher order, whose mid nodes lie anywhere."""
    corners = base.points[base.cells[0]]
    extra = np.random.default_rng(0).random((count - len(corners), 3)) + 5.0
    return meshio.Mesh(np.concatenate([extra, corners]), [(kind, [[*range(len(extra), count), *range(len(extra))]])])


def test_cells_of_higher_order_are_refused_by_name_and_read_by_their_corners():
    grid = wf.mesh.grid((1, 1), cells=(1, 1))
    for kind, base, count in (
        ("hexahedron20", BRICK, 20), ("hexahedron27", BRICK, 27), ("quad8", grid, 8), ("quad9", grid, 9),
    ):  # fmt: skip
        mesh = raised(kind, base, count)
        with pytest.raises(MeshError, match=rf"{kind}.*corners=True\) takes "):
            from_meshio(mesh)
        found = from_meshio(mesh, corners=True)
        assert found.cell_type == kind.rstrip("0123456789")
        assert len(found.points) == base.kind.corners
        assert found.points[found.cells[0]] == pytest.approx(base.points[base.cells[0]])
    prism = meshio.Mesh(BRICK.points, [("wedge", [[0, 1, 4, 12, 13, 16]]), ("tetra10", [list(range(10))])])
    with pytest.raises(MeshError, match=r"unknown cell type 'wedge'.*without cells of higher order"):
        from_meshio(prism)
    curved = wf.mesh.sphere(1.0, cells=2, element="T10")
    straight = from_meshio(meshio.Mesh(curved.points, [("tetra10", curved.cells)]), corners=True)
    assert straight.volume() == pytest.approx(wf.mesh.linear(curved).volume())
    assert len(straight.points) == len(wf.mesh.linear(curved).points)


def test_node_sets_follow_the_corners(tmp_path):
    curved = wf.mesh.box((1, 1, 1), cells=(1, 1, 1), element="T10")
    path = write(Parts.of(curved), tmp_path / "box", "msh41")
    mesh = read(path, corners=True)
    assert mesh.cell_type == "tetra"
    assert {len(mesh.node_sets[name]) for name in curved.surface_sets} == {4}
    assert (mesh.points[mesh.node_sets["x-"], 0] == 0.0).all()


def test_meshes_of_the_fork_of_meshio_are_taken():
    kind = type("Mesh", (meshio.Mesh,), {"__module__": "meshlane._mesh"})
    points = np.vstack([np.zeros(3), np.eye(3)])
    assert from_meshio(kind(points, [("tetra", [[0, 1, 2, 3]])])).volume() == pytest.approx(1 / 6)
    with pytest.raises(MeshError, match=r"expected a meshio\.Mesh"):
        from_meshio(type("Mesh", (), {})())


def ball(cells=3):
    mesh = wf.mesh.sphere(0.05, cells=2 * cells, element="T4")
    return mesh.points, mesh.faces(mesh.boundary())


def test_surfaces_that_enclose_nothing_are_refused_before_anything_is_meshed(tmp_path, monkeypatch):
    points, triangles = ball()
    for given, text in (
        ((points, triangles[1:]), "the surface is open"),
        ((points, triangles[:, ::-1]), "its triangles must turn outward"),
    ):
        with pytest.raises(MeshError, match=text):
            from_surface(given, size=0.02)
    quads = np.hstack([triangles, triangles[:, :1]])
    bad = np.where(points > 0.04, np.nan, points)
    for given in (3, (points,), (points, quads), (points[:, :2], triangles), (points, triangles + 1), (bad, triangles)):
        with pytest.raises(MeshError, match=r"a surface is a file, or points \(n, 3\) and triangles \(m, 3\)"):
            from_surface(given, size=0.02)
    with pytest.raises(MeshError, match="element = 'T5' must be"):
        from_surface((points, triangles), size=0.02, element="T5")
    with pytest.raises(MeshError, match=r"size = 20 m is more than the whole surface, 0\.17"):
        from_surface((points, triangles), size=20.0)
    with pytest.raises(MeshError, match="size must be positive"):
        from_surface((points, triangles), size=0.0)
    monkeypatch.setitem(sys.modules, "pytetwild", None)
    with pytest.raises(MeshError, match=r"pip install 'warpfea\[mesh\]'"):
        from_surface((points, triangles), size=0.02)


class Mesher:
    """A mesher that returns a mesh of a ball of another size."""

    def __init__(self, factor):
        self.factor = factor

    def tetrahedralize(self, points, triangles, *, edge_length_abs, epsilon, vtk_ordering):
        assert vtk_ordering  # else volumes are negative
        mesh = wf.mesh.sphere(0.5 * self.factor, cells=6, element="T4")
        assert np.linalg.norm(np.ptp(points, axis=0)) == pytest.approx(1.0)  # whatever the unit
        assert edge_length_abs == pytest.approx(0.2 * np.ptp(points[:, 0]))
        return np.ptp(points[:, 0]) * mesh.points, mesh.cells


def test_the_volume_of_the_mesh_is_that_of_the_surface(tmp_path, monkeypatch):
    points, triangles = ball()
    monkeypatch.setitem(sys.modules, "pytetwild", Mesher(1.0))
    mesh = from_surface((points, triangles), size=0.02)
    assert mesh.cell_type == "tetra10"
    half = itertools.combinations(range(4), 2)
    mids = np.array([mesh.points[mesh.cells[:, list(pair)]].mean(axis=1) for pair in half])
    assert np.sort(mids, axis=0) == pytest.approx(np.sort(np.swapaxes(mesh.points[mesh.cells[:, 4:]], 0, 1), axis=0))
    meshio.Mesh(1e3 * points, [("triangle", triangles)]).write(tmp_path / "ball.stl")
    mesh = from_surface(tmp_path / "ball.stl", size=0.02, scale=1e-3, element="T4")
    assert (mesh.cell_type, mesh.name) == ("tetra", "ball")
    monkeypatch.setitem(sys.modules, "pytetwild", Mesher(0.9))
    with pytest.raises(MeshError, match=r"the mesh has .* m\^3, the surface encloses"):
        from_surface((points, triangles), size=0.02)


def test_surface_by_the_mesher():
    """The volume is the polyhedron's own: 1e-4 was measured. pyvista is not needed."""
    if importlib.util.find_spec("pytetwild") is None:
        pytest.skip("extra mesh")
    points, triangles = ball()
    mesh = from_surface((points, triangles), size=0.02)
    assert mesh.cell_type == "tetra10"
    assert mesh.volume() == pytest.approx(np.linalg.det(points[triangles]).sum() / 6.0, rel=2e-3)


def test_a_surface_runs_from_the_command_line(tmp_path, capfd, monkeypatch):
    mesh = wf.mesh.box((0.1, 0.02, 0.02), cells=(2, 1, 1), element="T4")
    triangles = mesh.faces(mesh.boundary())
    path = tmp_path / "bar.stl"
    meshio.Mesh(1e3 * mesh.points, [("triangle", triangles)]).write(path)
    unit = mesh.points / np.linalg.norm(np.ptp(mesh.points, axis=0))
    monkeypatch.setitem(sys.modules, "pytetwild", SimpleNamespace(tetrahedralize=lambda *_, **__: (unit, mesh.cells)))
    words = ["run", str(path), "--material", "svk:E=1e7,nu=0", "--gravity", "0,0,0", "--device", "cpu"]
    code, _, err = run(capfd, *words)
    assert code == 2
    assert "or by --size 2e-3" in err
    words += ["--scale", "1e-3", "--size", "0.01", "--static", "--load-steps", "1", "--json", "-"]
    code, out, _ = run(capfd, *words, "--clamp", "x-", "--traction", "x+:1e3,0,0")
    assert code == 0
    summary = json.loads(out)
    assert summary["parameters"]["size"] == 0.01
    assert summary["probes"]["x+"]["displacement"][0] == pytest.approx(1e-5, rel=1e-3)
    code, _, err = run(capfd, "run", str(HERE / "data" / "S2_cube.msh"), "--size", "1", "--material", "svk:E=1e7,nu=0")
    assert code == 2
    assert "is a mesh already; --size is for surfaces" in err
