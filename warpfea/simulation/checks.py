"""Checks of what users pass to a simulation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..model.model import Model
from ..model.state import State

__all__ = ["check_choice", "check_constraint_tol", "check_dt", "check_model", "check_state", "check_steps"]


def check_model(model: Any) -> None:
    """Raise ModelError for what is not a Model, such as a builder."""
    if not isinstance(model, Model):
        raise ModelError(f"expected a Model, got {type(model).__name__}; builder.finalize() makes one")


def check_dt(value: Any) -> None:
    """Raise ModelError for what is not a time step, s."""
    if not (isinstance(value, (int, float, np.floating)) and math.isfinite(value) and value > 0.0):
        raise ModelError(f"dt = {value!r} must be a positive finite time (s)")


def check_choice(name: str, value: Any, first: str, second: str) -> None:
    """Raise ModelError for what is neither of two words."""
    if value not in (first, second):
        raise ModelError(f"{name} = {value!r} is neither {first!r} nor {second!r}")


def check_constraint_tol(value: Any) -> None:
    """Raise ModelError for what is not a tolerance of constraints, over the model's size."""
    if not (isinstance(value, (int, float, np.floating)) and 0.0 < value < 1.0):
        raise ModelError(f"constraint_tol = {value!r} must lie between 0 and 1")


def check_steps(count: Any) -> None:
    """Raise ModelError for what is not a number of steps."""
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
        raise ModelError(f"step({count!r}): the number of steps must be a whole number, at least 1")


def check_state(model: Model, state: State) -> None:
    """Raise ModelError for a state of another model."""
    got, expected = state.displacement, (model.worlds, model.slots)
    if got.shape != expected or got.dtype != model.types.vec3 or got.device != model.device:
        raise ModelError(
            f"the state is of another model: displacement {got.shape} of {got.dtype.__name__} on {got.device}, "
            f"expected {expected} of {model.types.vec3.__name__} on {model.device}"
        )
