"""Contact after an accepted step: history, energy ledger, record of each contact, fields, and matrix blocks."""

import functools
import types as _types

import warp as wp

from ..common.block_entries import add_symmetric_function
from ..common.structs import pattern_struct, topology_struct
from ..common.types import SHORT_UNROLL, kernel_module, kernel_set, precision
from .assembly import INACTIVE
from .colliders import MESH_SUFFIX, collider_functions
from .laws import PAPER, SMOOTH, law_functions
from .point import contact_point_functions
from .structs import (
    AREA_ROW,
    MOMENT_ROW,
    NORMAL_ROW,
    PENETRATION_ROW,
    RECORD_NAMES,
    SLIP_ROW,
    STICK_ROW,
    STORED_ROW,
    clock_struct,
    contact_scratch_struct,
    contact_struct,
    facet_struct,
    history_struct,
    world_value,
)

__all__ = [
    "COLLIDER_WORK",
    "ENERGY_COLUMNS",
    "FRICTION",
    "INTEGRATOR_WORK",
    "LOSS",
    "RECORD_LANES",
    "STORED",
    "SUMMED_ROWS",
    "contact_block_kernels",
    "contact_ledger_kernels",
]

STORED, LOSS, FRICTION, COLLIDER_WORK, INTEGRATOR_WORK = range(5)
"""Columns of the energy increments, J: stored energy (its value), lost to restitution, lost to friction, work of the
colliders, and the part of the contact's work that is due to the integrator."""
ENERGY_COLUMNS = 5
RECORD_LANES = 32
"""Threads that share the sums over the facets of a contact."""
SUMMED_ROWS = len(RECORD_NAMES) - 1
"""Rows of the record that are sums; the last one is a maximum."""
AVERAGED_ROWS = 7
"""Leading rows of the record (force, moment, normal force), averaged over the substeps of a step; area, stick and
stored are values at its end."""


