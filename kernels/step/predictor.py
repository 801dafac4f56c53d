"""Predictor: the first iterate of a step, extrapolated from the velocities of previous steps.

It is v_n (order 0), 2 v_n - v_{n-1} (order 1) or 3 v_n - 3 v_{n-1} + v_{n-2} (order 2): the order that would have been
the best for the last step. It saves a third of the PCG iterations in smooth motions, and costs none in others.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set, masked_kernel
from ..common.structs import RESTART_REPEATED, free_components_function
from ..common.types import double_3d, f64, precision
from ..solvers.newton_control import control_struct
from .step_control import step_struct

__all__ = ["PREDICTOR_ROWS", "predictor_kernels", "predictor_struct"]

PREDICTOR_ROWS = 3
"""Rows of `order_error_terms` that are summed per world."""
ORDER_MARGIN = 0.05
"""Squared error ratio to the lower order below which a higher order is chosen."""


@functools.cache
def predictor_struct():
    """Velocity history of the predictor, per world."""

    @wp.struct
    class PredictorControl:
        order: wp.array(dtype=wp.int32)  # order of this attempt
        history_count: wp.array(dtype=wp.int32)  # available earlier velocities, from steps of equal size; at most 2
        history_state: wp.array2d(
            dtype=wp.float64
        )  # [world, 4] in the state: next order and count, size and end of the last step
        sums: wp.array2d(dtype=wp.float64)  # [PREDICTOR_ROWS, world] squared errors of orders 0, 1, 2 in the last step

    return PredictorControl


@functools.cache
def predictor_kernels(dtype: str, accelerated: bool, impacts: bool, module: wp.Module) -> KernelSet:
    """Kernels in one precision, in the module of the step kernels; `accelerated`, `impacts`: see `step_kernels`."""
    p, free_components = precision(dtype), free_components_function(dtype)
    T, vec3 = p.T, p.vec3
    Predictor, Step, Newton = predictor_struct(), step_struct(), control_struct()

    @wp.func
    def extrapolated_velocity(order: int, v: vec3, before: vec3, first: vec3) -> vec3:
        """Extrapolation of order 1 or 2 from the velocities of the last three steps, m/s."""
        if order == 2:
            return T(3.0) * (v - before) + first
        return T(2.0) * v - before

    @wp.kernel(module=module)
    def begin_attempt(predictor: Predictor, step: Step, newton: Newton):
        """Choose the order: that of the state, if its last step had this size and ended at the start of the attempt."""
        world = wp.tid()
        predictor.order[world] = 0
        predictor.history_count[world] = 0
        newton.start.is_extrapolated[world] = 0
        if step.running[world] == 0:
            return
        if wp.static(impacts):
            if step.impact[world] >= RESTART_REPEATED:
                return
        if predictor.history_state[world, 2] == step.h[world] and predictor.history_state[world, 3] == step.time[world]:
            predictor.order[world] = int(predictor.history_state[world, 0])
            predictor.history_count[world] = int(predictor.history_state[world, 1])
        newton.start.is_extrapolated[world] = wp.min(predictor.order[world], 1)

    @wp.kernel(module=module)
    def extrapolate(
        predictor: Predictor,
        step: Step,
        free: p.vec3_1d,
        v_n: p.vec3_2d,
        before: p.vec3_2d,
        first: p.vec3_2d,
        v: p.vec3_2d,
    ):
        """Extrapolated first iterate on free components if the order is above 0; else v_n is kept."""
        world, slot = wp.tid()
        order = predictor.order[world]
        if step.running[world] == 0 or order == 0:
            return
        new = extrapolated_velocity(order, v_n[world, slot], before[world, slot], first[world, slot])
        v[world, slot] = free_components(free[slot], new, v[world, slot])

    @masked_kernel(module, "step.accepted")
    def order_error_terms(
        predictor: Predictor, step: Step, free: p.vec3_1d, is_position: p.scalar_1d, diagonal: p.vec3_2d, v: p.vec3_2d,
        v_n: p.vec3_2d, before: p.vec3_2d, first: p.vec3_2d, rows: double_3d,
    ):  # fmt: skip
        """Squared errors of orders 0, 1, 2 in an accepted step, in the norm of D."""
        world, slot = wp.tid()
        D = wp.cw_mul(diagonal[world, slot], free[slot])
        w = v[world, slot]
        a = v_n[world, slot]
        fall = (T(step.dq_dv[world]) * is_position[slot]) * vec3(step.gravity[world])
        if wp.static(accelerated):
            fall = (T(step.h[world]) * is_position[slot]) * vec3(step.gravity[world])
        e = w - a - fall
        if step.a1[world] > f64(0.0):  # a multistep scheme already extrapolates linearly
            e = w - extrapolated_velocity(1, a, before[world, slot], first[world, slot])
        rows[0, world, slot] = f64(wp.dot(D, wp.cw_mul(e, e)))
        for order in range(1, 3):
            e = w - extrapolated_velocity(order, a, before[world, slot], first[world, slot])
            rows[order, world, slot] = f64(wp.dot(D, wp.cw_mul(e, e)))

    @masked_kernel(module, "step.accepted")
    def shift_history(step: Step, own: int, v_n: p.vec3_2d, before: p.vec3_2d, first: p.vec3_2d):
        """Shift the stored velocities by a step; `own`: v_{n-1} too, which multistep schemes store themselves."""
        world, slot = wp.tid()
        first[world, slot] = before[world, slot]
        if own != 0:
            before[world, slot] = v_n[world, slot]

    @masked_kernel(module, "step.accepted")
    def choose_order(predictor: Predictor, step: Step):
        """Order of the next step: the smallest error, with a margin for higher orders."""
        world = wp.tid()
        count = predictor.history_count[world]
        best = int(0)  # noqa: RUF046 - a variable of the loop
        least = f64(ORDER_MARGIN) * predictor.sums[0, world]
        for order in range(1, 3):
            if order <= count and predictor.sums[order, world] < least:
                best = order
                least = f64(ORDER_MARGIN) * predictor.sums[order, world]
        predictor.history_state[world, 0] = f64(best)
        predictor.history_state[world, 1] = f64(wp.min(count + 1, 2))
        predictor.history_state[world, 2] = step.h[world]
        predictor.history_state[world, 3] = step.time[world]

    return kernel_set(locals())
