"""Structs of the contact kernels: contacts, facets with their points, history, quantities of a step; colliders."""

import functools
from typing import Any, NamedTuple

import warp as wp

from ..common.types import precision
from .collider_mesh import mesh_struct

__all__ = [
    "AREA_ROW",
    "FORCE_ONLY",
    "FREE",
    "INACTIVE",
    "IN_REACH",
    "MOMENT_ROW",
    "NORMAL_ROW",
    "PASSED",
    "PENETRATION_ROW",
    "RECORD_NAMES",
    "SLIP_FLAG",
    "SLIP_ROW",
    "STICK_ROW",
    "STORED_ROW",
    "TURNED",
    "WITH_STIFFNESS",
    "clock_struct",
    "collider_struct",
    "contact_scratch_struct",
    "contact_struct",
    "contact_structs",
    "facet_struct",
    "history_struct",
    "point_contact_struct",
    "world_value",
]  # fmt: skip

RECORD_NAMES = ("force_x", "force_y", "force_z", "moment_x", "moment_y", "moment_z", "normal_force", "slip", "area",
          "stick", "stored", "loss", "friction", "collider_work", "penetration")  # fmt: skip
"""Rows of a contact's record, sums over its points (penetration: maximum). Slip and stick are weighted by area."""
MOMENT_ROW, NORMAL_ROW, SLIP_ROW, AREA_ROW, STICK_ROW, STORED_ROW, PENETRATION_ROW = (
    RECORD_NAMES.index(name) for name in ("moment_x", "normal_force", "slip", "area", "stick", "stored", "penetration")
)

INACTIVE, FORCE_ONLY, WITH_STIFFNESS = 0, 1, 2
"""Activity of a point: no force; a force without tangent; a force with tangent."""
SLIP_FLAG = 1 << 30
"""Bit of a point's contact state: slipping; the bits below are the side of a collider + 1, or 1 on a facet."""
FREE, IN_REACH, PASSED, TURNED = range(4)
"""State of a point: without another side; with one, at a depth of either sign; passed through it; touched by one that
turned too far in the step. Iterates with the last two are refused."""


@wp.func
def world_value(table: wp.array2d(dtype=wp.float64), world: int, contact: int) -> wp.float64:
    """Value of a contact in a world from a table [world, contact], or [0, contact] if uniform."""
    return table[world % table.shape[0], contact]


@functools.cache
def contact_struct():
    """Contacts, [contact], and the constants of their laws."""

    @wp.struct
    class Contacts:
        law: wp.array(dtype=wp.int32)  # number and traits of its law, see `law_code`
        single_point: wp.array(dtype=wp.int32)  # single contact at the deepest point
        is_explicit: wp.array(dtype=wp.int32)  # explicit force of the last state
        first_point: wp.array(dtype=wp.int32)  # [contact + 1] index of its first point
        normal_stiffness: wp.array2d(
            dtype=wp.float64
        )  # [world or 0, contact] k_n, N/m; if single_point over sqrt(delta)
        tangential_stiffness: wp.array2d(dtype=wp.float64)  # k_t, N/m; if single_point over sqrt(delta)
        normal_damping: wp.array2d(dtype=wp.float64)  # gamma_n over -beta; if single_point over delta^(1/4)
        effective_mass: wp.array2d(dtype=wp.float64)  # m_eff, kg
        damping_ramp: wp.array(dtype=wp.float64)  # depth over which the damping grows, law "paper", m
        force_eps: wp.array(dtype=wp.float64)  # smoothing of the normal force, law "smooth", N
        speed_eps: wp.array(dtype=wp.float64)  # smoothing of friction, law "smooth", m/s
        offset: wp.array(dtype=wp.float64)  # gap at which contact begins, m
        overlap_decay_time: wp.array(dtype=wp.float64)  # s, over which a stored overlap vanishes
        mu: wp.array2d(dtype=wp.float64)  # [world, contact]
        mu_static: wp.array2d(dtype=wp.float64)
        damping: wp.array2d(dtype=wp.float64)  # d of the default law
        beta: wp.array2d(dtype=wp.float64)  # -beta of Eq. (75)
        scale: wp.array2d(dtype=wp.float64)  # factor on k_n and k_t
        compliance: wp.array2d(dtype=wp.vec3d)  # [world or 0, contact] see `stiffness_ratio` of kinematics.py

    return Contacts


