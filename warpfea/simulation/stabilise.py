"""Stabilising springs for bodies in statics before contact is established: k (1 - load) M (u - u at the last
equilibrium)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..base.writer import Output
from ..model.assembly import element_volumes, require_density
from ..model.contact_points import effective_modulus

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["Springs", "spring_stiffness"]

DEFAULT_STIFFNESS_RATIO = 1e-3
"""Default stiffness, over E / (density size^2) of the stiffest body."""


def spring_stiffness(model: Model, stabilise: Any) -> float:
    """Spring stiffness of `solve_static(stabilise=)`, N/m per kg; 0: none. ModelError for a bad value or a missing
    density."""
    if stabilise is False or stabilise is None:
        return 0.0
    good = isinstance(stabilise, (bool, int, float, np.integer, np.floating))
    if not good or not (math.isfinite(stabilise) and stabilise > 0.0):
        raise ModelError(
            f"solve_static: stabilise = {stabilise!r} must be True, False or a positive number, N/m per kg"
        )
    require_density(model.bodies, "stabilise")
    if stabilise is not True:
        return float(stabilise)
    stiffest = max(
        effective_modulus(b)[0] * float(element_volumes(b).sum()) / model.masses.total_of_body(b) for b in model.bodies
    )
    return DEFAULT_STIFFNESS_RATIO * stiffest / model.size**2


class Springs(Output):
    """Forces and energy of the springs, one entry per load step; an output of the run.

    Attributes:
        stiffness: N/m per kg at zero load.
    """

    def __init__(self, stiffness: float) -> None:
        self.stiffness = stiffness
        self._rows: list[tuple[np.ndarray, np.ndarray]] = []

    @property
    def force(self) -> np.ndarray:
        """Resultant on the model, (B, load steps, 3), N; 0 at full load."""
        return np.stack([row[0] for row in self._rows], axis=1)

    @property
    def energy(self) -> np.ndarray:
        """Stored energy (B, load steps), J; 0 at full load."""
        return np.stack([row[1] for row in self._rows], axis=1)

    def __repr__(self) -> str:
        largest = float(np.linalg.norm(self.force, axis=2).max(initial=0.0)) if self._rows else 0.0
        return f"Springs({self.stiffness:.3g} N/m per kg, at most {largest:.3g} N)"

    def write(self, sim: Any) -> None:
        """Record the completed load step."""
        if sim.last is None:
            return
        work = sim.stepper.work
        pull = work.inertia.numpy().astype(float)
        moved = work.v.numpy().astype(float)
        force = -np.einsum("bsc,s->bc", pull, sim.model.slot_table.is_position)
        self._rows.append((force, 0.5 * np.einsum("bsc,bsc->b", pull, moved)))
