"""Contact between bodies through a Simulation: values per world, fields, forces at a state, statics, bad input."""

from __future__ import annotations

import json

import numpy as np
import pytest

import warpfea as wf
from warpfea.cli import main
from warpfea.model import assembly, edges
from warpfea.simulation.checkpoint import save_checkpoint

RUBBER = wf.SVK(E=1e6, nu=0.3, density=1000.0)
SIDE, WEIGHT = 0.1, 9.81
"""Of the upper block, m and N."""


def blocks(
    *, place=(0.05, 0.05, 0.1), gravity=(0, 0, -9.81), speed=None, cells=(1, 2), floor=False, free=False, **options
):
    """A block on a slab that is clamped below: builder, slab, block."""
    b = wf.ModelBuilder(gravity=gravity)
    slab = b.add_solid(wf.mesh.box((0.2, 0.2, 0.1), cells=(cells[1], cells[1], 1)), material=RUBBER, name="slab")
    mesh = wf.mesh.box((SIDE,) * 3, cells=(cells[0],) * 3, origin=place)
    block = b.add_solid(mesh, material=RUBBER, name="block")
    if not free:
        b.clamp(slab.nodes("z-"))
    if speed is not None:
        b.set_initial(block, velocity=speed)
    options = {"mu": 0.5, "restitution": 0.5, "name": "pad"} | options
    b.add_contact(block.surface("z-"), slab.surface("z+"), **options)
    if floor:
        b.add_contact(block.surface("z+"), b.add_collider(wf.HalfSpace((0, 0, -1), -0.2)), name="lid")
    return b, slab, block


def run(builder, steps, dt=2e-3, **options):
    sim = wf.Simulation(builder.finalize(device="cpu", **options), dt=dt, solver=wf.NewtonPCG(tol=1e-9))
    sim.step(steps)
    return sim


# values


@pytest.mark.parametrize(
    ("name", "values"),
    [("mu", (0.1, 0.4)), ("mu_static", (0.5, 0.9)), ("restitution", (0.2, 0.9)), ("stiffness", (1.0, 5.0))],
)
def test_worlds_with_values_of_their_own_equal_their_own_runs(name, values):
    start = {"place": (0.05, 0.05, 0.1005), "speed": (1.0, 0.3, -0.5)}
    model = blocks(**start)[0].finalize(device="cpu", worlds=2)
    model.set_parameter(f"pad.{name}", values)
    both = wf.Simulation(model, dt=2e-3)
    both.step(6)
    u = both.state.displacement.numpy()
    assert np.abs(u[0] - u[1]).max() > 1e-9
    for world, value in enumerate(values):
        options = {name: value} | ({"mu_static": value} if name == "mu" else {})
        single = wf.Simulation(blocks(**start, **options)[0].finalize(device="cpu"), dt=2e-3)
        single.step(6)
        np.testing.assert_array_equal(single.state.displacement.numpy()[0], u[world])


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("pad.mu", -0.1, "contact 'pad': mu = -0.1 in world 0 must be a friction coefficient"),
        ("pad.mu_static", 0.2, "at least mu = 0.5"),
        ("pad.restitution", -0.1, "from 0 to 1"),
        ("pad.stiffness", [1.0, 2.0], r"shape \(2,\)"),
        ("pad.offset", 1e-3, "'pad.offset' is unknown; there are: .*'pad.mu'"),
        ("pas.mu", 0.1, r"did you mean 'pad.mu'\?"),
    ],
)
def test_bad_parameters_are_refused(name, value, text):
    model = blocks()[0].finalize(device="cpu")
    with pytest.raises(wf.ModelError, match=text):
        model.set_parameter(name, value)


def test_a_checkpoint_holds_values_that_were_set(tmp_path):
    sim = run(blocks()[0], 2)
    save_checkpoint(sim, tmp_path / "c.npz")
    held = [array.numpy() for array in sim.model.terms.parameter_arrays().values()]
    for name, value in (("pad.mu", 0.4), ("pad.restitution", 0.4), ("pad.stiffness", 2.0)):
        other = blocks()[0].finalize(device="cpu")
        other.set_parameter(name, value)
        wf.Simulation(other, dt=2e-3).resume(tmp_path / "c.npz")
        for array, wanted in zip(other.terms.parameter_arrays().values(), held):
            assert np.array_equal(array.numpy(), wanted)
    same = blocks(mu=0.3)[0].finalize(device="cpu")
    same.set_parameter("pad.mu", 0.5)
    with pytest.raises(wf.CheckpointError, match="another model"):
        wf.Simulation(same, dt=2e-3).resume(tmp_path / "c.npz")


