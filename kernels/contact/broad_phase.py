"""Broad phase of contact between bodies: master facets at an iterate and at the start of an attempted step.

Computed are the monomial coefficients of displacements on each facet, its centre, and the bounding boxes of the tree.
"""

import functools
from typing import Any

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import precision
from .facet_structs import facet_field_struct, master_struct, pair_scratch_struct
from .projection import facet_projection_functions

__all__ = ["BOX_MARGIN", "broad_phase_kernels", "search_module"]

BOX_MARGIN = 0.25
"""Enlargement of the boxes of the tree, as a fraction of the facet's side length: they stay valid for several steps."""
BOX_ROUNDING = 2.4e-7
"""Relative widening of a box before its conversion to float32: twice the machine epsilon, 1.2e-7."""


def search_module(name: str) -> wp.Module:
    """Module of the search of facets, in blocks of 128 threads: 4096 pairs of blocks take 3 % less time than with 256
    (64: 11 % more)."""
    return kernel_module(f"facet_search_{name}", max_unroll=SHORT_UNROLL, block_dim=128)


@functools.cache
def broad_phase_kernels(dtype: str) -> KernelSet:
    """Kernels for displacements of type `dtype`, in the module of `facet_search_kernels`; functions of boxes."""
    vec3 = precision(dtype).vec3
    f64, vec3d, box3 = wp.float64, wp.vec3d, wp.vec3
    mat43 = wp.types.matrix(shape=(4, 3), dtype=f64)
    Masters, PairScratch, FacetField = master_struct(dtype), pair_scratch_struct(dtype), facet_field_struct()
    f = facet_projection_functions(dtype)
    module = search_module(dtype)

    @wp.func
    def coefficients(mas: Masters, u: wp.array2d(dtype=Any), world: int, item: int, m: int):
        """Monomial coefficients m of a field u [world, slot] on facet `item`: of its value, and of its derivative along
        the director."""
        c = vec3d()
        d = vec3d()
        for i in range(mas.conn.shape[0]):
            value = vec3d(u[world, mas.conn[i, item]])
            c += f64(mas.shape[m, i, item]) * value
            d += f64(mas.director_shape[m, i, item]) * value
        return c, d

    @wp.kernel(module=module)
    def update_coefficients(
        mas: Masters, u: wp.array2d(dtype=vec3d), active: wp.array(dtype=wp.int32), pair: PairScratch
    ):  # fmt: skip
        """Coefficients of displacements on master facets in float64, see kernels/contact/double_displacements.py."""
        world, item, m = wp.tid()
        if active[world] != 0 and m < mas.monomial_count[mas.facet_kind[item]]:
            c, d = coefficients(mas, u, world, item, m)
            pair.displacement.value[world, mas.max_monomials * item + m] = c
            pair.displacement.director[world, mas.max_monomials * item + m] = d

    @masked_kernel(module, "active")
    def initial_coefficients(
        mas: Masters, u_n: wp.array2d(dtype=vec3), v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32),
        pair: PairScratch,
    ):  # fmt: skip
        """Coefficients of displacements and velocities at the start of an attempt; reset the largest depths."""
        world, item, m = wp.tid()
        control = mas.max_monomials * item + m
        # threads of a world share the bodies
        for body in range(control, pair.deepest_contact.shape[1], mas.max_monomials * mas.facet_count):
            pair.deepest_contact[world, body] = f64(0.0)
        if m < mas.monomial_count[mas.facet_kind[item]]:
            c, d = coefficients(mas, u_n, world, item, m)
            pair.start_displacement.value[world, control] = c
            pair.start_displacement.director[world, control] = d
            v, turned = coefficients(mas, v_n, world, item, m)
            pair.start_velocity[world, control] = v

    @wp.func
    def round_down(x: vec3d) -> box3:
        """x in single precision, rounded down by more than its largest round-off."""
        return box3(
            wp.float32(x[0] - wp.abs(x[0]) * f64(BOX_ROUNDING)),
            wp.float32(x[1] - wp.abs(x[1]) * f64(BOX_ROUNDING)),
            wp.float32(x[2] - wp.abs(x[2]) * f64(BOX_ROUNDING)),
        )

    @wp.func
    def round_up(x: vec3d) -> box3:
        """x in single precision, rounded up."""
        return -round_down(-x)

    @wp.func
    def contains(low: box3, high: box3, other_low: box3, other_high: box3) -> bool:
        """True if a box contains another one."""
        inside = bool(True)
        for j in range(3):
            if other_low[j] < low[j] or other_high[j] > high[j]:
                inside = False
        return inside

    @wp.func
    def pack_facet_point(s: f.FacetPoint) -> mat43:
        """Position and derivatives of a facet point as the rows of a matrix."""
        return wp.matrix_from_rows(s.position, s.tangent_a, s.tangent_b, s.director)

    @wp.func
    def unpack_facet_point(m: mat43) -> f.FacetPoint:
        """Facet point from the rows of a matrix."""
        return f.FacetPoint(m[0], m[1], m[2], m[3])

    @wp.func
    def hull_point(mas: Masters, U: FacetField, world: int, item: int, q: int) -> vec3d:
        """Control point of Bernstein's form of a facet, m."""
        kind = mas.facet_kind[item]
        x = vec3d()
        for m in range(mas.monomial_count[kind]):
            part = mas.hull_coefficients[kind, q, m]
            if part != f64(0.0):
                x += part * (
                    mas.reference_position_coefficients[m, item] + U.value[world, mas.max_monomials * item + m]
                )
        return x

    @wp.func
    def closest_facet(
        mas: Masters, pair: PairScratch, world: int, surface: int, x: vec3d, far: f64, tolerance: f64, way: vec3d,
        least: f64, most: f64,
    ) -> wp.vec4d:  # fmt: skip
        """Coordinates of x on the closest facet of a surface, and that facet; -1: none within `far`, m, and `tolerance`
        beside it, of those whose normal has a product between `least` and `most` with `way`."""
        out = wp.vec4d(f64(0.0), f64(0.0), f64(0.0), f64(-1.0))
        height = far
        off = tolerance
        pad = vec3d(far, far, far)
        root = wp.bvh_get_group_root(mas.tree, world * mas.surface_count + surface)
        query = wp.bvh_query_aabb(mas.tree, round_down(x - pad), round_up(x + pad), root)
        index = wp.int32(0)
        while wp.bvh_query_next(query, index):
            item = index - world * mas.facet_count
            corners = mas.corner_count[mas.facet_kind[item]]
            found = f.inverse_map(mas, pair.displacement, world, item, x, f.facet_centre(corners))
            xi = vec3d(found[0], found[1], found[2])
            o = f.distance_outside(corners, xi)
            if found[3] != f64(0.0) and o <= off:
                s = f.surface_point(mas, pair.displacement, world, item, xi)
                n = f.unit_normal(s)
                gap = xi[2] * wp.dot(n, s.director)
                turned = wp.dot(n, way) < least or wp.dot(n, way) > most
                closer = wp.abs(gap) < height or (wp.abs(gap) == height and f64(item) < out[3])
                if gap >= -mas.depth_limit[item] and (o < off or closer) and wp.abs(gap) <= far and not turned:
                    out = wp.vec4d(xi[0], xi[1], xi[2], f64(item))
                    height = wp.abs(gap)
                    off = o
        return out

    @masked_kernel(module, "active")
    def check_boxes(mas: Masters, active: wp.array(dtype=wp.int32), pair: PairScratch):
        """Request a refit if a facet, at the start of the attempt or now, left its box; compute the enlarged boxes."""
        world, item = wp.tid()
        low = vec3d(f64(1.0e300), f64(1.0e300), f64(1.0e300))
        high = -low
        kind = mas.facet_kind[item]
        count = mas.monomial_count[kind]
        for q in range(count):
            x = hull_point(mas, pair.displacement, world, item, q)
            y = hull_point(mas, pair.start_displacement, world, item, q)
            low = wp.min(low, wp.min(x, y))
            high = wp.max(high, wp.max(x, y))
        index = world * mas.facet_count + item
        if not contains(pair.box_lower[index], pair.box_upper[index], round_down(low), round_up(high)):
            pair.refit_needed[0] = 1
        room = f64(BOX_MARGIN) * mas.side_length[item]
        pad = vec3d(room, room, room)
        pair.refit_lower[index] = round_down(low - pad)
        pair.refit_upper[index] = round_up(high + pad)

    @masked_kernel(module, "active")
    def update_centres(mas: Masters, active: wp.array(dtype=wp.int32), pair: PairScratch):
        """Position and derivatives at the centre of each facet, now and at the start of the attempt; an upper bound, m,
        of the facet's height above the tangent plane there, from its control points."""
        world, item = wp.tid()
        kind = mas.facet_kind[item]
        count = mas.monomial_count[kind]
        xi = f.facet_centre(mas.corner_count[kind])
        s = f.surface_point(mas, pair.displacement, world, item, xi)
        n = f.unit_normal(s)
        bulge = f64(0.0)
        for q in range(count):
            x = hull_point(mas, pair.displacement, world, item, q)
            bulge = wp.max(bulge, wp.dot(x - s.position, n))
        pair.bulge[world, item] = bulge
        pair.facet_centre[world, item] = pack_facet_point(s)
        pair.start_facet_centre[world, item] = pack_facet_point(
            f.surface_point(mas, pair.start_displacement, world, item, xi)
        )

    @wp.kernel(module=module)
    def accept_boxes(pair: PairScratch):
        """Replace the boxes by the new ones."""
        index = wp.tid()
        pair.box_lower[index] = pair.refit_lower[index]
        pair.box_upper[index] = pair.refit_upper[index]
        if index == 0:
            pair.refit_needed[0] = 0
            pair.refit_count[0] = pair.refit_count[0] + 1

    return kernel_set(locals())
