"""The operator's matrix kept from step to step: what a run that goes on from a state does, and what bounds its cost."""

import numpy as np
import pytest

import warpfea as wf


def box(*, late=0.0, spin=0.0, clamp=True, damping=None, velocity=None, solver=None, gravity=(0, 0, -10.0), dt=2e-3):
    b = wf.ModelBuilder(gravity=gravity)
    law = wf.SVK(E=1e7, nu=0.3, density=1000.0, damping=damping)
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(6, 2, 2)), material=law)
    if clamp:
        b.clamp(body.nodes("x-"))
    if late:
        times = [0.0, late, late + 1e-3, 1.0]
        b.add_traction(body.surface("x+"), (times, [(0, 0, 0), (0, 0, 0), (0, 0, -1e4), (0, 0, -1e4)]))
    if spin:
        b.set_initial(body, angular_velocity=(0, 0, spin))
    if velocity:
        b.set_initial(body, velocity=velocity)
    b.add_probe("tip", body.surface("x+"))
    return wf.Simulation(
        b.finalize(device="cpu"), dt=dt, solver=solver or wf.NewtonPCG(operator="matrix"), ledger=False
    )


def bits(sim):
    return {name: value.tobytes() for name, value in sim.state.numpy().items()}


def test_steps_without_an_iteration_leave_the_memory_alone():
    """Nothing moves before the load comes: those steps must not tell the state what they have not looked at."""
    sim = box(late=0.02, gravity=(0, 0, 0))
    sim.step(25)
    assert sim.totals["newton"][0] > 0
    first = bits(sim)
    sim.reset()
    sim.step(25)
    assert bits(sim) == first


@pytest.mark.parametrize("damping", [None, wf.KelvinVoigt(1e4, 1e4)])
def test_a_run_from_any_step_is_the_same(damping):
    solver = wf.NewtonPCG(force_tol=5.0, operator="matrix")  # now and then a step needs no iteration
    sim = box(damping=damping, solver=solver)
    states = []
    for _ in range(12):
        states.append(sim.state.copy())
        sim.step()
    end = bits(sim)
    for k in (1, 4, 7, 11):
        other = box(damping=damping, solver=solver)
        other.reset(state=states[k])
        other.step(12 - k)
        assert bits(other) == end


def test_a_run_goes_on_the_same_where_kept_matrices_serve_badly():
    """A box that spins: memory of how a matrix served decides at the start of steps."""
    sim = box(spin=15.0, clamp=False)
    states, paces = [], []
    for _ in range(25):
        states.append(sim.state.copy())
        sim.step()
        paces.append(sim.state.numpy()["operator"][0, 5])
    assert len(set(paces)) > 10
    end = bits(sim)
    for k in range(1, 25):
        other = box(spin=15.0, clamp=False)
        other.reset(state=states[k])
        other.step(25 - k)
        assert bits(other) == end, k


def test_a_refused_step_leaves_no_trace():
    good, tried = (
        box(spin=40.0, clamp=False, solver=wf.NewtonPCG(max_newton=6, max_halvings=0, max_work=40, operator="matrix"))
        for _ in range(2)
    )
    for sim in (good, tried):
        sim.step(4)
    before = tried.state.copy()
    tried.dt = 1e2
    with pytest.raises(wf.ConvergenceError):
        tried.step()
    tried.dt = 2e-3
    tried.reset(state=before)
    good.step(4)
    tried.step(4)
    np.testing.assert_array_equal(tried.state.displacement.numpy(), good.state.displacement.numpy())


@pytest.mark.parametrize("most", [6, 8])
def test_few_iterations_are_enough_where_they_are_with_the_elements(most):
    for operator in ("elements", "matrix"):
        solver = wf.NewtonPCG(max_newton=most, operator=operator)
        sim = box(spin=60.0, clamp=False, solver=solver, dt=1e-2)
        halvings = sum(int(sim.step().halvings[0]) for _ in range(10))
        assert halvings == 0, operator


def test_impacts_of_damped_bodies_cost_no_halvings():
    counts = {}
    for operator in ("elements", "matrix"):
        solver = wf.NewtonPCG(operator=operator)
        sim = box(damping=wf.KelvinVoigt(1e5, 1e5), velocity=(-30.0, 0, 0), solver=solver, dt=1e-2)
        reports = [sim.step() for _ in range(10)]
        assert sum(int(r.halvings[0]) for r in reports) == 0, operator
        counts[operator] = sum(int(r.newton[0]) for r in reports)
    assert counts["matrix"] < 1.7 * counts["elements"]


def test_states_go_on_with_another_solver():
    """Its memory is no part of the motion."""
    sim = box()
    sim.step(5)
    expected = None
    for options in ({}, {"operator": "elements"}, {"preconditioner": "block-jacobi"}, {"linear": "direct"}):
        other = box(solver=wf.NewtonPCG(tol=1e-10, **options))
        other.state.load(sim.state.numpy())
        other.stepper.invalidate()
        other.step(5)
        tip = other.probe("tip").displacement[0, -1]
        expected = tip if expected is None else expected
        np.testing.assert_allclose(tip, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("count", [0, -1, 1.5, True, "2"])
def test_the_number_of_steps_is_checked(count):
    with pytest.raises(wf.ModelError, match="whole number"):
        box().step(count)


@pytest.mark.parametrize(
    "options",
    [{"tol": "a"}, {"force_tol": None}, {"forcing": "a"}, {"max_pcg": "9"}, {"max_newton": 1.5}, {"max_newton": True},
     {"max_halvings": 2.5}, {"penalty": "x"}, {"preconditioner": None}],
)  # fmt: skip
def test_options_of_the_wrong_kind_are_named(options):
    (name,) = options
    with pytest.raises(wf.ModelError, match=name):
        wf.NewtonPCG(**options)
