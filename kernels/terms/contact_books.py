"""What an accepted step of contact leaves: history, books of energy, the record of each contact, fields, and blocks."""

import functools
import types as _types

import warp as wp

from ..common.entries import add_block_function
from ..common.structs import pattern_struct, topology_struct
from ..common.types import SMALL, kernel_module, precision
from .contact_data import RECORD, attempt_struct, clock_struct, contact_struct, facet_struct, history_struct
from .contact_laws import PAPER, SMOOTH, law_functions
from .contact_touch import SLIPS, touch_functions

__all__ = ["BOOKED", "LANES", "book_kernels", "contact_block_kernels"]

BOOKED = 5  # stored, loss, friction, work of the colliders, the integrator's part
LANES = 32
SUMS = len(RECORD) - 1
FORCES = 7
"""Rows averaged over the substeps of a step, the first so many; area, stick and stored are those at its end."""


@functools.cache
def book_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels in the module of `contact_kernels`."""
    p = precision(dtype)
    vec3 = p.vec3
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets = contact_struct(), facet_struct(dtype)
    History, Attempt, Clock = history_struct(), attempt_struct(dtype), clock_struct()
    k = touch_functions(dtype)
    touch, hold, pull, acts = k.touch, k.hold, k.pull, k.acts
    plane, record_of, friction_force = k.plane, k.record_of, k.friction_force
    elastic = law_functions().elastic
    module = kernel_module(f"contact_{dtype}", max_unroll=SMALL)

    @wp.kernel(module=module)
    def finish(
        con: Contacts, facets: Facets, his: History, clock: Clock, u: wp.array2d(dtype=vec3),
        accepted: wp.array(dtype=wp.int32), at: Attempt, booked: wp.array3d(dtype=f64),
    ):  # fmt: skip
        """Books of an accepted substep per facet, and the history after it.

        The force on the body does collider_work = f . (motion of the collider's material at the point) and, on the
        relative motion, -(change of what is stored + loss + friction + the integrator's part). That part is made of its
        own formulas: chords of convex energies, and what a turning normal and a turning collider leave.
        """
        world, item = wp.tid()
        if accepted[world] == 0:
            return
        c = facets.contact[item]
        row = facets.row + item
        for j in range(BOOKED):
            booked[j, world, row] = f64(0.0)
        for j in range(SUMS + 1):
            at.rows[j, world, row] = f64(0.0)
        h = clock.h[world]
        inv_h = f64(0.0)
        if clock.still == 0:
            inv_h = f64(1.0) / h
        lumped = con.lumped[c]
        law = con.law[c]
        kc = con.collider[c]
        k_n = con.scale[world, c] * con.normal[c]
        for q in range(facets.points):
            point = facets.point + item * facets.points + q
            share = facets.share[q, item] * acts(con, at, world, c, point)
            if share > f64(0.0):
                rec = record_of(con, c, point)
                live = his.speed[world, rec] > f64(0.0)
                held = at.held[world, point]
                t = touch(con, facets, his, at, world, c, q, item, point, u, clock.new_time[world], inv_h, held[2])
                before = at.depth[world, point]
                change = t.depth - before
                spring = elastic(lumped, k_n, t.depth)
                normal = t.law[0]
                pulled = friction_force(con, world, c, t, held, inv_h)
                kept = vec3d()  # the spring that stays
                w = pull(con, world, c, t, held, inv_h)
                trial = vec3d(w[0], w[1], w[2])
                slips = wp.length(trial) > held[0] or law == SMOOTH
                old = vec3d()
                if live:
                    old = his.spring[world, rec]
                    if law != PAPER:
                        old = at.turn[world, kc] * old
                if con.dead[c] != 0:
                    force = at.dead[world, point]
                    normal = wp.dot(force, t.n)
                    pulled = normal * t.n - force
                    kept = at.dead_spring[world, point]
                    slips = wp.length(pulled) >= f64(0.999999) * con.mu[world, c] * normal
                elif normal > f64(0.0) and law != SMOOTH and held[1] > f64(0.0):
                    kept = t.q
                    if slips:
                        kept = (f64(1.0) / held[1]) * pulled
                        if law == PAPER:  # Eq. (83), which turns the spring where gamma_t v is above the cap
                            kept -= ((w[3] - held[1]) / held[1]) * t.slip
                inside = t.depth > f64(0.0) or law == SMOOTH
                stored = spring[1] + f64(0.5) * held[1] * wp.dot(kept, kept)
                past_stored = his.stored[world, rec]
                force = normal * t.n - pulled
                loss = (normal - spring[0]) * change
                base = plane(t.n, old)
                slid = t.slip - (kept - base)
                rubbed = wp.dot(pulled - held[1] * kept, kept - base) + wp.dot(pulled, slid)
                back = his.turn[world, kc] * (t.y - at.start[world, point])  # relative motion, in the old frame
                chord = spring[0] * change + held[1] * wp.dot(kept, kept - base) - (stored - past_stored)
                turned = -wp.dot(force, back) - (normal * change + wp.dot(pulled, t.slip))
                x = at.turn[world, kc] * t.y + at.place[world, kc]
                carried = x - (his.turn[world, kc] * t.y + his.place[world, kc])
                given = wp.dot(force, carried)
                booked[0, world, row] = booked[0, world, row] + share * stored
                booked[1, world, row] = booked[1, world, row] + share * loss
                booked[2, world, row] = booked[2, world, row] + share * rubbed
                booked[3, world, row] = booked[3, world, row] + share * given
                # the ledger takes for the integrator what the work of the force leaves; it is to find these formulas
                x_n = his.turn[world, kc] * at.start[world, point] + his.place[world, kc]
                left = -wp.dot(force, x - x_n) - (stored - past_stored) - loss - rubbed
                booked[4, world, row] = booked[4, world, row] + share * (chord + turned - left)
                area = facets.area[q, item]
                moment = wp.cross(x, force)
                for j in range(3):
                    at.rows[j, world, row] = at.rows[j, world, row] + share * force[j]
                    at.rows[3 + j, world, row] = at.rows[3 + j, world, row] + share * moment[j]
                at.rows[6, world, row] = at.rows[6, world, row] + share * normal
                if inside:
                    at.rows[7, world, row] = at.rows[7, world, row] + area * wp.where(slips, wp.length(slid), f64(0.0))
                    at.rows[8, world, row] = at.rows[8, world, row] + area
                    at.rows[9, world, row] = at.rows[9, world, row] + wp.where(slips, f64(0.0), area)
                at.rows[10, world, row] = at.rows[10, world, row] + share * stored
                at.rows[11, world, row] = at.rows[11, world, row] + share * loss
                at.rows[12, world, row] = at.rows[12, world, row] + share * rubbed
                at.rows[13, world, row] = at.rows[13, world, row] + share * given
                at.rows[14, world, row] = wp.max(at.rows[14, world, row], t.depth)
                if t.depth > f64(0.0):
                    speed = at.speed[world, point]
                    if clock.still == 0:
                        speed = wp.max(speed, change / h)
                    if law != PAPER:
                        kept = wp.transpose(at.turn[world, kc]) * kept
                    his.spring[world, rec] = kept
                    his.stored[world, rec] = stored
                    his.cap[world, rec] = held[0]
                    his.speed[world, rec] = speed
                    side = wp.max(t.side, -1) + 1
                    if slips and held[0] > f64(0.0):
                        side += SLIPS
                    his.mark[world, rec] = side
                else:
                    his.spring[world, rec] = vec3d()
                    his.stored[world, rec] = f64(0.0)
                    his.cap[world, rec] = f64(0.0)
                    his.speed[world, rec] = f64(0.0)
                    his.mark[world, rec] = 0

    @wp.kernel(module=module)
    def partial_records(
        con: Contacts, rows_of: wp.array(dtype=wp.int32), accepted: wp.array(dtype=wp.int32), at: Attempt,
        out: wp.array4d(dtype=f64),
    ):  # fmt: skip
        """Sums over the facets of a contact, by lanes; [world, contact, RECORD, lane]."""
        world, c, lane = wp.tid()
        if accepted[world] == 0:
            return
        for j in range(SUMS + 1):
            total = f64(0.0)
            for row in range(rows_of[c] + lane, rows_of[c + 1], LANES):
                value = at.rows[j, world, row]
                if j == SUMS:
                    total = wp.max(total, value)
                else:
                    total += value
            out[world, c, j, lane] = total

    @wp.kernel(module=module)
    def total_records(
        clock: Clock, accepted: wp.array(dtype=wp.int32), parts: wp.array4d(dtype=f64), at: Attempt
    ):  # fmt: skip
        """The record of the step so far: forces averaged over time, work added up."""
        world, c = wp.tid()
        if accepted[world] == 0:
            return
        h = clock.h[world]
        past = at.elapsed[world]
        for j in range(SUMS + 1):
            total = f64(0.0)
            for lane in range(LANES):
                if j == SUMS:
                    total = wp.max(total, parts[world, c, j, lane])
                else:
                    total += parts[world, c, j, lane]
            old = at.total[world, c, j]
            if past == f64(0.0):
                old = f64(0.0)
            if j < FORCES:
                if clock.still == 0:
                    total = (past * old + h * total) / (past + h)
            elif j == SUMS:
                total = wp.max(total, old)
            elif j == 7 or j > 10:
                total += old
            at.total[world, c, j] = total

    @wp.kernel(module=module)
    def keep_poses(
        clock: Clock, potential: wp.array(dtype=f64), term_sums: wp.array2d(dtype=f64),
        accepted: wp.array(dtype=wp.int32), his: History, at: Attempt,
    ):  # fmt: skip
        """Keep the places of the colliders; the energy of contact counts in the bound of the next first iterate."""
        world, k = wp.tid()
        if accepted[world] == 0:
            return
        his.place[world, k] = at.place[world, k]
        his.turn[world, k] = at.turn[world, k]
        if k == 0:
            at.elapsed[world] = at.elapsed[world] + clock.h[world]
            potential[world] = potential[world] + term_sums[1, world]

    @wp.kernel(module=module)
    def write_records(at: Attempt, first: int, report: wp.array2d(dtype=f64)):
        """The record of each contact into the report of the step; of slip and stick means over the area in contact."""
        world, c = wp.tid()
        area = at.total[world, c, 8]
        for j in range(SUMS + 1):
            value = at.total[world, c, j]
            if j == 7 or j == 9:
                value = value / wp.max(area, f64(1.0e-300))
            report[world, first + (SUMS + 1) * c + j] = value

    @wp.kernel(module=module)
    def at_points(
        con: Contacts, facets: Facets, his: History, u: wp.array2d(dtype=vec3), time: wp.array(dtype=f64),
        at: Attempt, gap: wp.array2d(dtype=f64), force: wp.array2d(dtype=vec3d),
    ):  # fmt: skip
        """At a state, without rates: gap, m, and the elastic force on the point, N."""
        world, item, q = wp.tid()
        point = facets.point + item * facets.points + q
        if facets.share[q, item] == f64(0.0):
            gap[world, point] = f64(1.0e30)
            return
        c = facets.contact[item]
        t = touch(con, facets, his, at, world, c, q, item, point, u, time[world], f64(0.0), f64(1.0))
        held = hold(con, his, at, world, c, point, t)
        gap[world, point] = -t.depth
        share = facets.share[q, item] * acts(con, at, world, c, point)
        force[world, point] = share * (t.law[0] * t.n - friction_force(con, world, c, t, held, f64(0.0)))

    return _types.SimpleNamespace(
        module=module, finish=finish, partial_records=partial_records, total_records=total_records,
        keep_poses=keep_poses, write_records=write_records, at_points=at_points,
    )  # fmt: skip


@functools.cache
def contact_block_kernels(dtype: str) -> _types.SimpleNamespace:
    """What contact adds to a matrix."""
    p = precision(dtype)
    T, mat33, sym = p.T, p.mat33, p.sym
    f64 = wp.float64
    Facets = facet_struct(dtype)
    Topology, Pattern = topology_struct(dtype), pattern_struct()
    add_block = add_block_function(dtype)
    module = kernel_module(f"contact_blocks_{dtype}", max_unroll=SMALL)

    @wp.kernel(module=module)
    def add_contact(
        topo: Topology, pattern: Pattern, facets: Facets, entry: wp.array(dtype=wp.int32),
        start: wp.array(dtype=wp.int32), source: wp.array(dtype=wp.vec3i), stiffness: wp.array2d(dtype=sym),
        dq_dv: wp.array(dtype=f64), active: wp.array(dtype=wp.int32), value: wp.array2d(dtype=mat33),
    ):  # fmt: skip
        """value += (dq/dv) sum over points of s_a s_b K; `source`: facet and two of its slots."""
        world, index = wp.tid()
        if active[world] == 0:
            return
        k6 = sym()
        for e in range(start[index], start[index + 1]):
            at = source[e]
            for q in range(facets.points):
                s = facets.shape[q, at[1], at[0]] * facets.shape[q, at[2], at[0]]
                k6 += s * stiffness[world, facets.point + at[0] * facets.points + q]
        k6 = T(dq_dv[world]) * k6
        A = mat33(k6[0], k6[5], k6[4], k6[5], k6[1], k6[3], k6[4], k6[3], k6[2])
        add_block(topo, pattern.upper[entry[index]], A, world, value)

    return _types.SimpleNamespace(module=module, add_contact=add_contact)
