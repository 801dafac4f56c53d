"""Adjoint of the geometry of a facet: a point's depth, normal and motion by the facet points that they depend on.

All that a point takes from the other side are positions and tangents of facets at given coordinates, `FacetPoint`:
at its projection and at its own coordinates on the facet at the end, and at the anchor, its place at the start, on the
facet that its motion is relative to. Warp differentiates one scalar of these (`geometry_work`). How coordinates change
follows from one more Newton step there, whose derivative is that of the converged coordinates.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64, precision, vec3d
from .adjoint import point_bars_struct
from .facet_structs import facet_field_struct, master_struct
from .projection import facet_projection_functions

__all__ = ["facet_adjoint_functions"]


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
            director = mas.reference_director_coefficients[m, f] + U.director[world, mas.max_monomials * f + m]
            g = mas.reference_position_coefficients[m, f] + U.value[world, mas.max_monomials * f + m] + xi[2] * director
            if i > 1:
                out.aa += (f64(i * (i - 1)) * power(xi[0], i - 2) * power(xi[1], j)) * g
            if j > 1:
                out.bb += (f64(j * (j - 1)) * power(xi[0], i) * power(xi[1], j - 2)) * g
            if i > 0 and j > 0:
                out.ab += (f64(i * j) * power(xi[0], i - 1) * power(xi[1], j - 1)) * g
            if i > 0:
                out.director_a += (f64(i) * power(xi[0], i - 1) * power(xi[1], j)) * director
            if j > 0:
                out.director_b += (f64(j) * power(xi[0], i) * power(xi[1], j - 1)) * director
        return out

    @wp.func
    def shape_jet(mas: Masters, f: int, i: int, xi: vec3d) -> wp.vec4d:
        """Shape value of slot i, and its derivatives by the coordinates."""
        out = wp.vec4d()
        kind = mas.facet_kind[f]
        for m in range(mas.monomial_count[kind]):
            a = mas.exponents[kind, m][0]
            b = mas.exponents[kind, m][1]
            director_shape_value = f64(mas.director_shape[m, i, f])
            s = f64(mas.shape[m, i, f]) + xi[2] * director_shape_value
            pa = power(xi[0], a)
            pb = power(xi[1], b)
            da = f64(0.0)
            db = f64(0.0)
            if a > 0:
                da = f64(a) * power(xi[0], a - 1)
            if b > 0:
                db = f64(b) * power(xi[1], b - 1)
            out += wp.vec4d(pa * pb * s, da * pb * s, pa * db * s, pa * pb * director_shape_value)
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

    @wp.struct
    class PointMotion:
        """Position of a point at the end and at the start, m, and its velocity at the start."""

        position: vec3d
        start_position: vec3d
        velocity: vec3d

    @wp.struct
    class Places:
        """Facet points that a point depends on, at the end and at the start: its projection, its own coordinates, and
        the anchor; and the anchor's velocity."""

        projection: FacetPoint
        own: FacetPoint
        anchor: FacetPoint
        start_projection: FacetPoint
        start_anchor: FacetPoint
        velocity: FacetPoint

    @wp.struct
    class Curvatures:
        """Their second derivatives."""

        projection: Curvature
        own: Curvature
        anchor: Curvature
        start_projection: Curvature

    @wp.struct
    class FacetDirection:
        """The field that forces work on, at the projection and at the point's own coordinates; elastic slip, and the
        bar of that after the step, in the axes of the facets."""

        at_projection: FacetPoint
        at_own: FacetPoint
        spring: vec3d
        slip: vec3d

    @wp.func
    def geometry_work(
        point: PointMotion, at: Places, second: Curvatures, anchored: int, bars: PointBars, direction: FacetDirection
    ) -> f64:  # fmt: skip
        """Sum of the bars of a record times its changes, and of the changes of the work of both forces on a field
        `direction` with their places."""
        x = point.position
        x_n = point.start_position
        r = x - at.projection.position
        d = projection_step(at.projection, second.projection, r)
        n = normal_after(at.projection, second.projection, d)
        gap = wp.dot(n, r)
        out = wp.dot(bars.normal, n) - bars.depth * gap
        out -= wp.dot(bars.normal_force, d[0] * direction.at_projection.tangent_a
                      + d[1] * direction.at_projection.tangent_b)  # fmt: skip
        e = local_components(at.own, x - at.own.position)
        out -= wp.dot(bars.friction, e[0] * direction.at_own.tangent_a + e[1] * direction.at_own.tangent_b
                      + e[2] * direction.at_own.director)  # fmt: skip
        out += wp.dot(bars.slip, turned(at.own, second.own, e, direction.slip))
        s = e
        if anchored != 0:
            s = local_components(at.start_anchor, x_n - at.start_anchor.position)
        motion = (x - moved(at.anchor, s)) - (x_n - moved(at.start_anchor, s))
        out += wp.dot(bars.motion, motion)
        if anchored == 0:
            return out + bars.previous_depth * (wp.dot(n, motion) - gap)
        out += wp.dot(bars.spring, turned(at.anchor, second.anchor, s, direction.spring))
        r_n = x_n - at.start_projection.position
        d_n = projection_step(at.start_projection, second.start_projection, r_n)
        n_n = normal_after(at.start_projection, second.start_projection, d_n)
        out -= bars.previous_depth * wp.dot(n_n, r_n)
        approach = at.velocity.position + s[0] * at.velocity.tangent_a + s[1] * at.velocity.tangent_b - point.velocity
        return out + bars.approach_speed * wp.dot(n_n, approach)

    return kernel_set(locals())
