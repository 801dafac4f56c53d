"""Points against facets of bodies: the geometry of facets, from what the facet search has found for a point.

Depth is the distance from the projection on the master's facet: the normal force, its derivative, acts there by the
shape functions of the facet, along a line through the point. Friction acts at the point's own coordinates, by the shape
functions of the master's material there. So force and moment balance, and the force is that of a potential of the
iterate, nearly continuous where a point passes to the next facet, for any strain. In midpoint schemes midpoint.py moves
the force to the middle of the step.
"""

import functools

import warp as wp

from ..common.lanes import lane_functions
from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import f64, precision, vec3d
from .carriers import END, carrier_functions
from .facet_search import PENETRATED, facet_search_kernels
from .facet_structs import facet_side_struct, master_struct, pair_scratch_struct
from .kinematics import GEOMETRIES, kinematics_functions
from .projection import facet_projection_functions
from .structs import FREE, IN_REACH, INACTIVE, PASSED, TURNED, WITH_STIFFNESS, contact_structs

__all__ = ["facet_kinematics", "master_kernels"]


@functools.cache
def facet_kinematics(dtype: str) -> KernelSet:
    """Device functions of the geometry, see kinematics.py."""
    p = precision(dtype)
    T, vec2, vec3, sym = p.T, p.vec2, p.vec3, p.sym
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    Masters, PairScratch, Other = master_struct(dtype), pair_scratch_struct(dtype), facet_side_struct(dtype)
    k, f_, search = kinematics_functions(dtype), facet_projection_functions(dtype), facet_search_kernels(dtype)
    surface_point, shape_value, facet_value = f_.surface_point, f_.shape_value, f_.facet_value
    carriers = carrier_functions(dtype)

    @wp.func
    def begin_point(
        con: Contacts, other: Other, facets: Facets, his: History, clock: Clock, scr: ContactScratch,
        u_n: wp.array2d(dtype=vec3), v_n: wp.array2d(dtype=vec3), world: int, item: int, q: int,
    ):  # fmt: skip
        """Start position of a point; depth and approach speed of one in contact."""
        if not k.is_edge(facets, item):
            search.begin_point(con, other.masters, facets, his, other.history, clock, scr, other.scratch, u_n, v_n,
                               search.slave_point(facets, world, item, q))  # fmt: skip

    @wp.func
    def start_motion(
        con: Contacts, other: Other, facets: Facets, his: History, clock: Clock, scr: ContactScratch,
        v_n: wp.array2d(dtype=vec3), world: int, item: int, q: int,
    ):  # fmt: skip
        """Normal, and velocity of a point relative to the facet, m/s, at the start of the attempt."""
        point = facets.first_point + item * facets.point_count + q
        f = other.history.facet[world, point] - 1
        xi = other.scratch.anchor_xi[world, point]
        s = surface_point(other.masters, other.scratch.start_displacement, world, f, xi)
        v = k.interpolate(facets, v_n, world, q, item)
        return f_.unit_normal(s), v - facet_value(other.masters, other.scratch.start_velocity, world, f, xi)

    @wp.func
    def evaluate(
        con: Contacts, other: Other, facets: Facets, his: History, scr: ContactScratch, world: int, q: int, item: int,
        point: int, u: wp.array2d(dtype=vec3d), time: f64,
    ) -> PointContact:  # fmt: skip
        """The record of a point, as the facet search has found it at displacements u."""
        out = PointContact()
        f = other.scratch.facet[world, point]
        out.feature = f
        out.relative_motion = other.scratch.relative_motion[world, point]
        if f < 0:
            out.state = wp.where(f == PENETRATED and con.is_explicit[facets.contact[item]] == 0, PASSED, FREE)
            return out
        out.state = IN_REACH
        out.position = k.position_at(facets, q, k.column(facets, world, item)) + carriers.displacement(
            other.masters, facets, other.scratch, u, world, q, item, END
        )
        out.normal = other.scratch.normal[world, point]
        out.depth = other.scratch.depth[world, point]
        if out.depth > f64(0.0) and search.has_turned_over(other.scratch, world, f):
            out.state = TURNED
        out.previous_depth = other.scratch.initial_depth[world, point]
        out.spring = other.scratch.spring[world, point]
        depth = other.masters.element_depth[f]
        out.stiffness_ratio = k.stiffness_ratio(con, facets, world, facets.contact[item], item, depth)
        return out

    @wp.func
    def relative_displacement(
        mas: Masters, facets: Facets, pair: PairScratch, u: wp.array2d(dtype=vec3d), world: int, q: int, item: int,
        point: int, f: int,
    ) -> vec3d:  # fmt: skip
        """Displacement of a point relative to a facet, by the frozen shape values."""
        out = k.interpolate_at(facets, u, world, q, item, k.frozen_column(facets, world, item))
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
        pair.frozen_spring[world, point] = pair.spring[world, point]
        pair.frozen_displacement[world, point] = relative_displacement(mas, facets, pair, u, world, q, item, point, f)
        pair.frozen_facet[world, point] = f

    @wp.func
    def set_master_shapes(mas: Masters, pair: PairScratch, world: int, point: int, f: int, friction: bool):
        """Shape values of the master's slots at the projection of a point, those of friction at its coordinates."""
        for i in range(mas.conn.shape[0]):
            pair.shape_values[world, point, i] = T(shape_value(mas, f, i, pair.projection[world, point]))
            pair.shape_gradient[world, point, i] = vec2(f_.shape_gradients(mas, f, i, pair.projection[world, point]))
            if friction:
                pair.friction_shape[world, point, i] = T(shape_value(mas, f, i, pair.friction_xi[world, point]))

    @wp.func
    def frozen_motion(
        other: Other, facets: Facets, scr: ContactScratch, u: wp.array2d(dtype=vec3d), world: int, q: int, item: int,
        point: int, t: PointContact, limit: f64, fresh: int,
    ) -> PointContact:  # fmt: skip
        """The record with the motion by frozen shape values, by which friction has a potential."""
        out = t
        if wp.dot(scr.frozen_normal[world, point], t.normal) <= f64(0.5):
            scr.frozen_normal[world, point] = t.normal  # the point has passed to another facet since
        renew = fresh != 0 or limit <= f64(0.0)
        set_master_shapes(other.masters, other.scratch, world, point, t.feature, renew)
        if renew:
            k.freeze_shape(facets, world, q, item)
        if fresh != 0:
            freeze_friction_shapes(other.masters, facets, other.scratch, u, world, q, item, point, t.feature)
        if limit > f64(0.0):
            f = other.scratch.frozen_facet[world, point]
            shift = relative_displacement(other.masters, facets, other.scratch, u, world, q, item, point, f)
            shift -= other.scratch.frozen_displacement[world, point]
            out.relative_motion = other.scratch.frozen_motion[world, point] + shift
            out.spring = other.scratch.frozen_spring[world, point]
        return out

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
        s = surface_point(mas, pair.displacement, world, f, xi)
        b = f_.second_derivatives(mas, pair.displacement, world, f, xi, n)
        ta, tb = s.tangent_a, s.tangent_b
        aa, bb, ab = wp.dot(ta, ta), wp.dot(tb, tb), wp.dot(ta, tb)
        A = wp.mat22d(aa, ab, ab, bb)
        B = wp.mat22d(b[0], b[2], b[2], b[1])
        M = A - gap * B
        det = wp.determinant(M)
        at_edge = wp.dot(n, f_.unit_normal(s)) < f64(0.99)
        pair.geometric_tangent[world, point, 0] = vec3()
        pair.geometric_tangent[world, point, 1] = vec3()
        pair.geometric_curvature[world, point] = sym()
        if force <= f64(0.0) or at_edge or det <= f64(0.1) * wp.determinant(A):
            return  # no projection beyond the centre of curvature
        m = force * wp.inverse(M)
        pair.geometric_tangent[world, point, 0] = vec3(m[0, 0] * ta + m[0, 1] * tb)
        pair.geometric_tangent[world, point, 1] = vec3(m[1, 0] * ta + m[1, 1] * tb)
        N = (M @ wp.inverse(A) @ B) / force
        pair.geometric_curvature[world, point] = sym(T(gap * m[0, 0]), T(gap * m[1, 1]), T(gap * m[0, 1]), T(N[0, 0]),
            T(N[1, 1]),
                                   T(N[0, 1]))  # fmt: skip

    @wp.func
    def transmit(
        con: Contacts, other: Other, scr: ContactScratch, world: int, c: int, point: int, t: PointContact,
        friction: vec3d,
    ):  # fmt: skip
        """Set friction, geometric stiffness and shape values for the facet's slots, and the list that a point is in."""
        f = wp.int32(-1)
        if scr.activity[world, point] == WITH_STIFFNESS:
            f = t.feature
            pressed = wp.dot(friction - scr.force[world, point], t.normal)
            gap = scr.activation_gap[world, point] - t.depth
            set_geometric_stiffness(other.masters, other.scratch, world, point, f, gap, pressed)
        elif scr.activity[world, point] != INACTIVE and con.is_explicit[c] != 0:  # at its position at the start
            f = other.history.facet[world, point] - 1
            xi = other.scratch.anchor_xi[world, point]
            for i in range(other.masters.conn.shape[0]):
                other.scratch.shape_values[world, point, i] = T(shape_value(other.masters, f, i, xi))
        if scr.activity[world, point] != INACTIVE:
            other.scratch.tangential_force[world, point] = friction
        if other.scratch.listed_facet[world, point] != f + 1:
            other.scratch.listed_facet[world, point] = f + 1
            other.scratch.lists_changed[0] = 1

    @wp.func
    def other_product(
        other: Other, scr: ContactScratch, p: wp.array2d(dtype=vec3), world: int, point: int, d: vec3
    ) -> vec3:  # fmt: skip
        """Force for a direction p, N, with the point's own displacement d; stores the rotation of the facet."""
        other.scratch.facet_rotation[world, point] = vec2()
        if scr.activity[world, point] != WITH_STIFFNESS:
            return vec3()
        f = other.scratch.listed_facet[world, point] - 1
        n = vec3(other.scratch.normal[world, point])
        e = vec2()
        r = d
        for i in range(other.masters.conn.shape[0]):
            own = p[world, other.masters.conn[i, f]]
            r -= other.scratch.shape_values[world, point, i] * own
            e += wp.dot(n, own) * other.scratch.shape_gradient[world, point, i]
        a = other.scratch.geometric_tangent[world, point, 0]
        b = other.scratch.geometric_tangent[world, point, 1]
        g = other.scratch.geometric_curvature[world, point]
        tau = vec2(wp.dot(a, r), wp.dot(b, r))
        other.scratch.facet_rotation[world, point] = tau + vec2(g[0] * e[0] + g[2] * e[1], g[2] * e[0] + g[1] * e[1])
        return (
            k.multiply_symmetric(scr.stiffness[world, point], r)
            + (e[0] + g[3] * tau[0] + g[5] * tau[1]) * a
            + (e[1] + g[5] * tau[0] + g[4] * tau[1]) * b
        )

    @wp.func
    def gather_other_product(
        other: Other, scr: ContactScratch, world: int, entry: int, lane: int, lanes: int
    ) -> vec3:  # fmt: skip
        """Sum of the products on a slot of a master facet, part of a lane."""
        out = vec3()
        f = entry % other.masters.facet_count
        i = entry / other.masters.facet_count
        first = other.scratch.list_start[world, f]
        for j in range(lane, other.scratch.list_size[world, f], lanes):
            point = other.scratch.list_point[world, first + j]
            out -= other.scratch.shape_values[world, point, i] * scr.point_product[world, point]
            turned = wp.dot(other.scratch.shape_gradient[world, point, i], other.scratch.facet_rotation[world, point])
            out += turned * vec3(other.scratch.normal[world, point])
        return out

    @wp.func
    def other_entries(other: Other) -> int:
        """First pool entry of the master facets."""
        return other.masters.first_entry

    @wp.func
    def report_sign(other: Other, c: int) -> f64:
        """-1 where the points belong to the second side of a contact, as reports state the force on the first."""
        return f64(other.masters.sign[c])

    @wp.func
    def carried(con: Contacts, other: Other, world: int, c: int, t: PointContact) -> vec3d:
        """Minus the motion of an obstacle that carries its points, m: the force on these is that of the body."""
        return -carriers.motion_in_step(other.masters, other.scratch, world, c, t.position)

    @wp.func
    def slip_frame(other: Other, world: int, c: int, point: int, t: PointContact) -> wp.mat33d:
        """Axes of the facet at the point."""
        return search.facet_frame(
            surface_point(
                other.masters, other.scratch.displacement, world, t.feature,
                other.scratch.xi[world, point],
            )
        )  # fmt: skip

    @wp.func
    def touched_state(other: Other, world: int, c: int, point: int, t: PointContact) -> int:
        """Store the facet of a point in contact; its contact state."""
        other.history.facet[world, point] = t.feature + 1
        other.history.xi[world, point] = other.scratch.xi[world, point]
        return 1

    @wp.func
    def released_state(other: Other, his: History, world: int, c: int, point: int, rec: int) -> int:
        """Clear the facet of a point that is not in contact; its contact state."""
        other.history.facet[world, point] = 0
        other.history.xi[world, point] = vec3d()
        return 0

    @wp.func
    def store_side(other: Other, world: int, index: int):
        """Store the places of obstacles that carry their points; bodies are in the state."""
        for carrier in range(other.masters.carrier_law.shape[0]):
            other.history.carried[world, carrier] = other.scratch.carried_value[world, carrier]

    return kernel_set(locals())


