"""`warpfea study identify`: stiffness and damping from a recorded, noisy motion, over many worlds at once.

A finger of rubber, 0.12 x 0.02 x 0.02 m of T10, is clamped at one end and let go under gravity; its tip is recorded for
0.24 s with noise of 1 % of the largest deflection. The record comes from a run of four times as many steps with E and
eta that the search does not know. scipy's differential evolution looks for both, a generation at a time: each candidate
is a world of one model (`wf.fit`). The misfit is the mean square of the differences of all samples. With `--gradients`
least squares with the derivatives of one motion at a time look for both from a poor start, of that record and of one
without noise or finer steps, which they must find exactly.

tests/results/identify_cpu.json, identify_h200.json, with 4096 worlds, and identify_gradients_cpu.json are the committed
results.
"""

import argparse
import time as clock
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

import warpfea as wf

from ..base.console import format_number, quiet_warp, to_json, write_json
from ..base.devices import find_device
from ..base.provenance import provenance_of
from ..base.writer import check_target

__all__ = ["Identification", "identify", "record_tip", "run"]

TRUE_CONSTANTS = {"E": 1.27e6, "eta": 4300.0}
SEARCH_BOUNDS = {"E": (4e5, 4e6), "eta": (4e2, 4e4)}
NOISE_RATIO = 0.01
DT, T_END = 2e-3, 0.24
RECORD_REFINEMENT = 4
GENERATIONS, WORLDS = 16, 64
POOR_START = {"finger.E": 3e6, "finger.eta": 3e4}
GRADIENT_TOL = 1e-9
"""Tolerance of the steps of a gradient."""


@wf.scene(dt=DT, t_end=T_END, integrator="bdf2", tol=1e-6)
def finger() -> wf.ModelBuilder:
    """The finger; its constants are set for each world."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    law = wf.NeoHookean.from_E_nu(E=1e6, nu=0.45, density=1100.0, damping=wf.KelvinVoigt(eta=1e3))
    body = b.add_solid(wf.mesh.box((0.12, 0.02, 0.02), cells=(4, 1, 1)), material=law, name="finger")
    b.clamp(body.nodes("x-"))
    b.add_probe("tip", body.surface("x+"))
    return b


def record_tip(
    device: Any, t_end: float = T_END, seed: int = 7, *, noise: float = NOISE_RATIO,
    refinement: int = RECORD_REFINEMENT, tol: float = 1e-6,
) -> np.ndarray:  # fmt: skip
    """The tip's deflection (steps, 3), m, every `DT`, of the true constants, with noise over the largest."""
    model = finger().finalize(device=device)
    for name, value in TRUE_CONSTANTS.items():
        model.set_parameter(f"finger.{name}", value)
    how: dict[str, Any] = {"integrator": finger.integrator, "solver": wf.NewtonPCG(tol=tol), "ledger": False}
    sim = wf.Simulation(model, dt=DT / refinement, **how)
    sim.step(refinement * round(t_end / DT))
    samples = sim.probe("tip").displacement[0, refinement - 1 :: refinement]
    return samples + noise * np.abs(samples).max() * np.random.default_rng(seed).normal(size=samples.shape)


@dataclass(frozen=True)
class Identification:
    """Result of a search.

    Attributes:
        E, eta: Pa, Pa s; E_error, eta_error: over the truth.
        misfit: root of the mean square of the differences, over the largest deflection.
        runs: motions of a world; backward_runs: Jacobians of one.
        time_s: of the search, without compilation.
    """

    device: str
    worlds: int
    generations: int
    steps: int
    unknowns: int
    noise: float
    E: float
    eta: float
    E_error: float
    eta_error: float
    misfit: float
    runs: int
    backward_runs: int
    setup_s: float
    time_s: float


def identify(
    samples: np.ndarray, *, device: Any, worlds: int = WORLDS, generations: int = GENERATIONS, seed: int = 1,
    gradients: bool = False, noise: float = NOISE_RATIO,
) -> Identification:  # fmt: skip
    """Look for E and eta that give the recorded deflections (steps, 3), m.

    The worlds are the candidates, or `gradients` lead from `POOR_START`.
    """
    times = DT * np.arange(1, len(samples) + 1)
    record = {f"probe.tip.displacement.{axis}": (times, column) for axis, column in zip("xyz", samples.T)}
    ranges = {f"finger.{name}": {"low": a, "high": b, "log": True} for name, (a, b) in SEARCH_BOUNDS.items()}
    run = {"device": str(device), "t_end": float(times[-1]), "ledger": False}
    began = clock.perf_counter()
    one = {text: (time[:1], column[:1]) for text, (time, column) in record.items()}
    wf.fit(finger, ranges, one, worlds=2, generations=1, run=run | {"t_end": DT})  # compiles
    how: dict[str, Any] = {"worlds": worlds, "generations": generations, "seed": seed}
    if gradients:
        worlds, generations, run = 1, 0, run | {"tol": GRADIENT_TOL}
        how = {"method": "least_squares", "start": POOR_START}
        wf.fit(finger, ranges, one, **how, run=run | {"t_end": DT})  # compiles
    ready = clock.perf_counter()
    found = wf.fit(finger, ranges, record, **how, run=run)
    values = {name: found.values[f"finger.{name}"] for name in TRUE_CONSTANTS}
    errors = {f"{name}_error": abs(value / TRUE_CONSTANTS[name] - 1.0) for name, value in values.items()}
    model = finger().finalize(device=device)
    return Identification(
        device=str(model.device), worlds=worlds, generations=generations, steps=len(samples),
        unknowns=model.info()["unknowns"], noise=noise, **values, **errors,
        misfit=found.misfit / np.abs(samples).max(), runs=found.runs,
        backward_runs=found.backward_runs, setup_s=ready - began, time_s=clock.perf_counter() - ready,
    )  # fmt: skip


def run(options: argparse.Namespace) -> None:
    """Do `warpfea study identify`."""
    if options.out is not None:
        check_target(options.out, (".json",))
    device = find_device(options.device)
    given: dict[str, Any] = {"worlds": options.worlds or WORLDS, "generations": 3 if options.quick else GENERATIONS}
    if options.gradients:
        given = {}
    settings = {"start": POOR_START, "tol": GRADIENT_TOL} if options.gradients else dict(given)
    settings |= {"truth": TRUE_CONSTANTS, "bounds": SEARCH_BOUNDS, "noise": NOISE_RATIO}
    settings |= {"dt": DT, "t_end": T_END}
    with quiet_warp():
        content = {"schema": 1, **provenance_of(options.words, device), "settings": settings}
        found = [identify(record_tip(device), device=device, gradients=options.gradients, **given)]
        if options.gradients:
            exact = record_tip(device, noise=0.0, refinement=1, tol=GRADIENT_TOL)
            found.append(identify(exact, device=device, gradients=True, noise=0.0))
    rows = [asdict(each) for each in found]
    for row in rows:
        print("  ".join(f"{k} {format_number(v) if isinstance(v, float) else v}" for k, v in row.items()), flush=True)
    if options.out is not None:
        write_json(options.out, to_json(content | {"rows": rows}))
