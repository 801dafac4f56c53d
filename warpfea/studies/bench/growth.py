"""`warpfea bench --growth`: how PCG iterations grow with the mesh, over stiffness, step and Poisson's ratio.

The first linear solve of a step from rest, to 1e-8 of its right side in the D^-1 norm, of the problems of
problems.py, undamped, under 1e-10 E over the loaded area so that strains are small and the same for all E. Growth
is that of the iterations from the first size to the last. A solve that does not get there is shown as failed.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import math
from dataclasses import dataclass
from typing import Any

from ...base.errors import ConvergenceError
from ...materials import SVK
from ...simulation.simulation import Simulation
from .measure import check_sizes, solver, write
from .problems import DENSITY, PROBLEMS, Problem

__all__ = ["GrowthRow", "growth"]

GROWN = ("bar", "beam", "plate")
MODULI = (1e5, 1e8, 1e11)
STEPS = (1e-4, 1e-3, 1e-2)
RATIOS = (0.3, 0.49)
SIZES = (10_000, 100_000, 1_000_000)
LOAD = 1e-10
TOL = 0.1
"""Of the step: any solve that works reaches it with the first Newton iteration."""
LIMITS = {"forcing": 1e-8, "max_newton": 1, "max_pcg": 5000, "max_halvings": 0}


@dataclass(frozen=True)
class GrowthRow:
    """Iterations of a step in all sizes.

    Attributes:
        E, dt, nu: Pa, s, -.
        unknowns: of each size.
        outcome: of each size, "converged" or the error.
        newton: iterations of each size, one where all is well.
        pcg: iterations of each size, None where it failed.
        growth: PCG iterations of the last size over those of the first; None where either failed.
    """

    problem: str
    E: float
    dt: float
    nu: float
    unknowns: list[int]
    outcome: list[str]
    newton: list[int | None]
    pcg: list[int | None]
    growth: float | None


@dataclass(frozen=True)
class _Cell:
    unknowns: int
    outcome: str
    newton: int | None
    pcg: int | None


def measure(problem: Problem, sizes: list[int], *, device: Any) -> list[GrowthRow]:
    """Rows of a problem, one per E, dt and nu; a model and a simulation per size, E and nu."""
    cells: dict[tuple[float, float, float], list[_Cell]] = {}
    for wanted, E, nu in itertools.product(sizes, MODULI, RATIOS):
        law = SVK(E=E, nu=nu, density=DENSITY)
        model = problem.build(problem.size_for(wanted), law=law, traction=LOAD * E).finalize(device=device)
        sim = Simulation(model, dt=STEPS[0], solver=solver(TOL, **LIMITS), ledger=False)
        for dt in STEPS:
            sim.reset()
            sim.dt = dt
            cells.setdefault((E, dt, nu), []).append(_step(sim))
        del sim, model
        gc.collect()  # a model refers to itself: its memory is wanted for the next
    rows = []
    for (E, dt, nu), row in sorted(cells.items()):
        first, last = row[0].pcg, row[-1].pcg
        rows.append(
            GrowthRow(
                problem=problem.name,
                E=E,
                dt=dt,
                nu=nu,
                unknowns=[c.unknowns for c in row],
                outcome=[c.outcome for c in row],
                newton=[c.newton for c in row],
                pcg=[c.pcg for c in row],
                growth=None if first is None or last is None else last / first,
            )
        )
    return rows


def _step(sim: Simulation) -> _Cell:
    unknowns = sim.model.info()["unknowns"]
    try:
        report = sim.step()
    except ConvergenceError as error:
        return _Cell(unknowns, f"ConvergenceError: {error}", None, None)
    if report.pcg[0] >= LIMITS["max_pcg"]:
        return _Cell(unknowns, f"{LIMITS['max_pcg']} iterations were not enough", int(report.newton[0]), None)
    return _Cell(unknowns, "converged", int(report.newton[0]), int(report.pcg[0]))


def growth(options: argparse.Namespace) -> None:
    """Do `warpfea bench --growth`: a table per problem, and the file after each."""
    problems = [PROBLEMS[name] for name in options.problem or GROWN]
    sizes = sorted(options.unknowns or SIZES)
    check_sizes(problems, sizes)
    settings = {
        "problems": [p.name for p in problems],
        "sizes": sizes,
        "E": MODULI,
        "dt": STEPS,
        "nu": RATIOS,
        "traction_over_E": LOAD,
        "tol": TOL,
        **LIMITS,
    }
    rows: list[GrowthRow] = []
    worst: dict[str, dict[str, Any]] = {}
    for problem in problems:
        found = measure(problem, sizes, device=options.device)
        rows += found
        largest = max((r.growth for r in found if r.growth is not None), default=math.nan)
        failed = sum(outcome != "converged" for r in found for outcome in r.outcome)
        worst[problem.name] = {"growth": None if math.isnan(largest) else largest, "failures": failed}
        print(_table(found), f"{problem.name}: largest growth {largest:.2f}, {failed} failed", sep="\n", flush=True)
        write(options, settings, rows, worst=worst)


def _table(rows: list[GrowthRow]) -> str:
    head = f"{'problem':8} {'E, Pa':>6} {'dt, s':>6} {'nu':>5}"
    lines = [head + "".join(f" {f'PCG at {n}':>16}" for n in rows[0].unknowns) + f" {'growth':>7}"]
    for r in rows:
        cells = ["failed" if p is None else str(p) for p in r.pcg]
        last = "-" if r.growth is None else f"{r.growth:.2f}"
        lines.append(
            f"{r.problem:8} {r.E:6.0e} {r.dt:6.0e} {r.nu:5.2f}" + "".join(f" {c:>16}" for c in cells) + f" {last:>7}"
        )
    return "\n".join(lines)
