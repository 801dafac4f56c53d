"""Cost and stability of constraints.

cost        a chain of m links and m revolute joints that hangs and swings to the side, m = 10, 100, 1000: ms per step
            and iterations (outer: multiplier updates), for the default (multipliers with every Newton step,
            constraint directions deflated), for either alone, and for the classical augmented Lagrangian on block
            Jacobi ("before").
stability   mass ratios to 1e4, E from 1e4 to 1e12 Pa, steps from 1e-5 to 1e-2 s; a door on four hinges; a parallelogram
            linkage driven through its dead points. A case passes if every step is accepted and the violation stays
            within 1e-8 of the model's size, or when a named error of warpfea ends it.
"""

from __future__ import annotations

import statistics
import time as clock
from collections.abc import Iterator
from typing import Any

import numpy as np
import warp as wp

import warpfea as wf

from .table import Row, Run, Table

__all__ = ["TABLE"]

METHODS: dict[str, dict[str, Any]] = {
    "default": {},
    "block Jacobi": {"preconditioner": "block-jacobi"},
    "outer, deflated": {"multipliers": "outer"},
    "before: outer, block Jacobi": {"multipliers": "outer", "preconditioner": "block-jacobi"},
}
RATIOS = (1.0, 1e2, 1e4)
MODULI = (1e4, 1e6, 1e8, 1e10, 1e12)
STEPS = (1e-5, 1e-4, 1e-3, 1e-2)


def chain(links: int, *, E: float = 7e8, ratio: float = 1.0, length: float = 0.5, side: float = 0.05) -> Any:
    """Links of one 3243 element on revolute joints, the last `ratio` times as dense; they hang and swing sideways."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    end: Any = wf.GROUND
    rate = 5.0 / (links * length)  # rad/s: the end moves at 5 m/s
    for k in range(links):
        law = wf.SVK(E=E, nu=0.33, density=2700.0 * (ratio if k == links - 1 else 1.0))
        link = b.add_beam(
            [(0, 0, -k * length), (0, 0, -(k + 1) * length)],
            elements=1,
            section=wf.Rectangle(side, side),
            normal=(1, 0, 0),
            material=law,
        )
        b.add_joint("revolute", parent=end, child=link.start, anchor=(0, 0, -k * length), axis=(0, 1, 0))
        b.set_initial(link, velocity=lambda X: np.cross((0, rate, 0), X))
        end = link.end
    b.add_probe("tip", end)
    return b


def door(E: float) -> wf.ModelBuilder:
    """A door of T10 on four hinges with the ground, swinging; 15 of their 20 rows are redundant for a rigid door."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.box((0.8, 0.04, 2.0), cells=(2, 1, 4))
    body = b.add_solid(mesh, material=wf.SVK(E=E, nu=0.3, density=600.0), name="door")
    for z in (0.25, 0.75, 1.25, 1.75):
        near = body.nodes(lambda X, z=z: (X[:, 0] < 0.41) & (np.abs(X[:, 2] - z) < 0.26))
        b.add_joint("revolute", parent=wf.GROUND, child=near, anchor=(0, 0.02, z), axis=(0, 0, 1))
    b.set_initial(body, velocity=lambda X: np.cross((0, 0, 1.0), X - np.array([0, 0.02, 0])))
    return b


