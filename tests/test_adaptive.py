"""dt="auto": errors asked for and met, and steps that follow from the state alone."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from adaptive_bars import KICK, LAW, SCHEMES, auto, bar

import warpfea as wf
from warpfea.simulation.checkpoint import Checkpoint
from warpfea.simulation.integrators.bdf2 import bdf2, bdf2_error


def everything(sim):
    out = {f"state.{name}": values for name, values in sim.state.numpy().items()}
    out |= {f"total.{name}": values for name, values in sim.totals.items()}
    return out | {"tip": sim.probe("tip").displacement, "time": sim.probe("tip").time}


def same(a, b):
    a, b = everything(a), everything(b)
    assert a.keys() == b.keys()
    for name, values in a.items():
        np.testing.assert_array_equal(b[name], values, err_msg=name)


# what is asked


def test_the_error_follows_what_is_asked():
    """A point mass on nothing: a free body in gravity, whose fall backward Euler misses by h g t / 2."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    body = b.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), material=LAW)
    model = b.finalize(device="cpu")
    found = []
    for end, error in ((0.2, 1e-2), (0.2, 1e-3), (0.2, 1e-4), (0.3, 1e-3)):
        sim = auto(model, error)
        sim.run(end)
        assert sim.time[0] == pytest.approx(end, rel=1e-12)
        fall = sim.displacements(body)[0, :, 2] + 0.5 * 9.81 * end**2
        found.append(np.abs(fall).max() / model.size / error)
    assert min(found) > 0.1
    assert max(found) < 1.0  # a share of the error is asked of the estimates, and steps are halves of halves


@wp.kernel
def weights(h: wp.array(dtype=wp.float64), before: wp.array(dtype=wp.float64), out: wp.array2d(dtype=wp.float64)):
    k = wp.tid()
    e = bdf2_error(h[k], before[k])
    c = bdf2(h[k], before[k], wp.float64(0.0))
    for i in range(3):
        out[k, i] = e[i]
    out[k, 3] = c.a0
    out[k, 4] = c.a1
    out[k, 5] = c.dq_dv


def test_bdf2_estimate_is_the_error_of_its_formula():
    """Weights against the formula's residual at t = 0 for q = t^3, at several ratios; in the first step for q = t^2."""
    h = np.full(5, 0.1)
    before = np.array([0.2, 0.1, 0.05, 0.07, 0.0])
    out = wp.zeros((5, 6), dtype=wp.float64, device="cpu")
    wp.launch(weights, 5, [wp.array(h, dtype=wp.float64), wp.array(before, dtype=wp.float64), out], device="cpu")
    for k, row in enumerate(out.numpy()):
        power = 3 if before[k] else 2
        t = np.array([0.0, -h[k], -h[k] - before[k]])
        q, v = t**power, power * t ** (power - 1)
        missed = q[0] - (row[3] * q[1] - row[4] * q[2] + row[5] * v[0])
        assert row[:3] @ v == pytest.approx(-missed, rel=1e-12)
        assert row[:3].sum() == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("integrator", SCHEMES)
def test_means_are_those_of_the_rates(integrator):
    """Every interval is one substep: rates and their running means, from the velocities in numpy."""
    h, count = 1e-4, 30
    sim = auto(bar(), 1e-1, integrator=integrator, interval=h, horizon=1e-2)
    v = [sim.state.velocity.numpy()[0].copy()]
    mean, seen, mean_step = np.zeros_like(v[0]), 0, None
    for _ in range(count):
        sim.step()
        v.append(sim.state.velocity.numpy()[0].copy())
        assert sim.totals["substeps"][0] == len(v) - 1
        order = 1 if integrator == "backward_euler" else 2
        mean_step = 0.125 * 1e-2 * 0.1 ** (1.0 / order) if mean_step is None else mean_step
        span = max(h, 0.125 * mean_step)
        mean_step += (h - mean_step) / 256.0
        if integrator == "backward_euler":
            rate = 0.5 * h * (v[-1] - v[-2]) / span
        elif len(v) == 2:
            continue  # of order 1
        else:
            rate = 2.0 / 9.0 * h * (v[-1] - 2.0 * v[-2] + v[-3]) / span
        seen = min(seen + 1, 16)
        mean = mean + (rate - mean) / seen
    assert span == h
    found = sim.state.adaptive_means.numpy()[0]
    np.testing.assert_allclose(found, mean, atol=1e-9 * np.abs(mean).max())
    assert sim.state.adaptive.numpy()[0, 2] == 16.0


