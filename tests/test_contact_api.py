"""Contact through a Simulation: records, forces at a state, parameters per world, refused steps, energies, commands."""

from __future__ import annotations

import json

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.cli import main
from warpfea.model.contact_points import contact_points
from warpfea.model.handles import SurfaceSet
from warpfea.simulation.checkpoint import save_checkpoint

DT = 1e-3
TIGHT = wf.NewtonPCG(tol=1e-12)
FLOOR = wf.HalfSpace((0, 0, 1), -0.002)
TURN = wf.Rotation(anchor=(0, 0, 0), axis=(0, 0.2, 1), angle=([0, 1], [0, 10.0]))
SLIDE = ([0, 0.01, 0.02, 0.05], [(0, 0, 0), (0, 0.01, 0.003), (0.01, 0, -0.002), (0.05, 0, 0)])
PLACES = {
    "plane": (FLOOR, None),
    "path": (FLOOR, SLIDE),
    "rotation": (FLOOR, TURN),
    "ball": (wf.Sphere((0.05, 0.05, -0.2), 0.199), None),
    "capsule": (wf.Capsule((-0.1, 0.05, -0.1), (0.2, 0.05, -0.1), 0.099), TURN),
    "cylinder": (wf.Cylinder((-0.1, 0.05, -0.1), (0.2, 0.05, -0.1), 0.099), ([0, 1], [(0, 0, 0), (3, 0, 0)])),
    "box": (wf.Box((0.05, 0.05, -0.102), (0.3, 0.3, 0.2)), TURN),
}


DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
DTYPES = ["float64", "float32"]


def placed(*cuda):
    """Devices and obstacles: all on the CPU, those named on a GPU."""
    on_gpu = [pytest.param("cuda", place, marks=pytest.mark.cuda) for place in cuda]
    return pytest.mark.parametrize(("device", "place"), [*(("cpu", place) for place in PLACES), *on_gpu])


def thrown(place="plane", *, E=1e6, device="cpu", dtype="float64", worlds=1, shape=None, **options):
    """A cube of 0.1 m and 1 kg that spins and slides onto an obstacle: builder, cube, model."""
    b = wf.ModelBuilder()
    cube = b.add_solid(
        wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=wf.SVK(E=E, nu=0.3, density=1000), name="cube"
    )
    b.set_initial(cube, velocity=(1.0, 0.2, -0.3), angular_velocity=(0, 3, 5))
    found, path = PLACES[place]
    floor = b.add_collider(shape or found, path=path, name="floor")
    b.add_contact(cube, floor, **({"mu": 0.5, "restitution": 0.5, "name": "pad"} | options))
    return b, cube, b.finalize(device=device, dtype=dtype, worlds=worlds)


def simulated(steps, *args, dt=DT, integrator="backward_euler", solver=None, **options):
    sim = wf.Simulation(thrown(*args, **options)[2], dt=dt, integrator=integrator, solver=solver)
    sim.step(steps)
    return sim


