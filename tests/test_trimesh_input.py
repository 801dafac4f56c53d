"""Rigid triangle meshes: bad input, what is shown, and what it costs."""

import math
import time

import numpy as np
import pytest
from triangle_meshes import BOX, DT, SIDE, TURN, ball, boxed, moved, octahedron, search, sheet, thrown

import warpfea as wf
from warpfea.cli import main
from warpfea.outputs.obstacles import Obstacles

# bad input


def point_meshes():
    points, triangles = octahedron()
    extra = np.array([(0, 1, 5)])
    turned = triangles.copy()
    turned[2] = turned[2][::-1]
    third = np.concatenate([points, [(3.0, 3.0, 0.0)]])
    nan = points.copy()
    nan[4, 1] = np.nan
    return {
        "none": (points, np.zeros((0, 3), dtype=int), "there are no triangles"),
        "nothing": (points, None, "there are no triangles"),
        "quads": (points, [(0, 1, 2, 3)], r"triangles have shape \(1, 4\)"),
        "fractions": (points, [(0.0, 1.0, 2.0)], "type float64, expected"),
        "flat points": (points[:, :2], triangles, r"points have shape \(6, 2\)"),
        "words": ([("a", "b", "c")], triangles, "must be"),
        "range": (points, [(0, 1, 6)], r"triangle 0 = \[0, 1, 6\] has a point number out of range, 0 \.\. 5"),
        "negative": (points, [(0, 1, -1)], "out of range"),
        "nan": (nan, triangles, r"point 4 = \[.*nan.*\] is not finite"),
        "degenerate": (points, [(0, 1, 2), (0, 1, 0)], r"triangle 1 = \[0, 1, 0\] has no area"),
        "in a line": ([(0, 0, 0), (1, 0, 0), (3, 0, 0)], [(0, 1, 2)], "triangle 0 .* has no area"),
        "orientation": (points, turned, r"inconsistent orientation of triangles \d and \d at the edge between points"),
        "three": (third, [(0, 1, 2), (1, 0, 5), (0, 1, 6)], "points 0 and 1 has more than two triangles"),
        "inside out": (points, triangles[:, ::-1], r"closed and inside out, its volume is -1\.33 m\^3"),
        "folded": ([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 2, 0)], [(0, 1, 2), (1, 0, 3)], "folds back on itself"),
        "many": (points, np.concatenate([triangles, extra]), "more than two triangles"),
    }


@pytest.mark.parametrize("name", point_meshes())
def test_bad_meshes_are_named(name):
    points, triangles, message = point_meshes()[name]
    with pytest.raises(wf.ModelError, match="^TriMesh: .*" + message):
        wf.TriMesh(points, triangles)


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, "big"])
def test_bad_scales_are_named(scale):
    with pytest.raises(wf.ModelError, match="TriMesh: scale = "):
        wf.TriMesh(*octahedron(), scale=scale)


def test_a_lumped_contact_needs_an_inside():
    with pytest.raises(wf.ModelError, match="collider 'floor' is a sheet of triangles, and model = 'sphere'"):
        thrown(wf.TriMesh(*sheet()), model="sphere", radius=0.05)


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".vtk", ".vtu"])
def test_files(tmp_path, suffix):
    meshio = pytest.importorskip("meshio")
    points, triangles = octahedron()
    file = tmp_path / f"rock{suffix}"
    meshio.Mesh(points, [("triangle", triangles)]).write(file)
    mesh = wf.TriMesh(file, scale=1e-3)
    assert mesh.closed
    assert mesh.volume == pytest.approx(4.0 / 3.0 * 1e-9, rel=1e-6)
    assert len(mesh.triangles) == 8


def test_bad_files_are_named(tmp_path):
    meshio = pytest.importorskip("meshio")
    with pytest.raises(wf.ModelError, match=r"TriMesh: .*none\.stl: no such mesh file"):
        wf.TriMesh(tmp_path / "none.stl")
    (tmp_path / "bad.vtu").write_text("nothing")
    with pytest.raises(wf.ModelError, match=r"TriMesh: .*bad\.vtu: can't be read"):
        wf.TriMesh(str(tmp_path / "bad.vtu"))
    meshio.Mesh(np.eye(3), [("line", [[0, 1]])]).write(tmp_path / "line.vtk")
    with pytest.raises(wf.ModelError, match=r"has no triangles, but line"):
        wf.TriMesh(tmp_path / "line.vtk")
    with pytest.raises(wf.ModelError, match="triangles = must be left out"):
        wf.TriMesh(tmp_path / "line.vtk", [(0, 1, 2)])
    meshio.Mesh(sheet(2)[0], [("quad", [[0, 1, 4, 3]])]).write(tmp_path / "quad.vtk")
    assert len(wf.TriMesh(tmp_path / "quad.vtk").triangles) == 2


