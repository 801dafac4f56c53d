"""Iterations of single linear solves with contact, beside those of the same body with its contact nodes clamped.

The blocks of contact.py, at the iterates of `STEPS` steps: those of a solve to 1e-8 of its right side with H and the
two-level preconditioner of that very iterate.

resting: beside the block with its lower face clamped.
sliding: beside the block whose lower face is held along the normal, pulled by the friction of its weight.

Each with the contact's own stiffness and with 100 times that, where a preconditioner that did not know of it would need
2 to 3 times the iterations.
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from ...simulation.simulation import Simulation
from ...solvers.twolevel import TwoLevel
from .measure import solver

__all__ = ["FORCING", "SOLVES", "STEPS", "SolveRow", "count_solves", "solve_rows", "solves"]

FORCING = 1e-8
STEPS = 3
BAR = 1.3
BESIDE = {"resting": "clamped", "sliding": "guided"}
SOLVES = [("clamped", 1.0), ("guided", 1.0), *((scene, stiffness) for scene in BESIDE for stiffness in (1.0, 100.0))]
"""Scenes of contact.py, and the contact's stiffness over its own."""


@dataclass(frozen=True)
class SolveRow:
    """Solves at the iterates of a scene.

    Attributes:
        stiffness: of the contact, over its own.
        pcg: iterations of each solve. per_solve: their mean. levels: of the preconditioner.
        ratio: mean over that of the scene beside, or None. bar: largest wanted.
    """

    scene: str
    dtype: str
    unknowns: int
    levels: int
    stiffness: float
    pcg: list[int]
    per_solve: float
    beside: str | None
    ratio: float | None
    bar: float | None


def count_solves(sim: Simulation, steps: int) -> list[int]:
    """Iterations of each linear solve of so many steps, with matrix and preconditioner of that very iterate."""
    loop, work = sim.stepper.newton, sim.stepper.work
    solve, counts, preconditioner = loop.pcg.solve, [], loop.preconditioner
    assert isinstance(preconditioner, TwoLevel)

    def anew(active: wp.array) -> None:
        loop.residual.take(active)
        preconditioner.renew(active)
        solve(active)
        counts.append(int(work.pcg.iterations.numpy()[0]))

    loop.pcg.solve = anew  # type: ignore[method-assign]
    sim.step(steps)
    return counts


def solves(before: Simulation) -> tuple[list[int], int]:
    """Iterations of each linear solve of the steps after those of a simulation, and levels of the preconditioner."""
    options = solver(None, forcing=FORCING, preconditioner="two-level")
    sim = Simulation(before.model, before.state, dt=before.dt, solver=options, ledger=False, capture=False)
    counts, preconditioner = count_solves(sim, STEPS), sim.stepper.newton.preconditioner
    assert isinstance(preconditioner, TwoLevel)
    return counts, len(preconditioner.levels)


def solve_rows(sims: dict[tuple[str, float], Simulation]) -> list[SolveRow]:
    """Rows of `SOLVES`, which go on from where these simulations are."""
    found = {key: solves(sims[key]) for key in SOLVES}
    mean = {key: sum(counts) / len(counts) for key, (counts, _) in found.items()}
    rows = []
    for (scene, stiffness), (counts, levels) in found.items():
        model, own, beside = sims[scene, stiffness].model, mean[scene, stiffness], BESIDE.get(scene)
        ratio, bar = (own / mean[beside, 1.0], BAR) if beside else (None, None)
        unknowns = model.info()["unknowns"]
        rows.append(SolveRow(scene, model.dtype, unknowns, levels, stiffness, counts, own, beside, ratio, bar))
    return rows