@functools.cache
def point_contact_struct():
    """The record of a point, between the geometry of the other side and the law."""

    @wp.struct
    class PointContact:
        """A point of a surface against its other side at an iterate; forces are of the whole region.

        A geometry (collider_kinematics.py, facet_kinematics.py) fills the first part, the law (friction.py) the second.
        Weights of slots vary in number and lie in arrays: those of the point's own side in `Facets.shape` (moving
        contact point: `ContactScratch.shape_values`), those of the other side in `PairScratch.shape_values` and
        `friction_shape`; a collider has none. An edge or a vertex as the other side fills the same record, with its
        nearest position and the weights of its slots; a moving shape gives its motion by `carried`; a dynamic part, or
        the body of the point itself, has slots and weights as facets have.
        """

        state: wp.int32  # FREE, IN_REACH, PASSED or TURNED
        feature: wp.int32  # facet of the other side; of a collider the side through which the point has entered, -1:
        # any or none, -2: it passed through
        position: wp.vec3d  # m
        local_position: wp.vec3d  # in the collider's frame, m
        normal: wp.vec3d  # outward unit normal of the other side; -d(depth)/d(position)
        depth: wp.float64  # minus the gap beyond the activation gap, m
        previous_depth: wp.float64  # at the start of the step, m; of a moving contact point, that of the one before
        relative_motion: wp.vec3d  # in the step, relative to the other side's material, m
        spring: wp.vec3d  # stored elastic slip, turned with the other side, m
        stiffness_ratio: wp.float64  # of the point's stiffness, over its area, to the contact's

        normal_values: wp.vec4d  # normal force, its derivative, its potential, the magnitude of the potential's terms
        friction_normal: wp.vec3d  # normal of the plane of friction
        tangential_motion: wp.vec3d  # tangential part of `relative_motion`, m
        trial_elastic_slip: wp.vec3d  # tangential part of `spring` plus `relative_motion`, m

    return PointContact


@functools.cache
def facet_struct(dtype: str):
    """Facets with equal numbers of slots and points."""
    T = precision(dtype).T

    @wp.struct
    class Facets:
        conn: wp.array2d(dtype=wp.int32)  # [local, facet] slot
        shape: wp.array3d(dtype=T)  # [point, local, facet] shape function values
        X: wp.array2d(dtype=wp.vec3d)  # [point, facet] reference position, m
        area_fraction: wp.array2d(dtype=wp.float64)  # [point, facet] fraction of the area of the region; 0: no contact
        area: wp.array2d(dtype=wp.float64)  # m^2
        contact: wp.array(dtype=wp.int32)  # [facet]
        element_depth: wp.array(dtype=wp.float64)  # [facet] of the element behind it, m
        corners: wp.array(dtype=wp.vec3i)  # [facet] three of its points, whose cross product is outward, or -1
        first_entry: wp.int32  # first entry in the pool of terms
        first_row: wp.int32  # first row of the potential
        first_point: wp.int32  # first point: [facet, point] are numbered in this order
        facet_count: wp.int32
        point_count: wp.int32  # number of points of a facet
        tracks_deepest: wp.int32  # a single point acts, with the shape values `ContactScratch.shape_values`
        corner_count: wp.int32
        point_coords: wp.array(
            dtype=wp.vec2d
        )  # [point] on the unit triangle or square; with the next two: lumped contacts
        lagrange_coefficients: wp.array2d(dtype=wp.float64)  # [point, monomial] Lagrange polynomials of the points
        exponents: wp.array(dtype=wp.vec2i)  # [monomial] exponents
        edge_rows: wp.int32  # number of rows of points on sharp edges, which move along them, and of rolling points
        edge_row: wp.array(dtype=wp.int32)  # [facet] number among them, or -1
        edge_shape: wp.array3d(dtype=T)  # [point, local, column - facet_count] shape values, see `column`
        edge_X: wp.array2d(dtype=wp.vec3d)  # [point, column - facet_count] reference position, m
        rolling_axis: wp.array(dtype=wp.vec4d)  # [edge row] axis of a round part, and its radius, m; see rolling.py
        rolling_end: wp.array2d(dtype=wp.float64)  # [point, edge row] 1, -1: centre of a ball at an end; 0: of a circle
        rolling_gradient: wp.array2d(dtype=wp.vec3d)  # [local, edge row] of the shape functions, 1/m

    return Facets


