"""Episodes of reinforcement learning on the device: ends, run statistics, masked copies, observations."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_1d, double_2d, f64, int_1d, mat33d, precision, vec3d, vec3d_1d
from ..terms.joint_angles import joint_vector_function
from ..terms.spring_coordinates import ANGLE, LENGTH, TRAVEL, coordinate_functions
from .step_control import REPORT_COLUMNS, SAME_TIME_FRACTION, STATUS

__all__ = ["JOINT_VALUE_KINDS", "MOTION_KINDS", "RUN_STATISTICS", "episode_kernels", "observation_kernels"]

RUN_STATISTICS = ("newton", "pcg", "rough", "floored", "residual", "floor", "violation", "energy_growth", "min_J")
"""Columns of the run statistics: sums, then maxima, then minima."""
FIRST_MINIMUM_COLUMN = 8
MOTION_KINDS = {"position": 0, "displacement": 1, "velocity": 2}
"""Kinds of observed vectors."""
RATE = 8
JOINT_VALUE_KINDS = {"length": LENGTH, "travel": TRAVEL, "angle": ANGLE}
JOINT_VALUE_KINDS |= {f"{name}_rate": RATE + kind for name, kind in JOINT_VALUE_KINDS.items()}
"""Kinds of values of joints: coordinates of ../terms/spring_coordinates.py, and their rates."""


@functools.cache
def episode_kernels() -> KernelSet:
    """Kernels with one thread per world."""
    module = kernel_module("loops", light=True)
    column = {name: REPORT_COLUMNS.index(name) for name in REPORT_COLUMNS}
    running = STATUS["running"]

    @wp.kernel(module=module)
    def end_episodes(time: double_1d, t_end: double_1d, dt: double_1d, status: int_1d):
        """Freeze the worlds that have reached their end time."""
        world = wp.tid()
        if status[world] == wp.static(running) and time[world] >= t_end[world] - f64(SAME_TIME_FRACTION) * dt[world]:
            status[world] = wp.static(STATUS["frozen"])

    @wp.kernel(module=module)
    def add_statistics(report: double_2d, sums: double_2d, stepped: int_1d):
        """Add a step to the run statistics."""
        world = wp.tid()
        status = wp.int32(report[world, wp.static(column["status"])])
        sums[world, 0] += report[world, wp.static(column["newton"])]
        sums[world, 1] += report[world, wp.static(column["pcg"])]
        if status == wp.static(STATUS["failed"]):
            stepped[world] = 0
        sums[world, 7] = wp.max(sums[world, 7], report[world, wp.static(column["energy_growth"])])
        if status != wp.static(running):
            return
        stepped[world] = 1
        floor = report[world, wp.static(column["floor"])]
        sums[world, 2] += wp.where(report[world, wp.static(column["rough"])] != f64(0.0), f64(1.0), f64(0.0))
        sums[world, 3] += wp.where(floor > f64(0.0), f64(1.0), f64(0.0))
        sums[world, 4] = wp.max(sums[world, 4], report[world, wp.static(column["residual"])])
        sums[world, 5] = wp.max(sums[world, 5], floor)
        sums[world, 6] = wp.max(sums[world, 6], report[world, wp.static(column["violation"])])
        sums[world, 8] = wp.min(sums[world, 8], report[world, wp.static(column["min_J"])])

    @wp.kernel(module=module)
    def clear_statistics(sums: double_2d):
        """Reset the run statistics."""
        world, k = wp.tid()
        sums[world, k] = wp.where(k < wp.static(FIRST_MINIMUM_COLUMN), f64(0.0), f64(wp.inf))

    @masked_kernel(module, "flags")
    def copy_flagged(flags: int_1d, source: double_1d, target: double_1d):
        """Copy a number in the flagged worlds."""
        world = wp.tid()
        target[world] = source[world]

    @masked_kernel(module, "flags")
    def clear_flagged(flags: int_1d, target: int_1d):
        """Clear a flag in the flagged worlds."""
        world = wp.tid()
        target[world] = 0

    return kernel_set(locals())


@functools.cache
def observation_kernels(dtype: str) -> KernelSet:
    """Kernels in one precision that fill a table [world, column]."""
    p, joint_vector = precision(dtype), joint_vector_function(dtype)
    of_joint = coordinate_functions(False)
    T, vec3 = p.T, p.vec3
    module = kernel_module(f"observations_{dtype}")

    @wp.kernel(module=module)
    def point_motions(
        start: int_1d, slot: int_1d, weight: double_1d,
        kind: int_1d, place: vec3d_1d, column: int_1d,
        u: p.vec3_2d, v: p.vec3_2d, out: p.scalar_2d,
    ):  # fmt: skip
        """Positions, displacements and velocities of points, sums of s_i u_i."""
        world, k = wp.tid()
        x = vec3d()
        if kind[k] == wp.static(MOTION_KINDS["position"]):
            x = place[k]
        for i in range(start[k], start[k + 1]):
            if kind[k] == wp.static(MOTION_KINDS["velocity"]):
                x += weight[i] * vec3d(v[world, slot[i]])
            else:
                x += weight[i] * vec3d(u[world, slot[i]])
        for c in range(3):
            out[world, column[k] + c] = T(x[c])

    @wp.kernel(module=module)
    def report_columns(
        source: int_1d, column: int_1d, report: double_2d,
        stepped: int_1d, out: p.scalar_2d,
    ):  # fmt: skip
        """Columns of the report of the last step; 0 without a step."""
        world, k = wp.tid()
        out[world, column[k]] = wp.where(stepped[world] != 0, T(report[world, source[k]]), T(0.0))

    @wp.kernel(module=module)
    def joint_values(
        start: int_1d, slot: int_1d, weight: double_1d, place: vec3d_1d, kind: int_1d, source: int_1d, column: int_1d,
        u: p.vec3_2d, v: p.vec3_2d, target: double_2d, turns: double_2d, out: p.scalar_2d,
    ):  # fmt: skip
        """Lengths, travels and angles from three vectors each, or their rates; `source` of turns: row of a drive,
        -2 - column of `turns`, or -1."""
        world, k = wp.tid()
        V, D = mat33d(), mat33d()
        for side in range(3):
            V[side] = joint_vector(start, slot, weight, place[3 * k + side], u, world, 3 * k + side)
            D[side] = joint_vector(start, slot, weight, vec3d(), v, world, 3 * k + side)
        of = kind[k] % RATE
        near = f64(0.0)
        if source[k] >= 0 and not wp.isnan(target[world, source[k]]):
            near = target[world, source[k]]
        elif source[k] < -1:
            near = turns[world, -2 - source[k]]
        x = of_joint.coordinate(of, V, near)
        if kind[k] >= RATE:
            x = wp.ddot(of_joint.derivatives(of, V, x).g, D)
        out[world, column[k]] = T(x)

    @wp.kernel(module=module)
    def world_values(values: double_1d, column: int, out: p.scalar_2d):
        """Copy of a number of each world."""
        world = wp.tid()
        out[world, column] = T(values[world])

    return kernel_set(locals())
