"""Derivatives of inertia, gravity, tractions and rotation drives by the reference values of the slots."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_1d, double_3d, f64, int_1d, precision, vec3d, vec3d_1d, vec3d_2d
from ..elements.points import block_struct

__all__ = ["shape_kernels"]


@functools.cache
def shape_kernels(dtype: str) -> KernelSet:
    """Kernels in one precision."""
    p = precision(dtype)
    T, vec3, Block = p.T, p.vec3, block_struct(dtype)
    module = kernel_module(f"shape_gradients_{dtype}")

    @masked_kernel(module, "active")
    def acceleration_of_mass(
        is_position: p.scalar_1d, gravity: vec3d_1d, ramp: double_1d, v: p.vec3_2d, v_tilde: p.vec3_2d,
        mass_factor: double_1d, active: int_1d, out: p.vec3_2d,
    ):  # fmt: skip
        """a of the force M a of gravity and inertia, m/s^2."""
        world, slot = wp.tid()
        load = (T(ramp[world]) * is_position[slot]) * vec3(gravity[world])
        out[world, slot] = load - T(mass_factor[world]) * (v[world, slot] - v_tilde[world, slot])

    @masked_kernel(module, "active")
    def mass_shape(
        block: Block, density: p.scalar_2d, a: p.vec3_2d, w: p.vec3_2d, active: int_1d, contribution: p.vec3_2d
    ):
        """w.dM/dX a of int rho w.a dV: the points' volumes change by div(dX)."""
        world, elem = wp.tid()
        column = elem % block.shape.shape[2]
        rho = density[world % density.shape[0], elem]
        for i in range(block.conn.shape[0]):
            contribution[world, block.contribution_offset + i * block.count + elem] = vec3()
        for q in range(block.mass_weight.shape[0]):
            x, y = vec3(), vec3()
            for i in range(block.conn.shape[0]):
                s = block.conn[i, elem]
                x += block.shape[q, i, column] * a[world, s]
                y += block.shape[q, i, column] * w[world, s]
            power = rho * block.mass_weight[q, elem] * wp.dot(x, y)
            for i in range(block.conn.shape[0]):
                e = block.contribution_offset + i * block.count + elem
                contribution[world, e] = contribution[world, e] + power * block.shape_gradient[q, i, elem]

    @masked_kernel(module, "active")
    def dead_load_shape(
        start: int_1d, loaded: int_1d, law: int_1d, change: p.vec3_1d, value: vec3d_2d, w: p.vec3_2d, active: int_1d,
        out: p.vec3_2d,
    ):  # fmt: skip
        """out_j += dweight_i/dX_j (w_i.value) of tractions, by the slots j."""
        world, slot = wp.tid()
        total = out[world, slot]
        for k in range(start[slot], start[slot + 1]):
            total += wp.dot(w[world, loaded[k]], vec3(value[world, law[k]])) * change[k]
        out[world, slot] = total

    @masked_kernel(module, "active")
    def rotation_shape(
        slot: int_1d, law: int_1d, components: vec3d_1d, axis: vec3d_1d, value: vec3d_2d, drive_bar: p.vec3_2d,
        active: int_1d, out: p.vec3_2d,
    ):  # fmt: skip
        """out += (R - I)^T bar of the displacements (R - I) arm of `drive_rotation`."""
        world, k = wp.tid()
        s = slot[k]
        angle = value[world, law[k]][0]
        half = wp.sin(f64(0.5) * angle)
        bar = wp.cw_mul(components[k], vec3d(drive_bar[world, s]))
        turn = wp.cross(axis[k], bar)
        out[world, s] = out[world, s] + vec3(f64(2.0) * half * half * wp.cross(axis[k], turn) - wp.sin(angle) * turn)

    @wp.kernel(module=module)
    def probe_shape(slot: int_1d, weight: p.scalar_1d, step: int, position: double_3d, out: p.vec3_2d):
        """Add the bars of reference positions of a probe; its slots are each in the list once."""
        world, k = wp.tid()
        bar = vec3d(position[world, step, 0], position[world, step, 1], position[world, step, 2])
        out[world, slot[k]] = out[world, slot[k]] + weight[k] * vec3(bar)

    return kernel_set(locals())
