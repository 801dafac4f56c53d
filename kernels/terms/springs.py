"""Springs, actuators, stops and joint friction: forces of scalar coordinates y of vectors linear in the slots.

A spring has the force F = dW/dy(y) + F_v(y, dy/dt) along y, and the vectors a, b, a2 of a row of constraints.py:

    LENGTH   y = |a|                                    between two points
    ANGLE    y = atan2(a2.b, a.b), turns counted        of a revolute joint
    TRAVEL   y = a.b                                    of a translational or cylindrical joint
    VECTOR   a itself, W = k a.a / 2                    of a foundation, per area
    CHORD    a itself, W = k psi(a.a), see chords.py    of a bushing

In a step dy/dt = (y - y~)/(dq/dv), with y~ the coordinate's q~: Phi contains W and the integral of F_v from y~ on, and
the tangent is symmetric. In a mid-point scheme F is the mean of dW/dy between both ends, dy/dt the mean rate, and both
act along a discrete gradient of y, whose product with the change of the vectors is that of y: W changes by exactly the
work done. Those of LENGTH and ANGLE are gradients at the middle of a.a, and of |(a.b, a2.b)| sin(y - y_m), both
quadratic, so that they have no moment; that of TRAVEL is its gradient at the middle. Evaluated in float64 from
displacements, as constraints.py.
"""

import functools

import warp as wp

from ..common.block_entries import add_block_function
from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import IMPACT_FOUND, RESTART_FOUND, pattern_struct, topology_struct
from ..common.types import double_1d, double_2d, double_3d, f64, int_1d, mat33d, precision, vec3d, vec3d_2d
from .bounded_laws import FRICTION, STOP, bounded_functions
from .chords import chord_functions
from .spring_coordinates import ANGLE, CHORD, FULL_TURN, LENGTH, TINY, TRAVEL, VECTOR, coordinate_functions
from .spring_laws import OwnForces, law_functions, spring_struct

__all__ = ["ANGLE", "CHORD", "LENGTH", "TRAVEL", "VECTOR", "scratch_struct", "spring_kernels"]

mat33d_2d = wp.array2d(dtype=mat33d)


@functools.cache
def scratch_struct():
    """Springs at an iterate; vectors of a spring as rows of a matrix."""

    @wp.struct
    class SpringScratch:
        winding: wp.array2d(dtype=wp.float64)  # [world, item] angle of whole turns at the start of the step, not in y
        start: wp.array2d(dtype=wp.float64)  # [world, item] y at the start of the step
        reference: wp.array2d(dtype=wp.float64)  # [world, item] y~
        anchor: wp.array2d(dtype=wp.float64)  # [world, item] of FRICTION at the start of the step
        force: wp.array2d(dtype=wp.mat33d)  # [world, item] derivatives of the potential by the vectors
        product: wp.array2d(dtype=wp.mat33d)  # [world, item] their change along a direction
        hessian: wp.array2d(dtype=wp.mat33d)  # [world, block] derivatives of the force
        projected: wp.array2d(dtype=wp.mat33d)  # [world, block] positive semi-definite part
        rows: wp.array3d(dtype=wp.float64)  # [TERM_ROWS, world, item] of the potential, J

    return SpringScratch


