"""dt="auto": errors asked for and met, decisions that are bits of the state, instants, and what is refused."""

from __future__ import annotations

import json
import pathlib

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.cli import main
from warpfea.simulation.checkpoint import Checkpoint
from warpfea.simulation.integrators import Integrator
from warpfea.simulation.integrators.backward_euler import BACKWARD_EULER
from warpfea.simulation.integrators.bdf2 import bdf2, bdf2_error
from warpfea.simulation.sync_times import SyncTimes
from warpfea.time_laws import time_law

RESULT = pathlib.Path(__file__).resolve().parent / "results" / "adaptive_cpu.json"
SCHEMES = ("backward_euler", "bdf2")
LAW = wf.SVK(E=1e6, nu=0.3, density=1000.0)
KICK = 0.0123


def bar(*, worlds=1, dtype="float64", gravity=(0, 0, -9.81), kick=False):
    b = wf.ModelBuilder(gravity=gravity)
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=LAW, name="bar")
    b.clamp(body.nodes("x-"))
    if kick:
        pull = [(0, 0, 0), (0, 0, 0), (0, 0, 3e3), (0, 0, 3e3)]
        b.add_traction(body.surface("x+"), ([0, KICK, KICK + 1e-3, 1.0], pull))
    b.add_probe("tip", body.surface("x+"))
    return b.finalize(device="cpu", dtype=dtype, worlds=worlds)


def auto(model=None, error=1e-3, **options):
    return wf.Simulation(model or bar(), dt="auto", error=error, **options)


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
    for error in (1e-2, 1e-3, 1e-4):
        sim = auto(model, error)
        sim.run(0.2)
        assert sim.time[0] == pytest.approx(0.2, rel=1e-12)
        fall = sim.displacements(body)[0, :, 2] + 0.5 * 9.81 * 0.2**2
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


# instants


def test_kinks_of_tables_are_instants_and_samples_of_curves_are_not():
    t = np.linspace(0.0, 1.0, 201)
    smooth = time_law((t, np.column_stack([np.sin(20.0 * t), 0 * t, 0 * t])), "curve")
    ramp = time_law(([0.0, 0.1, 0.100001, 5.0], [(0, 0, 0), (0, 0, 0), (1, 0, 0), (1, 0, 0)]), "ramp")
    assert SyncTimes([smooth], 1.0, 1.0).kinks.tolist() == [0.0, 1.0]  # where it begins and ends
    assert SyncTimes([ramp, time_law((1, 0, 0), "constant")], 1.0, 1.0).kinks.tolist() == [0.1, 0.100001]


def test_a_short_pulse_is_seen_beside_a_jump():
    """A jump is so steep that slopes of all else are small beside it: the pulse lies between two instants."""
    start, half = 0.0101, 1e-4
    times = [0.0, start, start + half, start + 2 * half, 0.5, 0.5 + 1e-7, 1.0]
    load = np.outer([0, 0, 1e5, 0, 0, 1e5, 1e5], [1.0, 0, 0])
    law = time_law((times, load), "pull")
    assert set(times[1:4]) <= set(SyncTimes([law], 1.0, 1.0).kinks)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), material=LAW)
    b.add_traction(body.surface("x+"), (times, load))
    model = b.finalize(device="cpu")
    sim = auto(model, 1e-3, integrator="bdf2")
    sim.run(0.05)
    speed = model.lumped_host @ sim.state.velocity.numpy()[0, :, 0] / model.lumped_host.sum()
    assert speed == pytest.approx(1e5 * half / 1000.0, rel=0.25)  # impulse over mass; unseen: 0


@pytest.mark.parametrize("start", [1e4, 1e6])
def test_a_late_start_ends(start):
    """Rounding of the time is above a billionth of the interval."""
    model = bar()
    state = model.state()
    state.time.fill_(start)
    sim = auto(model, 1e-2)
    sim.run(0.1)
    late = wf.Simulation(model, state, dt="auto", error=1e-2)
    late.run(start + 0.1)
    assert late.time[0] == pytest.approx(start + 0.1, abs=64.0 * np.spacing(start))
    way = np.abs(sim.probe("tip").displacement[0, -1]).max()
    assert np.abs(late.probe("tip").displacement[0, -1] - sim.probe("tip").displacement[0, -1]).max() < 1e-3 * way


