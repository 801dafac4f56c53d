"""Where time laws have kinks: jumps, and jumps of the slope."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..laws import TimeLaw

__all__ = ["jumps", "kinks"]

BEND = 0.25
"""Change of the slope that counts as a kink, over the largest slope; samples of a smooth law bend less."""
BULGE = 0.03
"""Change of the slope, times the shorter interval beside it and over the law's range, that counts as well, so that a
jump elsewhere does not hide it: a sine with so few samples that `BEND` spares it has less."""
STEEP = 1e-3
"""A change within this part of a step is a jump."""


def jumps(law: TimeLaw, dt: float) -> np.ndarray:
    """(n, 2) begin and end, s, of what is a jump to a step dt."""
    t = law.times
    if len(t) < 2:
        return np.zeros((0, 2))
    steep = (np.diff(t) < STEEP * dt) & np.any(np.diff(law.values, axis=0) != 0.0, axis=1)
    return np.stack([t[:-1][steep], t[1:][steep]], axis=1)


def kinks(law: TimeLaw, dt: float) -> np.ndarray:
    """(n,) times, s, at which the slope of a sampled law jumps; those of its jumps are in `jumps`."""
    t = law.times
    if len(t) < 2:
        return np.zeros(0)
    smooth = np.diff(t) >= STEEP * dt
    slope = np.where(smooth[:, None], np.diff(law.values, axis=0) / np.diff(t)[:, None], 0.0)
    slope = np.concatenate([np.zeros((1, 3)), slope, np.zeros((1, 3))])
    bend = np.linalg.norm(np.diff(slope, axis=0), axis=1)
    beside = np.concatenate([[np.inf], np.diff(t), [np.inf]])
    bulge = bend * np.minimum(beside[:-1], beside[1:])
    extent = np.linalg.norm(np.ptp(law.values, axis=0))
    steepest = np.linalg.norm(slope, axis=1).max()
    return t[(bend > BEND * np.maximum(steepest, 1e-300)) | (bulge > BULGE * np.maximum(extent, 1e-300))]
