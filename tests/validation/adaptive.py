"""dt="auto" compared with its requested error, and with fixed steps.

references reference runs, and the estimate of their own error.
fixed       true error and Newton iterations of fixed steps, in powers of two.
adaptive also substeps, for each scene, integrator and requested error.

An error is the largest distance of a position from the reference at eight common instants, over the model's size.
`cost` is the Newton iterations over those of the best fixed step with the same true error, interpolated between the
runs of `fixed`; beyond them extrapolated with the order of the scheme (`extrapolated`). The impacts of `impact` and
`contact` last a hundredth of the run; `soft_contact` has neither a short impact nor a smooth motion. Parts go on from
the parts before them.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import warpfea as wf
from warpfea.simulation.integrators import INTEGRATORS

from .table import Row, Run, Table

__all__ = ["CASES", "TABLE"]

STEEL = wf.SVK(E=2e11, nu=0.3, density=7800.0)
RUBBER = wf.SVK(E=1e6, nu=0.4, density=1000.0)


def stiff() -> tuple[wf.ModelBuilder, float]:
    """A thin steel beam swings from a pin: its axial waves are ten thousand times faster than the swing."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    line, section = [(0, 0, 0), (1.0, 0, 0)], wf.Rectangle(0.02, 0.02)
    beam = b.add_beam(line, elements=3, section=section, normal=(0, 0, 1), material=STEEL)
    b.clamp(beam.start, slots="position")
    return b, 0.3


def impact() -> tuple[wf.ModelBuilder, float]:
    """A damped free bar at rest is struck at a corner by a load that lasts a hundredth of the run, and flies on."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    damped = wf.SVK(E=1e8, nu=0.4, density=1000.0, damping=wf.KelvinVoigt(eta=1e5, lambda_v=1e5))
    bar = b.add_solid(wf.mesh.box((0.6, 0.3, 0.3), cells=(2, 1, 1)), material=damped)
    end, start, blow = 0.2, 0.0341, 8e4
    times = [0.0, start, start + 0.005 * end, start + 0.01 * end]
    force = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.5 * blow, 0.0, blow), (0.0, 0.0, 0.0)]
    b.add_point_load(bar.at((0.6, 0.3, 0.0)), force=(times, force))
    return b, end


def dead_points() -> tuple[wf.ModelBuilder, float]:
    """A free slider-crank goes by its inertia through a dead point, from 40 degrees before it to about 40 after it."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    crank, rod, speed, angle = 0.15, 0.3, 20.0, np.radians(140.0)
    pin = crank * np.array([np.cos(angle), 0.0, np.sin(angle)])
    tilt = np.arcsin(pin[2] / rod)  # of the rod, downwards to the slider
    end = pin + rod * np.array([np.cos(tilt), 0.0, -np.sin(tilt)])
    turn = speed * crank * np.cos(angle) / (rod * np.cos(tilt))  # d tilt/dt
    arm = b.add_beam(
        [(0, 0, 0), tuple(pin)], elements=1, section=wf.Rectangle(0.02, 0.02), normal=(0, 1, 0), material=STEEL
    )
    link = b.add_beam(
        [tuple(pin), tuple(end)], elements=2, section=wf.Rectangle(0.01, 0.01), normal=(0, 1, 0), material=STEEL
    )
    push = speed * np.array([-pin[2], 0.0, pin[0]])
    b.set_initial(arm, velocity=lambda X: speed * np.column_stack([-X[:, 2], 0.0 * X[:, 1], X[:, 0]]))
    b.set_initial(
        link, velocity=lambda X: push + turn * np.column_stack([X[:, 2] - pin[2], 0.0 * X[:, 1], pin[0] - X[:, 0]])
    )
    b.add_joint("revolute", parent=wf.GROUND, child=arm.start, axis=(0, -1, 0))
    b.add_joint("revolute", parent=arm.end, child=link.start, axis=(0, -1, 0))
    b.clamp(link.end, slots="position", components="yz")
    return b, np.radians(80.0) / speed


