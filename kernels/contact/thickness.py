"""Thickness of a body behind the facets of a surface, and depth of positions in it."""

import functools

import warp as wp

from ..common.modules import kernel_module

__all__ = ["MAX_INTERSECTIONS", "depth_kernel", "inner_depth", "thickness_kernel"]

MAX_INTERSECTIONS = 8
"""Maximum number of intersections of a ray or segment."""


@wp.func
def inner_depth(mesh: wp.uint64, x: wp.vec3) -> float:
    """Distance from a position inside a closed mesh to its nearest point, else 0."""
    found = wp.mesh_query_point_sign_winding_number(mesh, x, float(10.0))
    if found.result and found.sign < float(0.0):
        return wp.length(x - wp.mesh_eval_position(mesh, found.face, found.u, found.v))
    return float(0.0)


@functools.cache
def thickness_kernel() -> wp.Kernel:
    """Kernel; lengths over the size of the body."""
    module = kernel_module("pair_thickness")

    @wp.kernel(module=module)
    def thickness(
        mesh: wp.uint64, x: wp.array(dtype=wp.vec3), n: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)
    ):  # fmt: skip
        """Distance from x along -n to the opposite side of a closed mesh.

        The triangle approximating a curved face may lie below x: an intersection where the ray enters is skipped.
        """
        i = wp.tid()
        skip = float(1.0e-5)
        way = skip
        out[i] = float(1.0)
        for _ in range(MAX_INTERSECTIONS):
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
    """Kernel; lengths over the size of the body."""
    module = kernel_module("pair_depth")

    @wp.kernel(module=module)
    def depth(mesh: wp.uint64, x: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)):
        """Depths of positions in a closed mesh."""
        i = wp.tid()
        out[i] = inner_depth(mesh, x[i])

    return depth
