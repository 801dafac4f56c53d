"""A deformable ball thrown at a plane: speed of its rebound, and how long it touches."""

from __future__ import annotations

import math
import time as clock
from typing import Any

import numpy as np

import warpfea as wf

__all__ = ["rebound_case"]

RADIUS, E, NU, DENSITY, SPEED = 0.05, 1e6, 0.3, 1000.0, 1.0


def hertz_time() -> float:
    """Duration of Hertz's impact of the ball on a rigid plane, s."""
    mass = DENSITY * 4.0 / 3.0 * math.pi * RADIUS**3
    modulus = E / (1.0 - NU**2)
    return 2.87 * (mass**2 / (RADIUS * modulus**2 * SPEED)) ** 0.2


def rebound_case(
    *, cells: int = 6, steps: int = 50, stiffness: float = 100.0, integrator: str = "bdf2", device: Any = "cpu"
) -> dict[str, Any]:
    """A ball of T10 that falls on a half-space without gravity, damping or friction; `steps` per Hertz's duration.

    The speed after it is that of the centre of mass, by the impulse of the contact's records. The duration is between
    the times at which the force first exceeds and last falls below 1 % of its largest, linearly between steps.
    """
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.sphere(RADIUS, cells=cells, center=(0, 0, RADIUS))
    ball = b.add_solid(mesh, material=wf.SVK(E=E, nu=NU, density=DENSITY), name="ball")
    b.set_initial(ball, velocity=(0, 0, -SPEED))
    floor = b.add_collider(wf.HalfSpace((0, 0, 1), 0.0), name="floor")
    pad = b.add_contact(ball, floor, restitution=1.0, stiffness=stiffness, radius=0.3 * RADIUS, name="pad")
    model = b.finalize(device=device)
    dt = hertz_time() / steps
    sim = wf.Simulation(model, dt=dt, integrator=integrator)
    newton: list[int] = []
    halvings = resting = 0
    began = clock.perf_counter()
    while resting < 5 and len(newton) < 3 * steps:
        report = sim.step()
        newton.append(int(report.newton[0]))
        halvings += int(report.halvings[0])
        touching = float(sim.contact_record(pad).normal_force[0, -1]) > 0.0
        resting = 0 if touching or len(newton) < steps // 4 else resting + 1
    seconds = clock.perf_counter() - began
    record = sim.contact_record(pad)
    force, time = np.concatenate([[0.0], record.force[0, :, 2]]), np.concatenate([[0.0], record.time])
    low = 0.01 * force.max()
    over = np.flatnonzero(force > low)
    first, last = over[0], over[-1]
    start = np.interp(low, force[first - 1 : first + 1], time[first - 1 : first + 1])
    end = time[last] + dt * (force[last] - low) / (force[last] - force[last + 1])
    assert model.mass is not None
    mass = float(model.mass)
    energies = sim.energies()
    return {
        "cells": cells,
        "unknowns": int(model.free_slots.sum()),
        "dt": dt,
        "integrator": integrator,
        "stiffness": stiffness,
        "restitution": float(force.sum() * dt / mass / SPEED - 1.0),
        "duration": float(end - start),
        "duration_over_hertz": float((end - start) / hertz_time()),
        "force_most": float(force.max()),
        "ledger_residual": float(energies["ledger_residual"][0] / (0.5 * mass * SPEED**2)),
        "kinetic": float(energies["kinetic"][0] / (0.5 * mass * SPEED**2)),
        "strain": float(energies["strain"][0] / (0.5 * mass * SPEED**2)),
        "integrator_loss": float(energies["integrator"][0] / (0.5 * mass * SPEED**2)),
        "steps": len(newton),
        "newton": sum(newton),
        "newton_most": max(newton),
        "halvings": halvings,
        "pcg": int(sim.totals["pcg"][0]),
        "seconds": seconds,
    }
