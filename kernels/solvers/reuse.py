"""Reuse rule of a preconditioner or operator matrix from an earlier iterate: when to keep it, when to rebuild it.

It is kept until the extra iterations that it causes cost as much as a rebuild: iterations of PCG with a preconditioner,
of Newton's method with a matrix. The rules count iterations, never time, and their counts are part of the state, so
that a resumed run takes the same decisions. Below, "the object" is the preconditioner or the matrix, at its
linearisation point (displacements).
"""

import functools
from typing import Any

import warp as wp

from ..common.modules import KernelSet, kernel_set, masked_kernel
from ..common.types import double_1d, double_2d, f64, int_1d, precision, vec3d_2d
from .blocks import block_kernels
from .newton_control import control_struct
from .pcg import pcg_struct

__all__ = ["reuse_kernels", "reuse_struct"]

NEW_MATRIX_DECADES = 3.0
"""Expected residual reduction of a Newton iteration with a new matrix, in decades."""
REDUCTION_FADING = 0.8
"""Factor on `first_reduction` when a step begins with a new matrix: the rule retries an old matrix after some steps."""
REUSED_FORCING_FACTOR = 0.3
"""Relative tolerance of a linear solve with a reused matrix, over the reduction by the last Newton iteration."""


@functools.cache
def reuse_struct():
    """State of the reuse rule, per world."""

    @wp.struct
    class ReuseControl:
        build_now: wp.array(dtype=wp.int32)  # 1: build the object before this solve
        build_at_iterate: wp.array(dtype=wp.int32)  # 1: build it at this iterate; 0: at its old linearisation point
        point_changed: wp.array(dtype=wp.int32)  # the linearisation point has changed since it was stored in the state
        stale: wp.array(dtype=wp.int32)  # 1: object and counts are not the state's; 2: the object is not
        rebuild_due: wp.array(dtype=wp.int32)  # rebuild it at the next solve
        mass_factor: wp.array(dtype=wp.float64)  # c_M and dq/dv of the object; negative: never built
        dq_dv: wp.array(dtype=wp.float64)
        baseline_iterations: wp.array(
            dtype=wp.float64
        )  # iterations of its first solve (per decade) or step; 0: not yet known
        extra_iterations: wp.array(dtype=wp.float64)  # iterations beyond that rate since its first solve
        built_at_iteration: wp.array(dtype=wp.int32)  # matrix: Newton iteration of this attempt that built it; -1: kept
        first_reduction: wp.array(
            dtype=wp.float64
        )  # reduction of the residual by a step's first iteration with a kept matrix
        stored_counts: wp.array2d(dtype=wp.float64)  # [world, 6] in the state: the values of `restore_counts`
        max_extra_iterations: wp.float64  # beyond it a rebuild pays
        any_build: wp.array(dtype=wp.int32)

    return ReuseControl


