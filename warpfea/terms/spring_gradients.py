"""Adjoint of springs, actuators, stops and friction of joints; see kernels/terms/spring_gradients.py."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..kernels.terms.bounded_laws import FRICTION
from ..kernels.terms.spring_coordinates import CHORD, VECTOR
from ..kernels.terms.spring_gradients import parameter_struct, spring_gradient_kernels
from ..model.springs import bushing_parts
from .gradients import ForceGradient, Gradient, StepAdjoint, compile_kernels
from .protocols import Differentiable
from .term import StepContext, part

if TYPE_CHECKING:
    from ..model.springs import Bushing, Spring

__all__ = ["DifferentiableSprings"]

PAST = ("displacement", "previous_displacement")
ANCHOR = "spring_anchor"
"""State array of the anchors of friction."""


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
        return "friction of joints in statics" if self.has_friction and not ctx.inertia else None

    @property
    def has_friction(self) -> bool:
        """True with friction of joints."""
        return any(spring.law == FRICTION for spring in self.springs)

    @property
    def gradient_kernels(self) -> Any:
        """Its kernels."""
        return spring_gradient_kernels(self.model.dtype, *self.features_used)

    def gradients(self, ctx: StepContext) -> Mapping[str, Callable[[], Gradient]]:
        return {
            name: partial(self._parameter_gradient, ctx, field, [(k, np.ones(1))])
            for k, spring in enumerate(self.springs)
            for name, field in spring.parameters.items()
        } | {
            f"{bushing.name}.{field}": partial(self._bushing_gradient, ctx, bushing, field)
            for bushing in self.model.description.bushings
            for field in ("stiffness", "damping")
        }

    def _bushing_gradient(self, ctx: StepContext, bushing: Bushing, field: str) -> Gradient:
        """By the six values of a bushing; 0 of those whose springs were left out."""
        slopes = bushing_parts(np.eye(6), damping=field == "damping").T
        if field == "damping":  # products of an axis with itself are clipped from below
            slopes[6::4] = bushing_parts(np.eye(6), damping=False).T[3:6]
        k = [self.springs.index(spring) for spring in bushing.springs]
        values = getattr(self.data, self.device_fields[field]).numpy()[:, k]
        if field == "damping" and any(p in (6, 10, 14) and not values[:, n].all() for n, p in enumerate(bushing.parts)):
            raise ModelError(f"Adjoint: {bushing.name!r} is damped about one axis by no more than about the two others")
        return self._parameter_gradient(ctx, field, [(n, slopes[part]) for n, part in zip(k, bushing.parts)])

    def _parameter_gradient(
        self, ctx: StepContext, field: str, springs: list[tuple[int, np.ndarray]], law: int = -1
    ) -> Gradient:
        """By a field of springs, each times factors by component, or by a time law of theirs."""
        kernel, chosen = self.gradient_kernels.parameter_force, []
        for k, factors in springs:
            items, one = np.flatnonzero(self.definition["spring"] == k), parameter_struct()()
            one.first, one.last = int(items[0]), int(items[-1]) + 1
            one.column, one.law, one.in_motion = k, law, float(ctx.inertia)
            if self.springs[k].law == FRICTION and self.springs[k].stick > 0.0:
                one.stiffness = 1.0 / self.springs[k].stick
            chosen.append((one, factors))
        array = getattr(self.data, self.device_fields[field])
        compile_kernels(self.model, [kernel])

        def force(at: StepAdjoint, component: int) -> None:
            w, (start, _), scratch = at.ctx.work, self.start_of_step(at.ctx), at.ctx.scratch[self.name][0]
            scratch.product.zero_()
            for one, factors in chosen:
                if factors[component]:
                    args = [self.data, w.u, start, w.time_law_stage_values, w.step.dq_dv, array, one]
                    args += [float(factors[component]), at.active, scratch, scratch.product]
                    at.ctx.launch(kernel, self.model.worlds, args)
            self._sum_entries(at, -1)

        return ForceGradient(force, -1.0)

    def law_gradient(self, ctx: StepContext, law: int) -> Gradient | None:
        found = np.flatnonzero(self.definition.get("schedule", np.zeros(0)) == law).tolist()
        return self._parameter_gradient(ctx, "stiffness", [(k, np.ones(1)) for k in found], law) if found else None

    def prepare_adjoint(self, at: StepAdjoint) -> Iterable[wp.Module]:
        if self.has_friction:
            at.bars[ANCHOR] = at.ctx.work.array(f"adjoint {ANCHOR}", (self.model.worlds, self.count), wp.float64)
        return {self.gradient_kernels.module} if at.ctx.inertia else set()

    @part("springs")
    def linearise_adjoint(self, at: StepAdjoint) -> None:
        if self.has_friction:
            scratch = at.ctx.scratch[self.name][0]
            args = [self.data, at.ctx.work.u, at.bars[ANCHOR], at.active, scratch, scratch.product]
            at.ctx.launch(self.gradient_kernels.end_anchors, (self.model.worlds, self.count), args)
            self._sum_entries(at, 0)
            at.add_to("displacement", at.scratch)

    def _sum_entries(self, at: StepAdjoint, vector: int) -> None:
        """Bars of the items at their slots, into at.scratch; `vector`: those of VECTOR, or of the others."""
        args = [self.model.topology, self.data, self.offset, at.ctx.scratch[self.name][0].product, vector, at.active]
        at.ctx.launch(self.gradient_kernels.sum_entries, at.dim, [*args, at.scratch])

    def _rate_bars(self, at: StepAdjoint, n: int, direction: wp.array, forwards: int) -> None:
        """Bars, or forces, by the displacements (n = 0: at the start, 1: before) in y~ = a0 y(u_n) - a1 y(u_{n-1})."""
        ctx, w, scratch = at.ctx, at.ctx.work, at.ctx.scratch[self.name][0]
        past, factor, sign = ((ctx.state.displacement, w.step.a0, 1.0), (ctx.u_before, w.step.a1, -1.0))[n]
        args = [self.data, w.u, past, w.time_law_stage_values, factor, sign, w.step.dq_dv, direction, forwards]
        args += [at.active, scratch, scratch.product]
        ctx.launch(self.gradient_kernels.rate_bars, (self.model.worlds, self.count), args)

    @part("springs")
    def add_history_change(self, at: StepAdjoint) -> None:
        if self.has_friction or (self.impacts and at.integrator.multistep):
            what = "friction of joints has" if self.has_friction else "stops in steps of bdf2 have"
            raise ModelError(f"Adjoint.forward: {what} no sensitivities; take backward()")
        if at.ctx.inertia:
            add = [at.scratch, at.active, at.force]
            for n, name in enumerate(PAST[: 1 + at.integrator.multistep]):
                self._rate_bars(at, n, at.bars[name], 1)
                self._sum_entries(at, 0)
                at.ctx.launch(at.kernels.add_vector, at.dim, add)
            self._rate_bars(at, 0, at.q_tilde, 1)
            self._sum_entries(at, 1)
            at.ctx.launch(at.kernels.add_vector, at.dim, add)

    @part("springs")
    def add_history_gradient(self, at: StepAdjoint) -> None:
        ctx = at.ctx
        if not ctx.inertia:
            return
        m, w, k, scratch = self.model, ctx.work, self.gradient_kernels, ctx.scratch[self.name][0]
        for n, name in enumerate(PAST[: 1 + at.integrator.multistep]):
            self._rate_bars(at, n, at.w, 0)
            self._sum_entries(at, 0)
            at.add_to(name, at.scratch)
            if n == 0:  # bars of q~ by rates of vectors
                self._sum_entries(at, 1)
                at.add_predictor_bar(at.scratch)
        if self.has_friction:
            args = [self.data, w.u, ctx.state.displacement, w.time_law_stage_values, getattr(ctx.state, ANCHOR)]
            args += [w.step.dq_dv, at.w, at.active, scratch, at.bars[ANCHOR], scratch.product]
            ctx.launch(k.start_anchors, (m.worlds, self.count), args)
            self._sum_entries(at, 0)
            at.add_to("displacement", at.scratch)
