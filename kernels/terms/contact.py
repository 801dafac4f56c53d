"""Contact of surface points with rigid shapes: forces, their tangent, and what an accepted step keeps and books.

A point's force is the derivative of a scalar: `normal_law` of its depth, and `friction` of its anchored slip whose cap
mu F_n is held in a line search and refreshed at each iterate. The gap and all of the law are in float64.
"""

import functools
import types as _types

import warp as wp

from ..common.types import SMALL, kernel_module, precision
from ..step.control import step_struct
from .contact_data import attempt_struct, contact_struct, facet_struct, history_struct
from .contact_laws import DEFAULT, PAPER, SMOOTH, law_functions
from .contact_shapes import shape_functions

__all__ = ["SPEED_FLOOR", "contact_kernels"]

SPEED_FLOOR = 1e-3
"""Least approach speed that the default law's damping is made for, m/s."""
SLIPS = 16


@functools.cache
def contact_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels of contact in one precision of the displacements."""
    p = precision(dtype)
    T, vec3, sym = p.T, p.vec3, p.sym
    f64, vec3d, mat33d = wp.float64, wp.vec3d, wp.mat33d
    Contacts, Facets = contact_struct(), facet_struct(dtype)
    History, Attempt, Step = history_struct(), attempt_struct(dtype), step_struct()
    shapes, laws = shape_functions(), law_functions()
    distance, sweep = shapes.distance, shapes.sweep
    elastic, normal_law = laws.elastic, laws.normal_law
    friction, smooth_friction = laws.friction, laws.smooth_friction
    module = kernel_module(f"contact_{dtype}", max_unroll=SMALL)

    @wp.struct
    class Touch:
        """A point at an iterate; forces are of the whole region."""

        n: vec3d  # outward normal of the shape
        depth: f64
        side: wp.int32
        law: vec3d  # normal force, its derivative, its potential
        slip: vec3d  # tangential motion in the step
        q: vec3d  # spring: tangential slip since it was anchored
        y: vec3d  # place in the collider's frame

    @wp.func
    def along(facets: Facets, field: wp.array2d(dtype=vec3), world: int, point: int, item: int) -> vec3d:
        """sum_i s_i field_i at a point."""
        out = vec3d()
        for i in range(facets.conn.shape[0]):
            out += f64(facets.shape[point, i, item]) * vec3d(field[world, facets.conn[i, item]])
        return out

    @wp.func
    def plane(n: vec3d, a: vec3d) -> vec3d:
        """The part of a that is normal to n."""
        return a - wp.dot(n, a) * n

    @wp.func
    def record_of(con: Contacts, c: int, point: int) -> int:
        """Where the history of a point is."""
        if con.lumped[c] != 0:
            return con.first[c]
        return point

    @wp.func
    def allowance(con: Contacts, his: History, world: int, c: int, point: int, time: f64) -> f64:
        """What is left of a stored overlap."""
        left = f64(1.0) - (time - his.born[world]) / con.decay[c]
        return his.overlap[world, point] * wp.clamp(left, f64(0.0), f64(1.0))

    @wp.func
    def reach(con: Contacts, his: History, world: int, c: int, point: int, time: f64) -> f64:
        """Distance from the shape at which contact begins."""
        grown = con.offset[c] + con.grow[world, con.collider[c]]
        return grown - allowance(con, his, world, c, point, time)

    @wp.kernel(module=module)
    def poses(
        con: Contacts, value: wp.array2d(dtype=vec3d), active: wp.array(dtype=wp.int32), at: Attempt
    ):  # fmt: skip
        """Places of the colliders at the end of the attempt."""
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
        at.place[world, k] = place
        at.turn[world, k] = turn

    @wp.func
    def rate_of(con: Contacts, at: Attempt, world: int, c: int, point: int, inv_h: f64) -> f64:
        """Damping per depth of the normal law: chi/h, or gamma_n/h."""
        if con.law[c] == DEFAULT:
            return con.damping[world, c] * inv_h / at.speed[world, point]
        return con.beta[world, c] * wp.sqrt(con.scale[world, c]) * con.normal_damping[c] * inv_h

    @wp.func
    def tangent_damping(con: Contacts, world: int, c: int, stiffness: f64) -> f64:
        """gamma_t of Eq. (80), N s/m."""
        return f64(1.8257418583505538) * con.beta[world, c] * wp.sqrt(con.mass[c] * stiffness)

    @wp.func
    def touch(
        con: Contacts, facets: Facets, his: History, at: Attempt, world: int, c: int, q: int, item: int, point: int,
        u: wp.array2d(dtype=vec3), time: f64, inv_h: f64, shrink: f64,
    ) -> Touch:  # fmt: skip
        """A point at displacements u."""
        out = Touch()
        k = con.collider[c]
        rec = record_of(con, c, point)
        x = facets.X[q, item] + along(facets, u, world, q, item)
        turn = at.turn[world, k]
        out.y = wp.transpose(turn) * (x - at.place[world, k])
        side = wp.int32(-1)
        live = his.speed[world, rec] > f64(0.0)
        if live:
            side = his.mark[world, rec] % SLIPS - 1
        out.side = sweep(con.kind[k], con.size[k], at.start[world, point], out.y, side)
        d = distance(con.kind[k], con.size[k], out.y, out.side)
        out.n = turn * vec3d(d[0], d[1], d[2])
        out.depth = reach(con, his, world, c, point, time) - d[3]
        rate = rate_of(con, at, world, c, point, inv_h)
        k_n = con.scale[world, c] * con.normal[c]
        out.law = normal_law(con.law[c], con.lumped[c], k_n, rate, con.ramp[c], con.force_eps[c], out.depth,
                             at.depth[world, point])  # fmt: skip
        motion = turn * (out.y - at.start[world, point])
        out.slip = plane(out.n, motion)
        spring = vec3d()
        if live:
            spring = his.spring[world, rec]
            if con.law[c] != PAPER:
                spring = shrink * (turn * spring)
        out.q = plane(out.n, spring + motion)
        return out

    @wp.func
    def hold(con: Contacts, his: History, at: Attempt, world: int, c: int, point: int, t: Touch) -> vec3d:
        """Cap, k_t and shrinkage of the spring at an iterate."""
        rec = record_of(con, c, point)
        mu = con.mu_static[world, c]
        live = his.speed[world, rec] > f64(0.0)
        if live and his.mark[world, rec] >= SLIPS:
            mu = con.mu[world, c]
        stiffness = con.scale[world, c] * con.tangent[c]
        shrink = f64(1.0)
        if con.lumped[c] != 0:
            depth = wp.max(t.depth, f64(0.0))
            stiffness *= wp.sqrt(depth)
            before = at.depth[world, point]
            if live and depth < before and con.law[c] == DEFAULT:
                shrink = wp.sqrt(depth / before)
        return vec3d(mu * t.law[0], stiffness, shrink)

    @wp.func
    def pull(con: Contacts, world: int, c: int, t: Touch, held: vec3d, inv_h: f64) -> wp.vec4d:
        """Friction that resists the motion, as a trial force and in w its whole stiffness (spring and damper)."""
        gamma = tangent_damping(con, world, c, held[1]) * inv_h
        trial = held[1] * t.q + gamma * t.slip
        return wp.vec4d(trial[0], trial[1], trial[2], held[1] + gamma)

    @wp.func
    def friction_potential(con: Contacts, world: int, c: int, t: Touch, held: vec3d, inv_h: f64) -> f64:
        """J, with a cap that is held."""
        if held[0] <= f64(0.0):
            return f64(0.0)
        if con.law[c] == SMOOTH:
            return smooth_friction(t.slip, inv_h, con.speed_eps[c], held[0])[0]
        w = pull(con, world, c, t, held, inv_h)
        if w[3] <= f64(0.0):
            return f64(0.0)
        return friction(vec3d(w[0], w[1], w[2]), w[3], held[0])[0]

    @wp.func
    def friction_force(con: Contacts, world: int, c: int, t: Touch, held: vec3d, inv_h: f64) -> vec3d:
        """What friction adds to the residual, N."""
        if held[0] <= f64(0.0):
            return vec3d()
        if con.law[c] == SMOOTH:
            return smooth_friction(t.slip, inv_h, con.speed_eps[c], held[0])[1] * t.slip
        w = pull(con, world, c, t, held, inv_h)
        if w[3] <= f64(0.0):
            return vec3d()
        trial = vec3d(w[0], w[1], w[2])
        return friction(trial, w[3], held[0])[1] * trial

    @wp.func
    def point_stiffness(con: Contacts, world: int, c: int, t: Touch, held: vec3d, inv_h: f64) -> mat33d:
        """Derivative of the force that a point adds to the residual, positive: without that of the normal."""
        K = wp.max(t.law[1], f64(0.0)) * wp.outer(t.n, t.n)
        if held[0] > f64(0.0):
            P = wp.identity(n=3, dtype=f64) - wp.outer(t.n, t.n)
            if con.law[c] == SMOOTH:
                part = smooth_friction(t.slip, inv_h, con.speed_eps[c], held[0])[1]
                v = inv_h * t.slip
                root = wp.dot(v, v) + con.speed_eps[c] * con.speed_eps[c]
                K += part * (P - wp.outer(v, v) / root)
            else:
                w = pull(con, world, c, t, held, inv_h)
                trial = vec3d(w[0], w[1], w[2])
                size2 = wp.dot(trial, trial)
                if size2 <= held[0] * held[0]:
                    K += w[3] * P
                else:
                    K += (w[3] * held[0] / wp.sqrt(size2)) * (P - wp.outer(trial, trial) / size2)
        return K

    @wp.kernel(module=module)
    def begin_points(
        con: Contacts, facets: Facets, his: History, step: Step, still: int, u_n: wp.array2d(dtype=vec3),
        v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), at: Attempt,
    ):  # fmt: skip
        """Where the points are as an attempt begins, and the approach speed that damping is made for."""
        world, item, q = wp.tid()
        if active[world] == 0 or facets.share[q, item] == f64(0.0):
            return
        c = facets.contact[item]
        point = facets.point + item * facets.points + q
        rec = record_of(con, c, point)
        k = con.collider[c]
        x = facets.X[q, item] + along(facets, u_n, world, q, item)
        turn = his.turn[world, k]
        y = wp.transpose(turn) * (x - his.place[world, k])
        live = his.speed[world, rec] > f64(0.0)
        side = wp.int32(-1)
        if live:
            side = his.mark[world, rec] % SLIPS - 1
        d = distance(con.kind[k], con.size[k], y, side)
        at.start[world, point] = y
        at.depth[world, point] = reach(con, his, world, c, point, step.time[world]) - d[3]
        speed = wp.max(his.speed[world, rec], f64(SPEED_FLOOR))
        if still == 0:
            moved = (at.turn[world, k] * y + at.place[world, k] - x) / step.h[world]
            approach = wp.dot(turn * vec3d(d[0], d[1], d[2]), moved - along(facets, v_n, world, q, item))
            speed = wp.max(speed, approach)
        at.speed[world, point] = speed
        if q == 0 and item == 0 and facets.row == 0:
            at.through[world] = 0
            if step.part[world] == 0:
                at.elapsed[world] = f64(0.0)

    @wp.kernel(module=module)
    def settle(con: Contacts, facets: Facets, u: wp.array2d(dtype=vec3), at: Attempt):
        """Points begin where they are: what follows is at a state, without motion."""
        world, item, q = wp.tid()
        k = con.collider[facets.contact[item]]
        x = facets.X[q, item] + along(facets, u, world, q, item)
        point = facets.point + item * facets.points + q
        at.start[world, point] = wp.transpose(at.turn[world, k]) * (x - at.place[world, k])

    @wp.kernel(module=module)
    def explicit_forces(
        con: Contacts, facets: Facets, his: History, step: Step, still: int, v_n: wp.array2d(dtype=vec3),
        active: wp.array(dtype=wp.int32), at: Attempt,
    ):  # fmt: skip
        """Eqs. (77)-(83) literally, at the state that the attempt begins from; of contacts that are treated so."""
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
        side = his.mark[world, rec] % SLIPS - 1
        d = distance(con.kind[k], con.size[k], y, side)
        n = turn * vec3d(d[0], d[1], d[2])
        x = turn * y + his.place[world, k]
        h = step.h[world]
        moved = (at.turn[world, k] * y + at.place[world, k] - x) / h
        v = along(facets, v_n, world, q, item) - moved
        v_n_rel = wp.dot(v, n)
        v_t = v - v_n_rel * n
        beta = con.beta[world, c]
        scale = con.scale[world, c]
        spring = elastic(con.lumped[c], scale * con.normal[c], delta)[0]
        gamma = beta * wp.sqrt(scale) * con.normal_damping[c]
        k_t = scale * con.tangent[c]
        if con.lumped[c] != 0:
            gamma *= wp.sqrt(wp.sqrt(delta))
            k_t *= wp.sqrt(delta)
        force = wp.max(spring - gamma * v_n_rel, f64(0.0))
        s = plane(n, his.spring[world, rec] + h * v_t)
        gamma_t = tangent_damping(con, world, c, k_t)
        pulled = -k_t * s - gamma_t * v_t
        cap = con.mu[world, c] * force
        size = wp.length(pulled)
        if size > cap:
            pulled = (cap / size) * pulled
            s = (f64(-1.0) / k_t) * (pulled + gamma_t * v_t)
        at.dead_spring[world, point] = s
        at.dead[world, point] = force * n + pulled

    @wp.kernel(module=module)
    def levels(
        con: Contacts, facets: Facets, his: History, time: wp.array(dtype=f64), u: wp.array2d(dtype=vec3),
        active: wp.array(dtype=wp.int32), at: Attempt,
    ):  # fmt: skip
        """Depths of the points of lumped contacts."""
        world, item, q = wp.tid()
        if active[world] == 0:
            return
        c = facets.contact[item]
        if con.lumped[c] == 0:
            return
        point = facets.point + item * facets.points + q
        depth = f64(-1.0e300)
        if facets.share[q, item] > f64(0.0):
            k = con.collider[c]
            x = facets.X[q, item] + along(facets, u, world, q, item)
            y = wp.transpose(at.turn[world, k]) * (x - at.place[world, k])
            d = distance(con.kind[k], con.size[k], y, -1)
            depth = reach(con, his, world, c, point, time[world]) - d[3]
        at.level[world, point] = depth

    @wp.kernel(module=module)
    def pick_deepest(con: Contacts, active: wp.array(dtype=wp.int32), at: Attempt):
        """The deepest point of each lumped contact; of equals the first."""
        world, c = wp.tid()
        if active[world] == 0 or con.lumped[c] == 0:
            return
        best = con.first[c]
        deepest = at.level[world, best]
        for point in range(con.first[c] + 1, con.first[c + 1]):
            if at.level[world, point] > deepest:
                deepest = at.level[world, point]
                best = point
        at.pick[world, c] = best

    @wp.func
    def acts(con: Contacts, at: Attempt, world: int, c: int, point: int) -> f64:
        """1 unless another point stands for the contact."""
        if con.lumped[c] != 0 and at.pick[world, c] != point:
            return f64(0.0)
        return f64(1.0)

    @wp.kernel(module=module)
    def forces(
        con: Contacts, facets: Facets, his: History, step: Step, still: int, u: wp.array2d(dtype=vec3),
        active: wp.array(dtype=wp.int32), fresh: int, at: Attempt, pool: wp.array2d(dtype=vec3),
        rows: wp.array3d(dtype=f64),
    ):  # fmt: skip
        """Forces of facets, stiffness of their points, and rows of the potential.

        `fresh`: what line searches hold is taken from this iterate.
        """
        world, item = wp.tid()
        if active[world] == 0:
            return
        for i in range(facets.conn.shape[0]):
            pool[world, facets.pool + i * facets.count + item] = vec3()
        c = facets.contact[item]
        row = facets.row + item
        inv_h = f64(0.0)
        if still == 0:
            inv_h = f64(1.0) / step.h[world]
        held_sum, next_sum, size_sum = f64(0.0), f64(0.0), f64(0.0)
        touched = wp.int32(0)
        for q in range(facets.points):
            point = facets.point + item * facets.points + q
            share = facets.share[q, item] * acts(con, at, world, c, point)
            at.stiffness[world, point] = sym()
            if share > f64(0.0):
                force = vec3d()
                if con.dead[c] != 0:
                    k = con.collider[c]
                    x_n = his.turn[world, k] * at.start[world, point] + his.place[world, k]
                    x = facets.X[q, item] + along(facets, u, world, q, item)
                    force = -at.dead[world, point]
                    work = share * wp.dot(force, x - x_n)
                    held_sum += work
                    next_sum += work
                    size_sum += wp.abs(work)
                    if wp.length_sq(force) > f64(0.0):
                        touched = wp.int32(1)
                else:
                    held = at.held[world, point]
                    t = touch(con, facets, his, at, world, c, q, item, point, u, step.new_time[world], inv_h, held[2])
                    new = hold(con, his, at, world, c, point, t)
                    if new[2] != held[2]:
                        t = touch(
                            con, facets, his, at, world, c, q, item, point, u, step.new_time[world], inv_h, new[2]
                        )
                    at.next[world, point] = new
                    if fresh != 0:
                        held = new
                        at.held[world, point] = new
                    if t.side == -2:
                        at.through[world] = point + 1
                        held_sum += f64(wp.inf)
                        next_sum += f64(wp.inf)
                    elif t.depth > f64(0.0) or con.law[c] == SMOOTH:
                        touched = wp.int32(1)
                        psi = t.law[2]
                        a = psi + friction_potential(con, world, c, t, held, inv_h)
                        b = psi + friction_potential(con, world, c, t, new, inv_h)
                        held_sum += share * a
                        next_sum += share * b
                        size_sum += share * (wp.abs(psi) + wp.abs(a - psi))
                        force = friction_force(con, world, c, t, new, inv_h) - t.law[0] * t.n
                        K = point_stiffness(con, world, c, t, new, inv_h)
                        at.stiffness[world, point] = sym(T(share * K[0, 0]), T(share * K[1, 1]), T(share * K[2, 2]),
                            T(share * K[1, 2]), T(share * K[0, 2]), T(share * K[0, 1]))  # fmt: skip
                for i in range(facets.conn.shape[0]):
                    e = facets.pool + i * facets.count + item
                    pool[world, e] = pool[world, e] + facets.shape[q, i, item] * vec3(share * force)
        at.touched[world, row] = touched
        rows[0, world, row] = held_sum
        rows[1, world, row] = next_sum
        rows[2, world, row] = size_sum

    @wp.kernel(module=module)
    def adopt(flags: wp.array(dtype=wp.int32), at: Attempt):
        """The trial was accepted: hold its caps."""
        world, point = wp.tid()
        if flags[world] != 0:
            at.held[world, point] = at.next[world, point]

    @wp.func
    def times(k: sym, p: vec3) -> vec3:
        """The symmetric matrix k (Voigt) times p."""
        return vec3(k[0] * p[0] + k[5] * p[1] + k[4] * p[2], k[5] * p[0] + k[1] * p[1] + k[3] * p[2],
                    k[4] * p[0] + k[3] * p[1] + k[2] * p[2])  # fmt: skip

    @wp.kernel(module=module)
    def product(
        facets: Facets, active: wp.array(dtype=wp.int32), p: wp.array2d(dtype=vec3), at: Attempt,
        pool: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """K p of the facets."""
        world, item = wp.tid()
        if active[world] == 0:
            return
        for i in range(facets.conn.shape[0]):
            pool[world, facets.pool + i * facets.count + item] = vec3()
        if at.touched[world, facets.row + item] == 0:
            return
        for q in range(facets.points):
            stiff = at.stiffness[world, facets.point + item * facets.points + q]
            if stiff[0] + stiff[1] + stiff[2] > T(0.0):
                d = vec3()
                for i in range(facets.conn.shape[0]):
                    d += facets.shape[q, i, item] * p[world, facets.conn[i, item]]
                f = times(stiff, d)
                for i in range(facets.conn.shape[0]):
                    e = facets.pool + i * facets.count + item
                    pool[world, e] = pool[world, e] + facets.shape[q, i, item] * f

    @wp.kernel(module=module)
    def diagonal(facets: Facets, active: wp.array(dtype=wp.int32), at: Attempt, pool: wp.array2d(dtype=sym)):
        """3x3 blocks on the diagonal of the facets."""
        world, item, i = wp.tid()
        if active[world] == 0:
            return
        out = sym()
        if at.touched[world, facets.row + item] != 0:
            for q in range(facets.points):
                s = facets.shape[q, i, item]
                out += s * s * at.stiffness[world, facets.point + item * facets.points + q]
        pool[world, facets.pool + i * facets.count + item] = out

    return _types.SimpleNamespace(
        module=module, Touch=Touch, along=along, plane=plane, record_of=record_of, reach=reach, touch=touch, hold=hold,
        pull=pull, friction_force=friction_force, acts=acts, poses=poses, begin_points=begin_points,
        settle=settle, explicit_forces=explicit_forces, levels=levels, pick_deepest=pick_deepest, forces=forces,
        adopt=adopt, product=product, diagonal=diagonal,
    )  # fmt: skip
