"""Displacements of a float32 model's contact slots in float64."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.contact.double_displacements import double_displacement_kernels

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..terms.term import StepContext

__all__ = ["DoubleDisplacements"]


class DoubleDisplacements:
    """Displacements of the contact slots in float64, for a float32 model; see
    kernels/contact/double_displacements.py.

    Attributes:
        kernels: device code.
    """

    def __init__(self, model: Model, connectivity: list[np.ndarray]) -> None:
        self.kernels = double_displacement_kernels()
        slots = np.unique(np.concatenate([conn.ravel() for conn in connectivity]))
        self._slots = model.array("contact", slots, wp.int32)

    def update(self, ctx: StepContext, out: wp.array, active: wp.array) -> None:
        """Displacements of the iterate; in statics (no velocities) those of the state, rounded."""
        w = ctx.work
        if not ctx.inertia:
            self.widen(ctx.launch, w.u, active, out)
            return
        args = [self._slots, w.q_tilde, w.v, w.step.dq_dv, active, out]
        ctx.launch(self.kernels.update_displacements, (len(out), len(self._slots)), args)

    def widen(self, launch: Launcher, u: wp.array, active: wp.array, out: wp.array) -> None:
        """Copy u in float64."""
        launch(self.kernels.copy_to_float64, (len(out), len(self._slots)), [self._slots, u, active, out])