def free_flight() -> tuple[wf.ModelBuilder, float]:
    """A soft bar is thrown with a spin."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    bar = b.add_solid(wf.mesh.box((1.0, 0.2, 0.1), cells=(3, 1, 1)), material=RUBBER)
    b.set_initial(bar, velocity=(1.0, 0.0, 2.0), angular_velocity=(1.0, 5.0, 2.0))
    return b, 0.2


def contact() -> tuple[wf.ModelBuilder, float]:
    """A hard damped spinning ball falls on a floor, touches it for a hundredth of the run, and rebounds."""
    hard = wf.SVK(E=1e10, nu=0.3, density=1100.0, damping=wf.KelvinVoigt(eta=1e5, lambda_v=1e5))
    b, ball = _ball(hard, stiffness=0.2)
    b.set_initial(ball, angular_velocity=(0.0, 10.0, 0.0))
    return b, 0.08


def soft_contact() -> tuple[wf.ModelBuilder, float]:
    """A ball falls on a soft floor, stays in contact for two fifths of the run, and rebounds."""
    b, _ = _ball(wf.SVK(E=1e8, nu=0.3, density=1100.0), stiffness=0.002)
    return b, 0.08


def _ball(material: wf.SVK, *, stiffness: float) -> tuple[wf.ModelBuilder, wf.Body]:
    """A ball 1 cm above a floor, with the stiffness of the contact over Hertz's."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    radius, drop = 0.05, 0.01
    mesh = wf.mesh.sphere(radius, cells=2, center=(0.0, 0.0, drop + radius))
    ball = b.add_solid(mesh, material=material)
    floor = b.add_collider(wf.HalfSpace(normal=(0, 0, 1)))
    b.add_contact(ball, floor, model="sphere", radius=radius, restitution=1.0, stiffness=stiffness)
    return b, ball


CASES: dict[str, Callable[[], tuple[wf.ModelBuilder, float]]] = {
    f.__name__: f for f in (stiff, impact, dead_points, free_flight, contact, soft_contact)
}
"""Name -> function returning a scene and its end, s."""


ERRORS = (1e-2, 1e-3, 1e-4, 1e-5)
PIECES = 8
FINE = {"stiff": 2e-7, "impact": 2e-7, "dead_points": 4e-7, "free_flight": 2e-7, "contact": 2e-7, "soft_contact": 2e-7}
"""Error requested of references; the run with four times it gives their own error."""
FINEST = {"backward_euler": 16384, "bdf2": 8192}
"""Maximum number of fixed steps."""
LEFT_OUT = {
    ("impact", "backward_euler"): (1e-4, 1e-5),
    ("contact", "backward_euler"): (1e-5,),
    ("soft_contact", "backward_euler"): (1e-5,),
}
"""Skipped: backward Euler would take 3e5 and 3e6 steps, 1e5 of the contacts."""
_found: dict[Any, Any] = {}


def move(name: str, *, steps: int | None = None, error: float | None = None, integrator: str, tol: float = 1e-8) -> Any:
    """Run a scene with fixed steps or to an error: positions (PIECES, nodes, 3), m; cost; size, m."""
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


def references(run: Run) -> Iterator[Row]:
    """A fine run of each scene, and one for four times its error."""
    for name in filter(run.wants, CASES):
        error = FINE[name]
        coarse, _, size = move(name, error=4.0 * error, integrator="bdf2", tol=1e-10)
        fine, took, _ = move(name, error=error, integrator="bdf2", tol=1e-10)
        _found[name] = fine
        own = distance(coarse, fine, size)
        yield {"scene": name, "what": f"bdf2, error = {error:g}", "own_error": own, **took}


def fixed(run: Run) -> Iterator[Row]:
    """Fixed steps in powers of two."""
    for name in filter(run.wants, CASES):
        for integrator, most in FINEST.items():
            steps = PIECES
            while steps <= most:
                places, took, size = move(name, steps=steps, integrator=integrator)
                true = distance(places, _found[name], size)
                row = {"scene": name, "integrator": integrator, "steps": steps, "true": true, **took}
                _found.setdefault((name, integrator), []).append(row)
                yield row
                steps *= 2


def adaptive(run: Run) -> Iterator[Row]:
    """Requested errors."""
    for name in filter(run.wants, CASES):
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


def best_fixed(rows: list[Row], true: float, order: int) -> tuple[float, bool]:
    """Newton iterations of the cheapest fixed step with a given true error, and True if it is below those of the
    rows.
    """
    ranked = sorted((row["true"], row["newton"]) for row in rows)
    least, most = ranked[0]
    if true < least:
        return most * (least / true) ** (1.0 / order), True
    cheapest = np.minimum.accumulate([newton for _, newton in ranked])
    at = np.interp(np.log(true), np.log([error for error, _ in ranked]), np.log(cheapest))
    return float(np.exp(at)), False


TABLE = Table(
    about=__doc__,
    parts={"references": references, "fixed": fixed, "adaptive": adaptive},
    results={"adaptive_cpu.json": "adaptive --out tests/results/adaptive_cpu.json"},
    settings={"instants": PIECES, "tol": 1e-8, "errors": list(ERRORS), "fine": FINE},
)