@pytest.mark.parametrize("offset", [1e-3, -1e-3])
def test_contact_begins_at_its_offset(offset):
    """At rest the surfaces are apart by the offset, less what the contact is pressed in; beside one without."""
    gaps = []
    for value in (0.0, offset):
        b, _, block = blocks(place=(0.05, 0.05, 0.1 + value), offset=value, mu=0.0)
        sim = run(b, 150)
        gaps.append(sim.field("gap", block)[0])
        foot = sim.positions(block)[0, block.mesh.points[:, 2] < 0.1 + value + 1e-9, 2]
        gaps.append(foot.mean())
    np.testing.assert_allclose(gaps[2], gaps[0], rtol=5e-3)  # from the offset on
    assert gaps[3] - gaps[1] == pytest.approx(offset, abs=2e-6)


# fields and forces


def test_a_flat_press_has_one_pressure_on_both_bodies():
    """Pushed in by the same everywhere: k_n depth over the area, on both sides, and nothing elsewhere."""
    depth = 1e-4
    b, slab, block = blocks(gravity=(0, 0, 0), stiffness="region")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    u = sim.state.displacement.numpy()
    u[:, block.slots, 2] = -depth
    sim.state.displacement.assign(u)
    a = np.sqrt(SIDE**2 / np.pi)
    modulus = 1e6 / (1.0 - 0.3**2) / 2.0  # of two equal bodies
    expected = 4.0 / 3.0 * modulus * a * depth / SIDE**2
    for body, height in ((slab, 0.1), (block, 0.1)):
        X = body.mesh.points
        pressure, gap = sim.field("contact_pressure", body)[0], sim.field("gap", body)[0]
        touching = (np.abs(X[:, 2] - height) < 1e-9) & (np.abs(X[:, :2] - 0.1) < 0.0501).all(axis=1)
        assert touching.sum() >= 9
        assert pressure[touching] == pytest.approx(expected, rel=1e-9)
        assert gap[touching] == pytest.approx(-depth, rel=1e-6)
        assert not pressure[~touching].any()
        assert np.isnan(gap[~touching]).all()
    force = sim.model.contact_force(sim.state)[0]
    assert force[block.slots].sum(axis=0) == pytest.approx((0, 0, expected * SIDE**2), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_forces_at_a_state_are_those_of_the_record_and_in_balance(dtype):
    b, slab, block = blocks(
        place=(0.05, 0.05, 0.1002), speed=(0.4, 0.0, -0.3), restitution=1.0, mu=0.5, free=True, gravity=(0, 0, 0)
    )
    model = b.finalize(device="cpu", dtype=dtype)
    sim = wf.Simulation(model, dt=1e-3)
    sim.step(4)
    force = model.contact_force(sim.state)[0]
    size = np.abs(force).sum()
    assert size > 1.0
    assert np.abs(force.sum(axis=0)).max() < 1e-13 * size
    moment = sum(
        np.cross(sim.positions(body), sim.results.at_mesh_nodes(body, force[None]))[0].sum(axis=0)
        for body in (slab, block)
    )
    assert np.abs(moment).max() < (1e-12 if dtype == "float64" else 1e-7) * size
    recorded = sim.contact_force("pad")[0, :3]
    bound = (1e-11 if dtype == "float64" else 1e-6) * np.abs(recorded).max()
    assert np.abs(force[block.slots].sum(axis=0) - recorded).max() <= bound
    assert np.abs(force[slab.slots].sum(axis=0) + recorded).max() <= bound


def test_fields_of_obstacles_and_bodies_join():
    b, slab, block = blocks(floor=True, place=(0.05, 0.05, 0.1))
    sim = run(b, 3)
    X = block.mesh.points
    gap = sim.field("gap", block)[0]
    top, foot = np.abs(X[:, 2] - 0.2) < 1e-9, np.abs(X[:, 2] - 0.1) < 1e-9
    assert gap[top] == pytest.approx(-sim.displacements(block)[0, top, 2], rel=5e-3)  # of the lid
    assert (gap[foot] < 0.0).all()  # of the slab
    pressure = sim.field("contact_pressure", block)[0]
    assert pressure[foot].min() > 0.0
    assert not pressure[top].any()
    assert (sim.field("contact_pressure", slab)[0] > 0.0).any()
    assert sim.collider_poses()[0].shape == (1, 1, 3)


def test_outputs_show_pairs(tmp_path):
    import meshio
    from pxr import Usd, UsdGeom

    b, _, _ = blocks()
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3)
    assert sim.collider_poses() is None
    fields = ("contact_pressure", "gap")
    sim.run(
        0.008,
        outputs=[
            wf.USDWriter(tmp_path / "p.usda", fields=fields, fps=500.0),
            wf.VTUWriter(tmp_path / "v", fields=fields),
        ],
    )
    stage = Usd.Stage.Open(str(tmp_path / "p.usda"))
    skins = [prim for prim in stage.Traverse() if prim.GetName() == "skin"]
    assert len(skins) == 2
    for prim in skins:
        values = UsdGeom.PrimvarsAPI(prim).GetPrimvar("contact_pressure").Get(stage.GetEndTimeCode())
        assert max(values) > 0.0
    for name in ("slab", "block"):
        data = meshio.read(tmp_path / "v" / f"{name}_0000_000004.vtu").point_data
        assert data["contact_pressure"].max() > 0.0
        assert np.nanmin(data["gap"]) < 0.0


