"""Contact by multipliers beside the penalty: `python tests/contact_multipliers.py --out FILE`.

inf_sup: constants (Chapelle and Bathe 1993) of multipliers on a face of a cube that is clamped below, or on its sides
too: elastic energy of E = 1, norm h^(1/2) L2 of the multipliers. Hats of facet corners, a constant for each facet, and
one multiplier at each of 16 points of a facet.
statics: p = max(0, lambda - rho g), rho of the penalty; after a solve lambda = max(0, lambda - rho g) with the gap g at
points or weighted by hats. A sphere pressed into a block (Hertz), a block pressed on a floor.
drop: a block falls on a floor; lambda is updated once a step.

On the solver lambda is a stored overlap of -lambda/rho at each point that does not decay: it moves the gap at which the
penalty begins. With hats the penalty still acts on what is left of the gaps of points.
"""

import argparse
import json
import pathlib
import sys

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg
from validation.contact import A, grading

import warpfea as wf
from warpfea.base.provenance import provenance_of
from warpfea.contact.evaluation import evaluate_points
from warpfea.model.contact_points import CONTACT_RULES
from warpfea.model.pairs import PAIR_RULES, pair_points
from warpfea.simulation.statics import begin_static, run_static

SETTINGS = {"E": 1e6, "nu": 0.3, "side": 0.1, "pressure": 1e4, "drop": 0.02, "tol": 1e-8, "loose": 1e-3, "rigid": 1e3}
"""Pa, m; tolerances of the last solve and of those before it (`loose`); stiffness that counts as rigid contact."""
LAW = wf.SVK(E=SETTINGS["E"], nu=SETTINGS["nu"], density=1000.0)
STAYS = {"overlap": "offset", "overlap_time": 1e12}


