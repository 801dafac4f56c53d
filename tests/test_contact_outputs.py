"""Outputs of contact: pressure and gap at nodes, colliders in USD, VTU and pictures."""

from __future__ import annotations

import re

import numpy as np
import pytest

import warpfea as wf
from warpfea.outputs.frames import DrawnSurface
from warpfea.outputs.obstacles import Obstacles
from warpfea.outputs.render import render_usd
from warpfea.simulation.results import Results

DEPTH = 1e-3
RUBBER = wf.SVK(E=1e6, nu=0.3, density=1000.0)


def body_of(b, kind):
    """A body over the plane z = 0, its surface that touches, and the area of that."""
    if kind == "beam":
        section = wf.Rectangle(0.2, 0.1)
        beam = b.add_beam([(0, 0, 0.05), (1, 0, 0.05)], elements=3, section=section, normal=(0, 0, 1), material=RUBBER)
        return beam, beam.surface("normal-"), 0.2
    if kind == "shell":
        grid = wf.mesh.grid((1.0, 0.5), cells=(3, 2), origin=(0, 0, 0.05))
        shell = b.add_shell(grid, thickness=0.1, material=RUBBER)
        return shell, shell.surface("bottom"), 0.5
    mesh = wf.mesh.box((1.0, 0.5, 0.5), cells=(2, 1, 1), element=kind)
    solid = b.add_solid(mesh, material=RUBBER, element=kind)
    return solid, solid.surface("z-"), 0.5


@pytest.mark.parametrize("kind", ["T4", "T10", "ENMC", "H3843", "beam", "shell"])
def test_a_body_pressed_flat_has_one_pressure(kind):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body, surface, area = body_of(b, kind)
    b.add_contact(surface, b.add_collider(wf.HalfSpace((0, 0, 1))), name="base")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    moved = sim.state.displacement.numpy()
    moved[:, body.slots[body.slot_kind == 0]] = (0.0, 0.0, -DEPTH)
    sim.state.displacement.assign(moved)
    (term,) = (term for term in sim.model.terms.all if term.name == "contact")
    expected = term.at_points(sim.state)[1][0, :, 2].sum() / area
    assert expected > 0.0
    pressure, gap = sim.field("contact_pressure", body)[0], sim.field("gap", body)[0]
    low = np.ones(len(pressure), dtype=bool) if kind in ("beam", "shell") else body.mesh.points[:, 2] < 1e-9
    assert pressure[low] == pytest.approx(expected, rel=1e-9)
    assert gap[low] == pytest.approx(-DEPTH, rel=1e-9)
    assert not pressure[~low].any()
    assert np.isnan(gap[~low]).all()
    drawn = sim.skin_field("contact_pressure", body)[0]
    below = sim.skin_points(body)[0, :, 2] < 1e-6
    assert drawn[below] == pytest.approx(expected, rel=1e-9)
    above = sim.skin_points(body)[0, :, 2] > (0.05 if kind in ("beam", "shell") else 0.4)
    assert np.abs(drawn[above]).max() < 1e-6 * expected


def test_lumped_contact_shows_at_the_node_that_it_acts_on():
    b = wf.ModelBuilder()
    ball = b.add_solid(wf.mesh.sphere(0.1, cells=2, center=(0, 0, 0.1)), material=RUBBER)
    b.add_contact(ball, b.add_collider(wf.HalfSpace((0, 0, 1))), model="sphere", radius=0.1, mu=0.5)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.step(5)
    pressure, gap = sim.field("contact_pressure", ball)[0], sim.field("gap", ball)[0]
    (hit,) = np.flatnonzero(pressure)
    assert hit == int(np.argmin(sim.positions(ball)[0, :, 2]))
    assert gap[hit] == np.nanmin(gap) < 0.0


def test_bodies_and_models_without_contact():
    b = wf.ModelBuilder()
    touching = b.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), material=RUBBER)
    free = b.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1), origin=(3, 0, 0)), material=RUBBER)
    b.add_contact(touching, b.add_collider(wf.HalfSpace((0, 0, 1), -1.0)))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.step()
    assert not sim.field("contact_pressure", free).any()
    assert np.isnan(sim.field("gap", free)).all()
    part = b.add_rigid(wf.Box((6, 0, 0), (1, 1, 1)), density=1e3)
    with pytest.raises(wf.ModelError, match="field 'gap' of rigid part 'rigid' is one of its nodes"):
        Results(model := b.finalize(device="cpu"), model.state()).sample(part.at((6, 0, 0)), "gap")
    b = wf.ModelBuilder()
    b.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), material=RUBBER)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    assert sim.collider_poses() is None
    with pytest.raises(wf.ModelError, match="contact_pressure"):
        sim.check_field("contact_pressure")


# colliders


