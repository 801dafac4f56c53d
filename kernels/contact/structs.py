"""Structs of the contact kernels: contacts and colliders, facets with their points, history, quantities of a step."""

import functools

import warp as wp

from ..common.types import precision
from .collider_mesh import mesh_struct

__all__ = [
    "AREA_ROW",
    "MOMENT_ROW",
    "NORMAL_ROW",
    "PENETRATION_ROW",
    "RECORD_NAMES",
    "SLIP_ROW",
    "STICK_ROW",
    "STORED_ROW",
    "clock_struct",
    "contact_scratch_struct",
    "contact_struct",
    "facet_struct",
    "history_struct",
    "world_value",
]  # fmt: skip

RECORD_NAMES = ("force_x", "force_y", "force_z", "moment_x", "moment_y", "moment_z", "normal_force", "slip", "area",
          "stick", "stored", "loss", "friction", "collider_work", "penetration")  # fmt: skip
"""Rows of a contact's record, sums over its points (penetration: maximum). Slip and stick are weighted by area."""
MOMENT_ROW, NORMAL_ROW, SLIP_ROW, AREA_ROW, STICK_ROW, STORED_ROW, PENETRATION_ROW = (
    RECORD_NAMES.index(name) for name in ("moment_x", "normal_force", "slip", "area", "stick", "stored", "penetration")
)


@wp.func
def world_value(table: wp.array2d(dtype=wp.float64), world: int, contact: int) -> wp.float64:
    """Value of a contact in a world from a table [world, contact], or [0, contact] if uniform."""
    return table[world % table.shape[0], contact]


@functools.cache
def contact_struct(meshes: bool):
    """Contacts [contact] and colliders [collider]; `meshes`: with the triangles of mesh colliders."""

    class Contacts:
        collider: wp.array(dtype=wp.int32)  # [contact] index of its collider
        law: wp.array(dtype=wp.int32)  # DEFAULT, PAPER or SMOOTH
        single_point: wp.array(dtype=wp.int32)  # single contact at the deepest point
        is_explicit: wp.array(dtype=wp.int32)  # explicit force of the last state
        first_point: wp.array(dtype=wp.int32)  # [contact + 1] index of its first point
        normal_stiffness: wp.array2d(
            dtype=wp.float64
        )  # [world or 0, contact] k_n, N/m; if single_point over sqrt(delta)
        tangential_stiffness: wp.array2d(dtype=wp.float64)  # k_t, N/m; if single_point over sqrt(delta)
        normal_damping: wp.array2d(dtype=wp.float64)  # gamma_n over -beta; if single_point over delta^(1/4)
        effective_mass: wp.array2d(dtype=wp.float64)  # m_eff, kg
        damping_ramp: wp.array(dtype=wp.float64)  # depth over which the damping grows, law PAPER, m
        force_eps: wp.array(dtype=wp.float64)  # smoothing of the normal force, law SMOOTH, N
        speed_eps: wp.array(dtype=wp.float64)  # smoothing of friction, law SMOOTH, m/s
        offset: wp.array(dtype=wp.float64)  # gap at which contact begins, m
        overlap_decay_time: wp.array(dtype=wp.float64)  # s, over which a stored overlap vanishes
        mu: wp.array2d(dtype=wp.float64)  # [world, contact]
        mu_static: wp.array2d(dtype=wp.float64)
        damping: wp.array2d(dtype=wp.float64)  # d of the default law
        beta: wp.array2d(dtype=wp.float64)  # -beta of Eq. (75)
        scale: wp.array2d(dtype=wp.float64)  # factor on k_n and k_t
        margin: wp.array2d(dtype=wp.float64)  # [world, collider] m, outward offset of its surface
        collider_kind: wp.array(dtype=wp.int32)  # [collider] HALF_SPACE to CYLINDER, or MESH
        collider_size: wp.array(dtype=wp.vec3d)  # see `contact_shapes` and `mesh_functions`, m
        collider_center: wp.array(dtype=wp.vec3d)  # initial position, m
        collider_axes: wp.array(dtype=wp.mat33d)  # initial axes as columns
        translation_law: wp.array(dtype=wp.int32)  # time law of its displacement, -1: none
        rotation_law: wp.array(dtype=wp.int32)  # time law of its angle, -1: none
        rotation_anchor: wp.array(dtype=wp.vec3d)  # point on the axis of rotation, m
        rotation_axis: wp.array(dtype=wp.vec3d)  # unit vector

    if meshes:
        Contacts.__annotations__["mesh"] = mesh_struct()
    return wp.struct(Contacts)


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

    return Facets


