"""Episodes of reinforcement learning on the device: ends, run statistics, masked copies, observations."""

import functools
import math
import types as _types

import warp as wp

from ..common.types import kernel_module, precision
from .step_control import REPORT_COLUMNS, SAME_TIME_FRACTION, STATUS

__all__ = ["JOINT_VALUE_KINDS", "MOTION_KINDS", "RUN_STATISTICS", "episode_kernels", "observation_kernels"]

RUN_STATISTICS = ("newton", "pcg", "rough", "floored", "residual", "floor", "violation", "energy_growth", "min_J")
"""Columns of the run statistics: sums, then maxima, then minima."""
FIRST_MINIMUM_COLUMN = 8
MOTION_KINDS = {"position": 0, "displacement": 1, "velocity": 2}
"""Kinds of observed vectors."""
FULL_TURN = 2.0 * math.pi
JOINT_VALUE_KINDS = {"length": 0, "travel": 1, "angle": 2}
"""Kinds of values of joints."""


@functools.cache
def episode_kernels() -> _types.SimpleNamespace:
    """Kernels with one thread per world."""
    f64 = wp.float64
    module = kernel_module("loops", light=True)
    column = {name: REPORT_COLUMNS.index(name) for name in REPORT_COLUMNS}
    running = STATUS["running"]

    @wp.kernel(module=module)
    def end_episodes(
        time: wp.array(dtype=f64), t_end: wp.array(dtype=f64), dt: wp.array(dtype=f64), status: wp.array(dtype=wp.int32)
    ):
        """Freeze the worlds that have reached their end time."""
        world = wp.tid()
        if status[world] == wp.static(running) and time[world] >= t_end[world] - f64(SAME_TIME_FRACTION) * dt[world]:
            status[world] = wp.static(STATUS["frozen"])

    @wp.kernel(module=module)
    def add_statistics(report: wp.array2d(dtype=f64), sums: wp.array2d(dtype=f64), stepped: wp.array(dtype=wp.int32)):
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
    def clear_statistics(sums: wp.array2d(dtype=f64)):
        """Reset the run statistics."""
        world, k = wp.tid()
        sums[world, k] = wp.where(k < wp.static(FIRST_MINIMUM_COLUMN), f64(0.0), f64(wp.inf))

    @wp.kernel(module=module)
    def copy_flagged(flags: wp.array(dtype=wp.int32), source: wp.array(dtype=f64), target: wp.array(dtype=f64)):
        """Copy a number in the flagged worlds."""
        world = wp.tid()
        if flags[world] != 0:
            target[world] = source[world]

    @wp.kernel(module=module)
    def clear_flagged(flags: wp.array(dtype=wp.int32), target: wp.array(dtype=wp.int32)):
        """Clear a flag in the flagged worlds."""
        world = wp.tid()
        if flags[world] != 0:
            target[world] = 0

    return _types.SimpleNamespace(
        module=module, end_episodes=end_episodes, add_statistics=add_statistics, clear_statistics=clear_statistics,
        copy_flagged=copy_flagged, clear_flagged=clear_flagged,
    )  # fmt: skip


@functools.cache
def observation_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels in one precision that fill a table [world, column]."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    f64, vec3d = wp.float64, wp.vec3d
    module = kernel_module(f"observations_{dtype}")

    @wp.kernel(module=module)
    def point_motions(
        start: wp.array(dtype=wp.int32), slot: wp.array(dtype=wp.int32), weight: wp.array(dtype=f64),
        kind: wp.array(dtype=wp.int32), place: wp.array(dtype=vec3d), column: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3), v: wp.array2d(dtype=vec3), out: wp.array2d(dtype=T),
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
        source: wp.array(dtype=wp.int32), column: wp.array(dtype=wp.int32), report: wp.array2d(dtype=f64),
        stepped: wp.array(dtype=wp.int32), out: wp.array2d(dtype=T),
    ):  # fmt: skip
        """Columns of the report of the last step; 0 without a step."""
        world, k = wp.tid()
        out[world, column[k]] = wp.where(stepped[world] != 0, T(report[world, source[k]]), T(0.0))

    @wp.func
    def current_joint_vector(
        start: wp.array(dtype=wp.int32), slot: wp.array(dtype=wp.int32), weight: wp.array(dtype=f64),
        place: wp.array(dtype=vec3d), u: wp.array2d(dtype=vec3), world: int, k: int,
    ) -> vec3d:  # fmt: skip
        """Current vector of a joint: its reference value plus the sum of w_i u_i."""
        x = place[k]
        for i in range(start[k], start[k + 1]):
            x += weight[i] * vec3d(u[world, slot[i]])
        return x

    @wp.kernel(module=module)
    def joint_values(
        start: wp.array(dtype=wp.int32), slot: wp.array(dtype=wp.int32), weight: wp.array(dtype=f64),
        place: wp.array(dtype=vec3d), kind: wp.array(dtype=wp.int32), row: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.int32), u: wp.array2d(dtype=vec3), target: wp.array2d(dtype=f64),
        out: wp.array2d(dtype=T),
    ):  # fmt: skip
        """Lengths, travels and angles from three vectors each; `row`: of a drive with multiple turns, or -1."""
        world, k = wp.tid()
        a = current_joint_vector(start, slot, weight, place, u, world, 3 * k)
        b = current_joint_vector(start, slot, weight, place, u, world, 3 * k + 1)
        x = wp.length(a)
        if kind[k] == wp.static(JOINT_VALUE_KINDS["travel"]):
            x = wp.dot(a, b)
        elif kind[k] == wp.static(JOINT_VALUE_KINDS["angle"]):
            c = current_joint_vector(start, slot, weight, place, u, world, 3 * k + 2)
            x = wp.atan2(wp.dot(c, b), wp.dot(c, a))
            if row[k] >= 0 and not wp.isnan(target[world, row[k]]):
                turn = f64(wp.static(FULL_TURN))
                x += turn * wp.round((target[world, row[k]] - x) / turn)
        out[world, column[k]] = T(x)

    @wp.kernel(module=module)
    def world_values(values: wp.array(dtype=f64), column: int, out: wp.array2d(dtype=T)):
        """Copy of a number of each world."""
        world = wp.tid()
        out[world, column] = T(values[world])

    return _types.SimpleNamespace(
        module=module, point_motions=point_motions, report_columns=report_columns, world_values=world_values,
        joint_values=joint_values,
    )  # fmt: skip
