"""Energy gain of spinning bodies under generalized-alpha, for each rho_inf.

A T10 bar of 0.5 x 0.2 x 0.1 m spins by |w| rad/s, free about (1, 2, 10) or on a revolute joint at its end, in 300 steps
of h. `growth` is the largest kinetic and strain energy, from the mass matrix and the strain energy of the model, over
that of the start, and `end` that of the last step; a run ends if it exceeds `MOST`, or at a refused step.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

import warpfea as wf

from .table import Row, Run, Table

__all__ = ["BODIES", "MODULI", "RADII", "STEPS", "TABLE", "TURNS", "spin_energies", "spinning_body"]

SIZE = (0.5, 0.2, 0.1)
BODIES = {"free": (1.0, 2.0, 10.0), "rotor": (0.0, 0.0, 10.0)}
"""Angular velocity, rad/s."""
RADII = (0.0, 0.2, 0.3, 0.4, 0.5, 0.8, 0.9)
MODULI = (1e7, 1e9, 2e11)
TURNS = (0.1, 0.2, 0.3, 0.6, 1.0)
"""|w| h, rad."""
STEPS = 300
MOST = 1e3


def spinning_body(body: str, E: float, device: Any = "cpu") -> wf.Model:
    """The bar, free or on its joint, in rotation."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    bar = b.add_solid(wf.mesh.box(SIZE, cells=(4, 2, 1)), material=wf.SVK(E=E, nu=0.3, density=1000.0), name="bar")
    center = np.array(SIZE) / 2.0
    if body == "rotor":
        center[0] = 0.0
        b.add_joint("revolute", parent=wf.GROUND, child=bar.surface("x-"), anchor=tuple(center), axis=(0, 0, 1))
    b.set_initial(bar, velocity=lambda X: np.cross(BODIES[body], X - center))
    return b.finalize(device=device)


def spin_energies(model: wf.Model, integrator: Any, turn: float, spin: Any, steps: int = STEPS) -> list[float]:
    """Kinetic and strain energy over the initial one, after each step, until one exceeds `MOST`."""
    sim = wf.Simulation(model, dt=turn / float(np.linalg.norm(spin)), integrator=integrator, ledger=False, record=False)
    M, state = model.mass_matrix(), sim.state

    def energy() -> float:
        v = state.velocity.numpy()[0].astype(float).ravel()
        return 0.5 * float(v @ (M @ v)) + float(model.strain_energy(state)[0])

    start, out = energy(), []
    try:
        for _ in range(steps):
            sim.step()
            out.append(energy() / start)
            if not out[-1] <= MOST:
                break
    except wf.ConvergenceError:
        pass
    return out


def rows(run: Run) -> Iterator[Row]:
    """A row per body, rho_inf, modulus and step."""
    for body, E in itertools.product(BODIES, MODULI[:1] if run.quick else MODULI):
        model = spinning_body(body, E, run.device)
        for rho, turn in itertools.product(RADII, TURNS):
            integrator, steps = wf.GeneralizedAlpha(rho_inf=rho), 20 if run.quick else STEPS
            found = spin_energies(model, integrator, turn, BODIES[body], steps)
            growth, end = max(found, default=1.0), found[-1] if found else 1.0
            yield {"body": body, "rho_inf": rho, "E": E, "turn": turn, "steps": len(found), "growth": growth,
                   "end": end}  # fmt: skip


TABLE = Table(
    about=__doc__,
    parts={"rows": rows},
    results={"spinning_cpu.json": "spinning --out tests/results/spinning_cpu.json"},
    settings={"size": SIZE, "density": 1000.0, "nu": 0.3, "steps": STEPS, "spins": BODIES},
)
