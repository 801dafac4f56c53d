"""A stack of cubes that stand on each other: how far they move once they rest, and what each contact carries."""

from __future__ import annotations

import time as clock
from typing import Any

import numpy as np

import warpfea as wf

__all__ = ["STACK", "stack_case"]

SIDE, DENSITY, G = 0.1, 1000.0, 9.81
STACK = {"side": SIDE, "density": DENSITY, "nu": 0.3, "mu": 0.5, "element": "T4", "cells": 1}
"""Of the cubes; the lowest is clamped below."""


def stack_case(
    E: float, top: float, *, cubes: int = 10, duration: float = 10.0, dt: float = 1e-2, stiffness: float = 20.0,
    device: Any = "cpu",
) -> dict[str, Any]:  # fmt: skip
    """Let a stack rest whose last cube is `top` times as heavy; creep is counted from a tenth of the duration on.

    A stack is a column whose joints turn: with springs of k = 3.3 10^-2 stiffness E side in the joints those of E = 1e7
    buckle by their weight at `stiffness` 1 (q L^3/EI = 16 > 7.84 of Greenhill's column), and not at 20 (2.2).
    """
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    bodies = []
    for k in range(cubes):
        mesh = wf.mesh.box((SIDE,) * 3, cells=(1, 1, 1), origin=(0, 0, k * SIDE), element="T4")
        density = DENSITY * (top if k == cubes - 1 else 1.0)
        bodies.append(b.add_solid(mesh, material=wf.SVK(E=E, nu=0.3, density=density), name=f"cube {k}"))
    b.clamp(bodies[0].nodes("z-"))
    pairs = [
        b.add_contact(upper, lower, mu=0.5, restitution=0.5, stiffness=stiffness)
        for lower, upper in zip(bodies, bodies[1:])
    ]
    sim = wf.Simulation(b.finalize(device=device), dt=dt)
    steps, rest = round(duration / dt), max(round(0.1 * duration / dt), round(0.5 / dt))
    newton: list[int] = []
    creep, began, places = 0.0, clock.perf_counter(), None
    for k in range(steps):
        newton.append(int(sim.step().newton[0]))
        now = np.stack([sim.positions(body)[0] for body in bodies])
        if k + 1 == rest:
            places = now
        elif places is not None:
            creep = max(creep, float(np.abs(now - places).max()) / SIDE)
    seconds = clock.perf_counter() - began
    mass = DENSITY * SIDE**3
    weight = [G * mass * (top + cubes - 2 - k) for k in range(cubes - 1)]
    records = [sim.contact_record(pair) for pair in pairs]
    force = [float(np.abs(record.force[0, -1, 2])) for record in records]
    return {
        "E": E,
        "top": top,
        "cubes": cubes,
        "duration": duration,
        "dt": dt,
        "stiffness": stiffness,
        "creep": creep,
        "creep_from": rest * dt,
        "penetration": max(float(record.penetration[0, -1]) for record in records) / SIDE,
        "force_error": max(abs(f / w - 1.0) for f, w in zip(force, weight)),
        "speed": max(float(np.abs(sim.velocities(body)[0]).max()) for body in bodies),
        "steps": steps,
        "newton": sum(newton),
        "newton_most": max(newton),
        "pcg": int(sim.totals["pcg"][0]),
        "seconds": seconds,
    }
