"""A surface point against its obstacle: position, normal force, friction, and their derivative."""

import functools
import types as _types
from typing import Any

import warp as wp

from ..common.types import precision
from .contact_colliders import collider_functions
from .contact_data import attempt_struct, clock_struct, contact_struct, facet_struct, history_struct, of_world
from .contact_laws import DEFAULT, PAPER, SMOOTH, law_functions
from .contact_mesh import MESH

__all__ = ["touch_functions"]


@functools.cache
def touch_functions(dtype: str, meshes: bool) -> _types.SimpleNamespace:
    """Device functions in one precision of the displacements; everything else is float64. `meshes`: some collider is a
    mesh."""
    T = precision(dtype).T
    f64, vec3d, mat33d = wp.float64, wp.vec3d, wp.mat33d
    Contacts, Facets = contact_struct(meshes), facet_struct(dtype)
    History, Attempt, Clock = history_struct(), attempt_struct(dtype), clock_struct()
    colliders, laws = collider_functions(meshes), law_functions()
    distance, sweep, deepening, known_side = (
        colliders.distance,
        colliders.sweep,
        colliders.deepening,
        colliders.known_side,
    )
    SLIPS = colliders.SLIPS
    normal_law, elastic = laws.normal_law, laws.elastic
    friction, smooth_friction = laws.friction, laws.smooth_friction

    @wp.struct
    class Touch:
        """A point at an iterate; forces are of the whole region."""

        n: vec3d  # outward normal of the shape
        depth: f64
        rise: f64  # change of depth in the step; of a moving contact point, from the depth of the previous one
        side: wp.int32
        law: wp.vec4d  # normal force, its derivative, its potential, the magnitude of the potential's terms
        m: vec3d  # normal of the plane of friction
        motion: vec3d  # in the step, relative to the collider, m
        whole: vec3d  # motion plus spring, m
        slip: vec3d  # motion in that plane, m
        q: vec3d  # spring: tangential slip since it was anchored, m
        y: vec3d  # position in the collider's frame, m

    @wp.func
    def along(facets: Facets, field: wp.array2d(dtype=Any), world: int, point: int, item: int) -> vec3d:
        """sum_i s_i field_i at a point."""
        out = vec3d()
        for i in range(facets.conn.shape[0]):
            out += f64(facets.shape[point, i, item]) * vec3d(field[world, facets.conn[i, item]])
        return out

    @wp.func
    def shape_of(facets: Facets, at: Attempt, world: int, point: int, i: int, item: int) -> T:
        """Shape value of slot i at the active point: a point of a facet, or that of a lumped contact."""
        if facets.moving != 0:
            return at.weight[world, facets.contact[item], i]
        return facets.shape[point, i, item]

    @wp.func
    def acting(facets: Facets, at: Attempt, field: wp.array2d(dtype=Any), world: int, point: int, item: int) -> vec3d:
        """sum_i s_i field_i at the active point."""
        if facets.moving == 0:
            return along(facets, field, world, point, item)
        out = vec3d()
        for i in range(facets.conn.shape[0]):
            out += f64(shape_of(facets, at, world, point, i, item)) * vec3d(field[world, facets.conn[i, item]])
        return out

    @wp.func
    def reference(facets: Facets, at: Attempt, world: int, point: int, item: int) -> vec3d:
        """Reference position of the active point, m."""
        if facets.moving != 0:
            return at.middle[world, facets.contact[item]]
        return facets.X[point, item]

    @wp.func
    def monomial(x: f64, power: int, derivative: int) -> f64:
        """Derivative of x^power."""
        out = f64(1.0)
        for j in range(derivative):
            out *= f64(power - j)
        for _ in range(power - derivative):
            out *= x
        return out

    @wp.func
    def lagrange(facets: Facets, q: int, s: wp.vec2d) -> f64:
        """Lagrange polynomial of a facet: 1 at point q and 0 at the others."""
        out = f64(0.0)
        for m in range(facets.power.shape[0]):
            out += facets.basis[q, m] * (monomial(s[0], facets.power[m][0], 0) * monomial(s[1], facets.power[m][1], 0))
        return out

    @wp.func
    def plane(n: vec3d, a: vec3d) -> vec3d:
        """Component of a normal to n."""
        return a - wp.dot(n, a) * n

    @wp.func
    def record_of(con: Contacts, c: int, point: int) -> int:
        """Index of a point's history."""
        if con.lumped[c] != 0:
            return con.first[c]
        return point

    @wp.func
    def allowance(con: Contacts, his: History, world: int, c: int, point: int, time: f64) -> f64:
        """Remaining part of an initial overlap, m."""
        left = f64(1.0) - (time - his.born[world]) / con.decay[c]
        return his.overlap[world, point] * wp.clamp(left, f64(0.0), f64(1.0))

    @wp.func
    def recovered(con: Contacts, his: History, clock: Clock, world: int, c: int, point: int) -> f64:
        """Outward motion of the surface of an initial overlap in a substep, m: its force does work."""
        now = clock.new_time[world]
        before = allowance(con, his, world, c, point, now - clock.h[world])
        return before - allowance(con, his, world, c, point, now)

    @wp.func
    def reach(con: Contacts, his: History, world: int, c: int, point: int, time: f64, grown: f64) -> f64:
        """Gap at which contact begins, m: offset + `grown` - remaining overlap."""
        return con.offset[c] + grown - allowance(con, his, world, c, point, time)

    @wp.func
    def depth_before(con: Contacts, facets: Facets, his: History, at: Attempt, world: int, c: int, point: int) -> f64:
        """Depth at the start of the step, m; for a moving point in contact, that of the deepest position then."""
        if facets.moving != 0:
            rec = record_of(con, c, point)
            if his.speed[world, rec] > f64(0.0):
                return his.lead[world, rec]
        return at.depth[world, point]

    @wp.func
    def rate_of(con: Contacts, at: Attempt, world: int, c: int, point: int, inv_h: f64) -> f64:
        """Damping per depth of the normal law: chi/h, or gamma_n/h."""
        if con.law[c] == DEFAULT:
            return con.damping[world, c] * inv_h / at.speed[world, point]
        return con.beta[world, c] * wp.sqrt(con.scale[world, c]) * of_world(con.normal_damping, world, c) * inv_h

    @wp.func
    def tangent_damping(con: Contacts, world: int, c: int, stiffness: f64) -> f64:
        """gamma_t of Eq. (80), N s/m."""
        return f64(1.8257418583505538) * con.beta[world, c] * wp.sqrt(of_world(con.mass, world, c) * stiffness)

    @wp.func
    def in_plane(t: Touch, m: vec3d) -> Touch:
        """The point with friction in the plane of a normal m, frozen with the friction limits: on a curved shape the
        force would not be the derivative of its potential if the plane turned with the iterate."""
        out = t
        out.m = m
        out.slip = plane(m, t.motion)
        out.q = plane(m, t.whole)
        return out

    @wp.func
    def touch(
        con: Contacts, facets: Facets, his: History, at: Attempt, world: int, c: int, q: int, item: int, point: int,
        u: wp.array2d(dtype=vec3d), time: f64, inv_h: f64, shrink: f64,
    ) -> Touch:  # fmt: skip
        """A point at displacements u (float64, see kernels/terms/contact_exact.py)."""
        out = Touch()
        k = con.collider[c]
        rec = record_of(con, c, point)
        moved = acting(facets, at, u, world, q, item)
        x = reference(facets, at, world, q, item) + moved
        turn = at.turn[world, k]
        out.y = wp.transpose(turn) * (x - at.place[world, k])
        live = his.speed[world, rec] > f64(0.0)
        side = known_side(con, k, live, his.mark[world, rec])
        begins = reach(con, his, world, c, point, time, con.grow[world, k])
        d = wp.vec4d(f64(0.0), f64(0.0), f64(1.0), f64(0.0))
        out.side = -1
        far = bool(False)
        if wp.static(meshes):  # lower bound of the distance, the last one minus the motion: avoids a search of the mesh
            d[3] = at.reach[world, point] - at.depth[world, point] - wp.length(out.y - at.start[world, point])
            far = con.kind[k] == MESH and con.law[c] != SMOOTH and not live and d[3] > wp.max(begins, f64(0.0))
        if not far:
            out.side = sweep(con, k, at.start[world, point], out.y, side)
            d = distance(con, k, out.y, out.side)
        out.n = turn * vec3d(d[0], d[1], d[2])
        out.depth = begins - d[3]
        motion = moved - at.origin[world, point] - at.shift[world, k]
        if con.spin[k] >= 0:
            motion -= at.spin[world, k] * (his.turn[world, k] * at.start[world, point])
        before = at.depth[world, point]
        change = deepening(con, k, out.side, at.start[world, point], out.y, wp.transpose(turn) * motion,
                           at.reach[world, point] - before, d[3])  # fmt: skip
        if change[1] != f64(0.0):
            out.depth = before + change[0] + (begins - at.reach[world, point])
        rate = rate_of(con, at, world, c, point, inv_h)
        k_n = con.scale[world, c] * of_world(con.normal, world, c)
        led = depth_before(con, facets, his, at, world, c, point)
        out.law = normal_law(con.law[c], con.lumped[c], k_n, rate, con.ramp[c], con.force_eps[c], out.depth,
                             led)  # fmt: skip
        out.rise = out.depth - led
        out.motion = motion
        spring = vec3d()
        if live:
            spring = his.spring[world, rec]
            if con.law[c] != PAPER:
                spring = shrink * (turn * spring)
        out.whole = spring + motion
        return in_plane(out, out.n)

    @wp.func
    def coefficient(con: Contacts, his: History, world: int, c: int, rec: int) -> f64:
        """Friction coefficient: mu for a contact that slipped in the last step, else mu_static."""
        live = his.speed[world, rec] > f64(0.0)
        if live and his.mark[world, rec] >= SLIPS:
            return con.mu[world, c]
        return con.mu_static[world, c]

    @wp.func
    def put_explicit(
        con: Contacts, his: History, at: Attempt, world: int, c: int, point: int, delta: f64, n: vec3d, v: vec3d, h: f64
    ):  # fmt: skip
        """Force and spring, Eqs. (77)-(83) unmodified, of a point at depth delta with relative velocity v, for a step
        h."""
        rec = record_of(con, c, point)
        v_n_rel = wp.dot(v, n)
        v_t = v - v_n_rel * n
        beta = con.beta[world, c]
        scale = con.scale[world, c]
        spring = elastic(con.lumped[c], scale * of_world(con.normal, world, c), delta)[0]
        gamma = beta * wp.sqrt(scale) * of_world(con.normal_damping, world, c)
        k_t = scale * of_world(con.tangent, world, c)
        if con.lumped[c] != 0:
            gamma *= wp.sqrt(wp.sqrt(delta))
            k_t *= wp.sqrt(delta)
        force = wp.max(spring - gamma * v_n_rel, f64(0.0))
        s = plane(n, his.spring[world, rec] + h * v_t)
        gamma_t = tangent_damping(con, world, c, k_t)
        pulled = -k_t * s - gamma_t * v_t
        cap = coefficient(con, his, world, c, rec) * force
        size = wp.length(pulled)
        if size > cap:
            pulled = (cap / size) * pulled
            s = (f64(-1.0) / k_t) * (pulled + gamma_t * v_t)
        at.dead_spring[world, point] = s
        at.dead[world, point] = force * n + pulled

    @wp.func
    def hold(con: Contacts, his: History, at: Attempt, world: int, c: int, point: int, t: Touch) -> vec3d:
        """Friction limit, k_t and reduction factor of the spring at an iterate."""
        rec = record_of(con, c, point)
        mu = coefficient(con, his, world, c, rec)
        live = his.speed[world, rec] > f64(0.0)
        stiffness = con.scale[world, c] * of_world(con.tangent, world, c)
        shrink = f64(1.0)
        if con.lumped[c] != 0:
            depth = wp.max(t.depth, f64(0.0))
            stiffness *= wp.sqrt(depth)
            before = t.depth - t.rise
            if live and depth < before and con.law[c] == DEFAULT:
                shrink = wp.sqrt(depth / before)
        return vec3d(mu * t.law[0], stiffness, shrink)

    @wp.func
    def pull(con: Contacts, world: int, c: int, t: Touch, held: vec3d, inv_h: f64) -> wp.vec4d:
        """Friction opposing the motion: trial force, and in w its total stiffness (spring and damper)."""
        gamma = tangent_damping(con, world, c, held[1]) * inv_h
        trial = held[1] * t.q + gamma * t.slip
        return wp.vec4d(trial[0], trial[1], trial[2], held[1] + gamma)

    @wp.func
    def friction_potential(con: Contacts, world: int, c: int, t: Touch, held: vec3d, inv_h: f64) -> f64:
        """Friction potential with a frozen limit, J."""
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
        """Friction force on the residual, N."""
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
        """Derivative of the force that a point adds to the residual, positive; the change of the normal is omitted."""
        K = wp.max(t.law[1], f64(0.0)) * wp.outer(t.n, t.n)
        if held[0] > f64(0.0):
            P = wp.identity(n=3, dtype=f64) - wp.outer(t.m, t.m)
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

    @wp.func
    def acts(con: Contacts, at: Attempt, world: int, c: int, point: int) -> f64:
        """1, or 0 if another point represents the contact."""
        if con.lumped[c] != 0 and at.pick[world, c] != point:
            return f64(0.0)
        return f64(1.0)

    return _types.SimpleNamespace(
        Touch=Touch, along=along, plane=plane, record_of=record_of, reach=reach, allowance=allowance,
        recovered=recovered, rate_of=rate_of,
        depth_before=depth_before, touch=touch, in_plane=in_plane, coefficient=coefficient, put_explicit=put_explicit,
        hold=hold, pull=pull, friction_potential=friction_potential, friction_force=friction_force,
        point_stiffness=point_stiffness, acts=acts, shape_of=shape_of, lagrange=lagrange, monomial=monomial,
    )  # fmt: skip
