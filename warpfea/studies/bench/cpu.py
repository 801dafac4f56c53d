"""`warpfea bench --cpu`: ms per step on this CPU of three linear solvers, in one process on the same meshes.

default: warpfea as it comes. block-jacobi: PCG with 3x3 blocks. direct: the same Newton with scipy's SuperLU. Each
row steps a problem of problems.py from rest in float64, h = 1 ms, with the Newton iterations that
|g|_2 < 5e-4 N takes; the mean of all steps counts, the first and what solvers make in it included, as the default and
the direct solver keep their matrices for several steps. A run ends with the step that brings it beyond --limit. The
direct solver is left out where one step is predicted to take that long, from the next smaller row of its problem and a
time that grows with the square of the unknowns.

Beside it, for orientation, Project Chrono 10-dev with PARDISO on a like machine of two cores: ms per implicit step of
its own elements in as many elements or unknowns, with one and two threads.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

from ...base.errors import UsageError
from ...model.model import Model
from .measure import by_label, figures, run_once, solver, write
from .peer import DT, FORCE_TOL
from .problems import PROBLEMS

__all__ = ["CASES", "SOLVERS", "CpuCase", "CpuRow", "cpu"]

CHRONO = "Project Chrono 10-dev with PARDISO, two cores, ms per implicit step"
STEPS = 20
LIMIT = 60.0
SOLVERS: dict[str, dict[str, Any]] = {
    "default": {},
    "block-jacobi": {"preconditioner": "block-jacobi"},
    "direct": {"linear": "direct"},
}
BAR = PROBLEMS["bar"]


@dataclass(frozen=True)
class CpuCase:
    """A mesh: size as its problem takes it, and Chrono's ms with one and two threads."""

    label: str
    problem: str
    size: Any
    chrono: tuple[float, float] | None = None


CASES = (
    CpuCase("bar-1k", "bar", BAR.size_for(1_000)),
    CpuCase("bar-3k", "bar", (8, 4, 3)),
    CpuCase("bar-9.7k", "bar", (12, 7, 4), (203.0, 168.0)),
    CpuCase("bar-10k", "bar", BAR.size_for(10_000)),
    CpuCase("bar-30k", "bar", BAR.size_for(30_000)),
    CpuCase("bar-69k", "bar", (22, 15, 8), (3874.0, 2696.0)),
    CpuCase("bar-100k", "bar", BAR.size_for(100_000)),
    CpuCase("beam-256", "beam", 256, (7.2, 9.4)),
    CpuCase("beam-4096", "beam", 4096, (187.0, 146.0)),
    CpuCase("plate-16x16", "plate", (16, 16), (37.0, 30.0)),
    CpuCase("plate-64x64", "plate", (64, 64), (1314.0, 915.0)),
    CpuCase("brick-1080", "H3843", (15, 9, 8), (1284.0, 964.0)),
)


@dataclass(frozen=True)
class CpuRow:
    """A measurement. Times are None of a solver that was left out.

    Attributes:
        solver: "default", "block-jacobi" or "direct".
        unknowns: free ones.
        steps: that were done.
        residual_force: largest |g|_2 of a step, N.
        chrono_1, chrono_2: Chrono's ms with one and two threads.
        note: why steps are missing.
    """

    problem: str
    label: str
    solver: str
    dtype: str
    unknowns: int
    elements: int
    steps: int
    ms_per_step: float | None
    newton_per_step: float | None
    pcg_per_step: float | None
    residual: float | None
    residual_force: float | None
    bytes_per_unknown: float | None
    compile_s: float | None
    chrono_1: float | None
    chrono_2: float | None
    note: str | None


