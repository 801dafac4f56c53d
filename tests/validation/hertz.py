"""What comparisons with Hertz share: graded meshes, the fit of a contact radius and a peak pressure."""

from __future__ import annotations

import math
import time as clock
from typing import Any

import numpy as np

import warpfea as wf
from warpfea.simulation.statics import begin_static, run_static

from .table import Row

__all__ = ["WIDTH", "A", "E", "fit_errors", "grading", "solved"]

E = 1e6
A = 0.01
"""Contact radius that is aimed at, m; the sphere's is 1 m."""
WIDTH = 1.3
"""Half of the evenly meshed zone, contact radii."""


def grading(inner: int, outer: int, depth: float) -> Any:
    """Map of a lattice of unit cells: cells of `inner` even ones to WIDTH A, then `outer` that grow up to `depth` A.

    Radial, along surfaces of the 6-norm: planes through the origin stay, and far cells keep their shape. Mid-edge nodes
    lie midway: edges join lattice points whose coordinates differ by 0 or 1 alike.
    """
    size = WIDTH * A / inner
    target = depth * A / size - inner
    low, high = 1e-6, 5.0
    for _ in range(100):
        rate = 0.5 * (low + high)
        low, high = (rate, high) if math.expm1(rate * outer) / rate < target else (low, rate)

    def corner(X: np.ndarray) -> np.ndarray:
        s = (np.abs(X) ** 6).sum(axis=1) ** (1.0 / 6.0)
        far = inner + np.expm1(rate * np.maximum(s - inner, 0.0)) / rate
        return size * X * np.where(s > inner, far / np.maximum(s, 1e-9), 1.0)[:, None]

    def place(X: np.ndarray) -> np.ndarray:
        twice = np.rint(2.0 * X)
        return 0.5 * (corner(np.floor(0.5 * twice)) + corner(np.ceil(0.5 * twice)))

    return place


def fitted_pressure(r: np.ndarray, pressure: np.ndarray, area: np.ndarray, radius: float) -> tuple[float, float]:
    """Contact radius and peak pressure of p^2 = p0^2 (1 - r^2/a^2), by area within 0.9 of an expected radius."""
    used = (r < 0.9 * radius) & (area > 0.0)
    w = np.sqrt(area[used])
    columns = np.stack([np.ones(used.sum()), r[used] ** 2], axis=1) * w[:, None]
    (top, slope), *_ = np.linalg.lstsq(columns, pressure[used] ** 2 * w, rcond=None)
    return math.sqrt(-top / slope), math.sqrt(top)


def fit_errors(r: np.ndarray, pressure: np.ndarray, area: np.ndarray, radius: float, peak: float) -> Row:
    """Fitted contact radius and peak pressure beside expected ones, and the scatter of the pressures, over the peak."""
    a, p0 = fitted_pressure(r, pressure, area, radius)
    inside = (r < 0.9 * radius) & (area > 0.0)
    expected = p0 * np.sqrt(np.maximum(1.0 - (r[inside] / a) ** 2, 0.0))
    scatter = float(np.sqrt(np.average((pressure[inside] - expected) ** 2, weights=area[inside])) / p0)
    return {"points_inside": int(inside.sum()), "a": a, "p0": p0, "a_error": a / radius - 1.0,
            "p0_error": p0 / peak - 1.0, "pressure_scatter": scatter}  # fmt: skip


def solved(b: wf.ModelBuilder, load_steps: int, device: Any) -> tuple[wf.Simulation, Any, float]:
    """The simulation at full load, its result and the seconds of the solution, without compilation."""
    sim = begin_static(b.finalize(device=device), load_steps=load_steps)
    began = clock.perf_counter()
    found = run_static(sim, unstable="ignore")
    return sim, found, clock.perf_counter() - began
