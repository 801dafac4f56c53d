"""Adjoint of contact with facets: bars of the points, and of their facet points, which are gathered on the slots.

The geometry of a point is differentiated in facet_derivatives.py, its laws in adjoint.py.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import f64, int_1d, precision, vec3d
from .adjoint import contact_adjoint_functions, contact_adjoint_struct, force_bars_struct
from .facet_derivatives import facet_adjoint_functions
from .facet_kinematics import facet_kinematics
from .facet_structs import facet_side_struct, point_list_struct
from .kinematics import kinematics_functions
from .law import ANY_GAP, FIXED_SPRING, MIN_APPROACH_SPEED, OwnLaws, law_names
from .projection import facet_projection_functions
from .structs import IN_REACH, WITH_STIFFNESS, contact_structs

__all__ = ["FACET_POINTS", "adjoint_fields_struct", "facet_adjoint_kernels", "facet_adjoint_struct"]

FACET_POINTS = 3
"""Facet points of a point that have bars: at the end its projection, its coordinates and the anchor; at the start the
anchor, the projection then, and the anchor's velocity."""


@functools.cache
def facet_adjoint_struct():
    """Bars of facet points, [world, point, facet point], with the coordinates that they belong to."""

    @wp.struct
    class FacetBars:
        coordinates: wp.array3d(dtype=wp.vec3d)
        position: wp.array3d(dtype=wp.vec3d)
        tangent_a: wp.array3d(dtype=wp.vec3d)
        tangent_b: wp.array3d(dtype=wp.vec3d)
        director: wp.array3d(dtype=wp.vec3d)

    return FacetBars


@functools.cache
def adjoint_fields_struct(dtype: str):
    """Fields of the slots that the adjoint of points takes, and weights."""
    p = precision(dtype)

    @wp.struct
    class AdjointFields:
        displacement: wp.array2d(dtype=wp.vec3d)  # at the end, m
        velocity: p.vec3_2d  # at the start, m/s
        direction: p.vec3_2d  # that the forces of points work on
        force_weight: f64  # of that work
        history_weight: f64  # of the loss by the histories after the step
        at_start: wp.int32  # 1: bars at the start of the step, 0: at its end

    return AdjointFields