@functools.cache
def contact_ledger_kernels(dtype: str, meshes: bool) -> _types.SimpleNamespace:
    """Kernels in the module of `contact_kernels`."""
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets = contact_struct(meshes), facet_struct(dtype)
    History, ContactScratch, Clock = history_struct(), contact_scratch_struct(dtype), clock_struct()
    k = contact_point_functions(dtype, meshes)
    evaluate_point, with_friction_normal, friction_parameters, friction_trial, is_acting, PointContact = (
        k.evaluate_point,
        k.with_friction_normal,
        k.friction_parameters,
        k.friction_trial,
        k.is_acting,
        k.PointContact,
    )
    tangential, history_row, friction_force = k.tangential, k.history_row, k.friction_force
    friction_coefficient, lagrange_polynomial, overlap_recovery = (
        k.friction_coefficient,
        k.lagrange_polynomial,
        k.overlap_recovery,
    )
    elastic_force = law_functions().elastic_force
    g = collider_functions(meshes)
    updated_side, released_contact_state, SLIP_FLAG = g.updated_side, g.released_contact_state, g.SLIP_FLAG
    module = kernel_module(f"contact_{dtype}{MESH_SUFFIX * meshes}", max_unroll=SHORT_UNROLL)

    @wp.struct
    class PointOutcome:
        """Result of a point after a substep; forces and energies as if the point had the area of the whole region."""

        contact: PointContact
        force: vec3d  # on the body, N
        normal_force: f64  # N
        elastic_slip: vec3d  # elastic part of its slip: displacement of the friction spring, m
        friction_limit: f64  # mu F_n, N
        slipping: wp.int32
        slip_increment: vec3d  # slip in the substep, m
        stored: f64  # J, as are the following
        loss: f64
        friction_loss: f64
        collider_work: f64  # work done by the collider
        integrator_work: f64  # work due to the integrator beyond the ledger's own estimate

    @wp.func
    def return_mapping(
        con: Contacts, world: int, c: int, t: PointContact, frozen: vec3d, inv_h: f64, tangential_force: vec3d
    ) -> vec3d:
        """Elastic slip, m, after the force was cut to the friction limit; Eq. (83) of Paper I for law PAPER."""
        w = friction_trial(con, world, c, t, frozen, inv_h)
        if wp.length(vec3d(w[0], w[1], w[2])) <= frozen[0]:
            return t.trial_elastic_slip
        trial = vec3d(w[0], w[1], w[2])
        if con.law[c] != PAPER:  # spring and damper slip together: bounded by the motion of the point
            if frozen[0] <= f64(0.0):
                return vec3d()
            size = wp.length(trial)
            return t.trial_elastic_slip - ((size - frozen[0]) / (w[3] * size)) * trial
        # reverses the spring where gamma_t v exceeds the friction limit
        return (f64(1.0) / frozen[1]) * tangential_force - ((w[3] - frozen[1]) / frozen[1]) * t.tangential_motion

    @wp.func
    def point_outcome(
        con: Contacts, facets: Facets, his: History, clock: Clock, scr: ContactScratch, world: int, c: int, q: int,
        item: int, point: int, u: wp.array2d(dtype=vec3d),
    ) -> PointOutcome:  # fmt: skip
        """Force, friction spring and energies of a point at the end of a substep.

        The force on the body does `collider_work` = f . (motion of the collider's material at the point) and, on the
        relative motion, -(change of stored energy + loss + friction + the integrator's part). The integrator's part has
        its own formulas: chords of convex energies, and the contributions of a turning normal and a turning collider.
        """
        out = PointOutcome()
        rec = history_row(con, c, point)
        kc = con.collider[c]
        law = con.law[c]
        inv_h = f64(0.0)
        if clock.is_static == 0:
            inv_h = f64(1.0) / clock.h[world]
        frozen = scr.frozen_friction[world, rec]
        t = evaluate_point(con, facets, his, scr, world, q, item, point, u, clock.new_time[world], inv_h, frozen[2])
        if con.is_explicit[c] == 0:
            t = with_friction_normal(t, scr.frozen_normal[world, rec])
        change = t.depth - scr.start_depth[world, point]
        spring = elastic_force(
            con.single_point[c], con.scale[world, c] * world_value(con.normal_stiffness, world, c), t.depth
        )
        normal = t.normal_values[0]
        tangential_force = friction_force(con, world, c, t, frozen, inv_h)
        w = friction_trial(con, world, c, t, frozen, inv_h)
        out.slipping = wp.where(wp.length(vec3d(w[0], w[1], w[2])) > frozen[0] or law == SMOOTH, 1, 0)
        previous_elastic_slip = vec3d()  # previous spring, in the tangent plane
        if his.speed[world, rec] > f64(0.0):
            previous_elastic_slip = his.spring[world, rec]
            if law != PAPER:
                previous_elastic_slip = scr.collider_rotation[world, kc] * previous_elastic_slip
            previous_elastic_slip = tangential(t.friction_normal, previous_elastic_slip)
        if con.is_explicit[c] != 0:
            normal = wp.dot(scr.explicit_force[world, point], t.normal)
            tangential_force = normal * t.normal - scr.explicit_force[world, point]
            out.elastic_slip = scr.explicit_elastic_slip[world, point]
            frozen[0] = friction_coefficient(con, his, world, c, rec) * normal
            out.slipping = wp.where(wp.length(tangential_force) >= f64(0.999999) * frozen[0], 1, 0)
        elif normal > f64(0.0) and law != SMOOTH and frozen[1] > f64(0.0):
            out.elastic_slip = return_mapping(con, world, c, t, frozen, inv_h, tangential_force)
        out.contact = t
        out.normal_force = normal
        out.friction_limit = frozen[0]
        out.force = normal * t.normal - tangential_force
        out.stored = spring[1] + f64(0.5) * frozen[1] * wp.dot(out.elastic_slip, out.elastic_slip)
        gain = out.stored - his.stored[world, rec]
        out.loss = (normal - spring[0]) * t.depth_increment
        out.slip_increment = t.tangential_motion - (out.elastic_slip - previous_elastic_slip)
        out.friction_loss = wp.dot(
            tangential_force - frozen[1] * out.elastic_slip, out.elastic_slip - previous_elastic_slip
        ) + wp.dot(tangential_force, out.slip_increment)
        chord = (
            spring[0] * change + frozen[1] * wp.dot(out.elastic_slip, out.elastic_slip - previous_elastic_slip) - gain
        )
        chord += (normal - spring[0]) * (change - t.depth_increment)  # of a moving contact point
        x = scr.collider_rotation[world, kc] * t.local_position + scr.collider_position[world, kc]
        carried = scr.collider_translation[
            world, kc
        ]  # motion of the collider's material at the point, by its last velocity
        if con.rotation_law[kc] >= 0:
            angle = scr.collider_angle[world, kc] - his.angle[world, kc]
            carried = angle * wp.cross(con.rotation_axis[kc], x - con.rotation_anchor[kc])
        risen = overlap_recovery(con, his, clock, world, c, point)
        out.collider_work = wp.dot(out.force, carried) + normal * risen
        # the ledger attributes the remaining work of the force to the integrator; `left` makes it agree with these
        # formulas
        x_n = his.rotation[world, kc] * scr.start_position[world, point] + his.position[world, kc]
        turned = -wp.dot(out.force, x - x_n - carried) - (
            normal * (change - risen) + wp.dot(tangential_force, t.tangential_motion)
        )
        out.integrator_work = chord + turned + wp.dot(out.force, x - x_n) + gain + out.loss + out.friction_loss
        return out

    @wp.func
    def update_history(
        con: Contacts, facets: Facets, his: History, clock: Clock, scr: ContactScratch, world: int, c: int, point: int,
        o: PointOutcome,
    ):  # fmt: skip
        """Store the history of a point."""
        rec = history_row(con, c, point)
        if facets.tracks_deepest != 0:
            his.previous_depth[world, rec] = o.contact.depth
        kc = con.collider[c]
        if o.contact.depth <= f64(0.0):
            contact_state = released_contact_state(
                con, kc, his.speed[world, rec] > f64(0.0), his.contact_state[world, rec]
            )
            his.spring[world, rec] = vec3d()
            his.stored[world, rec] = f64(0.0)
            his.friction_limit[world, rec] = f64(0.0)
            his.speed[world, rec] = f64(0.0)
            his.contact_state[world, rec] = contact_state
            return
        speed = scr.approach_speed[world, point]
        if clock.is_static == 0:
            speed = wp.max(speed, o.contact.depth_increment / clock.h[world])
        elastic_slip = o.elastic_slip
        if con.law[c] != PAPER:
            elastic_slip = wp.transpose(scr.collider_rotation[world, kc]) * elastic_slip
        his.spring[world, rec] = elastic_slip
        his.stored[world, rec] = o.stored
        his.friction_limit[world, rec] = o.friction_limit
        his.speed[world, rec] = speed
        contact_state = updated_side(con, kc, o.contact.local_position, o.contact.side) + 1
        if o.slipping != 0 and o.friction_limit > f64(0.0):
            contact_state += SLIP_FLAG
        his.contact_state[world, rec] = contact_state

    @wp.func
    def add_to_row(rows: wp.array3d(dtype=f64), k: int, world: int, row: int, value: f64):
        """rows[k, world, row] += value."""
        rows[k, world, row] = rows[k, world, row] + value

    @wp.kernel(module=module)
    def record_substep(
        con: Contacts, facets: Facets, his: History, clock: Clock, u: wp.array2d(dtype=vec3d),
        accepted: wp.array(dtype=wp.int32), scr: ContactScratch, energies: wp.array3d(dtype=f64),
    ):  # fmt: skip
        """Energy increments of an accepted substep, its record per facet, and the history after it."""
        world, item = wp.tid()
        if accepted[world] == 0:
            return
        c = facets.contact[item]
        row = facets.first_row + item
        for j in range(ENERGY_COLUMNS):
            energies[j, world, row] = f64(0.0)
        for j in range(SUMMED_ROWS + 1):
            scr.record_rows[j, world, row] = f64(0.0)
        for q in range(facets.point_count):
            point = facets.first_point + item * facets.point_count + q
            area_fraction = facets.area_fraction[q, item] * is_acting(con, scr, world, c, point)
            idle = scr.activity[world, point] == INACTIVE and his.speed[world, history_row(con, c, point)] == f64(0.0)
            if area_fraction > f64(0.0) and (con.is_explicit[c] != 0 or not idle):
                o = point_outcome(con, facets, his, clock, scr, world, c, q, item, point, u)
                add_to_row(energies, STORED, world, row, area_fraction * o.stored)
                add_to_row(energies, LOSS, world, row, area_fraction * o.loss)
                add_to_row(energies, FRICTION, world, row, area_fraction * o.friction_loss)
                add_to_row(energies, COLLIDER_WORK, world, row, area_fraction * o.collider_work)
                add_to_row(energies, INTEGRATOR_WORK, world, row, area_fraction * o.integrator_work)
                x = (
                    scr.collider_rotation[world, con.collider[c]] * o.contact.local_position
                    + scr.collider_position[world, con.collider[c]]
                )
                moment = wp.cross(x, o.force)
                for j in range(3):
                    add_to_row(scr.record_rows, j, world, row, area_fraction * o.force[j])
                    add_to_row(scr.record_rows, MOMENT_ROW + j, world, row, area_fraction * moment[j])
                add_to_row(scr.record_rows, NORMAL_ROW, world, row, area_fraction * o.normal_force)
                if o.contact.depth > f64(0.0) or con.law[c] == SMOOTH:
                    area = facets.area[q, item]
                    add_to_row(
                        scr.record_rows, SLIP_ROW, world, row, area * f64(o.slipping) * wp.length(o.slip_increment)
                    )
                    add_to_row(scr.record_rows, AREA_ROW, world, row, area)
                    add_to_row(scr.record_rows, STICK_ROW, world, row, area * f64(1 - o.slipping))
                for j in range(4):
                    scr.record_rows[STORED_ROW + j, world, row] = energies[j, world, row]
                scr.record_rows[PENETRATION_ROW, world, row] = wp.max(
                    scr.record_rows[PENETRATION_ROW, world, row], o.contact.depth
                )
                update_history(con, facets, his, clock, scr, world, c, point, o)

    @wp.kernel(module=module)
    def partial_records(
        con: Contacts, rows_of: wp.array(dtype=wp.int32), accepted: wp.array(dtype=wp.int32), scr: ContactScratch,
        out: wp.array4d(dtype=f64),
    ):  # fmt: skip
        """Sums over the facets of a contact, by lanes: [world, contact, RECORD_NAMES, lane]."""
        world, c, j, lane = wp.tid()
        if accepted[world] == 0:
            return
        total = f64(0.0)
        for row in range(rows_of[c] + lane, rows_of[c + 1], RECORD_LANES):
            value = scr.record_rows[j, world, row]
            if j == SUMMED_ROWS:
                total = wp.max(total, value)
            else:
                total += value
        out[world, c, j, lane] = total

    @wp.kernel(module=module)
    def total_records(
        clock: Clock, accepted: wp.array(dtype=wp.int32), parts: wp.array4d(dtype=f64), scr: ContactScratch
    ):  # fmt: skip
        """Record of the step so far: forces averaged over time, work summed."""
        world, c, j = wp.tid()
        if accepted[world] == 0:
            return
        h = clock.h[world]
        past = scr.elapsed_time[world]
        total = f64(0.0)
        for lane in range(RECORD_LANES):
            if j == SUMMED_ROWS:
                total = wp.max(total, parts[world, c, j, lane])
            else:
                total += parts[world, c, j, lane]
        old = scr.record_totals[world, c, j]
        if past == f64(0.0):
            old = f64(0.0)
        if j < AVERAGED_ROWS:
            if clock.is_static == 0:
                total = (past * old + h * total) / (past + h)
        elif j == SUMMED_ROWS:
            total = wp.max(total, old)
        elif j == SLIP_ROW or j > STORED_ROW:
            total += old
        scr.record_totals[world, c, j] = total

    @wp.kernel(module=module)
    def store_poses(
        con: Contacts, clock: Clock, potential: wp.array(dtype=f64), term_sums: wp.array2d(dtype=f64),
        accepted: wp.array(dtype=wp.int32), his: History, scr: ContactScratch,
    ):  # fmt: skip
        """Store the poses of the colliders; add the contact energy to the bound of the next initial iterate."""
        world, k = wp.tid()
        if accepted[world] == 0:
            return
        his.position[world, k] = scr.collider_position[world, k]
        his.rotation[world, k] = scr.collider_rotation[world, k]
        his.angle[world, k] = scr.collider_angle[world, k]
        his.previous_margin[world, k] = con.margin[world, k]
        if k == 0:
            his.pose_time[world] = clock.time[world]
            scr.elapsed_time[world] = scr.elapsed_time[world] + clock.h[world]
            potential[world] = potential[world] + term_sums[1, world]

    @wp.kernel(module=module)
    def write_records(scr: ContactScratch, first: int, report: wp.array2d(dtype=f64)):
        """Record of each contact for the report of the step; slip and stick as averages over the area in contact."""
        world, c = wp.tid()
        area = scr.record_totals[world, c, AREA_ROW]
        for j in range(SUMMED_ROWS + 1):
            value = scr.record_totals[world, c, j]
            if j == SLIP_ROW or j == STICK_ROW:
                value = value / wp.max(area, f64(1.0e-300))
            report[world, first + (SUMMED_ROWS + 1) * c + j] = value

    @wp.kernel(module=module)
    def evaluate_at_points(
        con: Contacts, facets: Facets, his: History, u: wp.array2d(dtype=vec3d), time: wp.array(dtype=f64),
        scr: ContactScratch, places: int, gap: wp.array2d(dtype=f64), force: wp.array2d(dtype=vec3d),
    ):  # fmt: skip
        """Gap, m, and elastic force, N, of each point at a state, without rates; with `places` the gap of a moving
        contact point is written at the point next to it."""
        world, item, q = wp.tid()
        point = facets.first_point + item * facets.point_count + q
        if facets.area_fraction[q, item] == f64(0.0):
            gap[world, point] = f64(1.0e30)
            return
        c = facets.contact[item]
        area_fraction = facets.area_fraction[q, item] * is_acting(con, scr, world, c, point)
        acting_point = point
        if facets.tracks_deepest != 0:  # the force at the contact point is written at a point of its facet
            gap[world, point] = -scr.point_depth[world, point]
            row = facets.first_row + item
            area_fraction = f64(0.0)
            acting_point = scr.contact_point[world, c]
            if scr.chosen_facet[world, c] == row:
                area_fraction = lagrange_polynomial(facets, q, scr.facet_deepest_xi[world, row])
                if wp.length_sq(
                    scr.facet_deepest_xi[world, row] - facets.point_coords[acting_point - (point - q)]
                ) == f64(0.0):
                    area_fraction = wp.where(acting_point == point, f64(1.0), f64(0.0))
            if area_fraction == f64(0.0) and acting_point != point:
                return
        t = evaluate_point(con, facets, his, scr, world, q, item, acting_point, u, time[world], f64(0.0), f64(1.0))
        frozen = friction_parameters(con, his, scr, world, c, acting_point, t)
        if acting_point == point and (facets.tracks_deepest == 0 or places != 0):
            gap[world, point] = -t.depth
        force[world, point] = area_fraction * (
            t.normal_values[0] * t.normal - friction_force(con, world, c, t, frozen, f64(0.0))
        )

    return kernel_set(locals())


