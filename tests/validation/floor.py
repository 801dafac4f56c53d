"""Error estimate `StepReport.floor` in float32, compared with the true error.

Random strips of 1 m, 2 to 10 times as long as wide and 2 to 80 times as wide as thick, loaded at one end mostly in
their plane, with soft bending across it: T4, T10, H3843, 3243 and 3443 elements, E = 1e6 to 2e11 Pa, two static
load steps or ten steps of BDF2 of a twentieth of the first period. Cases are drawn from one seed until `CASES` of them
have a reference in float64 (tol 1e-10) whose tangent is positive definite at each step, by a Cholesky factorisation;
past a bifurcation a motion follows any disturbance, so the others are separate rows (`stable` false).
Errors are the largest of any node over the largest displacement; for a motion compared with the sum of its
estimates.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import warpfea as wf

from .table import Row, Run, Table

__all__ = ["CASES", "SEED", "TABLE", "draw", "tried"]

SEED, CASES, QUICK = 6, 117, 6
ELEMENTS = ("T4", "T10", "T10", "H3843", "3243", "3443")
CLAMPED = {"T4": "all", "T10": "all", "H3843": "position+gradient-y+gradient-z", "3243": "position+section",
           "3443": "position+director"}  # fmt: skip
DENSITY = 1000.0
REFERENCE = 1e-10
"""Tolerance of the references."""
STEPS, PERIODS = 10, 20
"""Steps of a motion, and steps per period."""


def draw(rng: np.random.Generator) -> dict[str, Any]:
    """A random case: lengths in m, E in Pa; `tilt` and `axial`: transverse and axial load over the in-plane load
    that bends it by `sag`.
    """
    width = 10 ** -rng.uniform(0.3, 1.0)
    element = str(rng.choice(ELEMENTS))
    return {
        "element": element, "motion": bool(rng.random() < 0.35), "width": width,
        "thickness": width / 10 ** rng.uniform(0.3, 1.9), "cells": int(rng.integers(6, 25)),
        "across": int(rng.integers(1, 4)) if element in ("H3843", "3443") else 1,
        "tilt": float(rng.choice([0.0, 0.0, 1e-3, 1e-2, 0.1, 0.5])), "axial": float(rng.choice([0.0, 0.0, 0.5])),
        "sag": 10 ** rng.uniform(-3.0, -1.0), "E": 10 ** rng.uniform(6.0, 11.3),
    }  # fmt: skip


def strip(case: dict[str, Any]) -> wf.ModelBuilder:
    """The strip of a case, clamped at x = 0 and loaded at x = 1 m; without gravity."""
    element, E, w, t = case["element"], case["E"], case["width"], case["thickness"]
    law = wf.SVK(E=E, nu=0.0 if element == "3443" else 0.3, density=DENSITY)
    across = 0.25 * E * t * w**3 * case["sag"]  # N, by Euler and Bernoulli
    force = np.array([case["axial"] * across, across, case["tilt"] * 0.25 * E * w * t**3 * case["sag"]])
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    if element == "3243":
        line = [(0, 0, 0), (1, 0, 0)]
        body = b.add_beam(line, elements=case["cells"], section=wf.Rectangle(w, t), normal=(0, 0, 1), material=law)
        b.clamp(body.start, slots=CLAMPED[element])
        b.add_point_load(body.end, tuple(force))
        return b
    if element == "3443":
        mesh = wf.mesh.grid((1.0, w), cells=(case["cells"], case["across"]))
        body = b.add_shell(mesh, thickness=t, material=law)
        b.clamp(body.edge("x-"), slots=CLAMPED[element])
    else:
        mesh = wf.mesh.box((1.0, w, t), cells=(case["cells"], case["across"], 1), element=element)
        body = b.add_solid(mesh, material=law, element=element)
        b.clamp(body.nodes("x-"), slots=CLAMPED[element])
    b.add_traction(body.surface("x+"), tuple(force / (w * t)))
    return b


def positive(sim: wf.Simulation) -> bool:
    """True if the tangent is positive definite on the free components."""
    free = sim.model.free_slots.ravel()
    K = sim.model.tangent_matrix(sim.state)[free][:, free].toarray()
    d = 1.0 / np.sqrt(np.abs(K.diagonal()))
    try:
        np.linalg.cholesky(d[:, None] * K * d)
    except np.linalg.LinAlgError:
        return False
    return True


def solved(
    case: dict[str, Any], device: Any, dtype: str, tol: float | None = None
) -> tuple[np.ndarray, dict[str, Any]]:
    """Final displacements of the nodes (nodes, 3), m, and the report; of a reference also its stability."""
    model = strip(case).finalize(device=device, dtype=dtype)
    stable, floors = True, []
    if case["motion"]:
        dt = 2.0 * np.pi / (1.875**2 * case["width"] * np.sqrt(case["E"] / (12.0 * DENSITY))) / PERIODS
        solver = wf.NewtonPCG(tol=tol, max_pcg=20000, max_halvings=0)
        sim = wf.Simulation(model, dt=dt, integrator="bdf2", solver=solver, ledger=False)
        for _ in range(STEPS):
            floors.append(float(sim.step().floor[0]))
            stable = stable and (tol is None or positive(sim))
    else:
        sim = wf.solve_static(model, load_steps=2, tol=tol).simulation
        floors.append(float(sim.last.floor[0]))
        stable = tol is None or positive(sim)
    u = sim.state.displacement.numpy()[0].astype(float)[model.slot_table.kind == 0]
    totals = {name: int(sim.totals[name][0]) for name in ("newton", "pcg")}
    return u, {"stable": stable, "floor": sum(floors), **totals}


def tried(case: dict[str, Any], device: Any) -> dict[str, Any]:
    """A row: float32 report of a case, and its error."""
    row: dict[str, Any] = {**case, "stable": None, "outcome": "no reference", "floor": None, "error": None}
    try:
        exact, report = solved(case, device, "float64", REFERENCE)
    except wf.ConvergenceError:
        return row
    row["stable"] = report["stable"]
    try:
        u, report = solved(case, device, "float32")
    except wf.ConvergenceError as error:
        known = "float32 round-off limit reached" in str(error)
        return row | {"outcome": "refused" if known else str(error)[:200]}
    off = float(np.abs(u - exact).max() / np.abs(exact).max())
    return row | report | {"stable": row["stable"], "outcome": "accepted", "error": off}


def rows(run: Run) -> Iterator[Row]:
    """Rows until `CASES` cases have a stable reference."""
    rng = np.random.default_rng(SEED)
    found = 0
    while found < (QUICK if run.quick else CASES):
        row = tried(draw(rng), run.device)
        found += row["stable"] is True
        yield row


TABLE = Table(
    about=__doc__,
    parts={"rows": rows},
    results={"floor_cpu.json": "floor --out tests/results/floor_cpu.json"},
    settings={"seed": SEED, "cases": CASES, "dtype": "float32", "reference": f"float64, tol {REFERENCE:g}"},
)
