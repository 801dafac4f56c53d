"""A term of one's own, see floor_term.py: forces, solvers, ledger, history, worlds."""

import functools

import numpy as np
import pytest
import warp as wp
from floor_term import Floor
from tight_solvers import SOLVERS

import warpfea as wf
from warpfea.simulation.checkpoint import load_checkpoint, save_checkpoint

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
DTYPES = ["float64", "float32"]


def block_on_floor(device="cpu", dtype="float64", worlds=1, velocity=(1.0, 0.0, -1.0), height=2e-3, options=None):
    b = wf.ModelBuilder()
    mesh = wf.mesh.box((0.1, 0.05, 0.05), cells=(4, 2, 2), origin=(0, 0, height))
    box = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000.0), name="box")
    b.set_initial(box, velocity=velocity)
    b.add_probe("corner", box.at((0, 0, height)))
    b.add_term(lambda model: Floor(model, **(options or {})))
    return b.finalize(device=device, dtype=dtype, worlds=worlds), box


def bounced(model, solver=None, steps=8, dt=1e-3, **options):
    sim = wf.Simulation(model, dt=dt, solver=solver, **options)
    sim.step(steps)
    return sim


def poised(device="cpu", dtype="float64", **options):
    """A simulation with a random state, partly below the floor, some of it stuck; its term evaluated."""
    model, _ = block_on_floor(device, dtype, height=-2e-2)
    sim = wf.Simulation(model, dt=1e-3, **options)
    rng = np.random.default_rng(1)
    ctx, term = sim.stepper.ctx, model.terms.find(Floor)
    ctx.state.floor_stuck.assign(rng.integers(0, 2, term.dim))
    ctx.state.floor_anchor.assign(rng.normal(scale=1e-3, size=(*term.dim, 3)))
    w = sim.stepper.work
    w.u.assign(rng.normal(scale=1e-3, size=(1, model.slots, 3)))
    w.step.dq_dv.fill_(1e-3)
    w.step.mass_factor.fill_(1e3)
    return sim, term, wp.ones(1, dtype=wp.int32, device=device)


def energy_at(sim, term, active, u):
    ctx = sim.stepper.ctx
    ctx.work.u.assign(u[None])
    term.force(ctx, active)
    return ctx.work.rows_of(term).numpy()[0].sum()


