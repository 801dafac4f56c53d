"""Contact of points of a body with facets of another: forces, tangent, frozen friction quantities.

The law is that of contact with obstacles. Depth is the distance from the projection on the master's facet: the normal
force, its derivative, acts there by the shape functions of the facet, along a line through the point. Friction acts at
the point's own coordinates, by the shape functions of the master's material there. So force and moment balance, and the
force is that of a potential of the iterate, nearly continuous where a point passes to the next facet, for any strain.
"""

import functools
import types as _types

import warp as wp

from ..common.lanes import lane_functions
from ..common.types import SHORT_UNROLL, kernel_module, kernel_set, precision
from .assembly import FORCE_ONLY, INACTIVE, WITH_STIFFNESS
from .facet_search import PENETRATED
from .facet_structs import master_struct, pair_history_struct, pair_scratch_struct
from .laws import law_functions
from .point import contact_point_functions
from .projection import facet_projection_functions
from .structs import (
    clock_struct,
    contact_scratch_struct,
    contact_struct,
    facet_struct,
    history_struct,
    world_value,
)

__all__ = ["pair_functions", "pair_kernels"]


@functools.cache
def pair_functions(dtype: str) -> _types.SimpleNamespace:
    """Device function `evaluate_pair_point`."""
    f64 = wp.float64
    Contacts, ContactScratch, PairScratch = (
        contact_struct(False),
        contact_scratch_struct(dtype),
        pair_scratch_struct(dtype),
    )
    k, normal_law = contact_point_functions(dtype, False), law_functions().normal_law
    PointContact, with_friction_normal, normal_damping_rate = (
        k.PointContact,
        k.with_friction_normal,
        k.normal_damping_rate,
    )

    @wp.func
    def evaluate_pair_point(
        con: Contacts, scr: ContactScratch, pair: PairScratch, world: int, c: int, point: int, inv_h: f64
    ) -> PointContact:
        """A point on its facet."""
        out = PointContact()
        out.normal = pair.normal[world, point]
        out.depth = pair.depth[world, point]
        out.depth_increment = out.depth - pair.initial_depth[world, point]
        k_n = con.scale[world, c] * world_value(con.normal_stiffness, world, c)
        rate = normal_damping_rate(con, scr, world, c, point, inv_h)
        out.normal_values = normal_law(con.law[c], 0, k_n, rate, con.damping_ramp[c], con.force_eps[c], out.depth,
                             pair.initial_depth[world, point])  # fmt: skip
        out.relative_motion = pair.relative_motion[world, point]
        out.trial_displacement = pair.trial_displacement[world, point]
        return with_friction_normal(out, wp.normalize(out.normal))

    return kernel_set(locals())


