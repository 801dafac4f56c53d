"""Predictor: first iterate of a step, see kernels/step/predictor.py."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from ..kernels.step.predictor import PREDICTOR_ROWS, predictor_kernels, predictor_struct

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..model.state import State
    from ..solvers.residual import RowReducer
    from ..terms.workspace import Workspace
    from .integrators import Integrator

__all__ = ["Predictor"]


class Predictor:
    """Velocity extrapolation in the order with the smallest error in the last step; the history is in the state."""

    def __init__(
        self, model: Model, work: Workspace, launch: Launcher, reduce: RowReducer, state: State, module: wp.Module,
        *, scheme: Integrator,
    ) -> None:  # fmt: skip
        self.model, self.work, self.launch, self.reduce, self.state = model, work, launch, reduce, state
        impacts = model.terms.traits.takes_again(scheme)
        self.kernels = predictor_kernels(model.dtype, scheme.accelerated, impacts, module)
        self.dim = (model.worlds, model.slots)
        self.control: Any = predictor_struct()()
        for name in ("order", "history_count"):
            setattr(self.control, name, work.array(f"predictor {name}", (model.worlds,), wp.int32))
        self.control.sums = work.array("predictor sums", (PREDICTOR_ROWS, model.worlds), wp.float64)
        self.control.history_state = state.register("predictor", wp.float64, (4,))
        # multistep schemes store v_{n-1} already
        self.stores_velocity = not scheme.multistep
        field = model.types.vec3, (model.slots,)
        before = state.register("predictor_before", *field) if self.stores_velocity else state.previous_velocity
        self.previous_velocities = before, state.register("predictor_first", *field)

    def begin(self) -> None:
        """Write the first iterate to work.v, which holds v_n from the kernel `predict`."""
        m, w, step = self.model, self.work, self.work.step
        self.launch(self.kernels.begin_attempt, m.worlds, [self.control, step, w.newton])
        args = [self.control, step, m.topology.free, self.state.velocity, *self.previous_velocities, w.v]
        self.launch(self.kernels.extrapolate, self.dim, args)

    def update_history(self) -> None:
        """Update the velocity history and choose the next extrapolation order, after an accepted attempt."""
        m, w, step = self.model, self.work, self.work.step
        args = [
            self.control,
            step,
            m.topology.free,
            m.slot_table.is_position_array,
            w.diagonal,
            w.v,
            self.state.velocity,
            *self.previous_velocities,
        ]
        self.launch(self.kernels.order_error_terms, self.dim, [*args, w.rows])
        self.reduce(w.rows, PREDICTOR_ROWS, step.accepted, self.control.sums)
        self.launch(
            self.kernels.shift_history,
            self.dim,
            [step, int(self.stores_velocity), self.state.velocity, *self.previous_velocities],
        )
        self.launch(self.kernels.choose_order, m.worlds, [self.control, step])