def test_an_interval_within_the_rounding_of_the_time_is_refused():
    sim = auto(bar(), 1e-2, interval=1e-20, horizon=0.1)
    with pytest.raises(wf.ModelError, match=r"interval 1e-20 s is below the round-off of t = .*: use a longer one"):
        sim.run(0.1)


def test_a_checkpoint_of_fixed_steps_is_refused(tmp_path):
    fixed = wf.Simulation(bar(), dt=1e-3)
    fixed.run(2e-3, outputs=[Checkpoint(tmp_path / "c.npz")])
    with pytest.raises(wf.CheckpointError, match=r"dt of the checkpoint is 0\.001, of the simulation 'auto'"):
        auto().resume(tmp_path / "c.npz")


def test_instants_are_intervals_frames_moments_and_the_end():
    class Frames:
        rate = 30.0
        moments = (0.0101,)

    sync_times = SyncTimes([], None, None)
    sync_times.add_outputs([Frames()])
    sync_times.set_defaults(0.0, 0.1)
    assert (1.0 / 30.0 / sync_times.interval) % 1.0 == pytest.approx(0.0, abs=1e-12)
    count = sync_times.count(0.0, 0.1)
    times = [0.0]
    while times[-1] < 0.1 - 1e-12:
        times.append(sync_times.next_after(times[-1]))
    assert len(times) == count + 1
    for due in (0.0101, 1.0 / 30.0, 2.0 / 30.0, 0.1):
        assert np.abs(np.array(times) - due).min() < 1e-15
    assert np.diff(times).min() > 1e-6


def test_a_whole_interval_has_always_the_same_bits():
    sync_times = SyncTimes([], 0.01, 1.0)
    sync_times.set_defaults(0.0)
    time, spans = np.zeros(1), set()
    for _ in range(300):
        span = sync_times.time_to_next(time)
        spans.add(float(span[0]))
        time = time + span
    assert spans == {0.01}


# what is refused


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"dt": "Auto", "error": 1e-4}, "dt = 'Auto' must be a positive finite time"),
        ({"dt": "auto"}, "needs error"),
        ({"dt": "auto", "error": 0.0}, "needs error"),
        ({"dt": "auto", "error": -1e-4}, "needs error"),
        ({"dt": "auto", "error": float("nan")}, "needs error"),
        ({"dt": "auto", "error": 2.0}, "needs error"),
        ({"dt": "auto", "error": "1e-4"}, "needs error"),
        ({"dt": "auto", "error": 1e-12}, "below float64 round-off"),
        ({"dt": 1e-3, "error": 1e-4}, "error = 0.0001 is for dt = 'auto'"),
        ({"dt": 1e-3, "interval": 1e-4}, "interval = 0.0001 is for dt = 'auto'"),
        ({"dt": "auto", "error": 1e-4, "interval": 0.0}, "interval = 0.0 must be"),
        ({"dt": "auto", "error": 1e-4, "horizon": -1.0}, "horizon = -1.0 must be"),
        ({"dt": "auto", "error": 1e-4, "solver": "jacobi"}, "needs solver 'newton-pcg'"),
    ],
)
def test_bad_input_is_refused_by_name(options, text):
    with pytest.raises(wf.ModelError, match=text):
        wf.Simulation(bar(), **options)


def test_schemes_without_an_estimate_are_refused():
    to_json = Integrator("plain", BACKWARD_EULER.coefficients, order=1)
    with pytest.raises(wf.ModelError, match="'plain' has no estimate of its error; there are backward_euler, bdf2"):
        auto(integrator=to_json)


@pytest.mark.parametrize("integrator", ["energy_momentum", wf.GeneralizedAlpha(rho_inf=0.8)])
def test_energy_momentum_and_generalized_alpha_are_refused_by_name(integrator):
    with pytest.raises(wf.ModelError, match=r"'(energy_momentum|generalized_alpha)' has no estimate of its error"):
        auto(integrator=integrator)


