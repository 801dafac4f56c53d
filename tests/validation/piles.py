"""Time of a step of piles of ten cubes of T4 that fall on each other with friction, mu = 0.5, h = 10 ms.

Cubes of 0.2 m, neo-Hookean, E = 1 MPa, nu = 0.4, 1000 kg/m^3, 10 mm apart, each 3 and 2 mm beside the one below, to a
residual of 1e-6; "-default": with default contact. ms: mean of the steps after the first; deepest: m, after a step.
"""

from __future__ import annotations

import itertools
import time as clock
from collections.abc import Iterator
from typing import Any

import warp as wp

import warpfea as wf

from .table import Row, Run, Table

__all__ = ["TABLE", "pile"]

CUBES, SIDE, GAP, DT, TOL = 10, 0.2, 0.01, 1e-2, 1e-6
STEPS = {4: 100, 10: 60, 20: 40}
"""Steps by cells along a side."""
STIFFNESS = {4: 11.0, 10: 11.0, 20: 15.0}
"""Factor on the stiffness of the region by cells along a side, with which no point is deeper than 2 mm."""


def pile(cells: int, default: bool = False, *, cubes: int = CUBES, stiffness: float | None = None) -> wf.ModelBuilder:
    """Cubes of cells^3 over each other, with gaps between; `default`: contact options, else a factor `stiffness`."""
    held: dict[str, Any] = {"restitution": 1.0, "stiffness": ("region", stiffness or STIFFNESS.get(cells, 1.0))}
    b = wf.ModelBuilder()
    law = wf.NeoHookean.from_E_nu(E=1e6, nu=0.4, density=1000.0)
    below = None
    for k in range(cubes):
        low = (0.003 * k, 0.002 * k, GAP + (SIDE + GAP) * k)
        mesh = wf.mesh.box((SIDE,) * 3, cells=(cells,) * 3, element="T4", origin=low)
        cube = b.add_solid(mesh, material=law, name=f"cube {k}")
        other = b.add_collider(wf.HalfSpace((0, 0, 1), 0.0)) if below is None else below.surface("z+")
        b.add_contact(cube.surface("z-"), other, mu=0.5, **({} if default else held))
        below = cube
    return b


def piles(run: Run) -> Iterator[Row]:
    """A row per number of cells along a side, with the held and with default options."""
    for (cells, steps), default in itertools.product(STEPS.items(), (False, True)):
        if not run.wants(label := f"pile-{cells}" + default * "-default"):
            continue
        model = pile(cells, default).finalize(device=run.device)
        sim = wf.Simulation(model, dt=DT, solver=wf.NewtonPCG(tol=TOL), ledger=False)
        sim.step()
        before = {name: int(sim.totals[name][0]) for name in ("newton", "pcg")}
        wp.synchronize_device(model.device)
        began = clock.perf_counter()
        sim.step(3 if run.quick else steps - 1)
        wp.synchronize_device(model.device)
        count = 3 if run.quick else steps - 1
        ms = 1e3 * (clock.perf_counter() - began) / count
        per_step = {name: (int(sim.totals[name][0]) - many) / count for name, many in before.items()}
        names = [contact.name for contact in model.description.contacts]
        deepest = max(float(sim.contact_record(name).penetration.max()) for name in names)
        yield {"label": label, "steps": count, "ms": ms, **per_step, "deepest": deepest}


TABLE = Table(__doc__, {"piles": piles}, settings={"steps": STEPS, "stiffness": STIFFNESS, "tol": TOL, "dt": DT},
              device="cuda:0", takes="minutes on a GPU")  # fmt: skip
