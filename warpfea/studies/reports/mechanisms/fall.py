"""Two bodies tied by a joint fall as one, whatever the solver does about the joint."""

from __future__ import annotations

from typing import Any

import numpy as np

import warpfea as wf

from ..parts import Rows
from .pair import BOX, GRAVITY, Pair, attempt, best_fall, fall

__all__ = ["OUTER", "SOLVERS", "TIES", "fall_of_a_pair", "free_fall"]

TIES = ("spherical", "revolute", "fixed", "distance")
OUTER = {"multipliers": "outer"}
SOLVERS = [{}, {"penalty": 1.0}, {"penalty": 1e4}, {"max_newton": 1, "max_pcg": 1},
           OUTER | {"penalty": 1.0}, OUTER, OUTER | {"penalty": 1e4}, OUTER | {"max_outer": 1}]  # fmt: skip


def fall_of_a_pair(device, E, tie, second, integrator, options, steps=30, dt=1e-2):
    """The row of a pair that is let go at rest; None as its error where the substeps can't be told."""
    pair = Pair(device, tie, E=E, second=second)
    sim = wf.Simulation(pair.model, dt=dt, integrator=integrator, solver=wf.NewtonPCG(**options))
    row = {"case": "fall", "joint": tie, "second": second, "integrator": integrator, "E": E, "dt": dt,
           "solver": options, "error": None}  # fmt: skip
    halvings = attempt(row, sim, steps)
    if halvings is None:
        return row
    if integrator == "backward_euler" and not any(halvings):  # the same, summed
        u, _ = fall(integrator, [dt] * steps, np.zeros(3))
        assert np.allclose(u, GRAVITY * dt**2 * steps * (steps + 1) / 2, rtol=1e-13, atol=0.0)
    row["error"] = best_fall(integrator, halvings, dt, np.zeros(3), lambda u: pair.points_error(sim, u))
    return row


def _spinning(device, E, tie, second, integrator, options, steps=20, dt=1e-2):
    """About its centre of mass: its fall, and with backward Euler the moment balance of each step,

    L_n+1 - L_n = h sum M v_n+1 x v_n, which holds if the forces between the bodies are without a moment at q_n+1."""
    pair = Pair(device, tie, E=E, second=second, velocity=(1.0, 0.0, 2.0), spin=np.array([1.0, 2.0, 8.0]))
    sim = wf.Simulation(pair.model, dt=dt, integrator=integrator, solver=wf.NewtonPCG(**options))
    row = {"case": "spin", "joint": tie, "second": second, "integrator": integrator, "E": E, "dt": dt,
           "solver": options, "error": None, "moment_balance": None, "kept": None}  # fmt: skip
    M = pair.consistent
    _, v0, _, v, start = pair.motion(sim.state)
    halvings, L, balance = [], start, 0.0
    for _ in range(steps):
        part: dict[str, Any] = {}
        done = attempt(part, sim, 1)
        if done is None:
            return row | part
        row |= part
        halvings += done
        moved, pace, _, v_new, L_new = pair.motion(sim.state)
        if done[0] == 0:
            away = L_new - L - dt * np.cross(v_new, M @ v).sum(axis=0)
            balance = max(balance, float(np.linalg.norm(away) / np.linalg.norm(start)))
        v, L = v_new, L_new
    row["error"] = best_fall(integrator, halvings, dt, v0, lambda u: float(np.abs(moved - u).max() / np.abs(u).max()))
    row |= {"steps": steps, "halvings": sum(halvings), "newton": int(sim.totals["newton"][0]),
            "kept": float(np.linalg.norm(L) / np.linalg.norm(start))}  # fmt: skip
    if integrator == "backward_euler" and not any(halvings):
        row["moment_balance"] = balance
    return row


