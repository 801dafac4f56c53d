"""Point list of each master facet by counting sort; rebuilt when a point changes its facet."""

import functools

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set
from .facet_structs import master_struct, pair_scratch_struct

__all__ = ["FACETS_PER_CHUNK", "point_list_kernels"]

FACETS_PER_CHUNK = 64
"""Facets per chunk of the prefix sum."""


@functools.cache
def point_list_kernels(dtype: str) -> KernelSet:
    """Kernels of the points of each master facet."""
    Masters, PairScratch = master_struct(dtype), pair_scratch_struct(dtype)
    module = kernel_module(f"pairs_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.kernel(module=module)
    def clear_lists(pair: PairScratch):
        """Clear the point counts."""
        i = wp.tid()
        pair.list_count[i] = 0
        if i == 0:
            pair.lists_changed[0] = 0

    @wp.kernel(module=module)
    def count_points(mas: Masters, pair: PairScratch):
        """Count the points of each facet."""
        world, point = wp.tid()
        f = pair.listed_facet[world, point] - 1
        if f >= 0:
            wp.atomic_add(pair.list_count, world * mas.facet_count + f, 1)

    @wp.kernel(module=module)
    def sum_chunks(mas: Masters, pair: PairScratch):
        """Number of points in the lists of each chunk of facets."""
        world, chunk = wp.tid()
        total = wp.int32(0)
        for f in range(chunk * FACETS_PER_CHUNK, wp.min((chunk + 1) * FACETS_PER_CHUNK, mas.facet_count)):
            total += pair.list_count[world * mas.facet_count + f]
        pair.chunk_offset[world, chunk] = total

    @wp.kernel(module=module)
    def scan_chunks(pair: PairScratch):
        """Prefix sum over the chunks."""
        world = wp.tid()
        before = wp.int32(0)
        for chunk in range(pair.chunk_offset.shape[1]):
            here = pair.chunk_offset[world, chunk]
            pair.chunk_offset[world, chunk] = before
            before += here

    @wp.kernel(module=module)
    def set_list_starts(mas: Masters, pair: PairScratch):
        """Start of each list in each world."""
        world, f = wp.tid()
        start = pair.chunk_offset[world, f / FACETS_PER_CHUNK]
        for other in range(f / FACETS_PER_CHUNK * FACETS_PER_CHUNK, f):
            start += pair.list_count[world * mas.facet_count + other]
        pair.list_start[world, f] = start
        pair.list_size[world, f] = 0

    @wp.kernel(module=module)
    def fill_lists(pair: PairScratch):
        """Fill the lists, in arbitrary order."""
        world, point = wp.tid()
        f = pair.listed_facet[world, point] - 1
        if f >= 0:
            k = wp.atomic_add(pair.list_size, world, f, 1)
            pair.list_point[world, pair.list_start[world, f] + k] = point

    @wp.kernel(module=module)
    def sort_lists(pair: PairScratch):
        """Sort each list by point: sums become deterministic."""
        world, f = wp.tid()
        first = pair.list_start[world, f]
        for k in range(1, pair.list_size[world, f]):
            point = pair.list_point[world, first + k]
            j = first + k - 1
            while j >= first and pair.list_point[world, j] > point:
                pair.list_point[world, j + 1] = pair.list_point[world, j]
                j -= 1
            pair.list_point[world, j + 1] = point

    return kernel_set(locals())