def scene(worlds=1, **floor):
    """A small block named "press" on a floor; a box of that name comes down on it, a wheel turns beside it."""
    b = wf.ModelBuilder()
    block = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=RUBBER, name="press")
    plane = b.add_collider(wf.HalfSpace(**(floor or {"normal": (0, 0, 1)})), name="floor")
    press = wf.Box((0.05, 0.05, 0.13), (0.2, 0.2, 0.04))
    press = b.add_collider(press, path=([0, 1], [(0, 0, 0), (0, 0, -0.5)]), name="press")
    turn = wf.Rotation(anchor=(0.2, 0, 0.05), axis=(0, 1, 0), angle=([0, 1], [0, 6.0]))
    wheel = wf.Cylinder(start=(0.25, -0.1, 0.05), end=(0.25, 0.2, 0.05), radius=0.08)
    wheel = b.add_collider(wheel, path=turn, name="wheel")
    for k, collider in enumerate((plane, press, wheel)):
        b.add_contact(block.surface(("z-", "z+", "x+")[k]), collider, mu=0.3, restitution=0.5)
    return wf.Simulation(b.finalize(device="cpu", worlds=worlds), dt=5e-3)


def test_shapes_are_drawn_where_they_are():
    sim = scene()
    low, high = np.zeros(3), np.full(3, 0.1)
    obstacles = Obstacles(sim, low, high)
    start = obstacles.points()
    shapes = [collider.shape for collider in sim.model.description.colliders]
    for shape, points in list(zip(shapes, start))[1:]:
        mesh, _ = shape.mesh(48)
        assert np.abs(points[0][:, None] - mesh).max(axis=2).min(axis=1).max() < 1e-12
    assert np.abs(start[0][0, :, 2]).max() < 1e-15
    sim.step(10)
    floor, press, wheel = obstacles.points()
    assert np.array_equal(floor, start[0])
    np.testing.assert_allclose(press - start[1], np.broadcast_to((0, 0, -0.025), press.shape), atol=1e-12)
    angle = 6.0 * 0.05
    c, s = np.cos(angle), np.sin(angle)
    anchor = np.array((0.2, 0, 0.05))
    turned = (start[2] - anchor) @ np.array([(c, 0, s), (0, 1, 0), (-s, 0, c)]).T + anchor
    np.testing.assert_allclose(wheel, turned, atol=1e-12)
    for obstacle, points in zip(obstacles.all[1:], (press, wheel)):  # closed and outward
        a, b, c = (points[0][obstacle.triangles[:, k]] for k in range(3))
        volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
        assert volume == pytest.approx(
            {"press": 0.2 * 0.2 * 0.04, "wheel": np.pi * 0.08**2 * 0.3}[obstacle.name], rel=0.01
        )


def test_usd_has_colliders(tmp_path):
    from PIL import Image
    from pxr import Usd, UsdGeom

    sim = scene(worlds=2)
    path = tmp_path / "contact.usda"
    writer = wf.USDWriter(path, fields=("contact_pressure", "gap"), color="gap", fps=100.0)
    sim.run(0.04, outputs=[writer])  # validated as it is closed
    stage = Usd.Stage.Open(str(path))
    place, turn, _ = sim.collider_poses()
    offsets = [stage.GetPrimAtPath(f"/World/world_{w:04d}").GetAttribute("xformOp:translate").Get() for w in (0, 1)]
    assert offsets[1][0] > 0.29  # apart with their colliders
    for name, k in (("floor", 0), ("press_", 1), ("wheel", 2)):
        for world in (0, 1):
            prim = stage.GetPrimAtPath(f"/World/world_{world:04d}/{name}")
            assert prim.GetDisplayName() == name.strip("_")
            mesh = UsdGeom.Mesh(prim.GetChild("shape"))
            assert not mesh.GetPointsAttr().GetTimeSamples()
            ops = UsdGeom.Xformable(prim).GetOrderedXformOps()
            assert [bool(op.GetTimeSamples()) for op in ops] == [k > 0] * 2
            matrix = np.array(UsdGeom.XformCache(stage.GetEndTimeCode()).GetLocalToWorldTransform(prim))
            np.testing.assert_allclose(matrix[3, :3], place[world, k] + offsets[world], atol=1e-12)
            np.testing.assert_allclose(matrix[:3, :3].T, turn[world, k], atol=1e-12)
    assert stage.GetPrimAtPath("/World/world_0000/press/skin")
    picture = tmp_path / "contact.png"
    render_usd(path, picture, size=(320, 180), field="contact_pressure")
    assert np.asarray(Image.open(picture)).shape == (180, 320, 3)


def test_usd_of_a_resumed_run_goes_on_with_colliders(tmp_path):
    from pxr import Usd

    sim = scene()
    path = tmp_path / "contact.usda"
    sim.run(0.02, outputs=[wf.USDWriter(path, fps=200.0)])
    sim.run(0.04, outputs=[wf.USDWriter(path, fps=200.0, extend=True)])
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath("/World/world_0000/press_")
    assert len(prim.GetAttribute("xformOp:translate").GetTimeSamples()) == 9
    other = wf.ModelBuilder()
    block = other.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=RUBBER, name="press")
    other.add_contact(block.surface("z-"), other.add_collider(wf.HalfSpace((0, 0, 1)), name="ground"))
    other = wf.Simulation(other.finalize(device="cpu"), dt=5e-3)
    path = tmp_path / "other.usda"
    other.run(0.02, outputs=[wf.USDWriter(path)])
    text = path.read_text().replace('"ground"', '"hill"')
    path.write_text(text)
    with pytest.raises(wf.OutputError, match="other colliders"):
        other.run(0.04, outputs=[wf.USDWriter(path, extend=True)])


