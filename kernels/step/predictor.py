"""The first iterate of a step from the velocities of the steps before.

v_n, 2 v_n - v_{n-1}, or 3 v_n - 3 v_{n-1} + v_{n-2}, whichever would have served the last step best: a third fewer PCG
iterations where motions are smooth, and those of v_n where they are not.
"""

import functools
import types as _types

import warp as wp

from ..common.types import precision
from ..solvers.newton import control_struct
from .step import step_struct

__all__ = ["PREDICTOR_ROWS", "predictor_kernels", "predictor_struct"]

PREDICTOR_ROWS = 4
BETTER = 0.05
"""Share of the squared error that a higher order must come below."""
ROUNDINGS = 1.0e3
"""Errors of so many roundings of the velocity are none."""


@functools.cache
def predictor_struct():
    """What is known of the steps before, per world."""

    @wp.struct
    class PredictorControl:
        order: wp.array(dtype=wp.int32)  # to begin the next step of the same size with
        count: wp.array(dtype=wp.int32)  # velocities that are known of steps of that size, at most 2
        kept: wp.array2d(dtype=wp.float64)  # of the state: order, count, size of the step, its end
        sums: wp.array2d(dtype=wp.float64)  # squared errors that orders 0, 1, 2 would have had; the velocity's square

    return PredictorControl


@functools.cache
def predictor_kernels(dtype: str, module: wp.Module) -> _types.SimpleNamespace:
    """Kernels in one precision, in the module of the step that they belong to."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    f64 = wp.float64
    Predictor, Step, Newton = predictor_struct(), step_struct(), control_struct()
    NOISE = (ROUNDINGS * {"float64": 2.0**-53, "float32": 2.0**-24}[dtype]) ** 2

    @wp.func
    def continued(order: int, v: vec3, before: vec3, first: vec3) -> vec3:
        if order == 2:
            return T(3.0) * (v - before) + first
        return T(2.0) * v - before

    @wp.kernel(module=module)
    def begin(predictor: Predictor, step: Step, newton: Newton):
        """What of the past counts for this attempt: only steps of its size, up to its start."""
        world = wp.tid()
        predictor.order[world] = 0
        predictor.count[world] = 0
        newton.predicted[world] = 0
        if step.running[world] == 0:
            return
        if predictor.kept[world, 2] == step.h[world] and predictor.kept[world, 3] == step.time[world]:
            predictor.order[world] = int(predictor.kept[world, 0])
            predictor.count[world] = int(predictor.kept[world, 1])
        newton.predicted[world] = wp.min(predictor.order[world], 1)

    @wp.kernel(module=module)
    def extrapolate(
        predictor: Predictor,
        step: Step,
        free: wp.array(dtype=vec3),
        v_n: wp.array2d(dtype=vec3),
        before: wp.array2d(dtype=vec3),
        first: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
    ):
        """The iterate on free components, where more than v_n is to be used."""
        world, slot = wp.tid()
        order = predictor.order[world]
        if step.running[world] == 0 or order == 0:
            return
        new = continued(order, v_n[world, slot], before[world, slot], first[world, slot])
        f = free[slot]
        old = v[world, slot]
        for k in range(3):
            if f[k] != T(0.0):
                old[k] = new[k]
        v[world, slot] = old

    @wp.kernel(module=module)
    def compare(
        predictor: Predictor,
        step: Step,
        free: wp.array(dtype=vec3),
        is_position: wp.array(dtype=T),
        diagonal: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        v_n: wp.array2d(dtype=vec3),
        before: wp.array2d(dtype=vec3),
        first: wp.array2d(dtype=vec3),
        rows: wp.array3d(dtype=f64),
    ):
        """Of an accepted step, before it becomes the state: squared errors of the orders in the norm of D."""
        world, slot = wp.tid()
        if step.accepted[world] == 0:
            return
        D = wp.cw_mul(diagonal[world, slot], free[slot])
        w = v[world, slot]
        a = v_n[world, slot]
        fall = (T(step.dq_dv[world]) * is_position[slot]) * vec3(step.gravity[world])
        e = w - a - fall
        if step.a1[world] > f64(0.0):  # a multistep scheme goes on as it went anyway
            e = w - continued(1, a, before[world, slot], first[world, slot])
        rows[0, world, slot] = f64(wp.dot(D, wp.cw_mul(e, e)))
        for order in range(1, 3):
            e = w - continued(order, a, before[world, slot], first[world, slot])
            rows[order, world, slot] = f64(wp.dot(D, wp.cw_mul(e, e)))
        rows[3, world, slot] = f64(wp.dot(D, wp.cw_mul(w, w)))

    @wp.kernel(module=module)
    def shift(
        step: Step,
        own: int,
        v_n: wp.array2d(dtype=vec3),
        before: wp.array2d(dtype=vec3),
        first: wp.array2d(dtype=vec3),
    ):
        """The past moves on; `own`: v_{n-1} too, which multistep schemes keep themselves."""
        world, slot = wp.tid()
        if step.accepted[world] != 0:
            first[world, slot] = before[world, slot]
            if own != 0:
                before[world, slot] = v_n[world, slot]

    @wp.kernel(module=module)
    def learn(predictor: Predictor, step: Step):
        """The order to begin the next step with."""
        world = wp.tid()
        if step.accepted[world] == 0:
            return
        count = predictor.count[world]
        best = int(0)  # noqa: RUF046 - a variable of the loop
        least = f64(BETTER) * predictor.sums[0, world]
        if predictor.sums[0, world] <= f64(NOISE) * predictor.sums[3, world]:
            least = f64(0.0)  # an extrapolated rounding would grow from step to step
        for order in range(1, 3):
            if order <= count and predictor.sums[order, world] < least:
                best = order
                least = f64(BETTER) * predictor.sums[order, world]
        predictor.kept[world, 0] = f64(best)
        predictor.kept[world, 1] = f64(wp.min(count + 1, 2))
        predictor.kept[world, 2] = step.h[world]
        predictor.kept[world, 3] = step.new_time[world]

    return _types.SimpleNamespace(begin=begin, extrapolate=extrapolate, compare=compare, shift=shift, learn=learn)
