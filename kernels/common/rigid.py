"""Rigid motions of bodies, see solvers/motions.py: what terms make their parts of the matrix with."""

import functools
import types as _types

import warp as wp

from .types import precision

__all__ = ["MOTIONS", "bodies_struct", "motion_functions"]

MOTIONS = 6
"""Of a body: three translations, three turns."""


@functools.cache
def bodies_struct(dtype: str):
    """The bodies whose motions these are, and where their slots are."""
    T = precision(dtype).T

    @wp.struct
    class Bodies:
        first: wp.array(dtype=wp.int32)  # [body] first slot
        last: wp.array(dtype=wp.int32)  # the slot after its last one
        size: wp.array(dtype=wp.float64)  # m
        move: wp.array(dtype=wp.vec3d)  # 1 for translations that nothing prescribes
        turn: wp.array(dtype=wp.vec3d)  # 1 for turns, or 0
        sample: wp.array2d(dtype=wp.int32)  # [place, body] slots whose mean is the centre
        of_slot: wp.array(dtype=wp.int32)  # [slot] body or -1
        is_place: wp.array(dtype=T)  # [slot] 1, or 0 of a gradient
        X: wp.array(dtype=wp.vec3d)  # [slot] reference place, m, or gradient
        arm: wp.array2d(dtype=wp.vec3d)  # [world, slot] a

    return Bodies


@functools.cache
def motion_functions(dtype: str) -> _types.SimpleNamespace:
    """Device functions that terms make their parts of the matrix with."""
    mat33d = wp.mat33d
    Bodies = bodies_struct(dtype)

    @wp.func
    def moves(bodies: Bodies, body: int, slot: int) -> mat33d:
        """How a slot moves with the translations of its body: the columns."""
        return wp.float64(bodies.is_place[slot]) * wp.diag(bodies.move[body])

    @wp.func
    def turns(bodies: Bodies, world: int, body: int, slot: int) -> mat33d:
        """And with its turns: the columns e_k x a."""
        return -wp.skew(bodies.arm[world, slot]) @ wp.diag(bodies.turn[body])

    return _types.SimpleNamespace(moves=moves, turns=turns)
