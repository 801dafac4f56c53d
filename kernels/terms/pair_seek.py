"""Master facet and coordinates of each slave point: boxes, tree, and search within it.

A point in contact stays on its facet, or passes to the one that contains it. Another point is in contact if it is
inside of a facet now and was outside of it at the start of the step; only boxes persist from step to step.
"""

import functools
import types as _types

import warp as wp

from ..common.types import SMALL, kernel_module, precision
from .contact import SPEED_FLOOR
from .contact_data import attempt_struct, clock_struct, contact_struct, facet_struct, history_struct
from .contact_laws import PAPER
from .contact_touch import touch_functions
from .pair_boxes import MARGIN, box_kernels
from .pair_data import master_struct, seat_struct, touching_struct
from .pair_places import HOLD, OUTER, place_functions

__all__ = ["MARGIN", "THROUGH", "seek_kernels"]

THROUGH = -2
"""Facet of a point that has left through the opposite side."""
TURNED = 0.1
"""Minimum cosine of the normals of two facets that a point in contact passes between: excludes the edge of a box."""
LOST = 0.25
"""Depth over the allowed depth above which a point without a facet has passed through."""
OPPOSES = 0.5
"""Cosine of a facet's normal and the slave's reversed normal above which they face each other; below its negative they
face the same way."""
ALIKE = 2.0
"""Largest depth of a point that enters from beside a facet, over the deepest active penetration."""
LEAN = 2.0
"""Maximum tangent of the angle between an outward vector and the normal of its facet, at the edge of a box."""
GLANCE = 0.5
"""Parametric margin for rejecting a facet by the tangent plane at its midpoint."""