def test_corners_in_one_place_are_one():
    """As files hold them that tell each triangle's corners: the mesh is closed all the same."""
    points, triangles = octahedron()
    mesh = wf.TriMesh(points[triangles].reshape(-1, 3), np.arange(24).reshape(8, 3))
    assert mesh.closed
    assert mesh.volume == pytest.approx(4.0 / 3.0)


# what is shown, and what it costs


def test_writers_draw_it_where_it_is(tmp_path):
    from pxr import Usd, UsdGeom

    cube, model = thrown(boxed(cells=2), TURN)
    sim = wf.Simulation(model, dt=DT)
    path = tmp_path / "mesh.usda"
    sim.run(0.004, outputs=[wf.USDWriter(path, fps=500.0), wf.VTUWriter(tmp_path / "vtu", every=2)])
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath("/World/world_0000/floor/shape")
    drawn = UsdGeom.Mesh(prim)
    assert prim.GetCustomDataByKey("warpfea:collider") == "TriMesh"
    assert len(drawn.GetFaceVertexCountsAttr().Get()) == 48
    last = stage.GetEndTimeCode()
    matrix = np.array(UsdGeom.XformCache(last).GetLocalToWorldTransform(prim))
    points = np.asarray(drawn.GetPointsAttr().Get(last)) @ matrix[:3, :3] + matrix[3, :3]
    place, turn, _ = sim.collider_poses()
    shape = model.description.colliders[0].shape
    wanted = (shape.points - shape.frame()[0]) @ turn[0, 0].T + place[0, 0]
    assert np.abs(points[:, None] - wanted).max(axis=2).min(axis=1).max() < 1e-6
    assert np.abs(turn[0, 0] - np.eye(3)).max() > 0.01
    assert (tmp_path / "vtu" / "vtu_colliders.pvd").exists()


def test_a_surface_that_lies_further_out():
    """`model.set_parameter("floor.offset", ...)` moves it along its normals, and its picture with it."""
    wanted, found = [], []
    for shape, out in ((BOX, wanted), (boxed(cells=4), found)):
        cube, model = thrown(shape)
        model.set_parameter("floor.offset", 0.0015)
        sim = wf.Simulation(model, dt=DT)
        sim.step(15)
        out += [
            sim.positions(cube),
            np.sort(Obstacles(sim, np.zeros(3), np.full(3, SIDE)).points()[0][0, :, 2])[[0, -1]],
        ]
    assert np.abs(found[0] - wanted[0]).max() < 1e-9 * SIDE
    np.testing.assert_allclose(found[1], wanted[1], atol=1e-12)


def test_info_counts_triangles(capfd, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(
        "import numpy as np, warpfea as wf\n"
        "@wf.scene(dt=1e-3, t_end=0.01)\n"
        "def drop():\n"
        "    b = wf.ModelBuilder()\n"
        "    law = wf.SVK(E=1e6, nu=.3, density=1000)\n"
        "    cube = b.add_solid(wf.mesh.box((.1,) * 3, cells=(1, 1, 1)), material=law, name='cube')\n"
        "    rock = wf.TriMesh(*wf.Box((.05, .05, -.1), (1, 1, .2)).mesh())\n"
        "    b.add_contact(cube, b.add_collider(rock), name='pad')\n"
        "    return b\n"
    )
    monkeypatch.chdir(tmp_path)
    capfd.readouterr()
    assert main(["info", "mine.py:drop", "--device", "cpu"]) == 0
    out = capfd.readouterr().out
    assert "body cube on mesh (12 triangles), law default, patch" in out
    assert "contact_float64_colliders_meshes" in out


def test_a_scene_without_a_mesh_has_nothing_of_it():
    names = {}
    for name, shape in (("box", BOX), ("closed", boxed()), ("sheet", wf.TriMesh(*sheet()))):
        sim = moved(2, shape)[1]
        names[name] = {module.name.rpartition(".")[2] for module in sim.stepper.modules()}
        assert hasattr(sim.model.terms.named("contact").tables.shapes, "mesh") == (name != "box")
    assert not any("meshes" in module for module in names["box"])
    assert {m.replace("_meshes", "") for m in names["closed"]} == names["box"]
    assert names["sheet"] == names["closed"]


def test_no_search_goes_over_all_triangles():
    """64 times as many triangles cost far less than 8 times the time; the machine may be busy."""
    rng = np.random.default_rng(1).normal(size=(20000, 3))
    around = 1.001 * rng / np.linalg.norm(rng, axis=1, keepdims=True)
    small, large = (seconds(ball(1.0, (0, 0, 0), halvings), around) for halvings in (3, 6))
    assert large < 8.0 * small, (small, large)


def seconds(mesh, places):
    """Least of a few times of a search, less that of what surrounds it."""
    mesh.tables  # noqa: B018

    def once(count):
        start = time.perf_counter()
        search(mesh, places[:count], places[:count] * 1.001)
        return time.perf_counter() - start

    return min(once(len(places)) for _ in range(4)) - min(once(1) for _ in range(4))
