"""Element term: internal force Eq. (32) with the viscous stress of Eq. (70), its tangent and diagonal blocks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from .fields import ELEMENT_FIELDS
from .term import StepContext, Term

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State

__all__ = ["Elements"]

MIN_LANE_POINTS = 8
"""Points per element from which lanes of a warp share an element."""


class Elements(Term):
    """Element blocks of a model. Writes work.contribution and, for energies, work.energy_rows."""

    name = "elements"
    fields = ELEMENT_FIELDS

    @classmethod
    def of(cls, model: Model) -> Elements:
        return cls(model)

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        return {
            "straight elements": any(b.key.affine for b in model.blocks),
            "table elements": any(not b.key.affine for b in model.blocks),
        }

    def kernels(self, ctx: StepContext) -> list:
        """Kernels of the blocks; statics has no rates and uses those without damping."""
        dtype, blocks = self.model.dtype, self.model.blocks
        if ctx.midpoint:
            lossy = ctx.dissipation > 0.0
            return [b.kernels_for(dtype, b.key.damping, midpoint=True, dissipative=lossy) for b in blocks]
        return [b.kernels if ctx.inertia else b.kernels_for(dtype, None) for b in blocks]

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        return {kernels.module for kernels in self.kernels(ctx)}

    def force(self, ctx: StepContext, active: wp.array) -> None:
        if not ctx.positions_changed:
            return
        m, w, launch = self.model, ctx.work, ctx.launch
        for block, kernels in zip(m.blocks, self.kernels(ctx)):
            lanes = launch.lanes(block.points // 2) if block.points >= MIN_LANE_POINTS and not block.key.tying else 1
            args = [w.data_of(block), w.stage, active, lanes, w.contribution, w.energy_rows]
            dim = (w.u.shape[0], launch.padded(block.count * lanes))
            launch(kernels.internal_force, dim, [*args, w.newton.min_J, w.newton.domain_J])

    def check_inversion(self, ctx: StepContext, active: wp.array) -> None:
        """Flag in newton.inverted the worlds with a point where J > 0 in the state and J <= 0 at the iterate."""
        w = ctx.work
        for block, kernels in zip(self.model.blocks, self.kernels(ctx)):
            if not block.key.tying:
                args = [w.data_of(block), ctx.state.displacement, w.u, active, w.newton.inverted]
                ctx.launch(kernels.inverted_elements, (w.u.shape[0], block.count), args)

    def measure_direction_gradient(self, ctx: StepContext, p: wp.array, active: wp.array) -> None:
        """Maximum gradient of a direction, into newton.direction_gradient."""
        for block, kernels in zip(self.model.blocks, self.kernels(ctx)):
            if not block.key.tying:
                args = [ctx.work.data_of(block), p, active, ctx.work.newton.nonmonotone.direction_gradient]
                ctx.launch(kernels.largest_gradient, (p.shape[0], block.count), args)

    def predicted_stress_kernels(self) -> list[wp.Kernel]:
        """Kernels of `predicted_stress_tangent`."""
        return [block.predicted_stress_product(self.model.dtype) for block in self.model.blocks]

    def predicted_stress_tangent(self, ctx: StepContext, p: wp.array, active: wp.array) -> None:
        """`tangent` with the linearly predicted stress in its geometric part, for worlds flagged `predicted_stress`."""
        m, w = self.model, ctx.work
        for block, kernel in zip(m.blocks, self.predicted_stress_kernels()):
            args = [block.data, w.iterate(w.u, w.v, w.step.dq_dv), active, p, w.contribution]
            ctx.launch(kernel, (p.shape[0], block.count), args)

    def tangent(self, ctx: StepContext, p: wp.array, active: wp.array) -> None:
        """K p of all elements into work.contribution, for matrix-free products."""
        m, w = self.model, ctx.work
        for block, kernels in zip(m.blocks, self.kernels(ctx)):
            args = [w.data_of(block), w.stage, active, p, w.contribution]
            ctx.launch(kernels.tangent_product, (p.shape[0], block.count), args)

    def diagonal(self, ctx: StepContext, active: wp.array) -> None:
        m, w = self.model, ctx.work
        for block, kernels in zip(m.blocks, self.kernels(ctx)):
            args = [w.data_of(block), w.u_stage, w.step.dq_dv, active, w.block_contribution]
            ctx.launch(kernels.diagonal_blocks, (m.worlds, block.count), args)

    def samples(self, field: str, body: Any, state: State) -> np.ndarray:
        if field == "displacement":
            return state.displacement.numpy()[:, body.slots].astype(float)
        evaluation = self.model.evaluation
        if field == "von_mises":
            return evaluation.sample_stress(state, body)
        sample = evaluation.sample_jacobian if field == "J" else evaluation.sample_energy_density
        return sample(state, body)[:, :, 0]
