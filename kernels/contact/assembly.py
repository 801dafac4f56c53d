"""Contact of surface points with rigid shapes: forces, tangent, friction limits, explicit forces.

A point's force is the derivative of a scalar: `normal_law` of its depth, and `friction` of its anchored slip, whose
limit mu F_n is frozen during a line search and updated at each iterate. Gap and law are evaluated in float64.
"""

import functools
import types as _types

import warp as wp

from ..common.lanes import lane_functions
from ..common.types import SHORT_UNROLL, kernel_module, kernel_set, precision
from .colliders import MESH_SUFFIX, collider_functions
from .laws import SMOOTH
from .point import contact_point_functions
from .structs import clock_struct, contact_scratch_struct, contact_struct, facet_struct, history_struct

__all__ = ["AITKEN_LANES", "MAX_COLLIDER_ROTATION", "MIN_APPROACH_SPEED", "contact_kernels"]

MIN_APPROACH_SPEED = 1e-3
"""Lower bound of the approach speed in the damping of the default law, m/s."""
INACTIVE, FORCE_ONLY, WITH_STIFFNESS = 0, 1, 2
"""States of a point: no force; a force without tangent; a force with tangent."""
MAX_COLLIDER_ROTATION = 1.0
"""Largest rotation of a touched collider in a step, rad; larger rotations are rejected."""
AITKEN_LANES = 128
SLOW_REDUCTION = 0.35
"""Ratio of successive changes of the friction limits above which they are relaxed."""


