"""Contact after an accepted step: history, energy ledger, record of each contact; for any geometry."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set, masked_kernel
from ..common.structs import IMPACT_FOUND, IMPACT_IGNORED
from ..common.types import f64, vec3d
from .assembly import contact_module
from .friction import friction_functions
from .kinematics import GEOMETRIES, kinematics_functions
from .law import ANY_GAP, FIXED_SPRING, SLIP_SPEED, OwnLaws
from .structs import (
    AREA_ROW,
    IN_REACH,
    INACTIVE,
    MOMENT_ROW,
    NORMAL_ROW,
    PENETRATION_ROW,
    RECORD_NAMES,
    SLIP_FLAG,
    SLIP_ROW,
    STICK_ROW,
    STORED_ROW,
    WITH_STIFFNESS,
    contact_structs,
    world_value,
)

__all__ = ["ENERGY_COLUMNS", "RECORD_LANES", "contact_ledger_kernels"]

STORED, LOSS, FRICTION, COLLIDER_WORK, INTEGRATOR_WORK = range(5)
"""Columns of the energy increments, J: stored energy (its value), lost to restitution, lost to friction, work of the
colliders, and the part of the contact's work that is due to the integrator."""
ENERGY_COLUMNS = 5
IMPACT_DEPTH = 0.1
"""Depth of a point that was less than half as deep before the step and loses half of its momentum in it, over approach
speed times step, below which the step does not resolve its impact: BDF2 and generalized-alpha would throw the body
back."""
RECORD_LANES = 32
"""Threads that share the sums over the facets of a contact."""
SUMMED_ROWS = len(RECORD_NAMES) - 1
"""Rows of the record that are sums; the last one is a maximum."""
AVERAGED_ROWS = 7
"""Leading rows of the record (force, moment, normal force), averaged over the substeps of a step; area, stick and
stored are values at its end."""


