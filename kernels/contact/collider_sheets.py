"""Check for bodies that cross a sheet of triangles at the start, where their side is undefined."""

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
    """A kernel in a module of its own, run once at the start of a simulation."""
    vec3, vec3d = precision(dtype).vec3, wp.vec3d
    Colliders, Facets = collider_struct(True), facet_struct(dtype)
    interpolate = kinematics_functions(dtype).interpolate
    distance, sweep = collider_functions(True).distance, collider_functions(True).sweep
    module = kernel_module(f"contact_sheets_{dtype}{MESH_SUFFIX}", max_unroll=SHORT_UNROLL)

    @wp.kernel(module=module)
    def find_crossed_sheets(
        col: Colliders, facets: Facets, u: wp.array2d(dtype=vec3), tolerance: wp.array(dtype=wp.float64),
        found: wp.array2d(dtype=wp.int32),
    ):  # fmt: skip
        """Point of each facet that is behind a sheet as seen from the preceding point, + 1; found: [world, row]."""
        world, item = wp.tid()
        k = col.of_contact[facets.contact[item]]
        before = vec3d()
        for q in range(facets.point_count):
            x = facets.X[q, item] + interpolate(facets, u, world, q, item)
            y = wp.transpose(col.rotation[world, k]) * (x - col.position[world, k])
            if q > 0:
                side = sweep(col, k, before, y, -1)
                if side == -2 or (side >= 0 and distance(col, k, y, side)[3] < -tolerance[world]):
                    found[world, facets.first_row + item] = facets.first_point + item * facets.point_count + q + 1
            before = y

    return kernel_set(locals())
