"""Contact at a state: gap, elastic force and facet of every point, for fields and checks."""

import functools

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set
from ..common.types import f64, precision, vec3d
from .carriers import END, carrier_functions
from .collider_kinematics import collider_kinematics
from .collider_seams import SEAMS_SUFFIX
from .colliders import MESH_SUFFIX
from .facet_search import facet_search_kernels
from .facet_structs import facet_side_struct
from .friction import friction_functions
from .kinematics import kinematics_functions
from .law import OwnLaws, law_names
from .projection import OUTSIDE_TOLERANCE, facet_projection_functions
from .structs import FREE, collider_struct, contact_structs

__all__ = ["collider_evaluation_kernels", "pair_evaluation_kernels", "pair_results_struct"]


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
def collider_evaluation_kernels(dtype: str, meshes: bool, seams: bool, own: OwnLaws = ()) -> KernelSet:
    """Kernels for contact with colliders; arguments as of `contact_kernels` and `collider_kinematics`."""
    vec3 = precision(dtype).vec3
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    Colliders = collider_struct(meshes)
    k, law = kinematics_functions(dtype), friction_functions(dtype, own)
    g = collider_kinematics(dtype, meshes, seams)
    name = "_".join(["contact_evaluation", dtype, *law_names(own)])
    module = kernel_module(f"{name}{MESH_SUFFIX * meshes}{SEAMS_SUFFIX * seams}", max_unroll=SHORT_UNROLL)

    @wp.kernel(module=module)
    def points_at_state(
        con: Contacts, col: Colliders, facets: Facets, his: History, time: wp.array(dtype=f64),
        u: wp.array2d(dtype=vec3), scr: ContactScratch,
    ):  # fmt: skip
        """Point data at a state without motion, for evaluations outside of a step."""
        world, item, q = wp.tid()
        c = facets.contact[item]
        kc = col.of_contact[c]
        point = facets.first_point + item * facets.point_count + q
        shift = k.interpolate(facets, u, world, q, item)
        X = k.position_at(facets, q, k.column(facets, world, item))
        y = wp.transpose(col.rotation[world, kc]) * (X + shift - col.position[world, kc])
        now = k.activation_gap(con, his, world, c, point, time[world], col.margin[world, kc])
        g.set_start(col, scr, world, kc, point, y, -1, now)
        scr.start_displacement[world, point] = shift

    @wp.kernel(module=module)
    def evaluate_at_points(
        con: Contacts, col: Colliders, facets: Facets, his: History, u: wp.array2d(dtype=vec3d),
        time: wp.array(dtype=f64), scr: ContactScratch, places: int, gap: wp.array2d(dtype=f64),
        normal: wp.array2d(dtype=f64), force: wp.array2d(dtype=vec3d),
    ):  # fmt: skip
        """Gap, m, elastic normal force and elastic force, N, of each point at a state, without rates; with `places` the
        gap of a moving contact point is written at the point next to it."""
        world, item, q = wp.tid()
        point = facets.first_point + item * facets.point_count + q
        if facets.area_fraction[q, item] == f64(0.0):
            gap[world, point] = f64(1.0e30)
            return
        c = facets.contact[item]
        area_fraction = facets.area_fraction[q, item] * k.is_acting(con, scr, world, c, point)
        acting_point = point
        if facets.tracks_deepest != 0:  # the force at the contact point is written at a point of its facet
            gap[world, point] = -scr.point_depth[world, point]
            row = facets.first_row + item
            area_fraction = f64(0.0)
            acting_point = scr.contact_point[world, c]
            if scr.chosen_facet[world, c] == row:
                area_fraction = k.lagrange_polynomial(facets, q, scr.facet_deepest_xi[world, row])
                if wp.length_sq(
                    scr.facet_deepest_xi[world, row] - facets.point_coords[acting_point - (point - q)]
                ) == f64(0.0):
                    area_fraction = wp.where(acting_point == point, f64(1.0), f64(0.0))
            if area_fraction == f64(0.0) and acting_point != point:
                return
        t = g.evaluate(con, col, facets, his, scr, world, q, item, acting_point, u, time[world])
        t = law.with_normal_force(con, scr, world, c, acting_point, t, f64(0.0))
        frozen = law.friction_parameters(con, his, world, c, acting_point, t)
        if t.state == FREE:
            area_fraction = f64(0.0)
        if acting_point == point and (facets.tracks_deepest == 0 or places != 0):
            gap[world, point] = -t.depth
        normal[world, point] = area_fraction * t.normal_values[0]
        force[world, point] = area_fraction * (
            t.normal_values[0] * t.normal - law.friction_force(con, world, c, t, frozen, f64(0.0))
        )

    return kernel_set(locals())


