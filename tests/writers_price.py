"""Price of writers: `python tests/writers_price.py DEVICE FILE` steps the bar of `warpfea bench --peer` with
54 x 36 x 18 cells (883k unknowns) 600 times without a writer, and with a page or a USD file of its von Mises stress in
60 frames, in turns; least time over that without one. About two minutes on an H200, of which one is compilation.

Each run begins at rest in the same simulation. Its time holds all that a user waits for: opening the writer, weights of
the field, frames, the file and its checks. Kernels are compiled before by a small bar. Without usd-core the row "USD"
is left out, and the file says so. `--cells 9 6 3 --steps 60` is for trying it.
"""

import argparse
import gc
import importlib.util
import json
import pathlib
import sys
import tempfile
import time

import warpfea as wf
from warpfea.base.provenance import provenance_of
from warpfea.studies.bench.measure import solver
from warpfea.studies.bench.peer import DT, FORCE_TOL, PEER_CASES, SOLVER_OPTIONS
from warpfea.studies.bench.problems import PROBLEMS

CASE = next(case for case in PEER_CASES if case.label == "bar-54x36x18")
STEPS, FRAMES, ROUNDS = 600, 60, 3
WRITERS = {"HTML": (wf.HTMLWriter, "bar.html"), "USD": (wf.USDWriter, "bar.usdc")}


def writer(kind, folder, span, frames):
    make, name = WRITERS[kind]
    return make(folder / name, fps=(frames - 1) / span, fields=["von_mises"])


def simulation(cells, device):
    model = PROBLEMS[CASE.problem].build(cells).finalize(device=device)
    return wf.Simulation(model, dt=DT, solver=solver(None, force_tol=FORCE_TOL, **SOLVER_OPTIONS), ledger=False)


def main(words):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("device")
    parser.add_argument("file")
    parser.add_argument("--cells", type=int, nargs=3, default=CASE.size)
    parser.add_argument("--steps", type=int, default=STEPS)
    given = parser.parse_args(words)
    content = provenance_of([], given.device) | {"command": "python tests/writers_price.py " + " ".join(words)}
    kinds = [kind for kind in WRITERS if kind != "USD" or importlib.util.find_spec("pxr")]
    content["left_out"] = [f"{kind}: no usd-core here" for kind in WRITERS if kind not in kinds]
    with tempfile.TemporaryDirectory() as name:
        folder, span = pathlib.Path(name), given.steps * DT
        small = simulation((3, 2, 1), given.device)
        for kind in kinds:
            small.reset()
            small.run(2 * DT, outputs=[writer(kind, folder, 2 * DT, 3)], progress=False)
        began = time.perf_counter()
        sim = simulation(tuple(given.cells), given.device)
        sim.step(2).newton  # noqa: B018 reads the report, so that the device is done
        content["setup_s"] = time.perf_counter() - began
        seconds, rows = {"none": [], **{kind: [] for kind in kinds}}, {}
        for _ in range(ROUNDS):
            for kind, spent in seconds.items():
                sim.reset()
                sim.model.evaluation.samples.operators.clear()  # each run makes the weights of its field
                outputs = [writer(kind, folder, span, FRAMES)] if kind in WRITERS else []
                before = int(sim.statistics.steps), int(sim.totals["pcg"][0])
                gc.collect()
                began = time.perf_counter()
                sim.run(span, outputs=outputs, progress=False)
                spent.append(time.perf_counter() - began)
                rows[kind] = {"MB": (folder / WRITERS[kind][1]).stat().st_size / 1e6} if outputs else {}
                rows[kind]["steps"] = int(sim.statistics.steps) - before[0]
                rows[kind]["pcg"] = int(sim.totals["pcg"][0]) - before[1]
                rows[kind]["tip"] = float(sim.probe("tip").displacement[-1, 0, 0])
                print(kind, f"{spent[-1]:.3f} s", flush=True)
    least = {kind: min(spent) for kind, spent in seconds.items()}
    content["rows"] = [
        {"label": kind, "seconds": least[kind], "of_rounds": seconds[kind], "ratio": least[kind] / least["none"],
         "tip_difference": abs(rows[kind]["tip"] / rows["none"]["tip"] - 1.0), **rows[kind]}
        for kind in seconds
    ]  # fmt: skip
    content["settings"] = {
        "cells": list(given.cells), "unknowns": int(3 * sim.model.slots), "steps": given.steps, "frames": FRAMES,
        "dt": DT, "force_tol": FORCE_TOL, **SOLVER_OPTIONS, "fields": ["von_mises"], "rounds": ROUNDS,
    }  # fmt: skip
    pathlib.Path(given.file).write_text(json.dumps(content, indent=2) + "\n")
    for row in content["rows"]:
        print(f"{row['label']:>5} {row['seconds']:8.3f} s {row['ratio']:6.3f}", flush=True)
    print(*content["left_out"], sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:])
