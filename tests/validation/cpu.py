"""ms per step on one CPU of three linear solvers, in one process on the same meshes.

default: warpfea as it comes. block-jacobi: PCG with 3x3 blocks. direct: the same Newton with scipy's SuperLU. Each
row steps a problem of `warpfea bench` from rest in float64, h = 1 ms, with the Newton iterations that
|g|_2 < 5e-4 N takes; the mean of all steps counts, the first and what solvers make in it included, as the default and
the direct solver keep their matrices for several steps. A run ends with the step that brings it beyond limit_s. The
direct solver is left out where one step is predicted to take that long, from the next smaller row of its problem and a
time that grows with the square of the unknowns.

Beside it, for orientation, Project Chrono 10-dev with PARDISO on a like machine of two cores: ms per implicit step of
its own elements in as many elements or unknowns, with one and two threads (chrono_1, chrono_2). unknowns: free ones;
residual_force: largest |g|_2 of a step, N; note: why steps are missing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from warpfea.base.errors import UsageError
from warpfea.studies.bench.measure import run_columns, run_once, solver
from warpfea.studies.bench.peer import DT, FORCE_TOL
from warpfea.studies.bench.problems import PROBLEMS

from .table import Row, Run, Table

__all__ = ["CASES", "SOLVERS", "TABLE", "CpuCase"]

SOLVERS: dict[str, dict[str, Any]] = {
    "default": {},
    "block-jacobi": {"preconditioner": "block-jacobi"},
    "direct": {"linear": "direct"},
}
BAR = PROBLEMS["bar"]
MEASURED = ("ms_per_step", "newton_per_step", "pcg_per_step", "residual", "residual_force", "bytes_per_unknown")


@dataclass(frozen=True)
class CpuCase:
    """A mesh: size as its problem takes it, and Chrono's ms with one and two threads."""

    label: str
    problem: str
    size: Any
    chrono: tuple[float, float] | None = None


CASES: tuple[CpuCase, ...] = (
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


def too_long(before: Row | None, unknowns: int, limit: float) -> str | None:
    """Why the direct solver is left out in this size, from its row in the next smaller one."""
    if before is None or before["ms_per_step"] is None:
        return before["note"] if before else None
    taken = 1e-3 * before["ms_per_step"]
    expected = taken * (unknowns / before["unknowns"]) ** 2
    if expected <= limit:
        return None
    return f"{taken:.1f} s per step with {before['unknowns']} unknowns, about {expected:.0f} s here"


def rows(run: Run) -> Iterator[Row]:
    """A row per mesh and solver."""
    steps, limit = run.options["steps"], run.options["limit_s"]
    before: dict[str, Row] = {}
    for case in filter(lambda case: run.wants(case.label), CASES):
        model = PROBLEMS[case.problem].build(case.size).finalize(device="cpu")
        info = model.info()
        for name, options in SOLVERS.items():
            row: Row = {"problem": case.problem, "label": case.label, "solver": name, "dtype": model.dtype}
            row |= {"unknowns": info["unknowns"], "elements": info["elements"]}
            row |= dict.fromkeys((*MEASURED, "compile_s")) | dict(
                zip(("chrono_1", "chrono_2"), case.chrono or (None, None))
            )
            note = too_long(before.get(case.problem), info["unknowns"], limit) if name == "direct" else None
            row |= {"steps": 0, "note": note}
            if note is None:
                how = solver(None, force_tol=FORCE_TOL, **options)
                found = run_once(model, dt=DT, steps=steps, solver=how, limit=limit)
                done, took = len(found.times), sum(found.times)
                row |= {"steps": done, "residual_force": found.residual_force, **run_columns(found, took / done)}
                row["note"] = None if done == steps else f"{done} of {steps} steps took {took:.3g} s"
            if name == "direct":
                before[case.problem] = row
            yield row


def on_the_cpu(run: Run) -> None:
    """Refuse another device. UsageError."""
    if run.device != "cpu":
        raise UsageError(f"--device {run.device}: the table cpu is of the CPU")


TABLE = Table(
    about=__doc__,
    parts={"rows": rows},
    results={"cpu.json": "cpu --out tests/results/cpu.json"},
    options={"steps": 20, "limit_s": 60.0},
    settings={
        "solvers": list(SOLVERS), "dt": DT, "time": "mean of all steps", "force_tol": FORCE_TOL,
        "chrono": "Project Chrono 10-dev with PARDISO, two cores, ms per implicit step",
    },
    columns=("label", "solver", "unknowns", "ms_per_step", "newton_per_step", "pcg_per_step", "chrono_1", "note"),
    takes="an hour",
    check=on_the_cpu,
)  # fmt: skip
