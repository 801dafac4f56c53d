"""Contact between bodies at a state: gap, elastic force and facet of every point, for fields and checks."""

import functools
import types as _types

import warp as wp

from ..common.types import SHORT_UNROLL, kernel_module, kernel_set
from .facet_search import facet_search_kernels
from .facet_structs import master_struct, pair_history_struct, pair_scratch_struct
from .laws import PAPER, law_functions
from .point import contact_point_functions
from .projection import OUTSIDE_TOLERANCE, facet_projection_functions
from .structs import contact_scratch_struct, contact_struct, facet_struct, history_struct, world_value

__all__ = ["pair_evaluation_kernels", "pair_results_struct"]


@functools.cache
def pair_results_struct():
    """Result of the evaluation, [world, point]."""

    @wp.struct
    class PairResults:
        gap: wp.array2d(dtype=wp.float64)  # m, 1e30: no facet nearby
        normal: wp.array2d(dtype=wp.float64)  # normal force, N
        force: wp.array2d(dtype=wp.vec3d)  # on the slave, N
        facet: wp.array2d(dtype=wp.int32)  # -1: none
        xi: wp.array2d(dtype=wp.vec3d)  # coordinates on it
        reaction: wp.array3d(dtype=wp.vec3d)  # [world, point, local] forces on its slots, N

    return PairResults


@functools.cache
def pair_evaluation_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels in one precision of the model."""
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets, History = contact_struct(False), facet_struct(dtype), history_struct()
    ContactScratch, PairResults = contact_scratch_struct(dtype), pair_results_struct()
    Masters, PairHistory, PairScratch = master_struct(dtype), pair_history_struct(), pair_scratch_struct(dtype)
    k, places, seek = (
        contact_point_functions(dtype, False),
        facet_projection_functions(dtype),
        facet_search_kernels(dtype),
    )
    PointContact, interpolate, activation_gap, friction_parameters, with_friction_normal = (
        k.PointContact,
        k.interpolate,
        k.activation_gap,
        k.friction_parameters,
        k.with_friction_normal,
    )
    friction_force, normal_law = k.friction_force, law_functions().normal_law
    surface_point, inverse_map, distance_outside, unit_normal, facet_centre = (
        places.surface_point,
        places.inverse_map,
        places.distance_outside,
        places.unit_normal,
        places.facet_centre,
    )
    project_on_facet, shape_value, facet_frame, round_down, round_up = (
        places.project_on_facet,
        places.shape_value,
        seek.facet_frame,
        seek.round_down,
        seek.round_up,
    )
    module = kernel_module(f"pair_evaluation_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.func
    def closest_facet(mas: Masters, pair: PairScratch, world: int, surface: int, x: vec3d, far: f64) -> wp.vec4d:
        """Coordinates of x on the closest facet of a surface, and that facet; -1: none within `far`."""
        out = wp.vec4d(f64(0.0), f64(0.0), f64(0.0), f64(-1.0))
        height = far
        off = f64(OUTSIDE_TOLERANCE)
        pad = vec3d(far, far, far)
        root = wp.bvh_get_group_root(mas.tree, world * mas.surface_count + surface)
        query = wp.bvh_query_aabb(mas.tree, round_down(x - pad), round_up(x + pad), root)
        index = wp.int32(0)
        while wp.bvh_query_next(query, index):
            f = index - world * mas.facet_count
            corners = mas.corner_count[mas.facet_kind[f]]
            found = inverse_map(mas, pair.u_coefs, pair.director_u_coefs, world, f, x, facet_centre(corners))
            xi = vec3d(found[0], found[1], found[2])
            o = distance_outside(corners, xi)
            if found[3] != f64(0.0) and o <= off:
                s = surface_point(mas, pair.u_coefs, pair.director_u_coefs, world, f, xi)
                gap = xi[2] * wp.dot(unit_normal(s), s.director)
                closer = wp.abs(gap) < height or (wp.abs(gap) == height and f64(f) < out[3])
                if gap >= -mas.depth_limit[f] and (o < off or closer) and wp.abs(gap) <= far:
                    out = wp.vec4d(xi[0], xi[1], xi[2], f64(f))
                    height = wp.abs(gap)
                    off = o
        return out

    @wp.kernel(module=module)
    def evaluate_pairs(
        con: Contacts, mas: Masters, facets: Facets, his: History, pair_his: PairHistory, time: wp.array(dtype=f64),
        u: wp.array2d(dtype=vec3d), far: f64, scr: ContactScratch, pair: PairScratch, out: PairResults,
    ):  # fmt: skip
        """Gaps of points in contact on their facets, of others on the closest facet; elastic forces, without motion."""
        world, item, q = wp.tid()
        c = facets.contact[item]
        point = facets.first_point + item * facets.point_count + q
        area_fraction = facets.area_fraction[q, item]
        out.gap[world, point] = f64(1.0e30)
        out.facet[world, point] = -1
        if area_fraction == f64(0.0):
            return
        x = facets.X[q, item] + interpolate(facets, u, world, q, item)
        in_contact = his.speed[world, point] > f64(0.0)
        f = wp.int32(-1)
        place = vec3d()
        if in_contact:
            f = pair_his.facet[world, point] - 1
            found = inverse_map(mas, pair.u_coefs, pair.director_u_coefs, world, f, x, pair_his.xi[world, point])
            place = vec3d(found[0], found[1], found[2])
            if found[3] == f64(0.0):
                f = -1
        if f < 0:
            found = closest_facet(mas, pair, world, mas.surface_of[c], x, far)
            place = vec3d(found[0], found[1], found[2])
            f = wp.int32(found[3])
        if f < 0:
            return
        projection = project_on_facet(mas, pair.u_coefs, pair.director_u_coefs, world, f, place)
        s = PointContact()
        s.normal = projection.normal
        activation_gap_now = activation_gap(con, his, world, c, point, time[world], f64(0.0))
        s.depth = activation_gap_now - (place[2] * projection.gap_slope + projection.gap_offset)
        k_n = con.scale[world, c] * world_value(con.normal_stiffness, world, c)
        s.normal_values = normal_law(
            con.law[c], 0, k_n, f64(0.0), con.damping_ramp[c], con.force_eps[c], s.depth, s.depth
        )
        if in_contact:
            s.trial_displacement = his.spring[world, point]
            if con.law[c] != PAPER:
                s.trial_displacement = (
                    facet_frame(surface_point(mas, pair.u_coefs, pair.director_u_coefs, world, f, place))
                    * s.trial_displacement
                )
        s = with_friction_normal(s, s.normal)
        frozen = friction_parameters(con, his, scr, world, c, point, s)
        frozen[2] = f64(1.0)
        pressed = area_fraction * s.normal_values[0] * s.normal
        tangential_force = area_fraction * friction_force(con, world, c, s, frozen, f64(0.0))
        out.gap[world, point] = -s.depth
        out.normal[world, point] = area_fraction * s.normal_values[0]
        out.force[world, point] = pressed - tangential_force
        out.facet[world, point] = f
        out.xi[world, point] = place
        for i in range(mas.conn.shape[0]):
            out.reaction[world, point, i] = (
                shape_value(mas, f, i, place) * tangential_force - shape_value(mas, f, i, projection.xi) * pressed
            )

    return kernel_set(locals())