@functools.cache
def spring_kernels(
    dtype: str, midpoint: bool, own: OwnForces = (), bounded: bool = False, has_chords: bool = False
) -> KernelSet:  # fmt: skip
    """Kernels of springs in one precision of the slots; `own`: forces given as functions; `bounded`: some have a law of
    bounded_laws.py; `has_chords`: some are a CHORD."""
    p = precision(dtype)
    T, vec3, sym6, mat33 = p.T, p.vec3, p.sym, p.mat33
    Springs, Scratch, Topology, Pattern = spring_struct(), scratch_struct(), topology_struct(dtype), pattern_struct()
    law, c, more = law_functions(own), coordinate_functions(midpoint), bounded_functions(midpoint)
    chords = chord_functions(midpoint)
    add_block = add_block_function(dtype)
    suffix = "_bounded" * bounded + "_chords" * has_chords + "".join(f"_{name}" for name, _ in own)
    module = kernel_module(f"springs_{dtype}{'_midpoint' if midpoint else ''}{suffix}")

    @wp.func
    def side_count(kind: int) -> int:
        """Number of vectors that a coordinate depends on."""
        if kind == TRAVEL:
            return 2
        return wp.where(kind == ANGLE, 3, 1)

    @wp.func
    def vectors(spr: Springs, x: p.vec3_2d, world: int, item: int) -> mat33d:
        """Sums over the slots of an item."""
        out = mat33d()
        for k in range(spr.entry_start[item], spr.entry_start[item + 1]):
            out += wp.outer(spr.entry_weight[k], vec3d(x[world, spr.entry_slot[k]]))
        return out

    @masked_kernel(module, "active")
    def begin(
        spr: Springs, u: p.vec3_2d, v: p.vec3_2d, earlier: p.vec3_2d, accelerated: int, first: double_1d,
        second: double_1d, turned: double_2d, anchor: double_2d, active: int_1d, scr: Scratch,
    ):  # fmt: skip
        """y at the start, and y~ = a0 y - a1 y(u_{n-1}), with accelerations y + b dy/dt + q_a d2y/dt2, in a mid-point
        scheme y, of friction y + b dy/dt."""
        world, item = wp.tid()
        kind = spr.kind[item]
        if kind == VECTOR or kind == CHORD:
            return
        near, winding = f64(0.0), f64(0.0)
        if kind == ANGLE:
            near = turned[world, item]
            winding = f64(FULL_TURN) * wp.round(near / f64(FULL_TURN))
        V = spr.reference[item] + vectors(spr, u, world, item)
        y = c.coordinate(kind, V, near - winding)
        scr.winding[world, item] = winding
        scr.start[world, item] = y
        if wp.static(bounded):
            if spr.law[spr.spring[item]] == FRICTION:
                previous = anchor[world, item] - winding
                scr.anchor[world, item] = wp.where(wp.isnan(previous), y, previous)
        if wp.static(midpoint):
            reference = y
            if wp.static(bounded):
                if spr.law[spr.spring[item]] == FRICTION:  # its rate is that at the end of the step
                    turn = wp.ddot(c.derivatives(kind, V, y).g, vectors(spr, v, world, item))
                    reference += second[world] * turn
        elif accelerated == 0:
            reference = first[world] * y
            if second[world] != f64(0.0):
                before = c.coordinate(kind, spr.reference[item] + vectors(spr, earlier, world, item), y)
                reference -= second[world] * before
        else:
            d = c.derivatives(kind, V, y)
            D = vectors(spr, v, world, item)
            turn = wp.ddot(d.g, vectors(spr, earlier, world, item))
            for s in range(3):
                for t in range(3):
                    turn += wp.dot(D[s], c.curvature(kind, d, s, t) * D[t])
            reference = y + first[world] * wp.ddot(d.g, D) + second[world] * turn
        scr.reference[world, item] = reference

    @wp.func
    def vector_force(kind: int, a: vec3d, b: vec3d, stiffness: f64, damping: f64) -> chords.VectorForce:
        """Force of a VECTOR or CHORD, see chords.py."""
        if wp.static(has_chords):
            if kind == CHORD:
                return chords.chord_force(a, b, stiffness)
        return chords.plain_force(a, b, stiffness, damping)

    @wp.func
    def evaluate_vector(
        spr: Springs, u: p.vec3_2d, start: p.vec3_2d, inverse: f64, world: int, item: int, scr: Scratch
    ):
        """Force, tangent and potential of a VECTOR or CHORD; `start`: q~, or of a mid-point step the start."""
        stiffness = spr.scale[item] * spr.stiffness[world, spr.spring[item]]
        damping = spr.scale[item] * spr.damping[world, spr.spring[item]] * inverse
        a = spr.reference[item] + vectors(spr, u, world, item)
        b = spr.reference[item] + vectors(spr, start, world, item)
        block = spr.first_block[item]
        found = vector_force(spr.kind[item], a[0], b[0], stiffness, damping)
        scr.force[world, item] = wp.matrix_from_rows(found.force, vec3d(), vec3d())
        scr.hessian[world, block] = found.hessian
        scr.projected[world, block] = found.projected
        for row in range(3):
            scr.rows[row, world, item] = wp.where(row == 2, wp.abs(found.energy), found.energy)

    @wp.func
    def unbounded(
        spr: Springs, world: int, item: int, y0: f64, y: f64, inverse: f64, in_motion: f64, scr: Scratch
    ) -> vec3d:  # fmt: skip
        """Force, its derivative by y, and the potential of a law of spring_laws.py; its size into the rows."""
        sp, winding = spr.spring[item], scr.winding[world, item]
        counted = y + winding
        reference = scr.reference[world, item] + winding
        if wp.static(midpoint):
            elastic_part = law.mean_force(spr, world, sp, y0 + winding, counted)
            viscous_part = law.viscous_force(spr, world, sp, f64(0.5) * (y0 + y) + winding, (y - y0) * inverse)
            viscous_part[1] = f64(0.5) * viscous_part[1]
        else:
            elastic_part = law.elastic_force(spr, world, sp, counted)
            viscous_part = law.viscous_force(spr, world, sp, counted, (counted - reference) * inverse)
        energy = law.energy(spr, world, sp, counted)
        loss = f64(0.0)
        if in_motion > f64(0.0):
            loss = law.viscous_potential(spr, world, sp, reference, counted, inverse)
        scr.rows[2, world, item] = wp.abs(energy) + wp.abs(loss)
        slope = elastic_part[1] + in_motion * (viscous_part[1] + viscous_part[2] * inverse)
        return vec3d(elastic_part[0] + in_motion * viscous_part[0], slope, energy + loss)

    @wp.func
    def store_force(
        kind: int, first: int, d: c.Derivatives, force: f64, slope: f64, world: int, item: int, scr: Scratch
    ):  # fmt: skip
        """Force on the vectors and its derivatives from those along y."""
        scr.force[world, item] = force * d.G
        sides = side_count(kind)
        tension = f64(0.0)  # of a stretched spring: the geometric stiffness is positive
        if kind == LENGTH:
            tension = wp.max(force, f64(0.0)) * d.unit[0]
        size = wp.max(wp.length_sq(d.G[0]), f64(TINY))
        for s in range(sides):
            for t in range(sides):
                block = first + sides * s + t
                along = wp.outer(d.G[s], d.G[t])
                scr.hessian[world, block] = slope * wp.outer(d.G[s], d.g[t]) + force * c.curvature(kind, d, s, t)
                scr.projected[world, block] = (
                    wp.max(slope, f64(0.0)) - tension / size
                ) * along + tension * wp.identity(n=3, dtype=f64)

    @wp.func
    def scheduled(spr: Springs, law_value: vec3d_2d, world: int, sp: int) -> f64:
        """Value of the time law of a spring, 0 without."""
        if spr.schedule[sp] < 0:
            return f64(0.0)
        return law_value[world, spr.schedule[sp]][0]

    @wp.func
    def force_along(
        spr: Springs, law_value: vec3d_2d, in_motion: f64, inverse: f64, V: mat33d, y: f64, world: int, item: int,
        scr: Scratch,
    ) -> vec3d:  # fmt: skip
        """Force along y of an item, its derivative, and the potential; its size into the rows."""
        sp, y0 = spr.spring[item], scr.start[world, item]
        if wp.static(bounded):
            if spr.law[sp] < 0:
                value, anchor = scheduled(spr, law_value, world, sp), scr.anchor[world, item]
                reference, winding = scr.reference[world, item], scr.winding[world, item]
                out = more.bounded_force(spr, world, sp, winding, y0, y, reference, inverse, anchor, value)
                # round-off of an angle is that of 1 rad, of a travel that of its vectors
                size = wp.where(spr.kind[item] == ANGLE, f64(1.0), wp.length(V[0]) * wp.length(V[1])) + wp.abs(y)
                scr.rows[2, world, item] = wp.abs(out[2]) + wp.abs(out[0]) * size
                return out
        return unbounded(spr, world, item, y0, y, inverse, in_motion, scr)

    @masked_kernel(module, "active")
    def evaluate(
        spr: Springs, u: p.vec3_2d, start: p.vec3_2d, law_value: vec3d_2d, in_motion: f64, span: double_1d,
        active: int_1d, scr: Scratch,
    ):  # fmt: skip
        """Forces on the vectors, their derivatives, and rows of the potential. `in_motion`: 1, or 0 in statics. `span`:
        dq/dv, of a mid-point scheme h: time of the change whose rate acts on dampers."""
        world, item = wp.tid()
        kind = spr.kind[item]
        inverse = in_motion / span[world]
        if kind == VECTOR or kind == CHORD:
            evaluate_vector(spr, u, start, inverse, world, item, scr)
            return
        V = spr.reference[item] + vectors(spr, u, world, item)
        y0 = scr.start[world, item]
        y = c.coordinate(kind, V, y0)
        if wp.static(midpoint):
            d = c.mean_derivatives(kind, spr.reference[item] + vectors(spr, start, world, item), V, y0, y)
        else:
            d = c.derivatives(kind, V, y)
        spring = force_along(spr, law_value, in_motion, inverse, V, y, world, item, scr)
        scr.rows[0, world, item] = spring[2]
        scr.rows[1, world, item] = spring[2]
        store_force(kind, spr.first_block[item], d, spring[0], spring[1], world, item, scr)

    @masked_kernel(module, "active")
    def change(spr: Springs, direction: p.vec3_2d, active: int_1d, scr: Scratch):
        """Change of the forces on the vectors along a direction."""
        world, item = wp.tid()
        D = vectors(spr, direction, world, item)
        out = mat33d()
        sides = side_count(spr.kind[item])
        for s in range(sides):
            row = vec3d()
            for t in range(sides):
                row += scr.hessian[world, spr.first_block[item] + sides * s + t] * D[t]
            out[s] = row
        scr.product[world, item] = out

    @masked_kernel(module, "active")
    def scatter(spr: Springs, of_item: mat33d_2d, active: int_1d, offset: int, pool: p.vec3_2d):
        """Forces on the slots from those on the vectors."""
        world, entry = wp.tid()
        pool[world, offset + entry] = vec3(spr.entry_weight[entry] * of_item[world, spr.entry_item[entry]])

    @wp.func
    def slot_block(spr: Springs, blocks: mat33d_2d, world: int, row: int, column: int) -> mat33d:
        """Symmetric part of the block of two entries of an item."""
        item = spr.entry_item[row]
        sides = side_count(spr.kind[item])
        A = mat33d()
        for s in range(sides):
            for t in range(sides):
                first = blocks[world, spr.first_block[item] + sides * s + t]
                other = blocks[world, spr.first_block[item] + sides * t + s]
                weight = spr.entry_weight[row][s] * spr.entry_weight[column][t]
                A += (f64(0.5) * weight) * (first + wp.transpose(other))
        return A

    @masked_kernel(module, "active")
    def diagonal(spr: Springs, active: int_1d, offset: int, scr: Scratch, pool: p.sym_2d):
        """Blocks of D, Voigt order."""
        world, entry = wp.tid()
        A = slot_block(spr, scr.projected, world, entry, entry)
        pool[world, offset + entry] = sym6(T(A[0, 0]), T(A[1, 1]), T(A[2, 2]), T(A[1, 2]), T(A[0, 2]), T(A[0, 1]))

    @masked_kernel(module, "active")
    def add_blocks(
        topo: Topology, pattern: Pattern, spr: Springs, upper: int_1d, start: int_1d, row: int_1d, column: int_1d,
        blocks: mat33d_2d, dq_dv: double_1d, active: int_1d, value: p.mat33_2d,
    ):  # fmt: skip
        """value += (dq/dv) K."""
        world, k = wp.tid()
        A = mat33d()
        for pair in range(start[k], start[k + 1]):
            A += slot_block(spr, blocks, world, row[pair], column[pair])
        add_block(topo, pattern.upper[upper[k]], mat33(dq_dv[world] * A), world, value)

    @masked_kernel(module, "active")
    def energies(
        spr: Springs, u: p.vec3_2d, start: p.vec3_2d, u_n: p.vec3_2d, law_value: vec3d_2d, in_motion: f64,
        span: double_1d, h: double_1d, active: int_1d, scr: Scratch, rows: double_3d,
    ):  # fmt: skip
        """Stored energy at u, what viscous forces and friction take in the step from u_n, and the work of actuators."""
        world, item = wp.tid()
        sp = spr.spring[item]
        inverse = in_motion / span[world]
        V = spr.reference[item] + vectors(spr, u, world, item)
        if wp.static(has_chords):
            if spr.kind[item] == CHORD:
                rows[0, world, item] = spr.stiffness[world, sp] * chords.chord_energy(wp.length_sq(V[0]))[0]
                rows[1, world, item] = f64(0.0)
                return
        if spr.kind[item] == VECTOR:
            moved = vectors(spr, u, world, item) - vectors(spr, start, world, item)
            step = vectors(spr, u, world, item) - vectors(spr, u_n, world, item)
            rows[0, world, item] = f64(0.5) * spr.scale[item] * spr.stiffness[world, sp] * wp.ddot(V, V)
            rows[1, world, item] = spr.scale[item] * spr.damping[world, sp] * inverse * wp.ddot(moved, step)
            return
        y0, winding = scr.start[world, item], scr.winding[world, item]
        y = c.coordinate(spr.kind[item], V, y0)
        if wp.static(bounded):
            if spr.law[sp] < 0:
                value, anchor = scheduled(spr, law_value, world, sp), scr.anchor[world, item]
                reference = scr.reference[world, item]
                force = more.bounded_force(spr, world, sp, winding, y0, y, reference, inverse, anchor, value)[0]
                change = more.increments(spr, world, sp, winding, y0, y, anchor, force, in_motion * (y - y0) / h[world])
                for row in range(3):
                    rows[row, world, item] = change[row]
                rows[3, world, item] = change[2]
                return
        if wp.static(midpoint):
            viscous_part = law.viscous_force(spr, world, sp, f64(0.5) * (y0 + y) + winding, (y - y0) * inverse)
        else:
            viscous_part = law.viscous_force(spr, world, sp, y + winding, (y - scr.reference[world, item]) * inverse)
        rows[0, world, item] = law.energy(spr, world, sp, y + winding)
        rows[1, world, item] = in_motion * viscous_part[0] * (y - y0)

    if bounded:

        @wp.kernel(module=module)
        def find_impacts(
            spr: Springs, u: p.vec3_2d, h: double_1d, dq_dv: double_1d, running: int_1d, failed: int_1d, scr: Scratch,
            impact: int_1d,
        ):  # fmt: skip
            """Flag worlds whose converged attempt hits a stop, or, to restart, does not resolve its force: in the step
            after a hit, where the force changes by half, and where what the scheme remembers of it changes the rate of
            a body that the stop has let go by a tenth. Shares of 0.1 to 1, and of 0.02 to 0.1, serve as well."""
            world, item = wp.tid()
            sp = spr.spring[item]
            if running[world] == 0 or failed[world] != 0 or impact[world] >= IMPACT_FOUND or spr.law[sp] != STOP:
                return
            y0 = scr.start[world, item]
            y = c.coordinate(spr.kind[item], spr.reference[item] + vectors(spr, u, world, item), y0)
            winding = scr.winding[world, item]
            before, depth = more.penetration(spr, world, sp, winding, y0), more.penetration(spr, world, sp, winding, y)
            k, damping = spr.stiffness[world, sp], spr.damping[world, sp]
            rate, mean_rate = (y - scr.reference[world, item]) / dq_dv[world], (y - y0) / h[world]
            if scr.force[world, item] == mat33d():
                if before != f64(0.0) and wp.abs(rate - mean_rate) > f64(0.1) * wp.abs(rate):
                    wp.atomic_max(impact, world, RESTART_FOUND)
                return
            if before * depth <= f64(0.0):
                wp.atomic_max(impact, world, IMPACT_FOUND)
                return
            change = k * wp.abs(depth - before)
            force_change = change + f64(2.0) * damping * wp.abs(rate - mean_rate)
            force = wp.abs(k * depth + damping * rate)
            largest = wp.max(wp.abs(depth), wp.abs(before))
            if change > f64(0.4) * k * largest or force_change > f64(0.5) * force:
                wp.atomic_max(impact, world, RESTART_FOUND)

    @masked_kernel(module, "active")
    def store_history(
        spr: Springs, u: p.vec3_2d, active: int_1d, scr: Scratch, turned: double_2d, anchor: double_2d
    ):  # fmt: skip
        """Angles of an accepted step, from which the next counts turns, and anchors of friction."""
        world, item = wp.tid()
        sp = spr.spring[item]
        V = spr.reference[item] + vectors(spr, u, world, item)
        y = c.coordinate(spr.kind[item], V, scr.start[world, item])
        winding = scr.winding[world, item]
        if spr.kind[item] == ANGLE:
            turned[world, item] = y + winding
        if wp.static(bounded):
            if spr.law[sp] == FRICTION:
                anchor[world, item] = more.dragged(spr, world, sp, y, scr.anchor[world, item]) + winding

    return kernel_set(locals())
