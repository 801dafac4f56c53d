"""Structs of contact between bodies, in addition to those of contact with obstacles."""

import functools

import warp as wp

from ..common.types import precision

__all__ = [
    "EDGES",
    "edge_struct",
    "facet_field_struct",
    "facet_side_struct",
    "master_struct",
    "pair_history_struct",
    "pair_scratch_struct",
    "point_list_struct",
]

EDGES = 2
"""`one_sided` of points on edges."""


@functools.cache
def master_struct(dtype: str):
    """Facets of master surfaces: positions are polynomials of two coordinates s, linear along an outward vector.

    x(s, z) = sum_m s^m ((X_m + sum_i shape_mi u_i) + z (N_m + sum_i director_shape_mi u_i)), X and N the coefficients
    of the reference position and of the outward vector, the director: a material vector mapped by the deformation
    gradient, so that a point near a surface depends on one element only.
    """
    T = precision(dtype).T

    @wp.struct
    class Masters:
        tree: wp.uint64  # bounding-box tree of [world, facet], grouped by world and surface
        surface_of: wp.array(dtype=wp.int32)  # [contact] its master surface
        sign: wp.array(dtype=wp.int32)  # [contact] -1 where the points belong to the second side
        one_sided: wp.array(dtype=wp.int32)  # [contact] above 0: points touch facets that face theirs; EDGES: within
        bodies: wp.array(dtype=wp.vec2i)  # [contact] of the points (of an obstacle: of the facets) and of the facets,
        # numbered among bodies with facets or points
        surface_count: wp.int32  # number of master surfaces
        touch_depth: wp.float64  # depth at the start of a step that counts as contact, m
        max_monomials: wp.int32  # maximum number of monomials of a facet
        conn: wp.array2d(dtype=wp.int32)  # [local, facet] slot
        shape: wp.array3d(dtype=T)  # [monomial, local, facet] coefficients of the shape functions on the facet
        director_shape: wp.array3d(dtype=T)  # coefficients of their derivatives along the director, 1/m
        reference_position_coefficients: wp.array2d(dtype=wp.vec3d)  # [monomial, facet] X_m, m
        reference_director_coefficients: wp.array2d(dtype=wp.vec3d)  # [monomial, facet] N_m
        facet_kind: wp.array(dtype=wp.int32)  # [facet] kind: number of corners and degree
        monomial_count: wp.array(dtype=wp.int32)  # [kind] number of monomials
        corner_count: wp.array(dtype=wp.int32)  # [kind] 3 or 4
        exponents: wp.array2d(dtype=wp.vec2i)  # [kind, monomial] exponents
        hull_coefficients: wp.array3d(
            dtype=wp.float64
        )  # [kind, point, monomial] Bernstein control points: their hull contains the facet
        element_depth: wp.array(dtype=wp.float64)  # [facet] of the element behind it, m
        depth_limit: wp.array(
            dtype=wp.float64
        )  # [facet] depth beyond which a point would leave through the opposite side, m
        side_length: wp.array(dtype=wp.float64)  # [facet] length of a side, m
        surface: wp.array(dtype=wp.int32)  # [facet] its master surface
        half_angle: wp.array2d(dtype=wp.float64)  # [side, facet] between the normals at a sharp edge, 0: none, rad
        first_entry: wp.int32  # first entry in the pool of terms
        facet_count: wp.int32
        carrier: wp.array(dtype=wp.int32)  # [contact] obstacle that moves its points, see carriers.py; -1: none
        carrier_law: wp.array(dtype=wp.int32)  # [carrier] time law of its displacement, m, or of its angle, rad
        carrier_turns: wp.array(dtype=wp.int32)  # 1: of its angle
        carrier_anchor: wp.array(dtype=wp.vec3d)  # point on the axis of its rotation, m
        carrier_axis: wp.array(dtype=wp.vec3d)
        # rows of seams: twice the contact, + 1 for the side of the points; see facet_seams.py
        neighbor_start: wp.array(dtype=wp.int32)  # [row] first neighbour
        neighbor: wp.array(dtype=wp.int32)  # surfaces
        seam_surface: wp.array(dtype=wp.int32)  # [row] surface of the side itself
        seam_lengths: wp.array(dtype=wp.vec3d)  # [row] `seam`, reach and depth, m

    return Masters


