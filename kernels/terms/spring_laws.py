"""Forces of springs as functions of a coordinate y and its rate: linear, by samples, or a function of one's own."""

import functools
from typing import Any

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64

__all__ = ["LINEAR", "OWN", "SAMPLED", "OwnForces", "law_functions", "spring_struct"]

OwnForces = tuple[tuple[str, Any], ...]
"""Names in module names, and device functions (y, dy/dt) -> force."""
LINEAR, SAMPLED, OWN = 0, 1, 2
"""Laws; OWN + k: the k-th function of one's own."""
HALF_RULE = (
    (0.1252334085114689, 0.2491470458134027),
    (0.3678314989981802, 0.2334925365383546),
    (0.5873179542866175, 0.20316742672306573),
    (0.7699026741943047, 0.16007832854334642),
    (0.9041172563704748, 0.10693932599531907),
    (0.9815606342467192, 0.04717533638651141),
)
"""Gauss points above 0 of (-1, 1) and weights, for integrals of functions of one's own."""
OWN_STEP = 1.0e-3
"""Step of the differences of such a function, over its argument and the length at rest (1 rad): errors of 1e-12."""
vec12d = wp.types.vector(length=12, dtype=wp.float64)
GAUSS_POINTS = vec12d([0.5 + 0.5 * sign * x for x, _ in HALF_RULE for sign in (-1.0, 1.0)])
GAUSS_WEIGHTS = vec12d([0.5 * w for _, w in HALF_RULE for _ in range(2)])


@functools.cache
def spring_struct():
    """Springs, each of one item or more (points of a foundation), their slots, and their laws."""

    @wp.struct
    class Springs:
        kind: wp.array(dtype=wp.int32)  # [item] LENGTH, ANGLE, VECTOR
        spring: wp.array(dtype=wp.int32)  # [item]
        scale: wp.array(dtype=wp.float64)  # [item] factor on stiffness and damping: area of a point, m^2
        first_block: wp.array(dtype=wp.int32)  # [item] of one block of the tangent, or 3 x 3 of an ANGLE
        reference: wp.array(dtype=wp.mat33d)  # [item] vectors in the reference configuration, as rows
        entry_start: wp.array(dtype=wp.int32)  # [item + 1] into the entries
        entry_item: wp.array(dtype=wp.int32)  # [entry]
        entry_slot: wp.array(dtype=wp.int32)
        entry_weight: wp.array(dtype=wp.vec3d)  # weights of the slot in the three vectors
        stiffness: wp.array2d(dtype=wp.float64)  # [world, spring] N/m, N m, N/m^3
        damping: wp.array2d(dtype=wp.float64)  # [world, spring] N s/m, N m s, N s/m^3
        rest_coordinate: wp.array2d(
            dtype=wp.float64
        )  # [world, spring] m, rad; of an OWN law a length, where the energy is 0
        max_force: wp.array2d(dtype=wp.float64)  # [world, spring] largest force of FEEDBACK and FRICTION, N, N m
        lower_end: wp.array2d(dtype=wp.float64)  # [world, spring] bounds of STOP, m, rad
        upper_end: wp.array2d(dtype=wp.float64)
        schedule: wp.array(dtype=wp.int32)  # [spring] time law of TORQUE and FEEDBACK, -1: none
        law: wp.array(dtype=wp.int32)  # [spring] LINEAR, SAMPLED, OWN + k, or one of bounded_laws.py, below 0
        knot_start: wp.array(dtype=wp.int32)  # [spring + 1] pieces of a sampled force; the first is linear
        knot: wp.array(dtype=wp.float64)  # y at which a piece begins, of the first: ends
        coefficients: wp.array(dtype=wp.vec4d)  # of powers of y - knot, N
        knot_energy: wp.array(dtype=wp.float64)  # J

    return Springs


