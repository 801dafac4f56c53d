"""Contact through a Simulation: records, forces at a state, parameters per world, commands."""

from __future__ import annotations

import json

import numpy as np
import pytest
import warp as wp
from contact_runs import DEVICES, DT, DTYPES, TIGHT, simulated, thrown

import warpfea as wf
from warpfea.cli import main
from warpfea.model.contact_points import contact_points
from warpfea.model.handles import SurfaceSet
from warpfea.simulation.checkpoint import save_checkpoint

# records


def test_a_record_has_every_step_and_world():
    sim = wf.Simulation(thrown(worlds=2)[2], dt=DT)
    sim.step(15)
    record = sim.contact_record("pad")
    assert record.time == pytest.approx(DT * np.arange(1, 16))
    assert record.force.shape == record.moment.shape == (2, 15, 3)
    names = ("normal_force", "penetration", "slip", "area", "stick", "stored", "loss", "friction", "collider_work")
    for name in names:
        values = getattr(record, name)
        assert values.shape == (2, 15)
        assert np.isfinite(values).all()
        assert (values[0] == values[1]).all()
    assert record.normal_force.max() > 10.0
    assert 1e-4 < record.penetration.max() < 0.01
    assert 0.005 < record.area.max() < 0.016  # of the foot, and of the points of the sides on its edges
    assert ((record.stick >= 0.0) & (record.stick <= 1.0)).all()
    assert sim.contact_record(sim.model.description.contacts[0]).force == pytest.approx(record.force)
    last = np.concatenate([record.force[:, -1], record.moment[:, -1]], axis=1)
    np.testing.assert_array_equal(sim.contact_force("pad"), last)


def test_friction_of_a_slide_is_mu_times_the_normal_force():
    b = wf.ModelBuilder()
    cube = b.add_solid(
        wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=wf.SVK(E=1e7, nu=0.3, density=1000), name="cube"
    )
    b.set_initial(cube, velocity=(1.0, 0, 0))
    b.add_contact(cube, b.add_collider(wf.HalfSpace((0, 0, 1)), name="floor"), mu=0.3, restitution=0.1, name="pad")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=DT)
    foot, place = cube.mesh.points[:, 2] < 1e-9, []
    for _ in range(100):
        sim.step()
        place.append(sim.positions(cube)[0, foot, 0].mean())
    record = sim.contact_record("pad")
    assert record.force[0, :, 2] == pytest.approx(record.normal_force[0], rel=1e-6)
    slips = (record.stick[0] == 0.0) & (record.normal_force[0] > 1.0)
    assert slips.sum() > 50
    assert -record.force[0, slips, 0] == pytest.approx(0.3 * record.normal_force[0, slips], rel=1e-4)
    assert record.slip[0, -50:].sum() == pytest.approx(place[-1] - place[-51], rel=1e-2)
    # the line of the resultant passes through the cube's foot
    x = -record.moment[0, -1, 1] / record.force[0, -1, 2]
    low, high = sim.positions(cube)[0, :, 0].min(), sim.positions(cube)[0, :, 0].max()
    assert low < x < high


def test_unknown_contacts_are_named():
    sim = wf.Simulation(thrown()[2], dt=DT)
    with pytest.raises(wf.ModelError, match=r"'padd'; it has: 'pad'; did you mean 'pad'\?"):
        sim.contact_record("padd")
    with pytest.raises(wf.ModelError, match="handle from add_contact"):
        sim.contact_force(thrown()[2].description.contacts[0])
    assert np.isnan(sim.contact_force("pad")).all()
    assert sim.contact_record("pad").force.shape == (1, 0, 3)


def test_a_world_that_did_not_step_has_no_record():
    sim = wf.Simulation(thrown(worlds=2)[2], dt=DT)
    sim.step(3)
    sim.reset([True, False])
    assert np.isnan(sim.contact_force("pad")).all(axis=1).tolist() == [True, False]