def functions(kind, p, rules):
    """Functions (points, multipliers) of the corners of flat facets, of facets, or of points, at the points."""
    facets, count = p.area.shape
    if kind != "hats":
        return sp.kron(sp.eye(facets), np.ones((count, 1)) if kind == "facets" else np.eye(count)).tocsr()
    corners = 4 if p.conn.shape[1] == 12 else 3
    a, b = rules[corners][count].points.T
    bilinear = ((1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b)
    shape = np.column_stack((1 - a - b, a, b) if corners == 3 else bilinear)
    X = np.einsum("cp,fpk->fck", np.linalg.pinv(shape), p.X).reshape(-1, 3)
    number = np.unique(np.round(X, 9), axis=0, return_inverse=True)[1].reshape(facets, 1, corners)
    row = np.repeat(np.arange(facets * count), corners)
    return sp.csr_matrix((np.tile(shape, (facets, 1)).ravel(), (row, np.repeat(number, count, axis=1).ravel())))


def inf_sup(element, cells, sides):
    """Rows of one mesh: the least eigenvalue of B K^-1 B^T over h M is the square of the constant."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.box((1, 1, 1), cells=(cells,) * 3, element=element)
    body = b.add_solid(mesh, material=wf.SVK(E=1.0, nu=SETTINGS["nu"], density=1.0))
    for name in ("z-", "x-", "x+", "y-", "y+")[: 5 if sides else 1]:
        b.clamp(body.nodes(name))
    model, p = b.finalize(device="cpu"), pair_points(body.surface("z+"))
    area, count = p.area.ravel(), p.area.shape[1]
    place = np.repeat(np.arange(area.size), p.conn.shape[1]), np.repeat(p.conn, count, axis=0).ravel()
    shape = sp.csr_matrix((p.shape.ravel(), place), shape=(area.size, model.slots))
    free = np.flatnonzero(model.free_slots)
    used = np.flatnonzero((abs(shape).max(axis=0).toarray()[0] > 1e-12) & model.free_slots[:, 2])
    unit = (free[:, None] == 3 * used + 2).astype(float)
    K = model.tangent_matrix(model.state()).tocsc()[free][:, free]
    compliance = unit.T @ scipy.sparse.linalg.splu(K).solve(unit)
    for kind in ("hats", "facets", "points"):
        H = functions(kind, p, PAIR_RULES)
        B, norm = (H.T @ sp.diags(area) @ shape[:, used]).toarray(), (H.T @ sp.diags(area / cells) @ H).toarray()
        least = scipy.linalg.eigh(B @ compliance @ B.T, norm, eigvals_only=True)[0]
        yield {"element": element, "cells": cells, "sides": sides, "multipliers": kind, "count": len(B),
               "rank": int(np.linalg.matrix_rank(B)), "inf_sup": float(np.sqrt(max(least, 0.0)))}  # fmt: skip


def model_of(problem, element, stiffness):
    """A quarter of a block into which a sphere of 1 m is pressed by A^2/R; a block pressed on a floor, or falling."""
    b, side = wf.ModelBuilder(gravity=(0, 0, -9.81 if problem == "drop" else 0)), SETTINGS["side"]
    if problem == "hertz":
        mesh = wf.mesh.box((8,) * 3, cells=(8,) * 3, origin=(0, 0, -8), map=grading(4, 4, 60.0), element=element)
        body = b.add_solid(mesh, material=LAW)
        for name, components in (("z-", "xyz"), ("x+", "xyz"), ("y+", "xyz"), ("x-", "x"), ("y-", "y")):
            b.clamp(body.nodes(name), components=components)
        path = [0.0, 1.0], [(0, 0, 0), (0, 0, -(A**2))]
        other, surface = b.add_collider(wf.Sphere((0, 0, 1), 1.0), path=path), body.surface("z+")
    else:
        where = (0, 0, SETTINGS["drop"] if problem == "drop" else 0)
        cells = (2 if problem == "drop" else 4,) * 3
        body = b.add_solid(wf.mesh.box((side,) * 3, cells=cells, element=element, origin=where), material=LAW)
        if problem == "floor":
            b.clamp(body.nodes("z+"), components="xy")
            b.add_traction(body.surface("z+"), (0, 0, -SETTINGS["pressure"]))
        other, surface = b.add_collider(wf.HalfSpace((0, 0, 1))), body.surface("z-")
    b.add_contact(surface, other, stiffness=stiffness, **STAYS)
    return b.finalize(device="cpu"), body


class Multipliers:
    """Multipliers of a contact over rho, m: `none`, of `points` or of `hats`."""

    def __init__(self, model, kind):
        (self.term,) = model.terms.contacts
        (self.p,), self.kind = self.term.tables.host, kind
        self.area, self.functions = self.p.area.ravel(), functions(kind, self.p, CONTACT_RULES)
        self.value = np.zeros(self.functions.shape[1])

    def gap(self, state):
        """Gaps, m, and normal forces, N, of the points."""
        gap, force, _ = evaluate_points(self.term, state)
        return gap[0] - getattr(state, f"{self.term.name}_overlap").numpy()[0], force[0]

    def update(self, state):
        """Uzawa's update; the next solve begins with it."""
        if self.kind != "none":
            mean = self.functions.T @ (self.area * self.gap(state)[0]) / (self.functions.T @ self.area)
            self.value = np.maximum(self.value - mean, 0.0)
            getattr(state, f"{self.term.name}_overlap").assign(-(self.functions @ self.value)[None])


def statics(problem, element, kind, stiffness=1.0, solves=1, loose=SETTINGS["loose"], during=False):
    """Row of a solution by four load steps to the tolerance `loose` and `solves` at full load, each after an update,
    the last one to the full tolerance; `during`: with updates between the load steps too."""
    model, _ = model_of(problem, element, stiffness)
    m, options = Multipliers(model, kind), {"stabilise": problem == "floor"}
    sim = begin_static(model, load_steps=4, tol=loose, **options)
    for _ in range(3 * during):
        sim.step()
        m.update(sim.state)
    found = [run_static(sim, unstable="ignore")]
    for k in range(solves):
        m.update(found[-1].state)
        options["tol"] = loose if k + 1 < solves else SETTINGS["tol"]
        found.append(wf.solve_static(model, state=found[-1].state, load_steps=1, unstable="ignore", **options))
    gap, force = m.gap(found[-1].state)
    pressure, hats = force / np.maximum(m.area, 1e-300), functions("hats", m.p, CONTACT_RULES)
    row = {"problem": problem, "element": element, "multipliers": kind, "stiffness": stiffness, "solves": solves,
           "loose": loose, "during": during, "newton": int(sum(r.newton[0] for r in found)),
           "pcg": int(sum(r.pcg[0] for r in found)), "force": float(force.sum()), "deepest": float(-gap.min()),
           "weighted": float(-(hats.T @ (m.area * gap) / (hats.T @ m.area)).min()),
           "peak": float(pressure.max())}  # fmt: skip
    if problem == "hertz":
        radius = (3.0 * row["force"] * (1.0 - SETTINGS["nu"] ** 2) / SETTINGS["E"]) ** (1.0 / 3.0)
        hertz = 6.0 * row["force"] / (np.pi * radius**2)
        wanted = hertz * np.sqrt(np.maximum(1.0 - (m.p.X[..., :2] ** 2).sum(axis=2).ravel() / radius**2, 0.0))
        row["peak_over_hertz"] = row["peak"] / hertz
        row["pressure_error"] = float(np.sqrt(m.area @ (pressure - wanted) ** 2 / (m.area @ wanted**2)))
    return row


def drop(integrator, dt, kind, stiffness=1.0):
    """Row of a block that falls on a floor, 0.6 s: depths, its rebound, m, and cost."""
    model, body = model_of("drop", "T10", stiffness)
    sim, m, depth, height = wf.Simulation(model, dt=dt, integrator=integrator), Multipliers(model, kind), [], []
    for _ in range(round(0.6 / dt)):
        sim.step()
        depth.append(float(-m.gap(sim.state)[0].min()))
        height.append(float(sim.positions(body)[0, :, 2].mean()))
        m.update(sim.state)
    lowest = int(np.argmin(height[: round(0.12 / dt)]))
    return {"integrator": integrator, "dt": dt, "multipliers": kind, "stiffness": stiffness, "deepest": max(depth),
            "deepest_at_rest": depth[-1], "rebound": max(height[lowest:]) - height[-1],
            "newton": int(sim.totals["newton"][0]), "pcg": int(sim.totals["pcg"][0])}  # fmt: skip


WAYS = [("none", {"stiffness": s}) for s in (1.0, 3.0, 10.0, 100.0, SETTINGS["rigid"])]
WAYS += [(kind, {"solves": n}) for kind in ("hats", "points") for n in (1, 2, 4)]
WAYS += [("hats", {"during": True}), ("points", {"during": True}), ("points", {"stiffness": 0.3})]
WAYS += [("none", {"solves": 0, "loose": SETTINGS["tol"]}), ("hats", {"loose": SETTINGS["tol"]})]


def main():
    """Make the file."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=pathlib.Path, required=True)
    out = parser.parse_args().out
    content = provenance_of([], "cpu") | {"command": " ".join(["python", *sys.argv]), "settings": SETTINGS}
    meshes = [(name, n, sides) for name in ("T4", "T10", "H3843") for sides in (False, True) for n in (2, 4, 8)]
    content["inf_sup"] = [row for mesh in meshes for row in inf_sup(*mesh)]
    problems = [("floor", "T10"), ("hertz", "T10"), ("hertz", "T4")]
    content["statics"] = [statics(*problem, kind, **how) for problem in problems for kind, how in WAYS]
    runs = [(name, dt) for name in ("backward_euler", "bdf2") for dt in (2e-3, 1e-2)]
    kinds = [("none", 1.0), ("none", 10.0), ("points", 1.0), ("hats", 1.0)]
    content["drop"] = [drop(*run, *kind) for run in runs for kind in kinds]
    out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
