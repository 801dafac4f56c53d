"""Paper T's comparison repeated: T4, T10, FN, FN18, ENMC and the brick H3843 on rigid and on large motion.

Errors are of the mean position of the bar's end face (see problems.py). Run times are those of the steps alone.
"""

from __future__ import annotations

import math
import statistics
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...base.errors import ModelError
from ...model.model import Model
from ...simulation.simulation import Simulation
from ...simulation.statics import solve_static
from ...solvers import NewtonPCG
from ..timing import NOT_REPEATED, repeated
from . import problems as bars
from .problems import (
    ELEMENTS,
    LENGTH,
    PROBLEMS,
    build,
    cells_of,
    level_for,
)
from .report import Row, Study, with_orders
from .rigid import exact_tip, stepped_tip

__all__ = ["ancf_tets"]

SIZES = (100, 300, 1000, 3000, 10000)
QUICK_SIZES = (300, 1000)
DT = {"rigid": 1e-2, "sudden": 5e-3}
STEPS = {"rigid": 50, "sudden": 100}
QUICK_STEPS = 10
TOL = {"rigid": 1e-6, "large": 1e-7, "sudden": 1e-6}
DYNAMIC_UP_TO, QUICK_DYNAMIC_UP_TO = 1500, 500  # wanted unknowns
START = np.array([LENGTH, 0.5 * bars.SIDE, 0.5 * bars.SIDE])  # m, of the tip
REFERENCE = "H3843"  # it comes closest, and is none of the tetrahedra
ASSUMED_ORDER = 3.5  # where three meshes do not tell


@dataclass(frozen=True)
class Run:
    """A run: tip (n, 3), m, at the ends of the steps (statics: 1), and what it took."""

    tip: np.ndarray
    model: Model
    seconds: float
    repeats: int
    setup_s: float
    newton: int
    pcg: int


@dataclass
class Runner:
    """Runs each mesh of each problem once, and remembers it."""

    device: Any
    steps: dict[str, int]
    repeat: int
    notify: Callable[[str], object]

    def __post_init__(self) -> None:
        self.done: dict[tuple[str, str, int], Run] = {}

    def __call__(self, problem: str, element: str, level: int) -> Run:
        key = (problem, element, level)
        if key not in self.done:
            self.done[key] = self._measure(*key)
        return self.done[key]

    def _measure(self, problem: str, element: str, level: int) -> Run:
        self.notify(f"{problem} {element} {'x'.join(map(str, cells_of(level)))}")
        began = clock.perf_counter()
        model = build(problem, element, level).finalize(device=self.device)
        made = clock.perf_counter() - began
        runs = repeated(lambda: self._once(problem, model), lambda run: run.seconds, self.repeat)
        first, median = runs[0], statistics.median(run.seconds for run in runs)
        return replace(first, seconds=median, repeats=len(runs), setup_s=made + first.setup_s)

    def _once(self, problem: str, model: Model) -> Run:
        solver = NewtonPCG(tol=TOL[problem], max_pcg=20000, max_newton=50)
        began = clock.perf_counter()
        if problem == "large":
            static = solve_static(model, load_steps=1, solver=solver)
            whole, sim = clock.perf_counter() - began, static.simulation
            setup, tip = sim.compile_s, static.probe("tip").displacement[0, -1:]
        else:
            sim = Simulation(model, dt=DT[problem], integrator="bdf2", solver=solver, ledger=False)
            setup = clock.perf_counter() - began
            sim.step(self.steps[problem])
            whole, tip = clock.perf_counter() - began, sim.probe("tip").displacement[0]
        newton, pcg = int(sim.totals["newton"][0]), int(sim.totals["pcg"][0])
        return Run(tip, model, whole - setup, 1, setup, newton, pcg)