def falling(shape, *, E, speed, solver=None, worlds=1, **options):
    """A cube of 0.1 m that flies at an obstacle below it: simulation with steps of 10 ms, and the cube."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    material = wf.SVK(E=E, nu=0.3, density=1000)
    cube = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(2, 2, 2)), material=material, name="cube")
    b.add_contact(cube, b.add_collider(shape, name="plate"), restitution=0.5, name="pad")
    model = b.finalize(device="cpu", worlds=worlds)
    state = model.state()
    velocity = state.velocity.numpy()
    velocity[:, :, 2] = -np.broadcast_to(speed, (worlds,))[:, None]
    state.velocity.assign(velocity)
    return wf.Simulation(model, state, dt=1e-2, solver=solver, **options), cube


def thin(thickness=0.02, gap=0.05):
    """A plate of which the upper face lies `gap` below the cube, m."""
    return wf.Box((0.05, 0.05, -gap - 0.5 * thickness), (0.5, 0.5, thickness))


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
    moment = np.cross(sim.positions(cube)[0], sim._rows(cube, nodal)[0]).sum(axis=0)
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
    sim = driven()
    sim.step(3)
    expected = 4 / 3 * modulus * np.sqrt(0.01 / np.pi) * 3e-3
    nodal = sim.model.contact_force(sim.state)[0]
    assert nodal.sum(axis=0) == pytest.approx([0, 0, expected], rel=1e-10)
    assert (nodal[:, 2] > 0.0).sum() == 4


def test_a_static_equilibrium_bears_on_the_collider():
    """What a collider presses with is what the clamp holds; also of the state that statics leaves."""
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
    data = model.terms.contact.tables.data
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
    ("pad.restitution", [1.0, 0.0], r"restitution = 0.0 in world 1 must be above 0 and at most 1"),
    ("pad.restitution", 1.1, r"restitution = 1.1"), ("pad.stiffness", 0, r"stiffness = 0.0 .* a positive factor"),
    ("floor.offset", np.inf, r"collider 'floor': offset = inf"),
    ("pad.nu", 1, r"'pad.nu' is unknown; there are: 'pad.mu'.* 'floor.offset'; did you mean 'pad.mu'"),
    ("floor.mu", 1, r"'floor.mu' is unknown"), ("pad", 1, "'pad' is unknown"), (3, 1, "3 is unknown"),
])  # fmt: skip
def test_bad_parameters_are_refused(name, value, text):
    model = thrown(worlds=2, mu_static=0.7)[2]
    before = model.fingerprint()
    with pytest.raises(wf.ModelError, match=text):
        model.set_parameter(name, value)
    assert model.fingerprint() == before


def test_a_checkpoint_of_other_values_is_refused(tmp_path):
    path = tmp_path / "c.npz"
    sim = simulated(5)
    save_checkpoint(sim, path)
    for name, value in (("pad.mu", 0.4), ("pad.restitution", 0.4), ("pad.stiffness", 2), ("floor.offset", -0.003)):
        other = thrown()[2]
        other.set_parameter(name, value)
        with pytest.raises(wf.CheckpointError, match=r"another model: .*contacts differ"):
            wf.Simulation(other, dt=DT).resume(path)
    same = thrown(mu=0.3)[2]
    same.set_parameter("pad.mu", 0.5)
    wf.Simulation(same, dt=DT).resume(path)


# refused steps


@pytest.mark.parametrize("E", [1e9, 1e10, 1e11])
def test_nothing_gets_behind_a_thin_plate(E):
    sim, cube = falling(thin(), E=E, speed=100.0)
    lowest = []
    for _ in range(5):
        sim.step()
        lowest.append(sim.positions(cube)[0, :, 2].min())
    assert min(lowest) > -0.06  # the middle of the plate
    assert sim.contact_record("pad").normal_force.max() > 0.0


@pytest.mark.parametrize("E", [1e3, 1e5, 1e7])
def test_an_impact_that_is_too_fast_is_named(E):
    sim, cube = falling(thin(), E=E, speed=100.0)
    before = {name: values.copy() for name, values in sim.state.numpy().items()}
    with pytest.raises(wf.PenetrationError) as caught:
        sim.step(3)
    text = str(caught.value)
    for words in ("contact 'pad'", "body 'cube'", "reference place (", "collider 'plate'", "smaller dt", "stiffness="):
        assert words in text
    assert isinstance(caught.value, wf.ConvergenceError)
    assert (caught.value.time, caught.value.world) == (0.0, 0)
    assert caught.value.state is sim.state
    for name, values in sim.state.numpy().items():
        np.testing.assert_array_equal(values, before[name], err_msg=name)


def test_a_world_that_fails_fails_alone():
    speeds = [1.0, 100.0, 2.0]
    sim, cube = falling(thin(gap=0.005), E=1e6, speed=speeds, worlds=3)
    sim.step(4)
    assert sim.status.tolist() == [0, 1, 0]
    assert np.isnan(sim.contact_record("pad").force[1]).all()
    for world in (0, 2):
        alone, body = falling(thin(gap=0.005), E=1e6, speed=speeds[world])
        alone.step(4)
        np.testing.assert_array_equal(sim.positions(cube)[world], alone.positions(body)[0])
        np.testing.assert_array_equal(sim.contact_record("pad").force[world], alone.contact_record("pad").force[0])
    assert sim.contact_record("pad").normal_force[[0, 2]].max() > 1.0
    sim, _ = falling(thin(gap=0.005), E=1e6, speed=speeds, worlds=3, on_failure="raise")
    with pytest.raises(wf.PenetrationError, match="in world 1"):
        sim.step(4)


def test_other_failures_are_no_penetration():
    sim, _ = falling(thin(gap=0.001), E=1e6, speed=1.0, solver=wf.NewtonPCG(max_newton=1, max_halvings=1))
    with pytest.raises(wf.ConvergenceError) as caught:
        sim.step(5)
    assert not isinstance(caught.value, wf.PenetrationError)


# the start


def resting(offset=0.0, **options):
    """A cube on, or in, a floor at height `offset`, m."""
    b = wf.ModelBuilder()
    cube = b.add_solid(
        wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000), name="cube"
    )
    floor = b.add_collider(wf.HalfSpace((0, 0, 1), offset), name="floor")
    b.add_contact(cube, floor, name="pad", **({"restitution": 0.1} | options))
    return wf.Simulation(b.finalize(device="cpu"), dt=DT), cube


def test_touch_at_the_start_is_fine_and_overlap_is_not():
    sim, cube = resting()
    assert sim.step(3).converged.all()
    text = r"'pad': body 'cube' begins 0.002 m inside collider 'floor' \(world 0.*overlap='offset'"
    with pytest.raises(wf.ModelError, match=text):
        resting(0.002)


def test_a_stored_overlap_decays():
    """It gives no kick: the cube is lifted at the speed at which the overlap vanishes, and then lies on the floor."""
    sim, cube = resting(0.002, overlap="offset", overlap_time=0.05)
    height, speed = [], []
    for _ in range(100):
        sim.step()
        height.append(sim.positions(cube)[0, :, 2].min())
        speed.append(np.abs(sim.velocities(cube)[0, :, 2]).max())
    force = sim.contact_record("pad").normal_force[0]
    assert abs(height[0]) < 2e-4
    assert max(speed) < 3 * 0.002 / 0.05
    assert force.max() < 5 * 9.81
    assert 0.0015 < height[49] < 0.002
    assert 0.0015 < height[-1] < 0.002
    assert force[-20:].mean() == pytest.approx(9.81, rel=0.01)


def test_a_body_at_rest_without_forces_takes_no_iterations():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1))
    cube = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000), name="cube")
    b.add_contact(cube, b.add_collider(wf.HalfSpace((0, 0, 1)), name="floor"), mu=0.5, name="pad")
    report = wf.Simulation(b.finalize(device="cpu"), dt=DT).step()
    assert report.converged.all()
    assert report.newton[0] == 0


# energies and momentum


LAWS = {
    "default": {}, "mu_static": {"mu_static": 0.7}, "paper": {"law": "paper"},
    "explicit": {"law": "paper", "treatment": "explicit"}, "smooth": {"law": "smooth"},
}  # fmt: skip


@pytest.mark.parametrize("integrator", ["backward_euler", "bdf2", "energy_momentum"])
@pytest.mark.parametrize("law", LAWS)
@placed("plane", "rotation", "capsule")
def test_the_ledger_closes(device, place, law, integrator):
    sim = simulated(40, place, device=device, solver=TIGHT, integrator=integrator, **LAWS[law])
    energies = {name: float(values[0]) for name, values in sim.energies().items()}
    names = ("kinetic", "strain", "friction", "contact_loss", "collider_work")
    scale = max(abs(energies[name]) for name in names)
    assert abs(energies["ledger_residual"]) <= 1e-9 * scale
    record = sim.contact_record("pad")
    for of_record, of_ledger in (("loss", "contact_loss"), ("friction", "friction"), ("collider_work",) * 2):
        assert getattr(record, of_record)[0].sum() == pytest.approx(energies[of_ledger], abs=1e-12 * scale)
    assert record.stored[0, -1] == pytest.approx(energies["contact"], rel=1e-12)
    assert energies["friction"] > 0.0
    assert (energies["collider_work"] != 0.0) == (place in ("path", "rotation", "capsule", "cylinder", "box"))


def momentum_error(solver, *args, **options):
    """Largest change of momentum in a step that is not the impulse of the records, over the largest change."""
    model = thrown(*args, **options)[2]
    sim = wf.Simulation(model, dt=DT, solver=solver)
    mass = model.lumped_host
    momentum = [mass @ sim.state.velocity.numpy()[0]]
    for _ in range(40):
        sim.step()
        momentum.append(mass @ sim.state.velocity.numpy()[0])
    impulse = DT * (sim.contact_record("pad").force[0] + model.mass * np.array([0, 0, -9.81]))
    change = np.diff(momentum, axis=0)
    return np.abs(change - impulse).max() / np.abs(change).max()


@placed("plane", "rotation", "capsule")
@pytest.mark.parametrize("law", LAWS)
def test_momentum_is_the_impulse_of_the_records(device, place, law):
    assert momentum_error(TIGHT, place, device=device, **LAWS[law]) <= 1e-10


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("law", ["default", "explicit", "smooth"])
def test_momentum_in_single_precision(device, law):
    assert momentum_error(None, device=device, dtype="float32", **LAWS[law]) <= 1e-4


@pytest.mark.parametrize("max_newton", [6, 30])
@pytest.mark.parametrize("device", DEVICES)
def test_halved_steps_keep_momentum_and_energy(device, max_newton):
    model = thrown(device=device)[2]
    sim = wf.Simulation(model, dt=4e-3, solver=wf.NewtonPCG(tol=1e-12, max_newton=max_newton))
    mass = model.lumped_host
    begin = mass @ sim.state.velocity.numpy()[0]
    halvings = sum(int(sim.step().halvings[0]) for _ in range(10))
    assert (halvings > 0) == (max_newton == 6)
    record = sim.contact_record("pad")
    impulse = 4e-3 * (record.force[0].sum(axis=0) + 10 * model.mass * np.array([0, 0, -9.81]))
    change = mass @ sim.state.velocity.numpy()[0] - begin
    assert change == pytest.approx(impulse, abs=1e-10 * np.abs(change).max())
    energies = sim.energies()
    assert abs(energies["ledger_residual"][0]) <= 1e-9 * energies["kinetic"][0]
    assert record.friction.sum() == pytest.approx(energies["friction"][0], rel=1e-12)


# history


def everything(sim):
    """Arrays of the state, and the record of the contact."""
    out = {f"state.{name}": values.copy() for name, values in sim.state.numpy().items()}
    return out | {f"record.{name}": values for name, values in vars(sim.contact_record("pad")).items()}


SINGLE = [("default", "float32"), ("explicit", "float32"), ("smooth", "float32")]


@pytest.mark.parametrize(("law", "dtype"), [*((law, "float64") for law in LAWS), *SINGLE])
@pytest.mark.parametrize(
    ("integrator", "max_newton"), [("backward_euler", 30), ("bdf2", 30), ("energy_momentum", 30), ("backward_euler", 6)]
)
@pytest.mark.parametrize("device", DEVICES)
def test_a_resumed_run_with_live_contacts_equals_the_undisturbed_one(
    tmp_path, device, integrator, max_newton, law, dtype
):  # fmt: skip
    """Also across halved steps."""
    path = tmp_path / "c.npz"
    options = {"integrator": integrator, "dt": 2e-3 if max_newton < 30 else DT}
    solver = wf.NewtonPCG(max_newton=max_newton)
    scene = {"device": device, "dtype": dtype, **LAWS[law]}
    whole, first, second = (wf.Simulation(thrown("rotation", **scene)[2], solver=solver, **options) for _ in "abc")
    whole.step(20)
    first.step(12)
    assert (first.state.contact_speed.numpy() > 0.0).any()
    save_checkpoint(first, path)
    second.resume(path)
    second.step(8)
    expected, found = everything(whole), everything(second)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


@pytest.mark.parametrize("device", DEVICES)
def test_a_refused_step_leaves_live_history_as_it_was(device):
    """Parts of the step that had been accepted are taken back."""
    b, cube, _ = thrown()
    b.add_traction(cube.surface("z+"), ([0, 0.0141, 0.0142], [(0, 0, 0), (0, 0, 0), (0, 0, -1e12)]))
    sim = wf.Simulation(b.finalize(device=device), dt=4e-3)
    sim.step(3)
    assert (sim.state.contact_speed.numpy() > 0.0).any()
    before = {name: values.copy() for name, values in sim.state.numpy().items()}
    with pytest.raises(wf.ConvergenceError):
        sim.step()
    for name, values in sim.state.numpy().items():
        np.testing.assert_array_equal(values, before[name], err_msg=name)


@pytest.mark.parametrize("device", DEVICES)
def test_a_reset_clears_history(device):
    sim = wf.Simulation(thrown("rotation", worlds=2, device=device)[2], dt=DT)
    sim.step(20)
    first = sim.positions(sim.model.bodies[0])[0]
    sim.reset([True, False])
    assert not sim.state.contact_speed.numpy()[0].any()
    sim.step(20)
    np.testing.assert_array_equal(sim.positions(sim.model.bodies[0])[0], first)


RAMPED = {"law": "paper", "smoothing": 1e-4}
"""The paper's implicit law where a step always has a solution: its damping is ramped in over 0.1 mm."""


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("place", ["plane", "path", "rotation", "ball", "capsule"])
@pytest.mark.parametrize("device", DEVICES)
def test_single_precision_runs(device, place, law):
    options = RAMPED if law == "paper" else LAWS[law]
    double, single = (simulated(30, place, device=device, dtype=dtype, **options) for dtype in DTYPES)
    cube = single.model.bodies[0]
    difference = single.positions(cube) - double.positions(double.model.bodies[0])
    assert np.abs(difference).max() < 2e-6
    energies = single.energies()
    assert abs(energies["ledger_residual"][0]) < 1e-4 * energies["kinetic"][0]
    force = single.contact_record("pad").normal_force[0]
    assert force == pytest.approx(double.contact_record("pad").normal_force[0], abs=2e-2 * force.max())


@pytest.mark.parametrize("place", ["plane", "path", "rotation", "ball", "capsule"])
def test_single_precision_runs_or_is_refused_by_name_with_the_papers_jump(place):
    """The unramped damping acts at once at the first touch: some steps have no solution, and are halved."""
    sim = wf.Simulation(thrown(place, dtype="float32", law="paper")[2], dt=DT)
    refused = ""
    try:
        sim.step(40)
    except wf.ConvergenceError as error:
        refused = str(error)
    assert not refused or "float32 can't hold this case" in refused
    assert np.isfinite(sim.state.displacement.numpy()).all()


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
        b.add_contact(cube, floor, mu=.5, restitution=.5, name=f"pad{k}")
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
    assert set(pad) == {"normal_force", "penetration", "force", "area", "stick"}
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
