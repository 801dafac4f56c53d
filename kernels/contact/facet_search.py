"""Master facet and coordinates of each slave point, and its motion relative to it.

A point in contact stays on its facet, or passes to the one that contains it. Another point is in contact if it is
inside of a facet now and was outside of it at the start of the step; only boxes persist from step to step.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set, masked_kernel
from ..common.types import f64, precision, vec3d
from .broad_phase import BOX_MARGIN, broad_phase_kernels, search_module
from .carriers import END, START, carrier_functions
from .collider_seams import SEAMS_SUFFIX
from .facet_candidates import facet_candidate_functions
from .facet_seams import facet_seam_functions
from .facet_structs import master_struct, pair_history_struct, pair_scratch_struct
from .kinematics import kinematics_functions
from .law import MIN_APPROACH_SPEED
from .projection import OUTSIDE_TOLERANCE, facet_projection_functions
from .structs import contact_structs

__all__ = ["BOX_MARGIN", "PENETRATED", "facet_search_kernels"]

PENETRATED, LEAVING = -2, -3
"""Facet of a point that has left through the opposite side; of one, at the start of an attempt, that is to pass on."""
PASSING_DISTANCE = 0.025
"""Distance beyond a side, over its length, from which a step begins on the next facet: in a valley a step that begins
near the `OUTSIDE_TOLERANCE` of one facet may end on neither."""


@functools.cache
def facet_search_kernels(dtype: str, seams: bool = False) -> KernelSet:
    """Kernels in one precision of the displacements; `seams`: some contact has neighbours, see facet_seams.py."""
    p = precision(dtype)
    vec3 = p.vec3
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    Masters, PairHistory, PairScratch = master_struct(dtype), pair_history_struct(), pair_scratch_struct(dtype)
    k, f, carried = kinematics_functions(dtype), facet_projection_functions(dtype), carrier_functions(dtype)
    surface_point, facet_value, displacement_change = f.surface_point, f.facet_value, f.displacement_change
    distance_outside, inverse_map, project_on_facet = f.distance_outside, f.inverse_map, f.project_on_facet
    unit_normal = f.unit_normal
    FacetPoint, boxes, candidates = f.FacetPoint, broad_phase_kernels(dtype), facet_candidate_functions(dtype)
    SlavePoint, slave_point, slave_point_at = candidates.SlavePoint, candidates.slave_point, candidates.slave_point_at
    module = search_module(f"{dtype}{SEAMS_SUFFIX * seams}")
    if seams:
        level_candidate = facet_seam_functions(dtype).level_candidate

    @wp.func
    def set_anchor(
        mas: Masters, facets: Facets, his: History, clock: Clock, scr: ContactScratch, pair: PairScratch,
        v_n: wp.array2d(dtype=vec3), slave: SlavePoint, f: int, start: vec3d,
    ):  # fmt: skip
        """Set the facet that a point's motion is relative to: start coordinates on it, depth and approach speed at the
        start."""
        world = slave.world
        point = slave.point
        found = inverse_map(mas, pair.start_displacement, world, f, scr.start_position[world, point], start)
        xi = vec3d(found[0], found[1], found[2])
        in_contact = his.speed[world, point] > f64(0.0)
        if found[3] == f64(0.0):
            if not in_contact:
                return
            xi = start
        if in_contact and distance_outside(mas.corner_count[mas.facet_kind[f]], xi) > f64(OUTSIDE_TOLERANCE):
            return  # it has left the surface
        projection = project_on_facet(mas, pair.start_displacement, world, f, xi)
        pair.anchor_facet[world, point] = f + 1
        pair.anchor_xi[world, point] = xi
        pair.anchor_gap[world, point] = wp.vec2d(projection.gap_slope, projection.gap_offset)
        scr.start_depth[world, point] = scr.activation_gap[world, point] - (
            xi[2] * projection.gap_slope + projection.gap_offset
        )
        speed = f64(0.0)
        if clock.is_static == 0:
            q, item = slave.number_in_facet, slave.slave_facet
            own = carried.velocity(mas, facets, pair, v_n, world, q, item, clock.h[world])
            speed = wp.dot(projection.normal, facet_value(mas, pair.start_velocity, world, f, xi) - own)
        scr.approach_speed[world, point] = k.approach_speed(his, world, point, speed)

    @wp.func
    def begin_point(
        con: Contacts, mas: Masters, facets: Facets, his: History, pair_his: PairHistory, clock: Clock,
        scr: ContactScratch, pair: PairScratch, u_n: wp.array2d(dtype=vec3), v_n: wp.array2d(dtype=vec3),
        slave: SlavePoint,
    ):  # fmt: skip
        """Start position of a point; depth and approach speed of one in contact."""
        world = slave.world
        point = slave.point
        c = slave.contact
        q, item = slave.number_in_facet, slave.slave_facet
        shift = carried.displacement(mas, facets, pair, u_n, world, q, item, START)
        scr.start_position[world, point] = facets.X[slave.number_in_facet, slave.slave_facet] + shift
        scr.start_displacement[world, point] = shift
        scr.start_depth[world, point] = f64(-1.0e30)
        scr.approach_speed[world, point] = f64(MIN_APPROACH_SPEED)
        pair.anchor_facet[world, point] = 0
        pair.facet[world, point] = -1
        scr.activation_gap[world, point] = k.activation_gap(con, his, world, c, point, clock.time[world], f64(0.0))
        if his.speed[world, point] > f64(0.0):
            f = pair_his.facet[world, point] - 1
            set_anchor(mas, facets, his, clock, scr, pair, v_n, slave, f, pair_his.xi[world, point])
            if pair.anchor_facet[world, point] > 0:
                corners = mas.corner_count[mas.facet_kind[f]]
                beyond = distance_outside(corners, pair.anchor_xi[world, point]) > f64(PASSING_DISTANCE)
                pair.facet[world, point] = wp.where(beyond and con.is_explicit[c] == 0, LEAVING, -1)
                depth = scr.start_depth[world, point]
                for i in range(2):
                    body = mas.bodies[c][i]
                    if depth > pair.deepest_contact[world, body]:
                        wp.atomic_max(pair.deepest_contact, world, body, depth)

    @masked_kernel(module, "active")
    def query_boxes(
        mas: Masters, facets: Facets, his: History, u: wp.array2d(dtype=vec3d),
        active: wp.array(dtype=wp.int32), search_distance: f64, scr: ContactScratch, pair: PairScratch,
    ):  # fmt: skip
        """Flag slave facets with a master facet's box nearby; for the others store the box without master facets."""
        world, item = wp.tid()
        row = facets.first_row + item
        if k.is_edge(facets, item):
            return
        low = vec3d(f64(1.0e300), f64(1.0e300), f64(1.0e300))
        high = -low
        inside = f64(0.0)
        for q in range(facets.point_count):
            x = facets.X[q, item] + carried.displacement(mas, facets, pair, u, world, q, item, END)
            y = scr.start_position[world, facets.first_point + item * facets.point_count + q]
            if facets.area_fraction[q, item] > f64(0.0):
                low = wp.min(low, wp.min(x, y))
                high = wp.max(high, wp.max(x, y))
                inside = wp.max(inside, his.overlap[world, facets.first_point + item * facets.point_count + q])
        if low[0] > high[0]:
            pair.in_reach[world, row] = 0
            return
        far = search_distance + inside
        pad = vec3d(far, far, far)
        empty_box_known = pair.empty_box_refit[world, row] == pair.refit_count[0]
        if empty_box_known and boxes.contains(
            pair.empty_box_lower[world, row],
            pair.empty_box_upper[world, row],
            boxes.round_down(low - pad),
            boxes.round_up(high + pad),
        ):
            pair.in_reach[world, row] = 0
            return
        room = f64(2.0) * far + f64(BOX_MARGIN) * wp.length(high - low)
        wide = vec3d(room, room, room)
        root = wp.bvh_get_group_root(mas.tree, world * mas.surface_count + mas.surface_of[facets.contact[item]])
        query = wp.bvh_query_aabb(mas.tree, boxes.round_down(low - wide), boxes.round_up(high + wide), root)
        index = wp.int32(0)
        if wp.bvh_query_next(query, index):
            pair.in_reach[world, row] = 1
            pair.empty_box_refit[world, row] = -1
            return
        pair.in_reach[world, row] = 0
        pair.empty_box_refit[world, row] = pair.refit_count[0]
        pair.empty_box_lower[world, row] = boxes.round_down(low - wide)
        pair.empty_box_upper[world, row] = boxes.round_up(high + wide)

    @wp.func
    def has_turned_over(pair: PairScratch, world: int, f: int) -> bool:
        """True if a facet has turned by more than a right angle in the attempt: motions along chords say nothing."""
        old = boxes.unpack_facet_point(pair.start_facet_centre[world, f])
        new = boxes.unpack_facet_point(pair.facet_centre[world, f])
        return wp.dot(unit_normal(old), unit_normal(new)) < f64(0.0)

    @wp.func
    def facet_frame(s: FacetPoint) -> wp.mat33d:
        """Columns: first tangent of a facet, second tangent, outward normal."""
        n = wp.normalize(wp.cross(s.tangent_a, s.tangent_b))
        a = wp.normalize(s.tangent_a)
        return wp.matrix_from_cols(a, wp.cross(n, a), n)

    @wp.func
    def update_anchor(
        mas: Masters, facets: Facets, his: History, clock: Clock, scr: ContactScratch, pair: PairScratch,
        v_n: wp.array2d(dtype=vec3), slave: SlavePoint, f: int, xi: vec3d,
    ):  # fmt: skip
        """Set the anchor of a point that has none, or move that of one in contact to another facet before a step, with
        its elastic slip to the axes of that one."""
        world, point = slave.world, slave.point
        first = pair.anchor_facet[world, point] - 1
        U = pair.start_displacement
        before = wp.identity(n=3, dtype=f64)
        if first >= 0:
            before = facet_frame(surface_point(mas, U, world, first, pair.anchor_xi[world, point]))
        set_anchor(mas, facets, his, clock, scr, pair, v_n, slave, f, xi)
        if first >= 0 and pair.anchor_facet[world, point] != first + 1:
            after = facet_frame(surface_point(mas, U, world, f, pair.anchor_xi[world, point]))
            his.spring[world, point] = wp.transpose(after) * (before * his.spring[world, point])

    @wp.func
    def set_contact(
        con: Contacts, mas: Masters, his: History, clock: Clock, scr: ContactScratch, pair: PairScratch,
        slave: SlavePoint, f: int, xi: vec3d,
    ):  # fmt: skip
        """Contact data of a point on a facet: depth now and at the start of the attempt, normal, motion."""
        world = slave.world
        point = slave.point
        c = slave.contact
        projection = project_on_facet(mas, pair.displacement, world, f, xi)
        now = k.activation_gap(con, his, world, c, point, clock.new_time[world], f64(0.0))
        pair.facet[world, point] = f
        pair.xi[world, point] = xi
        pair.projection[world, point] = projection.xi
        pair.normal[world, point] = projection.normal
        pair.depth[world, point] = now - (xi[2] * projection.gap_slope + projection.gap_offset)
        motion = slave.displacement - scr.start_displacement[world, point]
        spring = vec3d()
        if pair.anchor_facet[world, point] > 0:
            first = pair.anchor_facet[world, point] - 1
            from0 = pair.anchor_xi[world, point]
            motion -= displacement_change(mas, pair.displacement, pair.start_displacement, world, first, from0)
            if f == first:  # sum of motions: a difference of positions would lose digits
                before = pair.anchor_gap[world, point]
                rise = (
                    (xi[2] - from0[2]) * projection.gap_slope + from0[2] * (projection.gap_slope - before[0]) +
                    (projection.gap_offset - before[1])
                )  # fmt: skip
                pair.depth[world, point] = (
                    scr.start_depth[world, point] + (now - scr.activation_gap[world, point]) - rise
                )
            pair.initial_depth[world, point] = scr.start_depth[world, point]
            if his.speed[world, point] > f64(0.0):
                frame = facet_frame(surface_point(mas, pair.displacement, world, first, from0))
                spring = k.turned_spring(con, his, world, c, point, frame)
        else:
            motion -= displacement_change(mas, pair.displacement, pair.start_displacement, world, f, xi)
            pair.initial_depth[world, point] = (
                pair.depth[world, point] + wp.dot(projection.normal, motion) - (now - scr.activation_gap[world, point])
            )
        pair.relative_motion[world, point] = motion
        pair.spring[world, point] = spring

    @masked_kernel(module, "active")
    def find_facets(
        con: Contacts, mas: Masters, facets: Facets, his: History, clock: Clock, u: wp.array2d(dtype=vec3d),
        v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), overlap_limit: f64, scr: ContactScratch,
        pair: PairScratch,
    ):  # fmt: skip
        """Facet of each point at an iterate. `overlap_limit` > 0: no step; inner points up to that depth, m, are in
        contact."""
        world, item, q = wp.tid()
        if k.is_edge(facets, item):
            return
        point = facets.first_point + item * facets.point_count + q
        leaving = pair.facet[world, point] == LEAVING
        pair.facet[world, point] = -1
        if facets.area_fraction[q, item] == f64(0.0):
            return
        if his.speed[world, point] <= f64(0.0) and pair.in_reach[world, facets.first_row + item] == 0:
            return
        slave = slave_point_at(con, mas, facets, his, clock, scr, pair, u, world, item, q, overlap_limit)
        candidate = candidates.anchor_candidate(mas, pair, slave)
        if candidate.facet < 0 or leaving:
            candidate = candidates.search_facets(mas, facets, scr, pair, slave, candidate)
            if wp.static(seams):
                if candidate.facet >= 0 and not slave.anchored and overlap_limit == f64(0.0):
                    candidate = level_candidate(mas, pair, slave, candidate)
        if candidate.facet >= 0 and wp.where(slave.anchored, leaving, overlap_limit == f64(0.0)):
            update_anchor(mas, facets, his, clock, scr, pair, v_n, slave, candidate.facet, candidate.xi)
        if candidate.facet >= 0:
            set_contact(con, mas, his, clock, scr, pair, slave, candidate.facet, candidate.xi)
            if pair.depth[world, point] > mas.depth_limit[candidate.facet]:
                pair.facet[world, point] = PENETRATED
        elif candidate.passed_through:
            pair.facet[world, point] = PENETRATED

    return kernel_set(vars(boxes) | locals())