@pytest.mark.parametrize("device", DEVICES)
def test_forces_are_differences_of_the_energy(device):
    sim, term, active = poised(device)
    ctx = sim.stepper.ctx
    u = ctx.work.u.numpy()[0].copy()
    rng = np.random.default_rng(2)
    d = rng.normal(size=u.shape)
    high, low = (energy_at(sim, term, active, u + s * 1e-7 * d) for s in (1.0, -1.0))
    energy_at(sim, term, active, u)
    force = ctx.work.pool_force.numpy()[0]
    assert np.abs(force).max() > 1.0
    slope = (force * d[term.slots]).sum()
    assert slope == pytest.approx((high - low) / 2e-7, rel=1e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_product_is_the_difference_of_the_force(device):
    """Through the operator of the solver: elements, mass and the term."""
    sim, term, active = poised(device, solver=wf.NewtonPCG(operator="elements"))
    ctx, residual = sim.stepper.ctx, sim.stepper.newton.residual
    w, u = ctx.work, ctx.work.u.numpy()[0].copy()
    p = np.random.default_rng(3).normal(size=u.shape)

    def gradient(x):
        w.v_tilde.zero_()
        w.q_tilde.zero_()
        w.v.assign(x[None] / 1e-3)
        residual.evaluate(active)
        return w.gradient.numpy()[0].copy()

    high, low = (gradient(u + s * 1e-8 * p) for s in (1.0, -1.0))
    gradient(u)
    w.p.assign(p[None])
    residual.product(w.p, w.Hp, active)
    expected = 1e-3 * (high - low) / 2e-8
    product = w.Hp.numpy()[0]
    assert np.abs(product - expected).max() < 1e-6 * np.abs(expected).max()
    own = w.pool_product.numpy()[0]
    assert np.abs(1e-3 * own).max() > 1e-3 * np.abs(product).max()  # the term is felt


@functools.cache
def reference_motion():
    sim = bounced(block_on_floor()[0], SOLVERS["block-jacobi"])
    assert sim.state.floor_stuck.numpy().any()
    return sim.state.displacement.numpy(), sim.totals["pcg"][0]


@pytest.mark.parametrize("name", list(SOLVERS))
def test_solvers_agree(name):
    sim = bounced(block_on_floor()[0], SOLVERS[name])
    expected, pcg = reference_motion()
    assert np.abs(sim.state.displacement.numpy() - expected).max() < 1e-9 * np.abs(expected).max()
    if name == "direct":  # the factors hold the term: without it a solve takes several iterations
        assert sim.totals["pcg"][0] <= 1.2 * sim.totals["newton"][0]
    elif name != "block-jacobi":
        assert sim.totals["pcg"][0] < 0.7 * pcg


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("integrator", ["backward_euler", "bdf2"])
def test_ledger_closes(device, integrator):
    sim = wf.Simulation(block_on_floor(device)[0], dt=1e-3, integrator=integrator, solver=wf.NewtonPCG(tol=1e-10))
    stored, lost = [], []
    for _ in range(60):
        sim.step()
        e = sim.energies()
        stored.append(e["floor_stored"][0])
        lost.append(e["floor_lost"][0])
    assert max(stored) > 1e-3
    assert stored[-1] == pytest.approx(
        sim.model.terms.find(Floor).stored_energy(sim.stepper.ctx)["floor_stored"][0], abs=1e-12
    )
    assert np.all(np.diff(lost) >= 0.0)
    assert lost[-1] > 1e-6  # points have left
    scale = e["kinetic"][0] + e["strain"][0] + max(stored)
    assert abs(e["ledger_residual"][0]) < 1e-8 * scale
    assert abs(e["ledger_residual"][0] - e["unbalanced"][0]) < 1e-12 * scale
    assert e["integrator"][0] > -1e-6 * scale


def test_the_ledger_shows_a_wrong_force(monkeypatch):
    """Energy that the force does not derive from has nowhere to go but into the integrator's column."""
    right = bounced(block_on_floor()[0], steps=6).energies()
    energy_increments = Floor.energy_increments

    def tripled(self, ctx, accepted):
        rows = energy_increments(self, ctx, accepted)
        rows.assign(3.0 * rows.numpy())
        return rows

    monkeypatch.setattr(Floor, "energy_increments", tripled)
    got = bounced(block_on_floor()[0], steps=6, capture=False).energies()
    amiss = 2.0 * (right["floor_stored"][0] + right["floor_lost"][0])
    assert amiss > 1e-4
    assert got["integrator"][0] == pytest.approx(right["integrator"][0] - amiss, rel=1e-9)


def test_the_step_is_limited():
    """Falling fast: without the limit the first iterate goes through the floor by half the box."""
    free, held = (
        bounced(block_on_floor(velocity=(0, 0, -8.0), options=dict(k=1e7, depth=depth))[0], steps=3, dt=4e-3)
        for depth in (1.0, 1e-3)
    )
    assert held.totals["newton"][0] != free.totals["newton"][0]
    difference = np.abs(held.state.displacement.numpy() - free.state.displacement.numpy()).max()
    assert difference < 1e-6 * np.abs(free.state.displacement.numpy()).max()


def stuck_state(model, dt=1e-3):
    """A simulation in which some points stick, and a state of the same kind to start others from."""
    sim = bounced(model, wf.NewtonPCG(tol=1e-12), steps=5, dt=dt)
    assert sim.state.floor_stuck.numpy().any()
    return sim


def test_a_rejected_step_leaves_the_history():
    model = block_on_floor()[0]
    sim = stuck_state(model)
    before = sim.state.numpy()
    hard = wf.Simulation(model, sim.state.copy(), dt=1e-2, solver=wf.NewtonPCG(max_newton=1, max_halvings=2, tol=1e-12))
    with pytest.raises(wf.ConvergenceError):
        hard.step()
    after = hard.state.numpy()
    for name in ("floor_anchor", "floor_stuck", "displacement", "velocity", "ledger"):
        np.testing.assert_array_equal(after[name], before[name])


def test_halved_steps_are_short_steps():
    """A step that takes more iterations than there may be is done in two halves, history and ledger with it."""
    model = block_on_floor(velocity=(1.0, 0.0, -3.0))[0]
    long, short = (stuck_state(model, dt=5e-4) for _ in range(2))
    for most in range(2, 12):  # the fewest iterations that the half steps need are too few for the whole
        halved = wf.Simulation(
            model, long.state.copy(), dt=1.6e-2, solver=wf.NewtonPCG(max_newton=most, max_halvings=1, tol=1e-12)
        )
        try:
            halved.step()
        except wf.ConvergenceError:
            continue
        break
    assert halved.last.halvings[0] == 1
    halves = wf.Simulation(model, short.state.copy(), dt=8e-3, solver=wf.NewtonPCG(tol=1e-12))
    halves.step(2)
    for name in ("displacement", "velocity", "floor_anchor", "ledger"):
        a, b = halved.state.numpy()[name], halves.state.numpy()[name]
        assert np.abs(a - b).max() < 1e-8 * np.abs(b).max(), name
    np.testing.assert_array_equal(halved.state.floor_stuck.numpy(), halves.state.floor_stuck.numpy())


@pytest.mark.parametrize("solver", ["two-level", "banded"])
def test_resumed_runs_go_on_bit_for_bit(tmp_path, solver):
    whole = bounced(block_on_floor()[0], wf.NewtonPCG(preconditioner=solver), steps=6)
    save_checkpoint(whole, tmp_path / "c.npz")
    whole.step(6)
    resumed = wf.Simulation(block_on_floor()[0], dt=1e-3, solver=wf.NewtonPCG(preconditioner=solver))
    load_checkpoint(resumed, tmp_path / "c.npz")
    resumed.step(6)
    for name, values in whole.state.numpy().items():
        np.testing.assert_array_equal(resumed.state.numpy()[name], values, err_msg=name)
    with pytest.raises(wf.CheckpointError, match="another model"):
        load_checkpoint(wf.Simulation(block_on_floor(options=dict(k=1e3))[0], dt=1e-3), tmp_path / "c.npz")


def test_reset_forgets():
    model = block_on_floor()[0]
    sim = bounced(model, steps=6)
    first = sim.state.numpy()
    assert first["floor_stuck"].any()
    sim.reset()
    assert not sim.state.floor_stuck.numpy().any()
    sim.step(6)
    for name in ("displacement", "velocity", "floor_anchor", "floor_stuck"):
        np.testing.assert_array_equal(sim.state.numpy()[name], first[name])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("device", DEVICES)
def test_worlds_are_bit_equal_to_their_own_runs(device, dtype):
    speeds = (-1.0, -0.5, -2.0)
    many = wf.Simulation(block_on_floor(device, dtype, worlds=3)[0], dt=1e-3)
    v = many.state.velocity.numpy()
    for world, speed in enumerate(speeds):
        v[world, :, 2] = speed
    many.state.velocity.assign(v)
    many.step(8)
    for world, speed in enumerate(speeds):
        one = wf.Simulation(block_on_floor(device, dtype, velocity=(1.0, 0.0, speed))[0], dt=1e-3)
        one.step(8)
        for name in ("displacement", "velocity", "floor_anchor", "floor_stuck"):
            np.testing.assert_array_equal(many.state.numpy()[name][world], one.state.numpy()[name][0], err_msg=name)


def test_single_precision_follows_double():
    single, double = (bounced(block_on_floor(dtype=dtype)[0]) for dtype in ("float32", "float64"))
    a, b = single.state.displacement.numpy(), double.state.displacement.numpy()
    assert np.abs(a - b).max() < 1e-3 * np.abs(b).max()


def test_what_the_model_tells_of_it():
    model, box = block_on_floor()
    assert "floor" in model.info()["features"]
    sim = bounced(model, steps=6)
    gap = sim.field("floor_gap", box)
    assert gap.shape == (1, len(box.mesh.points))
    assert gap.min() < 0.0 < gap.max()
    np.testing.assert_allclose(gap[0], sim.positions(box)[0, :, 2], atol=1e-15)
    with pytest.raises(wf.ModelError, match="floor_gap"):
        sim.field("nothing", box)
    assert {"floor stiffness", "floor rows"} <= {name.partition(".")[2] for name in sim.bytes()}
    plain = wf.ModelBuilder()
    plain.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1.0))
    assert "floor" not in plain.finalize(device="cpu").info()["features"]
    with pytest.raises(wf.ModelError, match="add_term"):
        plain.add_term(3)