def test_records_begin_anew_where_the_first_point_is_clamped():
    """Points that clamped slots hold are left out and counted; a step's record does not reach into the next."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    cube = b.add_solid(
        wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000), name="cube"
    )
    first = contact_points(SurfaceSet(cube, cube.boundary)).X[0, 0]
    b.clamp(cube.nodes("z+"))
    b.clamp(cube.nodes(lambda X: np.linalg.norm(X - first, axis=1) < 1e-9))
    floor = b.add_collider(wf.HalfSpace((0, 0, 1), -0.001), path=([0, 1], [(0, 0, 0), (0, 0, 0.5)]), name="floor")
    b.add_contact(cube, floor, restitution=0.5, name="pad")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=DT)
    sim.step(20)
    record, energies = sim.contact_record("pad"), sim.energies()
    assert record.loss.sum() == pytest.approx(energies["contact_loss"][0], rel=1e-12)
    assert record.collider_work.sum() == pytest.approx(energies["collider_work"][0], rel=1e-12)
    fact = sim.model.info()["contacts"][0]
    assert fact["left_out"] > 0
    assert fact["points"] == 12 * 7 - fact["left_out"]


# forces at a state


@pytest.mark.parametrize("options", [{}, {"mu": 0.0}, {"mu_static": 0.8}, {"law": "paper", "mu": 0.0}], ids=str)
def test_force_at_a_state_is_that_of_the_step_without_losses(options):
    """With restitution 1 nothing is damped: the force at the end of a step is the elastic one, springs included."""
    b, cube, model = thrown(**(options | {"restitution": 1.0}))
    sim = wf.Simulation(model, dt=DT, solver=TIGHT)
    sim.step(12)
    nodal = model.contact_force(sim.state)
    assert nodal.shape == (1, model.slots, 3)
    force = sim.contact_force("pad")[0]
    assert nodal[0].sum(axis=0) == pytest.approx(force[:3], rel=1e-10, abs=1e-10 * np.abs(force).max())
    moment = np.cross(sim.positions(cube)[0], sim.results.at_mesh_nodes(cube, nodal)[0]).sum(axis=0)
    assert moment == pytest.approx(force[3:], rel=1e-9, abs=1e-9 * np.abs(force).max())


def driven(**options):
    """A cube of T4 of which every node is driven into a half-space at 0.01 m/s."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element="T4")
    cube = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000), element="T4", name="cube")
    b.drive(cube.nodes(lambda X: X[:, 0] > -1), displacement=([0, 1], [(0, 0, 0), (0, 0, -0.01)]))
    foot = cube.surface("z-")
    b.add_contact(foot, b.add_collider(wf.HalfSpace((0, 0, 1)), name="floor"), name="pad", **options)
    return wf.Simulation(b.finalize(device="cpu"), dt=0.1)


def test_all_nodes_may_be_driven():
    modulus = 1e6 / (1 - 0.3**2)
    sim = driven(model="sphere", radius=0.05)
    for k in range(1, 4):
        assert sim.step().converged.all()
        expected = 4 / 3 * modulus * np.sqrt(0.05) * (1e-3 * k) ** 1.5
        assert sim.contact_force("pad")[0, 2] == pytest.approx(expected, rel=1e-10)
        assert sim.model.contact_force(sim.state)[0].sum(axis=0)[2] == pytest.approx(expected, rel=1e-10)
    sim = driven(stiffness="region", restitution=1.0)
    sim.step(3)
    expected = 4 / 3 * modulus * np.sqrt(0.01 / np.pi) * 3e-3
    nodal = sim.model.contact_force(sim.state)[0]
    assert nodal.sum(axis=0) == pytest.approx([0, 0, expected], rel=1e-10)
    assert (nodal[:, 2] > 0.0).sum() == 4


