"""Kernels of Newton's method on vectors [world, slot]: iterates, dot products, sums over residual groups."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set, masked_kernel
from ..common.types import double_1d, double_3d, f64, int_1d, precision
from .newton_control import FLOOR_LANES, GROUP_LANES, GROUP_ROUNDOFF, GROUP_ROWS, Row, control_struct
from .pcg import pcg_kernels

__all__ = ["vector_kernels"]


@functools.cache
def vector_kernels(dtype: str, has_constraints: bool = False) -> KernelSet:
    """Kernels in one precision of the vectors, in the module of `pcg_kernels`, which every solver loads."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    Control = control_struct()
    module = pcg_kernels(dtype, has_constraints).module

    @masked_kernel(module, "active")
    def group_norm_partials(
        start: int_1d, slot: int_1d, rows: double_3d, active: int_1d, partial: wp.array4d(dtype=f64)
    ):  # fmt: skip
        """Strided partial sums of GROUP_ROWS over the slots of a residual group."""
        world, group, lane = wp.tid()
        for row in range(GROUP_ROWS):
            source = wp.where(row == GROUP_ROUNDOFF, Row.ROUNDOFF, row)
            total = f64(0.0)
            for k in range(start[group] + lane, start[group + 1], GROUP_LANES):
                total += rows[source, world, slot[k]]
            partial[row, world, group, lane] = total

    @masked_kernel(module, "active")
    def sum_group_norms(partial: wp.array4d(dtype=f64), active: int_1d, out: double_3d):
        """Sum of the lanes, in order."""
        row, world, group = wp.tid()
        total = f64(0.0)
        for lane in range(GROUP_LANES):
            total += partial[row, world, group, lane]
        out[row, world, group] = total

    @masked_kernel(module, "active")
    def update_position(q_tilde: p.vec3_2d, v: p.vec3_2d, dq_dv: double_1d, active: int_1d, u: p.vec3_2d):
        """q = q~ + (dq/dv) v."""
        world, slot = wp.tid()
        u[world, slot] = q_tilde[world, slot] + T(dq_dv[world]) * v[world, slot]

    @masked_kernel(module, "ctl.search.active")
    def trial_velocity(ctl: Control, base: p.vec3_2d, direction: p.vec3_2d, best: p.vec3_2d, v: p.vec3_2d):
        """v = base + alpha p, or the best iterate if that is to be restored."""
        world, slot = wp.tid()
        if ctl.nonmonotone.restore_best[world] != 0:
            v[world, slot] = best[world, slot]
        else:
            v[world, slot] = base[world, slot] + T(ctl.search.alpha[world]) * direction[world, slot]

    @masked_kernel(module, "ctl.active")
    def set_base(ctl: Control, v: p.vec3_2d, base: p.vec3_2d, best: p.vec3_2d):
        """base = v; before that, best iterate = base in the marked worlds."""
        world, slot = wp.tid()
        if ctl.nonmonotone.store_best[world] != 0:
            best[world, slot] = base[world, slot]
        base[world, slot] = v[world, slot]

    @wp.kernel(module=module)
    def floor_partials(
        ctl: Control, start: int_1d, slot: int_1d, element_start: int_1d, element: int_1d, gradient: p.vec3_2d,
        direction: p.vec3_2d, inertia: p.vec3_2d, v: p.vec3_2d, v_tilde: p.vec3_2d, u: p.vec3_2d, energy: double_3d,
    ):  # fmt: skip
        """Strided partial sums of FLOOR_ROWS over the slots and elements of a part; empty lists: all."""
        world, part, lane = wp.tid()
        if ctl.floor.estimate_error[world] != 2:
            return
        work, kinetic, strain, step, size = f64(0.0), f64(0.0), f64(0.0), f64(0.0), f64(0.0)
        for k in range(start[part] + lane, start[part + 1], FLOOR_LANES):
            i = k
            if slot.shape[0] > 0:
                i = slot[k]
            p = direction[world, i]
            work -= f64(wp.dot(gradient[world, i], p))
            kinetic += f64(wp.dot(inertia[world, i], v[world, i] - v_tilde[world, i]))
            step = wp.max(step, f64(wp.max(wp.abs(p))))
            size = wp.max(size, f64(wp.max(wp.abs(u[world, i]))))
        for k in range(element_start[part] + lane, element_start[part + 1], FLOOR_LANES):
            e = k
            if element.shape[0] > 0:
                e = element[k]
            strain += energy[0, world, e]
        ctl.floor.sums[0, world, part, lane] = work
        ctl.floor.sums[1, world, part, lane] = kinetic
        ctl.floor.sums[2, world, part, lane] = strain
        ctl.floor.sums[3, world, part, lane] = step
        ctl.floor.sums[4, world, part, lane] = size

    @masked_kernel(module, "active")
    def copy_active(source: p.vec3_2d, active: int_1d, target: p.vec3_2d):
        """target = source in the active worlds."""
        world, slot = wp.tid()
        target[world, slot] = source[world, slot]

    @masked_kernel(module, "active")
    def dot_terms(a: p.vec3_2d, b: p.vec3_2d, active: int_1d, rows: double_3d):
        """a.b per slot."""
        world, slot = wp.tid()
        rows[0, world, slot] = f64(wp.dot(a[world, slot], b[world, slot]))

    @wp.kernel(module=module)
    def set_any_flag(flags: int_1d, out: int_1d):
        """out[0] = 1 if any world's flag is set; out must be 0 before."""
        world = wp.tid()
        if flags[world] != 0:
            wp.atomic_max(out, 0, 1)

    return kernel_set(locals())
