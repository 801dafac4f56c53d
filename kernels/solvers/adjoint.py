"""Adjoint of a step: residual and refinements of its solve, and rows of derivatives; see ../step/adjoint.py."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import mass_functions, topology_struct
from ..common.types import double_1d, double_2d, double_3d, f64, int_1d, precision, vec3d, vec3d_1d, vec3d_2d
from ..terms.constraints import ANGLE, constraint_functions, constraint_struct, multiplier_struct
from .newton_control import control_struct

__all__ = ["adjoint_kernels", "adjoint_struct"]

MAX_REFINEMENTS = 60
"""Largest number of refinements of a solve; each gains the factor of a linear solve, or of the penalty."""
MIN_REFINEMENTS = 3
"""Refinements before a residual that does not fall by half ends a solve: the first multipliers may raise it."""
MAX_ORDER = 8
"""Largest order of the extrapolation of solutions over the steps; each world takes its own."""


@functools.cache
def adjoint_struct():
    """Scalars of the adjoint solve, per world."""

    @wp.struct
    class AdjointControl:
        first_norm: wp.array(dtype=wp.float64)  # |right side| in the D^-1 norm
        norm: wp.array(dtype=wp.float64)  # |r|
        refinements: wp.array(dtype=wp.int32)
        residual: wp.array(dtype=wp.float64)  # largest |r| / |right side| of all steps
        sums: wp.array2d(dtype=wp.float64)  # [3, world]
        difference_sums: wp.array2d(dtype=wp.float64)  # [MAX_ORDER + 1, world] |difference|^2 of w, by order
        any_active: wp.array(dtype=wp.int32)  # [1]
        tol: wp.float64

    return AdjointControl


@functools.cache
def adjoint_kernels(dtype: str, constrained: bool) -> KernelSet:
    """Kernels in one precision; `constrained`: with rows of constraints."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    Control, Newton, Topology = adjoint_struct(), control_struct(), topology_struct(dtype)
    Constraints, Multipliers = constraint_struct(), multiplier_struct()
    mass_times, functions = mass_functions(dtype).mass_times, constraint_functions(dtype)
    module = kernel_module(f"adjoint_{dtype}{'_constrained' if constrained else ''}")

    @wp.func
    def squared_norm(free: vec3, g: vec3, diagonal: vec3) -> f64:
        """g.D^-1 g of the free components of a slot."""
        s = f64(0.0)
        for k in range(3):
            x = f64(free[k]) * f64(g[k])
            if x != f64(0.0):
                s += x * x / f64(diagonal[k])
        return s

    @masked_kernel(module, "active")
    def residual(
        free: p.vec3_1d, con: Constraints, mul: Multipliers, mu: double_2d, rhs: p.vec3_2d, Hw: p.vec3_2d,
        diagonal: p.vec3_2d, active: int_1d, gradient: p.vec3_2d, rows: double_3d,
    ):  # fmt: skip
        """-r = H w + J^T mu - right side, and r.D^-1 r of the free components, of the right side too."""
        world, slot = wp.tid()
        g = Hw[world, slot] - rhs[world, slot]
        if wp.static(constrained):
            force = vec3d()
            for k in range(con.slot_start[slot], con.slot_start[slot + 1]):
                term = con.slot_term[k]
                force += (con.slot_weight[k] * mu[world, term / 3]) * mul.end_gradient[world, term]
            g += vec3(force)
        gradient[world, slot] = g
        rows[0, world, slot] = squared_norm(free[slot], g, diagonal[world, slot])
        rows[1, world, slot] = squared_norm(free[slot], rhs[world, slot], diagonal[world, slot])

    @wp.kernel(module=module)
    def check_residual(ctl: Control, start: int, least_forcing: f64, newton: Newton, active: int_1d):
        """Continue while |r| exceeds the tolerance and falls by half, with solves to half of the tolerance.

        The first solve takes the solution of exact factors, others check it by conjugate gradients.
        `start`: 1: the tolerance is relative to |r|; 2: to the right side, w being extrapolated.
        """
        world = wp.tid()
        if active[world] == 0:
            return
        norm = wp.sqrt(ctl.sums[0, world])
        last = ctl.norm[world]
        if start != 0:
            first = wp.where(start == 2, wp.sqrt(ctl.sums[1, world]), norm)
            if not (norm <= first):
                norm = first  # see `discard_extrapolation`
            ctl.first_norm[world] = first
            ctl.refinements[world] = 0
            last = f64(1.0e300)
        ctl.norm[world] = norm
        target = f64(0.5) * ctl.tol * ctl.first_norm[world]
        newton.solve.forcing[world] = wp.max(least_forcing, target / wp.max(norm, target))
        newton.iterations[world] = wp.where(start != 0, 0, newton.max_iterations)
        count = ctl.refinements[world]
        ctl.refinements[world] = count + 1
        more = norm > ctl.tol * ctl.first_norm[world] and count < MAX_REFINEMENTS
        if more and (norm < f64(0.5) * last or count < MIN_REFINEMENTS):
            wp.atomic_max(ctl.any_active, 0, 1)
        else:
            active[world] = 0

    # first iterates: w and mu extrapolated from the steps before, the sums of their differences of order 0 to n - 1

    @wp.func
    def extrapolation_order(ctl: Control, world: int) -> int:
        """Number n of differences that the extrapolation sums: that of order n, its error, is the smallest."""
        n = wp.int32(0)
        for k in range(1, MAX_ORDER + 1):
            if ctl.difference_sums[k, world] < ctl.difference_sums[n, world]:
                n = k
        return n

    @masked_kernel(module, "active")
    def add_differences(w: p.vec3_2d, diagonal: p.vec3_2d, active: int_1d, difference: p.vec3_3d, rows: double_3d):
        """Backward differences of w over the steps by their order, and d.D d of each."""
        world, slot = wp.tid()
        d = w[world, slot]
        for k in range(MAX_ORDER + 1):
            x = vec3d(d)
            rows[k, world, slot] = wp.dot(x, wp.cw_mul(vec3d(diagonal[world, slot]), x))
            if k < MAX_ORDER:
                before = difference[k, world, slot]
                difference[k, world, slot] = d
                d -= before

    @masked_kernel(module, "active")
    def extrapolate(ctl: Control, difference: p.vec3_3d, active: int_1d, w: p.vec3_2d):
        """w of the next step."""
        world, slot = wp.tid()
        total = vec3()
        for k in range(extrapolation_order(ctl, world)):
            total += difference[k, world, slot]
        w[world, slot] = total

    @masked_kernel(module, "active")
    def extrapolate_multipliers(ctl: Control, difference: double_3d, active: int_1d, mu: double_2d):
        """mu of the next step, from that of the last and the differences before it."""
        world, row = wp.tid()
        d = mu[world, row]
        total = f64(0.0)
        order = extrapolation_order(ctl, world)
        for k in range(MAX_ORDER):
            before = difference[k, world, row]
            difference[k, world, row] = d
            if k < order:
                total += d
            d -= before
        mu[world, row] = total

    @masked_kernel(module, "active")
    def discard_extrapolation(
        ctl: Control, rhs: p.vec3_2d, active: int_1d, w: p.vec3_2d, mu: double_2d, gradient: p.vec3_2d
    ):
        """w = 0, mu = 0 where they leave more of the right side than 0."""
        world, slot = wp.tid()
        if not (ctl.sums[0, world] <= ctl.sums[1, world]):
            w[world, slot] = vec3()
            gradient[world, slot] = -rhs[world, slot]
            for row in range(slot, mu.shape[1], w.shape[1]):
                mu[world, row] = f64(0.0)

    @masked_kernel(module, "active")
    def note_residual(ctl: Control, active: int_1d):
        """Record |r| / |right side| of the solution."""
        world = wp.tid()
        if ctl.first_norm[world] != f64(0.0):  # NaN is noted, too
            norm = ctl.norm[world]
            if wp.static(constrained):
                norm = wp.sqrt(ctl.sums[0, world])
            ratio = norm / ctl.first_norm[world]
            if not (ratio <= ctl.residual[world]):
                ctl.residual[world] = ratio

    @masked_kernel(module, "active")
    def add_direction(direction: p.vec3_2d, active: int_1d, w: p.vec3_2d):
        """w += direction."""
        world, slot = wp.tid()
        w[world, slot] = w[world, slot] + direction[world, slot]

    @masked_kernel(module, "active")
    def update_multipliers(
        con: Constraints, mul: Multipliers, w: p.vec3_2d, dq_dv: double_1d, active: int_1d, mu: double_2d
    ):
        """mu += (dq/dv) rho J w, by which the augmented operator has converged to the bordered one where J w = 0."""
        world, row = wp.tid()
        change = functions.directional_derivative(con, mul.gradient, w, world, row)
        mu[world, row] = mu[world, row] + dq_dv[world] * mul.penalty[world, row] * change

    @masked_kernel(module, "active")
    def add_vector(x: p.vec3_2d, active: int_1d, out: p.vec3_2d):
        """out += x."""
        world, slot = wp.tid()
        out[world, slot] = out[world, slot] + x[world, slot]

    @masked_kernel(module, "active")
    def subtract_force(x: p.vec3_2d, dq_dv: double_1d, active: int_1d, out: p.vec3_2d):
        """out -= x/(dq/dv)."""
        world, slot = wp.tid()
        out[world, slot] = out[world, slot] - T(f64(1.0) / dq_dv[world]) * x[world, slot]

    # derivatives by parameters: rows to be summed, and their sums

    @wp.kernel(module=module)
    def accumulate(sums: double_2d, sign: f64, active: int_1d, out: double_2d):
        """out[world, k] += sign sums[k, world]."""
        world, k = wp.tid()
        if active[world] != 0:
            out[world, k] = out[world, k] + sign * sums[k, world]

    @masked_kernel(module, "active")
    def weighted_rows(weight: p.vec3_1d, x: p.vec3_2d, active: int_1d, rows: double_3d):
        """Components of x times weights of the slots, of the value of a time law."""
        world, slot = wp.tid()
        for c in range(3):
            rows[c, world, slot] = f64(weight[slot][c]) * f64(x[world, slot][c])

    @masked_kernel(module, "active")
    def gravity_force(lumped: p.scalar_2d, ramp: double_1d, component: int, active: int_1d, out: p.vec3_2d):
        """Lumped masses along an axis."""
        world, slot = wp.tid()
        f = vec3()
        f[component] = T(ramp[world]) * lumped[world % lumped.shape[0], slot]
        out[world, slot] = f

    @masked_kernel(module, "active")
    def gravity_rows(lumped: p.scalar_2d, ramp: double_1d, w: p.vec3_2d, active: int_1d, rows: double_3d):
        """w times the force of gravity by each of its components."""
        world, slot = wp.tid()
        m = T(ramp[world]) * lumped[world % lumped.shape[0], slot]
        for c in range(3):
            rows[c, world, slot] = f64(m * w[world, slot][c])

    @masked_kernel(module, "active")
    def density_force(
        topo: Topology, lumped: p.scalar_2d, gravity: vec3d_1d, ramp: double_1d, v: p.vec3_2d, v_tilde: p.vec3_2d,
        mass_factor: double_1d, active: int_1d, out: p.vec3_2d,
    ):  # fmt: skip
        """m g - c_M M (v - v~) with the masses of a density of 1."""
        world, slot = wp.tid()
        inertia = mass_times(topo, v, world, slot) - mass_times(topo, v_tilde, world, slot)
        load = T(ramp[world]) * lumped[world % lumped.shape[0], slot] * vec3(gravity[world])
        out[world, slot] = load - T(mass_factor[world]) * inertia

    @masked_kernel(module, "active")
    def weighted_change(weight: p.vec3_1d, change: double_2d, active: int_1d, out: p.vec3_2d):
        """out += weights of the slots times the components of a change."""
        world, slot = wp.tid()
        for c in range(change.shape[1]):
            out[world, slot][c] += weight[slot][c] * T(change[world, c])

    @masked_kernel(module, "active")
    def scaled_change(x: p.vec3_2d, change: double_2d, component: int, sign: f64, active: int_1d, out: p.vec3_2d):
        """out += sign times a component of a change times x."""
        world, slot = wp.tid()
        out[world, slot] = out[world, slot] + T(sign * change[world, component]) * x[world, slot]

    @masked_kernel(module, "active")
    def rotation_rows(
        slot: int_1d, law: int_1d, chosen: int, components: vec3d_1d, lever_arm: vec3d_1d, axis: vec3d_1d,
        value: vec3d_2d, drive_bar: p.vec3_2d, active: int_1d, rows: double_3d,
    ):  # fmt: skip
        """Bar of the angle of `drive_rotation`."""
        world, k = wp.tid()
        if law[k] == chosen:
            angle = value[world, chosen][0]
            turn = wp.cross(axis[k], lever_arm[k])
            change = wp.cos(angle) * turn + wp.sin(angle) * wp.cross(axis[k], turn)
            bar = vec3d(drive_bar[world, slot[k]])
            rows[0, world, slot[k]] = wp.dot(wp.cw_mul(components[k], change), bar)

    @masked_kernel(module, "active")
    def right_side_sums(
        con: Constraints, mul: Multipliers, mu: double_2d, w: p.vec3_2d, dq_dv: double_1d, u: p.vec3_2d, law: int,
        active: int_1d, sums: double_2d,
    ):  # fmt: skip
        """Bar of the right sides f that follow a law: -(mu/h) dc/df - lambda w.dJ/df, in the order of the rows."""
        world = wp.tid()
        total = vec3d()
        for row in range(con.kind.shape[0]):
            if con.law[row] == law:
                scale = mul.signed_scale[world, row]
                bar = scale * mu[world, row] / dq_dv[world]
                if con.kind[row] == ANGLE:  # of the direction along = sin f a2 + cos f a
                    f = mul.target[world, row]
                    along = wp.cos(f) * (con.reference[3 * row] + functions.term_vector(con, 3 * row, u, world))
                    along += wp.sin(f) * (
                        con.reference[3 * row + 2] + functions.term_vector(con, 3 * row + 2, u, world)
                    )
                    b = con.reference[3 * row + 1] + functions.term_vector(con, 3 * row + 1, u, world)
                    change = wp.cos(f) * functions.term_vector(con, 3 * row, w, world)
                    change += wp.sin(f) * functions.term_vector(con, 3 * row + 2, w, world)
                    turn = wp.dot(change, b) + wp.dot(along, functions.term_vector(con, 3 * row + 1, w, world))
                    bar = bar * wp.dot(along, b) + scale * mul.trial_multiplier[world, row] * turn
                c = con.law_component[row]
                total[c] = total[c] + bar
        for c in range(3):
            sums[c, world] = total[c]

    # probes

    @wp.kernel(module=module)
    def probe_values(
        slot: int_1d, weight: p.scalar_1d, offset: vec3d, u: p.vec3_2d, v: p.vec3_2d, step: int,
        displacement: double_3d, velocity: double_3d, position: double_3d,
    ):  # fmt: skip
        """Values of a probe at a step."""
        world = wp.tid()
        d = vec3d()
        s = vec3d()
        for k in range(slot.shape[0]):
            d += f64(weight[k]) * vec3d(u[world, slot[k]])
            s += f64(weight[k]) * vec3d(v[world, slot[k]])
        for c in range(3):
            displacement[world, step, c] = d[c]
            position[world, step, c] = offset[c] + d[c]
            velocity[world, step, c] = s[c]

    @masked_kernel(module, "active")
    def count_changes(x: p.vec3_2d, y: p.vec3_2d, active: int_1d, count: int_1d):
        """count[0] += slots whose vectors differ."""
        world, slot = wp.tid()
        if not x[world, slot] == y[world, slot]:
            wp.atomic_add(count, 0, 1)

    @wp.kernel(module=module)
    def probe_bars(
        slot: int_1d, weight: p.scalar_1d, step: int, displacement: double_3d, velocity: double_3d,
        position: double_3d, q_bar: p.vec3_2d, v_bar: p.vec3_2d,
    ):  # fmt: skip
        """Add the bars of a probe at a step to those of its slots, each in the list once."""
        world, k = wp.tid()
        s = slot[k]
        q = vec3d()
        v = vec3d()
        for c in range(3):
            q[c] = displacement[world, step, c] + position[world, step, c]
            v[c] = velocity[world, step, c]
        q_bar[world, s] = q_bar[world, s] + weight[k] * vec3(q)
        v_bar[world, s] = v_bar[world, s] + weight[k] * vec3(v)

    @wp.kernel(module=module)
    def squared_error(values: double_3d, target: double_3d, scale: f64, loss: double_1d, bar: double_3d):
        """Sum of scale (value - target)^2 of each world, and its derivative by the values; NaN: no target."""
        world = wp.tid()
        total = f64(0.0)
        for step in range(values.shape[1]):
            for c in range(3):
                d = values[world, step, c] - target[world % target.shape[0], step, c]
                if wp.isnan(d):
                    d = f64(0.0)
                total += scale * d * d
                bar[world, step, c] = f64(2.0) * scale * d
        loss[world] = total

    return kernel_set(locals())
