"""Addition to an entry of a symmetric matrix of 3x3 blocks."""

import functools

import warp as wp

from .structs import topology_struct
from .types import precision

__all__ = ["add_block_function", "add_symmetric_function"]


@functools.cache
def add_block_function(dtype: str) -> wp.Function:
    """Function add_block(topo, at, A, world, value), with `at` a row of Pattern.upper."""
    p = precision(dtype)
    mat33 = p.mat33
    Topology = topology_struct(dtype)

    @wp.func
    def add_block(topo: Topology, at: wp.vec4i, A: mat33, world: int, value: p.mat33_2d):
        """Add A to an entry and its transpose to the mirrored one, on the free components."""
        row_free = topo.free[at[2]]
        column_free = topo.free[at[3]]
        B = mat33()
        for i in range(3):
            for j in range(3):
                B[i, j] = row_free[i] * column_free[j] * A[i, j]
        B += value[world, at[0]]
        value[world, at[0]] = B
        if at[1] != at[0]:
            value[world, at[1]] = wp.transpose(B)

    return add_block


@functools.cache
def add_symmetric_function(dtype: str) -> wp.Function:
    """Function add_symmetric(topo, at, k6, world, value), like add_block."""
    p = precision(dtype)
    mat33, sym = p.mat33, p.sym
    Topology = topology_struct(dtype)
    add_block = add_block_function(dtype)

    @wp.func
    def add_symmetric(topo: Topology, at: wp.vec4i, k6: sym, world: int, value: p.mat33_2d):
        """Add a symmetric block xx yy zz yz xz xy to an entry."""
        A = mat33(k6[0], k6[5], k6[4], k6[5], k6[1], k6[3], k6[4], k6[3], k6[2])
        add_block(topo, at, A, world, value)

    return add_symmetric
