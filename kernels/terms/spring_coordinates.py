"""Coordinates of springs, functions of vectors that are linear in the slots; see springs.py."""

import functools
import math

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64, mat33d, vec3d

__all__ = ["ANGLE", "CHORD", "FULL_TURN", "LENGTH", "TINY", "TRAVEL", "VECTOR", "coordinate_functions"]

LENGTH, ANGLE, VECTOR, TRAVEL, CHORD = 0, 1, 2, 3, 4
"""Coordinates."""
TINY = 1.0e-300
"""Divisor of vectors without a length."""
FULL_TURN = 2.0 * math.pi
SMALL_TURN = 1.0e-2
"""Half of a change of angle below which x / sin x is taken from its series, rad: what is left out is below 1e-16."""


@functools.cache
def coordinate_functions(midpoint: bool) -> KernelSet:
    """Device functions of the coordinates LENGTH, ANGLE and TRAVEL, and of their derivatives."""

    @wp.struct
    class Derivatives:
        """First derivatives G, along which the force acts, and g, of y at the end of a step. The change of row s of G
        is sum_t (unit_st I + A_s g_t^T + G_s B_t^T) d_t."""

        G: wp.mat33d
        g: wp.mat33d
        A: wp.mat33d
        B: wp.mat33d
        unit: wp.vec3d  # of LENGTH; of ANGLE and TRAVEL between a and b, b and a2

    @wp.func
    def coordinate(kind: int, v: mat33d, near: f64) -> f64:
        """y of the vectors; an angle with the number of turns that brings it closest to `near`."""
        if kind == LENGTH:
            return wp.length(v[0])
        if kind == TRAVEL:
            return wp.dot(v[0], v[1])
        y = wp.atan2(wp.dot(v[2], v[1]), wp.dot(v[0], v[1]))
        return y + f64(FULL_TURN) * wp.round((near - y) / f64(FULL_TURN))

    @wp.func
    def radius(v: mat33d) -> f64:
        """|(a.b, a2.b)|."""
        return wp.max(wp.length(wp.vec2d(wp.dot(v[0], v[1]), wp.dot(v[2], v[1]))), f64(TINY))

    @wp.func
    def transverse(v: mat33d, y: f64) -> mat33d:
        """Derivatives of (cos y a2 - sin y a).b by the vectors."""
        s, c = wp.sin(y), wp.cos(y)
        return wp.matrix_from_rows(-s * v[1], c * v[2] - s * v[0], c * v[1])

    @wp.func
    def along(v: mat33d, y: f64) -> mat33d:
        """Derivatives of (cos y a + sin y a2).b, of `radius` at the angle y."""
        s, c = wp.sin(y), wp.cos(y)
        return wp.matrix_from_rows(c * v[1], c * v[0] + s * v[2], s * v[1])

    @wp.func
    def derivatives(kind: int, v: mat33d, y: f64) -> Derivatives:
        """At one configuration: G = g."""
        d = Derivatives()
        if kind == LENGTH:
            size = wp.max(wp.length(v[0]), f64(TINY))
            d.G[0] = v[0] / size
            d.unit = vec3d(f64(1.0) / size, f64(0.0), f64(0.0))
            d.B = -d.G / size
        elif kind == TRAVEL:
            d.G = wp.matrix_from_rows(v[1], v[0], vec3d())
            d.unit = vec3d(f64(0.0), f64(1.0), f64(0.0))
        else:
            inverse = f64(1.0) / radius(v)
            d.G = inverse * transverse(v, y)
            d.A = -inverse * along(v, y)
            d.B = d.A
            d.unit = inverse * vec3d(f64(0.0), -wp.sin(y), wp.cos(y))
        d.g = d.G
        return d

    @wp.func
    def mean_derivatives(kind: int, v0: mat33d, v: mat33d, y0: f64, y: f64) -> Derivatives:
        """Between the ends of a step: G.(v - v0) = y - y0."""
        d = derivatives(kind, v, y)
        if kind == LENGTH:
            inverse = f64(1.0) / wp.max(wp.length(v0[0]) + wp.length(v[0]), f64(TINY))
            d.G[0] = inverse * (v0[0] + v[0])
            d.unit = vec3d(inverse, f64(0.0), f64(0.0))
            d.B = -inverse * d.g
            return d
        if kind == TRAVEL:
            d.G = wp.matrix_from_rows(f64(0.5) * (v0[1] + v[1]), f64(0.5) * (v0[0] + v[0]), vec3d())
            d.unit = vec3d(f64(0.0), f64(0.5), f64(0.0))
            return d
        x = f64(0.5) * (y - y0)
        ratio = f64(1.0) + x * x / f64(6.0) * (f64(1.0) + f64(7.0) / f64(60.0) * x * x)  # x / sin x
        slope = x / f64(3.0) * (f64(1.0) + f64(7.0) / f64(30.0) * x * x)  # its derivative over itself
        slope = slope / ratio
        if wp.abs(x) > f64(SMALL_TURN):
            ratio = x / wp.sin(x)
            slope = f64(1.0) / x - wp.cos(x) / wp.sin(x)
        inverse = f64(1.0) / (radius(v0) + radius(v))
        q = f64(2.0) * ratio * inverse
        middle = f64(0.5) * (v0 + v)
        mean = y - x
        d.G = q * transverse(middle, mean)
        d.A = (f64(-0.5) * q) * along(middle, mean)
        d.B = (f64(0.5) * slope) * d.g - inverse * along(v, y)
        d.unit = (f64(0.5) * q) * vec3d(f64(0.0), -wp.sin(mean), wp.cos(mean))
        return d

    @wp.func
    def curvature(kind: int, d: Derivatives, s: int, t: int) -> mat33d:
        """Derivative of row s of G by vector t."""
        unit = f64(0.0)
        if kind == LENGTH:
            unit = d.unit[0]
        elif s != t and s + t != 2:
            unit = wp.where(s + t == 1, d.unit[1], d.unit[2])
        return unit * wp.identity(n=3, dtype=f64) + wp.outer(d.A[s], d.g[t]) + wp.outer(d.G[s], d.B[t])

    return kernel_set(locals())
