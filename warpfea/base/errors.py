"""Exceptions of warpfea. Every one derives from :class:`Error`."""

from collections.abc import Sequence
from typing import Any

__all__ = [
    "CapacityError", "CheckpointError", "ConstraintError", "ConvergenceError", "Error", "MeshError", "MeshWarning",
    "ModelError", "ModelWarning", "OutputError", "PenetrationError", "StabilityError", "StabilityWarning",
]  # fmt: skip


class Error(Exception):
    """Base class of all errors raised by warpfea; `details` are values of attributes that its class declares."""

    def __init__(self, message: str = "", **details: Any) -> None:
        super().__init__(message)
        for name, value in details.items():
            getattr(self, name)  # AttributeError for an unknown one
            setattr(self, name, value)


class MeshError(Error):
    """Unusable mesh or mesh file; the text names file, element or node, and value."""


class ModelWarning(UserWarning):
    """Warning: the input is valid but probably unintended; the text states the correction."""


class MeshWarning(ModelWarning):
    """Warning: a mesh was read, but part of it was omitted or looks unintended."""


class ModelError(Error):
    """Invalid model description; the text names the body, group or parameter."""


class ConstraintError(Error):
    """Unsatisfiable constraint or joint.

    Attributes:
        joints: names of the joints, the most violated first.
        violations: of each joint, m.
        time: time (s) at the start of the refused step.
        world: index of the world.
        state: the state before the refused step; None if there is none.
    """

    joints: Sequence[str] = ()
    violations: Sequence[float] = ()
    time: float = 0.0
    world: int = 0
    state: Any = None


class CapacityError(Error):
    """Too little device memory for a model, a simulation or a step.

    Attributes:
        bytes: requested size of the array or simulation; 0 if unknown.
        per_world: bytes per world of a simulation; 0 if unknown.
        worlds: largest number of worlds that fits; 0 if unknown.
    """

    bytes: int = 0
    per_world: int = 0
    worlds: int = 0


class CheckpointError(Error):
    """Checkpoint that can't be written or read, or belongs to another model."""


class OutputError(Error):
    """Output file that can't be written or is invalid."""


class ConvergenceError(Error):
    """Rejected time step or static load step.

    Attributes:
        time: time (s) at the start of the refused step, of the first failed world.
        world: index of the first failed world.
        residuals: relative residual after each Newton iteration of the last attempt.
        element: index of the element with the largest residual at its nodes (model numbering), or -1.
        state: the state before the refused step.
    """

    time: float = 0.0
    world: int = 0
    residuals: Sequence[float] = ()
    element: int = -1
    state: Any = None


class PenetrationError(ConvergenceError):
    """Rejected step of a model with contact in which a point of a body passed through an obstacle."""


class StabilityError(ConvergenceError):
    """Unstable static equilibrium with `unstable="refuse"`.

    Attributes:
        state: the equilibrium. result: the StaticResult.
    """

    result: Any = None


class StabilityWarning(UserWarning):
    """Unstable static equilibrium: without an imperfection the model stays on it, a real structure leaves it."""


class UsageError(Error):
    """Invalid command line."""
