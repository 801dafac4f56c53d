"""Contact between bodies after an accepted step: energy ledger, records, history."""

import functools
import types as _types

import warp as wp

from ..common.types import SHORT_UNROLL, kernel_module, kernel_set
from .assembly import INACTIVE
from .colliders import SLIP_FLAG
from .facet_assembly import pair_functions
from .facet_search import facet_search_kernels
from .facet_structs import master_struct, pair_history_struct, pair_scratch_struct
from .laws import PAPER, law_functions
from .ledger import COLLIDER_WORK, ENERGY_COLUMNS, FRICTION, INTEGRATOR_WORK, LOSS, STORED, SUMMED_ROWS
from .point import contact_point_functions
from .projection import facet_projection_functions
from .structs import (
    AREA_ROW,
    MOMENT_ROW,
    NORMAL_ROW,
    PENETRATION_ROW,
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

__all__ = ["pair_ledger_kernels"]


@functools.cache
def pair_ledger_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels in the module of `pair_kernels`."""
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets, History = contact_struct(False), facet_struct(dtype), history_struct()
    ContactScratch, Clock = contact_scratch_struct(dtype), clock_struct()
    Masters, PairHistory, PairScratch = master_struct(dtype), pair_history_struct(), pair_scratch_struct(dtype)
    k, surface_point = contact_point_functions(dtype, False), facet_projection_functions(dtype).surface_point
    (
        PointContact,
        with_friction_normal,
        friction_trial,
        tangential,
        friction_force,
        friction_coefficient,
        overlap_recovery,
    ) = (
        k.PointContact,
        k.with_friction_normal,
        k.friction_trial,
        k.tangential,
        k.friction_force,
        k.friction_coefficient,
        k.overlap_recovery,
    )
    elastic_force = law_functions().elastic_force
    evaluate_pair_point = pair_functions(dtype).evaluate_pair_point
    facet_frame = facet_search_kernels(dtype).facet_frame
    module = kernel_module(f"pairs_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.func
    def add_to_row(rows: wp.array3d(dtype=f64), j: int, world: int, row: int, value: f64):
        """rows[j, world, row] += value."""
        rows[j, world, row] = rows[j, world, row] + value

    @wp.func
    def clear_increments(energies: wp.array3d(dtype=f64), scr: ContactScratch, world: int, row: int):
        """Clear the energy increments and the record of a facet."""
        for j in range(ENERGY_COLUMNS):
            energies[j, world, row] = f64(0.0)
        for j in range(SUMMED_ROWS + 1):
            scr.record_rows[j, world, row] = f64(0.0)

    @wp.func
    def add_overlap_work(rows: wp.array3d(dtype=f64), world: int, row: int, work: f64):
        """Work of the contact force, J, while an initial overlap is relaxed: the integrator's formula omits it."""
        add_to_row(rows, COLLIDER_WORK, world, row, work)
        add_to_row(rows, INTEGRATOR_WORK, world, row, work)

    @wp.func
    def clear_history(his: History, pair_his: PairHistory, world: int, point: int):
        """Reset the history of a point that has left contact."""
        his.spring[world, point] = vec3d()
        his.stored[world, point] = f64(0.0)
        his.friction_limit[world, point] = f64(0.0)
        his.speed[world, point] = f64(0.0)
        his.contact_state[world, point] = 0
        pair_his.facet[world, point] = 0
        pair_his.xi[world, point] = vec3d()

    @wp.func
    def record_slip(
        scr: ContactScratch, world: int, row: int, depth: f64, area: f64, slipping: int, slip_increment: vec3d
    ):
        """Add slip times area, area and sticking area of a point to the record of a facet; its depth by the maximum."""
        if depth > f64(0.0):
            add_to_row(scr.record_rows, SLIP_ROW, world, row, area * f64(slipping) * wp.length(slip_increment))
            add_to_row(scr.record_rows, AREA_ROW, world, row, area)
            add_to_row(scr.record_rows, STICK_ROW, world, row, area * f64(1 - slipping))
        scr.record_rows[PENETRATION_ROW, world, row] = wp.max(scr.record_rows[PENETRATION_ROW, world, row], depth)

    @wp.func
    def record_force(scr: ContactScratch, world: int, row: int, force: vec3d, x: vec3d):
        """Add a force and its moment about the origin to the record of a facet."""
        moment = wp.cross(x, force)
        for j in range(3):
            add_to_row(scr.record_rows, j, world, row, force[j])
            add_to_row(scr.record_rows, MOMENT_ROW + j, world, row, moment[j])

    @wp.func
    def return_mapping(law: int, s: PointContact, frozen: vec3d, w: wp.vec4d, tangential_force: vec3d) -> vec3d:
        """Elastic slip, m, after the force was cut to the friction limit; Eq. (83) of Paper I for law PAPER.

        `frozen`: friction limit, N, k_t, N/m, spring factor. `w`: trial force, N, and k_t + gamma_t / h, N/m.
        """
        trial = vec3d(w[0], w[1], w[2])
        size = wp.length(trial)
        if size <= frozen[0]:
            return s.trial_elastic_slip
        if frozen[0] <= f64(0.0):
            return vec3d()
        if law == PAPER:
            return (f64(1.0) / frozen[1]) * tangential_force - ((w[3] - frozen[1]) / frozen[1]) * s.tangential_motion
        return s.trial_elastic_slip - ((size - frozen[0]) / (w[3] * size)) * trial

    @wp.func
    def update_history(
        his: History, pair_his: PairHistory, scr: ContactScratch, pair: PairScratch, world: int, point: int, f: int,
        friction_limit: f64, slipping: int, approach_speed: f64,
    ):  # fmt: skip
        """Store the master facet of a point, its largest approach speed, and its slip state."""
        his.friction_limit[world, point] = friction_limit
        his.speed[world, point] = wp.max(scr.approach_speed[world, point], approach_speed)
        contact_state = wp.int32(1)
        if slipping != 0 and friction_limit > f64(0.0):
            contact_state += SLIP_FLAG
        his.contact_state[world, point] = contact_state
        pair_his.facet[world, point] = f + 1
        pair_his.xi[world, point] = pair.xi[world, point]

    @wp.kernel(module=module)
    def record_substep(
        con: Contacts, mas: Masters, facets: Facets, his: History, pair_his: PairHistory, clock: Clock,
        accepted: wp.array(dtype=wp.int32), scr: ContactScratch, pair: PairScratch, energies: wp.array3d(dtype=f64),
    ):  # fmt: skip
        """Energy increments of an accepted substep, its record per facet, and the history after it."""
        world, item = wp.tid()
        if accepted[world] == 0:
            return
        c = facets.contact[item]
        law = con.law[c]
        row = facets.first_row + item
        clear_increments(energies, scr, world, row)
        inv_h = f64(0.0)
        if clock.is_static == 0:
            inv_h = f64(1.0) / clock.h[world]
        for q in range(facets.point_count):
            point = facets.first_point + item * facets.point_count + q
            area_fraction = facets.area_fraction[q, item]
            in_contact = his.speed[world, point] > f64(0.0)  # at the start of the step
            f = pair.facet[world, point]
            if area_fraction == f64(0.0) or (f < 0 and not in_contact):
                continue
            stored, elastic_slip, previous_elastic_slip = f64(0.0), vec3d(), vec3d()
            if f < 0:  # -1: beyond the boundary of the surface; contact ends, and its stored energy is lost
                scr.activity[world, point] = INACTIVE
                add_to_row(energies, LOSS, world, row, area_fraction * his.stored[world, point])
                clear_history(his, pair_his, world, point)
                continue
            s = evaluate_pair_point(con, scr, pair, world, c, point, inv_h)
            frozen = scr.frozen_friction[world, point]
            frozen[2] = f64(1.0)
            s = with_friction_normal(s, scr.frozen_normal[world, point])
            normal = s.normal_values[0]
            tangential_force = friction_force(con, world, c, s, frozen, inv_h)
            w = friction_trial(con, world, c, s, frozen, inv_h)
            slipping = wp.where(wp.length(vec3d(w[0], w[1], w[2])) > frozen[0], 1, 0)
            if in_contact:
                previous_elastic_slip = tangential(
                    s.friction_normal, pair.trial_displacement[world, point] - pair.relative_motion[world, point]
                )
            force = normal * s.normal - tangential_force
            if con.is_explicit[c] != 0:
                force = scr.explicit_force[world, point]
                normal = wp.dot(force, s.friction_normal)
                tangential_force = normal * s.friction_normal - force
                elastic_slip = scr.explicit_elastic_slip[world, point]
                k_t = con.scale[world, c] * world_value(con.tangential_stiffness, world, c)
                frozen = vec3d(friction_coefficient(con, his, world, c, point) * normal, k_t, f64(1.0))
                slipping = wp.where(wp.length(tangential_force) >= f64(0.999999) * frozen[0], 1, 0)
            elif normal > f64(0.0) and frozen[1] > f64(0.0):
                elastic_slip = return_mapping(law, s, frozen, w, tangential_force)
            spring = elastic_force(0, con.scale[world, c] * world_value(con.normal_stiffness, world, c), s.depth)
            stored = spring[1] + f64(0.5) * frozen[1] * wp.dot(elastic_slip, elastic_slip)
            slip_increment = s.tangential_motion - (elastic_slip - previous_elastic_slip)
            friction_loss = wp.dot(
                tangential_force - frozen[1] * elastic_slip, elastic_slip - previous_elastic_slip
            ) + wp.dot(tangential_force, slip_increment)
            add_to_row(energies, STORED, world, row, area_fraction * stored)
            add_to_row(energies, LOSS, world, row, area_fraction * (normal - spring[0]) * s.depth_increment)
            add_to_row(energies, FRICTION, world, row, area_fraction * friction_loss)
            add_overlap_work(
                energies, world, row, area_fraction * normal * overlap_recovery(con, his, clock, world, c, point)
            )
            place = surface_point(mas, pair.u_coefs, pair.director_u_coefs, world, f, pair.xi[world, point])
            add_to_row(scr.record_rows, NORMAL_ROW, world, row, area_fraction * normal)
            record_force(scr, world, row, (mas.sign[c] * area_fraction) * force, place.position)
            record_slip(scr, world, row, s.depth, facets.area[q, item], slipping, slip_increment)
            if s.depth <= f64(0.0):
                clear_history(his, pair_his, world, point)
            else:
                if law != PAPER:
                    elastic_slip = wp.transpose(facet_frame(place)) * elastic_slip
                his.spring[world, point] = elastic_slip
                his.stored[world, point] = stored
                update_history(
                    his, pair_his, scr, pair, world, point, f, frozen[0], slipping, s.depth_increment * inv_h
                )
        for j in range(4):
            scr.record_rows[STORED_ROW + j, world, row] = energies[j, world, row]

    @wp.kernel(module=module)
    def add_energy_bound(
        clock: Clock, potential: wp.array(dtype=f64), term_sums: wp.array2d(dtype=f64),
        accepted: wp.array(dtype=wp.int32), his: History, scr: ContactScratch,
    ):  # fmt: skip
        """Store the time of the accepted state, advance the elapsed time; add the contact energy, J, to the bound of
        the next initial iterate."""
        world = wp.tid()
        if accepted[world] == 0:
            return
        his.pose_time[world] = clock.time[world]
        scr.elapsed_time[world] = scr.elapsed_time[world] + clock.h[world]
        potential[world] = potential[world] + term_sums[1, world]

    return kernel_set(locals())
