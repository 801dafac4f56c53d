"""When a preconditioner or an operator's matrix is made anew: it is kept until what it costs in iterations exceeds what
making it costs. A preconditioner costs iterations of PCG, a matrix those of Newton's method.

The rules count iterations, never time, and their memory is part of the state, so that a resumed run does the same.
"""

import functools
import types as _types

import warp as wp

from ..common.types import precision
from .blocks import block_kernels
from .newton import control_struct
from .pcg import pcg_struct

__all__ = ["reuse_kernels", "reuse_struct"]

DECADES = 3.0
"""What an iteration of Newton's method gains with the matrix of its iterate, for the rule."""
FADE = 0.8
"""A kept matrix that served badly at the start of a step is tried again after some steps."""
AGEING = 0.25
"""What a solve adds to `excess` where only D, which norms are measured with, is kept."""
SHARE = 0.3
"""Residual of a linear solve over what the last iteration left, with a matrix that is not of the iterate."""


@functools.cache
def reuse_struct():
    """What a rule knows of each world."""

    @wp.struct
    class LagControl:
        build: wp.array(dtype=wp.int32)  # make it now
        moved: wp.array(dtype=wp.int32)  # at the present iterate; else again where it was made
        changed: wp.array(dtype=wp.int32)  # it was moved since the state last heard
        stale: wp.array(dtype=wp.int32)  # the matrices at hand are not those of the state; 2: its counts are
        due: wp.array(dtype=wp.int32)  # make it at the next solve
        mass_factor: wp.array(dtype=wp.float64)  # c_M and dq/dv it was made for; negative: never made
        dq_dv: wp.array(dtype=wp.float64)
        rate: wp.array(dtype=wp.float64)  # iterations of the first solve (per decade) or step with it; 0: none yet
        excess: wp.array(dtype=wp.float64)  # iterations beyond that rate since
        made_at: wp.array(dtype=wp.int32)  # of a matrix: iteration of this attempt that it was made at; -1: kept
        pace: wp.array(dtype=wp.float64)  # reduction of the residual by a step's first iteration with a kept matrix
        kept: wp.array2d(dtype=wp.float64)  # of the state: due, mass_factor, dq_dv, rate, excess, pace
        limit: wp.float64  # excess that pays for making it
        any_build: wp.array(dtype=wp.int32)

    return LagControl