# statics


def test_a_block_pressed_on_another_stands_in_equilibrium():
    b, slab, block = blocks(gravity=(0, 0, 0))
    b.drive(block.nodes("z+"), displacement=([0, 1], [(0, 0, 0), (0, 0, -1e-3)]))
    model = b.finalize(device="cpu")
    result = wf.solve_static(model, load_steps=2)
    force = result.contact_force("pad")[0]
    assert force[2] > 10.0
    assert result.reaction(slab.nodes("z-"))[0, 2] == pytest.approx(force[2], rel=1e-6)
    assert result.reaction(block.nodes("z+"))[0, 2] == pytest.approx(-force[2], rel=1e-6)


def test_what_only_contact_holds_needs_stabilise():
    model = blocks(place=(0.05, 0.05, 0.1005))[0].finalize(device="cpu")
    with pytest.raises(wf.ModelError, match=r"body 'block' has . unconstrained rigid-body mode.*stabilise=True"):
        wf.solve_static(model)
    result = wf.solve_static(model, stabilise=True)
    assert result.contact_force("pad")[0, 2] == pytest.approx(WEIGHT, rel=1e-5)


# what is refused


def two(**options):
    b = wf.ModelBuilder()
    meshes = [wf.mesh.box((0.1,) * 3, cells=(1, 1, 1), origin=(x, 0, 0)) for x in (0.0, 0.11)]
    first, second = (b.add_solid(mesh, material=RUBBER, name=name) for mesh, name in zip(meshes, ("one", "two")))
    return b, first, second


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"model": "sphere", "radius": 0.1}, NotImplementedError, "model = 'sphere' between bodies"),
        ({"law": "smooth"}, NotImplementedError, "law = 'smooth'"),
        ({"points": 5}, wf.ModelError, "points = 5: faces of '(one|two)' have rules of 7, 16 points"),
        ({"treatment": "explicit"}, wf.ModelError, "law 'default' declares no explicit force; 'paper' does"),
        ({"mu": -1.0}, wf.ModelError, "mu = -1.0"),
        ({"offset": np.nan}, wf.ModelError, "offset = nan"),
        ({"overlap": "push"}, wf.ModelError, "overlap = 'push'"),
    ],
)
def test_bad_options_are_named(options, error, text):
    b, first, second = two()
    with pytest.raises(error, match=text):
        b.add_contact(first, second, **options)
    assert not b.description.contacts


def test_bodies_that_cannot_touch_are_refused():
    b, first, second = two()
    for other in (first, first.surface("x+")):
        with pytest.raises(NotImplementedError, match="'one' with itself"):
            b.add_contact(first, other)
    foreign = two()[1]
    with pytest.raises(wf.ModelError, match="another builder"):
        b.add_contact(first, foreign)
    b.add_contact(first, second, name="pad")
    with pytest.raises(wf.ModelError, match="'pad'"):
        b.add_contact(first, b.add_collider(wf.HalfSpace((0, 0, 1))), name="pad")


def test_two_surfaces_that_are_clamped_are_refused():
    b, first, second = two()
    for body in (first, second):
        b.clamp(body.nodes(lambda X: X[:, 0] > -1.0))
    b.add_solid(wf.mesh.box((0.1,) * 3, cells=(1, 1, 1), origin=(0, 1, 0)), material=RUBBER)
    b.add_contact(first, second, name="pad")
    with pytest.raises(wf.ModelError, match="contact 'pad': all of the surfaces of bodies 'one' and 'two' is clamped"):
        b.finalize(device="cpu")


