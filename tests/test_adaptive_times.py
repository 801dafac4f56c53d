"""dt="auto": instants that steps end at, what is refused, and the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from adaptive_bars import LAW, auto, bar

import warpfea as wf
from warpfea.cli import main
from warpfea.simulation.adaptive import SyncTimes
from warpfea.simulation.checkpoint import Checkpoint
from warpfea.simulation.integrators import Integrator
from warpfea.simulation.integrators.backward_euler import BACKWARD_EULER
from warpfea.time_laws import time_law


def test_kinks_of_tables_are_instants_and_samples_of_curves_are_not():
    t = np.linspace(0.0, 1.0, 201)
    smooth = time_law((t, np.column_stack([np.sin(20.0 * t), 0 * t, 0 * t])), "curve")
    ramp = time_law(([0.0, 0.1, 0.100001, 5.0], [(0, 0, 0), (0, 0, 0), (1, 0, 0), (1, 0, 0)]), "ramp")
    assert SyncTimes([smooth], 1.0, 1.0).kink_times.tolist() == [0.0, 1.0]  # where it begins and ends
    assert SyncTimes([ramp, time_law((1, 0, 0), "constant")], 1.0, 1.0).kink_times.tolist() == [0.1, 0.100001]


def test_a_short_pulse_is_seen_beside_a_jump():
    """A jump is so steep that slopes of all else are small beside it: the pulse lies between two instants."""
    start, half = 0.0101, 1e-4
    times = [0.0, start, start + half, start + 2 * half, 0.5, 0.5 + 1e-7, 1.0]
    load = np.outer([0, 0, 1e5, 0, 0, 1e5, 1e5], [1.0, 0, 0])
    law = time_law((times, load), "pull")
    assert set(times[1:4]) <= set(SyncTimes([law], 1.0, 1.0).kink_times)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), material=LAW)
    b.add_traction(body.surface("x+"), (times, load))
    model = b.finalize(device="cpu")
    sim = auto(model, 1e-3, integrator="bdf2")
    sim.run(0.05)
    speed = model.masses.lumped[0] @ sim.state.velocity.numpy()[0, :, 0] / model.masses.lumped[0].sum()
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
        output_times = (0.0101,)

    sync_times = SyncTimes([], None, None)
    sync_times.add_outputs([Frames()])
    sync_times.set_defaults(0.0, 0.1)
    assert (1.0 / 30.0 / sync_times.interval) % 1.0 == pytest.approx(0.0, abs=1e-12)
    count = sync_times.count_between(0.0, 0.1)
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
    scheme = Integrator("plain", BACKWARD_EULER.coefficients, order=1)
    with pytest.raises(wf.ModelError, match="'plain' has no estimate of its error; there are backward_euler, bdf2"):
        auto(integrator=scheme)


@pytest.mark.parametrize("integrator", ["energy_momentum", wf.GeneralizedAlpha(rho_inf=0.8)])
def test_energy_momentum_and_generalized_alpha_are_refused_by_name(integrator):
    with pytest.raises(wf.ModelError, match=r"'(energy_momentum|generalized_alpha)' has no estimate of its error"):
        auto(integrator=integrator)


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