def test_float32_runs_and_refuses_what_it_does_not_resolve():
    with pytest.raises(wf.ModelError, match=r"below float32 round-off \(1e-05 of the model size\); use float64"):
        auto(bar(dtype="float32"), 1e-6)
    tips = []
    for dtype in ("float32", "float64"):
        sim = auto(bar(dtype=dtype), 1e-3, integrator="bdf2")
        sim.run(0.05)
        tips.append(sim.probe("tip").displacement[0, -1])
    assert np.abs(tips[0] - tips[1]).max() < 1e-3


@pytest.mark.parametrize(("E", "error", "horizon", "end"), [(1e7, 1e-4, 2.0, 0.25), (1e9, 1e-5, 0.3, 0.1)])
def test_float32_takes_what_it_promises_on_a_pendulum(E, error, horizon, end):
    """A bar on a hinge falls: what rounds the displacements is no error of the step.

    Fails on 8934ce7: refused at 0.1875 s and 0.0703 s, "no step is short enough for the error asked for".
    """
    tips, counts = [], []
    for dtype in ("float64", "float32"):
        b = wf.ModelBuilder(gravity=(0, 0, -9.81))
        law = wf.SVK(E=E, nu=0.3, density=1000.0)
        rod = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(6, 1, 1)), material=law)
        b.add_joint("revolute", parent=wf.GROUND, child=rod.surface("x-"), axis=(0, 1, 0))
        b.add_probe("tip", rod.surface("x+"))
        model = b.finalize(device="cpu", dtype=dtype)
        sim = auto(model, error, integrator="bdf2", horizon=horizon, interval=horizon / 64)
        sim.run(end)
        tips.append(sim.probe("tip").position[0, -1])
        counts.append(sim.totals["substeps"][0])
    assert np.linalg.norm(tips[1] - tips[0]) < error * model.size  # 0.08 and 0.15 of it
    assert counts[1] < 1.1 * counts[0]


