"""Rigid-body modes (kernels/solvers/rigid_body_modes.py): shared data and functions for terms."""

import functools
import types as _types

import warp as wp

from .types import precision

__all__ = ["RIGID_MODES", "bodies_struct", "rigid_mode_functions"]

RIGID_MODES = 6
"""Modes of a body: three translations, three rotations."""


@functools.cache
def bodies_struct(dtype: str):
    """Bodies with rigid-body modes, and their slots."""
    T = precision(dtype).T

    @wp.struct
    class Bodies:
        first: wp.array(dtype=wp.int32)  # [body] first slot
        last: wp.array(dtype=wp.int32)  # [body] last slot + 1
        size: wp.array(dtype=wp.float64)  # m
        translations: wp.array(dtype=wp.vec3d)  # [body] 1 for free translations, 0 for prescribed ones
        rotations: wp.array(dtype=wp.vec3d)  # [body] 1 for free rotations, else 0
        centre_slots: wp.array2d(dtype=wp.int32)  # [sample, body] slots whose mean position is the centre
        of_slot: wp.array(dtype=wp.int32)  # [slot] body or -1
        is_position: wp.array(dtype=T)  # [slot] 1 for a position, 0 for a gradient
        X: wp.array(dtype=wp.vec3d)  # [slot] reference position, m, or gradient
        arm: wp.array2d(dtype=wp.vec3d)  # [world, slot] a

    return Bodies


@functools.cache
def rigid_mode_functions(dtype: str) -> _types.SimpleNamespace:
    """Device functions for the terms' parts of the matrix."""
    mat33d = wp.mat33d
    Bodies = bodies_struct(dtype)

    @wp.func
    def translation_columns(bodies: Bodies, body: int, slot: int) -> mat33d:
        """Motion of a slot by the translations of its body, as columns."""
        return wp.float64(bodies.is_position[slot]) * wp.diag(bodies.translations[body])

    @wp.func
    def rotation_columns(bodies: Bodies, world: int, body: int, slot: int) -> mat33d:
        """Motion of a slot by the rotations of its body, as columns e_k x a."""
        return -wp.skew(bodies.arm[world, slot]) @ wp.diag(bodies.rotations[body])

    return _types.SimpleNamespace(translation_columns=translation_columns, rotation_columns=rotation_columns)
