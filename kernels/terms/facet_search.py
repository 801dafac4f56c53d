"""Master facet and coordinates of each slave point: boxes, tree, and search within it.

A point in contact stays on its facet, or passes to the one that contains it. Another point is in contact if it is
inside of a facet now and was outside of it at the start of the step; only boxes persist from step to step.
"""

import functools
import types as _types

import warp as wp

from ..common.types import SHORT_UNROLL, kernel_module, precision
from .broad_phase import MARGIN, broad_phase_kernels
from .contact import MIN_APPROACH_SPEED
from .contact_laws import PAPER
from .contact_point import contact_point_functions
from .contact_structs import clock_struct, contact_scratch_struct, contact_struct, facet_struct, history_struct
from .facet_projection import MAX_OVERHANG, OUTSIDE_TOLERANCE, facet_projection_functions
from .pair_structs import master_struct, pair_history_struct, pair_scratch_struct

__all__ = ["MARGIN", "PENETRATED", "facet_search_kernels"]

PENETRATED = -2
"""Facet of a point that has left through the opposite side."""
MIN_NORMAL_COSINE = 0.1
"""Minimum cosine of the normals of two facets that a point in contact passes between: excludes the edge of a box."""
PASSED_DEPTH = 0.25
"""Depth over the allowed depth above which a point without a facet has passed through."""
OPPOSING_COSINE = 0.5
"""Cosine of a facet's normal and the slave's reversed normal above which they face each other; below its negative they
face the same way."""
MAX_DEPTH_RATIO = 2.0
"""Largest depth of a point that enters from beside a facet, over the deepest active penetration."""
MAX_EDGE_TANGENT = 2.0
"""Maximum tangent of the angle between an outward vector and the normal of its facet, at the edge of a box."""
TANGENT_PLANE_MARGIN = 0.5
"""Parametric margin for rejecting a facet by the tangent plane at its midpoint."""


