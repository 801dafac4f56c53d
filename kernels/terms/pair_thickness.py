"""How thick a body is behind the facets of a surface."""

import functools

import warp as wp

from ..common.types import kernel_module

__all__ = ["thickness_kernel"]

SIDES = 8
"""Sides that a ray may meet."""


@functools.cache
def thickness_kernel() -> wp.Kernel:
    """The kernel; lengths are over the size of the body."""
    module = kernel_module("pair_thickness")

    @wp.kernel(module=module)
    def thickness(
        mesh: wp.uint64, x: wp.array(dtype=wp.vec3), n: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)
    ):  # fmt: skip
        """Distance from x along -n to the other side of a closed mesh.

        Of a curved face the triangle that stands for it may lie below x: a side that the ray comes in by is passed.
        """
        i = wp.tid()
        skip = float(1.0e-5)
        way = skip
        out[i] = float(1.0)
        for _ in range(SIDES):
            hit = wp.mesh_query_ray(mesh, x[i] - way * n[i], -n[i], float(10.0))
            if not hit.result:
                return
            way += hit.t + skip
            if wp.dot(hit.normal, n[i]) < float(0.0):
                out[i] = way - skip
                return

    return thickness
