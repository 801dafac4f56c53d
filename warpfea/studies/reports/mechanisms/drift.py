"""Violation of joints over a hundred thousand steps."""

from __future__ import annotations

import time as clock

import numpy as np

import warpfea as wf

from .cases import X, Y, Z

__all__ = ["crossing", "no_drift", "swing"]

DRIFT_STEPS = 100_000


def swing(device):
    """A soft beam on a ball joint with another on its end by a hinge, thrown from the horizontal, 48 unknowns."""
    b = wf.ModelBuilder()
    law = wf.SVK(E=1e7, nu=0.3, density=1200.0)
    first, second = (
        b.add_beam(
            [0.5 * k * X, 0.5 * (k + 1) * X], elements=1, section=wf.Rectangle(0.02, 0.02), normal=Z, material=law
        )
        for k in range(2)
    )
    joints = [b.add_joint("spherical", parent=wf.GROUND, child=first.start),
              b.add_joint("revolute", parent=first.end, child=second.start, axis=Y)]  # fmt: skip
    for beam in (first, second):
        b.set_initial(beam, velocity=lambda P: np.cross((0.0, 0.0, 2.0), P))
    for name, end in (("pivot", first.start), ("above", first.end), ("below", second.start), ("tip", second.end)):
        b.add_probe(name, end)
    return wf.Simulation(b.finalize(device=device), dt=1e-3, integrator="bdf2"), joints


def crossing(sim):
    """Cosine between the hinge's axis on one beam of `swing` and the directions across it on the other, at its ends."""
    above, below = (sim.node_gradients(beam)[0, k] for beam, k in zip(sim.model.bodies, (-1, 0)))
    return max(abs(above @ Y @ (below @ d)) / np.linalg.norm(above @ Y) / np.linalg.norm(below @ d) for d in (X, Z))


def no_drift(device, quick, checkpoint=None, steps=None):
    """Violation over 1e5 steps of 1 ms of bdf2: a soft double pendulum of two 3243 elements swings in space.

    `violation_*` are what the joints record at every step, over the model's size; `gap_*` is the same of the pinned
    ends from their positions alone, `crossing` of the hinge from deformation gradients, every 100 steps since resumed.
    First and last: of the first and the last tenth."""
    sim, joints = swing(device)
    target = steps or (DRIFT_STEPS // 100 if quick else DRIFT_STEPS)
    if checkpoint is not None and checkpoint.exists():
        sim.resume(checkpoint)
        print(f"    goes on from step {sim.steps} of {checkpoint}", flush=True)
    begun_at, halvings, crossed, began = sim.steps, 0, 0.0, clock.perf_counter()

    def watch(sim):
        nonlocal halvings, crossed
        halvings += int(sim.last.halvings[0])
        if sim.steps % 100 == 0:
            crossed = max(crossed, crossing(sim))
        if sim.steps % 10000 == 0:
            print(f"    step {sim.steps}: {clock.perf_counter() - began:.0f} s", flush=True)

    outputs = [wf.Checkpoint(checkpoint, every=5000)] if checkpoint is not None else []
    sim.run(target * sim.dt, outputs=outputs, on_step=watch, progress=False)
    seconds = clock.perf_counter() - began
    assert sim.steps == target
    size, tenth = sim.model.size, target // 10
    records = [sim.joint_record(joint) for joint in joints]
    violation = np.max([r.violation[0] for r in records], axis=0) / size
    at = {name: sim.probe(name).position[0] for name in ("pivot", "above", "below", "tip")}
    gap = np.maximum(np.linalg.norm(at["pivot"], axis=1), np.linalg.norm(at["above"] - at["below"], axis=1)) / size
    energy = sim.energies()
    row = {"element": "3243", "unknowns": int(sim.model.free_slots.sum()), "E": 1e7, "dt": sim.dt, "steps": target,
           "recorded": len(violation), "resumed_at": begun_at, "violation_max": float(violation.max()),
           "violation_first": float(violation[:tenth].max()), "violation_last": float(violation[-tenth:].max()),
           "max_by_tenths": [float(part.max()) for part in np.array_split(violation, 10)],
           "mean_by_tenths": [float(part.mean()) for part in np.array_split(violation, 10)],
           "gap_max": float(gap.max()), "gap_first": float(gap[:tenth].max()), "gap_last": float(gap[-tenth:].max()),
           "crossing": float(crossed), "halvings_since_resumed": halvings,
           "force_max": float(max(np.linalg.norm(r.force[0], axis=1).max() for r in records)),
           "swing_last": float(np.ptp(at["tip"][-tenth:], axis=0).max()),
           "ledger_residual": float(energy["ledger_residual"][0]), "potential": float(energy["potential"][0]),
           "ms_per_step": 1e3 * seconds / max(target - begun_at, 1),
           "newton_per_step": float(sim.totals["newton"][0]) / target,
           "pcg_per_step": float(sim.totals["pcg"][0]) / target}  # fmt: skip
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    return [row]