def ancf_tets(
    *,
    device: Any = None,
    sizes: Sequence[int] | None = None,
    problems: Sequence[str] = PROBLEMS,
    elements: Sequence[str] = ELEMENTS,
    repeat: int = 3,
    quick: bool = False,
    on_run: Callable[[str], object] | None = None,
) -> Study:
    """Compare the elements of Paper T on three problems (see warpfea.studies.ancf_tets.problems).

    Args:
        device: Warp device; by default CUDA where there is one.
        sizes: numbers of unknowns, met as closely as whole cells allow; meshes that several sizes lead to run once. The
            problems with time steps take those up to 1500 alone.
        problems: of "rigid", "large", "sudden".
        elements: of "T4", "T10", "FN", "FN18", "ENMC", "H3843".
        repeat: runs whose median counts; those longer than 2 s are not repeated.
        quick: sizes of 300 and 1000 by default, 300 with time steps, 10 steps and one run: a trial, no result.
        on_run: called with a line before each mesh is run.

    Returns:
        A Study: rows, references, `table()`, `write(folder)`.

    Raises:
        ModelError: an unknown problem or element, or a size or repeat that is not positive.
        ConvergenceError: a step or load step was not accepted.
    """
    _known("problem", problems, PROBLEMS)
    _known("element", elements, ELEMENTS)
    chosen = tuple(sizes) if sizes is not None else QUICK_SIZES if quick else SIZES
    if not chosen or not all(isinstance(s, (int, np.integer)) and s > 0 for s in chosen):
        raise ModelError(f"ancf_tets: sizes = {list(chosen)} must be positive whole numbers, at least one")
    if not (isinstance(repeat, int) and repeat >= 1):
        raise ModelError(f"ancf_tets: repeat = {repeat!r} must be a positive whole number")
    up_to = QUICK_DYNAMIC_UP_TO if quick else DYNAMIC_UP_TO
    steps = dict.fromkeys(STEPS, QUICK_STEPS) if quick else STEPS
    run = Runner(device, steps, 1 if quick else repeat, on_run or (lambda text: None))
    references: dict[str, dict[str, Any]] = {}
    rows: list[Row] = []
    for problem in problems:
        wanted = [s for s in chosen if problem == "large" or s <= up_to] or [min(chosen)]
        levels = {e: sorted({level_for(e, s) for s in wanted}) for e in elements}
        for element, found in levels.items():
            for level in found:
                run(problem, element, level)
        tip, references[problem] = _reference(problem, run, max(level_for(REFERENCE, s) for s in wanted))
        for element, found in levels.items():
            measured = [_row(problem, element, level, run(problem, element, level), tip) for level in found]
            rows += measured if problem == "rigid" else with_orders(measured)
    return Study("ancf_tets", _settings(chosen, run, quick), references, rows)


def _known(what: str, given: Sequence[str], there: Sequence[str]) -> None:
    if not given or isinstance(given, str):
        raise ModelError(f"ancf_tets: {what}s = {given!r} must be a list of some of {', '.join(there)}")
    for name in given:
        if name not in there:
            raise ModelError(f"ancf_tets: {what} {name!r} is unknown; there are {', '.join(there)}")


def _row(problem: str, element: str, level: int, run: Run, reference: np.ndarray) -> Row:
    info = run.model.info()
    steps = len(run.tip)
    exact = None
    if problem == "rigid":
        exact = _distance(run.tip, exact_tip(DT[problem] * np.arange(1, steps + 1)) - START)
    return Row(
        problem=problem,
        element=element,
        cells=cells_of(level),
        elements=info["elements"],
        unknowns=info["unknowns"],
        error=_distance(run.tip, reference),
        error_exact=exact,
        order=None,
        mesh_order=None,
        seconds=run.seconds,
        ms_per_step=None if problem == "large" else 1e3 * run.seconds / steps,
        newton=run.newton,
        pcg=run.pcg,
        repeats=run.repeats,
        setup_s=run.setup_s,
        tip=tuple(run.tip[-1].tolist()),
    )


