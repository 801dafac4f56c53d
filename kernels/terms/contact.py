"""Contact of surface points with rigid shapes: forces, tangent, friction limits, explicit forces.

A point's force is the derivative of a scalar: `normal_law` of its depth, and `friction` of its anchored slip, whose
limit mu F_n is frozen during a line search and updated at each iterate. Gap and law are evaluated in float64.
"""

import functools
import types as _types

import warp as wp

from ..common.lanes import lane_functions
from ..common.types import SMALL, kernel_module, precision
from .contact_colliders import MESHES, collider_functions
from .contact_data import attempt_struct, clock_struct, contact_struct, facet_struct, history_struct
from .contact_laws import SMOOTH
from .contact_touch import touch_functions

__all__ = ["MOST_TURN", "RELAX_LANES", "SPEED_FLOOR", "contact_kernels"]

SPEED_FLOOR = 1e-3
"""Lower bound of the approach speed in the damping of the default law, m/s."""
IDLE, LOADED, STIFF = 0, 1, 2
"""States of a point: no force; a force without tangent; a force with tangent."""
MOST_TURN = 1.0
"""Largest rotation of a touched collider in a step, rad; larger rotations are rejected."""
RELAX_LANES = 128
SHRINKS = 0.35
"""Ratio of successive changes of the friction limits above which they are relaxed."""


