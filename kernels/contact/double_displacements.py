"""Float64 displacements of the slots of contact for float32 models.

float32 rounds a displacement of 1 cm to 5e-10 m. Over a step of 10 us that is a speed of 5e-5 m/s, 5 % of the
lower bound in the damping of the normal law: contact integrates the motion of a step from the velocities.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel

__all__ = ["double_displacement_kernels"]


@functools.cache
def double_displacement_kernels() -> KernelSet:
    """Kernels of float32 models, [world, listed slot]."""
    f64, vec3, vec3d = wp.float64, wp.vec3f, wp.vec3d
    module = kernel_module("double_displacements")

    @masked_kernel(module, "active")
    def update_displacements(
        slots: wp.array(dtype=wp.int32), q_tilde: wp.array2d(dtype=vec3), v: wp.array2d(dtype=vec3),
        dq_dv: wp.array(dtype=f64), active: wp.array(dtype=wp.int32), u: wp.array2d(dtype=vec3d),
    ):  # fmt: skip
        """q = q~ + (dq/dv) v of the listed slots, without rounding to float32."""
        world, i = wp.tid()
        slot = slots[i]
        u[world, slot] = vec3d(q_tilde[world, slot]) + dq_dv[world] * vec3d(v[world, slot])

    @masked_kernel(module, "active")
    def copy_to_float64(
        slots: wp.array(dtype=wp.int32), u: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32),
        out: wp.array2d(dtype=vec3d),
    ):  # fmt: skip
        """Copy of u in float64."""
        world, i = wp.tid()
        slot = slots[i]
        out[world, slot] = vec3d(u[world, slot])

    return kernel_set(locals())
