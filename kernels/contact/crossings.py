"""Segments across the surface of another body, for bodies without contact."""

import functools

import warp as wp

from ..common.modules import kernel_module
from .thickness import MAX_INTERSECTIONS, inner_depth

__all__ = ["crossing_kernel"]


@functools.cache
def crossing_kernel() -> wp.Kernel:
    """Kernel; lengths over the size of the mesh."""
    module = kernel_module("skin_crossings", light=True)

    @wp.kernel(module=module)
    def crossing_depth(
        mesh: wp.uint64, closed: int, start: wp.array(dtype=wp.vec3), end: wp.array(dtype=wp.vec3),
        out: wp.array(dtype=float),
    ):  # fmt: skip
        """Depth of a segment in a mesh: of a closed one the largest at the middles of the parts between intersections,
        of a sheet the distance from its plane of the nearer end on another side."""
        i = wp.tid()
        length = wp.length(end[i] - start[i])
        way = (end[i] - start[i]) / wp.max(length, float(1.0e-30))
        skip = float(1.0e-6)
        begin = float(0.0)
        deepest = float(0.0)
        for _ in range(MAX_INTERSECTIONS + 1):
            first = begin + skip
            hit = wp.mesh_query_ray(mesh, start[i] + first * way, way, wp.max(length - first, float(0.0)))
            stop = wp.where(hit.result, first + hit.t, length)
            if closed != 0:
                deepest = wp.max(deepest, inner_depth(mesh, start[i] + float(0.5) * (begin + stop) * way))
            elif hit.result:
                steep = wp.abs(wp.dot(way, hit.normal))
                deepest = wp.max(deepest, steep * wp.min(stop, length - stop))
            if not hit.result:
                break
            begin = stop
        out[i] = deepest

    return crossing_depth
