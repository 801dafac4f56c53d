"""Midpoint of a step, where the conserving scheme evaluates its forces."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_1d, f64, int_1d, precision

__all__ = ["midpoint_kernels"]


@functools.cache
def midpoint_kernels(dtype: str) -> KernelSet:
    """The kernel `evaluate_midpoint` in one precision of the vectors."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    module = kernel_module(f"stage_{dtype}")

    @masked_kernel(module, "active")
    def evaluate_midpoint(
        u_n: p.vec3_2d,
        v_n: p.vec3_2d,
        v: p.vec3_2d,
        b: double_1d,
        dq_dv: double_1d,
        active: int_1d,
        u_stage: p.vec3_2d,
        v_stage: p.vec3_2d,
    ):
        """Half of the change of u, (dq/dv) (v_n + v)/2, and u at the midpoint, m; without differences of positions."""
        world, slot = wp.tid()
        half = (T(0.5) * T(dq_dv[world])) * (v_n[world, slot] + v[world, slot])
        if b[world] == f64(0.0):  # backward Euler
            half = (T(0.5) * T(dq_dv[world])) * v[world, slot]
        u_stage[world, slot] = u_n[world, slot] + half
        v_stage[world, slot] = half

    return kernel_set(locals())
