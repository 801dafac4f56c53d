"""What kernels of contact read and write: contacts and colliders, facets with their points, the present step."""

import functools

import warp as wp

from ..common.types import precision
from .contact_mesh import mesh_struct

__all__ = ["RECORD", "attempt_struct", "clock_struct", "contact_struct", "facet_struct", "history_struct",
           "of_world"]  # fmt: skip

RECORD = ("force_x", "force_y", "force_z", "moment_x", "moment_y", "moment_z", "normal_force", "slip", "area",
          "stick", "stored", "loss", "friction", "collider_work", "penetration")  # fmt: skip
"""What is summed per contact over its points; of the last the largest. Slip and stick are weighted by area."""


@wp.func
def of_world(table: wp.array2d(dtype=wp.float64), world: int, contact: int) -> wp.float64:
    """A number of a contact in a world, from a table [world, contact], or [0, contact] where it is the same in all."""
    return table[world % table.shape[0], contact]


@functools.cache
def contact_struct(meshes: bool):
    """Contacts [contact] and colliders [collider]; `meshes`: with triangles of those that are meshes."""

    class Contacts:
        collider: wp.array(dtype=wp.int32)
        law: wp.array(dtype=wp.int32)
        lumped: wp.array(dtype=wp.int32)  # one contact at the deepest point
        dead: wp.array(dtype=wp.int32)  # the force of the last state
        first: wp.array(dtype=wp.int32)  # [contact + 1] its first point
        normal: wp.array2d(dtype=wp.float64)  # [world or 0, contact] k_n; of lumped contacts over sqrt(delta)
        tangent: wp.array2d(dtype=wp.float64)  # k_t, likewise
        normal_damping: wp.array2d(dtype=wp.float64)  # gamma_n over -beta; of lumped contacts over delta^(1/4)
        mass: wp.array2d(dtype=wp.float64)  # m_eff, kg
        ramp: wp.array(dtype=wp.float64)  # m
        force_eps: wp.array(dtype=wp.float64)  # N
        speed_eps: wp.array(dtype=wp.float64)  # m/s
        offset: wp.array(dtype=wp.float64)  # m
        decay: wp.array(dtype=wp.float64)  # s, over which a stored overlap vanishes
        mu: wp.array2d(dtype=wp.float64)  # [world, contact]
        mu_static: wp.array2d(dtype=wp.float64)
        damping: wp.array2d(dtype=wp.float64)  # d of the default law
        beta: wp.array2d(dtype=wp.float64)  # -beta of Eq. (75)
        scale: wp.array2d(dtype=wp.float64)  # on k_n and k_t
        grow: wp.array2d(dtype=wp.float64)  # [world, collider] m, by which its surface lies further out
        kind: wp.array(dtype=wp.int32)  # [collider]
        size: wp.array(dtype=wp.vec3d)
        center: wp.array(dtype=wp.vec3d)
        axes: wp.array(dtype=wp.mat33d)  # columns
        path: wp.array(dtype=wp.int32)  # time law of its displacement, -1: none
        spin: wp.array(dtype=wp.int32)  # of its angle
        anchor: wp.array(dtype=wp.vec3d)
        axis: wp.array(dtype=wp.vec3d)

    if meshes:
        Contacts.__annotations__["mesh"] = mesh_struct()
    return wp.struct(Contacts)


@functools.cache
def facet_struct(dtype: str):
    """Facets with as many slots and points each."""
    T = precision(dtype).T

    @wp.struct
    class Facets:
        conn: wp.array2d(dtype=wp.int32)  # [local, facet] slot
        shape: wp.array3d(dtype=T)  # [point, local, facet]
        X: wp.array2d(dtype=wp.vec3d)  # [point, facet] reference place
        share: wp.array2d(dtype=wp.float64)  # [point, facet] area over that of the region; 0: no contact
        area: wp.array2d(dtype=wp.float64)  # m^2
        contact: wp.array(dtype=wp.int32)  # [facet]
        pool: wp.int32  # first entry in the pool
        row: wp.int32  # first row of the potential
        point: wp.int32  # first point: [facet, point] are numbered in this order
        count: wp.int32
        points: wp.int32  # of a facet
        moving: wp.int32  # one point acts, where `Attempt.weight` says
        corners: wp.int32
        coords: wp.array(dtype=wp.vec2d)  # [point] on the unit triangle or square; of lumped contacts, as what follows
        basis: wp.array2d(dtype=wp.float64)  # [point, monomial] Lagrange's polynomials of the points
        power: wp.array(dtype=wp.vec2i)  # [monomial] exponents

    return Facets


