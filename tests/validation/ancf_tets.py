"""Paper T's comparison repeated: T4, T10, FN, FN18, ENMC and the brick H3843 on rigid and on large motion.

The bars of ancf_bars.py. Sizes are numbers of unknowns, met as closely as whole cells allow; the problems with time
steps take those up to dynamic_up_to alone. Rows, with seconds of the steps alone:

cells                of the box along x, y, z
unknowns             free components
error                largest distance of the mean of the bar's end face from the reference, over the bar's length.
                     rigid: from the rigid body in the same time steps, which is free of the time error; large: at the
                     end; sudden: over all steps
error_exact          rigid: from the exact rigid motion, time error included; None elsewhere
order, mesh_order    of convergence from the next coarser mesh, with h = unknowns^(-1/3), and with h = size of a cell.
                     None: first mesh, or rigid, where errors end at the bar's own flexibility
seconds              run time, median of `repeats`, without set-up and compilation; setup_s: model, compilation and
                     recording of the launches, in the first run; ms_per_step: None in statics
newton, pcg          iterations in all
tip                  last displacement of the tip, m

references: for each problem, the reference of its errors and how good that is.
"""

from __future__ import annotations

import itertools
import math
import statistics
import time as clock
from collections.abc import Iterator
from typing import Any

import numpy as np

import warpfea as wf
from warpfea.studies.timing import NOT_REPEATED, repeated

from . import ancf_bars as bars
from .table import Row, Run, Table

__all__ = ["TABLE", "observed_order"]

DT = {"rigid": 1e-2, "sudden": 5e-3}
STEPS = {"rigid": 50, "sudden": 100}
TOL = {"rigid": 1e-6, "large": 1e-7, "sudden": 1e-6}
START = np.array([bars.LENGTH, 0.5 * bars.SIDE, 0.5 * bars.SIDE])  # m, of the tip
REFERENCE = "H3843"  # it comes closest, and is none of the tetrahedra
ASSUMED_ORDER = 3.5  # where three meshes do not tell


def measure(problem: str, element: str, level: int, run: Run) -> Row:
    """Figures of a mesh of a problem, measured once, with its "path": (n, 3), m, tips at the ends of the steps."""
    key = (problem, element, level)
    if key not in run.made:
        began = clock.perf_counter()
        model = bars.build(*key).finalize(device=run.device)
        made = clock.perf_counter() - began
        times = 1 if run.quick else run.options["repeat"]
        found = repeated(lambda: _once(problem, model, run), lambda one: float(one["seconds"]), times)
        info, seconds = model.info(), statistics.median(one["seconds"] for one in found)
        run.made[key] = {
            "problem": problem, "element": element, "cells": bars.cells_of(level), "elements": info["elements"],
            "unknowns": info["unknowns"], **found[0], "seconds": seconds, "repeats": len(found),
            "setup_s": made + found[0]["setup_s"],
            "ms_per_step": None if problem == "large" else 1e3 * seconds / len(found[0]["path"]),
        }  # fmt: skip
    return dict(run.made[key])


def _once(problem: str, model: wf.Model, run: Run) -> Row:
    """A run: its path, iterations and times."""
    solver = wf.NewtonPCG(tol=TOL[problem], max_pcg=20000, max_newton=50)
    began = clock.perf_counter()
    if problem == "large":
        static = wf.solve_static(model, load_steps=1, solver=solver)
        whole, sim = clock.perf_counter() - began, static.simulation
        setup, path = sim.compile_s, static.probe("tip").displacement[0, -1:]
    else:
        sim = wf.Simulation(model, dt=DT[problem], integrator="bdf2", solver=solver, ledger=False)
        setup = clock.perf_counter() - began
        sim.step(_steps(problem, run))
        whole, path = clock.perf_counter() - began, sim.probe("tip").displacement[0]
    counts = {name: int(sim.totals[name][0]) for name in ("newton", "pcg")}
    return {"path": path, "seconds": whole - setup, "setup_s": setup, **counts, "tip": path[-1].tolist()}


def _steps(problem: str, run: Run) -> int:
    return 10 if run.quick else STEPS[problem]


def levels(problem: str, element: str, run: Run) -> list[int]:
    """Meshes of an element, coarse to fine."""
    sizes, most = run.options["sizes"], run.options["dynamic_up_to"]
    if run.quick:
        sizes, most = [size for size in sizes if size in (300, 1000)] or sizes, min(most, 500)
    wanted = [size for size in sizes if problem == "large" or size <= most] or [min(sizes)]
    return sorted({bars.level_for(element, size) for size in wanted})


def references(run: Run) -> dict[str, Any]:
    """Tips that errors are measured against, and how good they are."""
    out = {}
    for problem in bars.PROBLEMS:
        path, known = (_rigid if problem == "rigid" else _extrapolated)(problem, run)
        run.made["path", problem] = path
        out[problem] = known
    return out


