"""`warpfea study devices`: a CUDA device against the CPU on the same models, in both precisions.

tests/results/device_agreement.json is the committed result; the tests run the same cases where there is a device.
"""

from __future__ import annotations

import argparse
import time as clock
from collections.abc import Iterator
from typing import Any

import numpy as np
import warp as wp

import warpfea as wf

from ....base.errors import UsageError
from ..parts import run_tables
from .cases import CASES, cantilever, s3_mesh

__all__ = ["CASES", "cantilever", "compare", "rows", "run", "s3_mesh", "simulate"]

STEPS = 100
CONSTRAINT_TOL = {"float64": 1e-13, "float32": None}
"""Rows of a weld are almost dependent: what the default leaves of them, 1e-8 of the size, depends on the way there."""


def simulate(case, device, dtype="float64", steps=100, integrator="backward_euler", tol=None, worlds=1, dt=1e-3):
    """Tip displacement over time (worlds, steps, 3) and the last report, of one case on one device."""
    b, body = CASES[case]()
    model = b.finalize(device=device, dtype=dtype, worlds=worlds)
    tol = tol or (1e-12 if dtype == "float64" else None)
    solver = wf.NewtonPCG(tol=tol)
    sim = wf.Simulation(model, dt=dt, integrator=integrator, solver=solver, constraint_tol=CONSTRAINT_TOL[dtype])
    start = clock.perf_counter()
    report = sim.step(steps)
    wall = (clock.perf_counter() - start) / steps
    return sim.probe("tip").displacement, report, wall, sim


def compare(case, integrator="backward_euler", steps=STEPS, cuda="cuda:0"):
    """One row: how far CUDA is from the CPU in both precisions, relative to the tip's travel."""
    row = {"case": case, "integrator": integrator, "steps": steps, "tol_float64": 1e-12}
    reference, _, wall, _ = simulate(case, "cpu", steps=steps, integrator=integrator)
    travel = np.abs(reference).max()
    row["cpu_ms_per_step"] = 1e3 * wall
    for dtype in ("float64", "float32"):
        tip, report, wall, _ = simulate(case, cuda, dtype, steps=steps, integrator=integrator)
        row[f"cuda_{dtype}_difference"] = float(np.abs(tip - reference).max() / travel)
        row[f"cuda_{dtype}_residual"] = float(report.residual[0])
        row[f"cuda_{dtype}_ms_per_step"] = 1e3 * wall
    return row


def rows(device: Any, steps: int) -> Iterator[dict[str, Any]]:
    """A row per case, and one of bdf2."""
    for case in CASES:
        yield compare(case, steps=steps, cuda=device)
    yield compare("S3 svk tet4", integrator="bdf2", steps=steps, cuda=device)


def run(options: argparse.Namespace) -> None:
    """Do `warpfea study devices`."""
    options.device = options.device or "cuda:0"
    if not wp.get_device(options.device).is_cuda:
        raise UsageError(f"--device {options.device}: name a CUDA device, it is compared with the CPU")
    steps = options.steps or STEPS
    settings = f"h = 1e-3 s, {steps} steps, tol 1e-12 (float64), default (float32); differences over the tip's travel"
    run_tables(options, {"rows": rows}, settings, device=options.device, steps=steps)
