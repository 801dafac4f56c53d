"""Price of `clipping=True` in scenes that do not need it: `python tests/contact_clipping_price.py --out FILE`.

A block of T10, 0.2 x 0.2 x 0.1 m, E = 1e7 Pa, rests on a wider block of other cells, or on a wide box that does not
move, h = 1 ms: points of contact, seconds to build the model, median seconds of a step, iterations; seconds of one
thread of the processor.
"""

import argparse
import json
import pathlib
import statistics
import sys
import time

import warpfea as wf
from warpfea.base.provenance import provenance_of

STEPS, WARM_UP = 20, 5
LAW = wf.SVK(E=1e7, nu=0.3, density=1000.0)


def priced(other, cells, clipping):
    """Row of a scene."""
    b = wf.ModelBuilder()
    n, m = cells, cells + 1
    block = b.add_solid(wf.mesh.box((0.2, 0.2, 0.1), cells=(n, n, n // 2), element="T10"), material=LAW, name="block")
    if other == "block":
        mesh = wf.mesh.box((0.3, 0.3, 0.1), cells=(m, m, 2), element="T10", origin=(-0.05, -0.05, -0.1))
        base = b.add_solid(mesh, material=LAW, name="base")
        b.clamp(base.nodes("z-"))
    else:
        base = b.add_collider(wf.Box((0.1, 0.1, -0.05), (0.3, 0.3, 0.1)), name="base")
    b.add_contact(block, base, mu=0.3, clipping=clipping)
    began = time.process_time()
    model = b.finalize(device="cpu")
    seconds = time.process_time() - began
    sim = wf.Simulation(model, dt=1e-3)
    sim.step(WARM_UP)
    first, took = {name: int(sim.totals[name][0]) for name in ("newton", "pcg")}, []
    for _ in range(STEPS):
        began = time.process_time()
        sim.step()
        took.append(time.process_time() - began)
    each = {f"{name}_per_step": (int(sim.totals[name][0]) - first[name]) / STEPS for name in first}
    return {"other": other, "cells": cells, "clipping": clipping, "unknowns": model.info()["unknowns"],
            "points": sum(c["points"] for c in model.info()["contacts"]), "build_s": seconds,
            "ms_per_step": 1e3 * statistics.median(took), **each}  # fmt: skip


def main():
    """Make the file."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=pathlib.Path, required=True)
    out = parser.parse_args().out
    content = provenance_of([], "cpu") | {"command": " ".join(["python", *sys.argv])}
    content["settings"] = {"dt": 1e-3, "steps": STEPS, "warm_up": WARM_UP}
    content["rows"] = [priced(other, n, way) for other in ("block", "box") for n in (4, 8) for way in (False, True)]
    out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
