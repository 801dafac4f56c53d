"""Step size control by an estimate of the local position error of a substep.

The error e of a substep h, a vector at each slot, gives the rate r = e / max(h, MIN_STEP_RATIO mean_step), with
`mean_step` the running mean of the accepted step sizes, and updates the slot's running mean m of the rates. The substep
is accepted if

    |m| <= limit and |r| <= RATE_RATIO limit, or |r| <= limit,    limit = ERROR_FRACTION tolerance / horizon,

at all slots, with the requested error as a length, `tolerance`: local errors then accumulate over the horizon to a
fraction of it. Errors of vibrations change sign and do not accumulate: since only their means are bounded, a vibration
below the requested error is not resolved. At a velocity jump e is of order h for any h, and e/h does not fall: the
lower bound of the denominator accepts it. In single precision the round-off of displacements is subtracted: at most
ROUNDING_UNITS eps |u| from e, and from the mean of n rates 1/n of that, as round-off does not accumulate, and no more
than the scatter of the rates. Where RATE_MEMORY rates leave more than the requested error over the horizon, round-off
dominates the estimates and the run fails: a falling pendulum of 1e9 Pa, asked for 1e-5, had errors of 0.25, 1.3 and 142
times that after 0.1, 0.2 and 0.4 s.
"""

import functools
import types as _types
from typing import Any

import warp as wp

from ..common.types import kernel_module, precision
from ..solvers.newton_control import FAIL_ERROR, FAIL_FLOOR, control_struct
from ..solvers.pcg import pcg_struct
from .step_control import step_span, step_struct

__all__ = ["CONTROL_STATE", "MAX_LEVEL", "STEP_STATISTICS", "adaptive_kernels", "adaptive_struct"]

CONTROL_STATE = ("next_step", "mean_step", "rate_count")
"""Columns of the control's state, [world, column]: the upper bound of the next substep, s, 0 at the start; mean step
size, s; number of substeps in the mean of rates, at most RATE_MEMORY."""
STEP_STATISTICS = ("substeps", "rejected", "least_h", "largest_h")
"""Columns of a step's report: accepted substeps, substeps rejected for their error, smallest and largest size, s."""
MAX_LEVEL = 26
"""Maximum halvings of the interval between synchronisation times; float32 times would not resolve smaller steps."""
ERROR_FRACTION = 0.5
"""Fraction of the requested error that the estimates may accumulate to: errors made early grow until the end."""
DOUBLING_RATIO = 0.7
"""Fraction of the tolerance below which a doubled step's predicted error allows the doubling."""
MAX_CUTS = 3
"""Maximum halvings of a rejected substep: for nonsmooth motions the estimate falls with a lower power of h."""
MIN_STEP_RATIO = 0.125
"""Lower bound of the step size in an error rate, over the mean step; 1 lets velocity errors of impacts accumulate."""
FIRST_STEP_ERROR = 0.1
"""Fraction of the requested error allowed for the first step of a multistep scheme, of order 1."""
MAX_SUBSTEPS = 65536
"""Maximum number of substeps between two synchronisation times."""
STEP_MEMORY = 256.0
"""Substeps in the running mean of step sizes."""
RATE_MEMORY = 16.0
"""Substeps in the running mean of rates."""
RATE_RATIO = 4.0
"""Bound of a single rate, over that of the mean rate."""
ROUNDING_UNITS = 2.0
"""Bound of the round-off in an estimate, in round-offs of the largest displacement."""