@functools.cache
def edge_struct(dtype: str):
    """Sharp edges of slave facets, as cubics of a place t from 0 to 1, see edges.py."""
    T = precision(dtype).T

    @wp.struct
    class Edges:
        row: wp.array(dtype=wp.int32)  # [edge] row of its point among the facets of its group
        number: wp.array(dtype=wp.int32)  # number among the points of that row
        owner: wp.array(dtype=wp.int32)  # row of the facet that it is a side of; -1: of several
        half_angle: wp.array(dtype=wp.float64)  # between the normals of both facets, rad
        shape: wp.array4d(dtype=T)  # [0: position, 1: vector into the facet; power of t, local, edge]
        X: wp.array3d(dtype=wp.vec3d)  # [0 or 1, power of t, edge] in the reference, m
        edge_count: wp.int32

    return Edges


@functools.cache
def pair_history_struct():
    """Pair history in the state beside `History`, [world, point]."""

    @wp.struct
    class PairHistory:
        facet: wp.array2d(dtype=wp.int32)  # master facet in contact + 1; 0: none
        xi: wp.array2d(dtype=wp.vec3d)  # its coordinates, and m along the outward vector
        carried: wp.array2d(dtype=wp.vec4d)  # [world, carrier] value of its law, and 1: known

    return PairHistory


@functools.cache
def facet_field_struct():
    """Displacements on master facets as polynomials, [world, control], m: monomial m of facet f is control
    `max_monomials f + m`."""

    @wp.struct
    class FacetField:
        value: wp.array2d(dtype=wp.vec3d)  # sum_i shape_mi u_i
        director: wp.array2d(dtype=wp.vec3d)  # sum_i director_shape_mi u_i

    return FacetField


