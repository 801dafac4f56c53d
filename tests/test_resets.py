"""Resets and ends of single worlds, on the device; steps and end times of each world."""

import numpy as np
import pytest
import warp as wp
from loop_models import DEVICES, DT, QUIET, arms, bent, cubes, flags, same, stacks, values
from pairwise import covering

import warpfea as wf


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kind", [wp.int32, wp.bool])
@pytest.mark.parametrize("build", [cubes, arms, stacks])
def test_a_reset_world_restarts_and_others_go_on(build, kind, device):
    check_reset(build, kind, device=device)


@pytest.mark.parametrize(
    ("build", "how"),
    covering(
        [cubes, arms, stacks],
        [
            ("backward_euler", "float64"),
            ("bdf2", "float64"),
            ("energy_momentum", "float64"),
            ("generalized_alpha", "float64"),
            ("backward_euler", "float32"),
        ],
        strength=1,
    ),
)
def test_resets_with_every_integrator(build, how):
    integrator, dtype = how
    check_reset(build, wp.int32, dtype=dtype, integrator=integrator)


@pytest.mark.parametrize("solver", ["direct", "jacobi", "two-level", "banded", "block-jacobi"])
def test_resets_with_every_solver(solver):
    how = solver if solver in ("direct", "jacobi") else wf.NewtonPCG(preconditioner=solver)
    check_reset(arms, wp.int32, solver=how)


def check_reset(build, kind, dtype="float64", device="cpu", **options):
    """Worlds that are reset have the bits of a new run, and the others those of a run without resets."""
    model, options = build(4, dtype, device), QUIET | options
    sim, undisturbed = (wf.Simulation(model, dt=DT, **options) for _ in range(2))
    for s in (sim, undisturbed):
        s.step(25)
    sim.reset(flags(1, 2, dtype=kind, device=device))
    fresh = wf.Simulation(build(1, dtype, device), dt=DT, **options)
    assert same(values(sim, 1), values(fresh))
    for s in (sim, undisturbed, fresh):
        s.step(25)
    for world in range(4):
        assert same(
            values(sim, world), values(fresh if world in (1, 2) else undisturbed, 0 if world in (1, 2) else world)
        )


def test_what_is_done_is_reset_by_its_status():
    """At an end worlds are frozen by the step that gets there; what is written may be the mask itself."""
    sim = wf.Simulation(cubes(3), dt=DT, t_end=[0.02, 0.04, 0.04], **QUIET)
    report = sim.step(10)
    assert report.status.tolist() == [0, 0, 0]
    assert report.converged.all()
    assert sim.status.tolist() == [2, 0, 0]
    sim.reset(sim.state.status)
    assert sim.status.tolist() == [0, 0, 0]
    fresh = wf.Simulation(cubes(), dt=DT, t_end=0.02, **QUIET)
    assert same(values(sim, 0), values(fresh))
    sim.step(5)
    fresh.step(5)
    assert same(values(sim, 0), values(fresh))


@pytest.mark.parametrize("between", [0, 3])
@pytest.mark.parametrize("ledger", [False, True])
def test_a_reset_follows_parameters_that_were_set(ledger, between):
    """A world that begins strained begins with the energy that its constants now give it; others are not disturbed."""
    E, g = [1e6, 3e6, 1e6], [(0.0, 0.0, -9.81), (0.0, 0.0, -5.0), (0.0, 0.0, -9.81)]
    options = QUIET | {"ledger": ledger}
    models = [bent(3), bent(3), bent()]
    for model in models:
        model.set_parameter("bar.E", 1e6 if model.worlds == 3 else 3e6)
    models[2].set_gravity(g[1])
    sim, undisturbed, fresh = (wf.Simulation(model, dt=DT, **options) for model in models)
    for s, model in ((sim, models[0]), (undisturbed, models[1])):
        s.step(3)
        if s is sim:
            s.reset(flags(of=3))
        model.set_parameter("bar.E", E)
        model.set_gravity(g)
        if between:
            s.step(between)
    sim.reset(flags(1, of=3))
    assert same(values(sim, 1), values(fresh))
    for s in (sim, undisturbed, fresh):
        s.step(10)
    assert same(values(sim, 1), values(fresh))
    for world in (0, 2):
        assert same(values(sim, world), values(undisturbed, world))


def test_a_reset_that_is_refused_leaves_nothing_behind():
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    section = wf.Rectangle(0.02, 0.02)
    law = wf.SVK(E=1e9, nu=0.3, density=1000.0)
    bar = b.add_beam([(0, 0, 0), (0.3, 0, 0)], elements=2, section=section, normal=(0, 0, 1), material=law)
    b.add_joint("spherical", parent=wf.GROUND, child=bar.start, name="hook")
    b.set_initial(bar, displacement=lambda X: np.full_like(X, 0.05))
    model = b.finalize(device="cpu", worlds=2)
    state = model.state()
    state.displacement.zero_()
    sim = wf.Simulation(model, state, dt=DT, **QUIET)
    sim.step(5)
    before = [values(sim, world) for world in range(2)]
    with pytest.raises(wf.ConstraintError, match=r"'hook': initial violation 0\.05 m"):
        sim.reset(flags(0, of=2))
    assert all(same(values(sim, world), before[world]) for world in range(2))


