"""Rigid-body modes (kernels/solvers/rigid_body_modes.py): shared data and functions for terms."""

import functools

import warp as wp

from .modules import KernelSet, kernel_set
from .types import mat33d, precision

__all__ = ["RIGID_MODES", "bodies_struct", "rigid_mode_functions"]

RIGID_MODES = 6
"""Modes of a body: three translations, three rotations."""


@functools.cache
def bodies_struct(dtype: str):
    """Bodies with rigid-body modes, and their slots."""
    T = precision(dtype).T

    @wp.struct
    class Bodies:
        first_slot: wp.array(dtype=wp.int32)  # [body] first slot
        end_slot: wp.array(dtype=wp.int32)  # [body] last slot + 1
        body_size: wp.array(dtype=wp.float64)  # m
        free_translations: wp.array(dtype=wp.vec3d)  # [body] 1 for free translations, 0 for prescribed ones
        free_rotations: wp.array(dtype=wp.vec3d)  # [body] 1 for free rotations, else 0
        centre_slots: wp.array2d(dtype=wp.int32)  # [sample, body] slots whose mean position is the centre
        body_of_slot: wp.array(dtype=wp.int32)  # [slot] body or -1
        is_position: wp.array(dtype=T)  # [slot] 1 for a position, 0 for a gradient
        slot_reference: wp.array(dtype=wp.vec3d)  # [slot] reference position, m, or gradient
        lever_arm: wp.array2d(dtype=wp.vec3d)  # [world, slot] a

    return Bodies


@functools.cache
def rigid_mode_functions(dtype: str) -> KernelSet:
    """Device functions: columns of the matrix of rigid-body modes, R, at a slot."""
    Bodies = bodies_struct(dtype)

    @wp.func
    def translation_columns(bodies: Bodies, body: int, slot: int) -> mat33d:
        """Motion of a slot by the translations of its body, as columns."""
        return wp.float64(bodies.is_position[slot]) * wp.diag(bodies.free_translations[body])

    @wp.func
    def rotation_columns(bodies: Bodies, world: int, body: int, slot: int) -> mat33d:
        """Motion of a slot by the rotations of its body, as columns e_k x a."""
        return -wp.skew(bodies.lever_arm[world, slot]) @ wp.diag(bodies.free_rotations[body])

    return kernel_set(locals())
