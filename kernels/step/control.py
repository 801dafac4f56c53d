"""What the step loop knows of each world, and what it reports."""

import functools

import warp as wp

__all__ = ["REPORT", "STATUS", "Coefficients", "step_struct"]

STATUS = {"running": 0, "failed": 1, "frozen": 2}

REPORT = (
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
)
"""Columns of the report of a step, [world, column] in float64; probes follow."""


@wp.struct
class Coefficients:
    """Of a time discretisation.

    q~ = a0 q_n - a1 q_{n-1} + b v_n + q_a a_n and v~ = a0 v_n - a1 v_{n-1} + v_a a_n + v_w w_n; a_n are
    algorithmic accelerations, a_{n+1} = a_v (v - v_n) - a_a a_n, and w_n those of the equilibrium, q''.
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
    """What the step loop knows of each world."""

    @wp.struct
    class StepControl:
        status: wp.array(dtype=wp.int32)  # STATUS
        running: wp.array(dtype=wp.int32)  # this step is not finished
        level: wp.array(dtype=wp.int32)
        part: wp.array(dtype=wp.int32)  # substeps of the level that are done
        halvings: wp.array(dtype=wp.int32)
        refused: wp.array(dtype=wp.int32)  # in this attempt
        accepted: wp.array(dtype=wp.int32)
        first_refusal: wp.array(dtype=wp.int32)
        time: wp.array(dtype=wp.float64)  # s, state
        new_time: wp.array(dtype=wp.float64)  # end of the attempt
        stage_time: wp.array(dtype=wp.float64)  # its middle, of schemes that take forces there
        step_start: wp.array(dtype=wp.float64)
        h: wp.array(dtype=wp.float64)
        previous_h: wp.array(dtype=wp.float64)  # state of multistep schemes; 0 before the first step
        previous_end: wp.array(dtype=wp.float64)  # time that the step before ended at, of schemes that keep its state
        dt: wp.array(dtype=wp.float64)
        a0: wp.array(dtype=wp.float64)  # q~ = a0 q_n - a1 q_{n-1} + b v_n
        a1: wp.array(dtype=wp.float64)
        b: wp.array(dtype=wp.float64)  # of schemes that take v_n
        q_a: wp.array(dtype=wp.float64)  # of schemes that keep accelerations
        h_before: wp.array(dtype=wp.float64)  # of those: s, the step that led to a_n, not far below this one
        dq_dv: wp.array(dtype=wp.float64)
        mass_factor: wp.array(dtype=wp.float64)  # of the inertia; in statics that of springs, `stabilise`
        ramp: wp.array(dtype=wp.float64)  # factor of constant loads
        gravity: wp.array(dtype=wp.vec3d)
        any_running: wp.array(dtype=wp.int32)
        any_refused: wp.array(dtype=wp.int32)  # for the first time in the step; for good
        max_halvings: wp.int32
        parameter: wp.float64  # of the integrator
        stabilise: wp.float64  # N/m per kg, of statics: springs from the last equilibrium, none at full load
        total_J: wp.array(dtype=wp.float64)
        ledger_time: wp.array(dtype=wp.float64)  # s, what the ledger was last brought up to

    return StepControl
