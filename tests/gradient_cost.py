"""Cost of a gradient: `python tests/gradient_cost.py DEVICE FILE [SCENE ...]`; rows of other scenes stay in the file.

Scenes run forward and back in turns, with their own tolerance; least times of a step, on the CPU those of the process.
"""

import functools
import json
import pathlib
import sys
import time

import numpy as np
import warp as wp

import warpfea as wf
from scenes.gripper import gripper
from scenes.pendulum import pendulum
from warpfea.base.provenance import provenance_of
from warpfea.studies.identify import finger

STEPS, ROUNDS = {"cpu": 100, "cuda": 60}, {"cpu": 5, "cuda": 3}
SCENES = {
    "pendulum": (pendulum, ["beam.E", "beam.density", "gravity"], "tip", 2e6),
    "finger": (finger, ["finger.E", "finger.eta", "gravity"], "tip", 1e6),
    "gripper": (gripper, ["block.E", "gravity"], "middle", 1e5),
}


def timed(call, device):
    clock = time.process_time if device == "cpu" else time.perf_counter
    began = clock()
    call()
    wp.synchronize_device(device)
    return clock() - began


def row(name, device, worlds):
    scene, names, probe, modulus = SCENES[name]
    kind = device.partition(":")[0]
    steps = STEPS[kind]
    began = time.perf_counter()
    m = scene().finalize(device=device, worlds=worlds)
    m.set_parameter(names[0], modulus * np.linspace(1.0, 1.1, worlds))
    how = {"dt": scene.dt, "solver": wf.NewtonPCG(tol=scene.tol), "ledger": False, "record": False}
    sim = wf.Simulation(m, **how)
    try:
        tape = wf.Adjoint(sim, names)
    except wf.ModelError as error:
        return {"label": name, "refused": str(error)}
    tape.run(steps)
    p = tape.probe(probe)
    loss = wf.loss.sum_of_squares(p, np.zeros((steps, 3)))
    tape.backward(loss)
    compile_s = time.perf_counter() - began
    forward, back, kept = [], [], []
    for _ in range(ROUNDS[kind]):
        sim.reset()
        newton = sim.totals["newton"].sum()
        forward.append(timed(lambda: sim.step(steps), device))
        newton = sim.totals["newton"].sum() - newton
        sim.reset()
        tape.clear()
        kept.append(timed(lambda: tape.run(steps), device))
        loss = wf.loss.sum_of_squares(tape.probe(probe), np.zeros((steps, 3)))
        back.append(timed(functools.partial(tape.backward, loss), device))
    ms = {key: 1e3 * min(values) / steps for key, values in (("forward", forward), ("kept", kept), ("backward", back))}
    return {
        "label": name, "worlds": worlds, "unknowns": int(3 * len(m.free_slots)), "steps": steps, "dt": scene.dt,
        "tol": scene.tol, "parameters": names, "setup_s": compile_s, "newton": float(newton / steps / worlds),
        "forward_ms": ms["forward"], "recorded_ms": ms["kept"], "backward_ms": ms["backward"],
        "ratio": ms["backward"] / ms["forward"], "recomputed": 0,
        "matrix": tape.stepper.newton.residual.uses_matrix,
    }  # fmt: skip


def main(device, file, *chosen):
    path, count = pathlib.Path(file), 4096 if "cuda" in device else 1
    content = json.loads(path.read_text()) if path.exists() and chosen else {}
    rows = {row["label"]: row for row in content.get("rows", ())}
    for name in chosen or SCENES:
        began = time.perf_counter()
        rows[name] = row(name, device, count) | {"rounds": ROUNDS[device.partition(":")[0]]}
        content = provenance_of([], device) | {"command": f"python tests/gradient_cost.py {device} FILE"}
        content["rows"] = list(rows.values())
        path.write_text(json.dumps(content, indent=2) + "\n")
        print(f"{name}: {rows[name].get('ratio')}, {time.perf_counter() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
