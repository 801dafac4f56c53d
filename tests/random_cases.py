"""Seeded random models outside the stress suite: statics and motions of strips, joints and contacts.

`python tests/random_cases.py --seeds 0:200 --out FILE` runs some, and writes a row each: outcome, Newton and
PCG iterations, and the answer, the largest displacement and the mean position of the loaded end. Lengths, slenderness,
stiffness, loads, elements, laws, integrators, joints, contacts and precisions are drawn from the seed.
"""

from __future__ import annotations

import argparse
import json
import pathlib
from typing import Any

import numpy as np

import warpfea as wf
from warpfea.base.console import quiet_warp, to_json, write_json

__all__ = ["draw", "main", "tried"]

ELEMENTS = ("T4", "T10", "T10", "H3843", "3243", "3243", "3443")
LAWS = ("SVK", "NeoHookean", "MooneyRivlin")
INTEGRATORS = ("backward_euler", "bdf2", "energy_momentum", "generalized_alpha")
STEPS = 8
SAME = {"float64": 1e-5, "float32": 2e-2}
"""Answers within this fraction of the travel count as the same."""


def draw(seed: int) -> dict[str, Any]:
    """A random case: lengths in m, E in Pa, `load` over the one that bends the strip by its length, `rate` in steps
    per period."""
    rng = np.random.default_rng(20_000 + seed)
    element = str(rng.choice(ELEMENTS))
    slender = 10 ** rng.uniform(0.3, 2.0 if element in ("3243", "3443") else 1.3)
    return {
        "element": element, "law": str(rng.choice(LAWS)), "E": float(10 ** rng.uniform(5.0, 11.3)),
        "nu": float(rng.uniform(0.0, 0.4)), "length": float(10 ** rng.uniform(-2.0, 1.0)), "slender": float(slender),
        "cells": int(rng.integers(2, 9)), "load": float(10 ** rng.uniform(-2.0, 0.7)),
        "direction": [float(x) for x in rng.normal(size=3)], "motion": bool(rng.random() < 0.6),
        "integrator": str(rng.choice(INTEGRATORS)), "rate": float(10 ** rng.uniform(0.3, 2.0)),
        "joint": str(rng.choice(["none", "none", "spherical", "revolute", "fixed"])),
        "contact": str(rng.choice(["none", "none", "floor", "pair"])), "mu": float(rng.uniform(0.0, 0.8)),
        "speed": float(10 ** rng.uniform(-1.0, 1.0)), "dtype": str(rng.choice(["float64", "float64", "float32"])),
    }  # fmt: skip


def _strip(b: wf.ModelBuilder, case: dict[str, Any], law: Any, start: tuple[float, float, float], name: str) -> Any:
    """A strip along x from `start`, and its two ends."""
    L = case["length"]
    t = L / case["slender"]
    cells = case["cells"]
    if case["element"] == "3243":
        line = [start, (start[0] + L, start[1], start[2])]
        body = b.add_beam(line, elements=cells, section=wf.Rectangle(t, t), normal=(0, 0, 1), material=law, name=name)
        return body, body.start, body.end
    if case["element"] == "3443":
        mesh = wf.mesh.grid((L, 0.3 * L), cells=(cells, 2), origin=start)
        body = b.add_shell(mesh, thickness=t, material=law, name=name)
        return body, body.edge("x-"), body.edge("x+")
    mesh = wf.mesh.box((L, t, t), cells=(cells, 1, 1), element=case["element"], origin=start)
    body = b.add_solid(mesh, material=law, element=case["element"], name=name)
    return body, body.surface("x-"), body.surface("x+")


