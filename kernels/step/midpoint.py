"""Midpoint of a step, where the conserving scheme evaluates its forces."""

import functools
import types as _types

import warp as wp

from ..common.types import kernel_module, precision

__all__ = ["midpoint_kernels"]


@functools.cache
def midpoint_kernels(dtype: str) -> _types.SimpleNamespace:
    """The kernel `evaluate_midpoint` in one precision of the vectors."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    module = kernel_module(f"stage_{dtype}")

    @wp.kernel(module=module)
    def evaluate_midpoint(
        u_n: wp.array2d(dtype=vec3),
        v_n: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        dq_dv: wp.array(dtype=wp.float64),
        active: wp.array(dtype=wp.int32),
        u_stage: wp.array2d(dtype=vec3),
        v_stage: wp.array2d(dtype=vec3),
    ):
        """Half of the change of u, (dq/dv) (v_n + v)/2, and u at the midpoint, m; without differences of positions."""
        world, slot = wp.tid()
        if active[world] != 0:
            half = (T(0.5) * T(dq_dv[world])) * (v_n[world, slot] + v[world, slot])
            u_stage[world, slot] = u_n[world, slot] + half
            v_stage[world, slot] = half

    return _types.SimpleNamespace(module=module, evaluate_midpoint=evaluate_midpoint)