@functools.cache
def facet_adjoint_kernels(dtype: str, own: OwnLaws = ()) -> KernelSet:
    """Kernels; arguments as of `contact_kernels`, `law`: the contacts' constants with the points as contacts."""
    p = precision(dtype)
    vec3 = p.vec3
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    Other, ContactAdjoint, FacetBars = facet_side_struct(dtype), contact_adjoint_struct(), facet_adjoint_struct()
    Lists, AdjointFields, ForceBars = point_list_struct(), adjoint_fields_struct(dtype), force_bars_struct()
    g, k, f_ = facet_kinematics(dtype), kinematics_functions(dtype), facet_projection_functions(dtype)
    a, c_ = contact_adjoint_functions(dtype, own), facet_adjoint_functions(dtype)
    FacetPoint, surface_point, facet_frame = f_.FacetPoint, f_.surface_point, g.search.facet_frame
    law_bars, is_slipping, count_switch = a.law_bars, a.is_slipping, a.count_switch
    PointMotion, Places, Curvatures, FacetDirection = c_.PointMotion, c_.Places, c_.Curvatures, c_.FacetDirection
    curvature, field_point, shape_jet, geometry_work = c_.curvature, c_.field_point, c_.shape_jet, c_.geometry_work
    project_on_facet = f_.project_on_facet
    module = kernel_module("_".join(["facet_adjoint", dtype, *law_names(own)]), block_dim=64)

    @wp.func
    def store(bars: FacetBars, world: int, point: int, i: int, xi: vec3d, t: FacetPoint):
        """Store the bars of a facet point."""
        bars.coordinates[world, point, i] = xi
        bars.position[world, point, i] = t.position
        bars.tangent_a[world, point, i] = t.tangent_a
        bars.tangent_b[world, point, i] = t.tangent_b
        bars.director[world, point, i] = t.director

    @wp.struct
    class Coordinates:
        """Facets of a point with the coordinates of its facet points."""

        facet: int
        own: vec3d
        projection: vec3d
        anchored: int  # 0: its motion is relative to its place at the end
        anchor_facet: int
        anchor: vec3d
        start_projection: vec3d
        start_normal: vec3d  # at the projection at the start

    @wp.func
    def coordinates_of(other: Other, world: int, point: int, facet: int) -> Coordinates:
        """Coordinates of a point on a facet."""
        pair = other.scratch
        at = Coordinates()
        at.facet = facet
        at.own = pair.xi[world, point]
        at.projection = pair.projection[world, point]
        at.anchored = wp.where(pair.anchor_facet[world, point] > 0, 1, 0)
        at.anchor_facet = facet
        at.anchor = at.own
        if at.anchored != 0:
            at.anchor_facet = pair.anchor_facet[world, point] - 1
            at.anchor = pair.anchor_xi[world, point]
        start = project_on_facet(other.masters, pair.start_displacement, world, at.anchor_facet, at.anchor)
        at.start_projection = start.xi
        at.start_normal = start.normal
        return at

    @wp.func
    def on_surface(xi: vec3d) -> vec3d:
        """Coordinates on the surface."""
        return vec3d(xi[0], xi[1], f64(0.0))

    @wp.func
    def places_of(other: Other, fields: AdjointFields, world: int, at: Coordinates) -> Places:
        """Facet points of a point."""
        mas = other.masters
        end = other.scratch.displacement
        start = other.scratch.start_displacement
        out = Places()
        out.projection = surface_point(mas, end, world, at.facet, at.projection)
        out.own = surface_point(mas, end, world, at.facet, at.own)
        out.anchor = surface_point(mas, end, world, at.anchor_facet, at.anchor)
        out.start_projection = surface_point(mas, start, world, at.anchor_facet, at.start_projection)
        out.start_anchor = surface_point(mas, start, world, at.anchor_facet, at.anchor)
        out.velocity = field_point(mas, fields.velocity, world, at.anchor_facet, on_surface(at.anchor))
        return out

    @wp.func
    def curvatures_of(other: Other, world: int, at: Coordinates) -> Curvatures:
        """Second derivatives at the facet points of a point."""
        mas = other.masters
        end = other.scratch.displacement
        out = Curvatures()
        out.projection = curvature(mas, end, world, at.facet, at.projection)
        out.own = curvature(mas, end, world, at.facet, at.own)
        out.anchor = curvature(mas, end, world, at.anchor_facet, at.anchor)
        out.start_projection = curvature(
            mas, other.scratch.start_displacement, world, at.anchor_facet, at.start_projection
        )
        return out

    @wp.func
    def spring_at_start(
        other: Other, world: int, point: int, at: Coordinates, start_anchor: FacetPoint, bar: vec3d
    ) -> vec3d:
        """Bar of the stored elastic slip by that in the axes of the anchor's facet: it is turned to the axes of the
        next facet at the start of a step."""
        before = other.history.facet[world, point] - 1
        if before == at.anchor_facet:
            return bar
        old = surface_point(other.masters, other.scratch.start_displacement, world, before,
                            other.history.xi[world, point])  # fmt: skip
        return wp.transpose(facet_frame(old)) * (facet_frame(start_anchor) * bar)

    @wp.func
    def store_places(bars: FacetBars, world: int, point: int, at_start: int, at: Coordinates, near: Places):
        """Store the bars of the facet points at the end, or at the start."""
        if at_start == 0:
            store(bars, world, point, 0, at.projection, near.projection)
            store(bars, world, point, 1, at.own, near.own)
            store(bars, world, point, 2, at.anchor, near.anchor)
        else:
            store(bars, world, point, 0, at.anchor, near.start_anchor)
            store(bars, world, point, 1, at.start_projection, near.start_projection)
            store(bars, world, point, 2, on_surface(at.anchor), near.velocity)

    @masked_kernel(module, "active")
    def adjoint_of_points(
        con: Contacts, law: Contacts, other: Other, facets: Facets, his: History, clock: Clock, fields: AdjointFields,
        active: int_1d, scr: ContactScratch, adj: ContactAdjoint, bars: FacetBars,
    ):  # fmt: skip
        """Bars of points and of their facet points at the end, or at the start, of a step: of the work of their forces
        on a field `direction`, and of the loss by their histories, with the weights of `fields`."""
        world, item, q = wp.tid()
        point = facets.first_point + item * facets.point_count + q
        c = facets.contact[item]
        t = PointContact()
        area = facets.area_fraction[q, item]
        if area > f64(0.0):
            t = g.evaluate(con, other, facets, his, scr, world, q, item, point, fields.displacement,
                           clock.new_time[world])  # fmt: skip
        touching = t.state == IN_REACH and t.depth > f64(0.0)
        was_touching = his.speed[world, point] > f64(0.0)
        slipping = bool(False)
        moved = PointMotion()
        spring_bar = vec3d()
        speed_bar = f64(0.0)
        for i in range(FACET_POINTS):
            store(bars, world, point, i, vec3d(), FacetPoint())
        if touching or (t.state == IN_REACH and con.law[c] & ANY_GAP != 0):
            at = coordinates_of(other, world, point, t.feature)
            places = places_of(other, fields, world, at)
            turns = con.law[c] & FIXED_SPRING == 0
            scale = fields.force_weight * area
            own_direction = k.interpolate(facets, fields.direction, world, q, item)
            direction = FacetDirection()
            direction.at_projection = field_point(other.masters, fields.direction, world, at.facet, at.projection)
            direction.at_own = field_point(other.masters, fields.direction, world, at.facet, at.own)
            force = ForceBars()
            force.normal_force = scale * (own_direction - direction.at_projection.position)
            force.friction = scale * (own_direction - direction.at_own.position)
            if touching:
                force.slip = fields.history_weight * adj.spring_bar[world, point]
                force.speed = fields.history_weight * adj.speed_bar[world, point]
            if turns:
                direction.slip = force.slip
                force.slip = facet_frame(places.own) * direction.slip
                if was_touching:
                    direction.spring = his.spring[world, point]
            inv_h = k.inverse_step(clock, world)
            depth = other.masters.element_depth[at.facet]
            b = law_bars(law, facets, his, scr, adj, world, point, item, depth, t, inv_h, force)
            b.friction = scale * b.friction
            b.normal_force = scale * b.normal_force
            motion = PointMotion()
            motion.position = t.position
            motion.start_position = scr.start_position[world, point]
            motion.velocity = k.interpolate(facets, fields.velocity, world, q, item)
            lowest = wp.max(his.speed[world, point], f64(MIN_APPROACH_SPEED))
            if at.anchored == 0 or wp.dot(at.start_normal, places.velocity.position - motion.velocity) <= lowest:
                if lowest > f64(MIN_APPROACH_SPEED):
                    speed_bar = b.approach_speed
                b.approach_speed = f64(0.0)
            moved, near, _second, _anchored, _bars, direction_bar = wp.grad(geometry_work)(
                motion, places, curvatures_of(other, world, at), at.anchored, b, direction
            )
            store_places(bars, world, point, fields.at_start, at, near)
            if fields.at_start != 0:
                slipping = is_slipping(law, facets, his, scr, world, point, item, depth, t, inv_h)
            if was_touching:
                spring_bar = b.spring
                if turns:
                    spring_bar = spring_at_start(other, world, point, at, places.start_anchor, direction_bar.spring)
        if fields.at_start == 0:
            adj.end_bar[world, point] = moved.position
            return
        adj.start_bar[world, point] = moved.start_position
        adj.velocity_bar[world, point] = moved.velocity
        adj.spring_bar[world, point] = spring_bar
        adj.speed_bar[world, point] = speed_bar
        count_switch(his, adj, world, point, touching, slipping)

    @masked_kernel(module, "active")
    def list_anchors(other: Other, active: int_1d, scr: ContactScratch, listed: wp.array2d(dtype=wp.int32)):
        """Facet + 1 that the motion of each point with a force is relative to."""
        world, point = wp.tid()
        first = wp.int32(0)
        if scr.activity[world, point] == WITH_STIFFNESS:
            first = other.scratch.anchor_facet[world, point]
            if first == 0:
                first = other.scratch.facet[world, point] + 1
        listed[world, point] = wp.max(first, 0)

    @masked_kernel(module, "active")
    def gather_facet_bars(
        other: Other, lists: Lists, bars: FacetBars, first: int, last: int, active: int_1d, add: int, pool: p.vec3_2d
    ):
        """Bars of the facet points from `first` to before `last` of the listed points on the slots of their facets."""
        world, entry = wp.tid()
        f = entry % other.masters.facet_count
        i = entry / other.masters.facet_count
        total = vec3d()
        begin = lists.list_start[world, f]
        for j in range(lists.list_size[world, f]):
            point = lists.list_point[world, begin + j]
            for n in range(first, last):
                s = shape_jet(other.masters, f, i, bars.coordinates[world, point, n])
                total += s[0] * bars.position[world, point, n] + s[1] * bars.tangent_a[world, point, n]
                total += s[2] * bars.tangent_b[world, point, n] + s[3] * bars.director[world, point, n]
        pool_entry = other.masters.first_entry + entry
        if add != 0:
            total += vec3d(pool[world, pool_entry])
        pool[world, pool_entry] = vec3(total)

    return kernel_set(locals())