@functools.cache
def pair_evaluation_kernels(dtype: str, own: OwnLaws = ()) -> KernelSet:
    """Kernels for contact between bodies; arguments as of `contact_kernels`."""
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    PairResults, Other = pair_results_struct(), facet_side_struct(dtype)
    k, law, search = kinematics_functions(dtype), friction_functions(dtype, own), facet_search_kernels(dtype)
    f_, displacement = facet_projection_functions(dtype), carrier_functions(dtype).displacement
    surface_point, inverse_map = f_.surface_point, f_.inverse_map
    module = kernel_module("_".join(["pair_evaluation", dtype, *law_names(own)]), max_unroll=SHORT_UNROLL)

    @wp.kernel(module=module)
    def evaluate_pairs(
        con: Contacts, other: Other, facets: Facets, his: History, time: wp.array(dtype=f64),
        u: wp.array2d(dtype=vec3d), far: f64, scr: ContactScratch, out: PairResults,
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
        U = other.scratch.displacement
        x = k.position_at(facets, q, k.column(facets, world, item))
        x += displacement(other.masters, facets, other.scratch, u, world, q, item, END)
        in_contact = his.speed[world, point] > f64(0.0)
        f = wp.int32(-1)
        found = wp.vec4d()
        if in_contact:
            f = other.history.facet[world, point] - 1
            found = inverse_map(other.masters, U, world, f, x, other.history.xi[world, point])
            if found[3] == f64(0.0):
                f = -1
        at_edge = k.is_edge(facets, item)
        if at_edge:
            f = other.scratch.facet[world, point]
        elif f < 0:
            found = search.closest_facet(other.masters, other.scratch, world, other.masters.surface_of[c], x, far,
                                         f64(OUTSIDE_TOLERANCE), vec3d(), f64(-1.0), f64(1.0))  # fmt: skip
            f = wp.int32(found[3])
        if f < 0:
            return
        xi = vec3d(found[0], found[1], found[2])
        base = xi
        t = PointContact()
        if at_edge:  # as `begin_edges` has found it
            xi = other.scratch.xi[world, point]
            t.normal = other.scratch.normal[world, point]
            t.depth = other.scratch.depth[world, point]
            base = other.scratch.projection[world, point]
        else:
            projection = f_.project_on_facet(other.masters, U, world, f, xi)
            t.normal = projection.normal
            t.depth = k.activation_gap(con, his, world, c, point, time[world], f64(0.0)) - (
                xi[2] * projection.gap_slope + projection.gap_offset
            )
            base = projection.xi
        t.previous_depth = t.depth
        t.stiffness_ratio = k.stiffness_ratio(con, facets, world, c, item, other.masters.element_depth[f])
        if in_contact:
            frame = search.facet_frame(surface_point(other.masters, U, world, f, xi))
            t.spring = k.turned_spring(con, his, world, c, point, frame)
        t = law.with_normal_force(con, scr, world, c, point, t, f64(0.0))
        frozen = law.friction_parameters(con, his, world, c, point, t)
        pressed = area_fraction * t.normal_values[0] * t.normal
        tangential_force = area_fraction * law.friction_force(con, world, c, t, frozen, f64(0.0))
        out.gap[world, point] = -t.depth
        out.normal[world, point] = area_fraction * t.normal_values[0]
        out.force[world, point] = pressed - tangential_force
        out.facet[world, point] = f
        out.xi[world, point] = xi
        for i in range(other.masters.conn.shape[0]):
            out.reaction[world, point, i] = (
                f_.shape_value(other.masters, f, i, xi) * tangential_force
                - f_.shape_value(other.masters, f, i, base) * pressed
            )

    return kernel_set(locals())
