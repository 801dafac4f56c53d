"""Bodies that friction holds for long: a cube pressed to a wall, and one that rides on a plate that turns."""

from __future__ import annotations

import math
import time as clock
from typing import Any

import numpy as np

import warpfea as wf

__all__ = ["CUBE", "SPEED", "TURN_STEPS", "turntable_case", "wall_case"]

EDGE, G = 0.1, 9.81
CUBE = {"edge": EDGE, "mass": 1.0, "nu": 0.3, "tol": 1e-10}
"""Of 1000 kg/m^3."""
PRESSED, DT = 20.0, 1e-2
SPEED, TURN_STEPS = 10.0, 200
REST, RAMP = 200, 20
"""Steps before the plate turns, and those in which it comes to its speed."""


def _cube(b: wf.ModelBuilder, element: str, E: float, origin: tuple[float, float, float]) -> Any:
    mesh = wf.mesh.box((EDGE, EDGE, EDGE), cells=(1, 1, 1), element=element, origin=origin)
    return b.add_solid(mesh, material=wf.SVK(E=E, nu=0.3, density=1000.0), name="cube")


def _simulation(b: wf.ModelBuilder, dt: float, device: Any) -> wf.Simulation:
    return wf.Simulation(b.finalize(device=device), dt=dt, solver=wf.NewtonPCG(tol=CUBE["tol"]), record=False)


def _cost(sim: wf.Simulation, began: float) -> dict[str, Any]:
    """What the run took."""
    return {
        "steps": sim.steps,
        "newton": int(sim.totals["newton"][0]),
        "pcg": int(sim.totals["pcg"][0]),
        "ledger_residual": float(sim.energies()["ledger_residual"][0]),
        "seconds": clock.perf_counter() - began,
    }


def wall_case(element: str, *, settle: float = 10.0, hold: float = 10.0, device: Any = "cpu") -> dict[str, Any]:
    """A cube of E = 1e6 Pa that 20 N press to a wall of mu = 1 under its weight: how far any node moves in `hold` s
    after `settle` s from rest, m, and what the wall bears, N."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body = _cube(b, element, 1e6, (0.0, 0.0, 0.0))
    b.add_traction(body.surface("x+"), (-PRESSED / EDGE**2, 0, 0))
    wall = b.add_collider(wf.HalfSpace((1, 0, 0)), name="wall")
    pad = b.add_contact(body.surface("x-"), wall, mu=1.0, restitution=0.5, name="pad")
    sim = _simulation(b, DT, device)
    began = clock.perf_counter()
    sim.step(round(settle / DT))
    before = sim.positions(body).copy()
    sim.step(round(hold / DT))
    return {
        "element": element,
        "dt": DT,
        "settle_s": settle,
        "hold_s": hold,
        "moved": float(np.abs(sim.positions(body) - before).max()),
        "force": sim.contact_force(pad)[0, :3].tolist(),
        **_cost(sim, began),
    }


def turntable_case(law: str, *, turns: int = 10, device: Any = "cpu") -> dict[str, Any]:
    """A cube of E = 1e8 Pa on a plate that turns at 10 rad/s, 200 steps a turn: by how much its nodes have moved on the
    plate from the end of the first turn to that of the last, over its edge."""
    dt = 2.0 * math.pi / SPEED / TURN_STEPS
    first = REST + RAMP
    times = dt * np.arange(first + TURN_STEPS * turns + 1)
    angle = SPEED * dt * np.maximum(np.arange(len(times)) - REST - RAMP / 2, 0.0)
    angle[REST : first + 1] = 0.5 * SPEED * dt * np.arange(RAMP + 1) ** 2 / RAMP
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    centre = 0.5 * EDGE
    path = wf.Rotation(anchor=(centre, centre, 0), axis=(0, 0, 1), angle=(times, angle))
    plate = b.add_collider(wf.HalfSpace((0, 0, 1)), path=path, name="plate")
    body = _cube(b, "T4", 1e8, (0.2 * EDGE, 0.0, 0.0))
    b.add_contact(body.surface("z-"), plate, mu=0.8, restitution=0.5, stiffness=0.1, law=law, name="pad")
    sim = _simulation(b, dt, device)
    began = clock.perf_counter()
    sim.step(first)
    places = []
    for turn in range(turns):
        sim.step(TURN_STEPS)
        a = angle[first + TURN_STEPS * (turn + 1)]
        R = np.array([[math.cos(a), math.sin(a), 0], [-math.sin(a), math.cos(a), 0], [0, 0, 1]])
        places.append((sim.positions(body)[0] - (centre, centre, 0)) @ R.T)
    moved = [float(np.abs(place - places[0]).max() / EDGE) for place in places]
    return {"law": law, "dt": dt, "turns": turns, "moved": moved[-1], "moved_by_turn": moved, **_cost(sim, began)}
