"""What is made at one iterate and kept for later ones: when it is made anew, and what a resumed run must know of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from ..kernels.solvers.reuse import reuse_kernels, reuse_struct

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..model.state import State
    from ..terms.workspace import Workspace

__all__ = ["Reuse"]


class Reuse:
    """The rule of kernels/solvers/reuse.py for one thing, and where it was made.

    Attributes:
        control: the rule's counts on the device; `build` flags the worlds that make theirs.
        place: displacements that it is made at, (world, slot).
    """

    def __init__(self, model: Model, work: Workspace, launch: Launcher, name: str, limit: float) -> None:
        self.model, self.work, self.launch, self.name = model, work, launch, name
        self.kernels = reuse_kernels(model.dtype)
        self.dim = (model.worlds, model.slots)
        self.none = wp.zeros(0, dtype=wp.int32, device=model.device)
        self.control: Any = reuse_struct()()
        for field, var in reuse_struct().vars.items():
            if isinstance(var.type, wp.array) and field != "kept":
                size = 1 if field == "any_build" else model.worlds
                setattr(self.control, field, work.array(f"{name} {field}", (size,), var.type.dtype))
        self.control.limit = limit
        self.control.stale.fill_(1)
        self.control.mass_factor.fill_(-1.0)
        self.place = work.array(f"{name} place", self.dim, model.types.vec3)
        # without a state that remembers it
        self.control.kept, self.kept = wp.zeros((0, 0), dtype=wp.float64, device=model.device), self.place

    def register(self, state: State) -> None:
        """Put into the state where it was made, and the rule's counts."""
        self.control.kept = state.register(self.name, wp.float64, (6,), (0.0, -1.0, -1.0, 0.0, 0.0, 0.0))
        self.kept = state.register(f"{self.name}_displacement", self.model.types.vec3, (self.model.slots,))

    def forget(self, flags: wp.array) -> None:
        """The state of flagged worlds was set from elsewhere."""
        self.launch(self.kernels.mark, self.model.worlds, [flags, self.control])

    def decide(self, active: wp.array) -> None:
        """Flag the worlds that make theirs before this solve."""
        w = self.work
        self.control.any_build.zero_()
        args = [self.control, w.newton, w.step.mass_factor, w.step.dq_dv, active]
        self.launch(self.kernels.decide, self.model.worlds, args)

    def carry(self, accepted: wp.array | None = None) -> None:
        """Take the place: the iterate's or, where the state was set from elsewhere, the state's.

        `accepted`: of a step; the state takes it then.
        """
        args = [self.control, self.none if accepted is None else accepted, self.work.u, self.kept, self.place]
        self.launch(self.kernels.carry_places, self.dim, args)

    def made(self) -> None:
        """It was made where it was flagged."""
        self.launch(self.kernels.made, self.model.worlds, [self.control])

    def commit(self, accepted: wp.array) -> None:
        """The step was accepted: tell the state, after the places."""
        self.launch(self.kernels.commit, self.model.worlds, [self.control, accepted])
