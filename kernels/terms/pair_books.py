"""Contact between bodies after an accepted step: energy ledger, records, history."""

import functools
import types as _types

import warp as wp

from ..common.types import SMALL, kernel_module
from .contact import IDLE
from .contact_books import BOOKED, SUMS
from .contact_colliders import SLIPS
from .contact_data import attempt_struct, clock_struct, contact_struct, facet_struct, history_struct, of_world
from .contact_laws import PAPER, law_functions
from .contact_touch import touch_functions
from .pair_data import master_struct, seat_struct, touching_struct
from .pair_places import place_functions
from .pair_seek import seek_kernels
from .pairs import pair_functions

__all__ = ["pair_book_kernels"]


@functools.cache
def pair_book_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels in the module of `pair_kernels`."""
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets, History = contact_struct(False), facet_struct(dtype), history_struct()
    Attempt, Clock = attempt_struct(dtype), clock_struct()
    Masters, Seats, Touching = master_struct(dtype), seat_struct(), touching_struct(dtype)
    k, jet = touch_functions(dtype, False), place_functions(dtype).jet
    Touch, in_plane, pull, plane, friction_force, coefficient, recovered = (
        k.Touch,
        k.in_plane,
        k.pull,
        k.plane,
        k.friction_force,
        k.coefficient,
        k.recovered,
    )
    elastic = law_functions().elastic
    touch_of = pair_functions(dtype).touch_of
    frame = seek_kernels(dtype).frame
    module = kernel_module(f"pairs_{dtype}", max_unroll=SMALL)

    @wp.func
    def add(rows: wp.array3d(dtype=f64), j: int, world: int, row: int, value: f64):
        """rows[j, world, row] += value."""
        rows[j, world, row] = rows[j, world, row] + value

    @wp.func
    def add_work(rows: wp.array3d(dtype=f64), world: int, row: int, work: f64):
        """Work of a recovering initial overlap, which the integrator's own formula omits."""
        add(rows, 3, world, row, work)
        add(rows, 4, world, row, work)

    @wp.func
    def forget(his: History, seats: Seats, world: int, point: int):
        """Reset the history of a point that has left contact."""
        his.spring[world, point] = vec3d()
        his.stored[world, point] = f64(0.0)
        his.cap[world, point] = f64(0.0)
        his.speed[world, point] = f64(0.0)
        his.mark[world, point] = 0
        seats.seat[world, point] = 0
        seats.spot[world, point] = vec3d()

    @wp.func
    def tell_force(at: Attempt, world: int, row: int, force: vec3d, x: vec3d):
        """Add a force and its moment to the record of a facet."""
        moment = wp.cross(x, force)
        for j in range(3):
            add(at.rows, j, world, row, force[j])
            add(at.rows, 3 + j, world, row, moment[j])

    @wp.func
    def spring_after(law: int, s: Touch, held: vec3d, w: wp.vec4d, pulled: vec3d) -> vec3d:
        """Friction spring after the force was cut to the friction limit; Eq. (83) for the paper's law."""
        trial = vec3d(w[0], w[1], w[2])
        size = wp.length(trial)
        if size <= held[0]:
            return s.q
        if held[0] <= f64(0.0):
            return vec3d()
        if law == PAPER:
            return (f64(1.0) / held[1]) * pulled - ((w[3] - held[1]) / held[1]) * s.slip
        return s.q - ((size - held[0]) / (w[3] * size)) * trial

    @wp.func
    def remember(
        his: History, seats: Seats, at: Attempt, t: Touching, world: int, point: int, f: int, cap: f64, slips: int,
        closing: f64,
    ):  # fmt: skip
        """Store the master facet of a point, its largest approach speed, and its slip state."""
        his.cap[world, point] = cap
        his.speed[world, point] = wp.max(at.speed[world, point], closing)
        mark = wp.int32(1)
        if slips != 0 and cap > f64(0.0):
            mark += SLIPS
        his.mark[world, point] = mark
        seats.seat[world, point] = f + 1
        seats.spot[world, point] = t.spot[world, point]

    @wp.kernel(module=module)
    def finish(
        con: Contacts, mas: Masters, facets: Facets, his: History, seats: Seats, clock: Clock,
        accepted: wp.array(dtype=wp.int32), at: Attempt, t: Touching, booked: wp.array3d(dtype=f64),
    ):  # fmt: skip
        """Energy increments of an accepted substep, its record per facet, and the history after it."""
        world, item = wp.tid()
        if accepted[world] == 0:
            return
        c = facets.contact[item]
        law = con.law[c]
        row = facets.row + item
        for j in range(BOOKED):
            booked[j, world, row] = f64(0.0)
        for j in range(SUMS + 1):
            at.rows[j, world, row] = f64(0.0)
        inv_h = f64(0.0)
        if clock.still == 0:
            inv_h = f64(1.0) / clock.h[world]
        for q in range(facets.points):
            point = facets.point + item * facets.points + q
            share = facets.share[q, item]
            live = his.speed[world, point] > f64(0.0)
            f = t.seat[world, point]
            if share == f64(0.0) or (f < 0 and not live):
                continue
            stored, kept, base = f64(0.0), vec3d(), vec3d()
            if f < 0:  # beyond the boundary of the surface
                at.state[world, point] = IDLE
                add(booked, 1, world, row, share * his.stored[world, point])
                forget(his, seats, world, point)
                continue
            s = touch_of(con, at, t, world, c, point, inv_h)
            held = at.held[world, point]
            held[2] = f64(1.0)
            s = in_plane(s, at.plane[world, point])
            normal = s.law[0]
            pulled = friction_force(con, world, c, s, held, inv_h)
            w = pull(con, world, c, s, held, inv_h)
            slips = wp.where(wp.length(vec3d(w[0], w[1], w[2])) > held[0], 1, 0)
            if live:
                base = plane(s.m, t.whole[world, point] - t.motion[world, point])
            force = normal * s.n - pulled
            if con.dead[c] != 0:
                force = at.dead[world, point]
                normal = wp.dot(force, s.m)
                pulled = normal * s.m - force
                kept = at.dead_spring[world, point]
                k_t = con.scale[world, c] * of_world(con.tangent, world, c)
                held = vec3d(coefficient(con, his, world, c, point) * normal, k_t, f64(1.0))
                slips = wp.where(wp.length(pulled) >= f64(0.999999) * held[0], 1, 0)
            elif normal > f64(0.0) and held[1] > f64(0.0):
                kept = spring_after(law, s, held, w, pulled)
            spring = elastic(0, con.scale[world, c] * of_world(con.normal, world, c), s.depth)
            stored = spring[1] + f64(0.5) * held[1] * wp.dot(kept, kept)
            slid = s.slip - (kept - base)
            rubbed = wp.dot(pulled - held[1] * kept, kept - base) + wp.dot(pulled, slid)
            add(booked, 0, world, row, share * stored)
            add(booked, 1, world, row, share * (normal - spring[0]) * s.rise)
            add(booked, 2, world, row, share * rubbed)
            add_work(booked, world, row, share * normal * recovered(con, his, clock, world, c, point))
            place = jet(mas, t.C, t.D, world, f, t.spot[world, point])
            add(at.rows, 6, world, row, share * normal)
            tell_force(at, world, row, (mas.sign[c] * share) * force, place.x)
            if s.depth > f64(0.0):
                area = facets.area[q, item]
                add(at.rows, 7, world, row, area * f64(slips) * wp.length(slid))
                add(at.rows, 8, world, row, area)
                add(at.rows, 9, world, row, area * f64(1 - slips))
            at.rows[14, world, row] = wp.max(at.rows[14, world, row], s.depth)
            if s.depth <= f64(0.0):
                forget(his, seats, world, point)
            else:
                if law != PAPER:
                    kept = wp.transpose(frame(place)) * kept
                his.spring[world, point] = kept
                his.stored[world, point] = stored
                remember(his, seats, at, t, world, point, f, held[0], slips, s.rise * inv_h)
        for j in range(4):
            at.rows[10 + j, world, row] = booked[j, world, row]

    @wp.kernel(module=module)
    def close(
        clock: Clock, potential: wp.array(dtype=f64), term_sums: wp.array2d(dtype=f64),
        accepted: wp.array(dtype=wp.int32), his: History, at: Attempt,
    ):  # fmt: skip
        """Add the contact energy to the bound of the next initial iterate."""
        world = wp.tid()
        if accepted[world] == 0:
            return
        his.posed[world] = clock.time[world]
        at.elapsed[world] = at.elapsed[world] + clock.h[world]
        potential[world] = potential[world] + term_sums[1, world]

    return _types.SimpleNamespace(finish=finish, close=close)
