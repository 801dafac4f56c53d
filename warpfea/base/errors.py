"""Exceptions of warpfea. Every one derives from :class:`Error`."""

from __future__ import annotations

from typing import Any

__all__ = [
    "CapacityError",
    "CheckpointError",
    "ConstraintError",
    "ConvergenceError",
    "Error",
    "MeshError",
    "MeshWarning",
    "ModelError",
    "ModelWarning",
    "OutputError",
    "PenetrationError",
    "StabilityError",
    "StabilityWarning",
]


class Error(Exception):
    """Base of all errors that warpfea raises on purpose."""


class MeshError(Error):
    """A mesh file or mesh can't be used; the text names file, element or node, and value."""


class ModelWarning(UserWarning):
    """A model or a run is valid, but looks unintended; the text tells what to write."""


class MeshWarning(ModelWarning):
    """A mesh was usable, but something in it was left out or looks unintended."""


class ModelError(Error):
    """The description of a model is wrong; the text names the body, group or parameter."""


class ConstraintError(Error):
    """A constraint or joint can't be satisfied.

    Attributes:
        joints: names of the joints, the most violated first.
        violations: of each, m.
        time: time (s) at the start of the refused step.
        world: index of the world.
        state: the state, unchanged since before the refused step; None where none was made.
    """

    def __init__(
        self,
        message: str,
        *,
        joints: list[str] | None = None,
        violations: list[float] | None = None,
        time: float = 0.0,
        world: int = 0,
        state: Any = None,
    ) -> None:
        super().__init__(message)
        self.joints = joints or []
        self.violations = violations or []
        self.time = time
        self.world = world
        self.state = state


class CapacityError(Error):
    """A device has too little memory for a model, a simulation or a step.

    Attributes:
        bytes: size of the array that found no room, or of the simulation that would find none; 0 where that is not
            known.
        per_world: bytes that a world of a simulation takes; 0 where that is not known.
        worlds: the most worlds that fit; 0 where that is not known.
    """

    def __init__(self, message: str, *, bytes: int = 0, per_world: int = 0, worlds: int = 0) -> None:
        super().__init__(message)
        self.bytes = bytes
        self.per_world = per_world
        self.worlds = worlds


class CheckpointError(Error):
    """A checkpoint can't be written, read, or belongs to another model."""


class OutputError(Error):
    """An output file can't be written or is not valid."""


class ConvergenceError(Error):
    """A step or a static load step was not accepted.

    Attributes:
        time: time (s) at the start of the refused step, of the first failed world.
        world: index of the first failed world.
        residuals: relative residual after each Newton iteration of the last attempt.
        element: index of the element with the largest residual at its nodes (model numbering), or -1.
        state: the state, unchanged since before the refused step.
    """

    def __init__(
        self,
        message: str,
        *,
        time: float = 0.0,
        world: int = 0,
        residuals: list[float] | None = None,
        element: int = -1,
        state: Any = None,
    ) -> None:
        super().__init__(message)
        self.time = time
        self.world = world
        self.residuals = residuals or []
        self.element = element
        self.state = state


class PenetrationError(ConvergenceError):
    """A step of a model with contact was not accepted, and a point of a body went through an obstacle in it."""


class StabilityError(ConvergenceError):
    """A static equilibrium is unstable, and `unstable="refuse"` was asked for.

    Attributes:
        state: the equilibrium. result: the StaticResult.
    """

    result: Any = None


class StabilityWarning(UserWarning):
    """A static equilibrium is unstable: without an imperfection a model stays on it, a real structure leaves it."""


class UsageError(Error):
    """The command line is wrong."""