@functools.cache
def reuse_kernels(dtype: str) -> KernelSet:
    """Kernels of the reuse rule."""
    p = precision(dtype)
    vec3 = p.vec3
    Reuse = reuse_struct()
    Newton, PCG = control_struct(), pcg_struct()
    module = block_kernels(dtype).module  # shared with the kernels of the matrices, to compile one module less

    @wp.func
    def restore_counts(reuse: Reuse, world: int):
        """Restore the counts from the state, once, after the state was set externally (reset, checkpoint)."""
        if reuse.stale[world] == 1:
            reuse.rebuild_due[world] = int(reuse.stored_counts[world, 0])
            reuse.mass_factor[world] = reuse.stored_counts[world, 1]
            reuse.dq_dv[world] = reuse.stored_counts[world, 2]
            reuse.baseline_iterations[world] = reuse.stored_counts[world, 3]
            reuse.extra_iterations[world] = reuse.stored_counts[world, 4]
            reuse.first_reduction[world] = reuse.stored_counts[world, 5]
            reuse.stale[world] = 2

    @wp.func
    def gained_decades(reduction: f64) -> f64:
        """Reduction of the residual in decades."""
        return -wp.log10(wp.max(reduction, f64(1.0e-30)))

    @wp.kernel(module=module)
    def decide_rebuild(reuse: Reuse, newton: Newton, mass_factor: double_1d, dq_dv: double_1d, active: int_1d):
        """Before a solve: choose the worlds that build the object, at the iterate if it is due or the step has
        changed."""
        world = wp.tid()
        reuse.build_now[world] = 0
        reuse.build_at_iterate[world] = 0
        if active[world] == 0:
            return
        restore_counts(reuse, world)
        same = reuse.mass_factor[world] == mass_factor[world] and reuse.dq_dv[world] == dq_dv[world]
        if reuse.rebuild_due[world] != 0 or not same:
            reuse.build_at_iterate[world] = 1
            reuse.point_changed[world] = 1
            reuse.rebuild_due[world] = 0
            reuse.mass_factor[world] = mass_factor[world]
            reuse.dq_dv[world] = dq_dv[world]
            reuse.baseline_iterations[world] = f64(0.0)
            reuse.extra_iterations[world] = f64(0.0)
            reuse.built_at_iteration[world] = newton.iterations[world]
        if reuse.build_at_iterate[world] != 0 or reuse.stale[world] != 0:
            reuse.build_now[world] = 1
            wp.atomic_max(reuse.any_build, 0, 1)

    @masked_kernel(module, "newton.active")
    def check_matrix_reuse(reuse: Reuse, newton: Newton, keep: int):
        """Before a solve: decide whether the matrix of this iterate would save enough Newton iterations.

        The number of remaining iterations with the present matrix is estimated from its gain per iteration: that of the
        last one or, at the start of a step, of the first one of the last step that began with a kept matrix
        (`first_reduction`, which fades). `keep`: 1: the matrix may be kept within a step; 2: from step to step.
        """
        world = wp.tid()
        if keep == 2:
            restore_counts(reuse, world)
        k = newton.iterations[world]
        need = wp.log10(wp.max(newton.norms.ratio[world], f64(1.0)))
        fresh = wp.max(need / f64(NEW_MATRIX_DECADES), f64(1.0))
        if newton.floor.estimate_error[world] != 0 or newton.solve.predicted_stress[world] != 0:
            reuse.rebuild_due[world] = 1
        if newton.solve.operator_reused[world] == 2:
            reuse.rebuild_due[world] = 1
            if k == 0:
                reuse.first_reduction[world] = f64(1.0)
            return
        if k == 0:
            reuse.built_at_iteration[world] = -1
            if keep < 2:
                reuse.rebuild_due[world] = 1
                reuse.stale[world] = 0  # the state holds no matrix
                return
            if need > gained_decades(reuse.first_reduction[world]) * (fresh + reuse.max_extra_iterations):
                reuse.rebuild_due[world] = 1
                reuse.first_reduction[world] = f64(REDUCTION_FADING) * reuse.first_reduction[world]
            return
        slow = need > gained_decades(newton.norms.residual_reduction[world]) * (fresh + reuse.max_extra_iterations)
        late = 3 * k >= newton.max_iterations
        if newton.search.alpha[world] != f64(1.0) or slow or late:
            reuse.rebuild_due[world] = 1

    @wp.kernel(module=module)
    def loosen_forcing(reuse: Reuse, newton: Newton):
        """Loosen the forcing term of a solve with a reused matrix to the expected reduction by an iteration."""
        world = wp.tid()
        newton.solve.operator_reused[world] = 1 - reuse.build_at_iterate[world]
        if newton.active[world] == 0:
            return
        reduction = reuse.first_reduction[world]
        if newton.iterations[world] > 0:
            reduction = newton.norms.residual_reduction[world]
            if newton.iterations[world] == 1 and reuse.built_at_iteration[world] == -1:
                reuse.first_reduction[world] = reduction
        if reuse.build_at_iterate[world] == 0 and newton.solve.fixed_forcing == 0:
            newton.solve.forcing[world] = wp.max(
                newton.solve.forcing[world], wp.min(f64(REUSED_FORCING_FACTOR) * reduction, f64(0.1))
            )

    @wp.kernel(module=module)
    def count_step(reuse: Reuse, newton: Newton, accepted: int_1d):
        """After an accepted step: count its iterations beyond those of the first step with this matrix."""
        world = wp.tid()
        if accepted[world] == 0 or reuse.stale[world] != 0:
            return
        if newton.solve.predicted_stress[world] != 0:
            reuse.rebuild_due[world] = 1  # the state lacks its linearisation point
        built_at_iteration = wp.max(reuse.built_at_iteration[world], 0)
        # a step that rebuilt it midway began with another matrix: count one more iteration
        count = f64(newton.iterations[world] - built_at_iteration + wp.min(built_at_iteration, 1))
        if reuse.baseline_iterations[world] == f64(0.0):
            reuse.baseline_iterations[world] = wp.max(count, f64(1.0))
        else:
            reuse.extra_iterations[world] = reuse.extra_iterations[world] + wp.max(
                count - reuse.baseline_iterations[world], f64(0.0)
            )
            if reuse.extra_iterations[world] > reuse.max_extra_iterations:
                reuse.rebuild_due[world] = 1

    @wp.kernel(module=module)
    def count_solve(reuse: Reuse, newton: Newton, pcg: PCG):
        """After a solve: count its iterations beyond those of the first solve with this preconditioner."""
        world = wp.tid()
        if newton.active[world] == 0 or pcg.iterations[world] == 0:
            return
        count = f64(pcg.iterations[world])
        gained = wp.max(pcg.first_norm[world] / wp.max(pcg.norm[world], f64(1.0e-300)), f64(2.0))
        decades = wp.log10(gained)
        if reuse.baseline_iterations[world] == f64(0.0):
            reuse.baseline_iterations[world] = count / decades
        else:
            reuse.extra_iterations[world] = reuse.extra_iterations[world] + wp.max(
                count - reuse.baseline_iterations[world] * decades - f64(1.0), f64(0.0)
            )
        if reuse.extra_iterations[world] > reuse.max_extra_iterations:
            reuse.rebuild_due[world] = 1

    @wp.kernel(module=module)
    def store_counts(reuse: Reuse, accepted: int_1d):
        """After an accepted step: store the counts in the state, unless there was no solve."""
        world = wp.tid()
        if accepted[world] == 0 or reuse.stale[world] != 0:
            return
        reuse.point_changed[world] = 0
        reuse.stored_counts[world, 0] = f64(reuse.rebuild_due[world])
        reuse.stored_counts[world, 1] = reuse.mass_factor[world]
        reuse.stored_counts[world, 2] = reuse.dq_dv[world]
        reuse.stored_counts[world, 3] = reuse.baseline_iterations[world]
        reuse.stored_counts[world, 4] = reuse.extra_iterations[world]
        reuse.stored_counts[world, 5] = reuse.first_reduction[world]

    @masked_kernel(module, "flags")
    def mark_stale(flags: int_1d, reuse: Reuse):
        """Flag the worlds whose state was set externally."""
        world = wp.tid()
        reuse.stale[world] = 1

    @masked_kernel(module, "flags")
    def request_rebuild(flags: int_1d, reuse: Reuse):
        """Request a rebuild before the next solve in the flagged worlds."""
        world = wp.tid()
        reuse.rebuild_due[world] = 1

    @wp.func
    def transfer_case(reuse: Reuse, accepted: int_1d, world: int) -> int:
        """Transfer due: 1: iterate to linearisation point; 2: state to linearisation point; 3: linearisation point to
        state; 0: none.

        1 and 2 come before a solve, 3 after a step with the flags `accepted` (else an empty array).
        """
        if accepted.shape[0] > 0:
            return wp.where(accepted[world] != 0 and reuse.point_changed[world] != 0 and reuse.stale[world] == 0, 3, 0)
        if reuse.build_at_iterate[world] != 0:
            return 1
        return wp.where(reuse.stale[world] != 0, 2, 0)

    values = wp.array2d(dtype=Any)

    @wp.func
    def transfer_entry(to: int, live: values, kept: values, linearisation_point: values, world: int, k: int):
        """Copy an entry according to `transfer_case`."""
        if to == 1:
            linearisation_point[world, k] = live[world, k]
        elif to == 2:
            linearisation_point[world, k] = kept[world, k]
        elif to == 3:
            kept[world, k] = linearisation_point[world, k]

    @wp.kernel(module=module)
    def transfer_points(reuse: Reuse, accepted: int_1d, u: p.vec3_2d, kept: p.vec3_2d, linearisation_point: p.vec3_2d):
        """Copy the displacements of the linearisation point, see `transfer_case`."""
        world, slot = wp.tid()
        to = transfer_case(reuse, accepted, world)
        transfer_entry(to, u, kept, linearisation_point, world, slot)

    @wp.kernel(module=module)
    def transfer_words(
        reuse: Reuse, accepted: int_1d, live: wp.array2d(dtype=wp.uint32), kept: wp.array2d(dtype=wp.uint32),
        linearisation_point: wp.array2d(dtype=wp.uint32),
    ):  # fmt: skip
        """`transfer_points` for an array of a term, as [world, 32-bit word]."""
        world, word = wp.tid()
        to = transfer_case(reuse, accepted, world)
        transfer_entry(to, live, kept, linearisation_point, world, word)

    @wp.kernel(module=module)
    def transfer_constraint_rows(
        reuse: Reuse, accepted: int_1d, gradient: vec3d_2d, stiffness: double_2d, kept_gradient: vec3d_2d,
        kept_stiffness: double_2d, point_gradient: vec3d_2d, point_stiffness: double_2d,
    ):  # fmt: skip
        """`transfer_points` for the rows of constraints of the object."""
        world, row = wp.tid()
        to = transfer_case(reuse, accepted, world)
        transfer_entry(to, stiffness, kept_stiffness, point_stiffness, world, row)
        for side in range(3):
            transfer_entry(to, gradient, kept_gradient, point_gradient, world, 3 * row + side)

    @masked_kernel(module, "reuse.build_now")
    def mark_built(reuse: Reuse):
        """Clear `stale` in the worlds that have built the object."""
        world = wp.tid()
        reuse.stale[world] = 0

    return kernel_set(locals())
