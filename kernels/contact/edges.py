"""Sharp edges of slave facets against sharp edges of master facets: the common perpendicular of both curves.

A point of a slave's edge is where the perpendicular meets it, found at each iterate; its shape values are written to
the columns of its world in `Facets.shape`. The gap along the perpendicular is stationary in both places: the normal
force, in the record of a point on a facet, is its derivative. An edge sees another one where the perpendicular lies in
the cones of normals of both, by `EDGE_MARGIN` away from their faces, whose points see each other.
"""

import functools
from typing import Any

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import f64, precision, vec3d
from .broad_phase import broad_phase_kernels
from .facet_candidates import MAX_DEPTH_RATIO
from .facet_search import facet_search_kernels
from .facet_structs import edge_struct, facet_field_struct, master_struct, pair_history_struct, pair_scratch_struct
from .kinematics import kinematics_functions
from .law import MIN_APPROACH_SPEED
from .projection import facet_projection_functions
from .structs import INACTIVE, WITH_STIFFNESS, contact_structs

__all__ = ["EDGE_MARGIN", "closest_on_segments", "edge_kernels"]

EDGE_MARGIN = 0.17
"""Angle, rad, between the perpendicular and the normals of the faces at an edge below which edges do not come into
contact, and sine of the angle between two edges below which they count as parallel."""
MAX_STEPS = 12
"""Maximum number of Newton steps for the places on two edges."""


@wp.func
def closest_on_segments(a: vec3d, b: vec3d, c: vec3d, d: vec3d) -> wp.vec2d:
    """Parts (s, t) of two segments a + s (b - a), c + t (d - c) where they are closest, for any position: parallel ones
    and points too (Ericson, Real-Time Collision Detection, 2005, 5.1.9)."""
    u = b - a
    v = d - c
    r = a - c
    uu = wp.dot(u, u)
    vv = wp.dot(v, v)
    vr = wp.dot(v, r)
    ur = wp.dot(u, r)
    s = f64(0.0)
    t = f64(0.0)
    if uu > f64(0.0) and vv > f64(0.0):
        uv = wp.dot(u, v)
        square = wp.length_sq(wp.cross(u, v))
        if square > f64(0.0):
            s = wp.clamp((uv * vr - ur * vv) / square, f64(0.0), f64(1.0))
        t = (uv * s + vr) / vv
        if t < f64(0.0) or t > f64(1.0):
            t = wp.clamp(t, f64(0.0), f64(1.0))
            s = wp.clamp((uv * t - ur) / uu, f64(0.0), f64(1.0))
    elif uu > f64(0.0):
        s = wp.clamp(-ur / uu, f64(0.0), f64(1.0))
    elif vv > f64(0.0):
        t = wp.clamp(vr / vv, f64(0.0), f64(1.0))
    return wp.vec2d(s, t)