@functools.cache
def contact_kernels(dtype: str, meshes: bool) -> _types.SimpleNamespace:
    """Kernels of contact in one precision of the displacements; `meshes`: some collider is a triangle mesh."""
    p = precision(dtype)
    T, vec3, sym = p.T, p.vec3, p.sym
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets = contact_struct(meshes), facet_struct(dtype)
    lane_sum = lane_functions(dtype).lane_sum
    History, ContactScratch, Clock = history_struct(), contact_scratch_struct(dtype), clock_struct()
    f = contact_point_functions(dtype, meshes)
    interpolate, history_row, activation_gap, is_acting, acting_shape_value = (
        f.interpolate,
        f.history_row,
        f.activation_gap,
        f.is_acting,
        f.acting_shape_value,
    )
    set_explicit_force, evaluate_point, with_friction_normal, friction_parameters = (
        f.set_explicit_force,
        f.evaluate_point,
        f.with_friction_normal,
        f.friction_parameters,
    )
    friction_potential, friction_force = f.friction_potential, f.friction_force
    point_stiffness = f.point_stiffness
    g = collider_functions(meshes)
    distance, stored_side, sheet_side = g.distance, g.stored_side, g.sheet_side
    module = kernel_module(f"contact_{dtype}{MESH_SUFFIX * meshes}", max_unroll=SHORT_UNROLL)

    @wp.kernel(module=module)
    def update_poses(
        con: Contacts, his: History, value: wp.array2d(dtype=vec3d), active: wp.array(dtype=wp.int32),
        scr: ContactScratch
    ):  # fmt: skip
        """Poses of the colliders at the end of the attempt, and their motion in it."""
        world, k = wp.tid()
        if active[world] == 0:
            return
        position = con.collider_center[k]
        rotation = con.collider_axes[k]
        if con.rotation_law[k] >= 0:
            angle = value[world, con.rotation_law[k]][0]
            n = con.rotation_axis[k]
            N = wp.skew(n)
            half = wp.sin(f64(0.5) * angle)
            R = wp.identity(n=3, dtype=f64) + wp.sin(angle) * N + (f64(2.0) * half * half) * (N * N)
            position = con.rotation_anchor[k] + R * (position - con.rotation_anchor[k])
            rotation = R * rotation
        if con.translation_law[k] >= 0:
            position += value[world, con.translation_law[k]]
        if k == 0:
            scr.limit_updates[world] = 0
        scr.collider_position[world, k] = position
        scr.collider_rotation[world, k] = rotation
        scr.collider_translation[world, k] = position - his.position[world, k]
        if con.rotation_law[k] >= 0:
            scr.collider_angle[world, k] = value[world, con.rotation_law[k]][0]
            scr.collider_rotation_change[world, k] = rotation * wp.transpose(his.rotation[world, k]) - wp.identity(
                n=3, dtype=f64
            )

    @wp.kernel(module=module)
    def begin_points(
        con: Contacts, facets: Facets, his: History, clock: Clock, u_n: wp.array2d(dtype=vec3),
        v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), scr: ContactScratch,
    ):  # fmt: skip
        """Positions of the points at the start of an attempt, and the approach speed of the damping."""
        world, item, q = wp.tid()
        if active[world] == 0:
            return
        if q == 0 and item == 0 and facets.first_row == 0:
            scr.passed_point[world] = 0
            if clock.substep_index[world] == 0:
                scr.elapsed_time[world] = f64(0.0)
        if facets.area_fraction[q, item] == f64(0.0):
            return
        c = facets.contact[item]
        point = facets.first_point + item * facets.point_count + q
        rec = history_row(con, c, point)
        k = con.collider[c]
        x = facets.X[q, item] + interpolate(facets, u_n, world, q, item)
        rotation = his.rotation[world, k]
        y = wp.transpose(rotation) * (x - his.position[world, k])
        in_contact = his.speed[world, rec] > f64(0.0)
        if wp.static(meshes):
            if not in_contact:
                his.contact_state[world, rec] = sheet_side(con, k, y, his.contact_state[world, rec])
        side = stored_side(con, k, in_contact, his.contact_state[world, rec])
        d = distance(con, k, y, side)
        scr.start_position[world, point] = y
        activation_gap_now = activation_gap(con, his, world, c, point, clock.time[world], his.previous_margin[world, k])
        scr.start_displacement[world, point] = interpolate(facets, u_n, world, q, item)
        scr.activation_gap[world, point] = activation_gap_now
        scr.start_depth[world, point] = activation_gap_now - d[3]
        speed = wp.max(his.speed[world, rec], f64(MIN_APPROACH_SPEED))
        if clock.is_static == 0:
            moved = (scr.collider_rotation[world, k] * y + scr.collider_position[world, k] - x) / clock.h[world]
            approach = wp.dot(rotation * vec3d(d[0], d[1], d[2]), moved - interpolate(facets, v_n, world, q, item))
            speed = wp.max(speed, approach)
        scr.approach_speed[world, point] = speed

    @wp.kernel(module=module)
    def points_at_state(
        con: Contacts, facets: Facets, his: History, time: wp.array(dtype=f64), u: wp.array2d(dtype=vec3),
        scr: ContactScratch
    ):  # fmt: skip
        """Point data at a state without motion, for evaluations outside of a step."""
        world, item, q = wp.tid()
        c = facets.contact[item]
        k = con.collider[c]
        x = facets.X[q, item] + interpolate(facets, u, world, q, item)
        point = facets.first_point + item * facets.point_count + q
        y = wp.transpose(scr.collider_rotation[world, k]) * (x - scr.collider_position[world, k])
        scr.start_position[world, point] = y
        scr.start_displacement[world, point] = interpolate(facets, u, world, q, item)
        d = distance(con, k, y, -1)
        scr.activation_gap[world, point] = activation_gap(con, his, world, c, point, time[world], con.margin[world, k])
        scr.start_depth[world, point] = scr.activation_gap[world, point] - d[3]

    @wp.kernel(module=module)
    def explicit_forces(
        con: Contacts, facets: Facets, his: History, clock: Clock, v_n: wp.array2d(dtype=vec3),
        active: wp.array(dtype=wp.int32), scr: ContactScratch,
    ):  # fmt: skip
        """Forces of explicit contacts at the state that the attempt begins from."""
        world, item, q = wp.tid()
        if active[world] == 0 or facets.area_fraction[q, item] == f64(0.0):
            return
        c = facets.contact[item]
        if con.is_explicit[c] == 0:
            return
        point = facets.first_point + item * facets.point_count + q
        rec = history_row(con, c, point)
        k = con.collider[c]
        scr.explicit_force[world, point] = vec3d()
        scr.explicit_elastic_slip[world, point] = vec3d()
        delta = scr.start_depth[world, point]
        if delta <= f64(0.0):
            return
        rotation = his.rotation[world, k]
        y = scr.start_position[world, point]
        side = stored_side(con, k, True, his.contact_state[world, rec])
        d = distance(con, k, y, side)
        n = rotation * vec3d(d[0], d[1], d[2])
        x = rotation * y + his.position[world, k]
        h = clock.h[world]
        moved = (scr.collider_rotation[world, k] * y + scr.collider_position[world, k] - x) / h
        set_explicit_force(
            con, his, scr, world, c, point, delta, n, interpolate(facets, v_n, world, q, item) - moved, h
        )

    @wp.func
    def explicit_work(
        con: Contacts, facets: Facets, his: History, scr: ContactScratch, world: int, c: int, q: int, item: int,
        point: int, u: wp.array2d(dtype=vec3d),
    ) -> f64:  # fmt: skip
        """Potential of an explicit force: minus its work on the step so far, J."""
        k = con.collider[c]
        x_n = his.rotation[world, k] * scr.start_position[world, point] + his.position[world, k]
        x = facets.X[q, item] + interpolate(facets, u, world, q, item)
        return -wp.dot(scr.explicit_force[world, point], x - x_n)

    @wp.kernel(module=module)
    def forces(
        con: Contacts, facets: Facets, his: History, clock: Clock, u: wp.array2d(dtype=vec3d),
        active: wp.array(dtype=wp.int32), fresh: int, scr: ContactScratch,
    ):  # fmt: skip
        """Forces of points, N, their stiffness and potential.

        `fresh`: an attempt begins. Friction limits are frozen while Newton's method solves: the problem then has a
        potential, which it would lose with the limits of each iterate where an iterate lies deep in an obstacle.
        """
        world, item, q = wp.tid()
        if active[world] == 0:
            return
        c = facets.contact[item]
        point = facets.first_point + item * facets.point_count + q
        area_fraction = facets.area_fraction[q, item] * is_acting(con, scr, world, c, point)
        scr.activity[world, point] = INACTIVE
        if area_fraction == f64(0.0):
            return
        inv_h = f64(0.0)
        if clock.is_static == 0:
            inv_h = f64(1.0) / clock.h[world]
        rec = history_row(con, c, point)
        frozen = scr.frozen_friction[world, rec]
        if fresh != 0:
            frozen[2] = f64(1.0)
        t = evaluate_point(con, facets, his, scr, world, q, item, point, u, clock.new_time[world], inv_h, frozen[2])
        if con.is_explicit[c] == 0:
            new = friction_parameters(con, his, scr, world, c, point, t)
            if fresh != 0:  # initial limits: those of the last step, zero for a new contact
                scr.frozen_normal[world, rec] = t.normal
                frozen = new
                frozen[0] = wp.min(new[0], his.friction_limit[world, rec])
                scr.frozen_friction[world, rec] = frozen
            scr.updated_normal[world, rec] = t.normal
            t = with_friction_normal(t, scr.frozen_normal[world, rec])
            scr.updated_friction[world, rec] = new
        turned = f64(0.0)
        if con.rotation_law[con.collider[c]] >= 0:
            turned = wp.abs(scr.collider_angle[world, con.collider[c]] - his.angle[world, con.collider[c]])
        near = t.depth > f64(0.0) or scr.start_depth[world, point] > f64(0.0)
        if t.side == -2 or (near and turned > f64(MAX_COLLIDER_ROTATION)):
            scr.passed_point[world] = wp.where(t.side == -2, point + 1, -point - 1)
            scr.activity[world, point] = FORCE_ONLY
            scr.force[world, point] = vec3d()
            scr.energy[world, point] = wp.vec2d(f64(wp.inf), f64(0.0))
        elif con.is_explicit[c] != 0:
            if wp.length_sq(scr.explicit_force[world, point]) > f64(0.0):
                work = area_fraction * explicit_work(con, facets, his, scr, world, c, q, item, point, u)
                scr.activity[world, point] = FORCE_ONLY
                scr.force[world, point] = -area_fraction * scr.explicit_force[world, point]
                scr.energy[world, point] = wp.vec2d(work, wp.abs(work))
        elif t.depth > f64(0.0) or frozen[0] > f64(0.0) or con.law[c] == SMOOTH:
            friction_energy = friction_potential(con, world, c, t, frozen, inv_h)
            K = point_stiffness(con, world, c, t, frozen, inv_h)
            scr.activity[world, point] = WITH_STIFFNESS
            scr.force[world, point] = area_fraction * (
                friction_force(con, world, c, t, frozen, inv_h) - t.normal_values[0] * t.normal
            )
            scr.energy[world, point] = wp.vec2d(
                area_fraction * (t.normal_values[2] + friction_energy),
                area_fraction * (t.normal_values[3] + wp.abs(friction_energy)),
            )
            scr.stiffness[world, point] = sym(T(area_fraction * K[0, 0]), T(area_fraction * K[1, 1]),
                T(area_fraction * K[2, 2]), T(area_fraction * K[1, 2]), T(area_fraction * K[0, 2]),
                T(area_fraction * K[0, 1]))  # fmt: skip

    @wp.kernel(module=module)
    def gather_point_forces(
        facets: Facets, active: wp.array(dtype=wp.int32), lanes: int, scr: ContactScratch, pool: wp.array2d(dtype=vec3),
        rows: wp.array3d(dtype=f64), touching: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        """Forces of facets on their slots and, once per facet, rows of the potential."""
        world, index = wp.tid()
        if active[world] == 0:
            return
        entry = wp.min(index / lanes, facets.facet_count * facets.conn.shape[0] - 1)
        item = entry % facets.facet_count
        i = entry / facets.facet_count
        lane = index % lanes
        first = facets.first_point + item * facets.point_count
        touched = wp.int32(INACTIVE)
        for q in range(facets.point_count):
            touched = wp.max(touched, scr.activity[world, first + q])
        f = vec3()
        if touched != INACTIVE:
            for q in range(lane, facets.point_count, lanes):
                if scr.activity[world, first + q] != INACTIVE:
                    f += acting_shape_value(facets, scr, world, q, i, item) * vec3(scr.force[world, first + q])
        f = lane_sum(f, lanes)
        if lane > 0:
            return
        pool[world, facets.first_entry + entry] = f
        if i > 0:
            return
        row = facets.first_row + item
        before = scr.facet_activity[world, row]
        scr.facet_activity[world, row] = touched
        if wp.max(before, touched) == INACTIVE:
            return  # the rows are already zero
        energy = wp.vec2d()
        for q in range(facets.point_count):
            state = scr.activity[world, first + q]
            if state != INACTIVE:
                energy += scr.energy[world, first + q]
            if state != WITH_STIFFNESS:
                scr.stiffness[world, first + q] = sym()
        if touched != INACTIVE:
            wp.atomic_max(touching, world, 1)
        rows[0, world, row] = energy[0]
        rows[1, world, row] = energy[0]
        rows[2, world, row] = energy[1]

    @wp.kernel(module=module)
    def aitken_partial_sums(flags: wp.array(dtype=wp.int32), scr: ContactScratch):
        """Partial sums, by lanes, of r = limit of the iterate - frozen limit, and of its change, for relaxation."""
        world, lane = wp.tid()
        if flags[world] == 0:
            return
        out = wp.vec4d()
        for point in range(lane, scr.aitken_residual.shape[1], AITKEN_LANES):
            if scr.activity[world, point] == WITH_STIFFNESS:
                r = scr.updated_friction[world, point][0] - scr.frozen_friction[world, point][0]
                old = scr.aitken_residual[world, point]
                new = scr.updated_friction[world, point][0]
                out += wp.vec4d(old * (r - old), (r - old) * (r - old), r * r, new * new)
        scr.aitken_sums[world, lane] = out

    @wp.kernel(module=module)
    def aitken_relaxation(
        flags: wp.array(dtype=wp.int32), tol: f64, scr: ContactScratch, unsettled: wp.array(dtype=wp.int32)
    ):
        """Relaxation factor of the friction limits: 1 while r shrinks, else Aitken's (Irons and Tuck 1969)."""
        world = wp.tid()
        if flags[world] == 0:
            return
        total = wp.vec4d()
        for lane in range(AITKEN_LANES):
            total += scr.aitken_sums[world, lane]
        omega = f64(1.0)
        slow = total[2] > f64(SLOW_REDUCTION) * f64(SLOW_REDUCTION) * scr.aitken_norm2[world] and total[1] > f64(0.0)
        if scr.limit_updates[world] > 0 and slow and total[2] > tol * tol * total[3]:
            omega = wp.clamp(-scr.relaxation[world] * total[0] / total[1], f64(0.05), f64(2.0))
            unsettled[world] = 1
        scr.relaxation[world] = omega
        scr.aitken_norm2[world] = total[2]
        scr.limit_updates[world] = scr.limit_updates[world] + 1

    @wp.kernel(module=module)
    def update_frozen(flags: wp.array(dtype=wp.int32), scr: ContactScratch):
        """Update the frozen friction limits by the relaxed change, and the plane of friction."""
        world, point = wp.tid()
        if flags[world] != 0:
            new = scr.updated_friction[world, point]
            r = new[0] - scr.frozen_friction[world, point][0]
            if scr.relaxation[world] != f64(1.0):
                new[0] = wp.max(scr.frozen_friction[world, point][0] + scr.relaxation[world] * r, f64(0.0))
            scr.aitken_residual[world, point] = r
            scr.frozen_friction[world, point] = new
            scr.frozen_normal[world, point] = scr.updated_normal[world, point]

    @wp.func
    def multiply_symmetric(k: sym, p: vec3) -> vec3:
        """Product of the symmetric matrix k (Voigt) with p."""
        return vec3(k[0] * p[0] + k[5] * p[1] + k[4] * p[2], k[5] * p[0] + k[1] * p[1] + k[3] * p[2],
                    k[4] * p[0] + k[3] * p[1] + k[2] * p[2])  # fmt: skip

    @wp.kernel(module=module)
    def point_products(
        facets: Facets, active: wp.array(dtype=wp.int32), p: wp.array2d(dtype=vec3), scr: ContactScratch
    ):  # fmt: skip
        """K times the displacement of each point."""
        world, item, q = wp.tid()
        if active[world] == 0 or scr.facet_activity[world, facets.first_row + item] != WITH_STIFFNESS:
            return
        d = vec3()
        for i in range(facets.conn.shape[0]):
            d += acting_shape_value(facets, scr, world, q, i, item) * p[world, facets.conn[i, item]]
        point = facets.first_point + item * facets.point_count + q
        scr.point_product[world, point] = multiply_symmetric(scr.stiffness[world, point], d)

    @wp.kernel(module=module)
    def gather_facet_products(
        facets: Facets, active: wp.array(dtype=wp.int32), lanes: int, scr: ContactScratch, pool: wp.array2d(dtype=vec3)
    ):  # fmt: skip
        """Sums of the point products on the slots of the facets."""
        world, index = wp.tid()
        if active[world] == 0:
            return
        entry = wp.min(index / lanes, facets.facet_count * facets.conn.shape[0] - 1)
        item = entry % facets.facet_count
        out = vec3()
        if scr.facet_activity[world, facets.first_row + item] == WITH_STIFFNESS:
            for q in range(index % lanes, facets.point_count, lanes):
                flux = scr.point_product[world, facets.first_point + item * facets.point_count + q]
                out += acting_shape_value(facets, scr, world, q, entry / facets.facet_count, item) * flux
        out = lane_sum(out, lanes)
        if index % lanes == 0:
            pool[world, facets.first_entry + entry] = out

    @wp.kernel(module=module)
    def diagonal(facets: Facets, active: wp.array(dtype=wp.int32), scr: ContactScratch, pool: wp.array2d(dtype=sym)):
        """3x3 diagonal blocks of the facets."""
        world, item, i = wp.tid()
        if active[world] == 0:
            return
        out = sym()
        if scr.facet_activity[world, facets.first_row + item] == WITH_STIFFNESS:
            for q in range(facets.point_count):
                s = acting_shape_value(facets, scr, world, q, i, item)
                out += s * s * scr.stiffness[world, facets.first_point + item * facets.point_count + q]
        pool[world, facets.first_entry + i * facets.facet_count + item] = out

    return kernel_set(locals())