def test_a_static_equilibrium_bears_on_the_collider():
    """The force of a collider equals the reaction of the clamp; also of the state that statics leaves."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(2, 2, 2))
    cube = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000), name="cube")
    b.clamp(cube.nodes("z+"))
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)), path=([0, 1], [(0, 0, 0), (0.002, 0, 0.004)]), name="floor")
    b.add_contact(cube.surface("z-"), floor, mu=0.3, name="pad")
    model = b.finalize(device="cpu")
    static = wf.solve_static(model, load_steps=4, tol=1e-10)
    force = static.contact_force("pad")[0, :3]
    assert force[2] > 100.0
    assert 0.0 < force[0] < 0.3 * force[2]
    for other in (-static.reaction(cube.nodes("z+"))[0], model.contact_force(static.state)[0].sum(axis=0)):
        assert other == pytest.approx(force, abs=1e-8 * force[2])
    assert (np.diff(static.simulation.contact_record("pad").force[0, :, 2]) > 0.0).all()


def test_without_contact_the_force_is_zero():
    b = wf.ModelBuilder()
    b.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000), name="cube")
    model = b.finalize(device="cpu", worlds=2)
    assert not model.contact_force(model.state()).any()
    assert model.info()["contacts"] == []
    with pytest.raises(wf.ModelError, match="it has: none"):
        wf.Simulation(model, dt=DT).contact_record("pad")


# parameters per world


@pytest.mark.parametrize(("name", "values"), [
    ("mu", [0.1, 0.3, 0.5]), ("restitution", [0.2, 0.9, 1.0]), ("stiffness", [0.5, 1.0, 3.0]),
    ("mu_static", [0.5, 0.6, 0.9]),
])  # fmt: skip
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("device", DEVICES)
def test_worlds_with_values_of_their_own_equal_their_own_runs(device, dtype, name, values):
    model = thrown(worlds=3, device=device, dtype=dtype)[2]
    model.set_parameter(f"pad.{name}", values)
    sim = wf.Simulation(model, dt=DT)
    sim.step(25)
    for world, value in enumerate(values):
        alone = simulated(25, device=device, dtype=dtype, **{name: value})
        np.testing.assert_array_equal(sim.state.displacement.numpy()[world], alone.state.displacement.numpy()[0])
        for record in ("force", "slip", "stick", "stored", "friction"):
            expected = getattr(alone.contact_record("pad"), record)[0]
            np.testing.assert_array_equal(getattr(sim.contact_record("pad"), record)[world], expected)
    assert len({float(x) for x in sim.contact_record("pad").stored.sum(axis=1)}) == 3


def test_colliders_are_set_off_in_each_world():
    model = thrown(worlds=2)[2]
    model.set_parameter("floor.offset", [-0.002, -0.004])
    sim = wf.Simulation(model, dt=DT)
    sim.step(25)
    for world, offset in enumerate((-0.002, -0.004)):
        alone = simulated(25, shape=wf.HalfSpace((0, 0, 1), offset))
        expected = alone.state.displacement.numpy()[0]
        assert sim.state.displacement.numpy()[world] == pytest.approx(expected, abs=1e-8)
    ball = thrown("ball")[2]
    ball.set_parameter("floor.offset", -0.003)
    small = simulated(25, shape=wf.Sphere((0.05, 0.05, -0.2), 0.196))
    sim = wf.Simulation(ball, dt=DT)
    sim.step(25)
    assert sim.state.displacement.numpy() == pytest.approx(small.state.displacement.numpy(), abs=1e-8)


def test_a_run_in_progress_takes_new_values():
    """Recorded steps see them, also friction where there was none before; Warp arrays will do."""
    model = thrown(mu=0.0)[2]
    sim = wf.Simulation(model, dt=DT)
    graph = sim.stepper.graph
    sim.step(10)
    assert sim.contact_record("pad").friction[0].sum() == 0.0
    model.set_parameter("pad.mu", wp.array([0.4], dtype=wp.float32, device="cpu"))
    sim.step(5)
    assert sim.contact_record("pad").friction[0, 10:].sum() > 1e-3
    model.set_parameter("pad.mu", 0)
    sim.step()
    assert sim.contact_record("pad").friction[0, -1] == 0.0
    assert sim.stepper.graph is graph


def test_static_friction_follows_where_it_was_equal():
    model = thrown(worlds=2)[2]
    data = model.terms.named("contact").tables.data
    model.set_parameter("pad.mu_static", [0.5, 0.6])
    model.set_parameter("pad.mu", 0.2)
    assert data.mu.numpy()[:, 0].tolist() == [0.2, 0.2]
    assert data.mu_static.numpy()[:, 0].tolist() == [0.2, 0.6]


@pytest.mark.parametrize(("name", "value", "text"), [
    ("pad.mu", -1, r"contact 'pad': mu = -1.0 in world 0 must be a friction coefficient, 0 or above"),
    ("pad.mu", [0.2, 0.9], r"mu = 0.9 in world 1 must be at most mu_static = 0.7"),
    ("pad.mu", np.nan, r"mu = nan in world 0"), ("pad.mu", [0.1, 0.2, 0.3], r"mu has shape \(3,\).* \(2,\)"),
    ("pad.mu", "much", r"mu = 'much' must be a number"),
    ("pad.mu_static", [0.5, 0.4], r"mu_static = 0.4 in world 1 must be at least mu = 0.5"),
    ("pad.restitution", [1.0, -0.1], r"restitution = -0.1 in world 1 must be from 0 to 1"),
    ("pad.restitution", 1.1, r"restitution = 1.1"), ("pad.stiffness", 0, r"stiffness = 0.0 .* a positive factor"),
    ("floor.offset", np.inf, r"collider 'floor': offset = inf"),
    ("pad.nu", 1, r"'pad.nu' is unknown; there are: 'pad.mu'.* 'floor.offset'.*; did you mean"),
    ("floor.mu", 1, r"'floor.mu' is unknown"), ("pad", 1, "'pad' is unknown"), (3, 1, "3 is unknown"),
])  # fmt: skip
def test_bad_parameters_are_refused(name, value, text):
    model = thrown(worlds=2, mu_static=0.7)[2]
    before = model.fingerprint()
    with pytest.raises(wf.ModelError, match=text):
        model.set_parameter(name, value)
    assert model.fingerprint() == before


def test_a_checkpoint_holds_values_that_were_set(tmp_path):
    """In place of those that were set elsewhere; of what was built with other values it is not."""
    path = tmp_path / "c.npz"
    sim = simulated(5)
    sim.model.set_parameter("pad.restitution", 0.3)
    save_checkpoint(sim, path)
    held = [array.numpy() for array in sim.model.terms.parameter_arrays().values()]
    sim.step(3)
    for name, value in (("pad.mu", 0.4), ("pad.restitution", 0.4), ("pad.stiffness", 2), ("floor.offset", -0.003)):
        other = thrown()[2]
        other.set_parameter(name, value)
        resumed = wf.Simulation(other, dt=DT)
        resumed.resume(path)
        for array, wanted in zip(other.terms.parameter_arrays().values(), held):
            assert np.array_equal(array.numpy(), wanted)
        resumed.step(3)
        assert np.array_equal(resumed.state.displacement.numpy(), sim.state.displacement.numpy())
    same = thrown(mu=0.3)[2]
    same.set_parameter("pad.mu", 0.5)
    with pytest.raises(wf.CheckpointError, match=r"another model: .*contacts differ"):
        wf.Simulation(same, dt=DT).resume(path)


# commands


SCENES = """
import warpfea as wf