@functools.cache
def history_struct():
    """Contact history in the state: [world, point], of a lumped contact at its first point."""

    @wp.struct
    class History:
        spring: wp.array2d(dtype=wp.vec3d)  # elastic slip: displacement of the friction spring, in the collider's or
        # facet's frame (law "paper": world), m
        speed: wp.array2d(dtype=wp.float64)  # largest approach speed since contact began, m/s; 0: not in contact
        contact_state: wp.array2d(dtype=wp.int32)  # side + 1, plus SLIP_FLAG if slipping; see stored_side
        overlap: wp.array2d(dtype=wp.float64)  # initial overlap, m
        friction_limit: wp.array2d(dtype=wp.float64)  # mu F_n of the last step, N over the point's area fraction
        stored: wp.array2d(dtype=wp.float64)  # energy of the contact, J over the point's area fraction
        previous_depth: wp.array2d(dtype=wp.float64)  # of moving contact points: depth at the end of the last step, m
        overlap_time: wp.array(dtype=wp.float64)  # [world] time at which overlaps were stored, s
        pose_time: wp.array(dtype=wp.float64)  # [world] time of the collider poses, s

    return History


@functools.cache
def contact_scratch_struct(dtype: str):
    """Contact quantities of an attempt at a step."""
    p = precision(dtype)
    T, vec3, sym = p.T, p.vec3, p.sym

    @wp.struct
    class ContactScratch:
        start_displacement: wp.array2d(dtype=wp.vec3d)  # [world, point] displacement at the start of the attempt, m
        activation_gap: wp.array2d(dtype=wp.float64)  # gap at which contact begins, at the start of the attempt, m
        start_position: wp.array2d(
            dtype=wp.vec3d
        )  # [world, point] position at the start of the attempt, m; in a collider's frame
        start_depth: wp.array2d(dtype=wp.float64)  # depth at the start of the step, m
        approach_speed: wp.array2d(dtype=wp.float64)  # approach speed of the damping, m/s
        frozen_friction: wp.array2d(dtype=wp.vec3d)  # friction limit, N, k_t, N/m, factor on the stored elastic slip
        # (new in contact: on the motion); frozen in a line search
        updated_friction: wp.array2d(dtype=wp.vec3d)  # the same three at the iterate
        frozen_normal: wp.array2d(dtype=wp.vec3d)  # frozen normal of the plane of friction
        updated_normal: wp.array2d(dtype=wp.vec3d)  # normal of the plane of friction at the iterate
        predicted_friction: wp.array2d(dtype=wp.vec3d)  # friction after the last Newton step as its linear system has
        # it, on the residual, over the friction limit
        aitken_residual: wp.array2d(dtype=wp.float64)  # r, change of the friction limit at its last update
        aitken_sums: wp.array2d(dtype=wp.vec4d)  # [world, lane]
        relaxation: wp.array(dtype=wp.float64)  # [world] relaxation factor
        aitken_norm2: wp.array(dtype=wp.float64)  # [world] sum of squares of the last r
        limit_updates: wp.array(dtype=wp.int32)  # [world] updates in this attempt
        most_part_change: wp.array(dtype=wp.float64)  # [world] of the factor on the motion of a point new in contact
        activity: wp.array2d(dtype=wp.int32)  # [world, point] INACTIVE, FORCE_ONLY or WITH_STIFFNESS
        force: wp.array2d(dtype=wp.vec3d)  # on the residual, N, unless INACTIVE
        energy: wp.array2d(dtype=wp.vec2d)  # potential, and the magnitude of its terms, J
        stiffness: wp.array2d(dtype=sym)  # derivative of the force, N/m; 0 unless WITH_STIFFNESS
        point_product: wp.array2d(dtype=vec3)  # stiffness times the displacement of the point in a product, N
        facet_activity: wp.array2d(dtype=wp.int32)  # [world, facet row] largest activity of its points
        explicit_force: wp.array2d(dtype=wp.vec3d)  # [world, point] force of the last state, N
        explicit_elastic_slip: wp.array2d(dtype=wp.vec3d)  # elastic slip with it, m
        point_depth: wp.array2d(dtype=wp.float64)  # [world, point] depth; with lumped contacts
        facet_deepest_point: wp.array2d(dtype=wp.int32)  # [world, facet row] its deepest quadrature point
        facet_deepest_xi: wp.array2d(dtype=wp.vec2d)  # coordinates of its deepest position
        facet_max_depth: wp.array2d(dtype=wp.float64)  # depth there, m
        contact_point: wp.array2d(
            dtype=wp.int32
        )  # [world, contact] point nearest to the deepest position; provides its entries
        chosen_facet: wp.array2d(dtype=wp.int32)  # facet row of a newly chosen contact point, or -1
        shape_values: wp.array3d(dtype=T)  # [world, contact, local] shape values at the contact point
        point_reference: wp.array2d(dtype=wp.vec3d)  # [world, contact] its reference position, m
        choice_count: wp.array2d(dtype=wp.int32)  # number of choices of a contact point in the attempt
        passed_point: wp.array(
            dtype=wp.int32
        )  # [world] 1 + point that passed through a collider; -1 - point touched by
        # a collider that rotated too far; 0: none
        record_rows: wp.array3d(dtype=wp.float64)  # [RECORD_NAMES, world, facet row] of the substep
        record_totals: wp.array3d(dtype=wp.float64)  # [world, contact, RECORD_NAMES] of the step so far
        elapsed_time: wp.array(dtype=wp.float64)  # [world] duration of the accepted substeps of the step, s
        penalty_factor: wp.array(dtype=wp.float64)  # [world] factor on the stiffness, of Newton's method

    return ContactScratch