def test_overlap_at_the_start_is_refused_or_decays():
    depth = 1e-3
    b, _, _ = blocks(place=(0.05, 0.05, 0.1 - depth), overlap="refuse")
    with pytest.raises(wf.ModelError, match=r"contact 'pad': body '\w+' begins 0.001 m inside body '\w+'"):
        wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    b, _, block = blocks(place=(0.05, 0.05, 0.1 - depth), overlap="offset", overlap_time=0.05, gravity=(0, 0, 0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    heights = []
    for _ in range(100):
        assert sim.step().converged.all()
        heights.append(sim.displacements(block)[0, :, 2].mean())
    speed = np.diff(heights) / 1e-3
    assert speed.max() < 2.0 * depth / 0.05  # it is not thrown out
    assert heights[-1] > 0.9 * depth


@pytest.mark.parametrize("initial", [False, True])
@pytest.mark.parametrize("named", [False, True])
def test_a_body_that_begins_within_another_is_refused(named, initial):
    """Deeper than facets hold: also where the body is there by its initial displacement only."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    far = 1.0 if initial else 0.0
    big = b.add_solid(wf.mesh.box((0.3, 0.3, 0.3), cells=(2, 2, 2)), material=RUBBER, name="big")
    small = b.add_solid(wf.mesh.box((0.06,) * 3, cells=(1, 1, 1), origin=(0.12 + far, 0.12, 0.12)), material=RUBBER,
                        name="small")  # fmt: skip
    if initial:
        b.set_initial(small, displacement=(-far, 0, 0))
    sides = (small.surface("z-"), big.surface("z+")) if named else (small, big)
    b.add_contact(*sides, name="pad")
    model = b.finalize(device="cpu", worlds=2)
    with pytest.raises(wf.ModelError, match=r"contact 'pad': body 'small' begins (within|0\.12 m inside) body 'big'"):
        wf.Simulation(model, dt=1e-3)


def test_a_body_in_the_hollow_of_another_is_not_within_it():
    def bent(X):  # an arc that opens upwards
        angle = np.pi * X[:, 0] / 0.3
        r = 0.12 - X[:, 2]
        return np.column_stack([-r * np.cos(angle), X[:, 1], -r * np.sin(angle)])

    b = wf.ModelBuilder(gravity=(0, 0, 0))
    shell = wf.mesh.box((0.3, 0.06, 0.02), cells=(6, 1, 1), map=bent)
    bowl = b.add_solid(shell, material=RUBBER, name="bowl")
    ball = b.add_solid(wf.mesh.sphere(0.05, cells=2, center=(0, 0.03, -0.05)), material=RUBBER, name="ball")
    b.add_contact(ball, bowl)
    assert wf.Simulation(b.finalize(device="cpu"), dt=1e-3).step(2).converged.all()


# commands, and what a scene without it costs


def test_commands_tell_of_pairs(tmp_path, capfd):
    target = tmp_path / "s.json"
    assert (
        main(["run", "block_stack", "--set", "blocks=1", "--t-end", "0.04", "--device", "cpu", "--json", str(target)])
        == 0
    )
    out = capfd.readouterr().out
    assert "contact joint 1" in out
    assert "dissipated: impact" in out
    found = json.loads(target.read_text())["contacts"]["joint 1"]
    assert found["normal_force"] > 0.0
    assert found["force"][2] > 0.0
    assert main(["info", "block_stack", "--set", "blocks=1", "--device", "cpu"]) == 0
    assert "body block 1 on body slab, law default" in capfd.readouterr().out


@pytest.mark.parametrize("obstacle", [False, True])
def test_a_scene_without_pairs_has_nothing_of_them(obstacle):
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    block = b.add_solid(wf.mesh.box((0.1,) * 3, cells=(1, 1, 1)), material=RUBBER)
    if obstacle:
        b.add_contact(block.surface("z-"), b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.3)
    else:
        b.clamp(block.nodes("z-"))
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=1e-3)
    assert model.terms.named("pairs") is None
    assert "contact between bodies" in model.info()["left_out"]
    assert not [module for module in sim.stepper.launch.modules if "pair" in module]
    assert not [name for name in sim.state.specs if name.startswith("pairs")]


def test_a_surface_is_evaluated_once_for_all_its_pairs(monkeypatch):
    """The work grows with the number of bodies, not with its square as pairs do."""
    calls, counts, evaluate = [], [], assembly.facet_tables
    for module in (assembly, edges):
        monkeypatch.setattr(module, "facet_tables", lambda *args, **named: calls.append(1) or evaluate(*args, **named))
    for count in (3, 5, 7):
        b, before = wf.ModelBuilder(), len(calls)
        for k in range(count):
            b.add_solid(wf.mesh.box((1,) * 3, cells=(1, 1, 1), element="T4", origin=(k, 0, 0)), material=RUBBER)
        b.add_collider(wf.HalfSpace((0, 0, 1)))
        assert len(b.add_contact_all()) == count * (count + 1) / 2
        b.finalize(device="cpu")
        counts.append(len(calls) - before)
    assert counts[2] - counts[1] == counts[1] - counts[0] > 0
