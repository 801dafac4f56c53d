"""Loop of all kinds of `warpfea bench`: measures their declared cases, prints and writes a row of each."""

import argparse
import fnmatch
import math
import re
import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.console import write_json
from ...base.errors import UsageError
from ...base.provenance import provenance_of
from ...model.model import Model
from ...simulation.simulation import Simulation
from ...solvers import NewtonPCG

__all__ = ["Kind", "Row", "Run", "run_columns", "run_kind", "run_once", "select_by_label", "solver"]

SCHEMA = 1
Row = dict[str, Any]
"""Numbers and texts by column."""


@dataclass(frozen=True)
class Kind:
    """A kind of measurement, declared.

    Attributes:
        options: names of the command line's options that it takes, besides those of all kinds.
        columns: all columns of its rows -> heading and number format, "ms/step 9.3f"; "" where it is written alone.
        cases: options -> cases, after defaults are set in the options. UsageError.
        settings: options, cases -> all that the numbers depend on, for the file.
        measure: case, precision, options -> a row, or a text that says why there is none.
    """

    options: frozenset[str]
    columns: Mapping[str, str]
    cases: Callable[[argparse.Namespace], Sequence[Any]]
    settings: Callable[[argparse.Namespace, Sequence[Any]], dict[str, Any]]
    measure: Callable[[Any, str, argparse.Namespace], Row | str]


@dataclass(frozen=True)
class Run:
    """A simulation from rest that has been stepped.

    Attributes:
        sim: the simulation.
        times: of each step, s.
        startup_s: s until it could step: construction and compilation.
        residual_force: largest |g|_2 over the free components of a step, N.
    """

    sim: Simulation
    times: list[float]
    startup_s: float
    residual_force: float

    def tip(self, axis: int) -> np.ndarray:
        """Displacement of the tip along an axis after each step, m."""
        return self.sim.probe("tip").displacement[0, :, axis]


def run_kind(kind: Kind, options: argparse.Namespace) -> None:
    """Measure the cases of a kind; a line per row, and the file --out after each. UsageError, OutputError."""
    cases = kind.cases(options)
    about = {
        "schema": SCHEMA,
        **provenance_of(options.words or ["bench"], options.device),
        "settings": kind.settings(options, cases),
    }
    rows: list[Row] = []

    def write() -> None:
        if options.out is not None:
            write_json(options.out, about | {"rows": rows})

    print(_format_row(kind.columns), flush=True)
    for case in cases:
        for dtype in options.dtype:
            found = kind.measure(case, dtype, options)
            if not isinstance(found, str):
                rows.append(dict.fromkeys(kind.columns) | found)
            print(found if isinstance(found, str) else _format_row(kind.columns, rows[-1]), flush=True)
            write()
    write()


def _format_row(columns: Mapping[str, str], row: Row | None = None) -> str:
    """The row as text, or the headings; texts end with their column's left side, the note stands last."""
    cells = []
    for name, shown in columns.items():
        head, _, form = shown.rpartition(" ")
        if not shown:
            continue
        width = int(re.match(r"\d+", form)[0])  # type: ignore[index]
        value = head if row is None else row[name]
        if isinstance(value, str):
            cells.append(value.ljust(width) if form.isdigit() else value.rjust(width))
        else:
            text = "-" if value is None else str(value) if isinstance(value, bool) else format(value, form)
            cells.append(text.rjust(width))
    return " ".join([*cells, (row or {}).get("note") or ""]).rstrip()


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


def run_columns(run: Run, seconds: float) -> Row:
    """Columns common to runs from rest; `seconds`: time of a step. Bytes are per free unknown."""
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
        "compile_s": run.startup_s,
    }


def select_by_label(rows: str | None, every: Sequence[Any]) -> list[Any]:
    """Cases whose labels fit one of the words with commas, in their order; all without words. UsageError."""
    words = [word.strip() for word in (rows or "*").split(",")]
    for word in words:
        if not any(fnmatch.fnmatchcase(case.label, word) for case in every):
            raise UsageError(f"--rows: no row {word!r}; there are {', '.join(case.label for case in every)}")
    return [case for case in every if any(fnmatch.fnmatchcase(case.label, word) for word in words)]
