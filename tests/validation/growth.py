"""PCG iterations against the size of the mesh, over stiffness, step and Poisson's ratio.

The first linear solve of a step from rest, to 1e-8 of its right side in the D^-1 norm, of the problems of `warpfea
bench`, undamped, under 1e-10 E over the loaded area so that strains are small and the same for all E. A row has the
iterations of all sizes; `growth` is that of the iterations from the first size to the last, and None where either
failed. A solve that does not get there has its error as `outcome`, and no iterations.
"""

from __future__ import annotations

import gc
import itertools
from collections.abc import Iterator
from typing import Any

import warpfea as wf
from warpfea.studies.bench.measure import solver
from warpfea.studies.bench.problems import DENSITY, PROBLEMS, Problem
from warpfea.studies.bench.sizes import check_sizes

from .table import Row, Run, Table

__all__ = ["LIMITS", "TABLE"]

MODULI = (1e5, 1e8, 1e11)
STEPS = (1e-4, 1e-3, 1e-2)
RATIOS = (0.3, 0.49)
LOAD = 1e-10
TOL = 0.1
"""Of the step: any solve that works reaches it with the first Newton iteration."""
LIMITS: dict[str, Any] = {"forcing": 1e-8, "max_newton": 1, "max_pcg": 5000, "max_halvings": 0}


def _step(sim: wf.Simulation) -> dict[str, Any]:
    """Outcome and iterations of a step."""
    try:
        report = sim.step()
    except wf.ConvergenceError as error:
        return {"outcome": f"ConvergenceError: {error}", "newton": None, "pcg": None}
    newton, pcg = int(report.newton[0]), int(report.pcg[0])
    if pcg >= LIMITS["max_pcg"]:
        return {"outcome": f"{LIMITS['max_pcg']} iterations were not enough", "newton": newton, "pcg": None}
    return {"outcome": "converged", "newton": newton, "pcg": pcg}


def of_problem(problem: Problem, sizes: list[int], device: Any) -> Iterator[Row]:
    """Rows of a problem, one per E, dt and nu; a model and a simulation per size, E and nu."""
    cells: dict[tuple[float, float, float], list[Row]] = {}
    for wanted, E, nu in itertools.product(sizes, MODULI, RATIOS):
        law = wf.SVK(E=E, nu=nu, density=DENSITY)
        model = problem.build(problem.size_for(wanted), law=law, traction=LOAD * E).finalize(device=device)
        sim = wf.Simulation(model, dt=STEPS[0], solver=solver(TOL, **LIMITS), ledger=False)
        for dt in STEPS:
            sim.reset()
            sim.dt = dt
            cells.setdefault((E, dt, nu), []).append({"unknowns": model.info()["unknowns"]} | _step(sim))
        del sim, model
        gc.collect()  # a model refers to itself: its memory is wanted for the next
    for (E, dt, nu), found in sorted(cells.items()):
        lists = {name: [cell[name] for cell in found] for name in found[0]}
        first, last = lists["pcg"][0], lists["pcg"][-1]
        growth = None if first is None or last is None else last / first
        yield {"problem": problem.name, "E": E, "dt": dt, "nu": nu, **lists, "growth": growth}


def rows(run: Run) -> Iterator[Row]:
    """A row per problem, E, dt and nu."""
    problems, sizes = [PROBLEMS[name] for name in run.options["problems"]], sorted(run.options["sizes"])
    check_sizes(problems, sizes)
    for problem in problems:
        yield from of_problem(problem, sizes, run.device)


def worst(run: Run) -> dict[str, Any]:
    """Largest growth and number of failures of each problem."""
    out = {}
    for name in run.options["problems"]:
        mine = [row for row in run.made["rows"] if row["problem"] == name]
        growths = [row["growth"] for row in mine if row["growth"] is not None]
        failures = sum(text != "converged" for row in mine for text in row["outcome"])
        out[name] = {"growth": max(growths, default=None), "failures": failures}
    return out


TABLE = Table(
    about=__doc__,
    parts={"rows": rows, "worst": worst},
    results={
        "growth_h200.json": "growth --device cuda:0 --set problems=bar,plate,beam --out tests/results/growth_h200.json",
        "growth_h200_beam.json": "growth --device cuda:0 --set problems=beam --out tests/results/growth_h200_beam.json",
    },
    options={"problems": ("bar", "beam", "plate"), "sizes": (10_000, 100_000, 1_000_000)},
    settings={
        "E": MODULI, "dt": STEPS,
        "nu": RATIOS, "traction_over_E": LOAD, "tol": TOL, **LIMITS,
    },
    columns=("problem", "E", "dt", "nu", "pcg", "growth"),
)  # fmt: skip
