"""Step size control by an estimate of the local position error of a substep.

The error e of a substep h, a vector at each slot, gives the rate r = e / max(h, MIN_STEP_RATIO mean_step), with
`mean_step` the running mean of the accepted step sizes, and updates the slot's running mean m of the rates. The substep
is accepted if

    |m| <= limit and |r| <= RATE_RATIO limit, or |r| <= limit,    limit = ERROR_FRACTION tolerance / horizon,

at all slots, with `tolerance` the requested error as a length, m: local errors then accumulate over the horizon to a
fraction of it. Errors of vibrations change sign and do not accumulate: since only their means are bounded, a vibration
below the requested error is not resolved. At a velocity jump e is of order h for any h, and e/h does not fall: the
lower bound of the denominator accepts it. In single precision the round-off of displacements is subtracted: at most
ROUNDING_UNITS eps |u| from e, and from the mean of n rates 1/n of that, as round-off does not accumulate, and no more
than the scatter of the rates. Where RATE_MEMORY rates leave more than the requested error over the horizon, round-off
dominates the estimates and the run fails: a falling pendulum of 1e9 Pa, asked for 1e-5, had errors of 0.25, 1.3 and 142
times that after 0.1, 0.2 and 0.4 s.
"""

import functools
from typing import Any

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import f64, precision
from ..solvers.newton_control import Failure, control_struct
from ..solvers.pcg import pcg_struct
from .step_control import step_end_functions, step_struct

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
MAX_REJECTION_HALVINGS = 3
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
"""Bound of a single rate, over the bound of the mean rate."""
ROUNDING_UNITS = 2.0
"""Bound of the round-off in an estimate, in round-offs of the largest displacement."""


@functools.cache
def adaptive_struct():
    """Step size control data of each world."""

    @wp.struct
    class AdaptiveControl:
        estimate_requested: wp.array(dtype=wp.int32)  # 1: the attempt has converged, and its error is estimated
        rate_span: wp.array(dtype=wp.float64)  # s, time in the error rate of this attempt
        max_rate: wp.array(dtype=wp.float64)  # largest rate of this attempt, m/s
        max_mean_rate: wp.array(dtype=wp.float64)  # largest running mean of rates, this attempt included, m/s
        max_rate_scatter: wp.array(dtype=wp.float64)  # largest |rate - mean|, m/s
        max_displacement: wp.array(dtype=wp.float64)  # largest displacement, m
        round_off_ratio: wp.array(dtype=wp.float64)  # round-off in a mean of rates, over its limit; above 1: failed
        retries: wp.array(dtype=wp.int32)  # consecutive rejections not due to the estimate
        pcg_iterations: wp.array(dtype=wp.int32)  # PCG iterations of the previous substeps
        control_state: wp.array2d(dtype=wp.float64)  # [world, CONTROL_STATE], in the state
        statistics: wp.array2d(dtype=wp.float64)  # [world, STEP_STATISTICS]
        horizon: wp.array(dtype=wp.float64)  # [1] s, over which errors may accumulate
        first_substep: wp.array(dtype=wp.float64)  # [1] s, size of the first substep
        tolerance: wp.float64  # m
        eps: wp.float64  # round-off unit of displacements
        max_retries: wp.int32  # of `retries`, after which the step fails

    return AdaptiveControl


