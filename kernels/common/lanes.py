"""Sums over the threads (lanes) that share a row, in a fixed order; on the CPU one thread does a whole row."""

import functools

import warp as wp

from .modules import KernelSet, kernel_set
from .types import double_3d, precision

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


_SUM_SNIPPET = """
    #if defined(__CUDA_ARCH__)
    for (int o = lanes / 2; o > 0; o /= 2) x += __shfl_down_sync(0xffffffffu, x, o, lanes);
    #endif
    return x;
    """


@wp.func_native(snippet=_SUM_SNIPPET)
def lane_sum_float64(x: wp.float64, lanes: int) -> wp.float64:
    """Sum of x over a run of `lanes` threads, in its first thread; x itself on the CPU."""
    ...


@wp.func_native(snippet=_SUM_SNIPPET)
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
def block_memory(dtype: str, size: int) -> KernelSet:
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

    return KernelSet(open=open_memory, load=load, store=store)


@functools.cache
def lane_functions(dtype: str) -> KernelSet:
    """Device functions for threads that share a row.

    `sync()` is the barrier of a block. `lane_sum(v, lanes)` sums vectors, `row_sum(x, lanes)` float64 numbers and
    `scalar_sum(x, lanes)` numbers of this precision over runs of `lanes` threads, a power of two up to WARP. The first
    thread of a run gets the sum. Every thread of a warp must participate, so launches pad their rows to whole warps.
    `store_sum(row, x, index, lanes, world, rows)` stores row sums as `rows[row, world, run]`; `store_products` stores
    the pair of `residual_products(r, z, D)` as rows 0 and 1.
    """
    vec3, f64 = precision(dtype).vec3, wp.float64
    scalar_sum = {"float64": lane_sum_float64, "float32": lane_sum_float32}[dtype]

    @wp.func
    def lane_sum(v: vec3, lanes: int) -> vec3:
        """Sum of v over a run of `lanes` threads, in its first thread; v itself on the CPU."""
        return vec3(scalar_sum(v[0], lanes), scalar_sum(v[1], lanes), scalar_sum(v[2], lanes))

    @wp.func
    def store_sum(row: int, x: wp.float64, index: int, lanes: int, world: int, rows: double_3d):
        """Store the sum of x over each run of `lanes` threads."""
        total = lane_sum_float64(x, lanes)
        if index % lanes == 0:
            rows[row, world, index / lanes] = total

    @wp.func
    def residual_products(r: vec3, z: vec3, D: vec3) -> wp.vec2d:
        """r.z and r.D^-1 r."""
        return wp.vec2d(f64(wp.dot(r, z)), f64(wp.dot(r, wp.cw_div(r, D))))

    @wp.func
    def store_products(x: wp.vec2d, index: int, lanes: int, world: int, rows: double_3d):
        """Store both sums of `residual_products` over each run of `lanes` threads."""
        store_sum(0, x[0], index, lanes, world, rows)
        store_sum(1, x[1], index, lanes, world, rows)

    return kernel_set(locals() | {"sync": sync, "row_sum": lane_sum_float64})
