"""Contact between bodies in midpoint schemes: gaps are those at the end of a step, forces act in its middle.

A force along the normal through the projection of a point, and friction at its coordinates, on the facets of the
middle of the step conserve the angular momentum, as the gradients of constraints there do (constraints.py).
"""

import functools

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import f64, vec3d
from .carriers import END, carrier_functions
from .facet_structs import master_struct, pair_scratch_struct
from .kinematics import kinematics_functions
from .projection import facet_projection_functions
from .structs import contact_structs

__all__ = ["pair_midpoint_kernels"]


@functools.cache
def pair_midpoint_kernels(dtype: str) -> KernelSet:
    """Kernels in one precision of the displacements."""
    Masters, PairScratch = master_struct(dtype), pair_scratch_struct(dtype)
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    f_, k = facet_projection_functions(dtype), kinematics_functions(dtype)
    displacement, is_edge = carrier_functions(dtype).displacement, k.is_edge
    inverse_map, project_on_facet = f_.inverse_map, f_.project_on_facet
    module = kernel_module(f"pair_midpoint_{dtype}", max_unroll=SHORT_UNROLL)

    @masked_kernel(module, "active")
    def middle_coefficients(active: wp.array(dtype=wp.int32), pair: PairScratch):
        """Coefficients of the displacements on master facets in the middle of the step."""
        world, control = wp.tid()
        start, end, middle = pair.start_displacement, pair.displacement, pair.middle_displacement
        middle.value[world, control] = f64(0.5) * (start.value[world, control] + end.value[world, control])
        middle.director[world, control] = f64(0.5) * (start.director[world, control] + end.director[world, control])

    @masked_kernel(module, "active")
    def middle_projections(
        mas: Masters, facets: Facets, active: wp.array(dtype=wp.int32), u: wp.array2d(dtype=vec3d), scr: ContactScratch,
        pair: PairScratch,
    ):  # fmt: skip
        """Normal, projection and coordinates of points on their facets in the middle of the step."""
        world, item, q = wp.tid()
        point = facets.first_point + item * facets.point_count + q
        f = pair.facet[world, point]
        if f < 0:
            return
        end = k.position_at(facets, q, k.column(facets, world, item))
        end += displacement(mas, facets, pair, u, world, q, item, END)
        x = f64(0.5) * (scr.start_position[world, point] + end)
        found = inverse_map(mas, pair.middle_displacement, world, f, x, pair.xi[world, point])
        pair.friction_xi[world, point] = pair.xi[world, point]
        if found[3] == f64(0.0):
            return
        xi = vec3d(found[0], found[1], found[2])
        if is_edge(facets, item):
            pair.friction_xi[world, point] = xi
            pair.projection[world, point] = xi
            return
        projection = project_on_facet(mas, pair.middle_displacement, world, f, xi)
        pair.friction_xi[world, point] = xi
        pair.projection[world, point] = projection.xi
        pair.normal[world, point] = projection.normal

    return kernel_set(locals())
