"""Reuse rule of a preconditioner or matrix, its linearisation point and state arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import warp as wp

from ..kernels.solvers.reuse import reuse_kernels, reuse_struct

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..model.state import State
    from ..terms.workspace import Workspace

__all__ = ["ReuseRule"]


class ReuseRule:
    """Reuse rule of kernels/solvers/reuse.py for one object (preconditioner or matrix), with its linearisation point.

    Attributes:
        control: counts of the rule on the device; `build_now` flags the worlds that build the object before a solve.
        linearisation_point: displacements of the linearisation point, [world, slot], m; `iterate`: with them, the
            arrays from which element kernels evaluate it.
    """

    def __init__(self, model: Model, work: Workspace, launch: Launcher, name: str, limit: float) -> None:
        self.model, self.work, self.launch, self.name = model, work, launch, name
        self.kernels = reuse_kernels(model.dtype)
        self.dim = (model.worlds, model.slots)
        self.no_flags = wp.zeros(0, dtype=wp.int32, device=model.device)
        self.control: Any = reuse_struct()()
        for field, var in reuse_struct().vars.items():
            if isinstance(var.type, wp.array) and field != "stored_counts":
                size = 1 if field == "any_build" else model.worlds
                setattr(self.control, field, work.array(f"{name} {field}", (size,), var.type.dtype))
        self.control.max_extra_iterations = limit
        self.control.stale.fill_(1)
        self.control.mass_factor.fill_(-1.0)
        self.linearisation_point = work.array(f"{name} place", self.dim, model.types.vec3)
        # no state owns it before `register`
        self.control.stored_counts = wp.zeros((0, 0), dtype=wp.float64, device=model.device)
        self.accepted_point = self.linearisation_point
        self.iterate = work.iterate(self.linearisation_point, work.v_stage, self.control.dq_dv)

    def register(self, state: State) -> None:
        """Register the linearisation point and counts in the state, so that a resumed run takes the same decisions."""
        self.control.stored_counts = state.register(self.name, wp.float64, (6,), (0.0, -1.0, -1.0, 0.0, 0.0, 0.0))
        self.accepted_point = state.register(f"{self.name}_displacement", self.model.types.vec3, (self.model.slots,))

    def invalidate(self, flags: wp.array) -> None:
        """Flag worlds whose state was set externally: the object is rebuilt at the stored linearisation point."""
        self.launch(self.kernels.mark_stale, self.model.worlds, [flags, self.control])

    def decide_rebuild(self, active: wp.array, *, all_active: bool = False) -> None:
        """Flag the worlds that build the object before this solve, in `control.build_now`: those due, or all active."""
        w = self.work
        if all_active:
            self.launch(self.kernels.request_rebuild, self.model.worlds, [active, self.control])
        self.control.any_build.zero_()
        args = [self.control, w.newton, w.step.mass_factor, w.step.dq_dv, active]
        self.launch(self.kernels.decide_rebuild, self.model.worlds, args)

    def rebuild_if_flagged(self, build: Callable[[], None]) -> None:
        """Move the linearisation point and call `build` if any world is flagged; mark the object as built."""
        wp.capture_if(self.control.any_build, self._rebuild, build=build)

    def _rebuild(self, build: Callable[[], None]) -> None:
        self.move_point()
        build()
        self.launch(self.kernels.mark_built, self.model.worlds, [self.control])

    def move_point(self, accepted: wp.array | None = None) -> None:
        """Set the linearisation point before a solve: the iterate for a rebuild, the state's copy after a restore.

        `accepted`: flags of a step; the point is then copied to the state of accepted worlds instead.
        """
        args = [self.control, self.no_flags if accepted is None else accepted, self.work.u_stage]
        args += [self.accepted_point, self.linearisation_point]
        self.launch(self.kernels.transfer_points, self.dim, args)

    def store_counts(self, accepted: wp.array) -> None:
        """Store the rule's counts in the state of accepted worlds, after `move_point` has stored the point."""
        self.launch(self.kernels.store_counts, self.model.worlds, [self.control, accepted])
