"""What the parts share: axes, timing, what a run took."""

from __future__ import annotations

import time as clock

import numpy as np

__all__ = ["EVERY", "STEEL", "X", "Y", "Z", "place", "timed", "work"]

X, Y, Z = np.eye(3)
STEEL = 7870.0
"""Density, kg/m^3."""
PLANE = [0, 2]


def EVERY(X: np.ndarray) -> np.ndarray:
    """All nodes, as a selection."""
    return X[:, 0] > -np.inf


def work(sim, seconds):
    """What a run took."""
    n = sim.steps
    return {"steps": n, "ms_per_step": 1e3 * seconds / n, "newton_per_step": float(sim.totals["newton"][0]) / n,
            "pcg_per_step": float(sim.totals["pcg"][0]) / n,
            "violation_over_size": sim.max_violation / sim.model.size}  # fmt: skip


def timed(sim, steps):
    """Do the steps; seconds."""
    began = clock.perf_counter()
    sim.step(steps)
    return clock.perf_counter() - began


def place(sim, name):
    """A probe in the plane of the mechanism, (steps, 2)."""
    return sim.probe(name).position[0][:, PLANE]