def test_vtu_has_colliders_as_a_series_of_their_own(tmp_path):
    import meshio

    folder = tmp_path / "out"
    sim = scene(worlds=2)
    sim.run(0.02, outputs=[wf.VTUWriter(folder, fields=("contact_pressure", "gap"))])
    text = (folder / "out_colliders.pvd").read_text()
    files = re.findall(r'timestep="([^"]+)" group="" part="\d+" file="([^"]+)"', text)
    assert len(files) == 5 * 3 * 2
    assert {file for _, file in files if "floor" in file} == {f"collider_floor_{w:04d}_000000.vtu" for w in (0, 1)}
    assert len({file for _, file in files if "press" in file}) == 10
    last = [file for time, file in files if float(time) == pytest.approx(0.02) and "press_0001" in file]
    press = meshio.read(folder / last[0])
    assert press.points[:, 2].min() == pytest.approx(0.13 - 0.02 - 0.5 * 0.02)
    body = meshio.read(folder / "press_0000_000004.vtu")
    assert {"contact_pressure", "gap"} <= set(body.point_data)
    assert "collider" not in (folder / "out.pvd").read_text()


def vivid(path):
    """Share of pixels in the colours of a field."""
    from PIL import Image

    image = np.asarray(Image.open(path)).astype(int)
    pixels = image[:, : int(0.8 * image.shape[1])]
    return float((pixels.max(axis=2) - pixels.min(axis=2) > 60).mean())


@pytest.mark.parametrize(
    "plane",
    [
        {"normal": (0, 0, 1)},
        {"normal": (0.2, 0, 1), "offset": -0.2},
        {"normal": (0, 1, 0), "offset": -0.3},  # a wall before the camera
        {"normal": (0, 0, -1), "offset": -0.4},  # a ceiling
    ],
)
def test_pictures_show_the_body_whatever_the_plane(tmp_path, plane):
    b = wf.ModelBuilder()
    block = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=RUBBER)
    b.add_contact(block, b.add_collider(wf.HalfSpace(**plane)))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    target = tmp_path / "a.png"
    sim.run(2e-3, outputs=[wf.PNGWriter(target, size=(320, 180), field="contact_pressure", color_range=(0, 1))])
    assert vivid(target) > 0.08


def test_tilted_planes_of_many_worlds_do_not_cover_other_worlds():
    b = wf.ModelBuilder()
    block = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=RUBBER)
    b.add_contact(block, b.add_collider(wf.HalfSpace((0.3, 0, 1), -0.2)))
    one, four = (DrawnSurface(wf.Simulation(b.finalize(device="cpu", worlds=n), dt=1e-3)) for n in (1, 4))

    def width(surface):
        square = surface.obstacles.all[0].points[0]
        return np.linalg.norm(square[1] - square[0])

    assert width(one) == pytest.approx(6.0 * 0.1 * np.sqrt(3.0))
    assert width(four) == pytest.approx(four.offsets[1, 0])


@pytest.mark.parametrize(
    "shape",
    [
        wf.Sphere((0, 0, -1), 0.5),
        wf.Box((0, 0, -1), (0.4, 0.6, 0.8)),
        wf.Capsule((0, 0, -1), (0.3, 0, -1), 0.2),
        wf.Cylinder((0, 0, -1), (0.3, 0, -1), 0.2),
        wf.HalfSpace((0, 0, 1), -0.2),
    ],
)
def test_surfaces_that_lie_further_out_are_drawn_there(shape):
    b = wf.ModelBuilder()
    block = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=RUBBER)
    b.add_contact(block, b.add_collider(shape))
    sim = wf.Simulation(b.finalize(device="cpu", worlds=2), dt=1e-3)
    low, high = np.zeros(3), np.full(3, 0.1)
    (before,) = Obstacles(sim, low, high).points()
    (term,) = (term for term in sim.model.terms.all if term.name == "contact")
    term.tables.shapes.margin.assign(np.array([[0.0], [0.05]]))
    (after,) = Obstacles(sim, low, high).points()
    np.testing.assert_allclose(after[0], before[0], atol=1e-15)
    moved = after[1] - before[1]
    if shape.kind == 0:
        np.testing.assert_allclose(moved, np.broadcast_to((0, 0, 0.05), moved.shape), atol=1e-15)
        return
    np.testing.assert_allclose(after[1].max(axis=0) - before[1].max(axis=0), 0.05, atol=1e-12)
    np.testing.assert_allclose(after[1].min(axis=0) - before[1].min(axis=0), -0.05, atol=1e-12)
