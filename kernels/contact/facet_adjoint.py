"""Adjoint of the geometry of facets: a point's depth, normal and motion by both sides' displacements.

All that a point takes from the other side are positions and tangents of facets at given coordinates, `FacetPoint`:
at its projection and at its own coordinates on the facet at the end, and at the anchor, its place at the start, on the
facet that its motion is relative to. Warp differentiates one scalar of these (`geometry_work`). How coordinates change
follows from one more Newton step there, whose derivative is that of the converged coordinates.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import f64, int_1d, precision, vec3d, vec3d_2d
from .adjoint import contact_adjoint_functions, contact_adjoint_struct, point_bars_struct
from .facet_kinematics import facet_kinematics
from .facet_structs import facet_field_struct, facet_side_struct, master_struct, point_list_struct
from .kinematics import kinematics_functions
from .law import ANY_GAP, FIXED_SPRING, MIN_APPROACH_SPEED, OwnLaws, law_names
from .projection import facet_projection_functions
from .structs import IN_REACH, SLIP_FLAG, WITH_STIFFNESS, contact_structs

__all__ = ["FACET_POINTS", "facet_adjoint_kernels", "facet_adjoint_struct"]

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
def facet_adjoint_functions(dtype: str) -> KernelSet:
    """Device functions of the geometry."""
    Masters, FacetField = master_struct(dtype), facet_field_struct()
    vec3 = precision(dtype).vec3
    f_ = facet_projection_functions(dtype)
    FacetPoint, power, local_components = f_.FacetPoint, f_.power, f_.local_components
    PointBars = point_bars_struct()

    @wp.struct
    class Curvature:
        """Second derivatives of the position; of the director: first ones."""

        aa: vec3d
        bb: vec3d
        ab: vec3d
        director_a: vec3d
        director_b: vec3d

    @wp.func
    def curvature(mas: Masters, U: FacetField, world: int, f: int, xi: vec3d) -> Curvature:
        """Second derivatives at coordinates."""
        out = Curvature()
        kind = mas.facet_kind[f]
        for m in range(mas.monomial_count[kind]):
            i = mas.exponents[kind, m][0]
            j = mas.exponents[kind, m][1]
            rise = mas.reference_director_coefficients[m, f] + U.director[world, mas.max_monomials * f + m]
            g = mas.reference_position_coefficients[m, f] + U.value[world, mas.max_monomials * f + m] + xi[2] * rise
            if i > 1:
                out.aa += (f64(i * (i - 1)) * power(xi[0], i - 2) * power(xi[1], j)) * g
            if j > 1:
                out.bb += (f64(j * (j - 1)) * power(xi[0], i) * power(xi[1], j - 2)) * g
            if i > 0 and j > 0:
                out.ab += (f64(i * j) * power(xi[0], i - 1) * power(xi[1], j - 1)) * g
            if i > 0:
                out.director_a += (f64(i) * power(xi[0], i - 1) * power(xi[1], j)) * rise
            if j > 0:
                out.director_b += (f64(j) * power(xi[0], i) * power(xi[1], j - 1)) * rise
        return out

    @wp.func
    def shape_jet(mas: Masters, f: int, i: int, xi: vec3d) -> wp.vec4d:
        """Shape value of slot i, and its derivatives by the coordinates."""
        out = wp.vec4d()
        kind = mas.facet_kind[f]
        for m in range(mas.monomial_count[kind]):
            a = mas.exponents[kind, m][0]
            b = mas.exponents[kind, m][1]
            rise = f64(mas.director_shape[m, i, f])
            s = f64(mas.shape[m, i, f]) + xi[2] * rise
            pa = power(xi[0], a)
            pb = power(xi[1], b)
            da = f64(0.0)
            db = f64(0.0)
            if a > 0:
                da = f64(a) * power(xi[0], a - 1)
            if b > 0:
                db = f64(b) * power(xi[1], b - 1)
            out += wp.vec4d(pa * pb * s, da * pb * s, pa * db * s, pa * pb * rise)
        return out

    @wp.func
    def field_point(mas: Masters, field: wp.array2d(dtype=vec3), world: int, f: int, xi: vec3d) -> FacetPoint:
        """A field of the slots and its derivatives at coordinates."""
        out = FacetPoint()
        for i in range(mas.conn.shape[0]):
            s = shape_jet(mas, f, i, xi)
            x = vec3d(field[world, mas.conn[i, f]])
            out.position += s[0] * x
            out.tangent_a += s[1] * x
            out.tangent_b += s[2] * x
            out.director += s[3] * x
        return out

    @wp.func
    def projection_step(t: FacetPoint, c: Curvature, r: vec3d) -> wp.vec2d:
        """Newton step of the projection of a point at r from a position."""
        a = wp.dot(t.tangent_a, t.tangent_a) - wp.dot(r, c.aa)
        b = wp.dot(t.tangent_b, t.tangent_b) - wp.dot(r, c.bb)
        ab = wp.dot(t.tangent_a, t.tangent_b) - wp.dot(r, c.ab)
        x = wp.dot(r, t.tangent_a)
        y = wp.dot(r, t.tangent_b)
        det = a * b - ab * ab
        return wp.vec2d((b * x - ab * y) / det, (a * y - ab * x) / det)

    @wp.func
    def normal_after(t: FacetPoint, c: Curvature, d: wp.vec2d) -> vec3d:
        """Unit normal after a change of coordinates on the surface."""
        return wp.normalize(wp.cross(t.tangent_a + d[0] * c.aa + d[1] * c.ab, t.tangent_b + d[0] * c.ab + d[1] * c.bb))

    @wp.func
    def moved(t: FacetPoint, d: vec3d) -> vec3d:
        """Position after a change of coordinates."""
        return t.position + d[0] * t.tangent_a + d[1] * t.tangent_b + d[2] * t.director

    @wp.func
    def turned(t: FacetPoint, c: Curvature, d: vec3d, local: vec3d) -> vec3d:
        """A vector with the components `local` along the axes of `facet_frame`, after a change of coordinates."""
        ta = t.tangent_a + d[0] * c.aa + d[1] * c.ab + d[2] * c.director_a
        tb = t.tangent_b + d[0] * c.ab + d[1] * c.bb + d[2] * c.director_b
        n = wp.normalize(wp.cross(ta, tb))
        a = wp.normalize(ta)
        return local[0] * a + local[1] * wp.cross(n, a) + local[2] * n

    @wp.func
    def geometry_work(
        x: vec3d, x_n: vec3d, v: vec3d, projection: FacetPoint, own: FacetPoint, anchor: FacetPoint,
        start_anchor: FacetPoint, start_projection: FacetPoint, anchor_velocity: FacetPoint, of_projection: Curvature,
        of_own: Curvature, of_anchor: Curvature, of_start: Curvature, anchored: int, bars: PointBars,
        way_at_projection: FacetPoint, way_at_own: FacetPoint, spring: vec3d, slip_bar: vec3d,
    ) -> f64:  # fmt: skip
        """Sum of the bars of a record times its changes, and of the changes of the work of both forces on a field `way`
        with their places.

        x, x_n, v: position of the point at the end and at the start, velocity at the start. spring, slip_bar: elastic
        slip, and the bar of that after the step, in the axes of the facets.
        """
        r = x - projection.position
        d = projection_step(projection, of_projection, r)
        n = normal_after(projection, of_projection, d)
        gap = wp.dot(n, r)
        out = wp.dot(bars.normal, n) - bars.depth * gap
        out -= wp.dot(bars.normal_force, d[0] * way_at_projection.tangent_a + d[1] * way_at_projection.tangent_b)
        e = local_components(own, x - own.position)
        out -= wp.dot(bars.friction, e[0] * way_at_own.tangent_a + e[1] * way_at_own.tangent_b
                      + e[2] * way_at_own.director)  # fmt: skip
        out += wp.dot(bars.slip, turned(own, of_own, e, slip_bar))
        s = e
        if anchored != 0:
            s = local_components(start_anchor, x_n - start_anchor.position)
        motion = (x - moved(anchor, s)) - (x_n - moved(start_anchor, s))
        out += wp.dot(bars.motion, motion)
        if anchored == 0:
            return out + bars.previous_depth * (wp.dot(n, motion) - gap)
        out += wp.dot(bars.spring, turned(anchor, of_anchor, s, spring))
        r_n = x_n - start_projection.position
        d_n = projection_step(start_projection, of_start, r_n)
        n_n = normal_after(start_projection, of_start, d_n)
        out -= bars.previous_depth * wp.dot(n_n, r_n)
        approach = anchor_velocity.position + s[0] * anchor_velocity.tangent_a + s[1] * anchor_velocity.tangent_b - v
        return out + bars.approach_speed * wp.dot(n_n, approach)

    return kernel_set(locals())


@functools.cache
def facet_adjoint_kernels(dtype: str, own: OwnLaws = ()) -> KernelSet:
    """Kernels; arguments as of `contact_kernels`, `law`: the contacts' constants with the points as contacts."""
    p = precision(dtype)
    vec3 = p.vec3
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    Other, ContactAdjoint, FacetBars = facet_side_struct(dtype), contact_adjoint_struct(), facet_adjoint_struct()
    Lists = point_list_struct()
    g, k, f_ = facet_kinematics(dtype), kinematics_functions(dtype), facet_projection_functions(dtype)
    a, c_ = contact_adjoint_functions(dtype, own), facet_adjoint_functions(dtype)
    FacetPoint, surface_point, facet_frame = f_.FacetPoint, f_.surface_point, g.search.facet_frame
    law_bars, is_slipping = a.law_bars, a.is_slipping
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

    @masked_kernel(module, "active")
    def adjoint_of_points(
        con: Contacts, law: Contacts, other: Other, facets: Facets, his: History, clock: Clock, u: vec3d_2d,
        v_n: p.vec3_2d, way: p.vec3_2d, active: int_1d, weights: wp.vec2d, at_start: int, scr: ContactScratch,
        adj: ContactAdjoint, bars: FacetBars,
    ):  # fmt: skip
        """Bars of points and of their facet points at the end, or at the start, of a step: of the work of their forces
        on a field `way`, and of the loss by their histories, with `weights`."""
        world, item, q = wp.tid()
        point = facets.first_point + item * facets.point_count + q
        c = facets.contact[item]
        mas = other.masters
        pair = other.scratch
        end_bar = vec3d()
        start_bar = vec3d()
        velocity_bar = vec3d()
        spring_bar = vec3d()
        speed_bar = f64(0.0)
        t = PointContact()
        area = facets.area_fraction[q, item]
        if area > f64(0.0):
            t = g.evaluate(con, other, facets, his, scr, world, q, item, point, u, clock.new_time[world])
        touching = t.state == IN_REACH and t.depth > f64(0.0)
        was_touching = his.speed[world, point] > f64(0.0)
        slipping = bool(False)
        for i in range(FACET_POINTS):
            store(bars, world, point, i, vec3d(), FacetPoint())
        if touching or (t.state == IN_REACH and con.law[c] & ANY_GAP != 0):
            f = t.feature
            xi = pair.xi[world, point]
            base = pair.projection[world, point]
            anchored = wp.where(pair.anchor_facet[world, point] > 0, 1, 0)
            first = f
            from0 = xi
            if anchored != 0:
                first = pair.anchor_facet[world, point] - 1
                from0 = pair.anchor_xi[world, point]
            foot = vec3d(from0[0], from0[1], f64(0.0))
            start = project_on_facet(mas, pair.start_displacement, world, first, from0)
            start_place = surface_point(mas, pair.start_displacement, world, first, from0)
            place = surface_point(mas, pair.displacement, world, f, xi)
            # the work of the forces, and the history after the step
            scale = weights[0] * area
            own_way = k.interpolate(facets, way, world, q, item)
            base_way = field_point(mas, way, world, f, base)
            place_way = field_point(mas, way, world, f, xi)
            turns = con.law[c] & FIXED_SPRING == 0
            slip_way = vec3d()
            speed_way = f64(0.0)
            if touching:
                slip_way = weights[1] * adj.spring_bar[world, point]
                speed_way = weights[1] * adj.speed_bar[world, point]
            world_slip_way = slip_way
            if turns:
                world_slip_way = facet_frame(place) * slip_way
            else:
                slip_way = vec3d()
            inv_h = k.inverse_step(clock, world)
            depth = mas.element_depth[f]
            b = law_bars(law, facets, his, scr, adj, world, point, item, depth, t, inv_h,
                         scale * (own_way - base_way.position), scale * (own_way - place_way.position), world_slip_way,
                         speed_way)  # fmt: skip
            b.friction = scale * b.friction
            b.normal_force = scale * b.normal_force
            spring = vec3d()
            if was_touching and turns:
                spring = his.spring[world, point]
            # velocities at the start
            v = k.interpolate(facets, v_n, world, q, item)
            foot_velocity = field_point(mas, v_n, world, first, foot)
            lowest = wp.max(his.speed[world, point], f64(MIN_APPROACH_SPEED))
            if anchored == 0 or wp.dot(start.normal, foot_velocity.position - v) <= lowest:
                if lowest > f64(MIN_APPROACH_SPEED):
                    speed_bar = b.approach_speed
                b.approach_speed = f64(0.0)
            (
                x, x_n, v_bar, at_base, at_place, at_anchor, at_start_place, at_start_base, at_velocity, _0, _1, _2, _3,
                _4, _5, _6, _7, turned_bar, _8,
            ) = wp.grad(geometry_work)(
                t.position, scr.start_position[world, point], v,
                surface_point(mas, pair.displacement, world, f, base), place,
                surface_point(mas, pair.displacement, world, first, from0), start_place,
                surface_point(mas, pair.start_displacement, world, first, start.xi), foot_velocity,
                curvature(mas, pair.displacement, world, f, base), curvature(mas, pair.displacement, world, f, xi),
                curvature(mas, pair.displacement, world, first, from0),
                curvature(mas, pair.start_displacement, world, first, start.xi), anchored, b, base_way, place_way,
                spring, slip_way,
            )  # fmt: skip
            if at_start == 0:
                end_bar = x
                store(bars, world, point, 0, base, at_base)
                store(bars, world, point, 1, xi, at_place)
                store(bars, world, point, 2, from0, at_anchor)
            else:
                start_bar = x_n
                velocity_bar = v_bar
                store(bars, world, point, 0, from0, at_start_place)
                store(bars, world, point, 1, start.xi, at_start_base)
                store(bars, world, point, 2, foot, at_velocity)
                slipping = is_slipping(law, facets, his, scr, world, point, item, depth, t, inv_h)
                if was_touching:
                    spring_bar = turned_bar
                    if not turns:
                        spring_bar = b.spring
                    before = other.history.facet[world, point] - 1
                    if turns and before != first:  # the slip was turned to the axes of the next facet
                        old = surface_point(mas, pair.start_displacement, world, before, other.history.xi[world, point])
                        spring_bar = wp.transpose(facet_frame(old)) * (facet_frame(start_place) * spring_bar)
        if at_start == 0:
            adj.end_bar[world, point] = end_bar
            return
        adj.start_bar[world, point] = start_bar
        adj.velocity_bar[world, point] = velocity_bar
        adj.spring_bar[world, point] = spring_bar
        adj.speed_bar[world, point] = speed_bar
        was_slipping = was_touching and his.contact_state[world, point] >= SLIP_FLAG
        if touching != was_touching or (touching and slipping != was_slipping):
            wp.atomic_add(adj.switches, world, 1)

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
        place = other.masters.first_entry + entry
        if add != 0:
            total += vec3d(pool[world, place])
        pool[world, place] = vec3(total)

    return kernel_set(locals())