@functools.cache
def adaptive_kernels(dtype: str, scheme: Any) -> KernelSet:
    """Kernels in one precision.

    Args:
        dtype: precision of the vectors.
        scheme: the time discretisation: `estimate`, a wp.func (h, previous h) -> weights, s, of v_{n+1}, v_n, v_{n-1}
            that sum to 0 and give its local error in position; `order`; `multistep`; `variant`.
    """
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    step_length = step_end_functions().step_length
    Step, Newton, PCG, Adaptive = step_struct(), control_struct(), pcg_struct(), adaptive_struct()
    estimate, order, multistep = scheme.error_weights, scheme.order, scheme.multistep
    module = kernel_module(f"adaptive_{dtype}_{scheme.kernel_variant}")

    @wp.func
    def refine_level(step: Step, next_step: f64, world: int):
        """Raise the level until substeps are no longer than `next_step`."""
        level = step.halving_level[world]
        part = step.substep_index[world]
        h = step_length(step, world) / f64(wp.lshift(1, level))
        while level < MAX_LEVEL and h > f64(1.000001) * next_step:
            h = f64(0.5) * h
            level = level + 1
            part = part * 2
        step.halving_level[world] = level
        step.substep_index[world] = part

    @wp.kernel(module=module)
    def begin_step_control(step: Step, ctl: Adaptive):
        """Start the step of all running worlds with the substep size in the state."""
        world = wp.tid()
        for k in range(4):
            ctl.statistics[world, k] = f64(0.0)
        ctl.retries[world] = 0
        ctl.pcg_iterations[world] = 0
        if step.running[world] == 0:
            return
        if ctl.control_state[world, 0] == f64(0.0):
            ctl.control_state[world, 0] = ctl.first_substep[0]
            ctl.control_state[world, 1] = ctl.first_substep[0]
        refine_level(step, ctl.control_state[world, 0], world)

    @wp.kernel(module=module)
    def begin_estimate(step: Step, newton: Newton, ctl: Adaptive):
        """Flag the worlds whose Newton iteration has converged."""
        world = wp.tid()
        good = step.running[world] != 0 and newton.failed[world] == 0 and newton.inverted[world] == 0
        ctl.estimate_requested[world] = wp.where(good, 1, 0)
        ctl.rate_span[world] = wp.max(step.h[world], f64(MIN_STEP_RATIO) * ctl.control_state[world, 1])
        ctl.max_rate[world] = f64(0.0)
        ctl.max_mean_rate[world] = f64(0.0)
        ctl.max_rate_scatter[world] = f64(0.0)
        ctl.max_displacement[world] = f64(0.0)

    @wp.func
    def error_rate(step: Step, ctl: Adaptive, world: int, v: vec3, v_n: vec3, v_before: vec3) -> vec3:
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
        return T(f64(1.0) / ctl.rate_span[world]) * e

    @wp.func
    def running_mean(ctl: Adaptive, world: int, mean: vec3, rate: vec3) -> vec3:
        """Running mean including one more rate, m/s."""
        part = f64(1.0) / wp.min(ctl.control_state[world, 2] + f64(1.0), f64(RATE_MEMORY))
        return mean + T(part) * (rate - mean)

    @wp.func
    def finite_length(x: vec3) -> f64:
        """Length; 1e300 if not finite."""
        size = f64(wp.length(x))
        if not wp.isfinite(size):
            size = f64(1.0e300)
        return size

    @wp.kernel(module=module)
    def max_error_rates(
        step: Step, ctl: Adaptive, displacement_factor: p.scalar_1d, free: p.vec3_1d, u: p.vec3_2d, v: p.vec3_2d,
        v_n: p.vec3_2d, v_before: p.vec3_2d, means: p.vec3_2d,
    ):  # fmt: skip
        """Largest rate, mean of rates and displacement over free slots. The maximum is independent of the order.

        `displacement_factor`: from an unknown to a displacement: 1 for positions; half the size of the section, m, for
        position gradients across it; 0 for unknowns that are not controlled. `free`: 1 for free components, else 0.
        """
        world, slot = wp.tid()
        if ctl.estimate_requested[world] == 0 or displacement_factor[slot] == T(0.0):
            return
        reach = displacement_factor[slot] * free[slot]
        rate = error_rate(step, ctl, world, v[world, slot], v_n[world, slot], v_before[world, slot])
        wp.atomic_max(ctl.max_rate, world, finite_length(wp.cw_mul(reach, rate)))
        mean = running_mean(ctl, world, means[world, slot], rate)
        wp.atomic_max(ctl.max_mean_rate, world, finite_length(wp.cw_mul(reach, mean)))
        wp.atomic_max(ctl.max_rate_scatter, world, finite_length(wp.cw_mul(reach, rate - mean)))
        wp.atomic_max(ctl.max_displacement, world, finite_length(wp.cw_mul(reach, u[world, slot])))

    @wp.func
    def is_first_substep(step: Step, world: int) -> int:
        """1 if the substep is a multistep scheme's first, of order 1."""
        if wp.static(multistep):
            if step.a1[world] == f64(0.0):
                return 1
        return 0

    @masked_kernel(module, "step.accepted")
    def update_mean_rates(
        step: Step, ctl: Adaptive, v: p.vec3_2d, v_n: p.vec3_2d, v_before: p.vec3_2d, means: p.vec3_2d
    ):
        """Update the mean with the rate of an accepted substep; reset it after a substep of order 1."""
        world, slot = wp.tid()
        mean = vec3()
        if is_first_substep(step, world) == 0:
            rate = error_rate(step, ctl, world, v[world, slot], v_n[world, slot], v_before[world, slot])
            mean = running_mean(ctl, world, means[world, slot], rate)
        means[world, slot] = mean

    @wp.func
    def integer_power(x: f64, n: int) -> f64:
        """x to the power n, n >= 1."""
        out = x
        for _k in range(1, n):
            out = out * x
        return out

    @masked_kernel(module, "step.running")
    def control_step_size(step: Step, newton: Newton, pcg: PCG, ctl: Adaptive):
        """Reject a substep with too large an error; choose the size of the next."""
        world = wp.tid()
        h = step.h[world]
        if ctl.estimate_requested[world] == 0:
            ctl.control_state[world, 0] = f64(0.5) * h
            ctl.retries[world] = ctl.retries[world] + 1
            if ctl.retries[world] > ctl.max_retries:
                step.halving_level[world] = MAX_LEVEL  # no more halvings
            return
        mean_step = ctl.control_state[world, 1]
        span = ctl.rate_span[world]
        limit = f64(ERROR_FRACTION) * ctl.tolerance / ctl.horizon[0]
        round_off = f64(ROUNDING_UNITS) * ctl.eps * ctl.max_displacement[world]
        ctl.round_off_ratio[world] = round_off * ctl.horizon[0] / (f64(RATE_MEMORY) * mean_step * ctl.tolerance)
        if ctl.round_off_ratio[world] > f64(1.0):
            newton.failed[world] = Failure.ROUNDOFF  # the run fails: a smaller step would not help
            return
        rounding = round_off / span
        rate = wp.max(ctl.max_rate[world] - rounding, f64(0.0))
        part = f64(1.0) / wp.min(ctl.control_state[world, 2] + f64(1.0), f64(RATE_MEMORY))
        mean = wp.max(ctl.max_mean_rate[world] - part * wp.min(rounding, ctl.max_rate_scatter[world]), f64(0.0))
        effective_rate = wp.max(mean, rate / f64(RATE_RATIO))  # both conditions of the header in one number
        ratio = wp.min(rate, effective_rate) / limit
        n = wp.static(order) + 1
        if is_first_substep(step, world) != 0:
            n = 2
            ratio = rate / wp.max(limit, f64(FIRST_STEP_ERROR) * ctl.tolerance / span)
        if ctl.statistics[world, 0] >= f64(MAX_SUBSTEPS):
            ratio = f64(wp.inf)
        if not ratio <= f64(1.0):
            newton.failed[world] = Failure.LOCAL_ERROR
            ctl.statistics[world, 1] = ctl.statistics[world, 1] + f64(1.0)
            if ctl.statistics[world, 0] + ctl.statistics[world, 1] > f64(MAX_SUBSTEPS):
                step.halving_level[world] = MAX_LEVEL  # no more halvings
            next_step = f64(0.5) * h
            half = f64(1.0) / integer_power(f64(2.0), n)
            ratio = ratio * half
            for _k in range(1, MAX_REJECTION_HALVINGS):
                if ratio > f64(1.0):
                    ratio = ratio * half
                    next_step = f64(0.5) * next_step
            ctl.control_state[world, 0] = next_step
            return
        ctl.retries[world] = 0
        ctl.pcg_iterations[world] = ctl.pcg_iterations[world] + pcg.step_iterations[world]
        pcg.step_iterations[world] = 0
        double = f64(2.0) * h
        longer = wp.max(double, f64(MIN_STEP_RATIO) * mean_step)
        if effective_rate * (integer_power(f64(2.0), n) * span / longer) <= f64(DOUBLING_RATIO) * limit:
            ctl.control_state[world, 0] = double
        else:
            ctl.control_state[world, 0] = h
        ctl.control_state[world, 1] = mean_step + (h - mean_step) / f64(STEP_MEMORY)
        if ctl.statistics[world, 0] == f64(0.0) or h < ctl.statistics[world, 2]:
            ctl.statistics[world, 2] = h
        ctl.statistics[world, 3] = wp.max(ctl.statistics[world, 3], h)
        ctl.statistics[world, 0] = ctl.statistics[world, 0] + f64(1.0)

    @wp.kernel(module=module)
    def refine_substeps(step: Step, ctl: Adaptive):
        """After an attempt: update the count of rates, refine the substeps to at most the bound in `control_state`."""
        world = wp.tid()
        step.first_rejection[world] = 0
        if step.accepted[world] != 0:
            rate_count = wp.min(ctl.control_state[world, 2] + f64(1.0), f64(RATE_MEMORY))
            ctl.control_state[world, 2] = wp.where(is_first_substep(step, world) != 0, f64(0.0), rate_count)
        if step.running[world] != 0:
            refine_level(step, ctl.control_state[world, 0], world)

    @wp.kernel(module=module)
    def report_pcg_iterations(pcg: PCG, ctl: Adaptive):
        """Add the PCG iterations of the previous substeps to those of the last one, for the report."""
        world = wp.tid()
        pcg.step_iterations[world] = pcg.step_iterations[world] + ctl.pcg_iterations[world]

    return kernel_set(locals())
