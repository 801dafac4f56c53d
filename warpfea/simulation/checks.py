"""Validation of user input to a simulation."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..base.checks import is_number, number_hint
from ..base.errors import ModelError
from ..model.model import Model
from ..model.state import State

__all__ = ["check_constraint_tol", "check_mask", "check_model", "check_state",
           "check_time", "check_times", "write_times"]  # fmt: skip


def check_model(model: Any) -> None:
    """Raise ModelError unless `model` is a Model (not a builder)."""
    if not isinstance(model, Model):
        raise ModelError(f"expected a Model, got {type(model).__name__}; builder.finalize() makes one")


def check_time(name: str, value: Any) -> None:
    """Raise ModelError unless `value` is a finite time, s."""
    if not is_number(value):
        raise ModelError(f"{name} = {value!r} must be a finite time (s){number_hint(value)}")


def check_times(name: str, value: Any, model: Model, *, positive: bool = False) -> None:
    """Raise ModelError unless `value` is a time, s, or one per world; device arrays are checked by shape only."""
    what = "positive finite time (s)" if positive else "finite time (s)"
    if isinstance(value, wp.array):
        if value.shape != (model.worlds,) or value.dtype != wp.float64 or value.device != model.device:
            raise ModelError(
                f"{name} = {value.dtype.__name__}{value.shape} on {value.device} must be a Warp array "
                f"float64({model.worlds},) on {model.device}"
            )
        return
    one = isinstance(value, (int, float, np.floating)) and not isinstance(value, bool)
    if not one and not isinstance(value, (np.ndarray, list, tuple)):
        raise ModelError(f"{name} = {value!r} must be a {what}, or one of each world{number_hint(value)}")
    try:
        values = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        values = np.full((1, 1), np.nan)
    if not one and values.shape != (model.worlds,):
        raise ModelError(f"{name} = {value!r} must be a {what}, or {model.worlds} of them, one of each world")
    bad = ~np.isfinite(values) | (positive & ~(values > 0.0))
    if bad.any():
        where = "" if one else f" of world {int(np.flatnonzero(bad)[0])}"
        first = value if one else float(values[bad][0])
        raise ModelError(f"{name} = {first!r}{where} must be a {what}")


def write_times(target: wp.array, value: Any) -> None:
    """Write a time, s, or one per world to an array [world]."""
    if isinstance(value, wp.array):
        wp.copy(target, value)
    elif isinstance(value, (int, float, np.floating)):
        target.fill_(float(value))
    else:
        target.assign(np.asarray(value, dtype=float))


def check_mask(mask: wp.array, model: Model) -> None:
    """Raise ModelError unless `mask` is a mask of worlds on the device."""
    known = mask.dtype in (wp.int32, wp.bool)
    if mask.shape != (model.worlds,) or not known or mask.device != model.device:
        raise ModelError(
            f"reset: the mask is {mask.dtype.__name__}{mask.shape} on {mask.device}, expected int32 or bool "
            f"({model.worlds},) on {model.device}"
        )


def check_constraint_tol(value: Any) -> None:
    """Raise ModelError unless `value` is a constraint tolerance, over the model's size."""
    if not (isinstance(value, (int, float, np.floating)) and 0.0 < value < 1.0):
        raise ModelError(f"constraint_tol = {value!r} must lie between 0 and 1")


def check_state(model: Model, state: State) -> None:
    """Raise ModelError unless `state` is a state of this model."""
    if not isinstance(state, State):
        raise ModelError(f"expected a State, got {type(state).__name__}; sim.state is one, model.state() makes one")
    got, expected = state.displacement, (model.worlds, model.slots)
    if got.shape != expected or got.dtype != model.types.vec3 or got.device != model.device:
        raise ModelError(
            f"the state is of another model: displacement {got.shape} of {got.dtype.__name__} on {got.device}, "
            f"expected {expected} of {model.types.vec3.__name__} on {model.device}"
        )
