"""A surface point against its obstacle: position, normal force, friction, and their derivative."""

import functools
import types as _types
from typing import Any

import warp as wp

from ..common.types import kernel_set, precision
from .collider_mesh import MESH
from .colliders import collider_functions
from .laws import DEFAULT, PAPER, SMOOTH, law_functions
from .structs import (
    clock_struct,
    contact_scratch_struct,
    contact_struct,
    facet_struct,
    history_struct,
    world_value,
)

__all__ = ["contact_point_functions"]


@functools.cache
def contact_point_functions(dtype: str, meshes: bool) -> _types.SimpleNamespace:
    """Device functions in one precision of the displacements; everything else is float64. `meshes`: some collider is a
    mesh."""
    T = precision(dtype).T
    f64, vec3d, mat33d = wp.float64, wp.vec3d, wp.mat33d
    Contacts, Facets = contact_struct(meshes), facet_struct(dtype)
    History, ContactScratch, Clock = history_struct(), contact_scratch_struct(dtype), clock_struct()
    colliders, laws = collider_functions(meshes), law_functions()
    distance, sweep, depth_change, stored_side = (
        colliders.distance,
        colliders.sweep,
        colliders.depth_change,
        colliders.stored_side,
    )
    SLIP_FLAG = colliders.SLIP_FLAG
    normal_law, elastic_force = laws.normal_law, laws.elastic_force
    huber_friction, smooth_friction = laws.huber_friction, laws.smooth_friction

    @wp.struct
    class PointContact:
        """A point at an iterate; forces are of the whole region."""

        normal: vec3d  # outward normal of the shape
        depth: f64  # m
        # change of depth in the step, m; of a moving contact point, from the depth of the previous one
        depth_increment: f64
        side: (
            wp.int32
        )  # side of the collider through which the point has entered, -1: any or none, -2: it passed through
        normal_values: wp.vec4d  # normal force, its derivative, its potential, the magnitude of the potential's terms
        friction_normal: vec3d  # normal of the plane of friction
        relative_motion: vec3d  # in the step, relative to the collider, m
        trial_displacement: vec3d  # relative motion plus the stored elastic slip, m
        tangential_motion: vec3d  # tangential part of `relative_motion`, m
        trial_elastic_slip: vec3d  # tangential part of `trial_displacement`, m
        local_position: vec3d  # position in the collider's frame, m

    @wp.func
    def interpolate(facets: Facets, field: wp.array2d(dtype=Any), world: int, point: int, item: int) -> vec3d:
        """sum_i s_i field_i at a point."""
        out = vec3d()
        for i in range(facets.conn.shape[0]):
            out += f64(facets.shape[point, i, item]) * vec3d(field[world, facets.conn[i, item]])
        return out

    @wp.func
    def acting_shape_value(facets: Facets, scr: ContactScratch, world: int, point: int, i: int, item: int) -> T:
        """Shape value of slot i at the active point: a point of a facet, or that of a lumped contact."""
        if facets.tracks_deepest != 0:
            return scr.shape_values[world, facets.contact[item], i]
        return facets.shape[point, i, item]

    @wp.func
    def interpolate_acting(
        facets: Facets, scr: ContactScratch, field: wp.array2d(dtype=Any), world: int, point: int, item: int
    ) -> vec3d:
        """sum_i s_i field_i at the active point."""
        if facets.tracks_deepest == 0:
            return interpolate(facets, field, world, point, item)
        out = vec3d()
        for i in range(facets.conn.shape[0]):
            out += f64(acting_shape_value(facets, scr, world, point, i, item)) * vec3d(
                field[world, facets.conn[i, item]]
            )
        return out

    @wp.func
    def reference_position(facets: Facets, scr: ContactScratch, world: int, point: int, item: int) -> vec3d:
        """Reference position of the active point, m."""
        if facets.tracks_deepest != 0:
            return scr.point_reference[world, facets.contact[item]]
        return facets.X[point, item]

    @wp.func
    def monomial_derivative(x: f64, power: int, derivative: int) -> f64:
        """Derivative of x^power of order `derivative`."""
        out = f64(1.0)
        for j in range(derivative):
            out *= f64(power - j)
        for _ in range(power - derivative):
            out *= x
        return out

    @wp.func
    def lagrange_polynomial(facets: Facets, q: int, s: wp.vec2d) -> f64:
        """Lagrange polynomial of a facet: 1 at point q and 0 at the others."""
        out = f64(0.0)
        for m in range(facets.exponents.shape[0]):
            out += facets.lagrange_coefficients[q, m] * (
                monomial_derivative(s[0], facets.exponents[m][0], 0)
                * monomial_derivative(s[1], facets.exponents[m][1], 0)
            )
        return out

    @wp.func
    def tangential(n: vec3d, a: vec3d) -> vec3d:
        """Component of a normal to n."""
        return a - wp.dot(n, a) * n

    @wp.func
    def history_row(con: Contacts, c: int, point: int) -> int:
        """Index of a point's history."""
        if con.single_point[c] != 0:
            return con.first_point[c]
        return point

    @wp.func
    def remaining_overlap(con: Contacts, his: History, world: int, c: int, point: int, time: f64) -> f64:
        """Remaining part of an initial overlap, m."""
        left = f64(1.0) - (time - his.overlap_time[world]) / con.overlap_decay_time[c]
        return his.overlap[world, point] * wp.clamp(left, f64(0.0), f64(1.0))

    @wp.func
    def overlap_recovery(con: Contacts, his: History, clock: Clock, world: int, c: int, point: int) -> f64:
        """Outward motion of the surface of an initial overlap in a substep, m: its force does work."""
        now = clock.new_time[world]
        before = remaining_overlap(con, his, world, c, point, now - clock.h[world])
        return before - remaining_overlap(con, his, world, c, point, now)

    @wp.func
    def activation_gap(con: Contacts, his: History, world: int, c: int, point: int, time: f64, margin: f64) -> f64:
        """Gap at which contact begins, m: offset + `margin` - remaining overlap."""
        return con.offset[c] + margin - remaining_overlap(con, his, world, c, point, time)

    @wp.func
    def depth_at_start(
        con: Contacts, facets: Facets, his: History, scr: ContactScratch, world: int, c: int, point: int
    ) -> f64:
        """Depth at the start of the step, m; for a moving point in contact, that of the deepest position then."""
        if facets.tracks_deepest != 0:
            rec = history_row(con, c, point)
            if his.speed[world, rec] > f64(0.0):
                return his.previous_depth[world, rec]
        return scr.start_depth[world, point]

    @wp.func
    def normal_damping_rate(con: Contacts, scr: ContactScratch, world: int, c: int, point: int, inv_h: f64) -> f64:
        """Damping per depth of the normal law: chi/h, or gamma_n/h."""
        if con.law[c] == DEFAULT:
            return con.damping[world, c] * inv_h / scr.approach_speed[world, point]
        return con.beta[world, c] * wp.sqrt(con.scale[world, c]) * world_value(con.normal_damping, world, c) * inv_h

    @wp.func
    def tangent_damping(con: Contacts, world: int, c: int, stiffness: f64) -> f64:
        """gamma_t of Eq. (80), N s/m."""
        return (
            f64(1.8257418583505538)
            * con.beta[world, c]
            * wp.sqrt(world_value(con.effective_mass, world, c) * stiffness)
        )

    @wp.func
    def with_friction_normal(t: PointContact, m: vec3d) -> PointContact:
        """The point with friction in the plane of a normal m, frozen with the friction limits: on a curved shape the
        force would not be the derivative of its potential if the plane turned with the iterate."""
        out = t
        out.friction_normal = m
        out.tangential_motion = tangential(m, t.relative_motion)
        out.trial_elastic_slip = tangential(m, t.trial_displacement)
        return out

    @wp.func
    def evaluate_point(
        con: Contacts, facets: Facets, his: History, scr: ContactScratch, world: int, q: int, item: int, point: int,
        u: wp.array2d(dtype=vec3d), time: f64, inv_h: f64, shrink: f64,
    ) -> PointContact:  # fmt: skip
        """A point at displacements u (float64, see kernels/contact/double_displacements.py)."""
        out = PointContact()
        c = facets.contact[item]
        k = con.collider[c]
        rec = history_row(con, c, point)
        moved = interpolate_acting(facets, scr, u, world, q, item)
        x = reference_position(facets, scr, world, q, item) + moved
        rotation = scr.collider_rotation[world, k]
        out.local_position = wp.transpose(rotation) * (x - scr.collider_position[world, k])
        in_contact = his.speed[world, rec] > f64(0.0)
        side = stored_side(con, k, in_contact, his.contact_state[world, rec])
        activation_gap_now = activation_gap(con, his, world, c, point, time, con.margin[world, k])
        d = wp.vec4d(f64(0.0), f64(0.0), f64(1.0), f64(0.0))
        out.side = -1
        far = bool(False)
        if wp.static(meshes):  # lower bound of the distance, the last one minus the motion: avoids a search of the mesh
            d[3] = (
                scr.activation_gap[world, point]
                - scr.start_depth[world, point]
                - wp.length(out.local_position - scr.start_position[world, point])
            )
            far = (
                con.collider_kind[k] == MESH
                and con.law[c] != SMOOTH
                and not in_contact
                and d[3] > wp.max(activation_gap_now, f64(0.0))
            )
        if not far:
            out.side = sweep(con, k, scr.start_position[world, point], out.local_position, side)
            d = distance(con, k, out.local_position, out.side)
        out.normal = rotation * vec3d(d[0], d[1], d[2])
        out.depth = activation_gap_now - d[3]
        motion = moved - scr.start_displacement[world, point] - scr.collider_translation[world, k]
        if con.rotation_law[k] >= 0:
            motion -= scr.collider_rotation_change[world, k] * (
                his.rotation[world, k] * scr.start_position[world, point]
            )
        before = scr.start_depth[world, point]
        change = depth_change(con, k, out.side, scr.start_position[world, point], out.local_position,
                              wp.transpose(rotation) * motion,
                              scr.activation_gap[world, point] - before, d[3])  # fmt: skip
        if change[1] != f64(0.0):
            out.depth = before + change[0] + (activation_gap_now - scr.activation_gap[world, point])
        rate = normal_damping_rate(con, scr, world, c, point, inv_h)
        k_n = con.scale[world, c] * world_value(con.normal_stiffness, world, c)
        previous_depth = depth_at_start(con, facets, his, scr, world, c, point)
        out.normal_values = normal_law(con.law[c], con.single_point[c], k_n, rate, con.damping_ramp[c],
                                         con.force_eps[c], out.depth, previous_depth)  # fmt: skip
        out.depth_increment = out.depth - previous_depth
        out.relative_motion = motion
        spring = vec3d()
        if in_contact:
            spring = his.spring[world, rec]
            if con.law[c] != PAPER:
                spring = shrink * (rotation * spring)
        out.trial_displacement = spring + motion
        return with_friction_normal(out, out.normal)

    @wp.func
    def friction_coefficient(con: Contacts, his: History, world: int, c: int, rec: int) -> f64:
        """Friction coefficient: mu for a contact that slipped in the last step, else mu_static."""
        in_contact = his.speed[world, rec] > f64(0.0)
        if in_contact and his.contact_state[world, rec] >= SLIP_FLAG:
            return con.mu[world, c]
        return con.mu_static[world, c]

    @wp.func
    def set_explicit_force(
        con: Contacts, his: History, scr: ContactScratch, world: int, c: int, point: int, delta: f64, n: vec3d,
        v: vec3d, h: f64
    ):  # fmt: skip
        """Force and spring, Eqs. (77)-(83) unmodified, of a point at depth delta with relative velocity v, for a step
        h."""
        rec = history_row(con, c, point)
        v_n_rel = wp.dot(v, n)
        v_t = v - v_n_rel * n
        beta = con.beta[world, c]
        scale = con.scale[world, c]
        spring = elastic_force(con.single_point[c], scale * world_value(con.normal_stiffness, world, c), delta)[0]
        gamma = beta * wp.sqrt(scale) * world_value(con.normal_damping, world, c)
        k_t = scale * world_value(con.tangential_stiffness, world, c)
        if con.single_point[c] != 0:
            gamma *= wp.sqrt(wp.sqrt(delta))
            k_t *= wp.sqrt(delta)
        force = wp.max(spring - gamma * v_n_rel, f64(0.0))
        s = tangential(n, his.spring[world, rec] + h * v_t)
        gamma_t = tangent_damping(con, world, c, k_t)
        tangential_force = -k_t * s - gamma_t * v_t
        friction_limit = friction_coefficient(con, his, world, c, rec) * force
        size = wp.length(tangential_force)
        if size > friction_limit:
            tangential_force = (friction_limit / size) * tangential_force
            s = (f64(-1.0) / k_t) * (tangential_force + gamma_t * v_t)
        scr.explicit_elastic_slip[world, point] = s
        scr.explicit_force[world, point] = force * n + tangential_force

    @wp.func
    def friction_parameters(
        con: Contacts, his: History, scr: ContactScratch, world: int, c: int, point: int, t: PointContact
    ) -> vec3d:
        """Friction limit, k_t and reduction factor of the spring at an iterate."""
        rec = history_row(con, c, point)
        mu = friction_coefficient(con, his, world, c, rec)
        in_contact = his.speed[world, rec] > f64(0.0)
        stiffness = con.scale[world, c] * world_value(con.tangential_stiffness, world, c)
        shrink = f64(1.0)
        if con.single_point[c] != 0:
            depth = wp.max(t.depth, f64(0.0))
            stiffness *= wp.sqrt(depth)
            before = t.depth - t.depth_increment
            if in_contact and depth < before and con.law[c] == DEFAULT:
                shrink = wp.sqrt(depth / before)
        return vec3d(mu * t.normal_values[0], stiffness, shrink)

    @wp.func
    def friction_trial(con: Contacts, world: int, c: int, t: PointContact, frozen: vec3d, inv_h: f64) -> wp.vec4d:
        """Friction opposing the motion: trial force, and in w its total stiffness (spring and damper)."""
        gamma = tangent_damping(con, world, c, frozen[1]) * inv_h
        trial = frozen[1] * t.trial_elastic_slip + gamma * t.tangential_motion
        return wp.vec4d(trial[0], trial[1], trial[2], frozen[1] + gamma)

    @wp.func
    def friction_potential(con: Contacts, world: int, c: int, t: PointContact, frozen: vec3d, inv_h: f64) -> f64:
        """Friction potential with a frozen limit, J."""
        if frozen[0] <= f64(0.0):
            return f64(0.0)
        if con.law[c] == SMOOTH:
            return smooth_friction(t.tangential_motion, inv_h, con.speed_eps[c], frozen[0])[0]
        w = friction_trial(con, world, c, t, frozen, inv_h)
        if w[3] <= f64(0.0):
            return f64(0.0)
        return huber_friction(vec3d(w[0], w[1], w[2]), w[3], frozen[0])[0]

    @wp.func
    def friction_force(con: Contacts, world: int, c: int, t: PointContact, frozen: vec3d, inv_h: f64) -> vec3d:
        """Friction force on the residual, N."""
        if frozen[0] <= f64(0.0):
            return vec3d()
        if con.law[c] == SMOOTH:
            return smooth_friction(t.tangential_motion, inv_h, con.speed_eps[c], frozen[0])[1] * t.tangential_motion
        w = friction_trial(con, world, c, t, frozen, inv_h)
        if w[3] <= f64(0.0):
            return vec3d()
        trial = vec3d(w[0], w[1], w[2])
        return huber_friction(trial, w[3], frozen[0])[1] * trial

    @wp.func
    def point_stiffness(con: Contacts, world: int, c: int, t: PointContact, frozen: vec3d, inv_h: f64) -> mat33d:
        """Derivative of the force that a point adds to the residual, positive; the change of the normal is omitted."""
        K = wp.max(t.normal_values[1], f64(0.0)) * wp.outer(t.normal, t.normal)
        if frozen[0] > f64(0.0):
            P = wp.identity(n=3, dtype=f64) - wp.outer(t.friction_normal, t.friction_normal)
            if con.law[c] == SMOOTH:
                part = smooth_friction(t.tangential_motion, inv_h, con.speed_eps[c], frozen[0])[1]
                v = inv_h * t.tangential_motion
                root = wp.dot(v, v) + con.speed_eps[c] * con.speed_eps[c]
                K += part * (P - wp.outer(v, v) / root)
            else:
                w = friction_trial(con, world, c, t, frozen, inv_h)
                trial = vec3d(w[0], w[1], w[2])
                size2 = wp.dot(trial, trial)
                if size2 <= frozen[0] * frozen[0]:
                    K += w[3] * P
                else:
                    K += (w[3] * frozen[0] / wp.sqrt(size2)) * (P - wp.outer(trial, trial) / size2)
        return K

    @wp.func
    def is_acting(con: Contacts, scr: ContactScratch, world: int, c: int, point: int) -> f64:
        """1, or 0 if another point represents the contact."""
        if con.single_point[c] != 0 and scr.contact_point[world, c] != point:
            return f64(0.0)
        return f64(1.0)

    return kernel_set(locals())
