"""Price of a rigid part: `python tests/part_price.py cpu FILE` steps scene `hook` alone, with a free part and with one
that hangs from the ground on a hinge, in turns; least time of a step over that of the scene alone."""

import json
import pathlib
import sys
import time

import numpy as np

import warpfea as wf
from scenes.hook import hook
from warpfea.base.provenance import provenance_of

ROUNDS, STEPS = 7, 3


def simulation(kind, device):
    b = hook()
    if kind != "alone":
        at = np.array([0.5, 0.5, 0.5])
        part = b.add_rigid(wf.Box(tuple(at), (0.01, 0.02, 0.03)), density=1000.0, name="part")
        if kind == "hinged":
            b.add_joint("revolute", parent=wf.GROUND, child=part.at(tuple(at + (0, 0, 0.015))), axis=(1, 0, 0))
    sim = wf.Simulation(b.finalize(device=device), dt=hook.dt)
    sim.step(2)  # compiles
    return sim


def main(device, file):
    sims = {kind: simulation(kind, device) for kind in ("alone", "free", "hinged")}
    seconds = {kind: [] for kind in sims}
    for _ in range(ROUNDS):
        for kind, sim in sims.items():
            began = time.perf_counter()
            sim.step(STEPS).newton  # noqa: B018 reads the report, so that the device is done
            seconds[kind].append((time.perf_counter() - began) / STEPS)
    least = {kind: min(values) for kind, values in seconds.items()}
    spent = {kind: {name: int(sim.totals[name][0]) for name in ("newton", "pcg")} for kind, sim in sims.items()}
    rows = [
        {"label": kind, "unknowns": int(3 * len(sim.model.free_slots)), "ms": 1e3 * least[kind],
         "ratio": least[kind] / least["alone"], **spent[kind]}
        for kind, sim in sims.items()
    ]  # fmt: skip
    content = provenance_of([], device) | {"command": f"python tests/part_price.py {device} FILE", "rows": rows}
    content["settings"] = {"rounds": ROUNDS, "steps": STEPS, "dt": hook.dt}
    pathlib.Path(file).write_text(json.dumps(content, indent=2) + "\n")
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
