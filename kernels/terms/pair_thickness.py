"""How thick a body is behind the facets of a surface, and how deep places are in it."""

import functools

import warp as wp

from ..common.types import kernel_module

__all__ = ["depth_kernel", "thickness_kernel"]

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


@functools.cache
def depth_kernel() -> wp.Kernel:
    """The kernel; lengths are over the size of the body."""
    module = kernel_module("pair_depth")

    @wp.kernel(module=module)
    def depth(mesh: wp.uint64, x: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)):
        """Distance from x to the nearest place of a closed mesh that x is in, else 0."""
        i = wp.tid()
        found = wp.mesh_query_point_sign_winding_number(mesh, x[i], float(10.0))
        out[i] = float(0.0)
        if found.result and found.sign < float(0.0):
            out[i] = wp.length(x[i] - wp.mesh_eval_position(mesh, found.face, found.u, found.v))

    return depth
