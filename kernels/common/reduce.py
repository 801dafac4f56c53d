"""Sums per world, in an order that depends on the row length only, not on the number of worlds."""

import functools

import warp as wp

from .lanes import lane_sum_float64
from .modules import KernelSet, kernel_module, kernel_set, masked_kernel
from .types import double_2d, double_3d, f64, int_1d

__all__ = ["CHUNK", "MAX_WARP_ROW", "reduce_kernels"]

TILE_SIZE = 1024
"""Numbers summed at once by a block."""
MAX_WARP_ROW = 512
"""Rows up to this length are summed by a warp, which leaves room for many worlds (4096 worlds on an H200, rows of 67: 5
us for 48)."""
CHUNK = 16384
"""Rows up to this length are summed by one block; longer ones in chunks of this length first."""


@functools.cache
def reduce_kernels() -> KernelSet:
    """Kernels that sum rows [row, world, item] of float64."""
    module = kernel_module("reduce")

    @masked_kernel(module, "active")
    def partial_sums(rows: double_3d, active: int_1d, partial: double_3d):
        """One block sums one chunk of one row of one world."""
        row, world, chunk = wp.tid()
        acc = wp.tile_zeros(shape=(1, 1, TILE_SIZE), dtype=f64)
        for k in range(CHUNK // TILE_SIZE):
            acc += wp.tile_load(rows, shape=(1, 1, TILE_SIZE), offset=(row, world, chunk * CHUNK + k * TILE_SIZE))
        partial[row, world, chunk] = wp.tile_extract(wp.tile_sum(acc), 0)

    @masked_kernel(module, "active")
    def final_sums(rows: double_3d, active: int_1d, out: double_2d):
        """One block sums one row of one world."""
        row, world = wp.tid()
        acc = wp.tile_zeros(shape=(1, 1, TILE_SIZE), dtype=f64)
        for k in range((rows.shape[2] + TILE_SIZE - 1) // TILE_SIZE):
            acc += wp.tile_load(rows, shape=(1, 1, TILE_SIZE), offset=(row, world, k * TILE_SIZE))
        out[row, world] = wp.tile_extract(wp.tile_sum(acc), 0)

    @wp.kernel(module=module)
    def short_sums(rows: double_3d, lanes: int, active: int_1d, out: double_2d):
        """One warp sums one row of one world; on the CPU one thread, `lanes` is 1."""
        item = wp.tid() / lanes
        lane = wp.tid() % lanes
        world = item % rows.shape[1]
        row = item / rows.shape[1]
        if active[world] == 0:
            return
        s = f64(0.0)
        for k in range(lane, rows.shape[2], lanes):
            s += rows[row, world, k]
        s = lane_sum_float64(s, lanes)
        if lane == 0:
            out[row, world] = s

    return kernel_set(locals())