def test_a_vibration_smaller_than_the_error_is_not_resolved():
    """A box in slow rotation with an axial vibration of a tenth of the error asked for, 64 periods of it."""
    error, end, spin, mean_step = 1e-3, 0.4, 2.0, np.pi * np.sqrt(1e8 / 1000.0)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=1e8, nu=0.3, density=1000.0)
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=law)

    def velocity(X):
        x, z = X[:, 0] - 0.5, X[:, 2] - 0.1
        return np.column_stack([-0.1 * error * mean_step * np.cos(np.pi * X[:, 0]) - spin * z, 0.0 * x, spin * x])

    b.set_initial(body, velocity=velocity)
    model = b.finalize(device="cpu")
    sim = auto(model, error, integrator="bdf2", interval=end / 4, horizon=end)
    start = sim.positions(body)[0]
    sim.run(end)
    c, s = np.cos(spin * end), np.sin(spin * end)
    x, y, z = (start - [0.5, 0.1, 0.1]).T
    turned = np.column_stack([c * x - s * z, y, s * x + c * z]) + [0.5, 0.1, 0.1]
    assert np.linalg.norm(sim.positions(body)[0] - turned, axis=1).max() <= 2.0 * error * model.size
    assert sim.totals["substeps"][0] < 3 * mean_step * end / (2.0 * np.pi)  # 7 in each period where every rate is held


@pytest.mark.parametrize("integrator", SCHEMES)
def test_steps_are_halved_kept_or_doubled(integrator):
    """Sizes are the interval over powers of two, and so are their ratios."""
    sim = auto(bar(), 1e-3, integrator=integrator, interval=0.05, horizon=0.1)
    for _ in range(3):
        report = sim.step()
        sizes = np.log2(0.05 / np.array([report.least_h[0], report.largest_h[0]]))
        assert np.abs(sizes - np.round(sizes)).max() < 1e-6
        assert report.least_h[0] <= 0.05 / report.substeps[0] * (1 + 1e-9) <= report.largest_h[0] * (1 + 2e-9)
        assert report.rejected[0] <= report.halvings[0]
    assert sim.time[0] == pytest.approx(0.15, rel=1e-15)
    assert sim.totals["substeps"][0] > 20


def test_a_kick_is_met_on_its_kink_and_with_short_steps():
    sim = auto(bar(gravity=(0, 0, 0), kick=True), 1e-4, integrator="bdf2")
    sizes = {}
    sim.run(0.05, on_step=lambda s: sizes.update({float(s.time[0]): float(s.last.least_h[0])}))
    times = np.array(list(sizes))
    for kink in (KICK, KICK + 1e-3):
        assert np.abs(times - kink).min() < 1e-15
    before = [h for t, h in sizes.items() if 0.3 * KICK < t < KICK]
    after = [h for t, h in sizes.items() if KICK + 1e-12 < t < KICK + 2e-3]
    assert min(after) < 0.25 * min(before)
    assert times[-1] == pytest.approx(0.05, rel=1e-14)


@pytest.mark.parametrize(("integrator", "most"), [("backward_euler", 60), ("bdf2", 40)])
def test_an_impact_is_passed_in_few_substeps(integrator, most):
    """A velocity that jumps at any step: 37 and 22 substeps, 1661 and 254 where each is judged by its own size."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), origin=(0, 0, 0.0503))
    body = b.add_solid(mesh, material=wf.SVK(E=1e12, nu=0.3, density=1000.0))
    b.set_initial(body, velocity=(0, 0, -1.0))
    b.add_contact(body, b.add_collider(wf.HalfSpace((0, 0, 1), 0.0)))
    sim = auto(b.finalize(device="cpu"), 2e-2, integrator=integrator, horizon=0.1, interval=1e-2)
    sim.run(0.06)
    assert sim.totals["substeps"][0] < most
    assert abs(sim.velocities(body)[0, :, 2].mean()) < 0.1


# bits of the state


@pytest.mark.parametrize("integrator", SCHEMES)
def test_worlds_equal_runs_of_their_own(integrator):
    gravity = [(0, 0, -9.81), (0, -80.0, 0), (0, 0, 0)]
    model = bar(worlds=3)
    model.set_gravity(gravity)
    together = auto(model, 1e-4, integrator=integrator, interval=0.02)
    together.run(0.02)
    assert len(set(together.totals["substeps"].tolist())) == 3
    for world, pull in enumerate(gravity):
        alone = auto(bar(gravity=pull), 1e-4, integrator=integrator, interval=0.02)
        alone.run(0.02)
        np.testing.assert_array_equal(alone.probe("tip").time, together.probe("tip").time)
        np.testing.assert_array_equal(alone.probe("tip").displacement[0], together.probe("tip").displacement[world])
        np.testing.assert_array_equal(alone.state.adaptive.numpy()[0], together.state.adaptive.numpy()[world])
        assert alone.totals["newton"][0] == together.totals["newton"][world]


@pytest.mark.parametrize("integrator", SCHEMES)
def test_a_resumed_run_takes_the_same_steps(tmp_path, integrator):
    path = tmp_path / "bar.npz"
    whole, first, second = (auto(bar(kick=True), 1e-3, integrator=integrator) for _ in range(3))
    whole.run(0.05)
    first.run(0.05, outputs=[Checkpoint(path, every=7)], on_step=lambda s: s.time[0] < 0.02)
    second.resume(path)
    assert 0.02 <= second.time[0] < 0.021  # it stopped: numpy's False is one
    second.run(0.05)
    same(whole, second)


def test_a_failed_step_leaves_the_state_of_its_start():
    """The state to go back to is that of the step's start, also where the first refusal comes later."""
    sim = auto(bar(kick=True), 1e-2, solver=wf.NewtonPCG(max_newton=1, max_halvings=0), interval=0.02, horizon=0.1)
    before = sim.state.numpy()
    with pytest.raises(wf.ConvergenceError, match=r"dt = 'auto', error = 0\.01"):
        sim.step(9)
    assert sim.steps == 0
    for name in ("displacement", "velocity", "time", "adaptive"):
        np.testing.assert_array_equal(sim.state.numpy()[name], before[name], err_msg=name)


