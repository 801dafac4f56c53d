"""Facet coordinates of a point by Newton's method, and its projection on a master facet.

Positions on a facet are polynomials of xi = (a, b, z), see `master_struct`: a, b on the unit triangle or square, z in m
along the director. U: displacements on the facets, see `facet_field_struct`.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64, vec3d
from .facet_structs import facet_field_struct, master_struct

__all__ = ["INSIDE_TOLERANCE", "OUTSIDE_TOLERANCE", "facet_projection_functions"]

MAX_NEWTON_STEPS = 16
"""Maximum number of Newton steps for the facet coordinates."""
MAX_PROJECTION_STEPS = 12
"""Maximum number of projection steps: each reduces the error by gap times curvature."""
OUTSIDE_TOLERANCE = 0.05
"""Distance over a side by which a point may lie outside of its facet: outward vectors of two elements differ, and a
point on a border must not change facets from iterate to iterate."""
INSIDE_TOLERANCE = 1e-9
"""Distance over a side within which a point counts as inside of its facet: round-off of Newton's method."""
QUADRATIC_STEP = 1e-8
"""Step size below which Newton's method stops: the remaining error is its square."""


@functools.cache
def facet_projection_functions(dtype: str) -> KernelSet:
    """Device functions in one precision of the displacements; evaluated in float64."""
    Masters, FacetField = master_struct(dtype), facet_field_struct()

    @wp.struct
    class FacetPoint:
        """Position, m, and its derivatives by the coordinates a, b and z; `director` is the outward vector."""

        position: vec3d
        tangent_a: vec3d
        tangent_b: vec3d
        director: vec3d

    @wp.func
    def power(x: f64, n: int) -> f64:
        """x^n for n = 0 to 3; selects, since loops are unrolled wherever this is inlined: code for the search of facets
        that is half as long again."""
        low = wp.where(n == 0, f64(1.0), x)
        return wp.where(n < 2, low, wp.where(n == 2, x * x, x * x * x))

    @wp.func
    def monomial(mas: Masters, kind: int, m: int, xi: vec3d) -> f64:
        """Monomial m of a kind of facet at given coordinates."""
        return power(xi[0], mas.exponents[kind, m][0]) * power(xi[1], mas.exponents[kind, m][1])

    @wp.func
    def power_quotient(x0: f64, x: f64, n: int) -> f64:
        """(x^n - x0^n)/(x - x0) for n = 0 to 3, without cancellation."""
        low = wp.where(n == 0, f64(0.0), f64(1.0))
        return wp.where(n < 2, low, wp.where(n == 2, x0 + x, x0 * x0 + x * x0 + x * x))

    @wp.func
    def surface_point(
        mas: Masters, U: FacetField, world: int, f: int, xi: vec3d
    ) -> FacetPoint:  # fmt: skip
        """Position and derivatives at the coordinates `xi`."""
        out = FacetPoint()
        kind = mas.facet_kind[f]
        for m in range(mas.monomial_count[kind]):
            i = mas.exponents[kind, m][0]
            j = mas.exponents[kind, m][1]
            p = power(xi[0], i)
            q = power(xi[1], j)
            rise = mas.reference_director_coefficients[m, f] + U.director[world, mas.max_monomials * f + m]
            g = mas.reference_position_coefficients[m, f] + U.value[world, mas.max_monomials * f + m] + xi[2] * rise
            out.position += (p * q) * g
            out.director += (p * q) * rise
            if i > 0:
                out.tangent_a += (f64(i) * power(xi[0], i - 1) * q) * g
            if j > 0:
                out.tangent_b += (p * f64(j) * power(xi[1], j - 1)) * g
        return out

    @wp.func
    def facet_value(mas: Masters, C: wp.array2d(dtype=vec3d), world: int, f: int, xi: vec3d) -> vec3d:
        """Polynomial with coefficients C at the projection of a point on a facet, e.g. the velocity."""
        out = vec3d()
        kind = mas.facet_kind[f]
        for m in range(mas.monomial_count[kind]):
            out += monomial(mas, kind, m, xi) * C[world, mas.max_monomials * f + m]
        return out

    @wp.func
    def displacement_change(
        mas: Masters, U: FacetField, U0: FacetField, world: int, f: int, xi: vec3d,
    ) -> vec3d:  # fmt: skip
        """Displacement at given coordinates by U minus that by U0."""
        out = vec3d()
        kind = mas.facet_kind[f]
        for m in range(mas.monomial_count[kind]):
            p = monomial(mas, kind, m, xi)
            i = mas.max_monomials * f + m
            out += p * (
                (U.value[world, i] - U0.value[world, i]) + xi[2] * (U.director[world, i] - U0.director[world, i])
            )
        return out

    @wp.func
    def position_change(
        mas: Masters, U: FacetField, world: int, f: int, old: vec3d, new: vec3d
    ) -> vec3d:  # fmt: skip
        """x(new) - x(old) with round-off relative to its own size: a sum of differences of powers."""
        out = vec3d()
        kind = mas.facet_kind[f]
        step = new - old
        for m in range(mas.monomial_count[kind]):
            i = mas.exponents[kind, m][0]
            j = mas.exponents[kind, m][1]
            p = step[0] * power_quotient(old[0], new[0], i) * power(new[1], j)
            p += power(old[0], i) * step[1] * power_quotient(old[1], new[1], j)
            rise = mas.reference_director_coefficients[m, f] + U.director[world, mas.max_monomials * f + m]
            out += p * (
                mas.reference_position_coefficients[m, f] + U.value[world, mas.max_monomials * f + m] + old[2] * rise
            )
            out += (power(new[0], i) * power(new[1], j) * step[2]) * rise
        return out

    @wp.func
    def local_components(t: FacetPoint, r: vec3d) -> vec3d:
        """Solution d of a d_0 + b d_1 + c d_2 = r; 0 where a, b, c are coplanar."""
        n = wp.cross(t.tangent_a, t.tangent_b)
        det = wp.dot(n, t.director)
        if wp.abs(det) <= f64(1.0e-12) * wp.length(n) * wp.length(t.director):
            return vec3d()
        return (
            vec3d(
                wp.dot(r, wp.cross(t.tangent_b, t.director)), wp.dot(r, wp.cross(t.director, t.tangent_a)), wp.dot(r, n)
            )
            / det
        )

    @wp.func
    def distance_outside(corners: int, s: vec3d) -> f64:
        """Distance of coordinates outside of the unit triangle or square; 0 on the facet."""
        out = wp.max(-s[0], -s[1])
        if corners == 3:
            out = wp.max(out, s[0] + s[1] - f64(1.0))
        else:
            out = wp.max(out, wp.max(s[0], s[1]) - f64(1.0))
        return wp.where(out <= f64(INSIDE_TOLERANCE), f64(0.0), out)

    @wp.func
    def facet_centre(corners: int) -> vec3d:
        """Coordinates of the midpoint of a facet."""
        part = wp.where(corners == 3, f64(1.0) / f64(3.0), f64(0.5))
        return vec3d(part, part, f64(0.0))

    @wp.func
    def newton_coordinates(
        mas: Masters, U: FacetField, world: int, f: int, first: vec3d, target: vec3d, moved: bool
    ) -> wp.vec4d:  # fmt: skip
        """Coordinates of a point by Newton's method from `first`, and 1 if converged; `target`: its position, m, or
        with `moved` its motion from `first`, whose change then has a round-off relative to the motion."""
        xi = first
        last = f64(1.0e300)
        for _ in range(MAX_NEWTON_STEPS):
            t = surface_point(mas, U, world, f, xi)
            r = target
            if moved:
                r -= position_change(mas, U, world, f, first, xi)
            else:
                r -= t.position
            d = local_components(t, r)
            size = wp.max(wp.abs(d[0]), wp.abs(d[1]))
            if size > f64(0.5):
                d = d * (f64(0.5) / size)
            xi += d
            if distance_outside(mas.corner_count[mas.facet_kind[f]], xi) > f64(1.0):
                return wp.vec4d(xi[0], xi[1], xi[2], f64(0.0))
            size = wp.max(size, wp.abs(d[2]) / mas.side_length[f])
            least = f64(QUADRATIC_STEP)
            if moved:
                least = wp.max(least * wp.length(xi - first), f64(1.0e-15))
            if size < least:
                return wp.vec4d(xi[0], xi[1], xi[2], f64(1.0))
            last = size
        return wp.vec4d(xi[0], xi[1], xi[2], wp.where(last < f64(1.0e-9), f64(1.0), f64(0.0)))

    @wp.func
    def inverse_map(mas: Masters, U: FacetField, world: int, f: int, x: vec3d, first: vec3d) -> wp.vec4d:
        """Coordinates of x, and 1 if converged."""
        return newton_coordinates(mas, U, world, f, first, x, False)

    @wp.func
    def unit_normal(t: FacetPoint) -> vec3d:
        """Unit normal of the surface of constant z through a position."""
        return wp.normalize(wp.cross(t.tangent_a, t.tangent_b))

    @wp.struct
    class Projection:
        """Projection of a point onto a facet: gap = gap_slope x (coordinate along the outward vector) + gap_offset."""

        xi: vec3d  # coordinates of the projection, z = 0
        normal: vec3d  # unit normal at the projection
        gap_slope: f64
        gap_offset: f64  # m, nonzero on a curved facet

    @wp.func
    def project_on_facet(
        mas: Masters, U: FacetField, world: int, f: int, xi: vec3d
    ) -> Projection:  # fmt: skip
        """Orthogonal projection of a position."""
        out = Projection()
        base = vec3d(xi[0], xi[1], f64(0.0))
        off = surface_point(mas, U, world, f, base).director
        out.xi = base
        for _ in range(MAX_PROJECTION_STEPS):
            t = surface_point(mas, U, world, f, out.xi)
            out.normal = unit_normal(t)
            lie = position_change(mas, U, world, f, out.xi, base)
            out.gap_offset = wp.dot(out.normal, lie)
            lie += xi[2] * off
            t.director = out.normal
            d = local_components(t, lie - wp.dot(out.normal, lie) * out.normal)
            size = wp.max(wp.abs(d[0]), wp.abs(d[1]))
            if size < f64(1.0e-13) or size > f64(0.5):
                break
            out.xi += vec3d(d[0], d[1], f64(0.0))
        out.gap_slope = wp.dot(out.normal, off)
        return out

    @wp.func
    def second_derivatives(
        mas: Masters, U: FacetField, world: int, f: int, xi: vec3d, n: vec3d
    ) -> vec3d:  # fmt: skip
        """Second derivatives of a facet along n: (11, 22, 12)."""
        out = vec3d()
        kind = mas.facet_kind[f]
        for m in range(mas.monomial_count[kind]):
            i = mas.exponents[kind, m][0]
            j = mas.exponents[kind, m][1]
            h = wp.dot(n, mas.reference_position_coefficients[m, f] + U.value[world, mas.max_monomials * f + m])
            if i > 1:
                out[0] = out[0] + f64(i * (i - 1)) * power(xi[0], i - 2) * power(xi[1], j) * h
            if j > 1:
                out[1] = out[1] + f64(j * (j - 1)) * power(xi[0], i) * power(xi[1], j - 2) * h
            if i > 0 and j > 0:
                out[2] = out[2] + f64(i * j) * power(xi[0], i - 1) * power(xi[1], j - 1) * h
        return out

    @wp.func
    def shape_gradients(mas: Masters, f: int, i: int, xi: vec3d) -> wp.vec2d:
        """Derivatives of the shape value of slot i by the facet coordinates."""
        out = wp.vec2d()
        kind = mas.facet_kind[f]
        for m in range(mas.monomial_count[kind]):
            a = mas.exponents[kind, m][0]
            b = mas.exponents[kind, m][1]
            s = f64(mas.shape[m, i, f])
            if a > 0:
                out[0] = out[0] + s * f64(a) * power(xi[0], a - 1) * power(xi[1], b)
            if b > 0:
                out[1] = out[1] + s * f64(b) * power(xi[0], a) * power(xi[1], b - 1)
        return out

    @wp.func
    def shape_value(mas: Masters, f: int, i: int, xi: vec3d) -> f64:
        """Shape value of slot i of a facet at given coordinates."""
        out = f64(0.0)
        kind = mas.facet_kind[f]
        for m in range(mas.monomial_count[kind]):
            p = monomial(mas, kind, m, xi)
            out += p * (f64(mas.shape[m, i, f]) + xi[2] * f64(mas.director_shape[m, i, f]))
        return out

    return kernel_set(locals())