@functools.cache
def reuse_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels of the rule."""
    p = precision(dtype)
    vec3 = p.vec3
    f64 = wp.float64
    Reuse = reuse_struct()
    Newton, PCG = control_struct(), pcg_struct()
    module = block_kernels(dtype).module  # one with the matrices that it keeps

    @wp.func
    def recall(reuse: Reuse, world: int):
        """What the state remembers, once after it was set from elsewhere."""
        if reuse.stale[world] == 1:
            reuse.due[world] = int(reuse.kept[world, 0])
            reuse.mass_factor[world] = reuse.kept[world, 1]
            reuse.dq_dv[world] = reuse.kept[world, 2]
            reuse.rate[world] = reuse.kept[world, 3]
            reuse.excess[world] = reuse.kept[world, 4]
            reuse.pace[world] = reuse.kept[world, 5]
            reuse.stale[world] = 2

    @wp.func
    def gain(reduction: f64) -> f64:
        """Decades."""
        return -wp.log10(wp.max(reduction, f64(1.0e-30)))

    @wp.kernel(module=module)
    def decide(
        reuse: Reuse,
        newton: Newton,
        mass_factor: wp.array(dtype=f64),
        dq_dv: wp.array(dtype=f64),
        active: wp.array(dtype=wp.int32),
    ):
        """Before a solve: which worlds make theirs."""
        world = wp.tid()
        reuse.build[world] = 0
        reuse.moved[world] = 0
        if active[world] == 0:
            return
        recall(reuse, world)
        same = reuse.mass_factor[world] == mass_factor[world] and reuse.dq_dv[world] == dq_dv[world]
        if reuse.due[world] != 0 or not same:
            reuse.moved[world] = 1
            reuse.changed[world] = 1
            reuse.due[world] = 0
            reuse.mass_factor[world] = mass_factor[world]
            reuse.dq_dv[world] = dq_dv[world]
            reuse.rate[world] = f64(0.0)
            reuse.excess[world] = f64(0.0)
            reuse.made_at[world] = newton.iterations[world]
        if reuse.moved[world] != 0 or reuse.stale[world] != 0:
            reuse.build[world] = 1
            wp.atomic_max(reuse.any_build, 0, 1)

    @wp.kernel(module=module)
    def judge_matrix(reuse: Reuse, newton: Newton, keep: int):
        """Before a solve: whether Newton's method would gain by the matrix of this iterate.

        What an iteration gained tells how many are left with the matrix at hand: the last one or, at the start of a
        step, the first of the last step that began with a kept matrix, whose memory fades. `keep`: 1: it may be kept
        within a step; 2: from step to step.
        """
        world = wp.tid()
        if newton.active[world] == 0:
            return
        if keep == 2:
            recall(reuse, world)
        k = newton.iterations[world]
        need = wp.log10(wp.max(newton.excess[world], f64(1.0)))
        fresh = wp.max(need / f64(DECADES), f64(1.0))
        if newton.reused[world] == 2:
            reuse.due[world] = 1
            if k == 0:
                reuse.pace[world] = f64(1.0)
            return
        if k == 0:
            reuse.made_at[world] = -1
            if keep < 2:
                reuse.due[world] = 1
                reuse.stale[world] = 0  # whatever the state was, it holds none
                return
            if need > gain(reuse.pace[world]) * (fresh + reuse.limit):
                reuse.due[world] = 1
                reuse.pace[world] = f64(FADE) * reuse.pace[world]
            return
        slow = need > gain(newton.reduction[world]) * (fresh + reuse.limit)
        late = 3 * k >= newton.max_iterations
        if newton.alpha[world] != f64(1.0) or slow or late:
            reuse.due[world] = 1

    @wp.kernel(module=module)
    def loosen(reuse: Reuse, newton: Newton):
        """With a matrix of an earlier iterate no solve need go further than the matrix is good for."""
        world = wp.tid()
        newton.reused[world] = 1 - reuse.moved[world]
        if newton.active[world] == 0:
            return
        pace = reuse.pace[world]
        if newton.iterations[world] > 0:
            pace = newton.reduction[world]
            if newton.iterations[world] == 1 and reuse.made_at[world] == -1:
                reuse.pace[world] = pace
        if reuse.moved[world] == 0 and newton.fixed_forcing == 0:
            newton.forcing[world] = wp.max(newton.forcing[world], wp.min(f64(SHARE) * pace, f64(0.1)))

    @wp.kernel(module=module)
    def count_step(reuse: Reuse, newton: Newton, accepted: wp.array(dtype=wp.int32)):
        """An accepted step: what it cost in iterations beyond the first step with this matrix."""
        world = wp.tid()
        if accepted[world] == 0 or reuse.stale[world] != 0:
            return
        made_at = wp.max(reuse.made_at[world], 0)
        # a step that made it on its way had begun with another
        count = f64(newton.iterations[world] - made_at + wp.min(made_at, 1))
        if reuse.rate[world] == f64(0.0):
            reuse.rate[world] = wp.max(count, f64(1.0))
        else:
            reuse.excess[world] = reuse.excess[world] + wp.max(count - reuse.rate[world], f64(0.0))
            if reuse.excess[world] > reuse.limit:
                reuse.due[world] = 1

    @wp.kernel(module=module)
    def judge(reuse: Reuse, newton: Newton, pcg: PCG, follows: int):
        """After a solve: what it cost. `follows`: the preconditioner is made with the operator, only D grows old."""
        world = wp.tid()
        if newton.active[world] == 0 or pcg.iterations[world] == 0:
            return
        count = f64(pcg.iterations[world])
        gained = wp.max(pcg.first_norm[world] / wp.max(pcg.norm[world], f64(1.0e-300)), f64(2.0))
        decades = wp.log10(gained)
        if follows != 0:
            reuse.excess[world] = reuse.excess[world] + f64(AGEING)
        elif reuse.rate[world] == f64(0.0):
            reuse.rate[world] = count / decades
        else:
            reuse.excess[world] = reuse.excess[world] + wp.max(count - reuse.rate[world] * decades - f64(1.0), f64(0.0))
        if reuse.excess[world] > reuse.limit:
            reuse.due[world] = 1

    @wp.kernel(module=module)
    def commit(reuse: Reuse, accepted: wp.array(dtype=wp.int32)):
        """An accepted step: the state hears what was done; of a step without a solve that is nothing."""
        world = wp.tid()
        if accepted[world] == 0 or reuse.stale[world] != 0:
            return
        reuse.changed[world] = 0
        reuse.kept[world, 0] = f64(reuse.due[world])
        reuse.kept[world, 1] = reuse.mass_factor[world]
        reuse.kept[world, 2] = reuse.dq_dv[world]
        reuse.kept[world, 3] = reuse.rate[world]
        reuse.kept[world, 4] = reuse.excess[world]
        reuse.kept[world, 5] = reuse.pace[world]

    @wp.kernel(module=module)
    def mark(flags: wp.array(dtype=wp.int32), reuse: Reuse):
        """The state of flagged worlds was set from elsewhere."""
        world = wp.tid()
        if flags[world] != 0:
            reuse.stale[world] = 1

    @wp.func
    def which(reuse: Reuse, accepted: wp.array(dtype=wp.int32), world: int) -> int:
        """1: the iterate is where it is made; 2: what was kept is; 3: the state hears. 0: nothing to do."""
        if accepted.shape[0] > 0:
            return wp.where(accepted[world] != 0 and reuse.changed[world] != 0 and reuse.stale[world] == 0, 3, 0)
        if reuse.moved[world] != 0:
            return 1
        return wp.where(reuse.stale[world] != 0, 2, 0)

    @wp.kernel(module=module)
    def carry_places(
        reuse: Reuse,
        accepted: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        kept: wp.array2d(dtype=vec3),
        place: wp.array2d(dtype=vec3),
    ):
        """Where it is made, and what the state keeps of it. `accepted`: of a step, else empty."""
        world, slot = wp.tid()
        to = which(reuse, accepted, world)
        if to == 1:
            place[world, slot] = u[world, slot]
        elif to == 2:
            place[world, slot] = kept[world, slot]
        elif to == 3:
            kept[world, slot] = place[world, slot]

    @wp.kernel(module=module)
    def carry_rows(
        reuse: Reuse,
        accepted: wp.array(dtype=wp.int32),
        gradient: wp.array2d(dtype=wp.vec3d),
        stiffness: wp.array2d(dtype=f64),
        kept_gradient: wp.array2d(dtype=wp.vec3d),
        kept_stiffness: wp.array2d(dtype=f64),
        place_gradient: wp.array2d(dtype=wp.vec3d),
        place_stiffness: wp.array2d(dtype=f64),
    ):
        """The same for the constraints' rows."""
        world, row = wp.tid()
        to = which(reuse, accepted, world)
        if to == 1:
            place_stiffness[world, row] = stiffness[world, row]
        elif to == 2:
            place_stiffness[world, row] = kept_stiffness[world, row]
        elif to == 3:
            kept_stiffness[world, row] = place_stiffness[world, row]
        for side in range(3):
            k = 3 * row + side
            if to == 1:
                place_gradient[world, k] = gradient[world, k]
            elif to == 2:
                place_gradient[world, k] = kept_gradient[world, k]
            elif to == 3:
                kept_gradient[world, k] = place_gradient[world, k]

    @wp.kernel(module=module)
    def made(reuse: Reuse):
        """The matrices at hand are those of the state again."""
        world = wp.tid()
        if reuse.build[world] != 0:
            reuse.stale[world] = 0

    return _types.SimpleNamespace(
        module=module,
        decide=decide,
        judge=judge,
        judge_matrix=judge_matrix,
        count_step=count_step,
        loosen=loosen,
        commit=commit,
        mark=mark,
        made=made,
        carry_places=carry_places,
        carry_rows=carry_rows,
    )