def _beside_an_impact(device, tie, integrator):
    """The pair beside a soft box that runs against its clamp, which halves the steps of all, and a lone box that falls
    with the pair: same displacement everywhere; with backward Euler the velocity is n h g whatever the substeps."""
    lone = []

    def extra(b):
        soft = wf.NeoHookean.from_E_nu(E=1e6, nu=0.3, density=1000.0)
        hit = b.add_solid(wf.mesh.box((1.0, 0.4, 0.4), cells=(4, 2, 2), origin=(0, 2, 0)), material=soft, name="hit")
        b.clamp(hit.nodes("x-"))
        b.set_initial(hit, velocity=(-20.0, 0.0, 0.0))
        steel = wf.SVK(E=2e9, nu=0.3, density=1000.0)
        lone.append(b.add_solid(wf.mesh.box(BOX, cells=(1, 1, 1), origin=(0, 4, 0)), material=steel, name="lone"))

    pair = Pair(device, tie, E=2e9, extra=extra)
    dt, steps = 1e-2, 5
    options: dict[str, Any] = {"max_newton": 3}  # so that the impact halves steps
    sim = wf.Simulation(pair.model, dt=dt, integrator=integrator, solver=wf.NewtonPCG(**options))
    row = {"case": "beside an impact", "joint": tie, "second": "T10", "integrator": integrator, "E": 2e9, "dt": dt,
           "solver": options, "error": None}  # fmt: skip
    if attempt(row, sim, steps) is None:
        return row
    row["error"] = pair.points_error(sim, sim.displacements(lone[0])[0].mean(axis=0))
    pace = pair.motion(sim.state)[1]
    row["velocity_error"] = None
    if integrator == "backward_euler":
        row["velocity_error"] = float(np.abs(pace / (GRAVITY * dt * steps) - 1.0).max())
    return row


def free_fall(device: Any, quick: bool) -> Rows:
    """Two bodies tied by a joint fall as one, against the scheme's recursion; backward Euler's q = g h^2 n (n + 1) / 2.

    fall: all nodes of a pair let go at rest, over the fall. spin: the centre of mass of a pair thrown spinning at 8.3
    rad/s, 20 steps of 1/8 turn per 10 ms at most; where max_newton is named it halves steps; `moment_balance` is what
    the joint's forces do to the angular momentum in a step, over it; `kept` is L_end / L_start. beside an impact: steps
    halved by another body. welded: `kept` of the pair against one body of both, `from_one_body` their difference over
    what is lost."""
    rows = []
    schemes = ("backward_euler", "bdf2")
    soft, stiff = 1e5, 2e9
    pick = [TIES[:1], TIES[1:3]] if quick else [TIES, TIES]
    for tie in TIES:
        for integrator in schemes[: 1 if quick else 2]:
            rows += [fall_of_a_pair(device, soft, tie, "T10", integrator, o) for o in SOLVERS]
            rows += [
                fall_of_a_pair(device, stiff, tie, s, integrator, o) for s in ("T10", "3243") for o in (SOLVERS[:3])
            ]
            if not quick:
                rows += [fall_of_a_pair(device, stiff, tie, "T10", integrator, o) for o in SOLVERS[4:]]
    for tie in pick[1]:
        for integrator, limit in zip(schemes, (4, 3)):
            halved = {"max_newton": limit}
            some = [{}, halved] if quick else [{}, {"tol": 1e-3}, {"penalty": 1e4}, OUTER | {"penalty": 1.0}, halved]
            rows += [_spinning(device, stiff, tie, "T10", integrator, o, steps=4 if quick else 20) for o in some]
            if not quick:
                rows.append(_spinning(device, stiff, tie, "3243", integrator, {}))
    for tie in ("revolute",) if quick else TIES:
        rows += [_beside_an_impact(device, tie, integrator) for integrator in schemes]
    for E in () if quick else (2e7, 2e8, 2e9, 2e10):
        one = _spinning(device, E, None, "T10", "backward_euler", {})
        for joint in (None, "weld", "fixed", "revolute", "spherical"):
            row = _spinning(device, E, joint, "T10", "backward_euler", {}) if joint else dict(one)
            row["joint"] = joint or "one body"
            row["from_one_body"] = abs(row["kept"] - one["kept"]) / (1.0 - one["kept"])
            rows.append(row | {"case": "welded"})
    return rows