@functools.cache
def facet_search_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels in one precision of the displacements."""
    p = precision(dtype)
    vec3 = p.vec3
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets, History = contact_struct(False), facet_struct(dtype), history_struct()
    ContactScratch, Clock = contact_scratch_struct(dtype), clock_struct()
    Masters, PairHistory, PairScratch = master_struct(dtype), pair_history_struct(), pair_scratch_struct(dtype)
    k, f = contact_point_functions(dtype, False), facet_projection_functions(dtype)
    interpolate, contact_distance, remaining_overlap = k.interpolate, k.contact_distance, k.remaining_overlap
    (
        surface_point, polynomial_value, displacement_change, local_components, distance_outside, facet_centre,
        inverse_map, track_point, unit_normal, project_on_facet,
    ) = (
        f.surface_point, f.polynomial_value, f.displacement_change, f.local_components, f.distance_outside,
        f.facet_centre, f.inverse_map, f.track_point, f.unit_normal, f.project_on_facet
    )  # fmt: skip
    SurfacePoint, boxes = f.SurfacePoint, broad_phase_kernels(dtype)
    down, up, contains, unpack_surface_point = boxes.down, boxes.up, boxes.contains, boxes.unpack_surface_point
    module = kernel_module(f"pair_seek_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.struct
    class FacetCandidate:
        """Candidate facet of a point."""

        facet: wp.int32  # -1: none
        xi: vec3d
        outside_distance: f64  # distance beyond the sides of the facet; 0 within its `edge_margin`
        total_outside_distance: f64  # distance beyond the sides without that margin
        height: f64  # height above the facet
        rank: wp.int32  # see `candidate_rank`
        entered: wp.bool  # the point passed a side of the body
        needs_entry: wp.bool  # it must have, for this facet to be accepted

    @wp.func
    def approach_speed(
        mas: Masters, facets: Facets, pair: PairScratch, v: wp.array2d(dtype=vec3), world: int, q: int, item: int,
        f: int, xi: vec3d, n: vec3d,
    ) -> f64:  # fmt: skip
        """Approach speed of a point towards a facet at the start of the attempt, m/s."""
        projection = vec3d(xi[0], xi[1], f64(0.0))
        return wp.dot(
            n, polynomial_value(mas, pair.V0, pair.V0, world, f, projection) - interpolate(facets, v, world, q, item)
        )

    @wp.func
    def set_anchor(
        mas: Masters, facets: Facets, his: History, pair_his: PairHistory, clock: Clock, scr: ContactScratch,
        pair: PairScratch, v_n: wp.array2d(dtype=vec3), world: int, q: int, item: int, point: int, f: int, start: vec3d,
    ):  # fmt: skip
        """Set the facet that a point's motion is relative to: start coordinates on it, depth and approach speed at the
        start."""
        found = inverse_map(mas, pair.C0, pair.D0, world, f, pair.x0[world, point], start)
        xi = vec3d(found[0], found[1], found[2])
        in_contact = his.speed[world, point] > f64(0.0)
        if found[3] == f64(0.0):
            if not in_contact:
                return
            xi = start
        if in_contact and distance_outside(mas.corners[mas.kind[f]], xi) > f64(OUTSIDE_TOLERANCE):
            return  # it has left the surface
        projection = project_on_facet(mas, pair.C0, pair.D0, world, f, xi)
        pair.anchor_facet[world, point] = f + 1
        pair.anchor_xi[world, point] = xi
        pair.anchor_gap[world, point] = wp.vec2d(projection.gap_slope, projection.gap_offset)
        scr.depth[world, point] = scr.contact_distance[world, point] - (
            xi[2] * projection.gap_slope + projection.gap_offset
        )
        speed = wp.max(his.speed[world, point], f64(MIN_APPROACH_SPEED))
        if clock.still == 0:
            speed = wp.max(speed, approach_speed(mas, facets, pair, v_n, world, q, item, f, xi, projection.n))
        scr.speed[world, point] = speed

    @wp.kernel(module=module)
    def begin_points(
        con: Contacts, mas: Masters, facets: Facets, his: History, pair_his: PairHistory, clock: Clock,
        u_n: wp.array2d(dtype=vec3), v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), scr: ContactScratch,
        pair: PairScratch,
    ):  # fmt: skip
        """Start positions of the points; depth and approach speed of those in contact."""
        world, item, q = wp.tid()
        if active[world] == 0:
            return
        if q == 0 and item == 0 and facets.row == 0:
            scr.passed_through[world] = 0
            scr.limit_updates[world] = 0
            if clock.part[world] == 0:
                scr.elapsed[world] = f64(0.0)
        if facets.area_fraction[q, item] == f64(0.0):
            return
        c = facets.contact[item]
        point = facets.point + item * facets.points + q
        shift = interpolate(facets, u_n, world, q, item)
        x = facets.X[q, item] + shift
        pair.x0[world, point] = x
        scr.origin[world, point] = shift
        scr.depth[world, point] = f64(-1.0e30)
        scr.speed[world, point] = f64(MIN_APPROACH_SPEED)
        pair.anchor_facet[world, point] = 0
        scr.contact_distance[world, point] = contact_distance(con, his, world, c, point, clock.time[world], f64(0.0))
        if his.speed[world, point] > f64(0.0):
            set_anchor(mas, facets, his, pair_his, clock, scr, pair, v_n, world, q, item, point,
                pair_his.facet[world, point] - 1,
                   pair_his.xi[world, point])  # fmt: skip
            if pair.anchor_facet[world, point] > 0:
                depth = scr.depth[world, point]
                for i in range(2):
                    body = mas.bodies[c][i]
                    if depth > pair.deepest_contact[world, body]:
                        wp.atomic_max(pair.deepest_contact, world, body, depth)

    @wp.kernel(module=module)
    def query_boxes(
        con: Contacts, mas: Masters, facets: Facets, his: History, u: wp.array2d(dtype=vec3d),
        active: wp.array(dtype=wp.int32), search_distance: f64, pair: PairScratch,
    ):  # fmt: skip
        """Flag slave facets with a master facet's box nearby; for the others store the box without master facets."""
        world, item = wp.tid()
        if active[world] == 0:
            return
        row = facets.row + item
        low = vec3d(f64(1.0e300), f64(1.0e300), f64(1.0e300))
        high = -low
        inside = f64(0.0)
        for q in range(facets.points):
            x = facets.X[q, item] + interpolate(facets, u, world, q, item)
            y = pair.x0[world, facets.point + item * facets.points + q]
            if facets.area_fraction[q, item] > f64(0.0):
                low = wp.min(low, wp.min(x, y))
                high = wp.max(high, wp.max(x, y))
                inside = wp.max(inside, his.overlap[world, facets.point + item * facets.points + q])
        if low[0] > high[0]:
            pair.in_reach[world, row] = 0
            return
        far = search_distance + inside
        pad = vec3d(far, far, far)
        empty_box_known = pair.empty_box_refit[world, row] == pair.refits[0]
        if empty_box_known and contains(
            pair.empty_box_lower[world, row], pair.empty_box_upper[world, row], down(low - pad), up(high + pad)
        ):
            pair.in_reach[world, row] = 0
            return
        room = f64(2.0) * far + f64(MARGIN) * wp.length(high - low)
        wide = vec3d(room, room, room)
        root = wp.bvh_get_group_root(mas.tree, world * mas.surfaces + mas.surface_of[facets.contact[item]])
        query = wp.bvh_query_aabb(mas.tree, down(low - wide), up(high + wide), root)
        index = wp.int32(0)
        if wp.bvh_query_next(query, index):
            pair.in_reach[world, row] = 1
            pair.empty_box_refit[world, row] = -1
            return
        pair.in_reach[world, row] = 0
        pair.empty_box_refit[world, row] = pair.refits[0]
        pair.empty_box_lower[world, row] = down(low - wide)
        pair.empty_box_upper[world, row] = up(high + wide)

    @wp.func
    def passed_through_facet(mas: Masters, pair: PairScratch, world: int, f: int, x: vec3d, x0: vec3d) -> bool:
        """True if a point entered through a facet during the step, and deep."""
        kind = mas.kind[f]
        m = facet_centre(mas.corners[kind])
        old = unpack_surface_point(pair.centre0[world, f])
        new = unpack_surface_point(pair.centre[world, f])
        position_change = x - x0 - (new.x - old.x)
        deep = f64(PASSED_DEPTH) * mas.depth_limit[f]
        if wp.length(position_change) <= deep:
            return False
        g0 = wp.dot(x0 - old.x, unit_normal(old))
        g1 = wp.dot(x - new.x, unit_normal(new))
        if g0 <= f64(0.0) or g1 >= -deep:
            return False
        y = x - (g1 / (g1 - g0)) * position_change
        there = inverse_map(mas, pair.C, pair.D, world, f, y, m)
        xi = vec3d(there[0], there[1], there[2])
        return there[3] != f64(0.0) and distance_outside(mas.corners[kind], xi) == f64(0.0)

    @wp.func
    def frame(s: SurfacePoint) -> wp.mat33d:
        """Columns: first tangent of a facet, second tangent, outward normal."""
        n = wp.normalize(wp.cross(s.a, s.b))
        a = wp.normalize(s.a)
        return wp.matrix_from_cols(a, wp.cross(n, a), n)

    @wp.func
    def set_contact(
        con: Contacts, mas: Masters, facets: Facets, his: History, pair_his: PairHistory, clock: Clock,
        scr: ContactScratch, pair: PairScratch, v_n: wp.array2d(dtype=vec3), world: int, c: int, q: int, item: int,
        point: int, f: int, xi: vec3d, shift: vec3d, overlap_limit: f64,
    ):  # fmt: skip
        """Contact data of a point on a facet: depth now and at the start of the attempt, normal, motion."""
        projection = project_on_facet(mas, pair.C, pair.D, world, f, xi)
        now = contact_distance(con, his, world, c, point, clock.new_time[world], f64(0.0))
        pair.facet[world, point] = f
        pair.xi[world, point] = xi
        pair.projection[world, point] = projection.xi
        pair.normal[world, point] = projection.n
        pair.depth[world, point] = now - (xi[2] * projection.gap_slope + projection.gap_offset)
        if pair.anchor_facet[world, point] == 0 and overlap_limit == f64(0.0):
            set_anchor(mas, facets, his, pair_his, clock, scr, pair, v_n, world, q, item, point, f, xi)
        motion = shift - scr.origin[world, point]
        spring = vec3d()
        if pair.anchor_facet[world, point] > 0:
            first = pair.anchor_facet[world, point] - 1
            from0 = pair.anchor_xi[world, point]
            motion -= displacement_change(mas, pair.C, pair.D, pair.C0, pair.D0, world, first, from0)
            if f == first:  # sum of motions: a difference of positions would lose digits
                before = pair.anchor_gap[world, point]
                rise = (
                    (xi[2] - from0[2]) * projection.gap_slope + from0[2] * (projection.gap_slope - before[0]) +
                    (projection.gap_offset - before[1])
                )  # fmt: skip
                pair.depth[world, point] = scr.depth[world, point] + (now - scr.contact_distance[world, point]) - rise
            pair.initial_depth[world, point] = scr.depth[world, point]
            if his.speed[world, point] > f64(0.0):
                spring = his.spring[world, point]
                if con.law[c] != PAPER:
                    spring = frame(surface_point(mas, pair.C, pair.D, world, first, from0)) * spring
        else:
            motion -= displacement_change(mas, pair.C, pair.D, pair.C0, pair.D0, world, f, xi)
            pair.initial_depth[world, point] = (
                pair.depth[world, point] + wp.dot(projection.n, motion) - (now - scr.contact_distance[world, point])
            )
        pair.relative_motion[world, point] = motion
        pair.elastic_slip[world, point] = spring + motion

    @wp.func
    def is_far(mas: Masters, pair: PairScratch, world: int, f: int, x: vec3d, x0: vec3d, pad: f64) -> bool:
        """True if a point is above a facet by more than `pad`, or moved little and is beside it, by the tangent plane
        at its midpoint."""
        corners = mas.corners[mas.kind[f]]
        s = unpack_surface_point(pair.centre[world, f])
        if wp.dot(x - s.x, unit_normal(s)) > f64(2.0) * pad + pair.bulge[world, f]:
            return True
        if distance_outside(corners, facet_centre(corners) + local_components(s, x - s.x)) <= f64(TANGENT_PLANE_MARGIN):
            return False
        path = x - x0 - (s.x - pair.centre0[world, f][0])
        return wp.length(path) <= f64(0.5) * mas.depth_limit[f]

    @wp.func
    def in_front(mas: Masters, pair: PairScratch, world: int, f: int, x: vec3d, pad: f64) -> bool:
        """True if a point is above a facet by more than `pad` and within its sides."""
        corners = mas.corners[mas.kind[f]]
        found = inverse_map(mas, pair.C, pair.D, world, f, x, facet_centre(corners))
        within = distance_outside(corners, vec3d(found[0], found[1], found[2])) == f64(0.0)
        return found[3] != f64(0.0) and within and found[2] > pad

    @wp.func
    def opposite_normal(facets: Facets, pair: PairScratch, world: int, item: int, corners: wp.vec3i) -> vec3d:
        """Inward normal of a slave facet at the start of the attempt; 0 if undefined."""
        if corners[0] < 0:
            return vec3d()
        point = facets.point + item * facets.points
        x = pair.x0[world, point + corners[0]]
        return wp.normalize(wp.cross(pair.x0[world, point + corners[2]] - x, pair.x0[world, point + corners[1]] - x))

    @wp.func
    def edge_margin(mas: Masters, f: int, xi: vec3d) -> f64:
        """Tolerance beyond a side, over its length, for points below an edge, where outward vectors are inclined."""
        return wp.max(-f64(MAX_EDGE_TANGENT) * xi[2] / mas.size[f], f64(0.0))

    @wp.func
    def entered_sideways(
        mas: Masters, scr: ContactScratch, pair: PairScratch, world: int, c: int, point: int, f: int, xi: vec3d,
        gap: f64
    ) -> bool:  # fmt: skip
        """True if a point is at a facet now, was beside it at the start of the attempt, and was below its plane by at
        most the penetration of the bodies' contact: it slid under the edge of a body that has sunk in."""
        kind = mas.kind[f]
        most = wp.max(pair.deepest_contact[world, mas.bodies[c][0]], pair.deepest_contact[world, mas.bodies[c][1]])
        depth = scr.contact_distance[world, point] - gap
        if depth > wp.min(f64(MAX_DEPTH_RATIO) * most, f64(PASSED_DEPTH) * mas.depth_limit[f]):
            return False
        if distance_outside(mas.corners[kind], xi) > edge_margin(mas, f, xi):
            return False
        found = inverse_map(mas, pair.C0, pair.D0, world, f, pair.x0[world, point], xi)
        return found[3] == f64(0.0) or distance_outside(mas.corners[kind], vec3d(found[0], found[1], found[2])) > f64(
            0.0
        )

    @wp.func
    def candidate_rank(
        mas: Masters, scr: ContactScratch, pair: PairScratch, world: int, c: int, point: int, f: int, xi: vec3d,
        pad: f64, left: f64, anchored: bool, facing: vec3d, overlap_limit: f64,
    ) -> int:  # fmt: skip
        """Rank of a facet for a point, -1: rejected by depth, by the previous facet, or by the side at the start of the
        attempt. Higher for facets that face the slave's; among others, for one that the point reached from beside."""
        s = surface_point(mas, pair.C, pair.D, world, f, xi)
        n = unit_normal(s)
        cosine = wp.dot(n, facing)
        gap = xi[2] * wp.dot(n, s.c)
        if -gap > mas.depth_limit[f] or gap > pad:  # boxes depend on the other worlds: this test does not
            return -1
        if anchored:
            return wp.where(cosine > f64(MIN_NORMAL_COSINE), 0, -1)
        rank = wp.where(cosine > f64(OPPOSING_COSINE), 4, wp.where(cosine > -f64(OPPOSING_COSINE), 1, 0))
        if overlap_limit > f64(0.0):
            rank = 0
        else:
            projection = surface_point(mas, pair.C0, pair.D0, world, f, vec3d(xi[0], xi[1], f64(0.0)))
            before = wp.dot(pair.x0[world, point] - projection.x, unit_normal(projection))
            if before < -left:
                if rank == 0 or not entered_sideways(mas, scr, pair, world, c, point, f, xi, before):
                    return -1
                rank = wp.where(rank == 4, 3, 2)
        return rank

    @wp.func
    def better_candidate(
        mas: Masters, scr: ContactScratch, pair: PairScratch, world: int, c: int, point: int, f: int, x: vec3d,
        pad: f64, left: f64, anchored: bool, facing: vec3d, overlap_limit: f64, candidate: FacetCandidate,
    ) -> FacetCandidate:  # fmt: skip
        """The better of a candidate and another facet for a point."""
        out = candidate
        corners = mas.corners[mas.kind[f]]
        found = inverse_map(mas, pair.C, pair.D, world, f, x, facet_centre(corners))
        xi = vec3d(found[0], found[1], found[2])
        o = distance_outside(corners, xi)
        slack = f64(0.0)
        if not anchored and overlap_limit == f64(0.0):
            slack = edge_margin(mas, f, xi)
        if found[3] == f64(0.0) or o > wp.min(wp.max(candidate.outside_distance, slack), f64(OUTSIDE_TOLERANCE)):
            return out
        rank = candidate_rank(mas, scr, pair, world, c, point, f, xi, pad, left, anchored, facing, overlap_limit)
        beside = rank == 2 or rank == 3
        near = beside and o > f64(0.0)
        out.entered = out.entered or (rank >= 0 and not beside)
        beyond = o
        if rank > 1 and o <= slack:
            o = f64(0.0)
        closer = wp.abs(xi[2]) < candidate.height or (wp.abs(xi[2]) == candidate.height and f < candidate.facet)
        closer = beyond < candidate.total_outside_distance or (closer and beyond == candidate.total_outside_distance)
        closer = rank > candidate.rank or (closer and rank == candidate.rank)
        if rank >= 0 and (
            o < candidate.outside_distance or candidate.facet < 0 or (o == candidate.outside_distance and closer)
        ):
            out = FacetCandidate(f, xi, o, beyond, wp.abs(xi[2]), rank, out.entered, near)
        return out

    @wp.kernel(module=module)
    def find_facets(
        con: Contacts, mas: Masters, facets: Facets, his: History, pair_his: PairHistory, clock: Clock,
        u: wp.array2d(dtype=vec3d), v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), overlap_limit: f64,
        scr: ContactScratch, pair: PairScratch, corner_points: wp.array(dtype=wp.vec3i),
    ):  # fmt: skip
        """Facet of each point at an iterate. `overlap_limit` > 0: no step; inner points up to that depth, m, are in
        contact. `corner_points`: three points of each slave facet, or -1."""
        world, item, q = wp.tid()
        if active[world] == 0:
            return
        point = facets.point + item * facets.points + q
        pair.facet[world, point] = -1
        if facets.area_fraction[q, item] == f64(0.0):
            return
        if his.speed[world, point] <= f64(0.0) and pair.in_reach[world, facets.row + item] == 0:
            return
        c = facets.contact[item]
        shift = interpolate(facets, u, world, q, item)
        x = facets.X[q, item] + shift
        x0 = pair.x0[world, point]
        candidate = FacetCandidate(
            -1, vec3d(), f64(OUTSIDE_TOLERANCE), f64(OUTSIDE_TOLERANCE), f64(1.0e300), -1, False, False
        )
        if overlap_limit > f64(0.0):
            candidate.outside_distance = f64(0.0)  # no tolerance: a point in front of one face may be beside another
        inside = remaining_overlap(con, his, world, c, point, clock.time[world])
        pad = overlap_limit + inside + wp.abs(con.offset[c]) + f64(1.0e-6) * wp.length(x)
        through = bool(False)
        anchored = pair.anchor_facet[world, point] > 0
        motion = vec3d()
        from0 = pair.anchor_xi[world, point]
        if anchored:
            f = pair.anchor_facet[world, point] - 1
            motion = (
                shift - scr.origin[world, point] - displacement_change(mas, pair.C, pair.D, pair.C0, pair.D0, world, f,
                from0)
            )  # fmt: skip
            found = track_point(mas, pair.C, pair.D, world, f, from0, motion)
            if found[3] == f64(0.0):
                found = inverse_map(mas, pair.C, pair.D, world, f, x, facet_centre(mas.corners[mas.kind[f]]))
            xi = vec3d(found[0], found[1], found[2])
            o = distance_outside(mas.corners[mas.kind[f]], xi)
            if found[3] != f64(0.0) and (
                o <= candidate.outside_distance or (o <= f64(MAX_OVERHANG) and his.speed[world, point] > f64(0.0))
            ):
                candidate = FacetCandidate(f, xi, o, o, wp.abs(xi[2]), -1, False, False)
            pad += f64(2.0) * wp.abs(from0[2])
        if candidate.facet < 0 or candidate.outside_distance > f64(OUTSIDE_TOLERANCE):
            facing = vec3d()
            free = not anchored and overlap_limit == f64(0.0)
            if anchored:
                f = pair.anchor_facet[world, point] - 1
                facing = unit_normal(surface_point(mas, pair.C, pair.D, world, f, from0))
                through = scr.depth[world, point] - wp.dot(motion, facing) > f64(PASSED_DEPTH) * mas.depth_limit[f]
            wide = vec3d(pad, pad, pad)
            root = wp.bvh_get_group_root(mas.tree, world * mas.surfaces + mas.surface_of[c])
            query = wp.bvh_query_aabb(mas.tree, down(wp.min(x, x0) - wide), up(wp.max(x, x0) + wide), root)
            index = wp.int32(0)
            left = inside + mas.touch_depth - wp.min(con.offset[c], f64(0.0))
            while wp.bvh_query_next(query, index):
                f = index - world * mas.count
                if is_far(mas, pair, world, f, x, x0, pad):
                    continue
                if free and wp.length_sq(facing) == f64(0.0):
                    facing = opposite_normal(facets, pair, world, item, corner_points[item])
                candidate = better_candidate(
                    mas, scr, pair, world, c, point, f, x, pad, left, anchored, facing, overlap_limit, candidate
                )
                if free and passed_through_facet(mas, pair, world, f, x, x0):
                    through = True
            if candidate.needs_entry and not candidate.entered:
                candidate.facet = -1  # it passed no side of the body
            if candidate.facet >= 0 and candidate.outside_distance > f64(0.0) and not anchored:
                query = wp.bvh_query_aabb(mas.tree, down(wp.min(x, x0) - wide), up(wp.max(x, x0) + wide), root)
                while wp.bvh_query_next(query, index):
                    if in_front(mas, pair, world, index - world * mas.count, x, pad):
                        candidate.facet = -1  # beside a facet, and outside of the body
        if candidate.facet >= 0:
            set_contact(con, mas, facets, his, pair_his, clock, scr, pair, v_n, world, c, q, item, point,
                candidate.facet, candidate.xi, shift, overlap_limit)  # fmt: skip
            most = mas.depth_limit[candidate.facet] * wp.where(
                candidate.outside_distance > f64(OUTSIDE_TOLERANCE), f64(PASSED_DEPTH), f64(1.0)
            )
            if pair.depth[world, point] > most:
                pair.facet[world, point] = PENETRATED
        elif through:
            pair.facet[world, point] = PENETRATED

    return _types.SimpleNamespace(
        **vars(boxes), module=module, begin_points=begin_points, query_boxes=query_boxes, find_facets=find_facets,
        frame=frame,
    )  # fmt: skip
