"""Impacts of two bodies by default: elastic bars beside Saint-Venant's waves, rigid parts beside `restitution`.

Run as `python tests/contact_restitution_pairs.py --out FILE`.
"""

import argparse
import json
import pathlib
import sys
from typing import Any

import numpy as np

import warpfea as wf
from warpfea.base.provenance import provenance_of

E, RHO, LENGTH, SIDE = 1e6, 1000.0, 0.4, 0.02
SPEED = 0.1
"""Of the second body before the impact, m/s; the first is at rest."""
WAVE = (E / RHO) ** 0.5


def rebound(b: wf.ModelBuilder, pad: Any, h: float, steps: int, integrator: str) -> dict[str, float]:
    """Speed after an impact along x over that before, change of momentum over that, and duration of the contact, s."""
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=h, integrator=integrator, solver=wf.NewtonPCG(tol=1e-9))
    mass, weights = model.mass_matrix(), []
    for body in model.description.bodies:
        one = np.zeros((model.slots, 3))
        one[body.slots[body.slot_kind == 0], 0] = 1.0
        weights.append((mass @ one.ravel(), one.ravel()))

    def speeds() -> np.ndarray:
        v = sim.state.velocity.numpy()[0].ravel()
        return np.array([w @ v / (w @ one) for w, one in weights])

    before = speeds()
    sim.step(steps)
    after, masses = speeds(), np.array([w @ one for w, one in weights])
    record = sim.contact_record(pad)
    force = record.normal_force[0]
    return {
        "measured": float((after[1] - after[0]) / (before[0] - before[1])),
        "momentum_error": float(abs(masses @ (after - before)) / abs(masses @ before)),
        "duration": float((force > 1e-6 * force.max()).sum() * h),
        "penetration": float(record.penetration.max()),
    }


def bars(ratio: int, restitution: float, h: float = 2.5e-4, cells: int = 16) -> dict[str, Any]:
    """A bar of 0.4 m hits one of `ratio` times its length: waves leave 1/ratio of the speed, after 2 L/c."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    material = wf.SVK(E=E, nu=0.0, density=RHO)
    ends = ((0.0, ratio, 0.0), (LENGTH * ratio + 1e-4, 1, -SPEED))
    two = []
    for k, (x, times, v) in enumerate(ends):
        size, n = (LENGTH * times, SIDE, SIDE), (cells * times, 1, 1)
        mesh = wf.mesh.box(size, cells=n, origin=(x, 0, 0), element="T10")
        two.append(b.add_solid(mesh, material=material, name=f"bar {k}"))
        b.set_initial(two[k], velocity=(v, 0, 0))
    pad = b.add_contact(two[1].surface("x-"), two[0].surface("x+"), restitution=restitution)
    found = rebound(b, pad, h, int(5.0 * LENGTH * ratio / WAVE / h), "energy_momentum")
    known = {"expected": 1.0 / ratio, "expected_duration": 2.0 * LENGTH / WAVE}
    return {"ratio": ratio, "restitution": restitution, "dt": h, "cells": cells} | known | found


def parts(restitution: float, h: float) -> dict[str, Any]:
    """Two rigid cubes, the second of twice the mass, which their contact alone yields."""
    b, side = wf.ModelBuilder(gravity=(0, 0, 0)), 0.1
    two = []
    for k, (x, v) in enumerate(((0.0, 0.0), (side + 1e-5, -SPEED))):
        shape = wf.Box((x + 0.5 * side, 0.0, 0.0), (side,) * 3)
        material = wf.SVK(E=E, nu=0.3, density=RHO)
        two.append(b.add_rigid(shape, density=RHO * (1 + k), material=material, name=f"part {k}"))
        b.set_initial(two[k], velocity=(v, 0, 0))
    pad = b.add_contact(two[1], two[0], restitution=restitution)
    return {"restitution": restitution, "dt": h} | rebound(b, pad, h, round(1e-2 / h), "backward_euler")


def main():
    """Make the file."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=pathlib.Path, required=True)
    out = parser.parse_args().out
    content = provenance_of([], "cpu") | {"command": " ".join(["python", *sys.argv])}
    content["bars"] = [bars(ratio, e) for ratio in (1, 2) for e in (0.0, 1.0)]
    content["rigid parts"] = [parts(e, h) for e in (0.3, 0.5, 0.8) for h in (1e-4, 2.5e-5)]
    out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
