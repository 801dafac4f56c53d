"""Contact of points of a body with facets of another: forces, tangent, frozen friction quantities.

The law is that of contact with obstacles. Depth is the distance from the projection on the master's facet: the normal
force, its derivative, acts there by the shape functions of the facet, along a line through the point. Friction acts at
the point's own coordinates, by the shape functions of the master's material there. So force and moment balance, and the
force is that of a potential of the iterate, nearly continuous where a point passes to the next facet, for any strain.
"""

import functools
import types as _types

import warp as wp

from ..common.lanes import lane_functions
from ..common.types import SMALL, kernel_module, precision
from .contact import IDLE, LOADED, STIFF
from .contact_data import attempt_struct, clock_struct, contact_struct, facet_struct, history_struct, of_world
from .contact_laws import law_functions
from .contact_touch import touch_functions
from .pair_data import master_struct, seat_struct, touching_struct
from .pair_places import place_functions
from .pair_seek import THROUGH

__all__ = ["pair_functions", "pair_kernels"]


@functools.cache
def pair_functions(dtype: str) -> _types.SimpleNamespace:
    """Device function touch_of."""
    f64 = wp.float64
    Contacts, Attempt, Touching = contact_struct(False), attempt_struct(dtype), touching_struct(dtype)
    k, normal_law = touch_functions(dtype, False), law_functions().normal_law
    Touch, in_plane, rate_of = k.Touch, k.in_plane, k.rate_of

    @wp.func
    def touch_of(con: Contacts, at: Attempt, t: Touching, world: int, c: int, point: int, inv_h: f64) -> Touch:
        """A point on its facet."""
        out = Touch()
        out.n = t.normal[world, point]
        out.depth = t.depth[world, point]
        out.rise = out.depth - t.before[world, point]
        k_n = con.scale[world, c] * of_world(con.normal, world, c)
        rate = rate_of(con, at, world, c, point, inv_h)
        out.law = normal_law(con.law[c], 0, k_n, rate, con.ramp[c], con.force_eps[c], out.depth,
                             t.before[world, point])  # fmt: skip
        out.motion = t.motion[world, point]
        out.whole = t.whole[world, point]
        return in_plane(out, wp.normalize(out.n))

    return _types.SimpleNamespace(touch_of=touch_of)


