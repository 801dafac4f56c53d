"""Sums over the threads (lanes) that share a row, in a fixed order; on the CPU one thread does a whole row."""

import functools
import types as _types

import warp as wp

from .types import precision

__all__ = ["WARP_SIZE", "block_memory", "lane_functions", "warp_minimum"]

WARP_SIZE = 32
"""Threads of a warp."""


@wp.func_native(
    snippet="""
    #if defined(__CUDA_ARCH__)
    __syncthreads();
    #endif
    """
)
def sync():
    """Barrier for the threads of a block; nothing on the CPU."""


@wp.func_native(
    snippet="""
    #if defined(__CUDA_ARCH__)
    for (int o = lanes / 2; o > 0; o /= 2) x += __shfl_down_sync(0xffffffffu, x, o, lanes);
    #endif
    return x;
    """
)
def lane_sum_float64(x: wp.float64, lanes: int) -> wp.float64:
    """Sum of x over a run of `lanes` threads, in its first thread; x itself on the CPU."""
    ...


@wp.func_native(
    snippet="""
    #if defined(__CUDA_ARCH__)
    for (int o = lanes / 2; o > 0; o /= 2) x += __shfl_down_sync(0xffffffffu, x, o, lanes);
    #endif
    return x;
    """
)
def lane_sum_float32(x: wp.float32, lanes: int) -> wp.float32:
    """Sum of x over a run of `lanes` threads, in its first thread; x itself on the CPU."""
    ...


@wp.func_native(
    snippet="""
    #if defined(__CUDA_ARCH__)
    int same;
    unsigned warp = __activemask();
    __match_all_sync(warp, world, &same);
    if (same && warp == 0xffffffffu) {
        for (int o = 16; o > 0; o /= 2) x = fmin(x, __shfl_xor_sync(warp, x, o));
        if (threadIdx.x % 32 != 0) x = 1.0e300;
    }
    #endif
    return x;
    """
)
def warp_minimum(x: wp.float64, world: int) -> wp.float64:
    """Smallest x of a warp, in its first thread and 1e300 in others, if all are of one world; else x itself.

    For an atomic minimum, which in double precision is a loop that serialises the threads of a world.
    """
    ...


_SHARED_MEMORY_SNIPPET = """
    #if defined(__CUDA_ARCH__)
    __shared__ {number} memory[{size}];
    return (uint64_t)memory;
    #else
    return outside;
    #endif
"""
_C_TYPES = {"float64": "double", "float32": "float"}


@functools.cache
def block_memory(dtype: str, size: int) -> _types.SimpleNamespace:
    """Device functions for `size` numbers shared by the threads of a block.

    `open(outside)` is their location: memory of the block or, on the CPU, that at `outside`. `load(at, i)` and
    `store(at, i, x)` access number i.
    """
    T, number = precision(dtype).T, _C_TYPES[dtype]

    @wp.func_native(snippet=_SHARED_MEMORY_SNIPPET.format(number=number, size=size))
    def open_memory(outside: wp.uint64) -> wp.uint64:
        """Location of the numbers."""
        ...

    @wp.func_native(snippet=f"return (({number}*)at)[i];")
    def load(at: wp.uint64, i: int) -> T:
        """Number i."""
        ...

    @wp.func_native(snippet=f"(({number}*)at)[i] = x;")
    def store(at: wp.uint64, i: int, x: T):
        """Number i = x."""
        ...

    return _types.SimpleNamespace(open=open_memory, load=load, store=store)


@functools.cache
def lane_functions(dtype: str) -> _types.SimpleNamespace:
    """Device functions for threads that share a row.

    `sync()` is the barrier of a block. `lane_sum(v, lanes)` sums vectors, `row_sum(x, lanes)` float64 numbers and
    `scalar_sum(x, lanes)` numbers of this precision over runs of `lanes` threads, a power of two up to WARP. The first
    thread of a run gets the sum. Every thread of a warp must participate, so launches pad their rows to whole warps.
    """
    vec3 = precision(dtype).vec3
    scalar_sum = {"float64": lane_sum_float64, "float32": lane_sum_float32}[dtype]

    @wp.func
    def lane_sum(v: vec3, lanes: int) -> vec3:
        """Sum of v over a run of `lanes` threads, in its first thread; v itself on the CPU."""
        return vec3(scalar_sum(v[0], lanes), scalar_sum(v[1], lanes), scalar_sum(v[2], lanes))

    return _types.SimpleNamespace(sync=sync, lane_sum=lane_sum, row_sum=lane_sum_float64, scalar_sum=scalar_sum)
