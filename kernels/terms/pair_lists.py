"""Point list of each master facet by counting sort; rebuilt when a point changes its facet."""

import functools
import types as _types

import warp as wp

from ..common.types import SMALL, kernel_module
from .pair_data import master_struct, touching_struct

__all__ = ["CHUNK", "list_kernels"]

CHUNK = 64
"""Facets per chunk of the prefix sum."""


@functools.cache
def list_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels in the module of `pair_kernels`."""
    Masters, Touching = master_struct(dtype), touching_struct(dtype)
    module = kernel_module(f"pairs_{dtype}", max_unroll=SMALL)

    @wp.kernel(module=module)
    def clear_lists(t: Touching):
        """Clear the point counts."""
        i = wp.tid()
        t.count[i] = 0
        if i == 0:
            t.changed[0] = 0

    @wp.kernel(module=module)
    def count_points(mas: Masters, t: Touching):
        """Count the points of each facet."""
        world, point = wp.tid()
        f = t.listed[world, point] - 1
        if f >= 0:
            wp.atomic_add(t.count, world * mas.count + f, 1)

    @wp.kernel(module=module)
    def sum_chunks(mas: Masters, t: Touching):
        """Number of points in the lists of each chunk of facets."""
        world, chunk = wp.tid()
        total = wp.int32(0)
        for f in range(chunk * CHUNK, wp.min((chunk + 1) * CHUNK, mas.count)):
            total += t.count[world * mas.count + f]
        t.chunk[world, chunk] = total

    @wp.kernel(module=module)
    def scan_chunks(t: Touching):
        """Prefix sum over the chunks."""
        world = wp.tid()
        before = wp.int32(0)
        for chunk in range(t.chunk.shape[1]):
            here = t.chunk[world, chunk]
            t.chunk[world, chunk] = before
            before += here

    @wp.kernel(module=module)
    def place_lists(mas: Masters, t: Touching):
        """Start of each list in each world."""
        world, f = wp.tid()
        start = t.chunk[world, f / CHUNK]
        for other in range(f / CHUNK * CHUNK, f):
            start += t.count[world * mas.count + other]
        t.start[world, f] = start
        t.points[world, f] = 0

    @wp.kernel(module=module)
    def fill_lists(mas: Masters, t: Touching):
        """Fill the lists, in arbitrary order."""
        world, point = wp.tid()
        f = t.listed[world, point] - 1
        if f >= 0:
            k = wp.atomic_add(t.points, world, f, 1)
            t.entry[world, t.start[world, f] + k] = point

    @wp.kernel(module=module)
    def sort_lists(t: Touching):
        """Sort each list by point: sums become deterministic."""
        world, f = wp.tid()
        first = t.start[world, f]
        for k in range(1, t.points[world, f]):
            point = t.entry[world, first + k]
            j = first + k - 1
            while j >= first and t.entry[world, j] > point:
                t.entry[world, j + 1] = t.entry[world, j]
                j -= 1
            t.entry[world, j + 1] = point

    return _types.SimpleNamespace(
        clear_lists=clear_lists, count_points=count_points, sum_chunks=sum_chunks, scan_chunks=scan_chunks,
        place_lists=place_lists, fill_lists=fill_lists, sort_lists=sort_lists,
    )  # fmt: skip
