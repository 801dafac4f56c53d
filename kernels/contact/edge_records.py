"""Records of contacts that have a contact of edges, as of one contact."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set
from .structs import AREA_ROW, PENETRATION_ROW, RECORD_NAMES, SLIP_ROW, STICK_ROW

__all__ = ["edge_record_kernels"]


@functools.cache
def edge_record_kernels() -> KernelSet:
    """Kernels on the report."""
    f64 = wp.float64
    rows = len(RECORD_NAMES)
    module = kernel_module("edge_records")

    @wp.kernel(module=module)
    def add_edge_records(pairs: wp.array(dtype=wp.vec2i), report: wp.array2d(dtype=f64)):
        """Add the record at the second column of each pair to that at the first: sums, averages of slip and stick over
        both areas in contact, the larger penetration."""
        world, k = wp.tid()
        main = pairs[k][0]
        edges = pairs[k][1]
        area = report[world, main + AREA_ROW]
        more = report[world, edges + AREA_ROW]
        for j in range(rows):
            a = report[world, main + j]
            b = report[world, edges + j]
            value = a + b
            if j == SLIP_ROW or j == STICK_ROW:
                value = (a * area + b * more) / wp.max(area + more, f64(1.0e-300))
            if j == PENETRATION_ROW:
                value = wp.max(a, b)
            report[world, main + j] = value

    return kernel_set(locals())