@pytest.mark.parametrize("bad", [0.0, -1e-3, np.nan, np.inf])
def test_a_bad_step_on_the_device_fails_its_world_alone(bad):
    sim, undisturbed = wf.Simulation(cubes(2), dt=DT, **QUIET), wf.Simulation(cubes(), dt=DT, **QUIET)
    sim.dt = wp.array([DT, bad], dtype=wp.float64, device="cpu")
    for s in (sim, undisturbed):
        s.step(20)
    assert sim.status.tolist() == [0, 1]
    assert sim.time[1] == 0.0
    assert same(values(sim, 0), values(undisturbed))


def test_a_reset_to_a_state_that_was_kept():
    sim = wf.Simulation(cubes(4), dt=DT, **QUIET)
    sim.step(20)
    kept = sim.state.copy()
    sim.step(10)
    ahead = [values(sim, world) for world in range(4)]
    sim.reset(flags(0, 3), kept)
    sim.step(10)
    for world in (0, 3):
        assert same(values(sim, world), ahead[world])
    assert sim.time == pytest.approx(DT * np.array([30, 40, 40, 30]))


@pytest.mark.parametrize("on_device", [False, True])
def test_a_reset_with_a_ledger_and_records(on_device):
    """The ledger of the world restarts; records have the time of each world."""
    model = cubes(2)
    sim, fresh = wf.Simulation(model, dt=DT), wf.Simulation(cubes(), dt=DT)
    sim.step(25)
    sim.reset(flags(1, of=2) if on_device else [False, True])
    sim.step(10)
    fresh.step(10)
    energies, own = sim.energies(), fresh.energies()
    assert all(energies[name][1] == own[name][0] for name in own)
    time = sim.probe("top").time
    assert time.shape == (2, 35)
    assert time[:, -1] == pytest.approx([35 * DT, 10 * DT])
    sim.run(30 * DT)
    assert sim.time[0] == time[0, -1]  # it is past the end, and waits; until 8934ce7 it went on to 55 DT
    assert sim.time[1] == 30 * DT


def test_each_world_has_its_own_step_and_end():
    steps, ends = np.array([1e-3, 2e-3, 3e-3]), np.array([0.02, 0.05, 0.03])
    sim = wf.Simulation(cubes(3), dt=steps, t_end=ends, **QUIET)
    assert np.array_equal(sim.dt, steps)
    sim.step(40)
    assert np.array_equal(sim.status, [2, 2, 2])
    assert sim.time == pytest.approx([0.02, 0.05, 0.03])
    for world in range(3):
        alone = wf.Simulation(cubes(), dt=float(steps[world]), t_end=float(ends[world]), **QUIET)
        alone.step(40)
        assert same(values(sim, world), values(alone))
    sim.reset(flags(2, of=3))
    sim.dt = wp.array([1e-3, 1e-3, 5e-3], dtype=wp.float64, device="cpu")
    sim.t_end = 1.0
    sim.step(2)
    assert sim.time == pytest.approx([0.02, 0.05, 0.01])
    assert "0.001 to 0.005 s" in repr(sim)


def test_records_have_the_time_of_each_world():
    sim = wf.Simulation(cubes(2), dt=np.array([1e-3, 2e-3]))
    sim.step(5)
    assert sim.probe("top").time == pytest.approx(np.array([[1e-3], [2e-3]]) * np.arange(1, 6))
    assert sim.contact_record("pad").time.shape == (2, 5)


def test_resets_on_the_device_are_checked():
    model = cubes(2)
    sim = wf.Simulation(model, dt=DT, **QUIET)
    sim.step(3)
    before = [values(sim, world) for world in range(2)]
    for mask in (flags(0), wp.zeros(2, dtype=wp.float32, device="cpu")):
        with pytest.raises(wf.ModelError, match=r"reset: the mask is .* expected int32 or bool \(2,\) on cpu"):
            sim.reset(mask)
    with pytest.raises(wf.ModelError, match="state lacks 'status'"):
        sim.reset(flags(0, of=2), model.state())
    for mask in (flags(0, of=2), [True, False]):
        with pytest.raises(wf.ModelError, match="of another model"):
            sim.reset(mask, cubes(3).state())
        with pytest.raises(wf.ModelError, match=r"expected a State, got str; sim\.state is one"):
            sim.reset(mask, "start")
    assert all(same(values(sim, world), before[world]) for world in range(2))
    with pytest.raises(wf.ModelError, match="made without; give t_end to Simulation"):
        sim.t_end = 1.0
    sim.dt = [1e-3, 2e-3]
    with pytest.raises(wf.ModelError, match="worlds have times of their own"):
        sim.run(1.0)
