"""Step control data of each world, report columns, time integration coefficients."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64

__all__ = [
    "GROWTH_COLUMNS",
    "REPORT_COLUMNS",
    "SAME_TIME_FRACTION",
    "STATUS",
    "Coefficients",
    "step_end_functions",
    "step_struct",
]

STATUS = {"running": 0, "failed": 1, "frozen": 2}

REPORT_COLUMNS = (
    "status",
    "newton",
    "pcg",
    "residual",
    "halvings",
    "min_J",
    "time",
    "failure",
    "attempt_time",
    "violation",
    "outer",
    "residual_force",
    "rough",
    "floor",
    "energy_growth",
)
"""Columns of the report of a step, [world, column] in float64; probes follow."""

SAME_TIME_FRACTION = 1e-6
"""Times closer than this fraction of a step are equal."""
GROWTH_COLUMNS = ("share", "largest", "turnover", "added", "since", "steps", "next")
"""Columns of the monitor of spurious energy growth: energy added by integrator and residuals over the peak energy;
largest stored energy, J; sum of |work| and viscous loss, J; added energy, J; time at which the fraction first exceeded
`growth_warn_limit`, s; substeps since the onset of loads; sum of |work| and loss, J, at the next onset."""


@wp.struct
class Coefficients:
    """Coefficients of a time discretisation.

    q~ = a0 q_n - a1 q_{n-1} + b v_n + q_a a_n and v~ = a0 v_n - a1 v_{n-1} + v_a a_n + v_w w_n; a_n are algorithmic
    accelerations, a_{n+1} = a_v (v - v_n) - a_a a_n, and w_n those of the equilibrium, q''.
    """

    a0: wp.float64
    a1: wp.float64
    b: wp.float64  # s
    dq_dv: wp.float64  # s
    mass_factor: wp.float64  # 1/s
    q_a: wp.float64  # s^2
    v_a: wp.float64  # s
    v_w: wp.float64  # s
    a_v: wp.float64  # 1/s
    a_a: wp.float64


@functools.cache
def step_struct():
    """Step control data of each world."""

    @wp.struct
    class StepControl:
        status: wp.array(dtype=wp.int32)  # STATUS
        running: wp.array(dtype=wp.int32)  # this step is unfinished
        halving_level: wp.array(dtype=wp.int32)  # substeps of dt / 2^level
        substep_index: wp.array(dtype=wp.int32)  # number of finished substeps, at this level
        halvings: wp.array(dtype=wp.int32)  # of this step
        rejected: wp.array(dtype=wp.int32)  # this attempt was
        accepted: wp.array(dtype=wp.int32)  # this attempt was
        first_rejection: wp.array(dtype=wp.int32)  # this attempt was the first of the step to be rejected
        time: wp.array(dtype=wp.float64)  # s, state
        summed_time: wp.array(dtype=wp.float64)  # s, state: sum of the steps, where `time` was snapped to an end nearby
        run_end: wp.array(dtype=wp.float64)  # [2] s: end of the run, inf without; round-off of its times
        world_end: wp.array(dtype=wp.float64)  # s, end of each world, if set
        new_time: wp.array(dtype=wp.float64)  # s, end of the attempt
        stage_time: wp.array(dtype=wp.float64)  # its midpoint, for midpoint schemes
        rate_time: wp.array(dtype=wp.float64)  # s, of strain rates: dq/dv, of midpoint schemes h/2
        step_start_time: wp.array(dtype=wp.float64)  # s
        h: wp.array(dtype=wp.float64)  # s, size of the substep
        previous_h: wp.array(dtype=wp.float64)  # of schemes with a history; 0 before the first step
        impact: wp.array(dtype=wp.int32)  # of schemes with a history, with contact: IMPACT_FOUND, IMPACT_REPEATED, or 0
        previous_end_time: wp.array(dtype=wp.float64)  # end time of the previous step, of schemes that use its state
        dt: wp.array(dtype=wp.float64)  # s, size of the step
        a0: wp.array(dtype=wp.float64)  # q~ = a0 q_n - a1 q_{n-1} + b v_n
        a1: wp.array(dtype=wp.float64)
        b: wp.array(dtype=wp.float64)  # of schemes with v_n in q~
        q_a: wp.array(dtype=wp.float64)  # of schemes with accelerations in their state
        acceleration_step: wp.array(dtype=wp.float64)  # s: the step that led to a_n, or to v_n with contact; 0: unknown
        dq_dv: wp.array(dtype=wp.float64)  # s
        mass_factor: wp.array(dtype=wp.float64)  # c_M of the inertia; in statics of the springs, `stabilisation`
        load_factor: wp.array(dtype=wp.float64)  # factor of constant loads; 1 in dynamics
        gravity: wp.array(dtype=wp.vec3d)  # m/s^2
        any_running: wp.array(dtype=wp.int32)  # [1]
        any_rejected: wp.array(dtype=wp.int32)  # [2] any first rejection in the step; any final failure
        max_halvings: wp.int32  # largest `halving_level`
        newton_budget: wp.int32  # Newton iterations in a step after which it is not halved; 0: no limit
        scheme_parameter: wp.float64  # of the integrator
        stabilisation: wp.float64  # N/m per kg, statics: springs from the last equilibrium, none at full load
        step_min_J: wp.array(dtype=wp.float64)  # smallest J of the accepted substeps
        ledger_time: wp.array(dtype=wp.float64)  # s, time of the last ledger update
        energy_growth: wp.array2d(dtype=wp.float64)  # [world, GROWTH_COLUMNS], in the state; if monitored
        growth_monitored: wp.int32  # 1: energy growth is monitored
        residual_work_counted: wp.float64  # 1: as energy growth; 0: not, as a drive balances the work of residuals
        growth_warn_limit: wp.float64  # fraction of the energy at which the time is recorded
        growth_limit: wp.float64  # fraction above which the run fails
        min_energy: wp.array(dtype=wp.float64)  # [world] J, round-off level of the energy

    return StepControl


@functools.cache
def step_end_functions() -> KernelSet:
    """Device functions: time at which a run or world ends, its tolerance, and the step that matches it."""
    Step = step_struct()

    @wp.func
    def end_time(step: Step, world: int) -> f64:
        """End of the run or of the world, s."""
        first = step.run_end[0]
        if step.world_end:
            first = wp.min(first, step.world_end[world])
        return first

    @wp.func
    def time_tolerance(step: Step, world: int) -> f64:
        """Time tolerance, s."""
        return wp.max(f64(SAME_TIME_FRACTION) * step.dt[world], step.run_end[1])

    @wp.func
    def step_length(step: Step, world: int) -> f64:
        """Length of the step, s: dt, or the remainder to the end."""
        left = end_time(step, world) - step.step_start_time[world]
        if left < step.dt[world] - time_tolerance(step, world):
            return left
        return step.dt[world]

    return kernel_set(locals())
