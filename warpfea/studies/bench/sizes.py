"""`warpfea bench` without a kind: time and error of the solver on the problems of problems.py, by size.

Sizes are numbers of unknowns, met as closely as the problem allows. The error of the tip is measured against the same
mesh and steps with a tolerance 100 times tighter in float64, over the largest tip displacement of the reference; it is
None where no reference was made. Times are in ms or s, the tip is in m.
"""

import argparse
import statistics
import time as clock
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.errors import UsageError
from ...solvers import NewtonPCG
from .measure import Kind, Row, run_columns, run_once, solver
from .problems import PROBLEMS, Problem

__all__ = ["SIZES_KIND"]

WARM_UP_STEPS = 2
"""First steps whose time does not count."""
TIGHTENING = 100.0
"""Factor by which the tolerance of a reference is smaller."""
DEFAULT_OPTIONS: dict[str, Any] = {"steps": 10, "repeat": 3, "dt": 1e-3, "dtype": ["float64", "float32"],
            "linear": ["pcg"], "reference_up_to": [100000]}  # fmt: skip
COLUMNS = {
    "problem": "problem 8", "dtype": "dtype 8", "linear": "linear 6", "unknowns": "unknowns 9d",
    "elements": "elements 9d", "ms_per_step": "ms/step 10.2f", "newton_per_step": "Newton 7.1f",
    "pcg_per_step": "PCG 7.0f", "bytes_per_unknown": "B/unknown 9.0f", "residual": "residual 9.1e",
    "tip": "tip, m 13.6e", "tip_error": "tip error 9.1e", "setup_s": "set-up, s 9.1f", "compile_s": "compile, s 10.1f",
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A mesh, by its approximate number of unknowns, and a linear solver."""

    problem: Problem
    target_unknowns: int
    linear: str


def _cases(options: argparse.Namespace) -> list[Case]:
    problems = [PROBLEMS[name] for name in options.problem or ["bar"]]
    for p in problems:
        if options.unknowns and min(options.unknowns) < p.min_unknowns:
            raise UsageError(f"--unknowns {min(options.unknowns)}: the smallest {p.name} has {p.min_unknowns}")
    for name, value in DEFAULT_OPTIONS.items():
        setattr(options, name, getattr(options, name) or value)
    options.references = {}
    return [Case(p, n, how) for p in problems for n in options.unknowns or p.default_unknowns for how in options.linear]


def _settings(options: argparse.Namespace, cases: Sequence[Case]) -> dict[str, Any]:
    return {
        "problems": {case.problem.name: list(options.unknowns or case.problem.default_unknowns) for case in cases},
        "dtypes": options.dtype,
        **{name: getattr(options, name) for name in ("linear", "steps", "repeat", "dt", "tol")},
        "reference_tolerance_factor": 1.0 / TIGHTENING,
        "reference_up_to": max(options.reference_up_to),
        "warm_up_steps": min(WARM_UP_STEPS, options.steps - 1),
    }


def _measure(case: Case, dtype: str, options: argparse.Namespace) -> Row:
    """The row of a mesh; its reference is made with its first."""
    problem, mesh, known = case.problem, (case.problem.name, case.target_unknowns), options.references
    builder, how = problem.build(problem.size_for(case.target_unknowns)), {"dt": options.dt, "steps": options.steps}
    if mesh not in known and case.target_unknowns <= max(options.reference_up_to):
        tight = solver(NewtonPCG(tol=options.tol).tolerance("float64") / TIGHTENING)
        known[mesh] = run_once(builder.finalize(device=options.device), solver=tight, **how).tip(problem.tip_axis)
    began = clock.perf_counter()
    model = builder.finalize(device=options.device, dtype=dtype)
    setup = clock.perf_counter() - began
    method, first = solver(options.tol, linear=case.linear), min(WARM_UP_STEPS, options.steps - 1)
    run = run_once(model, solver=method, **how)
    times = run.times[first:]
    for _ in range(options.repeat - 1):
        times += run_once(model, solver=method, **how).times[first:]
    tip, reference = run.tip(problem.tip_axis), known.get(mesh)
    return {
        "problem": problem.name,
        "linear": case.linear,
        "unknowns": model.info()["unknowns"],
        "tip": float(tip[-1]),
        "tip_error": None if reference is None else float(np.abs(tip - reference).max() / np.abs(reference).max()),
        "setup_s": setup,
        **run_columns(run, statistics.median(times)),
    }


SIZES_OPTIONS = frozenset({"problem", "unknowns", "dtype", "linear", "steps", "repeat", "dt", "tol", "reference_up_to"})
SIZES_KIND = Kind(SIZES_OPTIONS, COLUMNS, _cases, _settings, _measure)