def measure(case: CpuCase, model: Model, name: str, *, steps: int, limit: float) -> CpuRow:
    """The row of a solver."""
    how = solver(None, force_tol=FORCE_TOL, **SOLVERS[name])
    run = run_once(model, dt=DT, steps=steps, solver=how, limit=limit)
    done = len(run.times)
    note = None if done == steps else f"{done} of {steps} steps took {sum(run.times):.3g} s"
    found = figures(run, sum(run.times) / done)
    return CpuRow(**_mesh(case, model, name), steps=done, residual_force=run.residual_force, note=note, **found)


def left_out(case: CpuCase, model: Model, name: str, note: str) -> CpuRow:
    """The row of a solver that was not tried."""
    columns = ("ms_per_step", "newton_per_step", "pcg_per_step", "residual", "residual_force", "bytes_per_unknown")
    nothing: dict[str, Any] = dict.fromkeys((*columns, "compile_s"))
    info = {"elements": model.info()["elements"], "dtype": model.dtype}
    return CpuRow(**_mesh(case, model, name), steps=0, note=note, **info, **nothing)


def _mesh(case: CpuCase, model: Model, name: str) -> dict[str, Any]:
    one, two = case.chrono or (None, None)
    unknowns = model.info()["unknowns"]
    return {
        "problem": case.problem,
        "label": case.label,
        "solver": name,
        "unknowns": unknowns,
        "chrono_1": one,
        "chrono_2": two,
    }


def too_long(rows: list[CpuRow], problem: str, unknowns: int, limit: float) -> str | None:
    """Why the direct solver is left out in this size, from its rows in smaller ones."""
    for row in reversed(rows):
        if row.solver == "direct" and row.problem == problem and row.unknowns < unknowns:
            if row.ms_per_step is None:
                return row.note
            expected = 1e-3 * row.ms_per_step * (unknowns / row.unknowns) ** 2
            if expected > limit:
                return (
                    f"{1e-3 * row.ms_per_step:.1f} s per step with {row.unknowns} unknowns, about {expected:.0f} s here"
                )
            return None
    return None


def cpu(options: argparse.Namespace) -> None:
    """Do `warpfea bench --cpu`: a line per row, and the file after each."""
    if options.device not in (None, "cpu"):
        raise UsageError(f"--device {options.device} does not go with --cpu")
    options.device = "cpu"
    cases = by_label(options.rows, CASES) if options.rows is not None else list(CASES)
    steps, limit = options.steps or STEPS, options.limit or LIMIT
    settings = {
        "rows": [case.label for case in cases],
        "solvers": list(SOLVERS),
        "dt": DT,
        "steps": steps,
        "time": "mean of all steps",
        "force_tol": FORCE_TOL,
        "limit_s": limit,
        "chrono": CHRONO,
    }
    rows: list[CpuRow] = []
    print(HEADER, flush=True)
    for case in cases:
        model = PROBLEMS[case.problem].build(case.size).finalize(device="cpu")
        for name in SOLVERS:
            note = too_long(rows, case.problem, model.info()["unknowns"], limit) if name == "direct" else None
            if note:
                rows.append(left_out(case, model, name, note))
            else:
                rows.append(measure(case, model, name, steps=steps, limit=limit))
            print(_line(rows[-1]), flush=True)
            write(options, settings, rows)
    write(options, settings, rows)


HEADER = (
    f"{'row':12} {'solver':12} {'unknowns':>8} {'elements':>8} {'ms/step':>9} {'Newton':>6} {'PCG':>6} {'|g|, N':>8} "
    f"{'Chrono, 1 / 2 threads':>21}"
)


def _line(r: CpuRow) -> str:
    def text(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    chrono = "-" if r.chrono_1 is None else f"{r.chrono_1:g} / {r.chrono_2:g}"
    return (
        f"{r.label:12} {r.solver:12} {r.unknowns:8d} {r.elements:8d} {text(r.ms_per_step, '.2f'):>9} "
        f"{text(r.newton_per_step, '.2f'):>6} {text(r.pcg_per_step, '.0f'):>6} {text(r.residual_force, '.1e'):>8} "
        f"{chrono:>21}" + (f"  {r.note}" if r.note else "")
    )
