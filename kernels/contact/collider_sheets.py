"""Sides of a sheet of triangles at the start: bodies that cross it, and points within round-off of it."""

import functools

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set
from ..common.types import precision
from .colliders import MESH_SUFFIX, collider_functions
from .kinematics import kinematics_functions
from .structs import collider_struct, facet_struct

__all__ = ["sheet_kernels"]


@functools.cache
def sheet_kernels(dtype: str) -> KernelSet:
    """Kernels in a module of their own, run once at the start of a simulation."""
    vec3, vec3d = precision(dtype).vec3, wp.vec3d
    Colliders, Facets = collider_struct(True), facet_struct(dtype)
    interpolate = kinematics_functions(dtype).interpolate
    of_mesh = collider_functions(True)
    distance, sweep, sheet_side = of_mesh.distance, of_mesh.sweep, of_mesh.sheet_side
    module = kernel_module(f"contact_sheets_{dtype}{MESH_SUFFIX}", max_unroll=SHORT_UNROLL)

    @wp.kernel(module=module)
    def find_crossed_sheets(
        col: Colliders, facets: Facets, u: wp.array2d(dtype=vec3), sides: wp.array2d(dtype=wp.int32),
        tolerance: wp.array(dtype=wp.float64), found: wp.array2d(dtype=wp.int32),
    ):  # fmt: skip
        """Point of each facet on another side of a sheet than the preceding point, + 1; sides: contact state by
        the side of the body, [world, point]; found: [world, row]."""
        world, item = wp.tid()
        own = sides[world, facets.first_point + item * facets.point_count]
        own = wp.where(own > 0, -2 - own, -1)
        k = col.of_contact[facets.contact[item]]
        before = vec3d()
        for q in range(facets.point_count):
            x = facets.X[q, item] + interpolate(facets, u, world, q, item)
            y = wp.transpose(col.rotation[world, k]) * (x - col.position[world, k])
            if q > 0:
                side = sweep(col, k, before, y, own)
                if side == -2 or (side >= 0 and distance(col, k, y, side)[3] < -tolerance[world]):
                    found[world, facets.first_row + item] = facets.first_point + item * facets.point_count + q + 1
            before = y

    @wp.kernel(module=module)
    def point_sides(
        col: Colliders, facets: Facets, u: wp.array2d(dtype=vec3), out: wp.array2d(dtype=wp.int32)
    ):  # fmt: skip
        """Contact state of free points by their side of a sheet, [world, point]."""
        world, item, q = wp.tid()
        k = col.of_contact[facets.contact[item]]
        x = facets.X[q, item] + interpolate(facets, u, world, q, item)
        y = wp.transpose(col.rotation[world, k]) * (x - col.position[world, k])
        out[world, facets.first_point + item * facets.point_count + q] = sheet_side(col, k, y, 0)

    return kernel_set(locals())