@functools.cache
def history_struct():
    """Contact history in the state: [world, point], of a lumped contact at its first point; [world, collider] of
    colliders."""

    @wp.struct
    class History:
        angle: wp.array2d(dtype=wp.float64)  # [world, collider] of its rotation, rad
        previous_margin: wp.array2d(dtype=wp.float64)  # `Contacts.margin` of the last step, m
        spring: wp.array2d(dtype=wp.vec3d)  # elastic slip: displacement of the friction spring, in the collider's or
        # facet's frame (law PAPER: world), m
        speed: wp.array2d(dtype=wp.float64)  # largest approach speed since contact began, m/s; 0: not in contact
        contact_state: wp.array2d(dtype=wp.int32)  # side + 1, plus SLIP_FLAG if slipping; see stored_side
        overlap: wp.array2d(dtype=wp.float64)  # initial overlap, m
        friction_limit: wp.array2d(dtype=wp.float64)  # mu F_n of the last step, N over the point's area fraction
        stored: wp.array2d(dtype=wp.float64)  # energy of the contact, J over the point's area fraction
        previous_depth: wp.array2d(dtype=wp.float64)  # of moving contact points: depth at the end of the last step, m
        overlap_time: wp.array(dtype=wp.float64)  # [world] time at which overlaps were stored, s
        pose_time: wp.array(dtype=wp.float64)  # [world] time of the collider poses, s
        position: wp.array2d(dtype=wp.vec3d)  # position of colliders, m
        rotation: wp.array2d(dtype=wp.mat33d)

    return History


@functools.cache
def contact_scratch_struct(dtype: str):
    """Contact quantities of an attempt at a step."""
    p = precision(dtype)
    T, vec3, sym = p.T, p.vec3, p.sym

    @wp.struct
    class ContactScratch:
        collider_position: wp.array2d(dtype=wp.vec3d)  # [world, collider] position at the end of the step, m
        collider_rotation: wp.array2d(dtype=wp.mat33d)
        collider_translation: wp.array2d(dtype=wp.vec3d)  # [world, collider] translation in the attempt, m
        collider_rotation_change: wp.array2d(dtype=wp.mat33d)  # R - 1 of the rotation R in the attempt
        collider_angle: wp.array2d(dtype=wp.float64)  # rotation angle, rad
        start_displacement: wp.array2d(dtype=wp.vec3d)  # [world, point] displacement at the start of the attempt, m
        activation_gap: wp.array2d(dtype=wp.float64)  # gap at which contact begins, at the start of the attempt, m
        start_position: wp.array2d(
            dtype=wp.vec3d
        )  # [world, point] position at the start of the step in the collider's frame, m
        start_depth: wp.array2d(dtype=wp.float64)  # depth at the start of the step, m
        approach_speed: wp.array2d(dtype=wp.float64)  # approach speed of the damping, m/s
        frozen_friction: wp.array2d(dtype=wp.vec3d)  # friction limit, N, k_t, N/m, factor on the stored elastic slip;
        # frozen in a line search
        updated_friction: wp.array2d(dtype=wp.vec3d)  # the same three at the iterate
        frozen_normal: wp.array2d(dtype=wp.vec3d)  # frozen normal of the plane of friction
        updated_normal: wp.array2d(dtype=wp.vec3d)  # normal of the plane of friction at the iterate
        aitken_residual: wp.array2d(dtype=wp.float64)  # r, change of the friction limit at its last update
        aitken_sums: wp.array2d(dtype=wp.vec4d)  # [world, lane]
        relaxation: wp.array(dtype=wp.float64)  # [world] relaxation factor
        aitken_norm2: wp.array(dtype=wp.float64)  # [world] sum of squares of the last r
        limit_updates: wp.array(dtype=wp.int32)  # [world] updates in this attempt
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

    return ContactScratch


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