@functools.cache
def adaptive_struct():
    """Step size control data of each world."""

    @wp.struct
    class AdaptiveControl:
        flags: wp.array(dtype=wp.int32)  # 1: an estimate is requested
        span: wp.array(dtype=wp.float64)  # s, time in the error rate of this attempt
        rate: wp.array(dtype=wp.float64)  # largest rate of this attempt, m/s
        mean: wp.array(dtype=wp.float64)  # largest mean of rates including it, m/s
        scatter: wp.array(dtype=wp.float64)  # largest |rate - mean|, m/s
        moved: wp.array(dtype=wp.float64)  # largest displacement, m
        round_off_ratio: wp.array(dtype=wp.float64)  # round-off in a mean of rates, over its limit; above 1: failed
        tries: wp.array(dtype=wp.int32)  # consecutive rejections not due to the estimate
        work: wp.array(dtype=wp.int32)  # PCG iterations of the previous substeps
        kept: wp.array2d(dtype=wp.float64)  # CONTROL_STATE, in the state
        counts: wp.array2d(dtype=wp.float64)  # STEP_STATISTICS
        horizon: wp.array(dtype=wp.float64)  # [1] s, over which errors may accumulate
        first: wp.array(dtype=wp.float64)  # [1] s, size of the first substep
        tolerance: wp.float64  # m
        eps: wp.float64  # round-off unit of displacements
        max_tries: wp.int32

    return AdaptiveControl