def parallelogram(E: float, turns: float = 0.625, seconds: float = 0.05) -> wf.ModelBuilder:
    """A four-bar with equal cranks, driven through the pose with all bars in line, where the Jacobian loses rank."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=E, nu=0.3, density=2700.0)

    def bar(start: Any, end: Any) -> Any:
        return b.add_beam([start, end], elements=1, section=wf.Rectangle(0.02, 0.02), normal=(0, 1, 0), material=law)

    crank, coupler = bar((0, 0, 0), (0, 0, 0.2)), bar((0, 0, 0.2), (0.5, 0, 0.2))
    rocker = bar((0.5, 0, 0), (0.5, 0, 0.2))
    y = (0, 1, 0)
    times = np.linspace(0.0, seconds, 401)
    s = times / seconds
    angle = 2.0 * np.pi * turns * (10 * s**3 - 15 * s**4 + 6 * s**5)
    b.add_joint("revolute", parent=wf.GROUND, child=crank.start, axis=y, drive=(times, angle), name="motor")
    b.add_joint("revolute", parent=crank.end, child=coupler.start, axis=y)
    b.add_joint("revolute", parent=coupler.end, child=rocker.end, axis=y)
    b.add_joint("revolute", parent=wf.GROUND, child=rocker.start, axis=y)
    b.add_probe("tip", rocker.end)
    return b


def simulate(
    builder: wf.ModelBuilder,
    *,
    dt: float,
    steps: int,
    device: Any,
    dtype: str = "float64",
    integrator: str = "bdf2",
    worlds: int = 1,
    **solver: Any,
) -> dict[str, Any]:
    """Do steps and return their cost; a named error is an outcome."""
    model = builder.finalize(device=device, dtype=dtype, worlds=worlds)
    equations = sum(joint["rows"] for joint in model.info()["joints"])
    row: dict[str, Any] = {"unknowns": int(model.free_slots.sum()), "rows": equations, "dt": dt}
    outcome, halvings, outer, done = "converged", 0, 0, 0
    times = []
    try:
        sim = wf.Simulation(model, dt=dt, integrator=integrator, solver=wf.NewtonPCG(max_pcg=20000, **solver))
        for _ in range(steps):
            began = clock.perf_counter()
            report = sim.step()
            times.append(clock.perf_counter() - began)
            halvings += int(report.halvings[0])
            outer += int(report.outer[0])
            done += 1
    except wf.Error as error:
        outcome = f"{type(error).__name__}: {str(error)[:160]}"
    n = max(done, 1)
    energies = sim.energies()
    scale = max(float(np.abs(energies[k][0])) for k in ("kinetic", "strain", "potential", "work"))
    row |= {
        "steps": done, "outcome": outcome,
        "ms_per_step": 1e3 * statistics.median(times[min(5, len(times) - 1) :]) if times else None,
        "outer": outer / n, "newton": float(sim.totals["newton"][0]) / n, "pcg": float(sim.totals["pcg"][0]) / n,
        "halvings": halvings, "violation": float(sim.max_violation) / model.size,
        "residual": float(sim.max_residual),
        "ledger_residual": float(energies["ledger_residual"][0]) / max(scale, 1e-300),
    }  # fmt: skip
    if model.description.probes and done:
        row["tip"] = sim.probe("tip").position[0, -1].tolist()
    return row


def cost(run: Run) -> Iterator[Row]:
    """Chains of m links on m joints; the tips of the methods are compared with the default's."""
    device, joints, steps = run.device, run.options["joints"], run.options["steps"]
    for m, E in [(m, 7e8) for m in joints] + [(min(joints), 7e10), (min(joints), 7e12)]:
        tip = None
        for name, solver in METHODS.items():
            for dtype in ("float64", "float32") if name == "default" and E == 7e8 else ("float64",):
                row: dict[str, Any] = {"joints": m, "E": E, "method": name, "dtype": dtype}
                row |= simulate(chain(m, E=E), dt=1e-3, steps=steps, device=device, dtype=dtype, **solver)
                if "tip" in row:
                    tip = tip or row["tip"]
                    row["tip_difference"] = float(np.abs(np.subtract(row.pop("tip"), tip)).max())
                yield row
    if wp.get_device(device).is_cuda:
        for worlds in (100, 1000):
            row = {"joints": min(joints), "E": 7e8, "method": "default", "dtype": "float64", "worlds": worlds}
            row |= simulate(chain(min(joints)), dt=1e-3, steps=steps, device=device, worlds=worlds)
            row.pop("tip", None)
            yield row


def stability(run: Run) -> Iterator[Row]:
    """Hard cases."""
    device, steps = run.device, run.options["steps"]

    def case(problem: str, builder: wf.ModelBuilder, dt: float, count: int, **labels: Any) -> dict[str, Any]:
        row = {"problem": problem, **labels} | simulate(builder, dt=dt, steps=count, device=device)
        row.pop("tip", None)
        row.pop("ms_per_step")
        return row

    for ratio in RATIOS:
        for E in MODULI:
            for dt in STEPS:
                yield case("two links", chain(2, E=E, ratio=ratio), dt, steps, E=E, ratio=ratio)
    for dt in STEPS:
        yield case("ten links", chain(10, E=1e10, ratio=1e4), dt, steps, E=1e10, ratio=1e4)
    for E in (1e6, 1e9, 1e12):
        for dt in STEPS:
            yield case("door on four hinges", door(E), dt, steps, E=E, ratio=1.0)
    for E in (1e8, 1e10, 1e12):
        for count in (100, 1000):
            yield case("parallelogram through its dead points", parallelogram(E), 0.05 / count, count, E=E, ratio=1.0)


TABLE = Table(
    about=__doc__,
    parts={"cost": cost, "stability": stability},
    results={
        "joints_cpu.json": "joints --out tests/results/joints_cpu.json",
        "joints_h200.json": "joints --device cuda:0 --out tests/results/joints_h200.json",
    },
    settings={"integrator": "bdf2", "constraint_tol": 1e-8, "cost_dt": 1e-3},
    options={"steps": 40, "joints": (10, 100, 1000)},
)
