"""Potentials of one vector a of springs.py: k a.a/2, and of chords between directions that two ends have in common.

A bushing turns by angles phi_i between the directions i of its ends, whose chords have a.a = 4 sin^2(phi/2). It has the
energy sum_i c_i phi_i^2/2 with c_1 = (k_2 + k_3 - k_1)/2 and so on: k_i t^2/2 of a turn t about axis i, for any turn,
and sum_i k_i t_i^2/2 of small ones. Each is a smooth function psi of s = a.a, symmetric in both ends, and its forces
have no moment, as they lie along the chord; in a mid-point scheme along the mean chord, with the quotient
(psi(s) - psi(s0))/(s - s0). Turns beyond MAX_TURN have no finite energy: the line search keeps below.
"""

import functools
import math

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64, vec3d

__all__ = ["MAX_TURN", "chord_functions"]

MAX_TURN = math.radians(170.0)
"""Largest angle between directions of the ends of a bushing, rad; at 180 degrees the sense of the turn is lost."""
MAX_SQUARE = 4.0 * math.sin(0.5 * MAX_TURN) ** 2
SMALL_ANGLE = 5.0e-3
"""Angle below which series stand for the quotients, rad: their errors are below 1e-14."""
SMALL_CHANGE = 1.0e-4
"""Change of s below which the quotient of a step is a derivative at the middle: an error of 1e-10 of the small work."""


@functools.cache
def chord_functions(midpoint: bool) -> KernelSet:
    """Device functions; `midpoint`: forces of the mid-point scheme."""

    @wp.struct
    class VectorForce:
        """Force on a vector, its derivative and the positive semi-definite part of it, and the potential."""

        force: wp.vec3d
        hessian: wp.mat33d
        projected: wp.mat33d
        energy: wp.float64

    @wp.func
    def chord_energy(square: f64) -> vec3d:
        """psi = phi^2/2 of s = 4 sin^2(phi/2), and two derivatives by s; constant beyond MAX_TURN."""
        s = wp.min(square, f64(MAX_SQUARE))
        phi = f64(2.0) * wp.asin(f64(0.5) * wp.sqrt(s))
        sine = wp.sin(phi)
        x = phi * phi
        slope = f64(0.5) + x * (f64(1.0) / f64(12.0) + x * (f64(7.0) / f64(720.0)))
        bend = f64(1.0) / f64(12.0) + x * f64(1.0) / f64(30.0)
        if phi > f64(SMALL_ANGLE):
            slope = f64(0.5) * phi / sine
            bend = f64(0.25) * (sine - phi * wp.cos(phi)) / (sine * sine * sine)
        return vec3d(f64(0.5) * x, slope, bend)

    @wp.func
    def plain_force(a: vec3d, b: vec3d, stiffness: f64, damping: f64) -> VectorForce:
        """Of k a.a/2, with damping from b on, where a rate is known from; in a mid-point scheme b is the start."""
        out = VectorForce()
        at = a
        slope = stiffness + damping
        if wp.static(midpoint):
            at = f64(0.5) * (a + b)
            slope = f64(0.5) * stiffness + damping
        out.force = stiffness * at + damping * (a - b)
        out.hessian = slope * wp.identity(n=3, dtype=f64)
        out.projected = out.hessian
        out.energy = f64(0.5) * (stiffness * wp.length_sq(a) + damping * wp.length_sq(a - b))
        return out

    @wp.func
    def chord_force(a: vec3d, b: vec3d, stiffness: f64) -> VectorForce:
        """Of the chord a, which was b at the start of a mid-point step."""
        out = VectorForce()
        s = wp.length_sq(a)
        p = chord_energy(s)
        out.energy = stiffness * p[0]
        if s > f64(MAX_SQUARE):
            out.energy = f64(wp.inf)
        along = f64(2.0) * a
        slope = p[1]
        bend = f64(2.0) * p[2] * a
        if wp.static(midpoint):
            start = wp.length_sq(b)
            along = a + b
            middle = chord_energy(f64(0.5) * (s + start))
            slope = middle[1]
            bend = middle[2] * a
            if wp.abs(s - start) > f64(SMALL_CHANGE):
                slope = (p[0] - chord_energy(start)[0]) / (s - start)
                bend = f64(2.0) * (p[1] - slope) / (s - start) * a
        out.force = stiffness * slope * along
        factor = f64(2.0)
        if wp.static(midpoint):
            factor = f64(1.0)
        out.hessian = stiffness * (factor * slope * wp.identity(n=3, dtype=f64) + wp.outer(along, bend))
        out.projected = wp.max(stiffness, f64(0.0)) * factor * slope * wp.identity(n=3, dtype=f64)
        return out

    return kernel_set(locals())
