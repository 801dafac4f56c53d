"""Displacements of the slots that contact reads, in float64 where the model has float32.

A displacement of 1 cm is rounded to 5e-10 m in float32. Over a step of 10 us that is a speed of 5e-5 m/s, 5 % of the
least that the normal law's damping is made for: contact takes the motion of a step from the velocities.
"""

import functools
import types as _types

import warp as wp

from ..common.types import kernel_module

__all__ = ["exact_kernels"]


@functools.cache
def exact_kernels() -> _types.SimpleNamespace:
    """Kernels of float32 models, [world, some slot]."""
    f64, vec3, vec3d = wp.float64, wp.vec3f, wp.vec3d
    module = kernel_module("contact_exact")

    @wp.kernel(module=module)
    def follow(
        slots: wp.array(dtype=wp.int32), q_tilde: wp.array2d(dtype=vec3), v: wp.array2d(dtype=vec3),
        dq_dv: wp.array(dtype=f64), active: wp.array(dtype=wp.int32), u: wp.array2d(dtype=vec3d),
    ):  # fmt: skip
        """q = q~ + (dq/dv) v of some slots, without rounding it to float32."""
        world, i = wp.tid()
        if active[world] != 0:
            slot = slots[i]
            u[world, slot] = vec3d(q_tilde[world, slot]) + dq_dv[world] * vec3d(v[world, slot])

    @wp.kernel(module=module)
    def widen(
        slots: wp.array(dtype=wp.int32), u: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32),
        out: wp.array2d(dtype=vec3d),
    ):  # fmt: skip
        """The numbers of u as they are."""
        world, i = wp.tid()
        if active[world] != 0:
            slot = slots[i]
            out[world, slot] = vec3d(u[world, slot])

    return _types.SimpleNamespace(module=module, follow=follow, widen=widen)
