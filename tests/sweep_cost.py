"""Cost of sweeps: tests/results/sweep_cpu.json and sweep_h200.json.

`python tests/sweep_cost.py --device cpu --out tests/results/sweep_cpu.json`: two processes; 100 designs of about 1 s
each, and 100 000 designs of three steps of free fall, with the memory of the driver. Minutes on two idle cores.

`python tests/sweep_cost.py --device cuda:0 --out tests/results/sweep_h200.json`: 65 536 pendulums of random E and two
lengths beside the same number in one plain batch.

From the root of a checkout. Seconds are those of the clock: no other work on the machine.
"""

from __future__ import annotations

import argparse
import csv
import pathlib
import resource
import sys
import time as clock
from typing import Any

import numpy as np

import warpfea as wf
from warpfea.base.console import quiet_warp, to_json, write_json
from warpfea.base.provenance import provenance_of
from warpfea.builder.scene import find
from warpfea.sweeps import PoolEngine

MODELS = pathlib.Path(__file__).resolve().parent / "sweep_models.py"


def efficiency(designs: int = 100, steps: int = 1400) -> dict[str, Any]:
    """Two processes, each design a model of its own: share of the ideal, and overhead per design, s."""
    rows = [{"E": float(E)} for E in 10.0 ** np.random.default_rng(1).uniform(7, 8, designs)]
    how: dict[str, Any] = {"measures": {"tip": "probe.tip.displacement.z"}, "parameters": {"cells": 20}}
    engine = PoolEngine(2)
    try:
        wf.sweep(f"{MODELS}:bar", rows[:2], run={"device": "cpu", "t_end": 0.01}, engine=engine, **how)  # kernels
        run = {"device": "cpu", "t_end": steps * 5e-3}
        result = wf.sweep(f"{MODELS}:bar", rows, run=run, engine=engine, **how)
        seconds = _task_seconds(result)
    finally:
        engine.close()
    wall, ideal = result.seconds["run"], float(seconds.sum()) / 2
    return {
        "part": "efficiency", "designs": designs, "workers": 2, "failed": len(result.failures), "wall_s": wall,
        "design_s": float(seconds.mean()), "efficiency": ideal / wall, "overhead_s": (wall - ideal) / designs,
    }  # fmt: skip


def _task_seconds(result: Any) -> np.ndarray:
    """Seconds of each task."""
    with open(result.folder / "times.csv", newline="") as file:
        rows = [(line["worker"], float(line["task_seconds"])) for line in csv.DictReader(file)]
    return np.array([seconds for _, seconds in dict.fromkeys(rows)])


def many(designs: int = 100_000) -> dict[str, Any]:
    """Three steps of free fall of each design in worlds: memory that the driver takes beyond a sweep of a tenth of the
    designs, bytes, and the largest error."""

    def peak() -> int:
        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    gravity = np.random.default_rng(2).uniform(-9.0, -1.0, designs)
    how: dict[str, Any] = {"measures": {"z": "probe.p.displacement.z"}, "run": {"device": "cpu"}, "engine": 2}
    wf.sweep(f"{MODELS}:fall", wf.Design({"gravity.z": gravity[: designs // 10]}), **how)
    before = peak()
    result = wf.sweep(f"{MODELS}:fall", wf.Design({"gravity.z": gravity}), **how)
    error = np.abs(result["z"] / (6e-4 * gravity) - 1.0).max()
    return {
        "part": "many", "designs": designs, "failed": len(result.failures), "wall_s": result.seconds["run"],
        "bytes_per_design": (peak() - before) / (0.9 * designs), "driver_bytes": peak(), "error": float(error),
        "record_bytes": (result.folder / "record.jsonl").stat().st_size,
    }  # fmt: skip


def rate(device: str, worlds: int = 65536, steps: int = 300, repeats: int = 3) -> dict[str, Any]:
    """World-steps per second of a sweep and of one plain batch, each from its models to its table or values: medians
    of several, in turn."""
    rng = np.random.default_rng(3)
    E, lengths = 10.0 ** rng.uniform(6, 7, worlds), np.repeat([1.0, 1.1], worlds // 2)
    scene, measures = find("pendulum"), {"tip": "probe.tip.displacement.z"}
    dt, t_end = scene.dt, steps * scene.dt

    def plain(count: int, end: float) -> tuple[float, np.ndarray]:
        began = clock.perf_counter()
        model = scene().finalize(device=device, worlds=count, many=True)
        model.set_parameter("beam.E", E[:count])
        how: dict[str, Any] = {"integrator": scene.integrator, "solver": wf.NewtonPCG(tol=scene.tol)}
        sim = wf.Simulation(model, dt=dt, record=False, on_failure="freeze", **how)
        sim.run(t_end=end, progress=False)
        tip = sim.probe("tip").displacement[:, -1, 2]
        return clock.perf_counter() - began, tip

    plain(64, 3 * dt)  # kernels
    plain_s, sweep_s, task_s = list[float](), list[float](), list[float]()
    engine = PoolEngine(1, gpus=[0]) if device.startswith("cuda") else PoolEngine(1)
    run = {"device": device}
    try:
        few = wf.Design({"length": lengths[:64], "beam.E": E[:64]})
        wf.sweep("pendulum", few, measures=measures, run=run | {"t_end": 3 * dt}, engine=engine)
        design = wf.Design({"length": lengths, "beam.E": E})
        for _ in range(repeats):
            seconds, tip = plain(worlds, t_end)
            plain_s.append(seconds)
            result = wf.sweep("pendulum", design, measures=measures, run=run | {"t_end": t_end}, engine=engine)
            sweep_s.append(result.seconds["run"])
            task_s.append(float(_task_seconds(result).sum()))
    finally:
        engine.close()
    of_plain, of_sweep = float(np.median(plain_s)), float(np.median(sweep_s))
    return {
        "part": "rate", "worlds": worlds, "steps": steps, "groups": 2, "failed": len(result.failures),
        "plain_s": plain_s, "sweep_s": sweep_s, "task_s": task_s, "plain_rate": worlds * steps / of_plain,
        "sweep_rate": worlds * steps / of_sweep, "ratio": of_plain / of_sweep,
        "same_bits": bool((result["tip"][: worlds // 2] == tip[: worlds // 2]).all()),
    }  # fmt: skip


def main() -> None:
    """Measure, print and write."""
    to = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    to.add_argument("--device", default="cpu")
    to.add_argument("--out", type=pathlib.Path)
    to.add_argument("--worlds", type=int, default=65536, help="of the rate")
    to.add_argument("--steps", type=int, default=300, help="of the rate")
    given = to.parse_args()
    with quiet_warp():
        content = {"schema": 1, **provenance_of(sys.argv[1:], given.device)}
        content["command"] = " ".join(["python", "tests/sweep_cost.py", *sys.argv[1:]])
        rows = [efficiency(), many()] if given.device == "cpu" else [rate(given.device, given.worlds, given.steps)]
    for row in rows:
        print(row, flush=True)
    if given.out is not None:
        write_json(str(given.out), to_json(content | {"rows": rows}))


if __name__ == "__main__":
    main()
