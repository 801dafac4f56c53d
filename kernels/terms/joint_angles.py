"""Angles of joints that no drive prescribes, with their turns."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_1d, double_2d, int_1d, mat33d, precision, vec3d, vec3d_1d
from .constraints import constraint_functions, multiplier_struct
from .spring_coordinates import ANGLE, coordinate_functions

__all__ = ["joint_angle_kernels", "joint_vector_function"]


@functools.cache
def joint_vector_function(dtype: str) -> wp.Function:
    """Device function of a joint's vector, with slots in one precision."""

    @wp.func
    def joint_vector(
        start: int_1d, slot: int_1d, weight: double_1d, place: vec3d, x: precision(dtype).vec3_2d, world: int, k: int
    ) -> vec3d:  # fmt: skip
        """Vector k of a joint: its reference value, 0 of a rate, plus the sum of w_i x_i."""
        out = place
        for i in range(start[k], start[k + 1]):
            out += weight[i] * vec3d(x[world, slot[i]])
        return out

    return joint_vector


@functools.cache
def joint_angle_kernels(dtype: str) -> KernelSet:
    """Kernel in one precision of the slots."""
    p = precision(dtype)
    Multipliers, store_row = multiplier_struct(), constraint_functions(dtype).store_row
    module, joint_vector = kernel_module(f"joint_angles_{dtype}"), joint_vector_function(dtype)
    coordinate = coordinate_functions(False).coordinate

    @masked_kernel(module, "accepted")
    def store_with_angles(
        accepted: int_1d, mul: Multipliers, state: double_2d, last_target: double_2d, start: int_1d, slot: int_1d,
        weight: double_1d, reference: vec3d_1d, u: p.vec3_2d, angle: double_2d,
    ):  # fmt: skip
        """As `store_multipliers` of constraints.py, and the angle of each joint from its vectors a, b, a2, in the turn
        closest to the last one: the first threads, as a joint has a row or more."""
        world, joint = wp.tid()
        store_row(mul, state, last_target, world, joint)
        if joint >= angle.shape[1]:
            return
        V = mat33d()
        for side in range(3):
            k = 3 * joint + side
            V[side] = joint_vector(start, slot, weight, reference[k], u, world, k)
        angle[world, joint] = coordinate(ANGLE, V, angle[world, joint])

    return kernel_set(locals())