def test_a_longer_run_settles_its_own_interval():
    """A pulse of 1 ms with a run of its own, then 1 s. Fails on 8934ce7: 64 109 substeps, intervals of the pulse's."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    law = wf.SVK(E=1e6, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(eta=1e3))
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=law)
    b.clamp(body.nodes("x-"))
    b.add_traction(body.surface("x+"), ([0.0, 5e-4, 1e-3], [(0, 0, 0), (0, 0, 3e4), (0, 0, 0)]))
    b.add_probe("tip", body.surface("x+"))
    model = b.finalize(device="cpu")
    split, whole = auto(model, integrator="bdf2"), auto(model, integrator="bdf2")
    split.run(1e-3)
    assert split.dt == pytest.approx(1e-3 / 64)
    for sim in (split, whole):
        sim.run(1.001)
    assert split.dt == pytest.approx(1.0 / 64)
    assert whole.totals["substeps"][0] < split.totals["substeps"][0] < 2 * whole.totals["substeps"][0]
    fine = auto(model, 1e-4, integrator="bdf2")
    fine.run(1.001)
    tips = [sim.probe("tip").displacement[0, -1] for sim in (split, fine)]
    assert np.linalg.norm(tips[0] - tips[1]) < 1e-3 * model.size
    interval = split.dt
    split.run(1.5)  # no longer than the last
    assert split.dt == interval


def test_dt_can_not_be_set():
    sim = auto()
    with pytest.raises(wf.ModelError, match="made with dt = 'auto'"):
        sim.dt = 1e-3
    assert "dt = auto, error = 0.001" in repr(sim)


def test_a_fixed_step_has_nothing_of_it():
    sim = wf.Simulation(bar(), dt=1e-3)
    report = sim.step()
    assert report.substeps is None
    assert report.least_h is None
    assert "adaptive" not in sim.state.names
    assert not any("adaptive" in module.name for module in sim.stepper.modules())
    assert not any("adaptive" in name.lower() for name in sim.bytes())
    assert "substeps" not in sim.totals


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


def test_a_fall_that_no_step_resolves_is_refused_by_name():
    model = bar()
    model.set_gravity([(0, 0, -1e9)])
    sim = wf.Simulation(model, dt="auto", error=1e-6, interval=0.05)
    with pytest.raises(wf.ConvergenceError, match=r"error tolerance was not met within 65536 substeps"):
        sim.step()


# the command line


def test_the_command_line_adapts_steps(tmp_path, capsys):
    out = tmp_path / "out.json"
    options = ["run", "pendulum", "--set", "elements=2", "--t-end", "0.05", "--device", "cpu", "--json", str(out)]
    assert main([*options, "--dt", "auto", "--error", "1e-4"]) == 0
    printed = capsys.readouterr().out
    summary = json.loads(out.read_text())
    assert f"{summary['substeps']} adaptive steps" in printed
    assert summary["substeps"] > summary["steps"]
    assert f"{summary['newton_iterations'] / summary['substeps']:.1f} Newton" in printed
    assert summary["dt"] == "auto"
    assert summary["t_end"] == pytest.approx(0.05, rel=1e-12)
    assert main([*options, "--dt", "auto"]) == 2
    assert "--dt auto needs --error" in capsys.readouterr().err
    assert main([*options, "--error", "1e-3"]) == 2
    assert "--error is for --dt auto" in capsys.readouterr().err


# the committed study

SMOOTH = ("stiff", "dead_points", "free_flight")
STRUCK = ("impact", "contact")
SCENES = (*SMOOTH, *STRUCK, "soft_contact")
ERRORS = (1e-2, 1e-3, 1e-4, 1e-5)
NOT_RUN = {("impact", "backward_euler", 1e-4), ("impact", "backward_euler", 1e-5), ("contact", "backward_euler", 1e-5)}
"""They would take 3e5, 3e6 and 1e5 steps."""


def study(scene, integrator):
    content = json.loads(RESULT.read_text())
    return [row for row in content["adaptive"] if (row["scene"], row["integrator"]) == (scene, integrator)]


@pytest.mark.parametrize("scene", SCENES)
def test_references_are_ten_times_finer_than_what_they_judge(scene):
    """A run for a quarter of the error has at most a third of the difference left."""
    content = json.loads(RESULT.read_text())
    (own,) = [row["own_error"] / 3.0 for row in content["references"] if row["scene"] == scene]
    assert 10.0 * own <= min(row["true"] for row in content["adaptive"] if row["scene"] == scene)


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("scene", SCENES)
def test_true_errors_keep_to_those_asked(scene, integrator):
    rows = study(scene, integrator)
    assert len(rows) >= 2
    for row in rows:
        assert 0.01 <= row["true"] / row["asked"] <= 5.0


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("scene", SCENES)
def test_true_errors_fall_as_those_asked(scene, integrator):
    rows = study(scene, integrator)
    slope = np.polyfit(np.log([row["asked"] for row in rows]), np.log([row["true"] for row in rows]), 1)[0]
    assert 0.8 <= slope <= 1.2


COSTLY = {
    ("impact", "backward_euler"): (
        {1e-2, 1e-3},
        "1.06, 0.75: the flight after the blow alone takes 0.70 and 0.40, with the steps that the best fixed one has",
    ),
    ("contact", "bdf2"): (
        {1e-2},
        "1.92: 16 and 32 fixed steps, longer than the contact, are at 1.4e-2 and 6.7e-3 by chance, 64 at 2.6e-2",
    ),
}
"""What misses the iterations asked for: at which errors, and by how much."""


def costs():
    for scene in SMOOTH + STRUCK:
        for integrator in SCHEMES:
            missed, reason = COSTLY.get((scene, integrator), (set(), ""))
            for error in ERRORS:
                if (scene, integrator, error) not in NOT_RUN:
                    marks = [pytest.mark.xfail(strict=True, reason=reason)] if error in missed else []
                    yield pytest.param(scene, integrator, error, marks=marks)


@pytest.mark.parametrize(("scene", "integrator", "error"), list(costs()))
def test_newton_iterations_beside_the_best_fixed_step(scene, integrator, error):
    """At most 1.5 times those of the best fixed step on smooth motions, 0.7 times with an impact."""
    (row,) = [row for row in study(scene, integrator) if row["asked"] == error]
    assert row["cost"] <= (1.5 if scene in SMOOTH else 0.7), row
