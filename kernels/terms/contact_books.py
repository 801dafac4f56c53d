"""Contact after an accepted step: history, energy ledger, record of each contact, fields, and matrix blocks."""

import functools
import types as _types

import warp as wp

from ..common.entries import add_symmetric_function
from ..common.structs import pattern_struct, topology_struct
from ..common.types import SMALL, kernel_module, precision
from .contact import IDLE
from .contact_colliders import MESHES, collider_functions
from .contact_data import RECORD, attempt_struct, clock_struct, contact_struct, facet_struct, history_struct, of_world
from .contact_laws import PAPER, SMOOTH, law_functions
from .contact_touch import touch_functions

__all__ = ["BOOKED", "LANES", "book_kernels", "contact_block_kernels"]

BOOKED = 5  # stored, loss, friction, work of the colliders, the integrator's part
LANES = 32
SUMS = len(RECORD) - 1
FORCES = 7
"""Leading rows of the record, averaged over the substeps of a step; area, stick and stored are values at its end."""


@functools.cache
def book_kernels(dtype: str, meshes: bool) -> _types.SimpleNamespace:
    """Kernels in the module of `contact_kernels`."""
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets = contact_struct(meshes), facet_struct(dtype)
    History, Attempt, Clock = history_struct(), attempt_struct(dtype), clock_struct()
    k = touch_functions(dtype, meshes)
    touch, in_plane, hold, pull, acts, Touch = k.touch, k.in_plane, k.hold, k.pull, k.acts, k.Touch
    plane, record_of, friction_force = k.plane, k.record_of, k.friction_force
    coefficient, lagrange, recovered = k.coefficient, k.lagrange, k.recovered
    elastic = law_functions().elastic
    g = collider_functions(meshes)
    side_after, released, SLIPS = g.side_after, g.released, g.SLIPS
    module = kernel_module(f"contact_{dtype}{MESHES * meshes}", max_unroll=SMALL)

    @wp.struct
    class Outcome:
        """Result of a point after a substep, for the whole region."""

        touch: Touch
        force: vec3d  # on the body, N
        normal: f64
        kept: vec3d  # stretch of its friction spring, m
        cap: f64
        slips: wp.int32
        slid: vec3d  # slip in the substep, m
        stored: f64  # J, as are the following
        loss: f64
        rubbed: f64
        given: f64  # by the collider
        left: f64  # the integrator's part that the ledger does not find by itself

    @wp.func
    def spring_after(con: Contacts, world: int, c: int, t: Touch, held: vec3d, inv_h: f64, pulled: vec3d) -> vec3d:
        """Friction spring after the force was cut to the friction limit; Eq. (83) for the paper's law."""
        w = pull(con, world, c, t, held, inv_h)
        if wp.length(vec3d(w[0], w[1], w[2])) <= held[0]:
            return t.q
        trial = vec3d(w[0], w[1], w[2])
        if con.law[c] != PAPER:  # spring and damper slip together: the stretch is bounded by the motion of the point
            if held[0] <= f64(0.0):
                return vec3d()
            size = wp.length(trial)
            return t.q - ((size - held[0]) / (w[3] * size)) * trial
        # reverses the spring where gamma_t v exceeds the friction limit
        return (f64(1.0) / held[1]) * pulled - ((w[3] - held[1]) / held[1]) * t.slip

    @wp.func
    def outcome(
        con: Contacts, facets: Facets, his: History, clock: Clock, at: Attempt, world: int, c: int, q: int, item: int,
        point: int, u: wp.array2d(dtype=vec3d),
    ) -> Outcome:  # fmt: skip
        """Force, friction spring and energies of a point at the end of a substep.

        The force on the body does `given` = f . (motion of the collider's material at the point) and, on the relative
        motion, -(change of stored energy + loss + friction + the integrator's part). The integrator's part has formulas
        of its own: chords of convex energies, and the contributions of a turning normal and a turning collider.
        """
        out = Outcome()
        rec = record_of(con, c, point)
        kc = con.collider[c]
        law = con.law[c]
        inv_h = f64(0.0)
        if clock.still == 0:
            inv_h = f64(1.0) / clock.h[world]
        held = at.held[world, rec]
        t = touch(con, facets, his, at, world, c, q, item, point, u, clock.new_time[world], inv_h, held[2])
        if con.dead[c] == 0:
            t = in_plane(t, at.plane[world, rec])
        change = t.depth - at.depth[world, point]
        spring = elastic(con.lumped[c], con.scale[world, c] * of_world(con.normal, world, c), t.depth)
        normal = t.law[0]
        pulled = friction_force(con, world, c, t, held, inv_h)
        w = pull(con, world, c, t, held, inv_h)
        out.slips = wp.where(wp.length(vec3d(w[0], w[1], w[2])) > held[0] or law == SMOOTH, 1, 0)
        base = vec3d()  # previous spring, in the tangent plane
        if his.speed[world, rec] > f64(0.0):
            base = his.spring[world, rec]
            if law != PAPER:
                base = at.turn[world, kc] * base
            base = plane(t.m, base)
        if con.dead[c] != 0:
            normal = wp.dot(at.dead[world, point], t.n)
            pulled = normal * t.n - at.dead[world, point]
            out.kept = at.dead_spring[world, point]
            held[0] = coefficient(con, his, world, c, rec) * normal
            out.slips = wp.where(wp.length(pulled) >= f64(0.999999) * held[0], 1, 0)
        elif normal > f64(0.0) and law != SMOOTH and held[1] > f64(0.0):
            out.kept = spring_after(con, world, c, t, held, inv_h, pulled)
        out.touch = t
        out.normal = normal
        out.cap = held[0]
        out.force = normal * t.n - pulled
        out.stored = spring[1] + f64(0.5) * held[1] * wp.dot(out.kept, out.kept)
        gain = out.stored - his.stored[world, rec]
        out.loss = (normal - spring[0]) * t.rise
        out.slid = t.slip - (out.kept - base)
        out.rubbed = wp.dot(pulled - held[1] * out.kept, out.kept - base) + wp.dot(pulled, out.slid)
        chord = spring[0] * change + held[1] * wp.dot(out.kept, out.kept - base) - gain
        chord += (normal - spring[0]) * (change - t.rise)  # of a moving contact point
        x = at.turn[world, kc] * t.y + at.place[world, kc]
        carried = at.shift[world, kc]  # motion of the collider's material at the point, by its last velocity
        if con.spin[kc] >= 0:
            angle = at.angle[world, kc] - his.angle[world, kc]
            carried = angle * wp.cross(con.axis[kc], x - con.anchor[kc])
        risen = recovered(con, his, clock, world, c, point)
        out.given = wp.dot(out.force, carried) + normal * risen
        # the ledger attributes the remaining work of the force to the integrator; `left` makes it agree with these
        # formulas
        x_n = his.turn[world, kc] * at.start[world, point] + his.place[world, kc]
        turned = -wp.dot(out.force, x - x_n - carried) - (normal * (change - risen) + wp.dot(pulled, t.slip))
        out.left = chord + turned + wp.dot(out.force, x - x_n) + gain + out.loss + out.rubbed
        return out

    @wp.func
    def remember(
        con: Contacts, facets: Facets, his: History, clock: Clock, at: Attempt, world: int, c: int, point: int,
        o: Outcome,
    ):  # fmt: skip
        """Store the history of a point."""
        rec = record_of(con, c, point)
        if facets.moving != 0:
            his.lead[world, rec] = o.touch.depth
        kc = con.collider[c]
        if o.touch.depth <= f64(0.0):
            mark = released(con, kc, his.speed[world, rec] > f64(0.0), his.mark[world, rec])
            his.spring[world, rec] = vec3d()
            his.stored[world, rec] = f64(0.0)
            his.cap[world, rec] = f64(0.0)
            his.speed[world, rec] = f64(0.0)
            his.mark[world, rec] = mark
            return
        speed = at.speed[world, point]
        if clock.still == 0:
            speed = wp.max(speed, o.touch.rise / clock.h[world])
        kept = o.kept
        if con.law[c] != PAPER:
            kept = wp.transpose(at.turn[world, kc]) * kept
        his.spring[world, rec] = kept
        his.stored[world, rec] = o.stored
        his.cap[world, rec] = o.cap
        his.speed[world, rec] = speed
        mark = side_after(con, kc, o.touch.y, o.touch.side) + 1
        if o.slips != 0 and o.cap > f64(0.0):
            mark += SLIPS
        his.mark[world, rec] = mark

    @wp.func
    def add(rows: wp.array3d(dtype=f64), k: int, world: int, row: int, value: f64):
        """rows[k, world, row] += value."""
        rows[k, world, row] = rows[k, world, row] + value

    @wp.kernel(module=module)
    def finish(
        con: Contacts, facets: Facets, his: History, clock: Clock, u: wp.array2d(dtype=vec3d),
        accepted: wp.array(dtype=wp.int32), at: Attempt, booked: wp.array3d(dtype=f64),
    ):  # fmt: skip
        """Energy increments of an accepted substep, its record per facet, and the history after it."""
        world, item = wp.tid()
        if accepted[world] == 0:
            return
        c = facets.contact[item]
        row = facets.row + item
        for j in range(BOOKED):
            booked[j, world, row] = f64(0.0)
        for j in range(SUMS + 1):
            at.rows[j, world, row] = f64(0.0)
        for q in range(facets.points):
            point = facets.point + item * facets.points + q
            share = facets.share[q, item] * acts(con, at, world, c, point)
            idle = at.state[world, point] == IDLE and his.speed[world, record_of(con, c, point)] == f64(0.0)
            if share > f64(0.0) and (con.dead[c] != 0 or not idle):
                o = outcome(con, facets, his, clock, at, world, c, q, item, point, u)
                add(booked, 0, world, row, share * o.stored)
                add(booked, 1, world, row, share * o.loss)
                add(booked, 2, world, row, share * o.rubbed)
                add(booked, 3, world, row, share * o.given)
                add(booked, 4, world, row, share * o.left)
                x = at.turn[world, con.collider[c]] * o.touch.y + at.place[world, con.collider[c]]
                moment = wp.cross(x, o.force)
                for j in range(3):
                    add(at.rows, j, world, row, share * o.force[j])
                    add(at.rows, 3 + j, world, row, share * moment[j])
                add(at.rows, 6, world, row, share * o.normal)
                if o.touch.depth > f64(0.0) or con.law[c] == SMOOTH:
                    area = facets.area[q, item]
                    add(at.rows, 7, world, row, area * f64(o.slips) * wp.length(o.slid))
                    add(at.rows, 8, world, row, area)
                    add(at.rows, 9, world, row, area * f64(1 - o.slips))
                for j in range(4):
                    at.rows[10 + j, world, row] = booked[j, world, row]
                at.rows[14, world, row] = wp.max(at.rows[14, world, row], o.touch.depth)
                remember(con, facets, his, clock, at, world, c, point, o)

    @wp.kernel(module=module)
    def partial_records(
        con: Contacts, rows_of: wp.array(dtype=wp.int32), accepted: wp.array(dtype=wp.int32), at: Attempt,
        out: wp.array4d(dtype=f64),
    ):  # fmt: skip
        """Sums over the facets of a contact, by lanes: [world, contact, RECORD, lane]."""
        world, c, j, lane = wp.tid()
        if accepted[world] == 0:
            return
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
        """Record of the step so far: forces averaged over time, work summed."""
        world, c, j = wp.tid()
        if accepted[world] == 0:
            return
        h = clock.h[world]
        past = at.elapsed[world]
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
        con: Contacts, clock: Clock, potential: wp.array(dtype=f64), term_sums: wp.array2d(dtype=f64),
        accepted: wp.array(dtype=wp.int32), his: History, at: Attempt,
    ):  # fmt: skip
        """Store the poses of the colliders; add the contact energy to the bound of the next initial iterate."""
        world, k = wp.tid()
        if accepted[world] == 0:
            return
        his.place[world, k] = at.place[world, k]
        his.turn[world, k] = at.turn[world, k]
        his.angle[world, k] = at.angle[world, k]
        his.grown[world, k] = con.grow[world, k]
        if k == 0:
            his.posed[world] = clock.time[world]
            at.elapsed[world] = at.elapsed[world] + clock.h[world]
            potential[world] = potential[world] + term_sums[1, world]

    @wp.kernel(module=module)
    def write_records(at: Attempt, first: int, report: wp.array2d(dtype=f64)):
        """Record of each contact for the report of the step; slip and stick as averages over the area in contact."""
        world, c = wp.tid()
        area = at.total[world, c, 8]
        for j in range(SUMS + 1):
            value = at.total[world, c, j]
            if j == 7 or j == 9:
                value = value / wp.max(area, f64(1.0e-300))
            report[world, first + (SUMS + 1) * c + j] = value

    @wp.kernel(module=module)
    def at_points(
        con: Contacts, facets: Facets, his: History, u: wp.array2d(dtype=vec3d), time: wp.array(dtype=f64),
        at: Attempt, places: int, gap: wp.array2d(dtype=f64), force: wp.array2d(dtype=vec3d),
    ):  # fmt: skip
        """Gap, m, and elastic force, N, of each point at a state, without rates; with `places` the gap of a moving
        contact point is written at the point next to it."""
        world, item, q = wp.tid()
        point = facets.point + item * facets.points + q
        if facets.share[q, item] == f64(0.0):
            gap[world, point] = f64(1.0e30)
            return
        c = facets.contact[item]
        share = facets.share[q, item] * acts(con, at, world, c, point)
        acting = point
        if facets.moving != 0:  # the force at the contact point is written at a point of its facet
            gap[world, point] = -at.level[world, point]
            row = facets.row + item
            share = f64(0.0)
            acting = at.pick[world, c]
            if at.moves[world, c] == row:
                share = lagrange(facets, q, at.spot[world, row])
                if wp.length_sq(at.spot[world, row] - facets.coords[acting - (point - q)]) == f64(0.0):
                    share = wp.where(acting == point, f64(1.0), f64(0.0))
            if share == f64(0.0) and acting != point:
                return
        t = touch(con, facets, his, at, world, c, q, item, acting, u, time[world], f64(0.0), f64(1.0))
        held = hold(con, his, at, world, c, acting, t)
        if acting == point and (facets.moving == 0 or places != 0):
            gap[world, point] = -t.depth
        force[world, point] = share * (t.law[0] * t.n - friction_force(con, world, c, t, held, f64(0.0)))

    return _types.SimpleNamespace(
        module=module, finish=finish, partial_records=partial_records, total_records=total_records,
        keep_poses=keep_poses, write_records=write_records, at_points=at_points,
    )  # fmt: skip


@functools.cache
def contact_block_kernels(dtype: str) -> _types.SimpleNamespace:
    """Contributions of contact to an assembled matrix."""
    p = precision(dtype)
    T, mat33, sym = p.T, p.mat33, p.sym
    f64 = wp.float64
    Facets = facet_struct(dtype)
    Topology, Pattern = topology_struct(dtype), pattern_struct()
    add_symmetric = add_symmetric_function(dtype)
    module = kernel_module(f"contact_blocks_{dtype}", max_unroll=SMALL)

    @wp.kernel(module=module)
    def add_contact(
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
            for q in range(facets.points):
                s = facets.shape[q, at[1], at[0]] * facets.shape[q, at[2], at[0]]
                if facets.moving != 0:
                    c = facets.contact[at[0]]
                    s = weight[world, c, at[1]] * weight[world, c, at[2]]
                k6 += s * stiffness[world, facets.point + at[0] * facets.points + q]
        add_symmetric(topo, pattern.upper[entry[index]], T(dq_dv[world]) * k6, world, value)

    return _types.SimpleNamespace(module=module, add_contact=add_contact)
