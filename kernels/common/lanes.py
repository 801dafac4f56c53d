"""Threads that share a row: partial sums of the lanes of a row added in a fixed order, on the CPU one lane alone."""

import functools
import types as _types

import warp as wp

from .types import precision

__all__ = ["WARP", "lane_functions"]

WARP = 32


@wp.func_native(
    snippet="""
    #if defined(__CUDA_ARCH__)
    __syncthreads();
    #endif
    """
)
def sync(): ...


@wp.func_native(
    snippet="""
    #if defined(__CUDA_ARCH__)
    for (int o = lanes / 2; o > 0; o /= 2) x += __shfl_down_sync(0xffffffffu, x, o, lanes);
    #endif
    return x;
    """
)
def lane_sum_float64(x: wp.float64, lanes: int) -> wp.float64: ...


@wp.func_native(
    snippet="""
    #if defined(__CUDA_ARCH__)
    for (int o = lanes / 2; o > 0; o /= 2) x += __shfl_down_sync(0xffffffffu, x, o, lanes);
    #endif
    return x;
    """
)
def lane_sum_float32(x: wp.float32, lanes: int) -> wp.float32: ...


@functools.cache
def lane_functions(dtype: str) -> _types.SimpleNamespace:
    """`sync` of a block's threads, and sums over runs of lanes, a power of two up to WARP: `lane_sum(v, lanes)` of
    vectors, `row_sum(x, lanes)` of float64, `scalar_sum` of the precision itself.

    Every thread of a warp must come to a sum: launches pad their rows to whole warps. The first lane has the sum.
    """
    vec3 = precision(dtype).vec3
    scalar_sum = {"float64": lane_sum_float64, "float32": lane_sum_float32}[dtype]

    @wp.func
    def lane_sum(v: vec3, lanes: int) -> vec3:
        return vec3(scalar_sum(v[0], lanes), scalar_sum(v[1], lanes), scalar_sum(v[2], lanes))

    return _types.SimpleNamespace(sync=sync, lane_sum=lane_sum, row_sum=lane_sum_float64, scalar_sum=scalar_sum)
