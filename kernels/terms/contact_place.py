"""Contact point of a lumped contact: the deepest position of a surface, found within its facets.

The surface interpolates the points of each facet by Lagrange polynomials, which neighbours share on their common edge:
the contact point moves continuously as a smooth body rolls.
"""

import functools
import types as _types

import warp as wp

from ..common.types import SMALL, kernel_module, precision
from .contact import SPEED_FLOOR
from .contact_colliders import MESHES, collider_functions
from .contact_data import attempt_struct, clock_struct, contact_struct, facet_struct, history_struct
from .contact_touch import touch_functions

__all__ = ["place_kernels"]

PICKS = 8
"""Choices of the contact point in an attempt."""
TURNS = 12
"""Newton steps within a facet."""
HALVINGS = 6
PROBE = 1e-5
"""Step in a facet's coordinates for finite differences of the shape's normals (its curvature)."""


@functools.cache
def place_kernels(dtype: str, meshes: bool) -> _types.SimpleNamespace:
    """Kernels of lumped contacts, in a module of their own; `meshes`: some collider is a triangle mesh."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    f64, vec2d, vec3d = wp.float64, wp.vec2d, wp.vec3d
    Contacts, Facets = contact_struct(meshes), facet_struct(dtype)
    History, Attempt, Clock = history_struct(), attempt_struct(dtype), clock_struct()
    f = touch_functions(dtype, meshes)
    along, reach, depth_before, record_of, lagrange, monomial = (
        f.along,
        f.reach,
        f.depth_before,
        f.record_of,
        f.lagrange,
        f.monomial,
    )
    distance, known_side = collider_functions(meshes).distance, collider_functions(meshes).known_side
    module = kernel_module(f"contact_place_{dtype}{MESHES * meshes}", max_unroll=SMALL)

    @wp.struct
    class Jet:
        """Position on a facet in the collider's frame, and its derivatives by the facet's coordinates."""

        y: vec3d
        a: vec3d
        b: vec3d
        aa: vec3d
        ab: vec3d
        bb: vec3d

    @wp.func
    def jet(con: Contacts, facets: Facets, at: Attempt, world: int, k: int, item: int, u: wp.array2d(dtype=vec3d),
            s: vec2d) -> Jet:  # fmt: skip
        """Position and derivatives at coordinates s."""
        out = Jet()
        back = wp.transpose(at.turn[world, k])
        for q in range(facets.points):
            x = back * (facets.X[q, item] + along(facets, u, world, q, item) - at.place[world, k])
            for m in range(facets.power.shape[0]):
                i = facets.power[m][0]
                j = facets.power[m][1]
                c = facets.basis[q, m]
                if c != f64(0.0):
                    out.y += (c * monomial(s[0], i, 0) * monomial(s[1], j, 0)) * x
                    out.a += (c * monomial(s[0], i, 1) * monomial(s[1], j, 0)) * x
                    out.b += (c * monomial(s[0], i, 0) * monomial(s[1], j, 1)) * x
                    out.aa += (c * monomial(s[0], i, 2) * monomial(s[1], j, 0)) * x
                    out.ab += (c * monomial(s[0], i, 1) * monomial(s[1], j, 1)) * x
                    out.bb += (c * monomial(s[0], i, 0) * monomial(s[1], j, 2)) * x
        return out

    @wp.func
    def side_of(corners: int, k: int, s: vec2d) -> vec3d:
        """Inward normal of an edge of the unit triangle or square, and the distance of s from it."""
        if corners == 3 and k == 2:
            return vec3d(f64(-1.0), f64(-1.0), f64(1.0) - s[0] - s[1])
        if k == 0:
            return vec3d(f64(1.0), f64(0.0), s[0])
        if k == 1:
            return vec3d(f64(0.0), f64(1.0), s[1])
        if k == 2:
            return vec3d(f64(-1.0), f64(0.0), f64(1.0) - s[0])
        return vec3d(f64(0.0), f64(-1.0), f64(1.0) - s[1])

    @wp.func
    def room(corners: int, s: vec2d, d: vec2d) -> f64:
        """Fraction of a step d, at most 1, that stays within the facet."""
        part = f64(1.0)
        for k in range(corners):
            edge = side_of(corners, k, s)
            rate = edge[0] * d[0] + edge[1] * d[1]
            if rate < f64(-1.0e-14) * wp.length(d):
                part = wp.min(part, wp.max(edge[2], f64(0.0)) / -rate)
        return part

    @wp.func
    def downhill(g: vec2d, h: vec3d, corners: int, s: vec2d) -> vec2d:
        """Newton step for a gap with gradient g and second derivatives h (aa, ab, bb), along an edge where that
        blocks it, cut to the facet; 0 without a descent direction."""
        det = h[0] * h[2] - h[1] * h[1]
        size = wp.abs(h[0]) + f64(2.0) * wp.abs(h[1]) + wp.abs(h[2])
        d = g * (f64(-1.0) / wp.max(wp.max(size, wp.length(g)), f64(1.0e-300)))
        if h[0] > f64(0.0) and det > f64(1.0e-10) * size * size:
            d = vec2d(h[1] * g[1] - h[2] * g[0], h[1] * g[0] - h[0] * g[1]) / det
        part = room(corners, s, d)
        if part > f64(1.0e-12):
            return part * d
        for k in range(corners):
            edge = side_of(corners, k, s)
            if edge[2] <= f64(1.0e-12):
                t = vec2d(-edge[1], edge[0])
                slope = wp.dot(g, t)
                bend = h[0] * t[0] * t[0] + f64(2.0) * h[1] * t[0] * t[1] + h[2] * t[1] * t[1]
                way = -wp.sign(slope)
                if bend > f64(0.0):
                    way = -slope / bend
                d = way * t
                part = room(corners, s, d)
                if part > f64(1.0e-12) and slope != f64(0.0):
                    return part * d
        return vec2d()

    @wp.func
    def deepest_of(con: Contacts, facets: Facets, at: Attempt, world: int, k: int, item: int,
                   u: wp.array2d(dtype=vec3d), start: vec2d) -> vec3d:  # fmt: skip
        """Coordinates of the position of a facet closest to the collider, and its gap, by descent from a start."""
        s = start
        here = jet(con, facets, at, world, k, item, u, s)
        d = distance(con, k, here.y, -1)
        for _ in range(TURNS):
            n = vec3d(d[0], d[1], d[2])
            next_a = distance(con, k, here.y + f64(PROBE) * here.a, -1)
            next_b = distance(con, k, here.y + f64(PROBE) * here.b, -1)
            turn_a = (vec3d(next_a[0], next_a[1], next_a[2]) - n) / f64(PROBE)
            turn_b = (vec3d(next_b[0], next_b[1], next_b[2]) - n) / f64(PROBE)
            g = vec2d(wp.dot(n, here.a), wp.dot(n, here.b))
            mixed = f64(0.5) * (wp.dot(here.a, turn_b) + wp.dot(here.b, turn_a))
            h = vec3d(wp.dot(n, here.aa) + wp.dot(here.a, turn_a), wp.dot(n, here.ab) + mixed,
                      wp.dot(n, here.bb) + wp.dot(here.b, turn_b))  # fmt: skip
            step = downhill(g, h, facets.corners, s)
            found = bool(False)
            for _try in range(HALVINGS):
                if not found and wp.length(step) > f64(1.0e-9):
                    new = jet(con, facets, at, world, k, item, u, s + step)
                    new_d = distance(con, k, new.y, -1)
                    if new_d[3] < d[3]:
                        found = True
                        s = s + step
                        here = new
                        d = new_d
                    else:
                        step = f64(0.5) * step
            if not found:
                break
        return vec3d(s[0], s[1], d[3])

    @wp.kernel(module=module)
    def levels(
        con: Contacts, facets: Facets, his: History, time: wp.array(dtype=f64), u: wp.array2d(dtype=vec3d),
        active: wp.array(dtype=wp.int32), at: Attempt,
    ):  # fmt: skip
        """Depths of the points of lumped contacts."""
        world, item, q = wp.tid()
        if active[world] == 0:
            return
        c = facets.contact[item]
        point = facets.point + item * facets.points + q
        depth = f64(-1.0e300)
        if facets.share[q, item] > f64(0.0):
            k = con.collider[c]
            x = facets.X[q, item] + along(facets, u, world, q, item)
            y = wp.transpose(at.turn[world, k]) * (x - at.place[world, k])
            d = distance(con, k, y, -1)
            depth = reach(con, his, world, c, point, time[world], con.grow[world, k]) - d[3]
            if con.dead[c] != 0:  # explicit: its force is that of the last state
                depth = at.depth[world, point]
        at.level[world, point] = depth

    @wp.kernel(module=module)
    def seek(
        con: Contacts, facets: Facets, his: History, time: wp.array(dtype=f64), u: wp.array2d(dtype=vec3d),
        active: wp.array(dtype=wp.int32), at: Attempt,
    ):  # fmt: skip
        """Deepest position of each facet that may touch and be the deepest of its contact; else its deepest point."""
        world, item = wp.tid()
        if active[world] == 0:
            return
        c = facets.contact[item]
        row = facets.row + item
        first = facets.point + item * facets.points
        q = wp.int32(0)
        top = at.level[world, first]
        low = f64(1.0e300)
        for j in range(facets.points):
            level = at.level[world, first + j]
            if level > top:
                top = level
                q = j
            if level > f64(-1.0e299):
                low = wp.min(low, level)
        at.near[world, row] = first + q
        at.spot[world, row] = facets.coords[q]
        at.best[world, row] = top
        highest = top + (top - low)  # upper bound between the points
        known = f64(-1.0e300)
        if at.pick[world, c] >= con.first[c] and at.pick[world, c] < con.first[c + 1]:
            known = at.level[world, at.pick[world, c]]
        if facets.moving == 0 or top < f64(-1.0e299) or highest <= f64(0.0) or highest < known:
            return
        k = con.collider[c]
        found = deepest_of(con, facets, at, world, k, item, u, facets.coords[q])
        at.spot[world, row] = vec2d(found[0], found[1])
        depth = reach(con, his, world, c, first, time[world], con.grow[world, k]) - found[2]
        at.best[world, row] = wp.max(depth, top)

    @wp.kernel(module=module)
    def pick_deepest(
        con: Contacts, row_start: wp.array(dtype=wp.int32), active: wp.array(dtype=wp.int32), fresh: int, at: Attempt,
        changed: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        """Deepest facet of each lumped contact, the first of equals; it may change PICKS times per attempt.

        With two equally deep positions neither alone gives an equilibrium: the last choice stays.
        """
        world, c = wp.tid()
        if active[world] == 0 or con.lumped[c] == 0:
            return
        at.moves[world, c] = -1
        if fresh != 0:
            at.picks[world, c] = 0
        elif at.picks[world, c] >= PICKS:
            return
        best = row_start[c]
        for row in range(best + 1, row_start[c + 1]):
            if at.best[world, row] > at.best[world, best]:
                best = row
        at.moves[world, c] = best
        at.picks[world, c] = at.picks[world, c] + 1
        if fresh != 0 or at.near[world, best] != at.pick[world, c]:
            changed[world] = 1
        at.pick[world, c] = at.near[world, best]

    @wp.kernel(module=module)
    def take(
        con: Contacts, facets: Facets, his: History, clock: Clock, u_n: wp.array2d(dtype=vec3),
        v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), settled: int, at: Attempt,
    ):  # fmt: skip
        """Shape values of the chosen contact point and its position at the start of the attempt; `settled`: at a
        state."""
        world, item = wp.tid()
        c = facets.contact[item]
        if active[world] == 0 or facets.moving == 0 or at.moves[world, c] != facets.row + item:
            return
        point = at.pick[world, c]
        row = facets.row + item
        near = point - (facets.point + item * facets.points)
        moved = wp.length_sq(at.spot[world, row] - facets.coords[near]) > f64(0.0)
        X = vec3d()
        origin = vec3d()
        v = vec3d()
        for i in range(facets.conn.shape[0]):
            w = f64(facets.shape[near, i, item])
            if moved:
                w = f64(0.0)
                for q in range(facets.points):
                    w += lagrange(facets, q, at.spot[world, row]) * f64(facets.shape[q, i, item])
            at.weight[world, c, i] = T(w)
            w = f64(T(w))
            origin += w * vec3d(u_n[world, facets.conn[i, item]])
            v += w * vec3d(v_n[world, facets.conn[i, item]])
        X = facets.X[near, item]
        if moved:
            X = vec3d()
            for q in range(facets.points):
                X += lagrange(facets, q, at.spot[world, row]) * facets.X[q, item]
        at.middle[world, c] = X
        rec = record_of(con, c, point)
        k = con.collider[c]
        turn = his.turn[world, k]
        place = his.place[world, k]
        grown = his.grown[world, k]
        if settled != 0:
            turn = at.turn[world, k]
            place = at.place[world, k]
            grown = con.grow[world, k]
        x = X + origin
        y = wp.transpose(turn) * (x - place)
        live = settled == 0 and his.speed[world, rec] > f64(0.0)
        side = known_side(con, k, live, his.mark[world, rec])
        d = distance(con, k, y, side)
        begins = reach(con, his, world, c, point, clock.time[world], grown)
        at.start[world, point] = y
        at.origin[world, point] = origin
        at.reach[world, point] = begins
        at.depth[world, point] = begins - d[3]
        if settled == 0:
            speed = wp.max(his.speed[world, rec], f64(SPEED_FLOOR))
            if clock.still == 0:
                motion = (at.turn[world, k] * y + at.place[world, k] - x) / clock.h[world]
                approach = wp.dot(turn * vec3d(d[0], d[1], d[2]), motion - v)
                # a rolling contact point descends initially at twice its mean speed
                rolled = depth_before(con, facets, his, at, world, c, point) - at.depth[world, point]
                speed = wp.max(speed, approach - f64(2.0) * rolled / clock.h[world])
            at.speed[world, point] = speed

    return _types.SimpleNamespace(module=module, levels=levels, seek=seek, pick_deepest=pick_deepest, take=take)