@functools.cache
def seek_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels in one precision of the displacements."""
    p = precision(dtype)
    vec3 = p.vec3
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets, History = contact_struct(False), facet_struct(dtype), history_struct()
    Attempt, Clock = attempt_struct(dtype), clock_struct()
    Masters, Seats, Touching = master_struct(dtype), seat_struct(), touching_struct(dtype)
    k, f = touch_functions(dtype, False), place_functions(dtype)
    along, reach, allowance = k.along, k.reach, k.allowance
    jet, moved, carried, coordinates, outside, middle, locate, follow, outward, foot_of = (
        f.jet, f.moved, f.carried, f.coordinates, f.outside, f.middle, f.locate, f.follow, f.outward, f.foot_of
    )  # fmt: skip
    Jet, boxes = f.Jet, box_kernels(dtype)
    down, up, contains, jet_of = boxes.down, boxes.up, boxes.contains, boxes.jet_of
    module = kernel_module(f"pair_seek_{dtype}", max_unroll=SMALL)

    @wp.struct
    class Seat:
        """Candidate facet of a point."""

        facet: wp.int32  # -1: none
        spot: vec3d
        off: f64  # distance beyond the sides of the facet; 0 within its `lean`
        beyond: f64  # distance beyond the sides without that margin
        height: f64  # height above the facet
        rank: wp.int32  # see `admits`
        entered: wp.bool  # the point passed a side of the body
        loose: wp.bool  # it must have, for this facet to be accepted

    @wp.func
    def approach(
        mas: Masters, facets: Facets, t: Touching, v: wp.array2d(dtype=vec3), world: int, q: int, item: int, f: int,
        spot: vec3d, n: vec3d,
    ) -> f64:  # fmt: skip
        """Approach speed of a point towards a facet at the start of the attempt, m/s."""
        foot = vec3d(spot[0], spot[1], f64(0.0))
        return wp.dot(n, moved(mas, t.V0, t.V0, world, f, foot) - along(facets, v, world, q, item))

    @wp.func
    def anchor(
        mas: Masters, facets: Facets, his: History, seats: Seats, clock: Clock, at: Attempt, t: Touching,
        v_n: wp.array2d(dtype=vec3), world: int, q: int, item: int, point: int, f: int, start: vec3d,
    ):  # fmt: skip
        """Set the facet that a point's motion is relative to: start coordinates on it, depth and approach speed at the
        start."""
        found = locate(mas, t.C0, t.D0, world, f, t.x0[world, point], start)
        spot = vec3d(found[0], found[1], found[2])
        live = his.speed[world, point] > f64(0.0)
        if found[3] == f64(0.0):
            if not live:
                return
            spot = start
        if live and outside(mas.corners[mas.kind[f]], spot) > f64(OUTER):
            return  # it has left the surface
        foot = foot_of(mas, t.C0, t.D0, world, f, spot)
        t.first[world, point] = f + 1
        t.spot0[world, point] = spot
        t.stretch[world, point] = wp.vec2d(foot.rise, foot.rest)
        at.depth[world, point] = at.reach[world, point] - (spot[2] * foot.rise + foot.rest)
        speed = wp.max(his.speed[world, point], f64(SPEED_FLOOR))
        if clock.still == 0:
            speed = wp.max(speed, approach(mas, facets, t, v_n, world, q, item, f, spot, foot.n))
        at.speed[world, point] = speed

    @wp.kernel(module=module)
    def begin_points(
        con: Contacts, mas: Masters, facets: Facets, his: History, seats: Seats, clock: Clock,
        u_n: wp.array2d(dtype=vec3), v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), at: Attempt,
        t: Touching,
    ):  # fmt: skip
        """Start positions of the points; depth and approach speed of those in contact."""
        world, item, q = wp.tid()
        if active[world] == 0:
            return
        if q == 0 and item == 0 and facets.row == 0:
            at.through[world] = 0
            at.changes[world] = 0
            if clock.part[world] == 0:
                at.elapsed[world] = f64(0.0)
        if facets.share[q, item] == f64(0.0):
            return
        c = facets.contact[item]
        point = facets.point + item * facets.points + q
        shift = along(facets, u_n, world, q, item)
        x = facets.X[q, item] + shift
        t.x0[world, point] = x
        at.origin[world, point] = shift
        at.depth[world, point] = f64(-1.0e30)
        at.speed[world, point] = f64(SPEED_FLOOR)
        t.first[world, point] = 0
        at.reach[world, point] = reach(con, his, world, c, point, clock.time[world], f64(0.0))
        if his.speed[world, point] > f64(0.0):
            anchor(mas, facets, his, seats, clock, at, t, v_n, world, q, item, point, seats.seat[world, point] - 1,
                   seats.spot[world, point])  # fmt: skip
            if t.first[world, point] > 0:
                depth = at.depth[world, point]
                for i in range(2):
                    body = mas.bodies[c][i]
                    if depth > t.deepest[world, body]:
                        wp.atomic_max(t.deepest, world, body, depth)

    @wp.kernel(module=module)
    def look_around(
        con: Contacts, mas: Masters, facets: Facets, his: History, u: wp.array2d(dtype=vec3d),
        active: wp.array(dtype=wp.int32), reaching: f64, t: Touching,
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
            x = facets.X[q, item] + along(facets, u, world, q, item)
            y = t.x0[world, facets.point + item * facets.points + q]
            if facets.share[q, item] > f64(0.0):
                low = wp.min(low, wp.min(x, y))
                high = wp.max(high, wp.max(x, y))
                inside = wp.max(inside, his.overlap[world, facets.point + item * facets.points + q])
        if low[0] > high[0]:
            t.near[world, row] = 0
            return
        far = reaching + inside
        pad = vec3d(far, far, far)
        calm = t.calm[world, row] == t.fits[0]
        if calm and contains(t.calm_lower[world, row], t.calm_upper[world, row], down(low - pad), up(high + pad)):
            t.near[world, row] = 0
            return
        room = f64(2.0) * far + f64(MARGIN) * wp.length(high - low)
        wide = vec3d(room, room, room)
        root = wp.bvh_get_group_root(mas.tree, world * mas.surfaces + mas.of[facets.contact[item]])
        query = wp.bvh_query_aabb(mas.tree, down(low - wide), up(high + wide), root)
        index = wp.int32(0)
        if wp.bvh_query_next(query, index):
            t.near[world, row] = 1
            t.calm[world, row] = -1
            return
        t.near[world, row] = 0
        t.calm[world, row] = t.fits[0]
        t.calm_lower[world, row] = down(low - wide)
        t.calm_upper[world, row] = up(high + wide)

    @wp.func
    def crosses(mas: Masters, t: Touching, world: int, f: int, x: vec3d, x0: vec3d) -> bool:
        """True if a point entered through a facet during the step, and deep."""
        kind = mas.kind[f]
        m = middle(mas.corners[kind])
        old = jet_of(t.middle0[world, f])
        new = jet_of(t.middle[world, f])
        way = x - x0 - (new.x - old.x)
        deep = f64(LOST) * mas.limit[f]
        if wp.length(way) <= deep:
            return False
        g0 = wp.dot(x0 - old.x, outward(old))
        g1 = wp.dot(x - new.x, outward(new))
        if g0 <= f64(0.0) or g1 >= -deep:
            return False
        y = x - (g1 / (g1 - g0)) * way
        there = locate(mas, t.C, t.D, world, f, y, m)
        spot = vec3d(there[0], there[1], there[2])
        return there[3] != f64(0.0) and outside(mas.corners[kind], spot) == f64(0.0)

    @wp.func
    def frame(s: Jet) -> wp.mat33d:
        """Columns: first tangent of a facet, second tangent, outward normal."""
        n = wp.normalize(wp.cross(s.a, s.b))
        a = wp.normalize(s.a)
        return wp.matrix_from_cols(a, wp.cross(n, a), n)

    @wp.func
    def sit(
        con: Contacts, mas: Masters, facets: Facets, his: History, seats: Seats, clock: Clock, at: Attempt, t: Touching,
        v_n: wp.array2d(dtype=vec3), world: int, c: int, q: int, item: int, point: int, f: int, spot: vec3d,
        shift: vec3d, settling: f64,
    ):  # fmt: skip
        """Contact data of a point on a facet: depth now and at the start of the attempt, normal, motion."""
        foot = foot_of(mas, t.C, t.D, world, f, spot)
        now = reach(con, his, world, c, point, clock.new_time[world], f64(0.0))
        t.seat[world, point] = f
        t.spot[world, point] = spot
        t.foot[world, point] = foot.spot
        t.normal[world, point] = foot.n
        t.depth[world, point] = now - (spot[2] * foot.rise + foot.rest)
        if t.first[world, point] == 0 and settling == f64(0.0):
            anchor(mas, facets, his, seats, clock, at, t, v_n, world, q, item, point, f, spot)
        motion = shift - at.origin[world, point]
        spring = vec3d()
        if t.first[world, point] > 0:
            first = t.first[world, point] - 1
            from0 = t.spot0[world, point]
            motion -= carried(mas, t.C, t.D, t.C0, t.D0, world, first, from0)
            if f == first:  # sum of motions: a difference of positions would lose digits
                before = t.stretch[world, point]
                rise = (spot[2] - from0[2]) * foot.rise + from0[2] * (foot.rise - before[0]) + (foot.rest - before[1])
                t.depth[world, point] = at.depth[world, point] + (now - at.reach[world, point]) - rise
            t.before[world, point] = at.depth[world, point]
            if his.speed[world, point] > f64(0.0):
                spring = his.spring[world, point]
                if con.law[c] != PAPER:
                    spring = frame(jet(mas, t.C, t.D, world, first, from0)) * spring
        else:
            motion -= carried(mas, t.C, t.D, t.C0, t.D0, world, f, spot)
            t.before[world, point] = t.depth[world, point] + wp.dot(foot.n, motion) - (now - at.reach[world, point])
        t.motion[world, point] = motion
        t.whole[world, point] = spring + motion

    @wp.func
    def apart(mas: Masters, t: Touching, world: int, f: int, x: vec3d, x0: vec3d, pad: f64) -> bool:
        """True if a point is above a facet by more than `pad`, or moved little and is beside it, by the tangent plane
        at its midpoint."""
        corners = mas.corners[mas.kind[f]]
        s = jet_of(t.middle[world, f])
        if wp.dot(x - s.x, outward(s)) > f64(2.0) * pad + t.swell[world, f]:
            return True
        if outside(corners, middle(corners) + coordinates(s, x - s.x)) <= f64(GLANCE):
            return False
        path = x - x0 - (s.x - t.middle0[world, f][0])
        return wp.length(path) <= f64(0.5) * mas.limit[f]

    @wp.func
    def in_front(mas: Masters, t: Touching, world: int, f: int, x: vec3d, pad: f64) -> bool:
        """True if a point is above a facet by more than `pad` and within its sides."""
        corners = mas.corners[mas.kind[f]]
        found = locate(mas, t.C, t.D, world, f, x, middle(corners))
        within = outside(corners, vec3d(found[0], found[1], found[2])) == f64(0.0)
        return found[3] != f64(0.0) and within and found[2] > pad

    @wp.func
    def opposite(facets: Facets, t: Touching, world: int, item: int, corners: wp.vec3i) -> vec3d:
        """Inward normal of a slave facet at the start of the attempt; 0 if undefined."""
        if corners[0] < 0:
            return vec3d()
        point = facets.point + item * facets.points
        x = t.x0[world, point + corners[0]]
        return wp.normalize(wp.cross(t.x0[world, point + corners[2]] - x, t.x0[world, point + corners[1]] - x))

    @wp.func
    def lean(mas: Masters, f: int, spot: vec3d) -> f64:
        """Tolerance beyond a side, over its length, for points below an edge, where outward vectors are inclined."""
        return wp.max(-f64(LEAN) * spot[2] / mas.size[f], f64(0.0))

    @wp.func
    def from_beside(
        mas: Masters, at: Attempt, t: Touching, world: int, c: int, point: int, f: int, spot: vec3d, gap: f64
    ) -> bool:  # fmt: skip
        """True if a point is at a facet now, was beside it at the start of the attempt, and was below its plane by at
        most the penetration of the bodies' contact: it slid under the edge of a body that has sunk in."""
        kind = mas.kind[f]
        most = wp.max(t.deepest[world, mas.bodies[c][0]], t.deepest[world, mas.bodies[c][1]])
        depth = at.reach[world, point] - gap
        if depth > wp.min(f64(ALIKE) * most, f64(LOST) * mas.limit[f]):
            return False
        if outside(mas.corners[kind], spot) > lean(mas, f, spot):
            return False
        found = locate(mas, t.C0, t.D0, world, f, t.x0[world, point], spot)
        return found[3] == f64(0.0) or outside(mas.corners[kind], vec3d(found[0], found[1], found[2])) > f64(0.0)

    @wp.func
    def admits(
        mas: Masters, at: Attempt, t: Touching, world: int, c: int, point: int, f: int, spot: vec3d, pad: f64,
        left: f64, anchored: bool, facing: vec3d, settling: f64,
    ) -> int:  # fmt: skip
        """Rank of a facet for a point, -1: rejected by depth, by the previous facet, or by the side at the start of the
        attempt. Higher for facets that face the slave's; among others, for one that the point reached from beside."""
        s = jet(mas, t.C, t.D, world, f, spot)
        n = outward(s)
        cosine = wp.dot(n, facing)
        gap = spot[2] * wp.dot(n, s.c)
        if -gap > mas.limit[f] or gap > pad:  # boxes depend on the other worlds: this test does not
            return -1
        if anchored:
            return wp.where(cosine > f64(TURNED), 0, -1)
        rank = wp.where(cosine > f64(OPPOSES), 4, wp.where(cosine > -f64(OPPOSES), 1, 0))
        if settling > f64(0.0):
            rank = 0
        else:
            foot = jet(mas, t.C0, t.D0, world, f, vec3d(spot[0], spot[1], f64(0.0)))
            before = wp.dot(t.x0[world, point] - foot.x, outward(foot))
            if before < -left:
                if rank == 0 or not from_beside(mas, at, t, world, c, point, f, spot, before):
                    return -1
                rank = wp.where(rank == 4, 3, 2)
        return rank

    @wp.func
    def offer(
        mas: Masters, at: Attempt, t: Touching, world: int, c: int, point: int, f: int, x: vec3d, pad: f64, left: f64,
        anchored: bool, facing: vec3d, settling: f64, seat: Seat,
    ) -> Seat:  # fmt: skip
        """The better of a candidate and another facet for a point."""
        out = seat
        corners = mas.corners[mas.kind[f]]
        found = locate(mas, t.C, t.D, world, f, x, middle(corners))
        spot = vec3d(found[0], found[1], found[2])
        o = outside(corners, spot)
        slack = f64(0.0)
        if not anchored and settling == f64(0.0):
            slack = lean(mas, f, spot)
        if found[3] == f64(0.0) or o > wp.min(wp.max(seat.off, slack), f64(OUTER)):
            return out
        rank = admits(mas, at, t, world, c, point, f, spot, pad, left, anchored, facing, settling)
        beside = rank == 2 or rank == 3
        near = beside and o > f64(0.0)
        out.entered = out.entered or (rank >= 0 and not beside)
        beyond = o
        if rank > 1 and o <= slack:
            o = f64(0.0)
        closer = wp.abs(spot[2]) < seat.height or (wp.abs(spot[2]) == seat.height and f < seat.facet)
        closer = beyond < seat.beyond or (closer and beyond == seat.beyond)
        closer = rank > seat.rank or (closer and rank == seat.rank)
        if rank >= 0 and (o < seat.off or seat.facet < 0 or (o == seat.off and closer)):
            out = Seat(f, spot, o, beyond, wp.abs(spot[2]), rank, out.entered, near)
        return out

    @wp.kernel(module=module)
    def seek(
        con: Contacts, mas: Masters, facets: Facets, his: History, seats: Seats, clock: Clock,
        u: wp.array2d(dtype=vec3d), v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), settling: f64,
        at: Attempt, t: Touching, trio: wp.array(dtype=wp.vec3i),
    ):  # fmt: skip
        """Facet of each point at an iterate. `settling` > 0: no step; inner points up to that depth, m, are in contact.
        `trio`: three points of each slave facet, or -1."""
        world, item, q = wp.tid()
        if active[world] == 0:
            return
        point = facets.point + item * facets.points + q
        t.seat[world, point] = -1
        if facets.share[q, item] == f64(0.0):
            return
        if his.speed[world, point] <= f64(0.0) and t.near[world, facets.row + item] == 0:
            return
        c = facets.contact[item]
        shift = along(facets, u, world, q, item)
        x = facets.X[q, item] + shift
        x0 = t.x0[world, point]
        seat = Seat(-1, vec3d(), f64(OUTER), f64(OUTER), f64(1.0e300), -1, False, False)
        if settling > f64(0.0):
            seat.off = f64(0.0)  # no tolerance: a point in front of one face may be beside another
        inside = allowance(con, his, world, c, point, clock.time[world])
        pad = settling + inside + wp.abs(con.offset[c]) + f64(1.0e-6) * wp.length(x)
        through = bool(False)
        anchored = t.first[world, point] > 0
        motion = vec3d()
        from0 = t.spot0[world, point]
        if anchored:
            f = t.first[world, point] - 1
            motion = shift - at.origin[world, point] - carried(mas, t.C, t.D, t.C0, t.D0, world, f, from0)
            found = follow(mas, t.C, t.D, world, f, from0, motion)
            if found[3] == f64(0.0):
                found = locate(mas, t.C, t.D, world, f, x, middle(mas.corners[mas.kind[f]]))
            spot = vec3d(found[0], found[1], found[2])
            o = outside(mas.corners[mas.kind[f]], spot)
            if found[3] != f64(0.0) and (o <= seat.off or (o <= f64(HOLD) and his.speed[world, point] > f64(0.0))):
                seat = Seat(f, spot, o, o, wp.abs(spot[2]), -1, False, False)
            pad += f64(2.0) * wp.abs(from0[2])
        if seat.facet < 0 or seat.off > f64(OUTER):
            facing = vec3d()
            free = not anchored and settling == f64(0.0)
            if anchored:
                f = t.first[world, point] - 1
                facing = outward(jet(mas, t.C, t.D, world, f, from0))
                through = at.depth[world, point] - wp.dot(motion, facing) > f64(LOST) * mas.limit[f]
            wide = vec3d(pad, pad, pad)
            root = wp.bvh_get_group_root(mas.tree, world * mas.surfaces + mas.of[c])
            query = wp.bvh_query_aabb(mas.tree, down(wp.min(x, x0) - wide), up(wp.max(x, x0) + wide), root)
            index = wp.int32(0)
            left = inside + mas.touch - wp.min(con.offset[c], f64(0.0))
            while wp.bvh_query_next(query, index):
                f = index - world * mas.count
                if apart(mas, t, world, f, x, x0, pad):
                    continue
                if free and wp.length_sq(facing) == f64(0.0):
                    facing = opposite(facets, t, world, item, trio[item])
                seat = offer(mas, at, t, world, c, point, f, x, pad, left, anchored, facing, settling, seat)
                if free and crosses(mas, t, world, f, x, x0):
                    through = True
            if seat.loose and not seat.entered:
                seat.facet = -1  # it passed no side of the body
            if seat.facet >= 0 and seat.off > f64(0.0) and not anchored:
                query = wp.bvh_query_aabb(mas.tree, down(wp.min(x, x0) - wide), up(wp.max(x, x0) + wide), root)
                while wp.bvh_query_next(query, index):
                    if in_front(mas, t, world, index - world * mas.count, x, pad):
                        seat.facet = -1  # beside a facet, and outside of the body
        if seat.facet >= 0:
            sit(con, mas, facets, his, seats, clock, at, t, v_n, world, c, q, item, point, seat.facet, seat.spot, shift,
                settling)  # fmt: skip
            most = mas.limit[seat.facet] * wp.where(seat.off > f64(OUTER), f64(LOST), f64(1.0))
            if t.depth[world, point] > most:
                t.seat[world, point] = THROUGH
        elif through:
            t.seat[world, point] = THROUGH

    return _types.SimpleNamespace(
        **vars(boxes), module=module, begin_points=begin_points, look_around=look_around, seek=seek, frame=frame,
    )  # fmt: skip