@functools.cache
def history_struct():
    """What the state keeps: [world, point], of a lumped contact at its first point; [world, collider] of colliders."""

    @wp.struct
    class History:
        angle: wp.array2d(dtype=wp.float64)  # [world, collider] of its rotation, rad
        grown: wp.array2d(dtype=wp.float64)  # `Contacts.grow` of the last step
        spring: wp.array2d(dtype=wp.vec3d)  # stretch of the friction spring, in the collider's frame (paper: world), m
        speed: wp.array2d(dtype=wp.float64)  # largest approach speed since birth, m/s; 0: not in contact
        mark: wp.array2d(dtype=wp.int32)  # side + 1, and SLIPS where it slips; see known_side
        overlap: wp.array2d(dtype=wp.float64)  # stored at the start, m
        cap: wp.array2d(dtype=wp.float64)  # mu F_n of the last step, N over the point's share
        stored: wp.array2d(dtype=wp.float64)  # energy of the contact, J over the point's share
        lead: wp.array2d(dtype=wp.float64)  # of contacts whose place moves: depth at the end of the last step, m
        born: wp.array(dtype=wp.float64)  # [world] time that overlaps were stored at
        posed: wp.array(dtype=wp.float64)  # [world] time that the colliders are at
        place: wp.array2d(dtype=wp.vec3d)  # of colliders
        turn: wp.array2d(dtype=wp.mat33d)

    return History


@functools.cache
def attempt_struct(dtype: str):
    """What an attempt at a step makes."""
    p = precision(dtype)
    T, vec3, sym = p.T, p.vec3, p.sym

    @wp.struct
    class Attempt:
        place: wp.array2d(dtype=wp.vec3d)  # [world, collider] at the end of the step
        turn: wp.array2d(dtype=wp.mat33d)
        shift: wp.array2d(dtype=wp.vec3d)  # [world, collider] by which they move in the attempt
        spin: wp.array2d(dtype=wp.mat33d)  # R - 1, R by which they turn
        angle: wp.array2d(dtype=wp.float64)  # of their rotation, rad
        origin: wp.array2d(dtype=wp.vec3d)  # [world, point] displacement as the attempt began
        reach: wp.array2d(dtype=wp.float64)  # gap at which contact begins, then
        start: wp.array2d(dtype=wp.vec3d)  # [world, point] where it was as the step began, in the collider's frame
        depth: wp.array2d(dtype=wp.float64)  # then
        speed: wp.array2d(dtype=wp.float64)  # that the damping takes
        held: wp.array2d(dtype=wp.vec3d)  # cap, k_t, shrinkage of the spring that a line search holds
        next: wp.array2d(dtype=wp.vec3d)  # those of the iterate
        plane: wp.array2d(dtype=wp.vec3d)  # normal of the plane of friction that is held
        next_plane: wp.array2d(dtype=wp.vec3d)  # that of the iterate
        asked: wp.array2d(dtype=wp.float64)  # change of the cap that the iterate asked for when it was last taken anew
        asked_sums: wp.array2d(dtype=wp.vec4d)  # [world, lane]
        omega: wp.array(dtype=wp.float64)  # [world] part of that change that was made
        asked_size: wp.array(dtype=wp.float64)  # [world] sum of squares of the last change that was asked for
        changes: wp.array(dtype=wp.int32)  # [world] changes in this attempt
        state: wp.array2d(dtype=wp.int32)  # [world, point] whether it has a force
        force: wp.array2d(dtype=wp.vec3d)  # that the point adds to the residual, N, where it has one
        energy: wp.array2d(dtype=wp.vec2d)  # its potential, and the size of what that is made of, J
        stiffness: wp.array2d(dtype=sym)  # derivative of the force, N/m; 0 without
        flux: wp.array2d(dtype=vec3)  # of a product
        touched: wp.array2d(dtype=wp.int32)  # [world, facet row] largest state of its points
        dead: wp.array2d(dtype=wp.vec3d)  # [world, point] explicit force
        dead_spring: wp.array2d(dtype=wp.vec3d)
        level: wp.array2d(dtype=wp.float64)  # [world, point] depth; with lumped contacts
        near: wp.array2d(dtype=wp.int32)  # [world, facet row] deepest point of the facet
        spot: wp.array2d(dtype=wp.vec2d)  # its deepest place
        best: wp.array2d(dtype=wp.float64)  # how deep that is
        pick: wp.array2d(dtype=wp.int32)  # [world, contact] point next to the deepest place, whose entries that uses
        moves: wp.array2d(dtype=wp.int32)  # facet row of a place that has just been chosen, or -1
        weight: wp.array3d(dtype=T)  # [world, contact, local] functions of the place
        middle: wp.array2d(dtype=wp.vec3d)  # [world, contact] its reference place
        picks: wp.array2d(dtype=wp.int32)  # how often it was chosen in the attempt
        through: wp.array(dtype=wp.int32)  # [world] a point that went through a shape, + 1
        rows: wp.array3d(dtype=wp.float64)  # [RECORD, world, facet row]
        total: wp.array3d(dtype=wp.float64)  # [world, contact, RECORD] of the step so far
        elapsed: wp.array(dtype=wp.float64)  # [world] s of the step so far

    return Attempt


@functools.cache
def clock_struct():
    """Times of the substep in hand, [world]."""

    @wp.struct
    class Clock:
        time: wp.array(dtype=wp.float64)  # at its start, s
        new_time: wp.array(dtype=wp.float64)  # at its end
        h: wp.array(dtype=wp.float64)
        part: wp.array(dtype=wp.int32)  # 0: the first of its step
        still: wp.int32  # statics: there are no rates

    return Clock
