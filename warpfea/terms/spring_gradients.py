"""Adjoint of springs, actuators, stops and friction of joints; see kernels/terms/spring_gradients.py."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.terms.bounded_laws import FRICTION
from ..kernels.terms.spring_coordinates import CHORD, VECTOR
from ..kernels.terms.spring_gradients import parameter_struct, spring_gradient_kernels
from .gradients import Gradient, StepAdjoint, compile_kernels
from .protocols import Differentiable
from .term import StepContext, part

if TYPE_CHECKING:
    from ..model.springs import Spring

__all__ = ["DifferentiableSprings"]


class DifferentiableSprings(Differentiable):
    """Adjoint of a term of springs. Where a law has a kink, at a stop or a limit, it takes the side of the step."""

    springs: list[Spring]
    kind: np.ndarray
    data: Any
    definition: Any
    features_used: Any
    count: int
    impacts: bool
    device_fields: Mapping[str, str]
    start_of_step: Callable[[StepContext], tuple[wp.array, list[Any]]]

    def not_differentiable(self, ctx: StepContext) -> str | None:
        if ctx.midpoint or (ctx.accelerated and not np.isin(self.kind, (VECTOR, CHORD)).all()):
            return "springs of lengths and angles in steps of generalized_alpha or energy_momentum"
        if self.impacts and "previous_displacement" in ctx.state.names:
            return "stops in steps of bdf2, which takes impacts by other steps"
        return "friction of joints" if any(spring.law == FRICTION for spring in self.springs) else None

    @property
    def gradient_kernels(self) -> Any:
        """Its kernels."""
        return spring_gradient_kernels(self.model.dtype, *self.features_used)

    def gradients(self, ctx: StepContext) -> Mapping[str, Callable[[], Gradient]]:
        return {
            name: partial(self._parameter_gradient, ctx, k, field)
            for k, spring in enumerate(self.springs)
            for name, field in spring.parameters.items()
        }

    def _parameter_gradient(self, ctx: StepContext, k: int, field: str, law: int = -1) -> Gradient:
        """By a parameter of spring k, or by its time law."""
        kernel, chosen = self.gradient_kernels.parameter_gradient, parameter_struct()()
        items = np.flatnonzero(self.definition["spring"] == k)
        chosen.first, chosen.last = int(items[0]), int(items[-1]) + 1
        chosen.column, chosen.law, chosen.in_motion = k, law, float(ctx.inertia)
        array = getattr(self.data, self.device_fields[field])
        compile_kernels(self.model, [kernel])

        def add(at: StepAdjoint, out: wp.array) -> None:
            w, (start, _) = at.ctx.work, self.start_of_step(at.ctx)
            args = [self.data, w.u, start, w.time_law_stage_values, w.step.dq_dv, array, chosen, at.w, at.active]
            at.ctx.launch(kernel, self.model.worlds, [*args, at.ctx.scratch[self.name][0], at.sums])
            at.accumulate(out, -1.0)

        return add

    def law_gradient(self, ctx: StepContext, law: int) -> Gradient | None:
        found = np.flatnonzero(self.definition.get("schedule", np.zeros(0)) == law)
        parts = [self._parameter_gradient(ctx, int(k), "stiffness", law) for k in found]

        def add(at: StepAdjoint, out: wp.array) -> None:
            for each in parts:
                each(at, out)

        return add if parts else None

    def prepare_adjoint(self, at: StepAdjoint) -> Iterable[wp.Module]:
        """Modules of `add_history_gradient`."""
        return {self.gradient_kernels.module} if at.ctx.inertia else set()

    @part("springs")
    def add_history_gradient(self, at: StepAdjoint) -> None:
        """Bars of q~ by rates of vectors, and of past displacements by y~ = a0 y(u_n) - a1 y(u_{n-1})."""
        ctx = at.ctx
        if not ctx.inertia:
            return
        m, w, k, scratch = self.model, ctx.work, self.gradient_kernels, ctx.scratch[self.name][0]
        past = [("displacement", ctx.state.displacement, w.step.a0, 1.0)]
        if at.integrator.multistep:
            past.append(("previous_displacement", ctx.u_before, w.step.a1, -1.0))
        for n, (name, u, factor, sign) in enumerate(past):
            args = [self.data, w.u, u, w.time_law_stage_values, factor, sign, w.step.dq_dv, at.w, at.active, scratch]
            ctx.launch(k.rate_bars, (m.worlds, self.count), [*args, scratch.product])
            for vector in (0, 1) if n == 0 else (0,):
                args = [m.topology, self.data, self.offset, scratch.product, vector, at.active, at.scratch]
                ctx.launch(k.sum_entries, at.dim, args)
                if vector:
                    at.add_predictor_bar(at.scratch, at.active)
                else:
                    at.add_to(name, at.scratch)
