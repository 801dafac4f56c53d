"""Element term: internal force Eq. (32) with the viscous stress of Eq. (70), its tangent and diagonal blocks.

Kelvin-Voigt damping outside the elements' kernels, which contain its incremental and rate forms. Incremental: strain at
the start of the step, from which the rate is computed. Explicit: the force of Eqs. (58)-(70) at the start of the step,
frozen during it among the dead loads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..kernels.elements.history_gradient import history_gradient_kernel
from ..kernels.step.gather import gather_kernels
from ..kernels.terms.loads import load_kernels
from .fields import ELEMENT_FIELDS
from .gradients import Gradient, StepAdjoint, material_gradients
from .protocols import Differentiable
from .section_forces import SECTION_FIELDS, section_field
from .shape_gradients import internal_force_gradient, mass_gradient, not_shaped
from .term import EXPLICIT_VISCOUS, Column, Congruence, StepContext, part

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State
    from .workspace import Workspace

__all__ = ["Damping", "Elements"]

MIN_LANE_POINTS = 8
"""Points per element from which lanes of a warp share an element."""
DAMPING_FORMS = ("incremental", "rate", "explicit")


class Elements(Differentiable):
    """Element blocks of a model. Writes work.contribution and, for energies, work.energy_rows."""

    name = "elements"
    fields = ELEMENT_FIELDS | SECTION_FIELDS

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
        for block, kernels in zip(self.model.blocks, self.kernels(ctx)):
            self.block_force(ctx, block, kernels, ctx.work.data_of(block), active)

    def block_force(self, ctx: StepContext, block: Any, kernels: Any, data: Any, active: wp.array) -> None:
        """Forces of a block with other constants `data`."""
        w, launch = ctx.work, ctx.launch
        lanes = launch.lanes(block.points // 2) if block.points >= MIN_LANE_POINTS and not block.key.tying else 1
        args = [data, w.stage, active, lanes, w.contribution, w.energy_rows]
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
            args = [w.data_of(block), w.u_stage, w.step.rate_time, active, w.block_contribution]
            ctx.launch(kernels.diagonal_blocks, (m.worlds, block.count), args)

    def matrices(self, state: State, world: int) -> tuple[Congruence, None]:
        """The tangent, without that of rigid parts, which constraints hold; viscous forces of motions:
        Evaluation.viscous_force."""
        flexible = np.ones((self.model.slots, 3))
        for body in self.model.bodies:
            if body.rigid:
                flexible[body.slot_range] = 0.0
        W = sp.diags(flexible.ravel(), format="csr")
        return Congruence(W, self.model.evaluation.tangent_matrix(state, world), diagonal=True), None

    # adjoint

    def not_differentiable(self, ctx: StepContext) -> str | None:
        forms = {b.key.damping for b in self.model.blocks} & {"explicit"} if ctx.inertia else set()
        return f"damping of the form {forms.pop()!r}" if forms else None

    def exact_product(
        self, ctx: StepContext, p: wp.array, active: wp.array, *, transposed: bool, start: bool = False
    ) -> None:  # fmt: skip
        kernels = self.exact_kernels(ctx)
        if not kernels:
            self.tangent(ctx, p, active)
        for block, kernel in zip(self.model.blocks, kernels):
            args = [ctx.work.data_of(block), ctx.work.stage, int(start), int(transposed), active, p]
            ctx.launch(kernel, (p.shape[0], block.count), [*args, ctx.work.contribution])

    def is_symmetric(self, ctx: StepContext) -> bool:
        rate = ctx.inertia and any(block.key.damping == "rate" for block in self.model.blocks)
        return not (ctx.midpoint or rate)

    def exact_kernels(self, ctx: StepContext) -> list[wp.Kernel]:
        """Kernels `exact_product` of the blocks; none where `tangent` is exact and symmetric."""
        kind = ctx.midpoint, ctx.dissipation > 0.0
        blocks = [] if self.is_symmetric(ctx) else self.model.blocks
        return [block.exact_product(self.model.dtype, block.key.damping, *kind) for block in blocks]

    def gradients(self, ctx: StepContext) -> Mapping[str, Callable[[], Gradient]]:
        return material_gradients(ctx, self)

    def shape_gradients(self, ctx: StepContext) -> list[Callable[[], Gradient]] | str:
        moving = ctx.inertia or self.model.terms.dead_loads.has_gravity
        makers = (internal_force_gradient, mass_gradient) if moving else (internal_force_gradient,)
        return not_shaped(ctx) or [partial(make, ctx) for make in makers]

    def history_kernels(self, damping: str) -> list[tuple[Any, wp.Kernel]]:
        """Blocks with a form of damping, and their kernels `history_gradient`."""
        blocks = [b for b in self.model.blocks if b.key.damping == damping]
        kind = [(b.key.law, b.slots, b.key.affine, b.key.framed) for b in blocks]
        return [(b, history_gradient_kernel(self.model.dtype, *key)) for b, key in zip(blocks, kind)]

    def add_history_gradient(self, at: StepAdjoint) -> None:
        ctx = at.ctx
        if not ctx.inertia or ctx.midpoint:
            return
        if found := self.history_kernels("incremental"):
            for name, x, scale in at.history_fields():
                self._history_force(at, found, x, scale, at.w, transposed=1)
                at.add_to(name, at.scratch)
        if found := self.history_kernels("rate"):
            self._history_force(at, found, at.ctx.work.u, at.ones, at.w, transposed=1)
            at.add_predictor_bar(at.scratch)

    def add_history_change(self, at: StepAdjoint) -> None:
        ctx = at.ctx
        if not ctx.inertia or ctx.midpoint:
            return
        if found := self.history_kernels("incremental"):
            for name, x, scale in at.history_fields():
                self._history_force(at, found, x, scale, at.bars[name], transposed=0)
                ctx.launch(at.kernels.add_vector, at.dim, [at.scratch, at.active, at.force])
        if found := self.history_kernels("rate"):
            self._history_force(at, found, ctx.work.u, at.ones, at.q_tilde, transposed=0)
            ctx.launch(at.kernels.add_vector, at.dim, [at.scratch, at.active, at.force])

    def _history_force(
        self, at: StepAdjoint, found: list[Any], x: wp.array, scale: wp.array, direction: wp.array, transposed: int
    ) -> None:
        """Forces of `history_gradient` into at.scratch."""
        w = at.ctx.work
        w.contribution.zero_()
        for block, kernel in found:
            args = [block.data, w.u, x, scale, direction, w.step.dq_dv, transposed, at.active, w.contribution]
            at.ctx.launch(kernel, (self.model.worlds, block.count), args)
        at.gather(at.scratch)

    def samples(self, field: str, body: Any, state: State) -> np.ndarray:
        """Fields of slots and section forces; others are functions of quantities."""
        if field in SECTION_FIELDS:
            return section_field(field, self.model, body, state)
        return getattr(state, field).numpy()[:, body.slot_range].astype(float)


class Damping(Differentiable):
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

    def matrices(self, state: State, world: int) -> tuple[None, None]:
        return None, None

    def shape_gradients(self, ctx: StepContext) -> list[Callable[[], Gradient]]:
        """That of the elements."""
        return []
