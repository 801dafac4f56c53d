"""`warpfea study jacobi`: error and cost of wf.Jacobi.

Four scenes from rest under gravity: a soft and a stiff T10 bar and a slender 3243 beam, each clamped at one end, and
the double pendulum with its joints. For 2 to 32 iterations, with and without the coarse space, and each acceleration:
the largest error of the tip in any step, over the way that it goes, against Newton's method with tol = 1e-10; ms per
step; the relative residual that the steps say is left; the share of steps within the default tolerance. Newton's method
itself stands beside it, also with loose tolerances. tests/results/jacobi_cpu.json is the committed result.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time as clock
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import warpfea as wf
from warpfea.builder.scene import find
from warpfea.solvers.jacobi import ACCELERATIONS

from .parts import run_tables

__all__ = ["rows", "run"]

ITERATIONS = (2, 4, 8, 16, 32)
TOLERANCES = (1e-8, 1e-4, 1e-2)
WARM = 5


def bar(E: float) -> wf.ModelBuilder:
    """A T10 bar of 1 x 0.2 x 0.2 m."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(8, 2, 2)), material=wf.SVK(E=E, nu=0.3, density=1000.0))
    b.clamp(body.nodes("x-"))
    b.add_probe("tip", body.surface("x+"))
    return b


def beam() -> wf.ModelBuilder:
    """A beam of 64 elements, 1 m long and 3 cm thick."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    law = wf.SVK(E=1e7, nu=0.3, density=1000.0)
    line = [(0, 0, 0), (1, 0, 0)]
    body = b.add_beam(line, elements=64, section=wf.Rectangle(0.03, 0.03), normal=(0, 0, 1), material=law)
    b.clamp(body.start, slots="all")
    b.add_probe("tip", body.end)
    return b


def pendulum() -> wf.ModelBuilder:
    """The scene double_pendulum."""
    scene = find("double_pendulum")
    return scene.build(scene.resolve({}))


SCENES: dict[str, tuple[Callable[[], wf.ModelBuilder], float]] = {
    "soft T10 bar, E = 1e5 Pa": (lambda: bar(1e5), 5e-3),
    "stiff T10 bar, E = 1e9 Pa": (lambda: bar(1e9), 5e-3),
    "3243 beam, E = 1e7 Pa": (beam, 5e-3),
    "double pendulum, joints": (pendulum, 4e-3),
}


def simulate(model: Any, dt: float, steps: int, solver: Any) -> tuple[dict[str, Any], np.ndarray]:
    """Step; what it took, and the way of the first probe (steps, 3). A named error is an outcome."""
    sim = wf.Simulation(model, dt=dt, solver=solver, ledger=False)
    times, residuals, halvings, outcome = [], [], 0, "done"
    try:
        for _ in range(steps):
            began = clock.perf_counter()
            report = sim.step()
            times.append(clock.perf_counter() - began)
            residuals.append(float(report.residual[0]))
            halvings += int(report.halvings[0])
    except wf.Error as error:
        outcome = f"{type(error).__name__} after {len(times)} steps"
    done = max(len(times), 1)
    row = {
        "outcome": outcome,
        "ms_per_step": 1e3 * statistics.median(times[min(WARM, len(times) - 1) :]) if times else None,
        "iterations_per_step": float(sim.totals["newton"][0]) / done,
        "residual": statistics.median(residuals) if residuals else None,
        "converged": 1.0 - float(sim.totals["rough"][0]) / done,
        "halvings": halvings,
        "violation": sim.max_violation / model.size,
    }
    return row, sim.probe(model.probes[0].name).displacement[0]


def rows(device: Any, steps: int) -> Iterator[dict[str, Any]]:
    """A row per scene and solver."""
    solvers: list[tuple[dict[str, Any], Any]] = [
        ({"solver": "newton-pcg", "tol": tol}, wf.NewtonPCG(tol=tol, max_pcg=20000)) for tol in TOLERANCES
    ]
    for coarse, acceleration, iterations in itertools.product((True, False), ACCELERATIONS, ITERATIONS):
        how: dict[str, Any] = {"iterations": iterations, "coarse": coarse, "acceleration": acceleration}
        solvers.append(({"solver": "jacobi", **how}, wf.Jacobi(**how)))
    for name, (make, dt) in SCENES.items():
        model = make().finalize(device=device)
        _, reference = simulate(model, dt, steps, wf.NewtonPCG(tol=1e-10, max_pcg=20000))
        travel = float(np.abs(reference).max())
        for label, solver in solvers:
            row, way = simulate(model, dt, steps, solver)
            error = float(np.abs(way - reference).max() / travel) if row["outcome"] == "done" else None
            yield {"scene": name, "unknowns": int(model.free_slots.sum()), **label, "tip_error": error, **row}


def run(options: argparse.Namespace) -> None:
    """Do `warpfea study jacobi`."""
    options.device = options.device or "cpu"
    steps = options.steps or 50
    settings = {"steps": steps, "integrator": "backward_euler", "reference": "newton-pcg, tol 1e-10"}
    run_tables(options, {"rows": rows}, settings, device=options.device, steps=steps)