@wf.scene(dt=1e-3, t_end=.01)
def slide(*, pads: int = 1) -> wf.ModelBuilder:
    '''Cubes that slide.'''
    b = wf.ModelBuilder()
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)), name="floor")
    for k in range(pads):
        mesh = wf.mesh.box((.1, .1, .1), cells=(1, 1, 1), origin=(.2 * k, 0, 0))
        cube = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=.3, density=1000), name=f"cube{k}")
        b.set_initial(cube, velocity=(1, 0, -.1))
        b.add_contact(cube, floor, mu=.5, restitution=.5, stiffness="region", name=f"pad{k}")
    return b
"""


def command(capfd, *words):
    capfd.readouterr()
    assert main([str(word) for word in words]) == 0
    return capfd.readouterr().out


def test_commands_tell_of_contacts(tmp_path, monkeypatch, capfd):
    (tmp_path / "mine.py").write_text(SCENES)
    monkeypatch.chdir(tmp_path)
    summary = json.loads(command(capfd, "run", "mine.py:slide", "--device", "cpu", "--json", "-"))
    pad = summary["contacts"]["pad0"]
    assert set(pad) == {"normal_force", "penetration", "relative_penetration", "force", "area", "stick"}
    assert pad["normal_force"] > 10.0
    assert 0.005 < pad["area"] < 0.016
    assert len(pad["force"]) == 3
    assert not {"contact", "friction"} & set(summary["left_out"])
    words = command(capfd, "run", "mine.py:slide", "--device", "cpu").split()
    assert "contact pad0 normal force up to" in " ".join(words)
    many = " ".join(command(capfd, "run", "mine.py:slide", "--device", "cpu", "--set", "pads=13").split())
    assert "contacts 13 in all, of which these have the largest forces" in many
    out = command(capfd, "info", "mine.py:slide", "--device", "cpu")
    assert "body cube0 on floor, law default, patch, 84 points" in out
    info = json.loads(command(capfd, "info", "mine.py:slide", "--device", "cpu", "--json", "-"))
    assert info["contacts"] == [
        {"name": "pad0", "body": "cube0", "collider": "floor", "law": "default", "model": "patch", "points": 84,
         "left_out": 0}
    ]  # fmt: skip
