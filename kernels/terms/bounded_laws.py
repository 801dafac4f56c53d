"""Forces of actuators, joint friction and stops along a coordinate y; those of springs are in spring_laws.py.

    TORQUE    F = -T(t)
    FEEDBACK  F = clamp(k (y - target(t)) + c dy/dt) to +-limit, of a PD controller
    FRICTION  F = clamp(k (y - anchor) + c dy/dt) to +-limit, at the end of a step: a slip drags the anchor along
    STOP      F = k p + c dp/dt of the penetration p beyond a bound, which never pulls

The stick spring k of FRICTION is overdamped by c = k * SETTLING_TIME: k alone would let a load applied at once pass the
limit on its way to twice the place where it rests, and slip.

None falls with y within a step: its integral is a convex part of Phi. In a mid-point scheme k p of a stop is the mean
(W(y) - W(y0))/(y - y0) of its energy, and a step takes from controller, stop and friction never less than the change
of their energies: it adds none.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64
from .spring_laws import spring_struct

__all__ = ["FEEDBACK", "FRICTION", "STOP", "TORQUE", "bounded_functions"]

TORQUE, FEEDBACK, FRICTION, STOP = -1, -2, -3, -4
"""Laws; those of springs are 0 and more."""
SETTLING_TIME = 0.1
"""Time in which a stuck joint settles on its stick spring, s: the damping over the stiffness."""


@functools.cache
def bounded_functions(midpoint: bool) -> KernelSet:
    """Device functions of these laws."""
    Springs = spring_struct()

    @wp.func
    def penetration(spr: Springs, world: int, sp: int, winding: f64, y: f64) -> f64:
        """Distance beyond the upper bound, or minus that beyond the lower."""
        over = wp.max(y - (spr.upper_end[world, sp] - winding), f64(0.0))
        return over + wp.min(y - (spr.lower_end[world, sp] - winding), f64(0.0))

    @wp.func
    def stop_force(
        spr: Springs, world: int, sp: int, winding: f64, y0: f64, y: f64, reference: f64, inverse: f64
    ) -> wp.vec3d:  # fmt: skip
        """Force of a stop, its derivative, and its potential."""
        k, c = spr.stiffness[world, sp], spr.damping[world, sp] * inverse
        p = penetration(spr, world, sp, winding, y)
        side = p
        elastic_force = k * p
        slope = f64(k)
        if wp.static(midpoint):
            p0 = penetration(spr, world, sp, winding, y0)
            elastic_force = f64(0.5) * k * (p0 + p)
            slope = f64(0.5) * k
            if p * p0 <= f64(0.0) and p != p0:
                elastic_force = f64(0.5) * k * (p * p - p0 * p0) / (y - y0)
                slope = (k * p - elastic_force) / (y - y0)
            if p == f64(0.0):
                side = p0
        before = penetration(spr, world, sp, winding, reference)
        if before * side < f64(0.0):
            before = f64(0.0)
        force = elastic_force + c * (p - before)
        if p != f64(0.0):
            slope += c
        if force * side <= f64(0.0):
            return wp.vec3d()
        return wp.vec3d(force, slope, f64(0.5) * force * force / wp.max(slope, f64(1.0e-300)))

    @wp.func
    def bounded_force(
        spr: Springs, world: int, sp: int, winding: f64, y0: f64, y: f64, reference: f64, inverse: f64, anchor: f64,
        value: f64,
    ) -> wp.vec3d:  # fmt: skip
        """Force, its derivative by y, and its potential, whose derivative it is but in a mid-point scheme.

        `winding`: angle of whole turns that y, y0, `reference` and `anchor` (of FRICTION) lack, so that its round-off
        is not theirs. The rate is (y - reference) * inverse. `value`: of the time law.
        """
        code = spr.law[sp]
        if code == STOP:
            return stop_force(spr, world, sp, winding, y0, y, reference, inverse)
        if code == TORQUE:
            return wp.vec3d(-value, f64(0.0), -value * y)
        k, c, max_force = spr.stiffness[world, sp], spr.damping[world, sp] * inverse, spr.max_force[world, sp]
        if code == FRICTION:
            c = k * f64(SETTLING_TIME) * inverse
            if wp.static(midpoint):
                c = f64(2.0) * c
        slope = k + c
        s = c * (y - reference)
        if code == FRICTION:
            s += k * (y - anchor)
        elif wp.static(midpoint):
            s += k * (f64(0.5) * (y0 + y) - (value - winding))
            slope = f64(0.5) * k + c
        else:
            s += k * (y - (value - winding))
        if wp.abs(s) > max_force:
            energy = max_force * (wp.abs(s) - f64(0.5) * max_force) / wp.max(slope, f64(1.0e-300))
            return wp.vec3d(wp.clamp(s, -max_force, max_force), f64(0.0), energy)
        return wp.vec3d(s, slope, f64(0.5) * s * s / wp.max(slope, f64(1.0e-300)))

    @wp.func
    def dragged(spr: Springs, world: int, sp: int, y: f64, anchor: f64) -> f64:
        """Anchor of FRICTION after a step to y."""
        k = spr.stiffness[world, sp]
        if k == f64(0.0):
            return y
        slip_distance = spr.max_force[world, sp] / k
        return y - wp.clamp(y - anchor, -slip_distance, slip_distance)

    @wp.func
    def energy(spr: Springs, world: int, sp: int, winding: f64, y: f64, anchor: f64) -> f64:
        """Stored energy, J."""
        moved = f64(0.0)
        if spr.law[sp] == STOP:
            moved = penetration(spr, world, sp, winding, y)
        elif spr.law[sp] == FRICTION:
            moved = y - anchor
        return f64(0.5) * spr.stiffness[world, sp] * moved * moved

    @wp.func
    def increments(
        spr: Springs, world: int, sp: int, winding: f64, y0: f64, y: f64, anchor: f64, force: f64, mean_rate: f64
    ) -> wp.vec3d:  # fmt: skip
        """Stored energy at y, energy lost in a step from y0, and work of actuators in it.

        What the elastic part of a stop or controller does beside its energy is the integrator's, as of springs; a stop
        loses what its damper takes at the mean rate, of second order.
        """
        if spr.law[sp] >= FEEDBACK:
            mean = force
            if wp.static(not midpoint):
                if spr.law[sp] == FEEDBACK and wp.abs(force) < spr.max_force[world, sp]:
                    mean -= f64(0.5) * spr.stiffness[world, sp] * (y - y0)
            return wp.vec3d(f64(0.0), f64(0.0), -mean * (y - y0))
        after, slip = anchor, f64(0.0)
        if spr.law[sp] == FRICTION:
            after = dragged(spr, world, sp, y, anchor)
            slip = after - anchor
        stored = energy(spr, world, sp, winding, y, after)
        if wp.static(midpoint):
            return wp.vec3d(stored, force * (y - y0) - stored + energy(spr, world, sp, winding, y0, anchor), f64(0.0))
        moved, elastic_force = y - y0, spr.stiffness[world, sp] * (y - after)
        if spr.law[sp] == STOP:
            p, p0 = penetration(spr, world, sp, winding, y), penetration(spr, world, sp, winding, y0)
            moved, elastic_force = p - p0, f64(0.5) * spr.stiffness[world, sp] * (p + p0)
            force = elastic_force + spr.damping[world, sp] * mean_rate
            if force * (p + p0) <= f64(0.0):
                force = f64(0.0)
        loss = force * slip + wp.max((force - elastic_force) * (moved - slip), f64(0.0))
        return wp.vec3d(stored, loss, f64(0.0))

    return kernel_set(locals())