@functools.cache
def pair_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels in one precision of the displacements."""
    p = precision(dtype)
    T, vec2, vec3, sym = p.T, p.vec2, p.vec3, p.sym
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets, History = contact_struct(False), facet_struct(dtype), history_struct()
    Attempt, Clock = attempt_struct(dtype), clock_struct()
    Masters, Seats, Touching = master_struct(dtype), seat_struct(), touching_struct(dtype)
    k, places = touch_functions(dtype, False), place_functions(dtype)
    touch_of = pair_functions(dtype).touch_of
    in_plane, hold, put_explicit = k.in_plane, k.hold, k.put_explicit
    friction_potential, friction_force, point_stiffness = k.friction_potential, k.friction_force, k.point_stiffness
    jet, weigh = places.jet, places.weigh
    lane_sum = lane_functions(dtype).lane_sum
    module = kernel_module(f"pairs_{dtype}", max_unroll=SMALL)

    @wp.kernel(module=module)
    def explicit_forces(
        con: Contacts, mas: Masters, facets: Facets, his: History, seats: Seats, clock: Clock,
        v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), at: Attempt, t: Touching,
    ):  # fmt: skip
        """Forces of explicit contacts at the state that the attempt begins from."""
        world, item, q = wp.tid()
        c = facets.contact[item]
        point = facets.point + item * facets.points + q
        if active[world] == 0 or facets.share[q, item] == f64(0.0) or con.dead[c] == 0:
            return
        at.dead[world, point] = vec3d()
        at.dead_spring[world, point] = vec3d()
        delta = at.depth[world, point]
        if delta <= f64(0.0):
            return
        f = seats.seat[world, point] - 1
        spot = t.spot0[world, point]
        s = jet(mas, t.C0, t.D0, world, f, spot)
        n = wp.normalize(wp.cross(s.a, s.b))
        foot = vec3d(spot[0], spot[1], f64(0.0))
        v = k.along(facets, v_n, world, q, item) - places.moved(mas, t.V0, t.V0, world, f, foot)
        put_explicit(con, his, at, world, c, point, delta, n, v, clock.h[world])

    @wp.func
    def relative(
        mas: Masters, facets: Facets, t: Touching, u: wp.array2d(dtype=vec3d), world: int, q: int, item: int,
        point: int, f: int,
    ) -> vec3d:  # fmt: skip
        """Displacement of a point relative to a facet, by the frozen shape values."""
        out = k.along(facets, u, world, q, item)
        for i in range(mas.conn.shape[0]):
            out -= f64(t.held_weight[world, point, i]) * vec3d(u[world, mas.conn[i, f]])
        return out

    @wp.func
    def hold_functions(
        mas: Masters, facets: Facets, t: Touching, u: wp.array2d(dtype=vec3d), world: int, q: int, item: int,
        point: int, f: int,
    ):  # fmt: skip
        """Freeze the shape values of friction: store motion and relative displacement at this iterate."""
        t.held_motion[world, point] = t.motion[world, point]
        t.held_whole[world, point] = t.whole[world, point]
        t.held_shift[world, point] = relative(mas, facets, t, u, world, q, item, point, f)
        t.held_facet[world, point] = f

    @wp.kernel(module=module)
    def take_functions(
        mas: Masters, facets: Facets, u: wp.array2d(dtype=vec3d), flags: wp.array(dtype=wp.int32), at: Attempt,
        t: Touching,
    ):  # fmt: skip
        """Update the shape values of friction to those of the iterate."""
        world, item, q = wp.tid()
        point = facets.point + item * facets.points + q
        if flags[world] == 0 or at.state[world, point] != STIFF:
            return
        f = t.seat[world, point]
        for i in range(mas.conn.shape[0]):
            t.held_weight[world, point, i] = T(weigh(mas, f, i, t.spot[world, point]))
        hold_functions(mas, facets, t, u, world, q, item, point, f)

    @wp.func
    def lean_on(mas: Masters, t: Touching, world: int, point: int, f: int, gap: f64, force: f64):
        """Geometric stiffness of the normal force: rotation of the facet under a force, and motion of the projection.

        With the relative displacement d at the projection, e_a = n.(change of the tangent a_a), t_a = a_a.d, b the
        curvature, M = a - gap b and m its inverse, it is 2 t m e + gap e m e + t a^-1 b m t (Wriggers, Computational
        Contact Mechanics, 2006, 4.1, with the facet's curvature). `lean`: force m a; `bend`: force gap m, and M a^-1 b
        / force.
        """
        spot = t.foot[world, point]
        n = t.normal[world, point]
        s = jet(mas, t.C, t.D, world, f, spot)
        b = places.curved(mas, t.C, world, f, spot, n)
        aa, bb, ab = wp.dot(s.a, s.a), wp.dot(s.b, s.b), wp.dot(s.a, s.b)
        A = wp.mat22d(aa, ab, ab, bb)
        B = wp.mat22d(b[0], b[2], b[2], b[1])
        M = A - gap * B
        det = wp.determinant(M)
        t.lean[world, point, 0] = vec3()
        t.lean[world, point, 1] = vec3()
        t.bend[world, point] = sym()
        if force <= f64(0.0) or det <= f64(0.1) * wp.determinant(A):
            return  # no projection beyond the centre of curvature
        m = force * wp.inverse(M)
        t.lean[world, point, 0] = vec3(m[0, 0] * s.a + m[0, 1] * s.b)
        t.lean[world, point, 1] = vec3(m[1, 0] * s.a + m[1, 1] * s.b)
        N = (M @ wp.inverse(A) @ B) / force
        t.bend[world, point] = sym(T(gap * m[0, 0]), T(gap * m[1, 1]), T(gap * m[0, 1]), T(N[0, 0]), T(N[1, 1]),
                                   T(N[0, 1]))  # fmt: skip

    @wp.func
    def put_dead(mas: Masters, at: Attempt, t: Touching, world: int, point: int, f: int, share: f64):
        """Explicit force of a point, applied at its position at the start of the attempt."""
        work = -share * wp.dot(at.dead[world, point], t.motion[world, point])
        at.state[world, point] = LOADED
        at.force[world, point] = -share * at.dead[world, point]
        at.energy[world, point] = wp.vec2d(work, wp.abs(work))
        t.friction[world, point] = vec3d()
        for i in range(mas.conn.shape[0]):
            t.weight[world, point, i] = T(weigh(mas, f, i, t.spot0[world, point]))

    @wp.kernel(module=module)
    def forces(
        con: Contacts, mas: Masters, facets: Facets, his: History, seats: Seats, clock: Clock,
        u: wp.array2d(dtype=vec3d), active: wp.array(dtype=wp.int32), fresh: int, at: Attempt, t: Touching,
    ):  # fmt: skip
        """Forces on points, their stiffness and potential; friction limits and shape values of friction are frozen."""
        world, item, q = wp.tid()
        if active[world] == 0:
            return
        c = facets.contact[item]
        point = facets.point + item * facets.points + q
        share = facets.share[q, item]
        at.state[world, point] = IDLE
        f = t.seat[world, point]
        if con.dead[c] != 0 and share > f64(0.0):
            if wp.length_sq(at.dead[world, point]) > f64(0.0):
                f = seats.seat[world, point] - 1
                put_dead(mas, at, t, world, point, f, share)
        elif f == THROUGH:
            at.through[world] = point + 1
            at.state[world, point] = LOADED
            at.force[world, point] = vec3d()
            t.friction[world, point] = vec3d()
            at.energy[world, point] = wp.vec2d(f64(wp.inf), f64(0.0))
            f = -1
        elif f >= 0 and share > f64(0.0):
            inv_h = f64(0.0)
            if clock.still == 0:
                inv_h = f64(1.0) / clock.h[world]
            s = touch_of(con, at, t, world, c, point, inv_h)
            held = at.held[world, point]
            new = hold(con, his, at, world, c, point, s)
            if fresh != 0:
                at.plane[world, point] = s.m
                held = new
                held[0] = wp.min(new[0], his.cap[world, point])
                at.held[world, point] = held
            held[1] = new[1]
            held[2] = f64(1.0)
            at.next_plane[world, point] = s.m
            at.next[world, point] = new
            m = at.plane[world, point]
            if wp.dot(m, s.m) <= f64(0.5):  # the point has passed to another facet since
                m = s.m
                at.plane[world, point] = m
            for i in range(mas.conn.shape[0]):
                t.weight[world, point, i] = T(weigh(mas, f, i, t.foot[world, point]))
                t.slope[world, point, i] = vec2(places.slopes(mas, f, i, t.foot[world, point]))
                if fresh != 0 or held[0] <= f64(0.0):
                    t.held_weight[world, point, i] = T(weigh(mas, f, i, t.spot[world, point]))
            if fresh != 0:
                hold_functions(mas, facets, t, u, world, q, item, point, f)
            if held[0] > f64(0.0):  # frozen shape values: friction has a potential
                shift = relative(mas, facets, t, u, world, q, item, point, t.held_facet[world, point])
                s.motion = t.held_motion[world, point] + (shift - t.held_shift[world, point])
                s.whole = t.held_whole[world, point] + (shift - t.held_shift[world, point])
            s = in_plane(s, m)
            if s.depth > f64(0.0) or held[0] > f64(0.0):
                rub = friction_potential(con, world, c, s, held, inv_h)
                K = point_stiffness(con, world, c, s, held, inv_h)
                pulled = share * friction_force(con, world, c, s, held, inv_h)
                at.state[world, point] = STIFF
                t.friction[world, point] = pulled
                lean_on(mas, t, world, point, f, at.reach[world, point] - s.depth, share * s.law[0])
                at.force[world, point] = pulled - (share * s.law[0]) * s.n
                at.energy[world, point] = wp.vec2d(share * (s.law[2] + rub), share * (s.law[3] + wp.abs(rub)))
                at.stiffness[world, point] = sym(T(share * K[0, 0]), T(share * K[1, 1]), T(share * K[2, 2]),
                    T(share * K[1, 2]), T(share * K[0, 2]), T(share * K[0, 1]))  # fmt: skip
        elif share > f64(0.0):
            held = vec3d()
            at.next[world, point] = held
            if fresh != 0:
                at.held[world, point] = held
                at.plane[world, point] = held
        wanted = wp.int32(0)
        if at.state[world, point] != IDLE and f >= 0:
            wanted = f + 1
        if t.listed[world, point] != wanted:
            t.listed[world, point] = wanted
            t.changed[0] = 1

    @wp.kernel(module=module)
    def gather_masters(
        mas: Masters, active: wp.array(dtype=wp.int32), lanes: int, at: Attempt, t: Touching,
        pool: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """Forces of points on the slots of their master facets."""
        world, index = wp.tid()
        if active[world] == 0:
            return
        entry = wp.min(index / lanes, mas.count * mas.conn.shape[0] - 1)
        f = entry % mas.count
        i = entry / mas.count
        total = vec3()
        first = t.start[world, f]
        for k in range(index % lanes, t.points[world, f], lanes):
            point = t.entry[world, first + k]
            pulled = t.friction[world, point]
            total -= t.weight[world, point, i] * vec3(at.force[world, point] - pulled)
            total -= t.held_weight[world, point, i] * vec3(pulled)
        total = lane_sum(total, lanes)
        if index % lanes == 0:
            pool[world, mas.pool + entry] = total

    @wp.func
    def times(k: sym, p: vec3) -> vec3:
        """The symmetric matrix k (Voigt) times p."""
        return vec3(k[0] * p[0] + k[5] * p[1] + k[4] * p[2], k[5] * p[0] + k[1] * p[1] + k[3] * p[2],
                    k[4] * p[0] + k[3] * p[1] + k[2] * p[2])  # fmt: skip

    @wp.kernel(module=module)
    def product_points(
        mas: Masters, facets: Facets, active: wp.array(dtype=wp.int32), p: wp.array2d(dtype=vec3), at: Attempt,
        t: Touching,
    ):  # fmt: skip
        """K times the relative displacement of each point."""
        world, item, q = wp.tid()
        if active[world] == 0 or at.touched[world, facets.row + item] != STIFF:
            return
        point = facets.point + item * facets.points + q
        if at.state[world, point] != STIFF:
            at.flux[world, point] = vec3()
            t.turned[world, point] = vec2()
            return
        f = t.listed[world, point] - 1
        n = vec3(t.normal[world, point])
        d = vec3()
        e = vec2()
        for i in range(facets.conn.shape[0]):
            d += facets.shape[q, i, item] * p[world, facets.conn[i, item]]
        for i in range(mas.conn.shape[0]):
            own = p[world, mas.conn[i, f]]
            d -= t.weight[world, point, i] * own
            e += wp.dot(n, own) * t.slope[world, point, i]
        a = t.lean[world, point, 0]
        b = t.lean[world, point, 1]
        g = t.bend[world, point]
        tau = vec2(wp.dot(a, d), wp.dot(b, d))
        at.flux[world, point] = (
            times(at.stiffness[world, point], d)
            + (e[0] + g[3] * tau[0] + g[5] * tau[1]) * a
            + (e[1] + g[5] * tau[0] + g[4] * tau[1]) * b
        )
        t.turned[world, point] = tau + vec2(g[0] * e[0] + g[2] * e[1], g[2] * e[0] + g[1] * e[1])

    @wp.kernel(module=module)
    def product_sides(
        mas: Masters, facets: Facets, active: wp.array(dtype=wp.int32), lanes: int, last: int, at: Attempt,
        t: Touching, pool: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """Sums of the products on the slots of the slave facets, and of master facets where the launch includes
        them."""
        world, index = wp.tid()
        if active[world] == 0:
            return
        out = vec3()
        own = facets.count * facets.conn.shape[0]
        entry = wp.min(index / lanes, last)
        lane = index % lanes
        place = facets.pool + entry
        if entry < own:
            item = entry % facets.count
            i = entry / facets.count
            if at.touched[world, facets.row + item] == STIFF:
                for q in range(lane, facets.points, lanes):
                    out += facets.shape[q, i, item] * at.flux[world, facets.point + item * facets.points + q]
        else:
            entry -= own
            place = mas.pool + entry
            f = entry % mas.count
            i = entry / mas.count
            first = t.start[world, f]
            for k in range(lane, t.points[world, f], lanes):
                point = t.entry[world, first + k]
                out -= t.weight[world, point, i] * at.flux[world, point]
                out += wp.dot(t.slope[world, point, i], t.turned[world, point]) * vec3(t.normal[world, point])
        out = lane_sum(out, lanes)
        if lane == 0:
            pool[world, place] = out

    @wp.kernel(module=module)
    def diagonal_masters(
        mas: Masters, active: wp.array(dtype=wp.int32), at: Attempt, t: Touching, pool: wp.array2d(dtype=sym)
    ):  # fmt: skip
        """3x3 diagonal blocks of master facets."""
        world, f, i = wp.tid()
        if active[world] == 0:
            return
        out = sym()
        for k in range(t.points[world, f]):
            point = t.entry[world, t.start[world, f] + k]
            if at.state[world, point] == STIFF:
                s = t.weight[world, point, i]
                out += s * s * at.stiffness[world, point]
        pool[world, mas.pool + i * mas.count + f] = out

    return _types.SimpleNamespace(
        module=module, explicit_forces=explicit_forces, forces=forces, take_functions=take_functions,
        gather_masters=gather_masters, product_points=product_points, product_sides=product_sides,
        diagonal_masters=diagonal_masters,
    )  # fmt: skip