def _distance(tip: np.ndarray, reference: np.ndarray) -> float:
    """Largest distance over the steps, in lengths of the bar."""
    return float(np.linalg.norm(tip - reference, axis=1).max() / LENGTH)


def _reference(problem: str, run: Runner, level: int) -> tuple[np.ndarray, dict[str, Any]]:
    """Displacement of the tip (n, 3), m, and what is known of it; `level` is the finest mesh of the sweep."""
    if problem == "rigid":
        return _rigid_reference(run.steps[problem])
    level += level < 3
    finest, coarser = run(problem, REFERENCE, level), run(problem, REFERENCE, level - 1).tip
    order = ASSUMED_ORDER
    if level >= 3:
        order = observed_order(run(problem, REFERENCE, level - 2).tip, coarser, finest.tip, level)
    tip = finest.tip + (finest.tip - coarser) / ((level / (level - 1)) ** order - 1.0)
    own = _distance(tip, finest.tip)
    cells = cells_of(level)
    mesh = "x".join(map(str, cells))
    how = "static" if problem == "large" else f"{run.steps[problem]} steps of {DT[problem]:g} s"
    about = (
        f"E = {bars.SOFT:g} Pa, {how}; error from {REFERENCE} on {mesh} cells, extrapolated "
        f"with order {order:.1f}, which moved the tip by {own:.1e} of the length"
    )
    known = {"element": REFERENCE, "cells": cells, "unknowns": finest.model.info()["unknowns"], "order": order}
    return tip, {"about": about, **known, "own_error": own, "tip": tip[-1]}


def observed_order(coarse: np.ndarray, middle: np.ndarray, fine: np.ndarray, level: int) -> float:
    """Order p of results a + b h^p on level - 2, level - 1, level, within 2 and 6; ASSUMED_ORDER where none fits."""
    from scipy.optimize import brentq

    ratio = np.linalg.norm(middle - coarse) / np.linalg.norm(fine - middle)
    a, b, c = level - 2.0, level - 1.0, float(level)

    def excess(p: float) -> float:
        return float((a**-p - b**-p) / (b**-p - c**-p) - ratio)

    return float(brentq(excess, 2.0, 6.0)) if excess(2.0) < 0.0 < excess(6.0) else ASSUMED_ORDER


def _rigid_reference(steps: int) -> tuple[np.ndarray, dict[str, Any]]:
    dt = DT["rigid"]
    exact = exact_tip(dt * np.arange(1, steps + 1))
    tip = stepped_tip(dt, steps)
    floor = _distance(tip, exact)
    half = _distance(stepped_tip(dt / 2, 2 * steps)[1::2], exact)
    about = (
        f"E = {bars.STIFF:g} Pa, {steps} steps of {dt:g} s; error from the rigid body in the same steps, so the bar's "
        f"flexibility; the steps alone are {floor:.1e} off the exact motion ({half:.1e} with half the step)"
    )
    return tip - START, {
        "about": about,
        "time_error": floor,
        "time_error_half_step": half,
        "time_order": math.log2(floor / half),
    }


def _settings(sizes: Sequence[int], run: Runner, quick: bool) -> dict[str, Any]:
    return {
        "sizes": list(sizes),
        "dynamic_up_to": QUICK_DYNAMIC_UP_TO if quick else DYNAMIC_UP_TO,
        "quick": quick,
        "repeat": run.repeat,
        "not_repeated_beyond_s": NOT_REPEATED,
        "bar": [LENGTH, bars.SIDE, bars.SIDE],
        "nu": bars.NU,
        "density": bars.DENSITY,
        "E": {"rigid": bars.STIFF, "large": bars.SOFT, "sudden": bars.SOFT},
        "weight": {"large": bars.WEIGHT, "sudden": 0.5 * bars.WEIGHT},
        "gravity": bars.GRAVITY,
        "integrator": "bdf2",
        "dt": DT,
        "steps": run.steps,
        "load_steps": 1,
        "tol": TOL,
        "dtype": "float64",
    }
