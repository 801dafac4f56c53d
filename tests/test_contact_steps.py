"""Contact through a Simulation: refused steps, the start, energies and momentum, history."""

from __future__ import annotations

import numpy as np
import pytest
from contact_runs import DEVICES, DT, DTYPES, PLACES, TIGHT, simulated, thrown
from pairwise import on_devices

import warpfea as wf
from warpfea.simulation.checkpoint import save_checkpoint
from warpfea.studies.stress.build import GRAVITY_VECTOR
from warpfea.studies.stress.cases.first_scenes import add_body


def falling(shape, *, E, speed, solver=None, worlds=1, stiffness=None, **options):
    """A cube of 0.1 m that flies at an obstacle below it: simulation with steps of 10 ms, and the cube."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    material = wf.SVK(E=E, nu=0.3, density=1000)
    cube = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(2, 2, 2)), material=material, name="cube")
    b.add_contact(cube, b.add_collider(shape, name="plate"), restitution=0.5, stiffness=stiffness, name="pad")
    model = b.finalize(device="cpu", worlds=worlds)
    state = model.state()
    velocity = state.velocity.numpy()
    velocity[:, :, 2] = -np.broadcast_to(speed, (worlds,))[:, None]
    state.velocity.assign(velocity)
    return wf.Simulation(model, state, dt=1e-2, solver=solver, **options), cube


def thin(thickness=0.02, gap=0.05):
    """A plate of which the upper face lies `gap` below the cube, m."""
    return wf.Box((0.05, 0.05, -gap - 0.5 * thickness), (0.5, 0.5, thickness))


# refused steps


@pytest.mark.parametrize("E", [1e9, 1e10, 1e11])
def test_nothing_gets_behind_a_thin_plate(E):
    sim, cube = falling(thin(), E=E, speed=100.0, stiffness="region")
    lowest = []
    for _ in range(5):
        sim.step()
        lowest.append(sim.positions(cube)[0, :, 2].min())
    assert min(lowest) > -0.06  # the middle of the plate
    assert sim.contact_record("pad").normal_force.max() > 0.0


@pytest.mark.parametrize("E", [1e3, 1e5, 1e7])
def test_an_impact_that_is_too_fast_is_named(E):
    sim, cube = falling(thin(), E=E, speed=100.0, stiffness="region")
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
    law = {"E": 1e6, "stiffness": "region"}
    sim, cube = falling(thin(gap=0.005), speed=speeds, worlds=3, **law)
    sim.step(4)
    assert sim.status.tolist() == [0, 1, 0]
    assert np.isnan(sim.contact_record("pad").force[1]).all()
    for world in (0, 2):
        alone, body = falling(thin(gap=0.005), speed=speeds[world], **law)
        alone.step(4)
        np.testing.assert_array_equal(sim.positions(cube)[world], alone.positions(body)[0])
        np.testing.assert_array_equal(sim.contact_record("pad").force[world], alone.contact_record("pad").force[0])
    assert sim.contact_record("pad").normal_force[[0, 2]].max() > 1.0
    sim, _ = falling(thin(gap=0.005), speed=speeds, worlds=3, on_failure="raise", **law)
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
        resting(0.002, overlap="refuse")


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


ON_GPU = ("plane", "rotation", "capsule")
SCHEMES = ("backward_euler", "bdf2", "energy_momentum")


@pytest.mark.parametrize(
    ("device", "place", "law", "integrator"), on_devices(PLACES, LAWS, SCHEMES, cuda=(ON_GPU, LAWS, SCHEMES))
)
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
    mass = model.masses.lumped[0]
    momentum = [mass @ sim.state.velocity.numpy()[0]]
    for _ in range(40):
        sim.step()
        momentum.append(mass @ sim.state.velocity.numpy()[0])
    impulse = DT * (sim.contact_record("pad").force[0] + model.mass * np.array([0, 0, -9.81]))
    change = np.diff(momentum, axis=0)
    return np.abs(change - impulse).max() / np.abs(change).max()


@pytest.mark.parametrize(("device", "place", "law"), on_devices(PLACES, LAWS, strength=1, cuda=(ON_GPU, LAWS)))
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
    mass = model.masses.lumped[0]
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
    speed = np.linalg.norm(begin[:2]) / model.mass  # m/s, which friction lowers
    assert 0.7 < record.slip.max() / (4e-3 * speed) < 1.0  # also where the area shrinks between halves


# history


def everything(sim):
    """Arrays of the state, and the record of the contact."""
    out = {f"state.{name}": values.copy() for name, values in sim.state.numpy().items()}
    return out | {f"record.{name}": values for name, values in vars(sim.contact_record("pad")).items()}


SINGLE = [("default", "float32"), ("explicit", "float32"), ("smooth", "float32")]
STEPPED = [("backward_euler", 30), ("bdf2", 30), ("energy_momentum", 30), ("backward_euler", 6)]
"""Integrators, and Newton iterations before a step is halved."""


@pytest.mark.parametrize(
    ("device", "scheme", "law"), on_devices(STEPPED, [*((law, "float64") for law in LAWS), *SINGLE], strength=1)
)
def test_a_resumed_run_with_live_contacts_equals_the_undisturbed_one(tmp_path, device, scheme, law):
    """Also across halved steps."""
    (integrator, max_newton), (law, dtype) = scheme, law
    path = tmp_path / "c.npz"
    options = {"integrator": integrator, "dt": 2e-3 if max_newton < 30 else DT}
    solver = wf.NewtonPCG(max_newton=max_newton)
    scene = {"device": device, "dtype": dtype, "stiffness": "region", **LAWS[law]}
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


@pytest.mark.parametrize(
    ("device", "place", "law"), on_devices(["plane", "path", "rotation", "ball", "capsule"], LAWS, strength=1)
)
def test_single_precision_runs(device, place, law):
    options = {"stiffness": "region"} | (RAMPED if law == "paper" else LAWS[law])
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
    assert not refused or "float32 round-off limit reached" in refused
    assert np.isfinite(sim.state.displacement.numpy()).all()


@pytest.mark.parametrize("gap", [1e-5, 4.9e-5])
def test_friction_begins_where_a_point_touches(gap):
    """A soft cube that comes down at a slope of 0.09 to a floor and touches it within the step sticks: friction has
    seen the part of its slip in contact, a fifth or a fiftieth of it, not all, with which it would slide."""
    nu, slope, speed, dt = 0.3, 0.09, 0.05, 1e-3
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), origin=(0, 0, gap))
    cube = b.add_solid(mesh, material=wf.SVK(E=100.0, nu=nu, density=1000.0))
    b.add_contact(cube, b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.2, restitution=1.0, name="pad")
    b.set_initial(cube, velocity=(slope * speed, 0.0, -speed))
    sim = wf.Simulation(b.finalize(), dt=dt)
    sim.step()
    record = sim.contact_record("pad")
    force = record.force[0, -1]
    assert record.stick[0, -1] == 1.0
    assert -force[0] / force[2] == pytest.approx(3.0 * (1.0 - nu) / (2.0 - nu) * slope, rel=5e-3)  # k_t / k_n, slope


def bar_on_the_floor(E, h, integrator, steps):
    """Newton iterations of the steps in which a bar of rubber falls 2 mm onto a floor and settles."""
    b = wf.ModelBuilder(gravity=GRAVITY_VECTOR)
    body = add_body(b, "bar", E, 2e-3, "bar", damped=True)
    b.add_contact(body, b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.3)
    b.set_initial(body, velocity=(0.2, 0.0, -1.0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=h, integrator=integrator)
    return [int(sim.step().newton[0]) for _ in range(steps)]


def test_midpoint_steps_of_a_body_at_rest_do_not_begin_deep_in_the_floor():
    """By first iterates taken from the velocity, which alternates, 11 iterations each."""
    assert max(bar_on_the_floor(1e4, 1e-2, "energy_momentum", 40)[20:]) <= 4


def test_an_impact_taken_again_begins_where_the_first_attempt_ended():
    """26 and 33 iterations from the velocity."""
    newton = bar_on_the_floor(1e8, 1e-2, "generalized_alpha", 9)
    assert newton[0] <= 20
    assert newton[8] <= 26