@functools.cache
def pair_scratch_struct(dtype: str):
    """Pair quantities of an attempt."""
    p = precision(dtype)
    T, vec3, vec2, sym = p.T, p.vec3, p.vec2, p.sym
    mat43 = wp.types.matrix(shape=(4, 3), dtype=wp.float64)

    @wp.struct
    class PairScratch:
        displacement: facet_field_struct()  # at the iterate
        start_displacement: facet_field_struct()  # at the start of the attempt
        middle_displacement: facet_field_struct()  # in the middle of the step, in midpoint schemes
        start_velocity: wp.array2d(dtype=wp.vec3d)  # [world, control] sum_i shape_mi v_i then, m/s
        facet_centre: wp.array2d(dtype=mat43)  # [world, facet] centre and derivatives, rows as of a FacetPoint
        bulge: wp.array2d(dtype=wp.float64)  # [world, facet] largest height above the tangent plane at the centre, m
        start_facet_centre: wp.array2d(dtype=mat43)  # at the start of the attempt
        box_lower: wp.array(dtype=wp.vec3)  # [world facet] boxes of the tree
        box_upper: wp.array(dtype=wp.vec3)
        refit_lower: wp.array(dtype=wp.vec3)
        refit_upper: wp.array(dtype=wp.vec3)
        refit_needed: wp.array(dtype=wp.int32)  # a facet has left its box
        refit_count: wp.array(dtype=wp.int32)  # number of refits so far
        in_reach: wp.array2d(dtype=wp.int32)  # [world, facet row of the slaves] 1 if a master surface is within reach
        empty_box_lower: wp.array2d(dtype=wp.vec3)  # box without master facets, valid for refit `empty_box_refit`
        empty_box_upper: wp.array2d(dtype=wp.vec3)
        empty_box_refit: wp.array2d(dtype=wp.int32)
        deepest_contact: wp.array2d(
            dtype=wp.float64
        )  # [world, body] largest depth of its points in contact at the start, m
        anchor_facet: wp.array2d(dtype=wp.int32)  # facet + 1 that its motion is relative to; 0: not yet set
        anchor_xi: wp.array2d(dtype=wp.vec3d)  # start coordinates on that facet
        anchor_gap: wp.array2d(dtype=wp.vec2d)  # start value of (gap_slope, gap_offset), see Projection
        facet: wp.array2d(dtype=wp.int32)  # master facet at the iterate, -1: none; -2: penetrated completely
        xi: wp.array2d(dtype=wp.vec3d)
        friction_xi: wp.array2d(dtype=wp.vec3d)  # coordinates where friction acts: `xi`, in midpoint schemes halfway
        projection: wp.array2d(dtype=wp.vec3d)  # coordinates of the projection on the facet
        depth: wp.array2d(dtype=wp.float64)
        initial_depth: wp.array2d(dtype=wp.float64)  # depth at the start of the attempt, m
        normal: wp.array2d(dtype=wp.vec3d)  # unit normal of the facet there; -d(depth)/d(position)
        relative_motion: wp.array2d(dtype=wp.vec3d)  # in the step, relative to the master's material, m
        spring: wp.array2d(dtype=wp.vec3d)  # stored elastic slip, turned with the facet, m
        shape_values: wp.array3d(dtype=T)  # [world, point, local] shape values of the master's slots at the projection
        shape_gradient: wp.array3d(dtype=vec2)  # their derivatives by the facet coordinates
        geometric_tangent: wp.array3d(
            dtype=vec3
        )  # [world, point, 2] geometric stiffness by rotation of the facet, see `set_geometric_stiffness`
        geometric_curvature: wp.array2d(dtype=sym)  # geometric stiffness by change of the projection and by curvature
        facet_rotation: wp.array2d(
            dtype=vec2
        )  # [world, point] change of the facet's inclination by the direction of a product
        friction_shape: wp.array3d(dtype=T)  # shape values of friction, frozen with the friction limit
        frozen_motion: wp.array2d(dtype=wp.vec3d)
        frozen_spring: wp.array2d(dtype=wp.vec3d)  # `spring` at freezing, m
        frozen_displacement: wp.array2d(
            dtype=wp.vec3d
        )  # relative displacement by the frozen shape values at freezing, m
        frozen_facet: wp.array2d(dtype=wp.int32)
        tangential_force: wp.array2d(dtype=wp.vec3d)  # friction part of a point's force, N
        listed_facet: wp.array2d(dtype=wp.int32)  # [world, point] facet + 1 of the list that contains it
        lists_changed: wp.array(dtype=wp.int32)  # 1 if some point belongs to another list
        list_count: wp.array(dtype=wp.int32)  # [world facet] point counts during list construction
        chunk_offset: wp.array2d(dtype=wp.int32)  # [world, chunk of facets] number of preceding points
        list_size: wp.array2d(
            dtype=wp.int32
        )  # [world, facet] number of points in its list, which begins at `list_start`
        list_start: wp.array2d(dtype=wp.int32)
        list_point: wp.array2d(dtype=wp.int32)  # [world, point]
        carried_shift: wp.array3d(dtype=wp.vec3d)  # [start or end of the attempt, world, carrier] m; with the next: the
        # displacement of a place x of an obstacle is shift + turn (x - anchor)
        carried_turn: wp.array3d(dtype=wp.mat33d)
        carried_value: wp.array2d(dtype=wp.vec4d)  # [world, carrier] `PairHistory.carried` at the end
        carried_angle: wp.array2d(dtype=wp.float64)  # rotation in the attempt, rad

    return PairScratch


@functools.cache
def facet_side_struct(dtype: str):
    """Facets of bodies as the other side."""

    @wp.struct
    class FacetSide:
        masters: master_struct(dtype)
        history: pair_history_struct()
        scratch: pair_scratch_struct(dtype)

    return FacetSide


@functools.cache
def point_list_struct():
    """Points of master facets, as stored with a preconditioner; see `PairScratch`."""

    @wp.struct
    class PointLists:
        list_size: wp.array2d(dtype=wp.int32)  # [world, facet]
        list_start: wp.array2d(dtype=wp.int32)
        list_point: wp.array2d(dtype=wp.int32)  # [world, position in the lists]

    return PointLists
