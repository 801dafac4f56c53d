"""How thick a body is behind the facets of a surface."""

import functools

import warp as wp

from ..common.types import kernel_module

__all__ = ["thickness_kernel"]


@functools.cache
def thickness_kernel() -> wp.Kernel:
    """The kernel; lengths are over the size of the body."""
    module = kernel_module("pair_thickness")

    @wp.kernel(module=module)
    def thickness(
        mesh: wp.uint64, x: wp.array(dtype=wp.vec3), n: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)
    ):  # fmt: skip
        """Distance from x along -n to the other side of a closed mesh."""
        i = wp.tid()
        skip = float(1.0e-5)
        hit = wp.mesh_query_ray(mesh, x[i] - skip * n[i], -n[i], float(10.0))
        out[i] = wp.where(hit.result, hit.t + skip, float(1.0))

    return thickness