def _extrapolated(problem: str, run: Run) -> tuple[np.ndarray, Row]:
    """Displacements (n, 3), m, from the finest meshes of bricks."""
    level = levels(problem, REFERENCE, run)[-1]
    level += level < 3
    finest, coarser = (measure(problem, REFERENCE, k, run)["path"] for k in (level, level - 1))
    order = ASSUMED_ORDER
    if level >= 3:
        order = observed_order(measure(problem, REFERENCE, level - 2, run)["path"], coarser, finest, level)
    path = finest + (finest - coarser) / ((level / (level - 1)) ** order - 1.0)
    own, cells = _distance(path, finest), bars.cells_of(level)
    how = "static" if problem == "large" else f"{_steps(problem, run)} steps of {DT[problem]:g} s"
    about = (
        f"E = {bars.SOFT:g} Pa, {how}; error from {REFERENCE} on {'x'.join(map(str, cells))} cells, extrapolated "
        f"with order {order:.1f}, which moved the tip by {own:.1e} of the length"
    )
    unknowns = measure(problem, REFERENCE, level, run)["unknowns"]
    known = {"element": REFERENCE, "cells": cells, "unknowns": unknowns, "order": order, "own_error": own}
    return path, {"about": about, **known, "tip": path[-1].tolist()}


def _rigid(problem: str, run: Run) -> tuple[np.ndarray, Row]:
    """Displacements (n, 3), m, of the rigid bar in the same steps."""
    dt, steps = DT[problem], _steps(problem, run)
    exact, path = _exact(steps), bars.stepped_tip(dt, steps)
    floor, half = _distance(path, exact), _distance(bars.stepped_tip(dt / 2, 2 * steps)[1::2], exact)
    about = (
        f"E = {bars.STIFF:g} Pa, {steps} steps of {dt:g} s; error from the rigid body in the same steps, so the bar's "
        f"flexibility; the steps alone are {floor:.1e} off the exact motion ({half:.1e} with half the step)"
    )
    known = {"time_error": floor, "time_error_half_step": half, "time_order": math.log2(floor / half)}
    return path - START, {"about": about, **known}


def _exact(steps: int) -> np.ndarray:
    return bars.exact_tip(DT["rigid"] * np.arange(1, steps + 1))


def _distance(path: np.ndarray, reference: np.ndarray) -> float:
    """Largest distance over the steps, in lengths of the bar."""
    return float(np.linalg.norm(path - reference, axis=1).max() / bars.LENGTH)


def observed_order(coarse: np.ndarray, middle: np.ndarray, fine: np.ndarray, level: int) -> float:
    """Order p of results a + b h^p on level - 2, level - 1, level, within 2 and 6; ASSUMED_ORDER where none fits."""
    from scipy.optimize import brentq

    ratio = np.linalg.norm(middle - coarse) / np.linalg.norm(fine - middle)
    a, b, c = level - 2.0, level - 1.0, float(level)

    def excess(p: float) -> float:
        return float((a**-p - b**-p) / (b**-p - c**-p) - ratio)

    return float(brentq(excess, 2.0, 6.0)) if excess(2.0) < 0.0 < excess(6.0) else ASSUMED_ORDER


def rows(run: Run) -> Iterator[Row]:
    """A row per problem, element and mesh."""
    for problem, element in itertools.product(bars.PROBLEMS, bars.ELEMENTS):
        coarse: Row | None = None
        for level in levels(problem, element, run):
            row = measure(problem, element, level, run)
            path = row.pop("path")
            row["error"] = _distance(path, run.made["path", problem])
            rigid = problem == "rigid"
            row["error_exact"] = _distance(path, _exact(len(path)) - START) if rigid else None
            row |= {"order": None, "mesh_order": None}
            if coarse is not None and not rigid:
                fall = math.log(coarse["error"] / row["error"])
                row["order"] = 3.0 * fall / math.log(row["unknowns"] / coarse["unknowns"])
                row["mesh_order"] = fall / math.log(row["cells"][1] / coarse["cells"][1])
            yield row
            coarse = row


TABLE = Table(
    about=__doc__,
    parts={"references": references, "rows": rows},
    results={"ancf_tets.json": "ancf_tets --out tests/results/ancf_tets.json"},
    options={"sizes": (100, 300, 1000, 3000, 10000), "dynamic_up_to": 1500, "repeat": 3},
    settings={
         "not_repeated_beyond_s": NOT_REPEATED, "bar": (bars.LENGTH, bars.SIDE, bars.SIDE), "nu": bars.NU,
        "density": bars.DENSITY, "E": {"rigid": bars.STIFF, "large": bars.SOFT, "sudden": bars.SOFT},
        "weight": {"large": bars.WEIGHT, "sudden": 0.5 * bars.WEIGHT}, "gravity": bars.GRAVITY, "integrator": "bdf2",
        "dt": DT, "steps": STEPS, "load_steps": 1, "tol": TOL, "dtype": "float64",
    },
    columns=("problem", "element", "elements", "unknowns", "error", "order", "mesh_order", "seconds", "ms_per_step",
             "newton", "pcg"),
)  # fmt: skip