def test_float32_runs_and_refuses_what_it_does_not_resolve():
    with pytest.raises(wf.ModelError, match=r"below float32 round-off \(1e-05 of the model size\); use float64"):
        auto(bar(dtype="float32"), 1e-6)
    tips = []
    for dtype in ("float32", "float64"):
        sim = auto(bar(dtype=dtype), 1e-3, integrator="bdf2")
        sim.run(0.05)
        tips.append(sim.probe("tip").displacement[0, -1])
    assert np.abs(tips[0] - tips[1]).max() < 1e-3


def falling(E, dtype, error, horizon):
    """A bar on a hinge that falls."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    law = wf.SVK(E=E, nu=0.3, density=1000.0)
    rod = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(6, 1, 1)), material=law)
    b.add_joint("revolute", parent=wf.GROUND, child=rod.surface("x-"), axis=(0, 1, 0))
    b.add_probe("tip", rod.surface("x+"))
    model = b.finalize(device="cpu", dtype=dtype)
    return auto(model, error, integrator="bdf2", horizon=horizon, interval=horizon / 64)


@pytest.mark.parametrize(
    ("E", "error", "horizon", "end"), [(1e7, 1e-4, 2.0, 0.25), (1e7, 3e-5, 1.0, 0.1), (1e9, 1e-5, 0.3, 0.1)]
)
def test_float32_takes_what_it_promises_on_a_pendulum(E, error, horizon, end):
    """Round-off of displacements is no error of the step.

    Fails on 8934ce7: refused at 0.1875 s and 0.0703 s, "no step is short enough for the error asked for".
    """
    tips, counts = [], []
    for dtype in ("float64", "float32"):
        sim = falling(E, dtype, error, horizon)
        sim.run(end)
        tips.append(sim.probe("tip").position[0, -1])
        counts.append(sim.totals["substeps"][0])
    assert np.linalg.norm(tips[1] - tips[0]) < error * sim.model.size  # 0.08 and 0.15 of it
    assert counts[1] < 1.1 * counts[0]


def test_float32_is_refused_where_round_off_hides_the_errors():
    """Without the refusal the error is 1.3 times that asked for after 0.2 s, 142 times after 0.4 s."""
    sim = falling(1e9, "float32", 1e-5, 0.8)
    with pytest.raises(
        wf.ConvergenceError, match=r"hides the local errors of substeps.*use float64, or error = 1\.\de-05"
    ):
        sim.run(0.3)
    reference = falling(1e9, "float64", 1e-5, 0.8)
    reference.run(sim.time[0])
    tips = [s.probe("tip").position[0, -1] for s in (sim, reference)]
    assert np.linalg.norm(tips[1] - tips[0]) < 1e-5 * sim.model.size


@pytest.mark.parametrize("integrator", SCHEMES)
def test_the_twist_of_a_beam_counts(integrator):
    """Its axis does not move: only the gradients across it do, by half the section. Steps of 20 us as reference."""

    def twisted(**options):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        beam = b.add_beam(
            [(0, 0, 0), (1, 0, 0)], elements=2, section=wf.Rectangle(0.1, 0.1), normal=(0, 0, 1), material=LAW
        )
        b.clamp(beam.start, slots="all")
        b.add_moment(beam.end, (2.0, 0, 0))
        sim = wf.Simulation(b.finalize(device="cpu"), integrator=integrator, **options)
        sim.run(0.1, progress=False)
        return sim.state.displacement.numpy()[0, beam.slots]

    error = 1e-3
    surface = 0.05 * np.abs(twisted(dt="auto", error=error) - twisted(dt=2e-5))[4:].max()
    assert surface <= 5.0 * error