GEOMETRIES["facets"] = facet_kinematics


@functools.cache
def master_kernels(dtype: str) -> KernelSet:
    """Kernels of master facets: sums over the points listed for each, and shape values of friction."""
    p = precision(dtype)
    T, vec3, sym = p.T, p.vec3, p.sym
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    Other = facet_side_struct(dtype)
    lane_sum, shape_value = lane_functions(dtype).lane_sum, facet_projection_functions(dtype).shape_value
    freeze_friction_shapes = facet_kinematics(dtype).freeze_friction_shapes
    freeze_shape = kinematics_functions(dtype).freeze_shape
    module = kernel_module(f"master_facets_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.kernel(module=module)
    def update_friction_shapes(
        other: Other, facets: Facets, u: wp.array2d(dtype=vec3d), flags: wp.array(dtype=wp.int32), scr: ContactScratch
    ):  # fmt: skip
        """Update the shape values of friction to those of the iterate."""
        world, item, q = wp.tid()
        point = facets.first_point + item * facets.point_count + q
        if flags[world] == 0 or scr.activity[world, point] != WITH_STIFFNESS:
            return
        f = other.scratch.facet[world, point]
        xi = other.scratch.friction_xi[world, point]
        for i in range(other.masters.conn.shape[0]):
            other.scratch.friction_shape[world, point, i] = T(shape_value(other.masters, f, i, xi))
        freeze_shape(facets, world, q, item)
        freeze_friction_shapes(other.masters, facets, other.scratch, u, world, q, item, point, f)

    @masked_kernel(module, "active")
    def gather_master_forces(
        other: Other, active: wp.array(dtype=wp.int32), lanes: int, scr: ContactScratch, pool: wp.array2d(dtype=vec3)
    ):  # fmt: skip
        """Forces of points on the slots of their master facets."""
        world, index = wp.tid()
        entry = wp.min(index / lanes, other.masters.facet_count * other.masters.conn.shape[0] - 1)
        f = entry % other.masters.facet_count
        i = entry / other.masters.facet_count
        total = vec3()
        first = other.scratch.list_start[world, f]
        for k in range(index % lanes, other.scratch.list_size[world, f], lanes):
            point = other.scratch.list_point[world, first + k]
            friction = other.scratch.tangential_force[world, point]
            total -= other.scratch.shape_values[world, point, i] * vec3(scr.force[world, point] - friction)
            total -= other.scratch.friction_shape[world, point, i] * vec3(friction)
        total = lane_sum(total, lanes)
        if index % lanes == 0:
            pool[world, other.masters.first_entry + entry] = total

    @masked_kernel(module, "active")
    def master_diagonal(
        other: Other, active: wp.array(dtype=wp.int32), scr: ContactScratch, pool: wp.array2d(dtype=sym)
    ):  # fmt: skip
        """3x3 diagonal blocks of master facets."""
        world, f, i = wp.tid()
        out = sym()
        for k in range(other.scratch.list_size[world, f]):
            point = other.scratch.list_point[world, other.scratch.list_start[world, f] + k]
            if scr.activity[world, point] == WITH_STIFFNESS:
                s = other.scratch.shape_values[world, point, i]
                out += s * s * scr.stiffness[world, point]
        pool[world, other.masters.first_entry + i * other.masters.facet_count + f] = out

    return kernel_set(locals())