@functools.cache
def adaptive_kernels(dtype: str, scheme: Any) -> _types.SimpleNamespace:
    """Kernels in one precision.

    Args:
        dtype: precision of the vectors.
        scheme: the time discretisation: `estimate`, a wp.func (h, previous h) -> weights of v_{n+1}, v_n and v_{n-1}
            that give its local error in position; `order`; `multistep`; `variant`.
    """
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    f64 = wp.float64
    span_of = step_span().span
    Step, Newton, PCG, Adaptive = step_struct(), control_struct(), pcg_struct(), adaptive_struct()
    estimate, order, multistep = scheme.error_weights, scheme.order, scheme.multistep
    module = kernel_module(f"adaptive_{dtype}_{scheme.kernel_variant}")

    @wp.func
    def refine(step: Step, next_step: f64, world: int):
        """Raise the level until substeps are no longer than `next_step`."""
        level = step.level[world]
        part = step.part[world]
        h = span_of(step, world) / f64(wp.lshift(1, level))
        while level < MAX_LEVEL and h > f64(1.000001) * next_step:
            h = f64(0.5) * h
            level = level + 1
            part = part * 2
        step.level[world] = level
        step.part[world] = part

    @wp.kernel(module=module)
    def open_step(step: Step, ctl: Adaptive):
        """Start the step of all running worlds with the substep size in the state."""
        world = wp.tid()
        for k in range(4):
            ctl.counts[world, k] = f64(0.0)
        ctl.tries[world] = 0
        ctl.work[world] = 0
        if step.running[world] == 0:
            return
        if ctl.kept[world, 0] == f64(0.0):
            ctl.kept[world, 0] = ctl.first[0]
            ctl.kept[world, 1] = ctl.first[0]
        refine(step, ctl.kept[world, 0], world)

    @wp.kernel(module=module)
    def begin_estimate(step: Step, newton: Newton, ctl: Adaptive):
        """Flag the worlds whose Newton iteration has converged."""
        world = wp.tid()
        good = step.running[world] != 0 and newton.failed[world] == 0 and newton.inverted[world] == 0
        ctl.flags[world] = wp.where(good, 1, 0)
        ctl.span[world] = wp.max(step.h[world], f64(MIN_STEP_RATIO) * ctl.kept[world, 1])
        ctl.rate[world] = f64(0.0)
        ctl.mean[world] = f64(0.0)
        ctl.scatter[world] = f64(0.0)
        ctl.moved[world] = f64(0.0)

    @wp.func
    def rate_of(step: Step, ctl: Adaptive, world: int, v: vec3, v_n: vec3, v_before: vec3) -> vec3:
        """Local error of a slot over the time span of the rate, m/s."""
        previous = f64(0.0)
        if wp.static(multistep):
            if step.a1[world] > f64(0.0):
                previous = step.previous_h[world]
        c = estimate(step.h[world], previous)
        # differences first: the velocities may be much larger
        e = T(c[0]) * (v - v_n)
        if wp.static(multistep):
            e -= T(c[2]) * (v_n - v_before)
        return T(f64(1.0) / ctl.span[world]) * e

    @wp.func
    def running_mean(ctl: Adaptive, world: int, mean: vec3, rate: vec3) -> vec3:
        """Running mean including one more rate, m/s."""
        part = f64(1.0) / wp.min(ctl.kept[world, 2] + f64(1.0), f64(RATE_MEMORY))
        return mean + T(part) * (rate - mean)

    @wp.func
    def finite_length(x: vec3) -> f64:
        """Length; 1e300 if not finite."""
        size = f64(wp.length(x))
        if not wp.isfinite(size):
            size = f64(1.0e300)
        return size

    @wp.kernel(module=module)
    def local_error(
        step: Step,
        ctl: Adaptive,
        arm: wp.array(dtype=T),
        free: wp.array(dtype=vec3),
        u: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        v_n: wp.array2d(dtype=vec3),
        v_before: wp.array2d(dtype=vec3),
        means: wp.array2d(dtype=vec3),
    ):
        """Largest rate, mean of rates and displacement over free slots. The maximum is independent of the order.

        `arm`: displacement over unknown: 1 for positions; half the section, m, for gradients across it; else 0. `free`:
        1, or 0 for prescribed components.
        """
        world, slot = wp.tid()
        if ctl.flags[world] == 0 or arm[slot] == T(0.0):
            return
        reach = arm[slot] * free[slot]
        rate = rate_of(step, ctl, world, v[world, slot], v_n[world, slot], v_before[world, slot])
        wp.atomic_max(ctl.rate, world, finite_length(wp.cw_mul(reach, rate)))
        mean = running_mean(ctl, world, means[world, slot], rate)
        wp.atomic_max(ctl.mean, world, finite_length(wp.cw_mul(reach, mean)))
        wp.atomic_max(ctl.scatter, world, finite_length(wp.cw_mul(reach, rate - mean)))
        wp.atomic_max(ctl.moved, world, finite_length(wp.cw_mul(reach, u[world, slot])))

    @wp.func
    def is_first_substep(step: Step, world: int) -> int:
        """1 if the substep is a multistep scheme's first, of order 1."""
        if wp.static(multistep):
            if step.a1[world] == f64(0.0):
                return 1
        return 0

    @wp.kernel(module=module)
    def keep_mean(
        step: Step,
        ctl: Adaptive,
        v: wp.array2d(dtype=vec3),
        v_n: wp.array2d(dtype=vec3),
        v_before: wp.array2d(dtype=vec3),
        means: wp.array2d(dtype=vec3),
    ):
        """Update the mean with the rate of an accepted substep; reset it after a substep of order 1."""
        world, slot = wp.tid()
        if step.accepted[world] == 0:
            return
        mean = vec3()
        if is_first_substep(step, world) == 0:
            rate = rate_of(step, ctl, world, v[world, slot], v_n[world, slot], v_before[world, slot])
            mean = running_mean(ctl, world, means[world, slot], rate)
        means[world, slot] = mean

    @wp.func
    def power(x: f64, n: int) -> f64:
        """x to the power n, n >= 1."""
        out = x
        for _k in range(1, n):
            out = out * x
        return out

    @wp.kernel(module=module)
    def control_step_size(step: Step, newton: Newton, pcg: PCG, ctl: Adaptive):
        """Reject a substep with too large an error; choose the size of the next."""
        world = wp.tid()
        if step.running[world] == 0:
            return
        h = step.h[world]
        if ctl.flags[world] == 0:
            ctl.kept[world, 0] = f64(0.5) * h
            ctl.tries[world] = ctl.tries[world] + 1
            if ctl.tries[world] > ctl.max_tries:
                step.level[world] = MAX_LEVEL  # no more halvings
            return
        mean_step = ctl.kept[world, 1]
        span = ctl.span[world]
        limit = f64(ERROR_FRACTION) * ctl.tolerance / ctl.horizon[0]
        round_off = f64(ROUNDING_UNITS) * ctl.eps * ctl.moved[world]
        ctl.round_off_ratio[world] = round_off * ctl.horizon[0] / (f64(RATE_MEMORY) * mean_step * ctl.tolerance)
        if ctl.round_off_ratio[world] > f64(1.0):
            newton.failed[world] = FAIL_FLOOR  # not halved
            return
        rounding = round_off / span
        rate = wp.max(ctl.rate[world] - rounding, f64(0.0))
        part = f64(1.0) / wp.min(ctl.kept[world, 2] + f64(1.0), f64(RATE_MEMORY))
        mean = wp.max(ctl.mean[world] - part * wp.min(rounding, ctl.scatter[world]), f64(0.0))
        effective_rate = wp.max(mean, rate / f64(RATE_RATIO))
        ratio = wp.min(rate, effective_rate) / limit
        n = wp.static(order) + 1
        if is_first_substep(step, world) != 0:
            n = 2
            ratio = rate / wp.max(limit, f64(FIRST_STEP_ERROR) * ctl.tolerance / span)
        if ctl.counts[world, 0] >= f64(MAX_SUBSTEPS):
            ratio = f64(wp.inf)
        if not ratio <= f64(1.0):
            newton.failed[world] = FAIL_ERROR
            ctl.counts[world, 1] = ctl.counts[world, 1] + f64(1.0)
            if ctl.counts[world, 0] + ctl.counts[world, 1] > f64(MAX_SUBSTEPS):
                step.level[world] = MAX_LEVEL  # no more halvings
            next_step = f64(0.5) * h
            half = f64(1.0) / power(f64(2.0), n)
            ratio = ratio * half
            for _k in range(1, MAX_CUTS):
                if ratio > f64(1.0):
                    ratio = ratio * half
                    next_step = f64(0.5) * next_step
            ctl.kept[world, 0] = next_step
            return
        ctl.tries[world] = 0
        ctl.work[world] = ctl.work[world] + pcg.total[world]
        pcg.total[world] = 0
        double = f64(2.0) * h
        longer = wp.max(double, f64(MIN_STEP_RATIO) * mean_step)
        if effective_rate * (power(f64(2.0), n) * span / longer) <= f64(DOUBLING_RATIO) * limit:
            ctl.kept[world, 0] = double
        else:
            ctl.kept[world, 0] = h
        ctl.kept[world, 1] = mean_step + (h - mean_step) / f64(STEP_MEMORY)
        if ctl.counts[world, 0] == f64(0.0) or h < ctl.counts[world, 2]:
            ctl.counts[world, 2] = h
        ctl.counts[world, 3] = wp.max(ctl.counts[world, 3], h)
        ctl.counts[world, 0] = ctl.counts[world, 0] + f64(1.0)

    @wp.kernel(module=module)
    def refine_substeps(step: Step, ctl: Adaptive):
        """After an attempt: update the count of rates, refine the substeps to at most the bound.

        A rejected step returns to the state at its start.
        """
        world = wp.tid()
        step.first_refusal[world] = 0
        if step.accepted[world] != 0:
            seen = wp.min(ctl.kept[world, 2] + f64(1.0), f64(RATE_MEMORY))
            ctl.kept[world, 2] = wp.where(is_first_substep(step, world) != 0, f64(0.0), seen)
        if step.running[world] != 0:
            refine(step, ctl.kept[world, 0], world)

    @wp.kernel(module=module)
    def close_step(pcg: PCG, ctl: Adaptive):
        """PCG iterations of all substeps, for the report."""
        world = wp.tid()
        pcg.total[world] = pcg.total[world] + ctl.work[world]

    return _types.SimpleNamespace(
        module=module,
        open_step=open_step,
        begin_estimate=begin_estimate,
        local_error=local_error,
        keep_mean=keep_mean,
        control_step_size=control_step_size,
        refine_substeps=refine_substeps,
        close_step=close_step,
    )
