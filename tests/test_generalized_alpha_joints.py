"""Generalized-alpha with joints, drives and damping: orders, the start, kinks of laws."""

import numpy as np
import pytest
from pairwise import covering
from soft_links import EXACT, JUMP, double_pendulum, links, pulled, swing, turning

import warpfea as wf
from warpfea.simulation.consistent_initial_conditions import constraint_rates
from warpfea.simulation.discontinuities import jump_intervals, kink_times


def series(make, h, rho, end=0.016, halved=False):
    """Times, and displacement, velocity and reaction over time; `halved`: every third step is made in two halves."""
    model, state = make()
    sim = wf.Simulation(model, state, dt=h, integrator=wf.GeneralizedAlpha(rho_inf=rho), solver=EXACT)
    keep = []
    for k in range(round(end / h)):
        if halved and k % 3 == 1:
            sim.dt = h / 2
            sim.step(2)
            sim.dt = h
        else:
            sim.step()
        keep.append(len(sim.probe("tip").time) - 1)
    e = sim.energies()
    assert abs(e["ledger_residual"] - e["unbalanced"]) < 1e-12 * abs(e["strain"] + e["kinetic"])
    probe, joint = sim.probe("tip"), sim.joint_record("pivot")
    return [x[0][keep] for x in (probe.displacement, probe.velocity, joint.force)]


def orders(make, rho, halved=False, h=2e-4):
    """Observed orders of the largest errors of q, v, and the reaction after ten steps; of the limit of finer steps."""
    fine, finer = (series(make, h / n, rho) for n in (4, 8))
    limit = [(4.0 * b[1::2] - a) / 3.0 for a, b in zip(fine, finer)]
    errors = []
    for n in (1, 2):
        every = 4 // n
        found = series(make, h / n, rho, halved=halved)
        off = [np.linalg.norm(a - b[every - 1 :: every], axis=1) for a, b in zip(found, limit)]
        errors.append([off[0].max(), off[1].max(), off[2][9:].max()])
    return np.log2(np.array(errors[0]) / errors[1])


def driven_link():
    b, bodies, anchor = links(1, drive=swing)
    model = b.finalize(device="cpu")
    return model, turning(model, bodies, anchor, 5.0)


@pytest.mark.parametrize(("make", "rho", "halved"), covering([double_pendulum, driven_link], [0.5, 0.8], [False, True]))
def test_order_with_joints(make, rho, halved):
    assert orders(make, rho, halved)[:2] == pytest.approx([2.0, 2.0], abs=0.1)


@pytest.mark.parametrize("make", [double_pendulum, driven_link])
def test_reactions_are_of_the_second_order(make):
    assert orders(make, 0.8, h=4e-4)[2] == pytest.approx(2.0, abs=0.1)


# the start


def test_rates_of_constraints_equal_differences():
    """Rates of all kinds of rows, with a law that moves, against differences of the rows' own values."""
    b, bodies, anchor = links(2, drive=swing)
    b.add_constraint("DIST", points=(bodies[0].at((0.1, 0, 0.01)), bodies[1].at((0.3, -0.02, 0.03))), value=0.2)
    model = b.finalize(device="cpu")
    tables, random = model.constraints, np.random.default_rng(1)
    u, v = 1e-2 * random.standard_normal((2, model.slots, 3))
    state, t, s = model.state(), 0.013, 1e-4

    def value(when):
        state.displacement.assign((u + (when - t) * v)[None])
        state.time.fill_(when)
        return model.evaluation.constraint_values(state)[0]

    def law(when):
        return np.array([0.25 * np.sin(20 * when) + 20 * when**2 + 800 * when**3, 0, 0])[None]

    laws = [law(t), (law(t + s) - law(t - s)) / (2 * s), (law(t + s) - 2 * law(t) + law(t - s)) / s**2]
    gradients, first, second = constraint_rates(tables, u, v, np.array(laws))
    c = [value(t + k * s) for k in (-1, 0, 1)]
    assert np.abs(first - (c[2] - c[0]) / (2 * s)).max() < 1e-6 * np.abs(first).max()
    assert np.abs(second - (c[2] - 2 * c[1] + c[0]) / s**2).max() < 1e-5 * np.abs(second).max()
    value(t)
    assert np.abs(tables.expand_jacobian(gradients) - model.terms.constraints.jacobian(state, 0)).max() < 1e-12


def test_the_start_is_in_equilibrium_and_obeys_the_joints():
    """w_0 by the matrices of the model alone: M w + J^T m = f - f_int, J w = -c''."""
    model, state = double_pendulum()
    before = state.velocity.numpy().copy()
    sim = wf.Simulation(model, state, dt=1e-4, integrator="generalized_alpha")
    sim.stepper.initial_conditions.prepare(sim.dt)
    assert np.abs(state.velocity.numpy() - before).max() < 1e-5  # of h^2 w', and the velocities were consistent
    w = state.acceleration.numpy()[0].ravel()
    J = model.terms.constraints.jacobian(model.state(), 0).toarray()
    gravity = np.tile([0, 0, -9.81], model.slots)
    force = model.mass_matrix() @ (gravity - w)  # that the constraints must carry
    carried = np.linalg.lstsq(J.T, force, rcond=1e-11)[0]
    assert np.abs(J.T @ carried - force).max() < 1e-12 * np.abs(force).max()
    _, _, second = constraint_rates(model.constraints, np.zeros((model.slots, 3)), before[0], np.zeros((3, 1, 3)))
    assert np.abs(J @ w + second).max() < 1e-12 * np.abs(w).max()