@functools.cache
def contact_ledger_kernels(dtype: str, geometry: str, own: OwnLaws = ()) -> KernelSet:
    """Kernels in the module of `contact_kernels`, with the same arguments."""
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    k, law, g = kinematics_functions(dtype), friction_functions(dtype, own), GEOMETRIES[geometry](dtype)
    Other = g.Other
    module = contact_module(dtype, geometry, own)

    @wp.struct
    class PointOutcome:
        """Result of a point after a substep; forces and energies as if the point had the area of the whole region."""

        force: vec3d  # on the body, N
        normal_force: f64  # N
        elastic_slip: vec3d  # elastic part of its slip: displacement of the friction spring, m
        friction_limit: f64  # mu F_n, N
        slipping: wp.int32
        slip_increment: vec3d  # slip in the substep, m
        stored: f64  # J, as are the following
        loss: f64
        friction_loss: f64

    @wp.func
    def point_outcome(
        con: Contacts, his: History, scr: ContactScratch, world: int, c: int, point: int, record: PointContact,
        inv_h: f64,
    ) -> PointOutcome:  # fmt: skip
        """Force, friction spring and energies of a point at the end of a substep.

        On the relative motion the force does the work -(change of stored energy + loss + friction + the integrator's
        part).
        """
        out = PointOutcome()
        rec = k.history_row(con, c, point)
        frozen = scr.frozen_friction[world, rec]
        t = law.with_normal_force(con, scr, world, c, point, record, inv_h)
        if con.is_explicit[c] == 0:
            t = law.in_friction_plane(t, scr.frozen_normal[world, rec], frozen[2])
        normal = t.normal_values[0]
        tangential_force = law.friction_force(con, world, c, t, frozen, inv_h)
        out.slipping = wp.where(law.is_slipping(con, world, c, t, frozen, inv_h), 1, 0)
        if con.is_explicit[c] != 0:
            normal = wp.dot(scr.explicit_force[world, point], t.normal)
            tangential_force = normal * t.normal - scr.explicit_force[world, point]
            out.elastic_slip = scr.explicit_elastic_slip[world, point]
            frozen[0] = law.friction_coefficient(con, his, world, c, rec) * normal
            frozen[1] = law.friction_stiffness(con, world, c, f64(1.0), scr.start_depth[world, point])
            out.slipping = wp.where(wp.length(tangential_force) >= f64(0.999999) * frozen[0], 1, 0)
        elif normal > f64(0.0) and frozen[1] > f64(0.0) and not law.has_trait(con, c, SLIP_SPEED):
            out.elastic_slip = law.return_mapping(con, world, c, t, frozen, inv_h)
        out.normal_force = normal
        out.friction_limit = frozen[0]
        out.force = normal * t.normal - tangential_force
        spring = law.elastic_part(con, world, c, t)
        out.stored = spring[1] + f64(0.5) * frozen[1] * wp.dot(out.elastic_slip, out.elastic_slip)
        out.loss = (normal - spring[0]) * (t.depth - t.previous_depth)
        stretch = out.elastic_slip - k.tangential(t.friction_normal, t.spring)  # change of the elastic slip
        out.slip_increment = t.tangential_motion - stretch
        out.friction_loss = wp.dot(tangential_force - frozen[1] * out.elastic_slip, stretch) + wp.dot(
            tangential_force, out.slip_increment
        )
        return out

    @wp.func
    def clear_history(con: Contacts, other: Other, his: History, world: int, c: int, point: int):
        """Reset the history of a point that is not in contact."""
        rec = k.history_row(con, c, point)
        contact_state = g.released_state(other, his, world, c, point, rec)
        his.spring[world, rec] = vec3d()
        his.stored[world, rec] = f64(0.0)
        his.friction_limit[world, rec] = f64(0.0)
        his.speed[world, rec] = f64(0.0)
        his.contact_state[world, rec] = contact_state

    @wp.func
    def update_history(
        con: Contacts, other: Other, his: History, scr: ContactScratch, world: int, c: int, point: int,
        t: PointContact, o: PointOutcome, inv_h: f64,
    ):  # fmt: skip
        """Store the history of a point in contact."""
        rec = k.history_row(con, c, point)
        speed = scr.approach_speed[world, point]
        his.spring[world, rec] = o.elastic_slip
        if not law.has_trait(con, c, FIXED_SPRING):
            his.spring[world, rec] = wp.transpose(g.slip_frame(other, world, c, point, t)) * o.elastic_slip
        his.stored[world, rec] = o.stored
        his.friction_limit[world, rec] = o.friction_limit
        his.speed[world, rec] = wp.max(speed, (t.depth - t.previous_depth) * inv_h)
        contact_state = g.touched_state(other, world, c, point, t)
        if o.slipping != 0 and o.friction_limit > f64(0.0):
            contact_state += SLIP_FLAG
        his.contact_state[world, rec] = contact_state

    @wp.func
    def add_to_row(rows: wp.array3d(dtype=f64), k: int, world: int, row: int, value: f64):
        """rows[k, world, row] += value."""
        rows[k, world, row] = rows[k, world, row] + value

    @wp.func
    def record_point(
        con: Contacts, other: Other, facets: Facets, scr: ContactScratch, world: int, item: int, q: int,
        t: PointContact, o: PointOutcome, area_fraction: f64,
    ):  # fmt: skip
        """Add a point to the record of its facet: force and moment about the origin, slip, area in contact, depth."""
        row = facets.first_row + item
        c = facets.contact[item]
        force = (g.report_sign(other, c) * area_fraction) * o.force
        moment = wp.cross(t.position, force)
        for j in range(3):
            add_to_row(scr.record_rows, j, world, row, force[j])
            add_to_row(scr.record_rows, MOMENT_ROW + j, world, row, moment[j])
        add_to_row(scr.record_rows, NORMAL_ROW, world, row, area_fraction * o.normal_force)
        if t.depth > f64(0.0) or law.has_trait(con, c, ANY_GAP):
            area = facets.area[q, item]
            add_to_row(scr.record_rows, SLIP_ROW, world, row, area * f64(o.slipping) * wp.length(o.slip_increment))
            add_to_row(scr.record_rows, AREA_ROW, world, row, area)
            add_to_row(scr.record_rows, STICK_ROW, world, row, area * f64(1 - o.slipping))
        scr.record_rows[PENETRATION_ROW, world, row] = wp.max(scr.record_rows[PENETRATION_ROW, world, row], t.depth)

    @wp.kernel(module=module)
    def find_impacts(
        con: Contacts, other: Other, facets: Facets, his: History, clock: Clock, u: wp.array2d(dtype=vec3d),
        running: wp.array(dtype=wp.int32), failed: wp.array(dtype=wp.int32), scr: ContactScratch, only_plastic: int,
        impact: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        """Flag worlds whose converged attempt stops a point within the substep; `only_plastic`: of restitution 0."""
        world, item = wp.tid()
        seen = impact[world] >= IMPACT_FOUND or impact[world] == IMPACT_IGNORED
        if running[world] == 0 or failed[world] != 0 or seen:
            return
        c = facets.contact[item]
        inv_h = k.inverse_step(clock, world)
        for q in range(facets.point_count):
            point = facets.first_point + item * facets.point_count + q
            if scr.activity[world, point] == WITH_STIFFNESS:
                t = g.evaluate(con, other, facets, his, scr, world, q, item, point, u, clock.new_time[world])
                speed = scr.approach_speed[world, point]
                rate = law.normal_damping_rate(con, scr, world, c, point, t.stiffness_ratio, inv_h)
                if con.damping[world, c] < f64(-1.0) and rate < f64(0.0) and t.state == IN_REACH:
                    stiffness = law.normal_stiffness(con, world, c, t.stiffness_ratio)
                    before, now = wp.max(t.previous_depth, f64(0.0)), wp.max(t.depth, f64(0.0))
                    if (stiffness - rate) * wp.abs(now - before) > f64(0.1) * stiffness * wp.max(now, before):
                        impact[world] = IMPACT_FOUND
                sudden = t.depth > f64(2.0) * t.previous_depth and t.depth * inv_h < f64(IMPACT_DEPTH) * speed
                sudden = sudden and only_plastic == 0
                if t.state == IN_REACH and t.depth > f64(0.0) and sudden:
                    momentum = world_value(con.effective_mass, world, c) * speed
                    force = law.with_normal_force(con, scr, world, c, point, t, inv_h).normal_values[0]
                    if force > f64(0.5) * momentum * inv_h:
                        impact[world] = IMPACT_FOUND

    @masked_kernel(module, "accepted")
    def record_substep(
        con: Contacts, other: Other, facets: Facets, his: History, clock: Clock, u: wp.array2d(dtype=vec3d),
        accepted: wp.array(dtype=wp.int32), scr: ContactScratch, energies: wp.array3d(dtype=f64),
    ):  # fmt: skip
        """Energy increments of an accepted substep, its record per facet, and the history after it.

        The force on a body does the work f . (motion of the other side's material), and on a surface that an initial
        overlap moves: the integrator's formula omits both.
        """
        world, item = wp.tid()
        c = facets.contact[item]
        row = facets.first_row + item
        for j in range(ENERGY_COLUMNS):
            energies[j, world, row] = f64(0.0)
        for j in range(SUMMED_ROWS + 1):
            scr.record_rows[j, world, row] = f64(0.0)
        inv_h = k.inverse_step(clock, world)
        for q in range(facets.point_count):
            point = facets.first_point + item * facets.point_count + q
            area_fraction = facets.area_fraction[q, item] * k.is_acting(con, scr, world, c, point)
            rec = k.history_row(con, c, point)
            idle = scr.activity[world, point] == INACTIVE and his.speed[world, rec] == f64(0.0)
            if area_fraction > f64(0.0) and (con.is_explicit[c] != 0 or not idle):
                t = g.evaluate(con, other, facets, his, scr, world, q, item, point, u, clock.new_time[world])
                if t.state != IN_REACH:  # contact ends beyond the boundary of a surface: its stored energy is lost
                    scr.activity[world, point] = INACTIVE
                    add_to_row(energies, LOSS, world, row, area_fraction * his.stored[world, rec])
                    clear_history(con, other, his, world, c, point)
                else:
                    o = point_outcome(con, his, scr, world, c, point, t, inv_h)
                    work = wp.dot(o.force, g.carried(con, other, world, c, t))
                    work += o.normal_force * k.overlap_recovery(con, his, clock, world, c, point)
                    add_to_row(energies, STORED, world, row, area_fraction * o.stored)
                    add_to_row(energies, LOSS, world, row, area_fraction * o.loss)
                    add_to_row(energies, FRICTION, world, row, area_fraction * o.friction_loss)
                    add_to_row(energies, COLLIDER_WORK, world, row, area_fraction * work)
                    add_to_row(energies, INTEGRATOR_WORK, world, row, area_fraction * work)
                    record_point(con, other, facets, scr, world, item, q, t, o, area_fraction)
                    if his.previous_depth.shape[0] > 0:
                        his.previous_depth[world, rec] = t.depth
                    if t.depth > f64(0.0):
                        update_history(con, other, his, scr, world, c, point, t, o, inv_h)
                    else:
                        clear_history(con, other, his, world, c, point)
        for j in range(4):
            scr.record_rows[STORED_ROW + j, world, row] = energies[j, world, row]

    @masked_kernel(module, "accepted")
    def partial_records(
        rows_of: wp.array(dtype=wp.int32), accepted: wp.array(dtype=wp.int32), scr: ContactScratch,
        out: wp.array4d(dtype=f64),
    ):  # fmt: skip
        """Sums over the facets of a contact, by lanes: [world, contact, RECORD_NAMES, lane]."""
        world, c, j, lane = wp.tid()
        total = f64(0.0)
        for row in range(rows_of[c] + lane, rows_of[c + 1], RECORD_LANES):
            value = scr.record_rows[j, world, row]
            if j == SUMMED_ROWS:
                total = wp.max(total, value)
            else:
                total += value
        out[world, c, j, lane] = total

    @masked_kernel(module, "accepted")
    def total_records(
        clock: Clock, accepted: wp.array(dtype=wp.int32), parts: wp.array4d(dtype=f64), scr: ContactScratch
    ):  # fmt: skip
        """Record of the step so far: forces averaged over time, work and mean slip summed."""
        world, c, j = wp.tid()
        h = clock.h[world]
        past = scr.elapsed_time[world]
        total = f64(0.0)
        for lane in range(RECORD_LANES):
            if j == SUMMED_ROWS:
                total = wp.max(total, parts[world, c, j, lane])
            else:
                total += parts[world, c, j, lane]
        if j == SLIP_ROW:
            area = f64(0.0)
            for lane in range(RECORD_LANES):
                area += parts[world, c, AREA_ROW, lane]
            total /= wp.max(area, f64(1.0e-300))
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

    @masked_kernel(module, "accepted")
    def store_state(
        other: Other, clock: Clock, potential: wp.array(dtype=f64), term_sums: wp.array2d(dtype=f64),
        accepted: wp.array(dtype=wp.int32), his: History, scr: ContactScratch,
    ):  # fmt: skip
        """Store the other side and the time of the accepted state; advance the elapsed time; add the contact energy,
        J, to the bound of the next initial iterate."""
        world, index = wp.tid()
        g.store_side(other, world, index)
        if index == 0:
            his.pose_time[world] = clock.time[world]
            scr.elapsed_time[world] = scr.elapsed_time[world] + clock.h[world]
            potential[world] = potential[world] + term_sums[1, world]

    @wp.kernel(module=module)
    def write_records(scr: ContactScratch, first: int, report: wp.array2d(dtype=f64)):
        """Record of each contact for the report of the step; stick as the average over the area in contact."""
        world, c = wp.tid()
        area = scr.record_totals[world, c, AREA_ROW]
        for j in range(SUMMED_ROWS + 1):
            value = scr.record_totals[world, c, j]
            if j == STICK_ROW:
                value = value / wp.max(area, f64(1.0e-300))
            report[world, first + (SUMMED_ROWS + 1) * c + j] = value

    return kernel_set(locals())