@functools.cache
def edge_kernels(dtype: str) -> KernelSet:
    """Kernels in one precision of the displacements."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    mat43 = wp.types.matrix(shape=(4, 3), dtype=f64)
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    Masters, PairHistory, PairScratch = master_struct(dtype), pair_history_struct(), pair_scratch_struct(dtype)
    Edges, FacetField = edge_struct(dtype), facet_field_struct()
    k, f_, boxes = kinematics_functions(dtype), facet_projection_functions(dtype), broad_phase_kernels(dtype)
    surface_point, displacement_change = f_.surface_point, f_.displacement_change
    facet_frame = facet_search_kernels(dtype).facet_frame
    module = kernel_module(f"edge_search_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.struct
    class EdgePoint:
        """Position on an edge, m, its derivative by the place, and a vector into the edge's facet."""

        position: vec3d
        tangent: vec3d
        inward: vec3d

    @wp.struct
    class Perpendicular:
        """Common perpendicular of a slave's edge and a side of a master facet."""

        world: wp.int32
        edge: wp.int32
        found: wp.bool
        own: f64  # place on the slave's edge, from 0 to 1
        other: f64  # place on the side
        normal: vec3d  # out of the master
        gap: f64  # m
        facet: wp.int32
        side: wp.int32

    @wp.func
    def own_coefficients(
        ed: Edges, facets: Facets, u: wp.array2d(dtype=Any), world: int, edge: int, inward: int
    ) -> mat43:  # fmt: skip
        """Coefficients of t^m of the position on a slave's edge, or of its inward vector."""
        out = mat43()
        for m in range(4):
            c = ed.X[inward, m, edge]
            for i in range(facets.conn.shape[0]):
                c += f64(ed.shape[inward, m, i, edge]) * vec3d(u[world, facets.conn[i, ed.row[edge]]])
            out[m] = c
        return out

    @wp.func
    def polynomial(c: mat43, t: f64) -> vec3d:
        """Value of a cubic."""
        return c[0] + t * (c[1] + t * (c[2] + t * c[3]))

    @wp.func
    def own_point(x: mat43, inward: mat43, t: f64) -> EdgePoint:
        """Place on a slave's edge."""
        slope = x[1] + t * (f64(2.0) * x[2] + f64(3.0) * t * x[3])
        return EdgePoint(polynomial(x, t), slope, polynomial(inward, t))

    @wp.func
    def side_coordinates(corners: int, side: int, s: f64) -> vec3d:
        """Facet coordinates of a place on a side, anticlockwise."""
        rest = f64(1.0) - s
        if side == 0:
            return vec3d(s, f64(0.0), f64(0.0))
        if side == corners - 1:
            return vec3d(f64(0.0), rest, f64(0.0))
        if corners == 3:
            return vec3d(rest, s, f64(0.0))
        return wp.where(side == 1, vec3d(f64(1.0), s, f64(0.0)), vec3d(rest, f64(1.0), f64(0.0)))

    @wp.func
    def side_place(corners: int, side: int, xi: vec3d) -> f64:
        """Place on a side that is nearest to facet coordinates."""
        if side == 0:
            return xi[0]
        if side == corners - 1:
            return f64(1.0) - xi[1]
        return wp.where(side == 1, xi[1], f64(1.0) - xi[0])

    @wp.func
    def side_point(mas: Masters, U: FacetField, world: int, f: int, side: int, s: f64) -> EdgePoint:
        """Place on a side of a master facet."""
        corners = mas.corner_count[mas.facet_kind[f]]
        q = surface_point(mas, U, world, f, side_coordinates(corners, side, s))
        if side == 0:
            return EdgePoint(q.position, q.tangent_a, q.tangent_b)
        if side == corners - 1:
            return EdgePoint(q.position, -q.tangent_b, q.tangent_a)
        if corners == 3:
            return EdgePoint(q.position, q.tangent_b - q.tangent_a, -q.tangent_a - q.tangent_b)
        if side == 1:
            return EdgePoint(q.position, q.tangent_b, -q.tangent_a)
        return EdgePoint(q.position, -q.tangent_a, -q.tangent_b)

    @wp.func
    def bisector(e: EdgePoint, half_angle: f64) -> vec3d:
        """Outward unit vector halfway between the normals of both facets at an edge, `half_angle` from each."""
        n = wp.normalize(wp.cross(e.tangent, e.inward))
        return wp.cos(half_angle) * n - wp.sin(half_angle) * wp.normalize(wp.cross(n, e.tangent))

    @wp.func
    def perpendicular(
        mas: Masters, ed: Edges, U: FacetField, x: mat43, inward: mat43, world: int, edge: int, f: int, side: int,
        own: f64, other: f64, margin: f64,
    ) -> Perpendicular:  # fmt: skip
        """Common perpendicular by Newton's method from places on both curves; found if it is within the cones of
        normals of both edges, reduced by `margin`, rad."""
        out = Perpendicular()
        out.world = world
        out.edge = edge
        out.own = own
        out.other = other
        out.facet = f
        out.side = side
        a = own_point(x, inward, own)
        b = side_point(mas, U, world, f, side, other)
        for _ in range(MAX_STEPS):
            n = wp.cross(a.tangent, b.tangent)
            square = wp.length_sq(n)
            if square <= f64(EDGE_MARGIN * EDGE_MARGIN) * wp.length_sq(a.tangent) * wp.length_sq(b.tangent):
                return out
            r = b.position - a.position
            dt = wp.dot(wp.cross(r, b.tangent), n) / square
            ds = wp.dot(wp.cross(r, a.tangent), n) / square
            out.own += dt
            out.other += ds
            size = wp.max(wp.abs(dt), wp.abs(ds))
            if size > f64(4.0):
                return out
            a = own_point(x, inward, out.own)
            b = side_point(mas, U, world, f, side, out.other)
            if size < f64(1.0e-9):
                break
        out.normal = wp.normalize(wp.cross(a.tangent, b.tangent))
        outward = bisector(b, mas.half_angle[side, f])
        if wp.dot(out.normal, outward) < f64(0.0):
            out.normal = -out.normal
        out.gap = wp.dot(out.normal, a.position - b.position)
        out.found = (
            wp.dot(out.normal, outward) > wp.cos(wp.max(mas.half_angle[side, f] - margin, f64(0.0)))
            and -wp.dot(out.normal, bisector(a, ed.half_angle[edge]))
            > wp.cos(wp.max(ed.half_angle[edge] - margin, f64(0.0)))
        )  # fmt: skip
        return out

    @wp.func
    def is_within(q: Perpendicular) -> bool:
        """True if a perpendicular meets both edges between their ends."""
        return q.found and wp.min(q.own, q.other) >= f64(0.0) and wp.max(q.own, q.other) <= f64(1.0)

    @wp.func
    def write_shape(ed: Edges, facets: Facets, world: int, edge: int, t: f64):
        """Shape values and reference position of a place on a slave's edge."""
        q = ed.number[edge]
        at = k.column(facets, world, ed.row[edge]) - facets.facet_count
        X = vec3d()
        power = f64(1.0)
        for i in range(facets.conn.shape[0]):
            facets.edge_shape[q, i, at] = T(0.0)
        for m in range(4):
            X += power * ed.X[0, m, edge]
            for i in range(facets.conn.shape[0]):
                facets.edge_shape[q, i, at] = facets.edge_shape[q, i, at] + T(power) * ed.shape[0, m, i, edge]
            power *= t
        facets.edge_X[q, at] = X

    @wp.func
    def store_place(
        con: Contacts, mas: Masters, ed: Edges, facets: Facets, his: History, pair: PairScratch, U: FacetField,
        u: wp.array2d(dtype=Any), time: f64, q: Perpendicular,
    ):  # fmt: skip
        """Facet, coordinates, normal and depth of an edge in contact, shape values of its place."""
        world = q.world
        item = ed.row[q.edge]
        number = ed.number[q.edge]
        point = facets.first_point + item * facets.point_count + number
        f = q.facet
        write_shape(ed, facets, world, q.edge, q.own)
        x = k.position_at(facets, number, k.column(facets, world, item)) + k.interpolate(facets, u, world, number, item)
        xi = side_coordinates(mas.corner_count[mas.facet_kind[f]], q.side, q.other)
        found = f_.inverse_map(mas, U, world, f, x, xi)
        pair.facet[world, point] = f
        pair.projection[world, point] = xi
        pair.xi[world, point] = wp.where(found[3] != f64(0.0), vec3d(found[0], found[1], found[2]), xi)
        pair.normal[world, point] = q.normal
        pair.depth[world, point] = (
            k.activation_gap(con, his, world, facets.contact[item], point, time, f64(0.0)) - q.gap
        )

    @wp.func
    def history_perpendicular(
        mas: Masters, ed: Edges, U: FacetField, pair_his: PairHistory, x: mat43, inward: mat43, world: int, edge: int,
        point: int,
    ) -> Perpendicular:  # fmt: skip
        """Perpendicular of an edge in contact at a state."""
        f = pair_his.facet[world, point] - 1
        corners = mas.corner_count[mas.facet_kind[f]]
        out = Perpendicular()
        least = f64(1.0e300)
        for side in range(corners):
            if mas.half_angle[side, f] > f64(0.0):
                s = side_place(corners, side, pair_his.xi[world, point])
                off = wp.length(side_coordinates(corners, side, s) - pair_his.xi[world, point])
                new = perpendicular(mas, ed, U, x, inward, world, edge, f, side, f64(0.5), s, f64(-0.5))
                off = wp.abs(new.gap) + off * mas.side_length[f]
                if new.found and off < least:
                    out = new
                    least = off
        return out

    @masked_kernel(module, "active")
    def begin_edges(
        con: Contacts, mas: Masters, ed: Edges, facets: Facets, his: History, pair_his: PairHistory, clock: Clock,
        u_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), scr: ContactScratch, pair: PairScratch,
    ):  # fmt: skip
        """Edges in contact at the start of an attempt: place, depth."""
        world, edge = wp.tid()
        item = ed.row[edge]
        point = facets.first_point + item * facets.point_count + ed.number[edge]
        c = facets.contact[item]
        pair.facet[world, point] = -1
        pair.anchor_facet[world, point] = 0
        scr.start_depth[world, point] = f64(-1.0e30)
        scr.approach_speed[world, point] = f64(MIN_APPROACH_SPEED)
        scr.activation_gap[world, point] = k.activation_gap(con, his, world, c, point, clock.time[world], f64(0.0))
        if his.speed[world, point] <= f64(0.0):
            return
        x = own_coefficients(ed, facets, u_n, world, edge, 0)
        inward = own_coefficients(ed, facets, u_n, world, edge, 1)
        found = history_perpendicular(mas, ed, pair.start_displacement, pair_his, x, inward, world, edge, point)
        if found.found:
            U = pair.start_displacement
            store_place(con, mas, ed, facets, his, pair, U, u_n, clock.time[world], found)
            pair.anchor_facet[world, point] = found.facet + 1
            pair.anchor_xi[world, point] = pair.projection[world, point]
            pair.anchor_gap[world, point] = wp.vec2d(f64(found.side), found.own)
            depth = pair.depth[world, point]
            scr.start_depth[world, point] = depth
            for i in range(2):
                wp.atomic_max(pair.deepest_contact, world, mas.bodies[c][i], depth)

    @wp.func
    def was_outside(q: Perpendicular, outside: f64, deepest: f64) -> bool:
        """True if two edges were apart, or beside each other and no deeper than the contact of the bodies."""
        beside = wp.min(q.own, q.other) < f64(0.0) or wp.max(q.own, q.other) > f64(1.0)
        return q.gap >= -outside or (beside and -q.gap <= f64(MAX_DEPTH_RATIO) * deepest)

    @wp.func
    def is_nearer(new: Perpendicular, old: Perpendicular) -> bool:
        """True if a perpendicular is shorter, of equal ones that of the first facet."""
        same = wp.abs(new.gap) == wp.abs(old.gap) and new.facet < old.facet
        return not old.found or wp.abs(new.gap) < wp.abs(old.gap) or same

    @wp.func
    def set_edge_contact(
        con: Contacts, mas: Masters, ed: Edges, facets: Facets, his: History, clock: Clock, scr: ContactScratch,
        pair: PairScratch, u_n: wp.array2d(dtype=vec3), v_n: wp.array2d(dtype=vec3), u: wp.array2d(dtype=vec3d),
        q: Perpendicular,
    ):  # fmt: skip
        """Contact data of an edge, as `set_contact` of facet_search.py."""
        world = q.world
        item = ed.row[q.edge]
        number = ed.number[q.edge]
        point = facets.first_point + item * facets.point_count + number
        store_place(con, mas, ed, facets, his, pair, pair.displacement, u, clock.new_time[world], q)
        start = k.interpolate(facets, u_n, world, number, item)
        scr.start_displacement[world, point] = start
        scr.start_position[world, point] = k.position_at(facets, number, k.column(facets, world, item)) + start
        f = q.facet
        xi = pair.projection[world, point]
        now = pair.depth[world, point] + q.gap
        motion = k.interpolate(facets, u, world, number, item) - start
        motion -= displacement_change(mas, pair.displacement, pair.start_displacement, world, f, xi)
        pair.relative_motion[world, point] = motion
        pair.initial_depth[world, point] = (
            pair.depth[world, point] + wp.dot(q.normal, motion) - (now - scr.activation_gap[world, point])
        )
        pair.spring[world, point] = vec3d()
        if his.speed[world, point] > f64(0.0) and pair.anchor_facet[world, point] > 0:
            first = pair.anchor_facet[world, point] - 1
            t = surface_point(mas, pair.displacement, world, first, pair.anchor_xi[world, point])
            pair.spring[world, point] = k.turned_spring(con, his, world, facets.contact[item], point, facet_frame(t))
            pair.initial_depth[world, point] = scr.start_depth[world, point]
        speed = f64(0.0)
        if clock.is_static == 0:
            own = k.interpolate(facets, v_n, world, number, item)
            speed = wp.dot(q.normal, f_.facet_value(mas, pair.start_velocity, world, f, xi) - own)
        scr.approach_speed[world, point] = k.approach_speed(his, world, point, speed)

    @wp.func
    def crossed_side(
        con: Contacts, mas: Masters, ed: Edges, pair: PairScratch, x: mat43, inward: mat43, x0: mat43, inward0: mat43,
        world: int, edge: int, c: int, anchored: bool,
    ) -> Perpendicular:  # fmt: skip
        """The nearest side of a master facet that an edge crosses now, and at the start of the attempt did not."""
        best = Perpendicular()
        outside = mas.touch_depth - wp.min(con.offset[c], f64(0.0))
        far = wp.abs(con.offset[c]) + f64(1.0e-6) * wp.length(x[0])
        margin = wp.where(anchored, f64(0.0), f64(EDGE_MARGIN))
        bodies = mas.bodies[c]
        deepest = wp.max(pair.deepest_contact[world, bodies[0]], pair.deepest_contact[world, bodies[1]])
        low = x[0]
        high = x[0]
        for m in range(4):
            t = f64(m) / f64(3.0)
            low = wp.min(low, wp.min(polynomial(x, t), polynomial(x0, t)))
            high = wp.max(high, wp.max(polynomial(x, t), polynomial(x0, t)))
        pad = vec3d(far, far, far)
        end = polynomial(x, f64(1.0))
        root = wp.bvh_get_group_root(mas.tree, world * mas.surface_count + mas.surface_of[c])
        query = wp.bvh_query_aabb(mas.tree, boxes.round_down(low - pad), boxes.round_up(high + pad), root)
        index = wp.int32(0)
        while wp.bvh_query_next(query, index):
            f = index - world * mas.facet_count
            for side in range(mas.corner_count[mas.facet_kind[f]]):
                if mas.half_angle[side, f] == f64(0.0):
                    continue
                a = side_point(mas, pair.displacement, world, f, side, f64(0.0)).position
                b = side_point(mas, pair.displacement, world, f, side, f64(1.0)).position
                place = closest_on_segments(x[0], end, a, b)
                apart = x[0] + place[0] * (end - x[0]) - a - place[1] * (b - a)
                if wp.length(apart) > mas.depth_limit[f] + pair.bulge[world, f]:
                    continue
                new = perpendicular(mas, ed, pair.displacement, x, inward, world, edge, f, side, place[0], place[1],
                                    margin)  # fmt: skip
                if is_within(new) and new.gap < far and -new.gap <= mas.depth_limit[f]:
                    old = perpendicular(mas, ed, pair.start_displacement, x0, inward0, world, edge, f, side, new.own,
                                        new.other, f64(-0.5))  # fmt: skip
                    if old.found and was_outside(old, outside, deepest) and is_nearer(new, best):
                        best = new
        return best

    @masked_kernel(module, "active")
    def find_edges(
        con: Contacts, mas: Masters, ed: Edges, facets: Facets, his: History, clock: Clock,
        u_n: wp.array2d(dtype=vec3), v_n: wp.array2d(dtype=vec3), u: wp.array2d(dtype=vec3d),
        active: wp.array(dtype=wp.int32), scr: ContactScratch, pair: PairScratch,
    ):  # fmt: skip
        """The side of a master facet that each edge of the slaves crosses at an iterate."""
        world, edge = wp.tid()
        item = ed.row[edge]
        point = facets.first_point + item * facets.point_count + ed.number[edge]
        pair.facet[world, point] = -1
        anchored = pair.anchor_facet[world, point] > 0
        owner = ed.owner[edge]
        if not anchored and owner >= 0 and pair.in_reach[world, facets.first_row + owner] == 0:
            return
        x = own_coefficients(ed, facets, u, world, edge, 0)
        inward = own_coefficients(ed, facets, u, world, edge, 1)
        best = Perpendicular()
        if anchored:
            f = pair.anchor_facet[world, point] - 1
            side = wp.int32(pair.anchor_gap[world, point][0])
            s = side_place(mas.corner_count[mas.facet_kind[f]], side, pair.anchor_xi[world, point])
            t = pair.anchor_gap[world, point][1]
            best = perpendicular(mas, ed, pair.displacement, x, inward, world, edge, f, side, t, s, f64(0.0))
        if not is_within(best):
            x0 = own_coefficients(ed, facets, u_n, world, edge, 0)
            inward0 = own_coefficients(ed, facets, u_n, world, edge, 1)
            best = crossed_side(con, mas, ed, pair, x, inward, x0, inward0, world, edge, facets.contact[item], anchored)
        if best.found:
            set_edge_contact(con, mas, ed, facets, his, clock, scr, pair, u_n, v_n, u, best)

    @masked_kernel(module, "active")
    def move_friction(
        ed: Edges, facets: Facets, active: wp.array(dtype=wp.int32), scr: ContactScratch, pair: PairScratch,
        pool: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """Friction of edges acts by their frozen shape values: move it there on the slots of the slaves."""
        world, edge, i = wp.tid()
        item = ed.row[edge]
        if ed.number[edge] > 0 or scr.facet_activity[world, facets.first_row + item] == INACTIVE:
            return
        total = vec3()
        at = k.column(facets, world, item)
        frozen = k.frozen_column(facets, world, item)
        for q in range(facets.point_count):
            point = facets.first_point + item * facets.point_count + q
            if scr.activity[world, point] == WITH_STIFFNESS:
                total += (k.shape_at(facets, q, i, frozen) - k.shape_at(facets, q, i, at)) * vec3(
                    pair.tangential_force[world, point]
                )
        entry = facets.first_entry + i * facets.facet_count + item
        pool[world, entry] = pool[world, entry] + total

    return kernel_set(locals())