def test_an_equilibrium_stays():
    """From statics nothing accelerates, also where contact carries the body."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    cube = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    b.add_contact(cube, b.add_collider(wf.HalfSpace((0, 0, 1), 0.0)), mu=0.5)
    model = b.finalize(device="cpu")
    start = wf.solve_static(model, stabilise=True, tol=1e-12)
    rest = start.displacements(cube)[0]
    sim = wf.Simulation(model, start.state, dt=1e-3, integrator="generalized_alpha", solver=EXACT)
    sim.step(20)
    assert np.abs(sim.state.acceleration.numpy()).max() < 1e-4
    assert np.abs(sim.displacements(cube)[0] - rest).max() < 1e-9


def test_velocities_that_joints_forbid_are_taken_in_the_first_step():
    """A link at rest whose hinge begins to turn: an impulse, which the ledger books."""
    b, bodies, _ = links(1, gravity=(0, 0, 0), drive=([0.0, 1.0], [0.0, 3.0]))
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=1e-4, integrator="generalized_alpha", solver=EXACT)
    sim.stepper.initial_conditions.prepare(sim.dt)
    still, laws = np.zeros((model.slots, 3)), np.zeros((3, 1, 3))
    laws[1, 0, 0] = 3.0
    rates = constraint_rates(model.constraints, still, sim.state.velocity.numpy()[0], laws)[1]
    assert np.abs(rates).max() < 1e-7  # of h^2 w'; the hinge turns at 3 rad/s
    e = {name: value[0] for name, value in sim.energies().items()}
    assert e["kinetic"] > 0.0
    assert e["integrator"] == pytest.approx(-e["kinetic"], rel=1e-12)
    sim.step(3)
    e = {name: value[0] for name, value in sim.energies().items()}
    assert abs(e["ledger_residual"]) < 1e-9 * e["kinetic"]


def test_accelerations_of_a_state_that_another_scheme_advanced_are_computed_again():
    """Accelerations belong to the state that they were made with, whatever other schemes keep in it."""
    model, state = double_pendulum()
    for scheme, steps in (("generalized_alpha", 3), ("bdf2", 2)):
        wf.Simulation(model, state, dt=1e-3, integrator=scheme).step(steps)
    fresh = model.state()
    for name in ("displacement", "velocity", "time"):
        getattr(fresh, name).assign(getattr(state, name))
    found = []
    for start in (state, fresh):
        sim = wf.Simulation(model, start, dt=1e-3, integrator="generalized_alpha", solver=EXACT)
        sim.step(2)
        assert sim.stepper.initial_conditions.restart_count == 1
        found.append(sim.state.displacement.numpy())
    assert np.abs(found[0] - found[1]).max() < 1e-12 * np.abs(found[0]).max()


# kinks


def test_kinks_of_a_law():
    smooth = np.linspace(0, 1, 60)
    laws = {
        "ramp": wf.time_laws.time_law(([0.0, 0.5, 1.0], [0.0, 1.0, 1.0]), "x", scalar=True),
        "jump": wf.time_laws.time_law(([0.0, 0.5, 0.5 + 1e-9, 1.0], [0.0, 0.0, 1.0, 1.0]), "x", scalar=True),
        "sine": wf.time_laws.time_law((smooth, np.sin(6 * smooth)), "x", scalar=True),
        "constant": wf.time_laws.time_law(2.0, "x", scalar=True),
    }
    assert kink_times(laws["ramp"], 1e-3).tolist() == [0.0, 0.5]
    assert jump_intervals(laws["ramp"], 1e-3).size == 0
    assert jump_intervals(laws["jump"], 1e-3).tolist() == [[0.5, 0.5 + 1e-9]]
    assert kink_times(laws["jump"], 1e-3).size == 0
    assert set(kink_times(laws["sine"], 1e-3)) <= {0.0, 1.0}
    assert kink_times(laws["constant"], 1e-3).size == jump_intervals(laws["constant"], 1e-3).size == 0


@pytest.mark.parametrize("load", [True, False], ids=["load", "drive"])
def test_order_across_a_kink(load):
    model, ends = pulled(load), []
    for h in (2e-4, 1e-4, 1.25e-5):
        sim = wf.Simulation(model, dt=h, integrator="generalized_alpha", solver=EXACT)
        sim.step(round(3 * JUMP / h))
        assert sim.stepper.initial_conditions.restart_count == 2
        ends.append(np.concatenate([sim.probe("tip").displacement[0, -1], 1e-2 * sim.probe("tip").velocity[0, -1]]))
        if not load:  # exactly as driven, without an oscillation
            k = round(JUMP / h)
            speed = sim.probe("root").velocity[0, :, 0]
            assert np.abs(speed[:k] - 0.25).max() < 1e-9
            assert np.abs(speed[k:]).max() < 1e-9
        e = {name: value[0] for name, value in sim.energies().items()}
        assert abs(e["ledger_residual"] - e["unbalanced"]) < 1e-12 * (e["kinetic"] + e["strain"])
    errors = [np.linalg.norm(end - ends[2]) for end in ends[:2]]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


# damping


@pytest.mark.parametrize("form", ["incremental", "rate"])
def test_order_with_damping(form):
    def make():
        b, bodies, anchor = links(1, damping=wf.KelvinVoigt(20.0, 30.0, form=form))
        model = b.finalize(device="cpu")
        return model, turning(model, bodies, anchor, 5.0)

    assert orders(make, 0.8, halved=True)[:2] == pytest.approx([2.0, 2.0], abs=0.1)