def build(case: dict[str, Any]) -> wf.ModelBuilder:
    """The model of a case: a clamped strip, on it or below it a jointed strip or a block that falls."""
    L, E, density = case["length"], case["E"], 1000.0
    t = L / case["slender"]
    width = 0.3 * L if case["element"] == "3443" else t
    b = wf.ModelBuilder(gravity=(0, 0, -9.81 if case["contact"] != "none" else 0.0))
    law = getattr(wf, case["law"]).from_E_nu(E=E, nu=case["nu"], density=density)
    body, first, last = _strip(b, case, law, (0.0, 0.0, 0.0), "strip")
    where = body.nodes("x-") if hasattr(first, "area") or case["element"] not in ("3243", "3443") else first
    b.clamp(where)
    load = np.array(case["direction"]) * 3.0 * E * width * t**3 / 12.0 / L**2 * case["load"]
    if case["joint"] == "none":
        loaded = last
    else:
        second, head, loaded = _strip(b, case, law, (L, 0.0, 0.0), "second")
        more = {"axis": (0, 1, 0)} if case["joint"] == "revolute" else {}
        kind = case["joint"] if case["motion"] else "fixed"
        b.add_joint(kind, parent=last, child=head, name="joint", **(more if kind == case["joint"] else {}))
    if case["element"] == "3243":
        b.add_point_load(loaded, tuple(load))
    elif case["element"] == "3443":
        b.add_traction(loaded, tuple(load / (width * t))) if hasattr(loaded, "area") else b.add_point_load(
            body.at((0.5 * L, 0.15 * L, 0.0)), tuple(load)
        )
    else:
        b.add_traction(loaded, tuple(load / (t * t)))
    if case["contact"] != "none" and case["motion"]:
        size = 0.2 * L
        mesh = wf.mesh.box((size,) * 3, cells=(2, 2, 1), origin=(0.4 * L, 0.0, 0.5 * t + 1e-3 * L + size), element="T4")
        block = b.add_solid(mesh, material=wf.NeoHookean.from_E_nu(E=E, nu=0.3, density=density), name="block")
        b.set_initial(block, velocity=(0.3 * case["speed"] * L, 0.0, -case["speed"] * L))
        if case["contact"] == "pair":
            b.add_contact(block, body, mu=case["mu"])
        else:
            floor = b.add_collider(wf.HalfSpace(normal=(0, 0, 1), offset=0.5 * t + size))
            b.add_contact(block, floor, mu=case["mu"])
    return b


def _answer(model: wf.Model, u: np.ndarray) -> list[float]:
    """Mean and largest displacement of the nodes of each body, m."""
    out: list[float] = []
    for body in model.bodies:
        rows = u[body.slots][body.slot_kind == 0]
        out += [*(float(x) for x in rows.mean(axis=0)), float(np.abs(rows).max())]
    return out


def tried(seed: int, device: str) -> dict[str, Any]:
    """Row of a case."""
    case = draw(seed)
    row: dict[str, Any] = {"case": f"random/{seed}", "precision": case["dtype"], "passed": False, "note": ""}
    try:
        model = build(case).finalize(device=device, dtype=case["dtype"])
        if case["motion"]:
            wave = 1.875**2 / (case["slender"] * case["length"]) * np.sqrt(case["E"] / 12.0e3)
            dt = float(np.clip(2.0 * np.pi / wave / case["rate"], 1e-6, 0.02))
            sim = wf.Simulation(model, dt=dt, integrator=case["integrator"], energy_growth="ignore")
            sim.step(STEPS)
        else:
            sim = wf.solve_static(model, load_steps=4, unstable="ignore").simulation
        row |= {name: int(sim.totals[name][0]) for name in ("newton", "pcg")}
        row |= {
            "outcome": "done",
            "passed": True,
            "error": _answer(model, sim.state.displacement.numpy()[0].astype(float)),
        }
    except wf.Error as error:
        row |= {"outcome": "refused", "note": f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"}
    return row


def same(one: Any, other: Any, dtype: str) -> bool:
    """True if two answers agree within `SAME` of their largest number."""
    a, b = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
    return a.shape == b.shape and bool(np.abs(a - b).max() <= SAME[dtype] * max(np.abs(a).max(), 1e-300))


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0:200", help="first:last, the last not included")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=pathlib.Path)
    options = parser.parse_args()
    first, last = (int(word) for word in options.seeds.split(":"))
    rows = []
    with quiet_warp():
        for seed in range(first, last):
            rows.append(tried(seed, options.device))
            if options.out:
                write_json(str(options.out), to_json({"rows": rows}))
            else:
                print(json.dumps(to_json(rows[-1])), flush=True)


if __name__ == "__main__":
    main()