@functools.cache
def pair_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels in one precision of the displacements."""
    p = precision(dtype)
    T, vec2, vec3, sym = p.T, p.vec2, p.vec3, p.sym
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets, History = contact_struct(False), facet_struct(dtype), history_struct()
    ContactScratch, Clock = contact_scratch_struct(dtype), clock_struct()
    Masters, PairHistory, PairScratch = master_struct(dtype), pair_history_struct(), pair_scratch_struct(dtype)
    k, places = contact_point_functions(dtype, False), facet_projection_functions(dtype)
    PointContact, evaluate_pair_point = k.PointContact, pair_functions(dtype).evaluate_pair_point
    with_friction_normal, friction_parameters, set_explicit_force = (
        k.with_friction_normal,
        k.friction_parameters,
        k.set_explicit_force,
    )
    friction_potential, friction_force, point_stiffness = k.friction_potential, k.friction_force, k.point_stiffness
    surface_point, shape_value = places.surface_point, places.shape_value
    lane_sum = lane_functions(dtype).lane_sum
    module = kernel_module(f"pairs_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.kernel(module=module)
    def explicit_forces(
        con: Contacts, mas: Masters, facets: Facets, his: History, pair_his: PairHistory, clock: Clock,
        v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), scr: ContactScratch, pair: PairScratch,
    ):  # fmt: skip
        """Forces of explicit contacts at the state that the attempt begins from."""
        world, item, q = wp.tid()
        c = facets.contact[item]
        point = facets.first_point + item * facets.point_count + q
        if active[world] == 0 or facets.area_fraction[q, item] == f64(0.0) or con.is_explicit[c] == 0:
            return
        scr.explicit_force[world, point] = vec3d()
        scr.explicit_elastic_slip[world, point] = vec3d()
        delta = scr.start_depth[world, point]
        if delta <= f64(0.0):
            return
        f = pair_his.facet[world, point] - 1
        xi = pair.anchor_xi[world, point]
        s = surface_point(mas, pair.start_u_coefs, pair.start_director_u_coefs, world, f, xi)
        n = wp.normalize(wp.cross(s.tangent_a, s.tangent_b))
        projection = vec3d(xi[0], xi[1], f64(0.0))
        v = k.interpolate(facets, v_n, world, q, item) - places.polynomial_value(
            mas, pair.start_v_coefs, pair.start_v_coefs, world, f, projection
        )
        set_explicit_force(con, his, scr, world, c, point, delta, n, v, clock.h[world])

    @wp.func
    def relative_displacement(
        mas: Masters, facets: Facets, pair: PairScratch, u: wp.array2d(dtype=vec3d), world: int, q: int, item: int,
        point: int, f: int,
    ) -> vec3d:  # fmt: skip
        """Displacement of a point relative to a facet, by the frozen shape values."""
        out = k.interpolate(facets, u, world, q, item)
        for i in range(mas.conn.shape[0]):
            out -= f64(pair.friction_shape[world, point, i]) * vec3d(u[world, mas.conn[i, f]])
        return out

    @wp.func
    def freeze_friction_shapes(
        mas: Masters, facets: Facets, pair: PairScratch, u: wp.array2d(dtype=vec3d), world: int, q: int, item: int,
        point: int, f: int,
    ):  # fmt: skip
        """Freeze the shape values of friction: store motion and relative displacement at this iterate."""
        pair.frozen_motion[world, point] = pair.relative_motion[world, point]
        pair.frozen_trial_displacement[world, point] = pair.trial_displacement[world, point]
        pair.frozen_displacement[world, point] = relative_displacement(mas, facets, pair, u, world, q, item, point, f)
        pair.frozen_facet[world, point] = f

    @wp.kernel(module=module)
    def update_friction_shapes(
        mas: Masters, facets: Facets, u: wp.array2d(dtype=vec3d), flags: wp.array(dtype=wp.int32), scr: ContactScratch,
        pair: PairScratch,
    ):  # fmt: skip
        """Update the shape values of friction to those of the iterate."""
        world, item, q = wp.tid()
        point = facets.first_point + item * facets.point_count + q
        if flags[world] == 0 or scr.activity[world, point] != WITH_STIFFNESS:
            return
        f = pair.facet[world, point]
        for i in range(mas.conn.shape[0]):
            pair.friction_shape[world, point, i] = T(shape_value(mas, f, i, pair.xi[world, point]))
        freeze_friction_shapes(mas, facets, pair, u, world, q, item, point, f)

    @wp.func
    def set_geometric_stiffness(mas: Masters, pair: PairScratch, world: int, point: int, f: int, gap: f64, force: f64):
        """Geometric stiffness of the normal force: rotation of the facet under a force, and motion of the projection.

        With the relative displacement d at the projection, e_a = n.(change of the tangent a_a), t_a = a_a.d, b the
        curvature, M = a - gap b and m its inverse, it is 2 t m e + gap e m e + t a^-1 b m t (Wriggers, Computational
        Contact Mechanics, 2006, 4.1, with the facet's curvature). `geometric_tangent`: force m a;
        `geometric_curvature`: force gap m, and M a^-1 b / force.
        """
        xi = pair.projection[world, point]
        n = pair.normal[world, point]
        s = surface_point(mas, pair.u_coefs, pair.director_u_coefs, world, f, xi)
        b = places.second_derivatives(mas, pair.u_coefs, world, f, xi, n)
        ta, tb = s.tangent_a, s.tangent_b
        aa, bb, ab = wp.dot(ta, ta), wp.dot(tb, tb), wp.dot(ta, tb)
        A = wp.mat22d(aa, ab, ab, bb)
        B = wp.mat22d(b[0], b[2], b[2], b[1])
        M = A - gap * B
        det = wp.determinant(M)
        pair.geometric_tangent[world, point, 0] = vec3()
        pair.geometric_tangent[world, point, 1] = vec3()
        pair.geometric_curvature[world, point] = sym()
        if force <= f64(0.0) or det <= f64(0.1) * wp.determinant(A):
            return  # no projection beyond the centre of curvature
        m = force * wp.inverse(M)
        pair.geometric_tangent[world, point, 0] = vec3(m[0, 0] * ta + m[0, 1] * tb)
        pair.geometric_tangent[world, point, 1] = vec3(m[1, 0] * ta + m[1, 1] * tb)
        N = (M @ wp.inverse(A) @ B) / force
        pair.geometric_curvature[world, point] = sym(T(gap * m[0, 0]), T(gap * m[1, 1]), T(gap * m[0, 1]), T(N[0, 0]),
            T(N[1, 1]),
                                   T(N[0, 1]))  # fmt: skip

    @wp.func
    def apply_explicit_force(
        mas: Masters, scr: ContactScratch, pair: PairScratch, world: int, point: int, f: int, area_fraction: f64
    ):
        """Explicit force of a point, applied at its position at the start of the attempt."""
        work = -area_fraction * wp.dot(scr.explicit_force[world, point], pair.relative_motion[world, point])
        scr.activity[world, point] = FORCE_ONLY
        scr.force[world, point] = -area_fraction * scr.explicit_force[world, point]
        scr.energy[world, point] = wp.vec2d(work, wp.abs(work))
        pair.tangential_force[world, point] = vec3d()
        for i in range(mas.conn.shape[0]):
            pair.shape_values[world, point, i] = T(shape_value(mas, f, i, pair.anchor_xi[world, point]))

    @wp.func
    def reject_point(scr: ContactScratch, pair: PairScratch, world: int, point: int):
        """Infinite potential of a point that has passed through a body: the iterate is refused."""
        scr.passed_point[world] = point + 1
        scr.activity[world, point] = FORCE_ONLY
        scr.force[world, point] = vec3d()
        pair.tangential_force[world, point] = vec3d()
        scr.energy[world, point] = wp.vec2d(f64(wp.inf), f64(0.0))

    @wp.func
    def freeze_friction(
        con: Contacts, his: History, scr: ContactScratch, world: int, c: int, point: int, s: PointContact, fresh: int
    ) -> vec3d:
        """Frozen friction limit, k_t and spring factor of a point; `fresh`: they and the normal are those of s."""
        frozen = scr.frozen_friction[world, point]
        new = friction_parameters(con, his, scr, world, c, point, s)
        if fresh != 0:
            scr.frozen_normal[world, point] = s.friction_normal
            frozen = new
            frozen[0] = wp.min(new[0], his.friction_limit[world, point])
            scr.frozen_friction[world, point] = frozen
        frozen[1] = new[1]
        frozen[2] = f64(1.0)
        scr.updated_normal[world, point] = s.friction_normal
        scr.updated_friction[world, point] = new
        return frozen

    @wp.func
    def set_master_shapes(mas: Masters, pair: PairScratch, world: int, point: int, f: int, friction: bool):
        """Shape values of the master's slots at the projection of a point, those of friction at its coordinates."""
        for i in range(mas.conn.shape[0]):
            pair.shape_values[world, point, i] = T(shape_value(mas, f, i, pair.projection[world, point]))
            pair.shape_gradient[world, point, i] = vec2(
                places.shape_gradients(mas, f, i, pair.projection[world, point])
            )
            if friction:
                pair.friction_shape[world, point, i] = T(shape_value(mas, f, i, pair.xi[world, point]))

    @wp.func
    def store_force(
        con: Contacts, mas: Masters, scr: ContactScratch, pair: PairScratch, world: int, c: int, point: int, f: int,
        s: PointContact, frozen: vec3d, inv_h: f64, area_fraction: f64,
    ):  # fmt: skip
        """Normal force and friction of a point on its facet, their potential, and the stiffness, N/m."""
        friction_energy = friction_potential(con, world, c, s, frozen, inv_h)
        K = point_stiffness(con, world, c, s, frozen, inv_h)
        tangential_force = area_fraction * friction_force(con, world, c, s, frozen, inv_h)
        scr.activity[world, point] = WITH_STIFFNESS
        pair.tangential_force[world, point] = tangential_force
        set_geometric_stiffness(
            mas, pair, world, point, f, scr.activation_gap[world, point] - s.depth, area_fraction * s.normal_values[0]
        )
        scr.force[world, point] = tangential_force - (area_fraction * s.normal_values[0]) * s.normal
        scr.energy[world, point] = wp.vec2d(
            area_fraction * (s.normal_values[2] + friction_energy),
            area_fraction * (s.normal_values[3] + wp.abs(friction_energy)),
        )
        scr.stiffness[world, point] = sym(T(area_fraction * K[0, 0]), T(area_fraction * K[1, 1]),
            T(area_fraction * K[2, 2]), T(area_fraction * K[1, 2]), T(area_fraction * K[0, 2]),
            T(area_fraction * K[0, 1]))  # fmt: skip

    @wp.func
    def update_listed_facet(scr: ContactScratch, pair: PairScratch, world: int, point: int, f: int):
        """Facet whose list contains a point: its own where it has a force."""
        wanted = wp.int32(0)
        if scr.activity[world, point] != INACTIVE and f >= 0:
            wanted = f + 1
        if pair.listed_facet[world, point] != wanted:
            pair.listed_facet[world, point] = wanted
            pair.lists_changed[0] = 1

    @wp.kernel(module=module)
    def forces(
        con: Contacts, mas: Masters, facets: Facets, his: History, pair_his: PairHistory, clock: Clock,
        u: wp.array2d(dtype=vec3d), active: wp.array(dtype=wp.int32), fresh: int, scr: ContactScratch,
        pair: PairScratch,
    ):  # fmt: skip
        """Forces on points, their stiffness and potential; friction limits and shape values of friction are frozen."""
        world, item, q = wp.tid()
        if active[world] == 0:
            return
        c = facets.contact[item]
        point = facets.first_point + item * facets.point_count + q
        area_fraction = facets.area_fraction[q, item]
        scr.activity[world, point] = INACTIVE
        f = pair.facet[world, point]
        if con.is_explicit[c] != 0 and area_fraction > f64(0.0):
            if wp.length_sq(scr.explicit_force[world, point]) > f64(0.0):
                f = pair_his.facet[world, point] - 1
                apply_explicit_force(mas, scr, pair, world, point, f, area_fraction)
        elif f == PENETRATED:
            reject_point(scr, pair, world, point)
            f = -1
        elif f >= 0 and area_fraction > f64(0.0):
            inv_h = f64(0.0)
            if clock.is_static == 0:
                inv_h = f64(1.0) / clock.h[world]
            s = evaluate_pair_point(con, scr, pair, world, c, point, inv_h)
            frozen = freeze_friction(con, his, scr, world, c, point, s, fresh)
            m = scr.frozen_normal[world, point]
            if wp.dot(m, s.friction_normal) <= f64(0.5):  # the point has passed to another facet since
                m = s.friction_normal
                scr.frozen_normal[world, point] = m
            set_master_shapes(mas, pair, world, point, f, fresh != 0 or frozen[0] <= f64(0.0))
            if fresh != 0:
                freeze_friction_shapes(mas, facets, pair, u, world, q, item, point, f)
            if frozen[0] > f64(0.0):  # frozen shape values: friction has a potential
                shift = relative_displacement(
                    mas, facets, pair, u, world, q, item, point, pair.frozen_facet[world, point]
                )
                s.relative_motion = pair.frozen_motion[world, point] + (shift - pair.frozen_displacement[world, point])
                s.trial_displacement = pair.frozen_trial_displacement[world, point] + (
                    shift - pair.frozen_displacement[world, point]
                )
            s = with_friction_normal(s, m)
            if s.depth > f64(0.0) or frozen[0] > f64(0.0):
                store_force(con, mas, scr, pair, world, c, point, f, s, frozen, inv_h, area_fraction)
        elif area_fraction > f64(0.0):
            frozen = vec3d()
            scr.updated_friction[world, point] = frozen
            if fresh != 0:
                scr.frozen_friction[world, point] = frozen
                scr.frozen_normal[world, point] = frozen
        update_listed_facet(scr, pair, world, point, f)

    @wp.kernel(module=module)
    def gather_master_forces(
        mas: Masters, active: wp.array(dtype=wp.int32), lanes: int, scr: ContactScratch, pair: PairScratch,
        pool: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """Forces of points on the slots of their master facets."""
        world, index = wp.tid()
        if active[world] == 0:
            return
        entry = wp.min(index / lanes, mas.facet_count * mas.conn.shape[0] - 1)
        f = entry % mas.facet_count
        i = entry / mas.facet_count
        total = vec3()
        first = pair.list_start[world, f]
        for k in range(index % lanes, pair.list_size[world, f], lanes):
            point = pair.list_point[world, first + k]
            tangential_force = pair.tangential_force[world, point]
            total -= pair.shape_values[world, point, i] * vec3(scr.force[world, point] - tangential_force)
            total -= pair.friction_shape[world, point, i] * vec3(tangential_force)
        total = lane_sum(total, lanes)
        if index % lanes == 0:
            pool[world, mas.first_entry + entry] = total

    @wp.func
    def multiply_symmetric(k: sym, p: vec3) -> vec3:
        """The symmetric matrix k (Voigt) times p."""
        return vec3(k[0] * p[0] + k[5] * p[1] + k[4] * p[2], k[5] * p[0] + k[1] * p[1] + k[3] * p[2],
                    k[4] * p[0] + k[3] * p[1] + k[2] * p[2])  # fmt: skip

    @wp.kernel(module=module)
    def point_products(
        mas: Masters, facets: Facets, active: wp.array(dtype=wp.int32), p: wp.array2d(dtype=vec3), scr: ContactScratch,
        pair: PairScratch,
    ):  # fmt: skip
        """K times the relative displacement of each point."""
        world, item, q = wp.tid()
        if active[world] == 0 or scr.facet_activity[world, facets.first_row + item] != WITH_STIFFNESS:
            return
        point = facets.first_point + item * facets.point_count + q
        if scr.activity[world, point] != WITH_STIFFNESS:
            scr.point_product[world, point] = vec3()
            pair.facet_rotation[world, point] = vec2()
            return
        f = pair.listed_facet[world, point] - 1
        n = vec3(pair.normal[world, point])
        d = vec3()
        e = vec2()
        for i in range(facets.conn.shape[0]):
            d += facets.shape[q, i, item] * p[world, facets.conn[i, item]]
        for i in range(mas.conn.shape[0]):
            own = p[world, mas.conn[i, f]]
            d -= pair.shape_values[world, point, i] * own
            e += wp.dot(n, own) * pair.shape_gradient[world, point, i]
        a = pair.geometric_tangent[world, point, 0]
        b = pair.geometric_tangent[world, point, 1]
        g = pair.geometric_curvature[world, point]
        tau = vec2(wp.dot(a, d), wp.dot(b, d))
        scr.point_product[world, point] = (
            multiply_symmetric(scr.stiffness[world, point], d)
            + (e[0] + g[3] * tau[0] + g[5] * tau[1]) * a
            + (e[1] + g[5] * tau[0] + g[4] * tau[1]) * b
        )
        pair.facet_rotation[world, point] = tau + vec2(g[0] * e[0] + g[2] * e[1], g[2] * e[0] + g[1] * e[1])

    @wp.kernel(module=module)
    def gather_pair_products(
        mas: Masters, facets: Facets, active: wp.array(dtype=wp.int32), lanes: int, last: int, scr: ContactScratch,
        pair: PairScratch, pool: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """Sums of the products on the slots of the slave facets, and of master facets where the launch includes
        them."""
        world, index = wp.tid()
        if active[world] == 0:
            return
        out = vec3()
        own = facets.facet_count * facets.conn.shape[0]
        entry = wp.min(index / lanes, last)
        lane = index % lanes
        place = facets.first_entry + entry
        if entry < own:
            item = entry % facets.facet_count
            i = entry / facets.facet_count
            first_point = facets.first_point + item * facets.point_count
            if scr.facet_activity[world, facets.first_row + item] == WITH_STIFFNESS:
                for q in range(lane, facets.point_count, lanes):
                    out += facets.shape[q, i, item] * scr.point_product[world, first_point + q]
        else:
            entry -= own
            place = mas.first_entry + entry
            f = entry % mas.facet_count
            i = entry / mas.facet_count
            first = pair.list_start[world, f]
            for k in range(lane, pair.list_size[world, f], lanes):
                point = pair.list_point[world, first + k]
                out -= pair.shape_values[world, point, i] * scr.point_product[world, point]
                out += wp.dot(pair.shape_gradient[world, point, i], pair.facet_rotation[world, point]) * vec3(
                    pair.normal[world, point]
                )
        out = lane_sum(out, lanes)
        if lane == 0:
            pool[world, place] = out

    @wp.kernel(module=module)
    def master_diagonal(
        mas: Masters, active: wp.array(dtype=wp.int32), scr: ContactScratch, pair: PairScratch,
        pool: wp.array2d(dtype=sym)
    ):  # fmt: skip
        """3x3 diagonal blocks of master facets."""
        world, f, i = wp.tid()
        if active[world] == 0:
            return
        out = sym()
        for k in range(pair.list_size[world, f]):
            point = pair.list_point[world, pair.list_start[world, f] + k]
            if scr.activity[world, point] == WITH_STIFFNESS:
                s = pair.shape_values[world, point, i]
                out += s * s * scr.stiffness[world, point]
        pool[world, mas.first_entry + i * mas.facet_count + f] = out

    return kernel_set(locals())
