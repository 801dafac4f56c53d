"""Forces of a point of contact from its record: normal force, friction, their potential and derivative.

The normal force is `normal_law` of the depth. Friction is an anchored spring and damper of the elastic slip, whose
force is cut at the friction limit mu F_n (`friction_trial`, `friction_force`, `return_mapping`). With a frozen limit
friction has a potential, Huber's; with the limits of each iterate it has none, and an iterate deep in an obstacle has a
huge one. Stick or slip is decided after an accepted step, in `point_outcome` of ledger.py; the `SLIP_FLAG` that it
stores selects mu or mu_static in the next one. Of a point that comes into contact within the step friction acts on the
part of its motion in contact, depth over the sum of depth and gap: what went before is no slip, and would make it slide
where it sticks, against points that it is wedged between.

Limits, the plane of friction and the elastic slip's factor are frozen over Newton's iterations. `forces` (assembly.py)
sets those of an attempt from its first iterate, at most the limits of the last step, and stores those of each later
iterate aside (`friction_limits_at_iterate`). `update_frozen` takes them over, relaxed, when `NewtonLoop._update_frozen`
asks for it, after the first iterate and after each iteration: where the relative residual is at most
`FROZEN_UPDATE_RESIDUAL` (0.1, frozen_update.py) or within round-off, or no iteration is left. The residual is then
evaluated again, and convergence is tested with it.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64, mat33d, precision, vec3d
from .kinematics import kinematics_functions
from .law import (
    ANY_GAP,
    FIXED_SPRING,
    HARDENING_DEPTH,
    HARDENS,
    IMPACT_SPEED,
    SLIP_SPEED,
    SPEED_DAMPING,
    TRAIT_BITS,
    UNLOADING,
    OwnLaws,
    elastic_force,
    huber_friction,
    law_functions,
    smooth_friction,
)
from .structs import SLIP_FLAG, contact_structs, world_value

__all__ = ["EXACT_TOLERANCE", "TOUCHING_PART_UPDATES", "friction_functions"]

TOUCHING_PART_UPDATES = 2
"""Updates in an attempt of the part of the step that a new point is in contact. By that part friction in stick follows
the normal force, as a coefficient does: updates to the end diverge where two points wedge a body (by 1.05 each in a
chain of links)."""
EXACT_TOLERANCE = 1e-9
"""Relative tolerance of a step at or below which that part follows to the end, where its changes fall: gradients are
those of converged steps. An eighth more iterations where a stiff bar lands and sticks."""


@functools.cache
def friction_functions(dtype: str, own: OwnLaws = ()) -> KernelSet:
    """Device functions in one precision of the displacements; `own`: laws of one's own in use."""
    T, sym = precision(dtype).T, precision(dtype).sym
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    k, normal_law = kinematics_functions(dtype), law_functions(own).normal_law

    @wp.func
    def has_trait(con: Contacts, c: int, trait: int) -> bool:
        """True if the law of a contact has a trait."""
        return con.law[c] & trait != 0

    @wp.func
    def normal_stiffness(con: Contacts, world: int, c: int, ratio: f64) -> f64:
        """k_n, N/m; of a lumped contact over the root of the depth."""
        return con.scale[world, c] * ratio * world_value(con.normal_stiffness, world, c)

    @wp.func
    def law_length(con: Contacts, world: int, c: int, ratio: f64) -> f64:
        """Length `ramp` of the normal law, m: with the stiffness of the elements the depth beyond which it hardens."""
        s = con.compliance[world % con.compliance.shape[0], c]
        if s[0] > f64(0.0) or con.single_point[c] != 0 or not has_trait(con, c, HARDENS):
            return con.damping_ramp[c]
        return f64(HARDENING_DEPTH) / (ratio * (s[1] + s[2]))

    @wp.func
    def friction_stiffness(con: Contacts, world: int, c: int, ratio: f64, depth: f64) -> f64:
        """k_t, N/m."""
        k_t = con.scale[world, c] * ratio * world_value(con.tangential_stiffness, world, c)
        if con.single_point[c] != 0:
            k_t *= wp.sqrt(wp.max(depth, f64(0.0)))
        return k_t

    @wp.func
    def normal_damping_rate(
        con: Contacts, scr: ContactScratch, world: int, c: int, point: int, ratio: f64, inv_h: f64
    ) -> f64:  # fmt: skip
        """Damping per depth of the normal law: chi/h, or gamma_n/h; with restitution 0 minus the critical damping of
        the effective mass over h, of rigid parts `RIGID_DAMPING` times it, at points that have come faster than
        `IMPACT_SPEED`."""
        if inv_h == f64(0.0):
            return f64(0.0)
        if has_trait(con, c, SPEED_DAMPING):
            speed = scr.approach_speed[world, point]
            if con.damping[world, c] >= f64(0.0):
                return con.damping[world, c] * inv_h / speed
            if speed <= f64(IMPACT_SPEED):
                return f64(0.0)
            mass = world_value(con.effective_mass, world, c)
            critical = f64(2.0) * inv_h * wp.sqrt(normal_stiffness(con, world, c, ratio) * mass)
            return con.damping[world, c] * critical
        damping = world_value(con.normal_damping, world, c)
        return con.beta[world, c] * wp.sqrt(con.scale[world, c] * ratio) * damping * inv_h

    @wp.func
    def touching_part(t: PointContact, factor: f64) -> f64:
        """Part of the motion in the step that friction acts on: the frozen factor of a point that was apart before."""
        return wp.where(t.previous_depth < f64(0.0), factor, f64(1.0))

    @wp.func
    def in_friction_plane(t: PointContact, m: vec3d, shrink: f64) -> PointContact:
        """The point with friction in the plane of a normal m, frozen with the friction limits: on a curved shape the
        force would not be the derivative of its potential if the plane turned with the iterate. `shrink`: factor on the
        stored elastic slip."""
        out = t
        out.friction_normal = m
        out.tangential_motion = k.tangential(m, t.relative_motion)
        out.trial_elastic_slip = k.tangential(m, shrink * t.spring + touching_part(t, shrink) * t.relative_motion)
        return out

    @wp.func
    def with_normal_force(
        con: Contacts, scr: ContactScratch, world: int, c: int, point: int, t: PointContact, inv_h: f64
    ) -> PointContact:  # fmt: skip
        """The record with the normal force, and friction in its own tangent plane."""
        out = in_friction_plane(t, t.normal, f64(1.0))
        out.normal_values = normal_law(
            con.law[c] >> TRAIT_BITS, con.single_point[c], normal_stiffness(con, world, c, t.stiffness_ratio),
            normal_damping_rate(con, scr, world, c, point, t.stiffness_ratio, inv_h),
            law_length(con, world, c, t.stiffness_ratio), con.force_eps[c], t.depth, t.previous_depth,
        )  # fmt: skip
        return out

    @wp.func
    def elastic_part(con: Contacts, world: int, c: int, t: PointContact) -> wp.vec2d:
        """Elastic normal force, N, and its stored energy, J."""
        k_n = normal_stiffness(con, world, c, t.stiffness_ratio)
        if has_trait(con, c, ANY_GAP):
            return elastic_force(con.single_point[c], k_n, t.depth)
        w = normal_law(
            con.law[c] >> TRAIT_BITS, con.single_point[c], k_n, f64(0.0), law_length(con, world, c, t.stiffness_ratio),
            con.force_eps[c], t.depth, t.depth,
        )  # fmt: skip
        return wp.vec2d(w[0], w[2])

    @wp.func
    def tangent_damping(con: Contacts, world: int, c: int, stiffness: f64) -> f64:
        """gamma_t of Eq. (80), N s/m."""
        return (
            f64(1.8257418583505538)
            * con.beta[world, c]
            * wp.sqrt(world_value(con.effective_mass, world, c) * stiffness)
        )

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
        rec = k.history_row(con, c, point)
        v_n_rel = wp.dot(v, n)
        v_t = v - v_n_rel * n
        beta = con.beta[world, c]
        spring = elastic_force(con.single_point[c], normal_stiffness(con, world, c, f64(1.0)), delta)[0]
        gamma = beta * wp.sqrt(con.scale[world, c]) * world_value(con.normal_damping, world, c)
        k_t = friction_stiffness(con, world, c, f64(1.0), delta)
        if con.single_point[c] != 0:
            gamma *= wp.sqrt(wp.sqrt(delta))
        force = wp.max(spring - gamma * v_n_rel, f64(0.0))
        s = k.tangential(n, his.spring[world, rec] + h * v_t)
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
    def friction_parameters(con: Contacts, his: History, world: int, c: int, point: int, t: PointContact) -> vec3d:
        """Friction limit, k_t and factor on the stored elastic slip at an iterate, or on the motion of a point that
        comes into contact in the step: the part of the step after its first touch."""
        rec = k.history_row(con, c, point)
        shrink = f64(1.0)
        depth = wp.max(t.depth, f64(0.0))
        if t.previous_depth < f64(0.0) and not has_trait(con, c, FIXED_SPRING) and not has_trait(con, c, SLIP_SPEED):
            shrink = depth / (depth - t.previous_depth)
        if con.single_point[c] != 0 and his.speed[world, rec] > f64(0.0) and depth < t.previous_depth:
            if has_trait(con, c, UNLOADING):
                shrink = wp.sqrt(depth / t.previous_depth)
        mu = friction_coefficient(con, his, world, c, rec)
        return vec3d(mu * t.normal_values[0], friction_stiffness(con, world, c, t.stiffness_ratio, t.depth), shrink)

    @wp.func
    def friction_limits_at_iterate(
        con: Contacts, his: History, scr: ContactScratch, world: int, c: int, point: int, t: PointContact, fresh: int
    ) -> vec3d:  # fmt: skip
        """Store friction limit, k_t, factor on the stored elastic slip, and normal of an iterate for the next frozen
        update. Returns the frozen three; `fresh`: they and the normal are set to those of the iterate, with at most the
        limit of the last step: zero for a new contact. The factor of a point stays after a few updates."""
        rec = k.history_row(con, c, point)
        frozen = scr.frozen_friction[world, rec]
        new = friction_parameters(con, his, world, c, point, t)
        if fresh != 0:
            scr.frozen_normal[world, rec] = t.normal
            frozen = new
            frozen[0] = wp.min(new[0], his.friction_limit[world, rec])
            scr.frozen_friction[world, rec] = frozen
            scr.predicted_friction[world, point] = vec3d()
            if his.friction_limit[world, rec] > f64(0.0):
                scr.predicted_friction[world, point] = (new[1] / his.friction_limit[world, rec]) * t.spring
        elif con.single_point[c] == 0:  # a point that has come to another side since
            frozen[1] = new[1]
            if frozen[0] > f64(0.0) and wp.abs(new[2] - frozen[2]) > scr.most_part_change[world]:
                new[2] = frozen[2]
        scr.updated_normal[world, rec] = t.normal
        scr.updated_friction[world, rec] = new
        return frozen

    @wp.func
    def friction_trial(con: Contacts, world: int, c: int, t: PointContact, frozen: vec3d, inv_h: f64) -> wp.vec4d:
        """Friction opposing the motion: trial force, and in w its total stiffness (spring and damper)."""
        part = touching_part(t, frozen[2])
        gamma = tangent_damping(con, world, c, frozen[1]) * inv_h
        trial = frozen[1] * t.trial_elastic_slip + (part * gamma) * t.tangential_motion
        return wp.vec4d(trial[0], trial[1], trial[2], part * (frozen[1] + gamma))

    @wp.func
    def friction_potential(con: Contacts, world: int, c: int, t: PointContact, frozen: vec3d, inv_h: f64) -> f64:
        """Friction potential with a frozen limit, J."""
        if frozen[0] <= f64(0.0):
            return f64(0.0)
        if has_trait(con, c, SLIP_SPEED):
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
        if has_trait(con, c, SLIP_SPEED):
            return smooth_friction(t.tangential_motion, inv_h, con.speed_eps[c], frozen[0])[1] * t.tangential_motion
        w = friction_trial(con, world, c, t, frozen, inv_h)
        if w[3] <= f64(0.0):
            return vec3d()
        trial = vec3d(w[0], w[1], w[2])
        return huber_friction(trial, w[3], frozen[0])[1] * trial

    @wp.func
    def point_stiffness(
        con: Contacts, world: int, c: int, t: PointContact, frozen: vec3d, inv_h: f64, predicted: vec3d
    ) -> mat33d:  # fmt: skip
        """Derivative of the force that a point adds to the residual, positive; the change of the normal is omitted.

        Of a slipping point Newton's method with friction as an unknown of its own (Chan, Golub and Mulet 1999), where
        `predicted` is that of the last step: with the derivative of the force a step does not see that the slip ends.
        """
        K = wp.max(t.normal_values[1], f64(0.0)) * wp.outer(t.normal, t.normal)
        if frozen[0] > f64(0.0):
            P = wp.identity(n=3, dtype=f64) - wp.outer(t.friction_normal, t.friction_normal)
            if has_trait(con, c, SLIP_SPEED):
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
                    size = wp.sqrt(size2)
                    lead = (f64(0.5) / (size * wp.max(wp.length(predicted), f64(1.0)))) * (P @ predicted)
                    K += (w[3] * frozen[0] / size) * (P - wp.outer(lead, trial) - wp.outer(trial, lead))
        return K

    @wp.func
    def return_mapping(con: Contacts, world: int, c: int, t: PointContact, frozen: vec3d, inv_h: f64) -> vec3d:
        """Elastic slip, m, after the force was cut to the friction limit; Eq. (83) of Paper I for its law."""
        w = friction_trial(con, world, c, t, frozen, inv_h)
        trial = vec3d(w[0], w[1], w[2])
        size = wp.length(trial)
        if size <= frozen[0]:
            return t.trial_elastic_slip
        if frozen[0] <= f64(0.0):
            return vec3d()
        if has_trait(con, c, FIXED_SPRING):  # reverses the spring where gamma_t v exceeds the friction limit
            return (frozen[0] / (frozen[1] * size)) * trial - ((w[3] - frozen[1]) / frozen[1]) * t.tangential_motion
        # spring and damper slip together: bounded by the motion of the point
        return t.trial_elastic_slip - (touching_part(t, frozen[2]) * (size - frozen[0]) / (w[3] * size)) * trial

    @wp.func
    def is_slipping(con: Contacts, world: int, c: int, t: PointContact, frozen: vec3d, inv_h: f64) -> bool:
        """True if the trial force of friction exceeds its limit."""
        w = friction_trial(con, world, c, t, frozen, inv_h)
        return has_trait(con, c, SLIP_SPEED) or wp.length(vec3d(w[0], w[1], w[2])) > frozen[0]

    @wp.func
    def set_point_force(
        con: Contacts, scr: ContactScratch, world: int, c: int, point: int, t: PointContact, frozen: vec3d, inv_h: f64,
        area_fraction: f64,
    ) -> vec3d:  # fmt: skip
        """Set normal force and friction of a point, their potential, and the stiffness, N/m; its friction, N."""
        friction_energy = friction_potential(con, world, c, t, frozen, inv_h)
        K = area_fraction * point_stiffness(con, world, c, t, frozen, inv_h, scr.predicted_friction[world, point])
        tangential_force = area_fraction * friction_force(con, world, c, t, frozen, inv_h)
        scr.force[world, point] = tangential_force - (area_fraction * t.normal_values[0]) * t.normal
        scr.energy[world, point] = area_fraction * wp.vec2d(
            t.normal_values[2] + friction_energy, t.normal_values[3] + wp.abs(friction_energy)
        )
        scr.stiffness[world, point] = sym(T(K[0, 0]), T(K[1, 1]), T(K[2, 2]), T(K[1, 2]), T(K[0, 2]), T(K[0, 1]))
        return tangential_force

    return kernel_set(locals())