@functools.cache
def law_functions(own: OwnForces) -> KernelSet:
    """Device functions of the laws."""
    Springs = spring_struct()
    own_force = _own_functions(own)

    @wp.func
    def own_slope(number: int, y: f64, rate: f64, dy: f64, dr: f64) -> f64:
        """Derivative along (dy, dr) of a function of one's own, to the fourth order of its length."""
        one = own_force(number, y + dy, rate + dr) - own_force(number, y - dy, rate - dr)
        two = own_force(number, y + f64(2.0) * dy, rate + f64(2.0) * dr)
        two -= own_force(number, y - f64(2.0) * dy, rate - f64(2.0) * dr)
        return (f64(8.0) * one - two) / f64(12.0)

    @wp.func
    def own_derivatives(number: int, y: f64, rate: f64, rest_coordinate: f64) -> wp.vec3d:
        """Force of a function of one's own, and its derivatives by y and the rate."""
        dy, dr = f64(OWN_STEP) * (wp.abs(y) + rest_coordinate), f64(OWN_STEP) * (wp.abs(rate) + rest_coordinate)
        by_y = own_slope(number, y, rate, dy, f64(0.0)) / dy
        return wp.vec3d(own_force(number, y, rate), by_y, own_slope(number, y, rate, f64(0.0), dr) / dr)

    @wp.func
    def find_piece(spr: Springs, sp: int, y: f64) -> int:
        """Piece of a sampled force at y."""
        k = spr.knot_start[sp]
        while k + 1 < spr.knot_start[sp + 1] and y >= spr.knot[k + 1]:
            k += 1
        return k

    @wp.func
    def piece_force(spr: Springs, k: int, y: f64) -> wp.vec2d:
        """Force of a piece, and its derivative."""
        q = spr.coefficients[k]
        t = y - spr.knot[k]
        slope = q[1] + t * (f64(2.0) * q[2] + f64(3.0) * t * q[3])
        return wp.vec2d(q[0] + t * (q[1] + t * (q[2] + t * q[3])), slope)

    @wp.func
    def piece_mean(spr: Springs, k: int, y0: f64, y: f64) -> f64:
        """Mean force of a piece between two places, by Simpson's rule, exact for a cubic."""
        ends = piece_force(spr, k, y0)[0] + piece_force(spr, k, y)[0]
        return (ends + f64(4.0) * piece_force(spr, k, f64(0.5) * (y0 + y))[0]) / f64(6.0)

    @wp.func
    def elastic_force(spr: Springs, world: int, sp: int, y: f64) -> wp.vec2d:
        """dW/dy and its derivative."""
        code = spr.law[sp]
        if code == LINEAR:
            k = spr.stiffness[world, sp]
            return wp.vec2d(k * (y - spr.rest_coordinate[world, sp]), k)
        if code == SAMPLED:
            return piece_force(spr, find_piece(spr, sp, y), y)
        f = own_derivatives(code - OWN, y, f64(0.0), spr.rest_coordinate[world, sp])
        return wp.vec2d(f[0], f[1])

    @wp.func
    def energy(spr: Springs, world: int, sp: int, y: f64) -> f64:
        """W, J."""
        code = spr.law[sp]
        moved = y - spr.rest_coordinate[world, sp]
        if code == LINEAR:
            return f64(0.5) * spr.stiffness[world, sp] * moved * moved
        if code == SAMPLED:
            k = find_piece(spr, sp, y)
            q = spr.coefficients[k]
            t = y - spr.knot[k]
            fourth = q[2] / f64(3.0) + f64(0.25) * t * q[3]
            return spr.knot_energy[k] + t * (q[0] + t * (f64(0.5) * q[1] + t * fourth))
        s = f64(0.0)
        for i in range(12):
            s += GAUSS_WEIGHTS[i] * own_force(
                code - OWN, spr.rest_coordinate[world, sp] + GAUSS_POINTS[i] * moved, f64(0.0)
            )
        return moved * s

    @wp.func
    def mean_force(spr: Springs, world: int, sp: int, y0: f64, y: f64) -> wp.vec2d:
        """(W(y) - W(y0)) / (y - y0) without cancellation, and its derivative by y."""
        code = spr.law[sp]
        middle = f64(0.5) * (y0 + y)
        if code == LINEAR:
            stiffness = spr.stiffness[world, sp]
            return wp.vec2d(stiffness * (middle - spr.rest_coordinate[world, sp]), f64(0.5) * stiffness)
        if code == SAMPLED:
            low, high = wp.min(y0, y), wp.max(y0, y)
            first, last = find_piece(spr, sp, low), find_piece(spr, sp, high)
            if first == last:
                slope = f64(2.0) * piece_force(spr, first, middle)[1] + piece_force(spr, first, y)[1]
                return wp.vec2d(piece_mean(spr, first, y0, y), slope / f64(6.0))
            work = (spr.knot[first + 1] - low) * piece_mean(spr, first, low, spr.knot[first + 1])
            for k in range(first + 1, last):
                work += (spr.knot[k + 1] - spr.knot[k]) * piece_mean(spr, k, spr.knot[k], spr.knot[k + 1])
            work += (high - spr.knot[last]) * piece_mean(spr, last, spr.knot[last], high)
            mean = work / (high - low)
            return wp.vec2d(mean, (elastic_force(spr, world, sp, y)[0] - mean) / (y - y0))
        out = wp.vec2d()
        for i in range(12):
            x = GAUSS_POINTS[i]
            f = own_derivatives(code - OWN, y0 + x * (y - y0), f64(0.0), spr.rest_coordinate[world, sp])
            out += GAUSS_WEIGHTS[i] * wp.vec2d(f[0], x * f[1])
        return out

    @wp.func
    def viscous_force(spr: Springs, world: int, sp: int, y: f64, rate: f64) -> wp.vec3d:
        """Part of the force that vanishes at rest, and its derivatives by y and the rate."""
        out = wp.vec3d(spr.damping[world, sp] * rate, f64(0.0), spr.damping[world, sp])
        if spr.law[sp] >= OWN:
            f = own_derivatives(spr.law[sp] - OWN, y, rate, spr.rest_coordinate[world, sp])
            e = own_derivatives(spr.law[sp] - OWN, y, f64(0.0), spr.rest_coordinate[world, sp])
            out += wp.vec3d(f[0] - e[0], f[1] - e[1], f[2])
        return out

    @wp.func
    def viscous_potential(spr: Springs, world: int, sp: int, reference: f64, y: f64, inverse: f64) -> f64:
        """Integral of the viscous force from `reference`, y~, to y, at rates (y - y~) * inverse."""
        moved = y - reference
        if spr.law[sp] < OWN:
            return f64(0.5) * spr.damping[world, sp] * moved * moved * inverse
        s = f64(0.0)
        for i in range(12):
            x = GAUSS_POINTS[i] * moved
            s += GAUSS_WEIGHTS[i] * viscous_force(spr, world, sp, reference + x, x * inverse)[0]
        return moved * s

    return kernel_set(locals())


def _own_functions(own: OwnForces) -> wp.Function:
    """Device function of the functions of one's own by number."""

    @wp.func
    def none(number: int, y: f64, rate: f64) -> f64:
        """No function."""
        return f64(0.0)

    chosen = none
    for k, (_, function) in enumerate(own):
        chosen = _own_function(k, function, chosen)
    return chosen


def _own_function(k: int, function: wp.Function, others: wp.Function) -> wp.Function:
    @wp.func
    def own_force(number: int, y: f64, rate: f64) -> f64:
        """The k-th function of one's own, else one of those before it."""
        if number == k:
            return function(y, rate)
        return others(number, y, rate)

    return own_force
