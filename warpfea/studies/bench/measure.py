"""What all benchmarks share: a run from rest, its columns, and writing rows with where they come from."""

from __future__ import annotations

import argparse
import fnmatch
import itertools
import math
import statistics
import time as clock
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ...base.console import write_json
from ...base.errors import UsageError
from ...base.provenance import origin
from ...model.model import Model
from ...simulation.simulation import Simulation
from ...solvers import NewtonPCG
from .problems import Problem

__all__ = [
    "SCHEMA",
    "TIGHTER",
    "WARM_UP",
    "Row",
    "Run",
    "by_label",
    "check_sizes",
    "figures",
    "measure",
    "run_once",
    "solver",
    "write",
]

SCHEMA = 1
WARM_UP = 2
"""First steps whose time does not count."""
TIGHTER = 100.0
"""By how much the tolerance of a reference is smaller."""


@dataclass(frozen=True)
class Row:
    """A measurement. Times in ms or s, the tip in m; `tip_error` is None where no reference was made."""

    problem: str
    dtype: str
    linear: str
    unknowns: int
    elements: int
    ms_per_step: float
    newton_per_step: float
    pcg_per_step: float
    bytes_per_unknown: float
    residual: float
    tip: float
    tip_error: float | None
    setup_s: float
    compile_s: float


@dataclass(frozen=True)
class Run:
    """A simulation from rest that has been stepped.

    Attributes:
        sim: the simulation.
        times: s of each step.
        ready_s: s until it could step.
        residual_force: largest |g|_2 over the free components of a step, N.
    """

    sim: Simulation
    times: list[float]
    ready_s: float
    residual_force: float

    def tip(self, axis: int) -> np.ndarray:
        """Displacement of the tip along an axis after each step, m."""
        return self.sim.probe("tip").displacement[0, :, axis]


def solver(tol: float | None, **options: Any) -> NewtonPCG:
    """The solver of all measurements."""
    return NewtonPCG(tol=tol, **({"max_pcg": 20000} | options))


def run_once(model: Model, *, dt: float, steps: int, solver: NewtonPCG, limit: float = math.inf) -> Run:
    """Simulate from rest; the step that brings the time beyond `limit` seconds is the last."""
    began = clock.perf_counter()
    sim = Simulation(model, dt=dt, solver=solver, ledger=False)
    ready = clock.perf_counter() - began
    times: list[float] = []
    largest = 0.0
    for _ in range(steps):
        start = clock.perf_counter()
        report = sim.step()  # reads its report, and so waits for the device
        times.append(clock.perf_counter() - start)
        largest = max(largest, float(report.residual_force.max()))
        if sum(times) > limit:
            break
    return Run(sim, times, ready, largest)


def figures(run: Run, seconds: float) -> dict[str, Any]:
    """The columns that all tables share; `seconds` is what a step takes. Bytes are per free unknown."""
    sim, steps = run.sim, len(run.times)
    info = sim.model.info()
    return {
        "dtype": sim.model.dtype,
        "elements": info["elements"],
        "ms_per_step": 1e3 * seconds,
        "newton_per_step": float(sim.totals["newton"][0]) / steps,
        "pcg_per_step": float(sim.totals["pcg"][0]) / steps,
        "bytes_per_unknown": sum(sim.bytes().values()) / info["unknowns"],
        "residual": float(sim.max_residual),
        "compile_s": run.ready_s,
    }


def measure(
    problem: Problem,
    size: Any,
    dtypes: list[str],
    linear: Sequence[str] = ("pcg",),
    *,
    device: Any,
    steps: int,
    repeat: int,
    dt: float,
    tol: float | None,
    with_reference: bool,
) -> list[Row]:
    """Rows of one mesh, one per precision and linear solver."""
    builder = problem.build(size)
    reference = None
    if with_reference:
        tight = solver(NewtonPCG(tol=tol).tolerance("float64") / TIGHTER)
        reference = run_once(builder.finalize(device=device), dt=dt, steps=steps, solver=tight).tip(problem.axis)
    rows = []
    for dtype, name in itertools.product(dtypes, linear):
        began = clock.perf_counter()
        model = builder.finalize(device=device, dtype=dtype)
        setup = clock.perf_counter() - began
        first = min(WARM_UP, steps - 1)
        how = solver(tol, linear=name)
        run = run_once(model, dt=dt, steps=steps, solver=how)
        times = run.times[first:]
        for _ in range(repeat - 1):
            times += run_once(model, dt=dt, steps=steps, solver=how).times[first:]
        tip = run.tip(problem.axis)
        rows.append(
            Row(
                problem=problem.name,
                linear=name,
                unknowns=model.info()["unknowns"],
                tip=float(tip[-1]),
                tip_error=None if reference is None else float(np.abs(tip - reference).max() / np.abs(reference).max()),
                setup_s=setup,
                **figures(run, statistics.median(times)),
            )
        )
    return rows


def check_sizes(problems: list[Problem], sizes: list[int]) -> None:
    """Refuse sizes that a problem does not have. UsageError."""
    for problem in problems:
        if sizes and min(sizes) < problem.smallest:
            raise UsageError(f"--unknowns {min(sizes)}: the smallest {problem.name} has {problem.smallest}")


def by_label(rows: str, every: Sequence[Any]) -> list[Any]:
    """Cases whose labels fit one of the words with commas, in their order. UsageError for a word that fits none."""
    words = [word.strip() for word in rows.split(",")]
    for word in words:
        if not any(fnmatch.fnmatchcase(case.label, word) for case in every):
            raise UsageError(f"--rows: no row {word!r}; there are {', '.join(case.label for case in every)}")
    return [case for case in every if any(fnmatch.fnmatchcase(case.label, word) for word in words)]


def write(options: argparse.Namespace, settings: dict[str, Any], rows: list[Any], **more: Any) -> None:
    """Write rows (dataclasses) with where they come from to --out, if given. OutputError."""
    if options.out is not None:
        content = {
            "schema": SCHEMA,
            **origin(options.words or ["bench"], options.device),
            "settings": settings,
            **more,
            "rows": [asdict(row) for row in rows],
        }
        write_json(options.out, content)