@functools.cache
def contact_kernels(dtype: str, meshes: bool) -> _types.SimpleNamespace:
    """Kernels of contact in one precision of the displacements; `meshes`: some collider is a triangle mesh."""
    p = precision(dtype)
    T, vec3, sym = p.T, p.vec3, p.sym
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets = contact_struct(meshes), facet_struct(dtype)
    lane_sum = lane_functions(dtype).lane_sum
    History, Attempt, Clock = history_struct(), attempt_struct(dtype), clock_struct()
    f = touch_functions(dtype, meshes)
    along, record_of, reach, acts, shape_of = f.along, f.record_of, f.reach, f.acts, f.shape_of
    put_explicit, touch, in_plane, hold = f.put_explicit, f.touch, f.in_plane, f.hold
    friction_potential, friction_force = f.friction_potential, f.friction_force
    point_stiffness = f.point_stiffness
    g = collider_functions(meshes)
    distance, known_side, beside = g.distance, g.known_side, g.beside
    module = kernel_module(f"contact_{dtype}{MESHES * meshes}", max_unroll=SMALL)

    @wp.kernel(module=module)
    def poses(
        con: Contacts, his: History, value: wp.array2d(dtype=vec3d), active: wp.array(dtype=wp.int32), at: Attempt
    ):  # fmt: skip
        """Poses of the colliders at the end of the attempt, and their motion in it."""
        world, k = wp.tid()
        if active[world] == 0:
            return
        place = con.center[k]
        turn = con.axes[k]
        if con.spin[k] >= 0:
            angle = value[world, con.spin[k]][0]
            n = con.axis[k]
            N = wp.skew(n)
            half = wp.sin(f64(0.5) * angle)
            R = wp.identity(n=3, dtype=f64) + wp.sin(angle) * N + (f64(2.0) * half * half) * (N * N)
            place = con.anchor[k] + R * (place - con.anchor[k])
            turn = R * turn
        if con.path[k] >= 0:
            place += value[world, con.path[k]]
        if k == 0:
            at.changes[world] = 0
        at.place[world, k] = place
        at.turn[world, k] = turn
        at.shift[world, k] = place - his.place[world, k]
        if con.spin[k] >= 0:
            at.angle[world, k] = value[world, con.spin[k]][0]
            at.spin[world, k] = turn * wp.transpose(his.turn[world, k]) - wp.identity(n=3, dtype=f64)

    @wp.kernel(module=module)
    def begin_points(
        con: Contacts, facets: Facets, his: History, clock: Clock, u_n: wp.array2d(dtype=vec3),
        v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), at: Attempt,
    ):  # fmt: skip
        """Positions of the points at the start of an attempt, and the approach speed of the damping."""
        world, item, q = wp.tid()
        if active[world] == 0:
            return
        if q == 0 and item == 0 and facets.row == 0:
            at.through[world] = 0
            if clock.part[world] == 0:
                at.elapsed[world] = f64(0.0)
        if facets.share[q, item] == f64(0.0):
            return
        c = facets.contact[item]
        point = facets.point + item * facets.points + q
        rec = record_of(con, c, point)
        k = con.collider[c]
        x = facets.X[q, item] + along(facets, u_n, world, q, item)
        turn = his.turn[world, k]
        y = wp.transpose(turn) * (x - his.place[world, k])
        live = his.speed[world, rec] > f64(0.0)
        if wp.static(meshes):
            if not live:
                his.mark[world, rec] = beside(con, k, y, his.mark[world, rec])
        side = known_side(con, k, live, his.mark[world, rec])
        d = distance(con, k, y, side)
        at.start[world, point] = y
        begins = reach(con, his, world, c, point, clock.time[world], his.grown[world, k])
        at.origin[world, point] = along(facets, u_n, world, q, item)
        at.reach[world, point] = begins
        at.depth[world, point] = begins - d[3]
        speed = wp.max(his.speed[world, rec], f64(SPEED_FLOOR))
        if clock.still == 0:
            moved = (at.turn[world, k] * y + at.place[world, k] - x) / clock.h[world]
            approach = wp.dot(turn * vec3d(d[0], d[1], d[2]), moved - along(facets, v_n, world, q, item))
            speed = wp.max(speed, approach)
        at.speed[world, point] = speed

    @wp.kernel(module=module)
    def settle(
        con: Contacts, facets: Facets, his: History, time: wp.array(dtype=f64), u: wp.array2d(dtype=vec3), at: Attempt
    ):  # fmt: skip
        """Point data at a state without motion, for evaluations outside of a step."""
        world, item, q = wp.tid()
        c = facets.contact[item]
        k = con.collider[c]
        x = facets.X[q, item] + along(facets, u, world, q, item)
        point = facets.point + item * facets.points + q
        y = wp.transpose(at.turn[world, k]) * (x - at.place[world, k])
        at.start[world, point] = y
        at.origin[world, point] = along(facets, u, world, q, item)
        d = distance(con, k, y, -1)
        at.reach[world, point] = reach(con, his, world, c, point, time[world], con.grow[world, k])
        at.depth[world, point] = at.reach[world, point] - d[3]

    @wp.kernel(module=module)
    def explicit_forces(
        con: Contacts, facets: Facets, his: History, clock: Clock, v_n: wp.array2d(dtype=vec3),
        active: wp.array(dtype=wp.int32), at: Attempt,
    ):  # fmt: skip
        """Forces of explicit contacts at the state that the attempt begins from."""
        world, item, q = wp.tid()
        if active[world] == 0 or facets.share[q, item] == f64(0.0):
            return
        c = facets.contact[item]
        if con.dead[c] == 0:
            return
        point = facets.point + item * facets.points + q
        rec = record_of(con, c, point)
        k = con.collider[c]
        at.dead[world, point] = vec3d()
        at.dead_spring[world, point] = vec3d()
        delta = at.depth[world, point]
        if delta <= f64(0.0):
            return
        turn = his.turn[world, k]
        y = at.start[world, point]
        side = known_side(con, k, True, his.mark[world, rec])
        d = distance(con, k, y, side)
        n = turn * vec3d(d[0], d[1], d[2])
        x = turn * y + his.place[world, k]
        h = clock.h[world]
        moved = (at.turn[world, k] * y + at.place[world, k] - x) / h
        put_explicit(con, his, at, world, c, point, delta, n, along(facets, v_n, world, q, item) - moved, h)

    @wp.func
    def dead_work(
        con: Contacts, facets: Facets, his: History, at: Attempt, world: int, c: int, q: int, item: int, point: int,
        u: wp.array2d(dtype=vec3d),
    ) -> f64:  # fmt: skip
        """Potential of an explicit force: minus its work on the step so far, J."""
        k = con.collider[c]
        x_n = his.turn[world, k] * at.start[world, point] + his.place[world, k]
        x = facets.X[q, item] + along(facets, u, world, q, item)
        return -wp.dot(at.dead[world, point], x - x_n)

    @wp.kernel(module=module)
    def forces(
        con: Contacts, facets: Facets, his: History, clock: Clock, u: wp.array2d(dtype=vec3d),
        active: wp.array(dtype=wp.int32), fresh: int, at: Attempt,
    ):  # fmt: skip
        """Forces of points, N, their stiffness and potential.

        `fresh`: an attempt begins. Friction limits are frozen while Newton's method solves: the problem then has a
        potential, which it would lose with the limits of each iterate where an iterate lies deep in an obstacle.
        """
        world, item, q = wp.tid()
        if active[world] == 0:
            return
        c = facets.contact[item]
        point = facets.point + item * facets.points + q
        share = facets.share[q, item] * acts(con, at, world, c, point)
        at.state[world, point] = IDLE
        if share == f64(0.0):
            return
        inv_h = f64(0.0)
        if clock.still == 0:
            inv_h = f64(1.0) / clock.h[world]
        rec = record_of(con, c, point)
        held = at.held[world, rec]
        if fresh != 0:
            held[2] = f64(1.0)
        t = touch(con, facets, his, at, world, c, q, item, point, u, clock.new_time[world], inv_h, held[2])
        if con.dead[c] == 0:
            new = hold(con, his, at, world, c, point, t)
            if fresh != 0:  # initial limits: those of the last step, zero for a new contact
                at.plane[world, rec] = t.n
                held = new
                held[0] = wp.min(new[0], his.cap[world, rec])
                at.held[world, rec] = held
            at.next_plane[world, rec] = t.n
            t = in_plane(t, at.plane[world, rec])
            at.next[world, rec] = new
        turned = f64(0.0)
        if con.spin[con.collider[c]] >= 0:
            turned = wp.abs(at.angle[world, con.collider[c]] - his.angle[world, con.collider[c]])
        near = t.depth > f64(0.0) or at.depth[world, point] > f64(0.0)
        if t.side == -2 or (near and turned > f64(MOST_TURN)):
            at.through[world] = wp.where(t.side == -2, point + 1, -point - 1)
            at.state[world, point] = LOADED
            at.force[world, point] = vec3d()
            at.energy[world, point] = wp.vec2d(f64(wp.inf), f64(0.0))
        elif con.dead[c] != 0:
            if wp.length_sq(at.dead[world, point]) > f64(0.0):
                work = share * dead_work(con, facets, his, at, world, c, q, item, point, u)
                at.state[world, point] = LOADED
                at.force[world, point] = -share * at.dead[world, point]
                at.energy[world, point] = wp.vec2d(work, wp.abs(work))
        elif t.depth > f64(0.0) or held[0] > f64(0.0) or con.law[c] == SMOOTH:
            rub = friction_potential(con, world, c, t, held, inv_h)
            K = point_stiffness(con, world, c, t, held, inv_h)
            at.state[world, point] = STIFF
            at.force[world, point] = share * (friction_force(con, world, c, t, held, inv_h) - t.law[0] * t.n)
            at.energy[world, point] = wp.vec2d(share * (t.law[2] + rub), share * (t.law[3] + wp.abs(rub)))
            at.stiffness[world, point] = sym(T(share * K[0, 0]), T(share * K[1, 1]), T(share * K[2, 2]),
                T(share * K[1, 2]), T(share * K[0, 2]), T(share * K[0, 1]))  # fmt: skip

    @wp.kernel(module=module)
    def gather_points(
        facets: Facets, active: wp.array(dtype=wp.int32), lanes: int, at: Attempt, pool: wp.array2d(dtype=vec3),
        rows: wp.array3d(dtype=f64), touching: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        """Forces of facets on their slots and, once per facet, rows of the potential."""
        world, index = wp.tid()
        if active[world] == 0:
            return
        entry = wp.min(index / lanes, facets.count * facets.conn.shape[0] - 1)
        item = entry % facets.count
        i = entry / facets.count
        lane = index % lanes
        first = facets.point + item * facets.points
        touched = wp.int32(IDLE)
        for q in range(facets.points):
            touched = wp.max(touched, at.state[world, first + q])
        f = vec3()
        if touched != IDLE:
            for q in range(lane, facets.points, lanes):
                if at.state[world, first + q] != IDLE:
                    f += shape_of(facets, at, world, q, i, item) * vec3(at.force[world, first + q])
        f = lane_sum(f, lanes)
        if lane > 0:
            return
        pool[world, facets.pool + entry] = f
        if i > 0:
            return
        row = facets.row + item
        before = at.touched[world, row]
        at.touched[world, row] = touched
        if wp.max(before, touched) == IDLE:
            return  # the rows are already zero
        energy = wp.vec2d()
        for q in range(facets.points):
            state = at.state[world, first + q]
            if state != IDLE:
                energy += at.energy[world, first + q]
            if state != STIFF:
                at.stiffness[world, first + q] = sym()
        if touched != IDLE:
            wp.atomic_max(touching, world, 1)
        rows[0, world, row] = energy[0]
        rows[1, world, row] = energy[0]
        rows[2, world, row] = energy[1]

    @wp.kernel(module=module)
    def partial_asked(flags: wp.array(dtype=wp.int32), at: Attempt):
        """Partial sums, by lanes, of r = limit of the iterate - frozen limit, and of the change of r, for `relax`."""
        world, lane = wp.tid()
        if flags[world] == 0:
            return
        out = wp.vec4d()
        for point in range(lane, at.asked.shape[1], RELAX_LANES):
            if at.state[world, point] == STIFF:
                r = at.next[world, point][0] - at.held[world, point][0]
                old = at.asked[world, point]
                new = at.next[world, point][0]
                out += wp.vec4d(old * (r - old), (r - old) * (r - old), r * r, new * new)
        at.asked_sums[world, lane] = out

    @wp.kernel(module=module)
    def relax(flags: wp.array(dtype=wp.int32), tol: f64, at: Attempt, unsettled: wp.array(dtype=wp.int32)):
        """Relaxation factor of the friction limits: 1 while r shrinks, else Aitken's (Irons and Tuck 1969)."""
        world = wp.tid()
        if flags[world] == 0:
            return
        total = wp.vec4d()
        for lane in range(RELAX_LANES):
            total += at.asked_sums[world, lane]
        omega = f64(1.0)
        slow = total[2] > f64(SHRINKS) * f64(SHRINKS) * at.asked_size[world] and total[1] > f64(0.0)
        if at.changes[world] > 0 and slow and total[2] > tol * tol * total[3]:
            omega = wp.clamp(-at.omega[world] * total[0] / total[1], f64(0.05), f64(2.0))
            unsettled[world] = 1
        at.omega[world] = omega
        at.asked_size[world] = total[2]
        at.changes[world] = at.changes[world] + 1

    @wp.kernel(module=module)
    def refresh(flags: wp.array(dtype=wp.int32), at: Attempt):
        """Update the frozen friction limits by the relaxed change, and the plane of friction."""
        world, point = wp.tid()
        if flags[world] != 0:
            new = at.next[world, point]
            r = new[0] - at.held[world, point][0]
            if at.omega[world] != f64(1.0):
                new[0] = wp.max(at.held[world, point][0] + at.omega[world] * r, f64(0.0))
            at.asked[world, point] = r
            at.held[world, point] = new
            at.plane[world, point] = at.next_plane[world, point]

    @wp.func
    def times(k: sym, p: vec3) -> vec3:
        """Product of the symmetric matrix k (Voigt) with p."""
        return vec3(k[0] * p[0] + k[5] * p[1] + k[4] * p[2], k[5] * p[0] + k[1] * p[1] + k[3] * p[2],
                    k[4] * p[0] + k[3] * p[1] + k[2] * p[2])  # fmt: skip

    @wp.kernel(module=module)
    def product_points(
        facets: Facets, active: wp.array(dtype=wp.int32), p: wp.array2d(dtype=vec3), at: Attempt
    ):  # fmt: skip
        """K times the displacement of each point."""
        world, item, q = wp.tid()
        if active[world] == 0 or at.touched[world, facets.row + item] != STIFF:
            return
        d = vec3()
        for i in range(facets.conn.shape[0]):
            d += shape_of(facets, at, world, q, i, item) * p[world, facets.conn[i, item]]
        point = facets.point + item * facets.points + q
        at.flux[world, point] = times(at.stiffness[world, point], d)

    @wp.kernel(module=module)
    def product_facets(
        facets: Facets, active: wp.array(dtype=wp.int32), lanes: int, at: Attempt, pool: wp.array2d(dtype=vec3)
    ):  # fmt: skip
        """Sums of the point products on the slots of the facets."""
        world, index = wp.tid()
        if active[world] == 0:
            return
        entry = wp.min(index / lanes, facets.count * facets.conn.shape[0] - 1)
        item = entry % facets.count
        out = vec3()
        if at.touched[world, facets.row + item] == STIFF:
            for q in range(index % lanes, facets.points, lanes):
                flux = at.flux[world, facets.point + item * facets.points + q]
                out += shape_of(facets, at, world, q, entry / facets.count, item) * flux
        out = lane_sum(out, lanes)
        if index % lanes == 0:
            pool[world, facets.pool + entry] = out

    @wp.kernel(module=module)
    def diagonal(facets: Facets, active: wp.array(dtype=wp.int32), at: Attempt, pool: wp.array2d(dtype=sym)):
        """3x3 diagonal blocks of the facets."""
        world, item, i = wp.tid()
        if active[world] == 0:
            return
        out = sym()
        if at.touched[world, facets.row + item] == STIFF:
            for q in range(facets.points):
                s = shape_of(facets, at, world, q, i, item)
                out += s * s * at.stiffness[world, facets.point + item * facets.points + q]
        pool[world, facets.pool + i * facets.count + item] = out

    return _types.SimpleNamespace(
        module=module, poses=poses, begin_points=begin_points, settle=settle, explicit_forces=explicit_forces,
        forces=forces, gather_points=gather_points,
        partial_asked=partial_asked, relax=relax, refresh=refresh,
        product_points=product_points, product_facets=product_facets, diagonal=diagonal,
    )  # fmt: skip
