"""What kernels of contact between bodies read and write beside the structs of contact with obstacles."""

import functools

import warp as wp

from ..common.types import precision

__all__ = ["master_struct", "seat_struct", "touching_struct"]


@functools.cache
def master_struct(dtype: str):
    """Facets of master surfaces: places are polynomials of two coordinates, and linear along an outward vector.

    x(s, z) = sum_m s^m ((X_m + sum_i shape_mi u_i) + z (N_m + sum_i rise_mi u_i)): the vector is the material's,
    carried along by the deformation gradient, so that a point near a surface has weights on the slots of one element.
    """
    T = precision(dtype).T

    @wp.struct
    class Masters:
        tree: wp.uint64  # boxes of [world, facet], grouped by world and surface
        of: wp.array(dtype=wp.int32)  # [contact] its surface
        sign: wp.array(dtype=wp.float64)  # [contact] -1 where the points are of the second body
        bodies: wp.array(dtype=wp.vec2i)  # [contact] of the points and of the facets, among those in pairs
        surfaces: wp.int32
        touch: wp.float64  # depth as a step begins that counts as touch, m
        most: wp.int32  # monomials of a facet, at most
        conn: wp.array2d(dtype=wp.int32)  # [local, facet] slot
        shape: wp.array3d(dtype=T)  # [monomial, local, facet]
        rise: wp.array3d(dtype=T)  # 1/m
        X: wp.array2d(dtype=wp.vec3d)  # [monomial, facet]
        N: wp.array2d(dtype=wp.vec3d)
        kind: wp.array(dtype=wp.int32)  # [facet]
        terms: wp.array(dtype=wp.int32)  # [kind] monomials
        corners: wp.array(dtype=wp.int32)  # [kind]
        power: wp.array2d(dtype=wp.vec2i)  # [kind, monomial] exponents
        hull: wp.array3d(dtype=wp.float64)  # [kind, point, monomial] control points whose hull holds the facet
        limit: wp.array(dtype=wp.float64)  # [facet] depth beyond which a point would leave through another side, m
        size: wp.array(dtype=wp.float64)  # [facet] length of a side, m
        surface: wp.array(dtype=wp.int32)  # [facet]
        pool: wp.int32  # first entry in the pool
        count: wp.int32

    return Masters


@functools.cache
def seat_struct():
    """What the state keeps of points in contact, beside their history, [world, point]."""

    @wp.struct
    class Seats:
        seat: wp.array2d(dtype=wp.int32)  # master facet + 1 that a point is in contact with
        spot: wp.array2d(dtype=wp.vec3d)  # where on it: coordinates, and m along the outward vector

    return Seats


@functools.cache
def touching_struct(dtype: str):
    """What an attempt makes; [world, control]: monomial m of facet f is control `most f + m`."""
    p = precision(dtype)
    T, vec3, vec2, sym = p.T, p.vec3, p.vec2, p.sym
    mat43 = wp.types.matrix(shape=(4, 3), dtype=wp.float64)

    @wp.struct
    class Touching:
        C: wp.array2d(dtype=wp.vec3d)  # [world, control] coefficients of displacements at the iterate
        D: wp.array2d(dtype=wp.vec3d)  # of those of the outward vector
        C0: wp.array2d(dtype=wp.vec3d)  # as the attempt began
        D0: wp.array2d(dtype=wp.vec3d)
        V0: wp.array2d(dtype=wp.vec3d)  # of velocities then
        middle: wp.array2d(dtype=mat43)  # [world, facet] place in its middle and derivatives there, rows as of a Jet
        swell: wp.array2d(dtype=wp.float64)  # [world, facet] most that it rises above the plane in its middle, m
        middle0: wp.array2d(dtype=mat43)  # as the attempt began
        lower: wp.array(dtype=wp.vec3)  # [world facet] boxes of the tree
        upper: wp.array(dtype=wp.vec3)
        wanted_lower: wp.array(dtype=wp.vec3)
        wanted_upper: wp.array(dtype=wp.vec3)
        stale: wp.array(dtype=wp.int32)  # a facet has left its box
        fits: wp.array(dtype=wp.int32)  # refits so far
        near: wp.array2d(dtype=wp.int32)  # [world, facet row of the slaves] a master surface is in reach
        calm_lower: wp.array2d(dtype=wp.vec3)  # box in which none is, as of refit `calm`
        calm_upper: wp.array2d(dtype=wp.vec3)
        calm: wp.array2d(dtype=wp.int32)
        x0: wp.array2d(dtype=wp.vec3d)  # [world, point] place as the attempt began
        deepest: wp.array2d(dtype=wp.float64)  # [world, body] largest depth of its points in contact then, m
        first: wp.array2d(dtype=wp.int32)  # facet + 1 from which its motion is measured, 0: none yet
        spot0: wp.array2d(dtype=wp.vec3d)  # where it was on that
        stretch: wp.array2d(dtype=wp.vec2d)  # then: gap per coordinate along the outward vector, and its rest, m
        seat: wp.array2d(dtype=wp.int32)  # master facet at the iterate, -1: none; -2: went through
        spot: wp.array2d(dtype=wp.vec3d)
        foot: wp.array2d(dtype=wp.vec3d)  # coordinates of the closest place on the facet
        depth: wp.array2d(dtype=wp.float64)
        before: wp.array2d(dtype=wp.float64)  # depth as the attempt began
        normal: wp.array2d(dtype=wp.vec3d)  # of the facet there, minus the derivative of the depth by the place
        motion: wp.array2d(dtype=wp.vec3d)  # in the step, relative to the master's material
        whole: wp.array2d(dtype=wp.vec3d)  # that and the friction spring
        weight: wp.array3d(dtype=T)  # [world, point, local] functions of the master's slots at the foot
        slope: wp.array3d(dtype=vec2)  # their derivatives by the coordinates of the foot
        lean: wp.array3d(dtype=vec3)  # [world, point, 2] what a turn of the facet does to the force, see `lean_on`
        bend: wp.array2d(dtype=sym)  # and its own turn and curvature
        turned: wp.array2d(dtype=vec2)  # [world, point] of a product, what turns the facet
        held_weight: wp.array3d(dtype=T)  # functions that friction acts by, held with its cap
        held_motion: wp.array2d(dtype=wp.vec3d)
        held_whole: wp.array2d(dtype=wp.vec3d)  # that and the spring, as they were taken
        held_shift: wp.array2d(dtype=wp.vec3d)  # relative displacement by these functions then
        held_facet: wp.array2d(dtype=wp.int32)
        friction: wp.array2d(dtype=wp.vec3d)  # part of a point's force that acts by them, N
        listed: wp.array2d(dtype=wp.int32)  # [world, point] facet + 1 whose list it is in
        changed: wp.array(dtype=wp.int32)  # a point belongs into another list
        count: wp.array(dtype=wp.int32)  # [world facet] of lists in the making
        chunk: wp.array2d(dtype=wp.int32)  # [world, chunk of facets] points before it
        points: wp.array2d(dtype=wp.int32)  # [world, facet] points of its list, which begins at `start`
        start: wp.array2d(dtype=wp.int32)
        entry: wp.array2d(dtype=wp.int32)  # [world, point]

    return Touching
