"""Time laws: a constant, samples (times, values), or a `wp.func` of t."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .base.errors import ModelError

__all__ = ["TimeLaw", "time_law"]


@dataclass(frozen=True, eq=False)
class TimeLaw:
    """A value over time: samples, interpolated linearly and constant outside of them; or a function of t.

    Attributes:
        times: (n,) s; one for a constant, empty for a function.
        values: (n, 3) in the unit of what the law drives; of scalar laws the first column.
        function: wp.func of t (s), or None.
        scalar: whether the value is a scalar.
    """

    times: np.ndarray
    values: np.ndarray
    function: Any = None
    scalar: bool = False


def _widen(values: np.ndarray, scalar: bool) -> np.ndarray:
    if not scalar:
        return values
    out = np.zeros((len(values), 3))
    out[:, 0] = values
    return out


def time_law(value: Any, what: str, *, scalar: bool = False) -> TimeLaw:
    """The time law that a user has given.

    Args:
        value: number or 3-vector; (times (n,), values (n,) or (n, 3)); or a wp.func of t; times in s.
        what: name used in errors.
        scalar: a scalar law instead of a vector law.

    Raises:
        ModelError: a Python function, a wrong shape, times that do not increase, or a value that is not finite.
    """
    if isinstance(value, wp.Function):
        return TimeLaw(np.zeros(0), np.zeros((0, 3)), value, scalar)
    if callable(value):
        raise ModelError(f"{what}: a function of time must be a wp.func, got {value!r}")
    width = () if scalar else (3,)
    if isinstance(value, tuple) and len(value) == 2 and np.ndim(value[0]) == 1:
        times = np.asarray(value[0], dtype=float)
        values = np.asarray(value[1], dtype=float)
        if values.shape != (len(times), *width):
            raise ModelError(
                f"{what}: values have shape {values.shape}, expected {(len(times), *width)} for {len(times)} times"
            )
        if len(times) < 1 or np.any(np.diff(times) <= 0.0):
            raise ModelError(f"{what}: times must increase, got {times.tolist()}")
        if len(times) == 1:
            raise ModelError(f"{what}: a law over time needs at least two samples; give the value alone for a constant")
    else:
        try:
            values = np.asarray(value, dtype=float)[None]
        except (TypeError, ValueError) as error:
            raise ModelError(f"{what} = {value!r} is not a number, vector, (times, values) or wp.func") from error
        times = np.zeros(1)
        if values.shape != (1, *width):
            raise ModelError(f"{what} has shape {values.shape[1:]}, expected {width or 'a number'}")
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(values))):
        raise ModelError(f"{what}: {value!r} holds a value that is not finite")
    return TimeLaw(times, _widen(values, scalar), None, scalar)
