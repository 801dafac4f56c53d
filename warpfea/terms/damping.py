"""Kelvin-Voigt damping outside the elements' kernels, which contain its incremental and rate forms.

Incremental: strain at the start of the step, from which the rate is computed. Explicit: the force of Eqs. (58)-(70) at
the start of the step, frozen during it among the dead loads.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import warp as wp

from ..kernels.step.gather import gather_kernels
from ..kernels.terms.loads import load_kernels
from .term import EXPLICIT_VISCOUS, Column, StepContext, Term, part

if TYPE_CHECKING:
    from ..model.model import Model
    from .workspace import Workspace

__all__ = ["Damping"]

DAMPING_FORMS = ("incremental", "rate", "explicit")


class Damping(Term):
    """Damping data at the start of an attempt."""

    name = "damping"

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.explicit = any(b.key.damping == "explicit" for b in model.blocks)
        self.columns = (Column("viscous", EXPLICIT_VISCOUS),) if self.explicit else ()  # type: ignore[misc]
        self.kernels = load_kernels(model.dtype)

    @classmethod
    def of(cls, model: Model) -> Damping | None:
        return cls(model) if any(b.key.damping in ("incremental", "explicit") for b in model.blocks) else None

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        forms = {b.key.damping for b in model.blocks}
        return {f"damping {form}": form in forms for form in DAMPING_FORMS}

    def allocate(self, work: Workspace, ctx: StepContext) -> None:
        if self.explicit:
            m = self.model
            force = work.array("explicit", (m.worlds, m.slots), m.types.vec3)
            power = work.array("explicit_power", (m.worlds, m.element_count), wp.float64)
            ctx.scratch[self.name] = force, power

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        if not ctx.inertia:
            return set()
        out = {b.kernels.viscous_force.module for b in self.model.blocks if b.key.damping == "explicit"}
        if not ctx.midpoint:  # computes the strains of both ends
            name = "strain_history_with_velocity" if ctx.accelerated else "strain_history"
            out |= {getattr(b.kernels, name).module for b in self.model.blocks if b.key.damping == "incremental"}
        return out | ({self.kernels.subtract_explicit_force.module} if self.explicit else set())

    @part("loads")
    def begin(self, ctx: StepContext, active: wp.array) -> None:
        if not ctx.inertia:
            return
        m, w, launch, state = self.model, ctx.work, ctx.launch, ctx.state
        force, power = ctx.scratch[self.name] if self.explicit else (None, None)
        if self.explicit:
            w.contribution.zero_()  # the gather below sums the entries of all blocks
        for block in m.blocks:
            dim = (m.worlds, block.count)
            if block.key.damping == "incremental" and ctx.accelerated:
                args = [block.data, state.displacement, state.velocity, ctx.u_before, w.step.b, w.step.q_a, active]
                launch(block.kernels.strain_history_with_velocity, dim, [*args, w.history])
            elif block.key.damping == "incremental" and not ctx.midpoint:
                args = [block.data, state.displacement, ctx.u_before, w.step.a0, w.step.a1, active, w.history]
                launch(block.kernels.strain_history, dim, args)
            elif block.key.damping == "explicit":
                args = [block.data, state.displacement, state.velocity, active, w.contribution, power]
                launch(block.kernels.viscous_force, dim, args)
        if self.explicit:
            gather = gather_kernels(m.dtype, ctx.traits).gather_force
            launch(gather, (m.worlds, m.slots), [m.topology, w.contribution, active, force])
            launch(self.kernels.subtract_explicit_force, (m.worlds, m.slots), [force, active, w.dead])

    def energy_increments(self, ctx: StepContext, accepted: wp.array) -> wp.array | None:
        """Viscous loss of the frozen force, J."""
        if not (self.explicit and ctx.inertia):
            return None
        m, w = self.model, ctx.work
        force, _ = ctx.scratch[self.name]
        ctx.launch(
            self.kernels.explicit_work_rows, (m.worlds, m.slots), [force, w.u, ctx.state.displacement, accepted, w.rows]
        )
        return w.rows