@functools.cache
def collider_struct(meshes: bool):
    """Colliders as the other side: shapes, poses in the state and in an attempt; `meshes`: with their triangles."""

    class Colliders:
        of_contact: wp.array(dtype=wp.int32)  # [contact] index of its collider
        kind: wp.array(dtype=wp.int32)  # [collider] HALF_SPACE to CYLINDER, or MESH
        size: wp.array(dtype=wp.vec3d)  # see `shape_functions` and `mesh_functions`, m
        center: wp.array(dtype=wp.vec3d)  # initial position, m
        axes: wp.array(dtype=wp.mat33d)  # initial axes as columns
        translation_law: wp.array(dtype=wp.int32)  # time law of its displacement, -1: none
        rotation_law: wp.array(dtype=wp.int32)  # time law of its angle, -1: none
        rotation_anchor: wp.array(dtype=wp.vec3d)  # point on the axis of rotation, m
        rotation_axis: wp.array(dtype=wp.vec3d)  # unit vector
        margin: wp.array2d(dtype=wp.float64)  # [world, collider] outward offset of its surface, m
        previous_position: wp.array2d(dtype=wp.vec3d)  # in the state: at the start of the step, m
        previous_rotation: wp.array2d(dtype=wp.mat33d)
        previous_angle: wp.array2d(dtype=wp.float64)  # rad
        previous_margin: wp.array2d(dtype=wp.float64)  # m
        position: wp.array2d(dtype=wp.vec3d)  # at the end of the attempt, m
        rotation: wp.array2d(dtype=wp.mat33d)
        angle: wp.array2d(dtype=wp.float64)  # rad
        translation: wp.array2d(dtype=wp.vec3d)  # in the attempt, m
        rotation_change: wp.array2d(dtype=wp.mat33d)  # R - 1 of the rotation R in the attempt
        deepest: wp.array3d(dtype=wp.float64)  # [world, collider, 6] largest depth of points by sides that face along
        # -x, x, -y, y, -z, z of its axes, at the start of the attempt, m
        neighbor_start: wp.array(dtype=wp.int32)  # [contact + 1] its first neighbour; with the next three: seams
        neighbor: wp.array(dtype=wp.int32)  # collider; -1: flexible bodies
        neighbor_shares: wp.array(dtype=wp.int32)  # 1: the body's contact with it has the same points
        seam_lengths: wp.array(dtype=wp.vec3d)  # [contact] seam, reach, depth, see collider_seams.py, m
        body_level: wp.array2d(dtype=wp.vec4d)  # [world, point] normal of the neighbouring body's surface, and height
        # above it at the start of the attempt, m; 0: none

    if meshes:
        Colliders.__annotations__["mesh"] = mesh_struct()
    return wp.struct(Colliders)


@functools.cache
def clock_struct():
    """Times of the current substep, [world]."""

    @wp.struct
    class Clock:
        time: wp.array(dtype=wp.float64)  # at its start, s
        new_time: wp.array(dtype=wp.float64)  # at its end
        h: wp.array(dtype=wp.float64)  # its length, s
        substep_index: wp.array(dtype=wp.int32)  # index of the substep; 0: first of the step
        is_static: wp.int32  # 1 in statics: no rates

    return Clock


class ContactStructs(NamedTuple):
    """Structs of all kernels of contact."""

    Contacts: Any
    Facets: Any
    History: Any
    ContactScratch: Any
    Clock: Any
    PointContact: Any


@functools.cache
def contact_structs(dtype: str) -> ContactStructs:
    """The structs in one precision of the displacements."""
    own = (facet_struct(dtype), history_struct(), contact_scratch_struct(dtype))
    return ContactStructs(contact_struct(), *own, clock_struct(), point_contact_struct())