@functools.cache
def contact_block_kernels(dtype: str) -> _types.SimpleNamespace:
    """Contributions of contact to an assembled matrix."""
    p = precision(dtype)
    T, mat33, sym = p.T, p.mat33, p.sym
    f64 = wp.float64
    Facets = facet_struct(dtype)
    Topology, Pattern = topology_struct(dtype), pattern_struct()
    add_symmetric = add_symmetric_function(dtype)
    module = kernel_module(f"contact_blocks_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.kernel(module=module)
    def add_contact_blocks(
        topo: Topology, pattern: Pattern, facets: Facets, entry: wp.array(dtype=wp.int32),
        start: wp.array(dtype=wp.int32), source: wp.array(dtype=wp.vec3i), stiffness: wp.array2d(dtype=sym),
        weight: wp.array3d(dtype=T),
        dq_dv: wp.array(dtype=f64), active: wp.array(dtype=wp.int32), value: wp.array2d(dtype=mat33),
    ):  # fmt: skip
        """value += (dq/dv) sum over points of s_a s_b K; `source`: facet and two of its slots."""
        world, index = wp.tid()
        if active[world] == 0:
            return
        k6 = sym()
        for e in range(start[index], start[index + 1]):
            at = source[e]
            for q in range(facets.point_count):
                s = facets.shape[q, at[1], at[0]] * facets.shape[q, at[2], at[0]]
                if facets.tracks_deepest != 0:
                    c = facets.contact[at[0]]
                    s = weight[world, c, at[1]] * weight[world, c, at[2]]
                k6 += s * stiffness[world, facets.first_point + at[0] * facets.point_count + q]
        add_symmetric(topo, pattern.upper[entry[index]], T(dq_dv[world]) * k6, world, value)

    return kernel_set(locals())
