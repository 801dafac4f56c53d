"""Discontinuities of time laws: value and slope jumps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..time_laws import TimeLaw

__all__ = ["jump_intervals", "kink_times"]

MIN_SLOPE_CHANGE = 0.25
"""Slope change of a kink over the largest slope; samples of a smooth law change less."""
MIN_KINK_HEIGHT = 0.03
"""Slope change of a kink times the shorter adjacent interval, over the law's range: detects kinks beside a large jump,
above the value of a coarsely sampled sine that passes `MIN_SLOPE_CHANGE`."""
MAX_JUMP_DURATION = 1e-3
"""Duration of a jump, over the step."""


def jump_intervals(law: TimeLaw, dt: float) -> np.ndarray:
    """Start and end times (n, 2), s, of jumps relative to a step dt."""
    t = law.times
    if len(t) < 2:
        return np.zeros((0, 2))
    steep = (np.diff(t) < MAX_JUMP_DURATION * dt) & np.any(np.diff(law.values, axis=0) != 0.0, axis=1)
    return np.stack([t[:-1][steep], t[1:][steep]], axis=1)


def kink_times(law: TimeLaw, dt: float) -> np.ndarray:
    """Times (n,), s, of slope jumps of a sampled law; value jumps are in `jump_intervals`."""
    t = law.times
    if len(t) < 2:
        return np.zeros(0)
    smooth = np.diff(t) >= MAX_JUMP_DURATION * dt
    slope = np.where(smooth[:, None], np.diff(law.values, axis=0) / np.diff(t)[:, None], 0.0)
    slope = np.concatenate([np.zeros((1, 3)), slope, np.zeros((1, 3))])
    bend = np.linalg.norm(np.diff(slope, axis=0), axis=1)
    beside = np.concatenate([[np.inf], np.diff(t), [np.inf]])
    bulge = bend * np.minimum(beside[:-1], beside[1:])
    extent = np.linalg.norm(np.ptp(law.values, axis=0))
    steepest = np.linalg.norm(slope, axis=1).max()
    return t[
        (bend > MIN_SLOPE_CHANGE * np.maximum(steepest, 1e-300))
        | (bulge > MIN_KINK_HEIGHT * np.maximum(extent, 1e-300))
    ]
