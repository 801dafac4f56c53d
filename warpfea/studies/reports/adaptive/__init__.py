"""`warpfea study adaptive`: dt="auto" beside the error that was asked for, and beside fixed steps.

adaptive    true error, Newton iterations and substeps of each scene, integrator and error asked for.
fixed       the same of fixed steps, in powers of two.
references  what errors are measured from, and the estimate of its own error.

An error is the largest distance of a position from the reference at eight common instants, over the model's size.
`cost` is the Newton iterations over those of the best fixed step with the same true error, interpolated between the
runs of `fixed`; beyond them extrapolated with the order of the scheme (`extrapolated`). The impacts of `impact` and
`contact` last a hundredth of the run; `soft_contact` has neither a short impact nor a smooth motion. The committed
result is tests/results/adaptive_cpu.json.
"""

from __future__ import annotations

import argparse
import time as clock
from collections.abc import Iterator
from typing import Any

import numpy as np

import warpfea as wf

from ....simulation.integrators import INTEGRATORS
from ..parts import Part, Rows, run_tables
from .cases import CASES

__all__ = ["ERRORS", "PARTS", "adaptive", "distance", "fixed", "move", "references", "run"]

ERRORS = (1e-2, 1e-3, 1e-4, 1e-5)
PIECES = 8
FINE = {"stiff": 2e-7, "impact": 2e-7, "dead_points": 4e-7, "free_flight": 2e-7, "contact": 2e-7, "soft_contact": 2e-7}
"""Error that references are asked for; the run with four times it tells how good they are."""
FINEST = {"backward_euler": 16384, "bdf2": 8192}
"""Most fixed steps."""
LEFT_OUT = {
    ("impact", "backward_euler"): (1e-4, 1e-5),
    ("contact", "backward_euler"): (1e-5,),
    ("soft_contact", "backward_euler"): (1e-5,),
}
"""Not run: backward Euler would take 3e5 and 3e6 steps, 1e5 of the contacts."""
_found: dict[Any, Any] = {}


def move(name: str, *, steps: int | None = None, error: float | None = None, integrator: str, tol: float = 1e-8) -> Any:
    """Run a scene with fixed steps or to an error: positions (PIECES, nodes, 3), m; what it took; the size, m."""
    build, end = CASES[name]()
    model = build.finalize(device="cpu")
    options: dict[str, Any] = {"integrator": integrator, "solver": wf.NewtonPCG(tol=tol), "ledger": False}
    if steps is None:
        sim = wf.Simulation(model, dt="auto", error=error, interval=end / PIECES, horizon=end, **options)
    else:
        sim = wf.Simulation(model, dt=end / steps, **options)
    places: list[np.ndarray] = []

    def keep(_: wf.Simulation) -> None:
        if sim.time[0] >= end * ((len(places) + 1) / PIECES - 1e-9):
            places.append(np.concatenate([sim.positions(body)[0] for body in model.bodies]))

    began = clock.perf_counter()
    sim.run(end, on_step=keep, progress=False)
    took = {"newton": int(sim.totals["newton"][0]), "pcg": int(sim.totals["pcg"][0])}
    if steps is None:
        took |= {key: int(sim.totals[key][0]) for key in ("substeps", "rejected")}
    return np.array(places), took | {"wall_s": clock.perf_counter() - began}, float(model.size)


def distance(a: np.ndarray, b: np.ndarray, size: float) -> float:
    """Largest distance of positions (..., 3), over the size."""
    return float(np.linalg.norm(a - b, axis=-1).max() / size)


def references() -> Iterator[dict[str, Any]]:
    """A fine run of each scene, and one for four times its error."""
    for name in CASES:
        error = FINE[name]
        coarse, _, size = move(name, error=4.0 * error, integrator="bdf2", tol=1e-10)
        fine, took, _ = move(name, error=error, integrator="bdf2", tol=1e-10)
        _found[name] = fine
        own = distance(coarse, fine, size)
        yield {"scene": name, "what": f"bdf2, error = {error:g}", "own_error": own, **took}


def fixed() -> Iterator[dict[str, Any]]:
    """Fixed steps in powers of two."""
    for name in CASES:
        for integrator, most in FINEST.items():
            steps = PIECES
            while steps <= most:
                places, took, size = move(name, steps=steps, integrator=integrator)
                true = distance(places, _found[name], size)
                row = {"scene": name, "integrator": integrator, "steps": steps, "true": true, **took}
                _found.setdefault((name, integrator), []).append(row)
                yield row
                steps *= 2


def adaptive() -> Iterator[dict[str, Any]]:
    """Errors asked for."""
    for name in CASES:
        for integrator in FINEST:
            for error in ERRORS:
                if error in LEFT_OUT.get((name, integrator), ()):
                    continue
                places, took, size = move(name, error=error, integrator=integrator)
                true = distance(places, _found[name], size)
                best, beyond = best_fixed(_found[name, integrator], true, INTEGRATORS[integrator].order)
                yield {
                    "scene": name, "integrator": integrator, "asked": error, "true": true, "ratio": true / error,
                    **took, "cost": took["newton"] / best, "extrapolated": beyond,
                }  # fmt: skip


def best_fixed(rows: Rows, true: float, order: int) -> tuple[float, bool]:
    """Newton iterations of the cheapest fixed step with a true error, and whether that is below those of the rows."""
    ranked = sorted((row["true"], row["newton"]) for row in rows)
    least, most = ranked[0]
    if true < least:
        return most * (least / true) ** (1.0 / order), True
    cheapest = np.minimum.accumulate([newton for _, newton in ranked])
    at = np.interp(np.log(true), np.log([error for error, _ in ranked]), np.log(cheapest))
    return float(np.exp(at)), False


PARTS: dict[str, Part] = {f.__name__: f for f in (references, fixed, adaptive)}


def run(options: argparse.Namespace) -> None:
    """Do `warpfea study adaptive`."""
    options.device = "cpu"
    settings = {"instants": PIECES, "tol": 1e-8, "errors": list(ERRORS), "fine": FINE}
    run_tables(options, PARTS, settings)
