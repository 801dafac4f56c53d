"""Contact point of a lumped contact: the deepest position of a surface, found within its facets.

The surface interpolates the points of each facet by Lagrange polynomials, which neighbours share on their common edge:
the contact point moves continuously as a smooth body rolls.
"""

import functools

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import precision
from .collider_kinematics import collider_kinematics
from .colliders import MESH_SUFFIX, collider_functions
from .kinematics import kinematics_functions
from .structs import collider_struct, contact_structs

__all__ = ["deepest_point_kernels"]

MAX_POINT_CHOICES = 8
"""Choices of the contact point in an attempt."""
MAX_NEWTON_STEPS = 12
"""Newton steps within a facet."""
MAX_HALVINGS = 6
DIFFERENCE_STEP = 1e-5
"""Step in a facet's coordinates for finite differences of the shape's normals (its curvature)."""


@functools.cache
def deepest_point_kernels(dtype: str, meshes: bool) -> KernelSet:
    """Kernels of lumped contacts, in a module of their own; `meshes`: some collider is a triangle mesh."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    f64, vec2d, vec3d = wp.float64, wp.vec2d, wp.vec3d
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    Colliders = collider_struct(meshes)
    f, geometry = kinematics_functions(dtype), collider_kinematics(dtype, meshes)
    distance, stored_side = collider_functions(meshes).distance, collider_functions(meshes).stored_side
    module = kernel_module(f"deepest_point_{dtype}{MESH_SUFFIX * meshes}", max_unroll=SHORT_UNROLL)

    @wp.struct
    class SurfacePoint:
        """Position on a facet in the collider's frame, and its derivatives by the facet's coordinates."""

        y: vec3d
        a: vec3d
        b: vec3d
        aa: vec3d
        ab: vec3d
        bb: vec3d

    @wp.func
    def surface_point(col: Colliders, facets: Facets, world: int, k: int, item: int,
        u: wp.array2d(dtype=vec3d),
            s: vec2d) -> SurfacePoint:  # fmt: skip
        """Position and derivatives at coordinates s."""
        out = SurfacePoint()
        back = wp.transpose(col.rotation[world, k])
        for q in range(facets.point_count):
            x = back * (facets.X[q, item] + f.interpolate(facets, u, world, q, item) - col.position[world, k])
            for m in range(facets.exponents.shape[0]):
                i = facets.exponents[m][0]
                j = facets.exponents[m][1]
                c = facets.lagrange_coefficients[q, m]
                if c != f64(0.0):
                    out.y += (c * f.monomial_derivative(s[0], i, 0) * f.monomial_derivative(s[1], j, 0)) * x
                    out.a += (c * f.monomial_derivative(s[0], i, 1) * f.monomial_derivative(s[1], j, 0)) * x
                    out.b += (c * f.monomial_derivative(s[0], i, 0) * f.monomial_derivative(s[1], j, 1)) * x
                    out.aa += (c * f.monomial_derivative(s[0], i, 2) * f.monomial_derivative(s[1], j, 0)) * x
                    out.ab += (c * f.monomial_derivative(s[0], i, 1) * f.monomial_derivative(s[1], j, 1)) * x
                    out.bb += (c * f.monomial_derivative(s[0], i, 0) * f.monomial_derivative(s[1], j, 2)) * x
        return out

    @wp.func
    def edge_half_plane(corners: int, k: int, s: vec2d) -> vec3d:
        """Inward normal of an edge of the unit triangle or square, and the distance of s from it."""
        if corners == 3 and k == 2:
            return vec3d(f64(-1.0), f64(-1.0), f64(1.0) - s[0] - s[1])
        if k == 0:
            return vec3d(f64(1.0), f64(0.0), s[0])
        if k == 1:
            return vec3d(f64(0.0), f64(1.0), s[1])
        if k == 2:
            return vec3d(f64(-1.0), f64(0.0), f64(1.0) - s[0])
        return vec3d(f64(0.0), f64(-1.0), f64(1.0) - s[1])

    @wp.func
    def feasible_fraction(corners: int, s: vec2d, d: vec2d) -> f64:
        """Fraction of a step d, at most 1, that stays within the facet."""
        part = f64(1.0)
        for k in range(corners):
            edge = edge_half_plane(corners, k, s)
            rate = edge[0] * d[0] + edge[1] * d[1]
            if rate < f64(-1.0e-14) * wp.length(d):
                part = wp.min(part, wp.max(edge[2], f64(0.0)) / -rate)
        return part

    @wp.func
    def descent_step(g: vec2d, h: vec3d, corners: int, s: vec2d) -> vec2d:
        """Newton step for a gap with gradient g and second derivatives h (aa, ab, bb), along an edge where that
        blocks it, cut to the facet; 0 without a descent direction."""
        det = h[0] * h[2] - h[1] * h[1]
        size = wp.abs(h[0]) + f64(2.0) * wp.abs(h[1]) + wp.abs(h[2])
        d = g * (f64(-1.0) / wp.max(wp.max(size, wp.length(g)), f64(1.0e-300)))
        if h[0] > f64(0.0) and det > f64(1.0e-10) * size * size:
            d = vec2d(h[1] * g[1] - h[2] * g[0], h[1] * g[0] - h[0] * g[1]) / det
        part = feasible_fraction(corners, s, d)
        if part > f64(1.0e-12):
            return part * d
        for k in range(corners):
            edge = edge_half_plane(corners, k, s)
            if edge[2] <= f64(1.0e-12):
                t = vec2d(-edge[1], edge[0])
                slope = wp.dot(g, t)
                bend = h[0] * t[0] * t[0] + f64(2.0) * h[1] * t[0] * t[1] + h[2] * t[1] * t[1]
                way = -wp.sign(slope)
                if bend > f64(0.0):
                    way = -slope / bend
                d = way * t
                part = feasible_fraction(corners, s, d)
                if part > f64(1.0e-12) and slope != f64(0.0):
                    return part * d
        return vec2d()

    @wp.func
    def deepest_in_facet(col: Colliders, facets: Facets, world: int, k: int, item: int,
                   u: wp.array2d(dtype=vec3d), start: vec2d) -> vec3d:  # fmt: skip
        """Coordinates of the position of a facet closest to the collider, and its gap, by descent from a start."""
        s = start
        here = surface_point(col, facets, world, k, item, u, s)
        d = distance(col, k, here.y, -1)
        for _ in range(MAX_NEWTON_STEPS):
            n = vec3d(d[0], d[1], d[2])
            next_a = distance(col, k, here.y + f64(DIFFERENCE_STEP) * here.a, -1)
            next_b = distance(col, k, here.y + f64(DIFFERENCE_STEP) * here.b, -1)
            turn_a = (vec3d(next_a[0], next_a[1], next_a[2]) - n) / f64(DIFFERENCE_STEP)
            turn_b = (vec3d(next_b[0], next_b[1], next_b[2]) - n) / f64(DIFFERENCE_STEP)
            g = vec2d(wp.dot(n, here.a), wp.dot(n, here.b))
            mixed = f64(0.5) * (wp.dot(here.a, turn_b) + wp.dot(here.b, turn_a))
            h = vec3d(wp.dot(n, here.aa) + wp.dot(here.a, turn_a), wp.dot(n, here.ab) + mixed,
                      wp.dot(n, here.bb) + wp.dot(here.b, turn_b))  # fmt: skip
            step = descent_step(g, h, facets.corner_count, s)
            found = bool(False)
            for _try in range(MAX_HALVINGS):
                if not found and wp.length(step) > f64(1.0e-9):
                    new = surface_point(col, facets, world, k, item, u, s + step)
                    new_d = distance(col, k, new.y, -1)
                    if new_d[3] < d[3]:
                        found = True
                        s = s + step
                        here = new
                        d = new_d
                    else:
                        step = f64(0.5) * step
            if not found:
                break
        return vec3d(s[0], s[1], d[3])

    @masked_kernel(module, "active")
    def point_depths(
        con: Contacts, col: Colliders, facets: Facets, his: History, time: wp.array(dtype=f64),
        u: wp.array2d(dtype=vec3d), active: wp.array(dtype=wp.int32), scr: ContactScratch,
    ):  # fmt: skip
        """Depths of the points of lumped contacts."""
        world, item, q = wp.tid()
        c = facets.contact[item]
        point = facets.first_point + item * facets.point_count + q
        depth = f64(-1.0e300)
        if facets.area_fraction[q, item] > f64(0.0):
            k = col.of_contact[c]
            x = facets.X[q, item] + f.interpolate(facets, u, world, q, item)
            y = wp.transpose(col.rotation[world, k]) * (x - col.position[world, k])
            d = distance(col, k, y, -1)
            depth = f.activation_gap(con, his, world, c, point, time[world], col.margin[world, k]) - d[3]
            if con.is_explicit[c] != 0:  # explicit: its force is that of the last state
                depth = scr.start_depth[world, point]
        scr.point_depth[world, point] = depth

    @masked_kernel(module, "active")
    def find_deepest(
        con: Contacts, col: Colliders, facets: Facets, his: History, time: wp.array(dtype=f64),
        u: wp.array2d(dtype=vec3d), active: wp.array(dtype=wp.int32), scr: ContactScratch,
    ):  # fmt: skip
        """Deepest position of each facet that may touch and be the deepest of its contact; else its deepest point."""
        world, item = wp.tid()
        c = facets.contact[item]
        row = facets.first_row + item
        first = facets.first_point + item * facets.point_count
        q = wp.int32(0)
        top = scr.point_depth[world, first]
        low = f64(1.0e300)
        for j in range(facets.point_count):
            level = scr.point_depth[world, first + j]
            if level > top:
                top = level
                q = j
            if level > f64(-1.0e299):
                low = wp.min(low, level)
        scr.facet_deepest_point[world, row] = first + q
        scr.facet_deepest_xi[world, row] = facets.point_coords[q]
        scr.facet_max_depth[world, row] = top
        highest = top + (top - low)  # upper bound between the points
        known = f64(-1.0e300)
        if scr.contact_point[world, c] >= con.first_point[c] and scr.contact_point[world, c] < con.first_point[c + 1]:
            known = scr.point_depth[world, scr.contact_point[world, c]]
        if facets.tracks_deepest == 0 or top < f64(-1.0e299) or highest <= f64(0.0) or highest < known:
            return
        k = col.of_contact[c]
        found = deepest_in_facet(col, facets, world, k, item, u, facets.point_coords[q])
        scr.facet_deepest_xi[world, row] = vec2d(found[0], found[1])
        depth = f.activation_gap(con, his, world, c, first, time[world], col.margin[world, k]) - found[2]
        scr.facet_max_depth[world, row] = wp.max(depth, top)

    @wp.kernel(module=module)
    def choose_deepest(
        con: Contacts, row_start: wp.array(dtype=wp.int32), active: wp.array(dtype=wp.int32), fresh: int,
        scr: ContactScratch, changed: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        """Deepest facet of each lumped contact, the first of equals; it may change MAX_POINT_CHOICES times per attempt.

        With two equally deep positions neither alone gives an equilibrium: the last choice stays.
        """
        world, c = wp.tid()
        if active[world] == 0 or con.single_point[c] == 0:
            return
        scr.chosen_facet[world, c] = -1
        if fresh != 0:
            scr.choice_count[world, c] = 0
        elif scr.choice_count[world, c] >= MAX_POINT_CHOICES:
            return
        best = row_start[c]
        for row in range(best + 1, row_start[c + 1]):
            if scr.facet_max_depth[world, row] > scr.facet_max_depth[world, best]:
                best = row
        scr.chosen_facet[world, c] = best
        scr.choice_count[world, c] = scr.choice_count[world, c] + 1
        if fresh != 0 or scr.facet_deepest_point[world, best] != scr.contact_point[world, c]:
            changed[world] = 1
        scr.contact_point[world, c] = scr.facet_deepest_point[world, best]

    @wp.kernel(module=module)
    def set_contact_point(
        con: Contacts, col: Colliders, facets: Facets, his: History, clock: Clock, u_n: wp.array2d(dtype=vec3),
        v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), settled: int, scr: ContactScratch,
    ):  # fmt: skip
        """Shape values of the chosen contact point and its position at the start of the attempt; `settled`: at a
        state."""
        world, item = wp.tid()
        c = facets.contact[item]
        if active[world] == 0 or facets.tracks_deepest == 0 or scr.chosen_facet[world, c] != facets.first_row + item:
            return
        point = scr.contact_point[world, c]
        row = facets.first_row + item
        near = point - (facets.first_point + item * facets.point_count)
        moved = wp.length_sq(scr.facet_deepest_xi[world, row] - facets.point_coords[near]) > f64(0.0)
        X = vec3d()
        origin = vec3d()
        v = vec3d()
        for i in range(facets.conn.shape[0]):
            w = f64(facets.shape[near, i, item])
            if moved:
                w = f64(0.0)
                for q in range(facets.point_count):
                    w += f.lagrange_polynomial(facets, q, scr.facet_deepest_xi[world, row]) * f64(
                        facets.shape[q, i, item]
                    )
            scr.shape_values[world, c, i] = T(w)
            w = f64(T(w))
            origin += w * vec3d(u_n[world, facets.conn[i, item]])
            v += w * vec3d(v_n[world, facets.conn[i, item]])
        X = facets.X[near, item]
        if moved:
            X = vec3d()
            for q in range(facets.point_count):
                X += f.lagrange_polynomial(facets, q, scr.facet_deepest_xi[world, row]) * facets.X[q, item]
        scr.point_reference[world, c] = X
        rec = f.history_row(con, c, point)
        k = col.of_contact[c]
        rotation = col.previous_rotation[world, k]
        y = wp.transpose(rotation) * (X + origin - col.previous_position[world, k])
        in_contact = settled == 0 and his.speed[world, rec] > f64(0.0)
        side = stored_side(in_contact, his.contact_state[world, rec])
        now = f.activation_gap(con, his, world, c, point, clock.time[world], col.previous_margin[world, k])
        n = geometry.set_start(col, scr, world, k, point, y, side, now)
        scr.start_displacement[world, point] = origin
        speed = f64(0.0)
        if clock.is_static == 0:
            approach = wp.dot(rotation * n, geometry.material_velocity(col, clock, world, k, y) - v)
            # a rolling contact point descends initially at twice its mean speed
            rolled = f.depth_at_start(con, facets, his, scr, world, c, item, point) - scr.start_depth[world, point]
            speed = approach - f64(2.0) * rolled / clock.h[world]
        scr.approach_speed[world, point] = f.approach_speed(his, world, rec, speed)

    return kernel_set(locals())
