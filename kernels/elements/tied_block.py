"""The tables of elements with tied shears, see tied.py."""

import functools

import warp as wp

from ..common.types import precision

__all__ = ["coupling_function", "tied_struct"]


@functools.cache
def tied_struct(dtype: str, dissipative: bool = False):
    """The constant data of a block of tied elements, in one precision; `dissipative`: see `tied_kernels`."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3

    @wp.struct
    class TiedBlock:
        conn: wp.array2d(dtype=wp.int32)  # [local, elem] slot
        is_position: wp.array(dtype=T)  # [local]
        first: wp.array3d(dtype=T)  # [tie, local, elem] ds_i/dxi_a
        second: wp.array3d(dtype=T)  # [tie, local, elem] ds_i/dxi_b
        X_first: wp.array2d(dtype=vec3)  # [tie, elem] reference X_a
        X_second: wp.array2d(dtype=vec3)  # [tie, elem] reference X_b
        coupling: wp.array3d(dtype=T)  # [tie, k, elem] A, k within the run of ties that it couples; or world by world
        material: wp.array(dtype=wp.int32)  # [elem]
        coefficients: wp.array3d(dtype=T)  # [world or 0, material, NCOEF]; the first is mu
        contribution_offset: wp.int32
        element_offset: wp.int32
        history_offset: wp.int32
        count: wp.int32
        if dissipative:
            dissipation: T  # chi of conserving.py

    return TiedBlock


@functools.cache
def coupling_function(dtype: str, worlds: bool, dissipative: bool = False) -> wp.Function:
    """The device function of an entry of A; `worlds`: of a world's own."""
    T, Block = precision(dtype).T, tied_struct(dtype, dissipative)

    @wp.func
    def coupled(block: Block, tie: int, k: int, world: int, elem: int) -> T:
        """Entry k of the run of ties that a tie is in."""
        if wp.static(worlds):
            return block.coupling[tie, k, world * block.count + elem]
        else:
            return block.coupling[tie, k, elem]

    return coupled
