"""Per-world logic of Newton's method: convergence, forcing terms, line search, acceptance. One thread per world."""

import functools
import types as _types

import warp as wp

from ..common.traits import NO_TERMS, Traits
from ..common.types import kernel_module, precision

__all__ = [
    "COMPONENT_ROWS",
    "FAIL_CONSTRAINT",
    "FAIL_CURVATURE",
    "FAIL_GROWTH",
    "FAIL_ITERATIONS",
    "FAIL_JACOBIAN",
    "FAIL_LINE_SEARCH",
    "FAIL_NAN",
    "LANES",
    "TERM_ROWS",
    "control_struct",
    "newton_kernels",
]

FAIL_ITERATIONS = 1
FAIL_LINE_SEARCH = 2
FAIL_JACOBIAN = 3
FAIL_NAN = 4
FAIL_CURVATURE = 5
FAIL_CONSTRAINT = 6
FAIL_GROWTH = 7

ARMIJO = 1.0e-4
WOLFE = 0.8
COMPONENT_ROWS = 5  # squared norms of g, f_int, loads, inertia, rounding
LANES = 32
TERM_ROWS = 3
"""Rows summed per world of what terms store: the potential with what is held in a line search (multipliers, caps), the
potential with what they would hold next, and its magnitude."""
NOISE = 100.0  # Phi is blind below this many roundings of its parts
FLOOR = 16.0
MAX_SEARCH = 20
REUSED_SEARCH = 2
PREDICTED = 1.0e-3


@functools.cache
def control_struct():
    """What Newton's method knows of each world."""

    @wp.struct
    class NewtonControl:
        active: wp.array(dtype=wp.int32)  # iterating
        searching: wp.array(dtype=wp.int32)  # in a line search
        failed: wp.array(dtype=wp.int32)  # 0 or a FAIL_ code
        iterations: wp.array(dtype=wp.int32)  # of this attempt
        searches: wp.array(dtype=wp.int32)
        total_iterations: wp.array(dtype=wp.int32)  # of this step
        alpha: wp.array(dtype=wp.float64)
        phi: wp.array(dtype=wp.float64)
        phi_magnitude: wp.array(dtype=wp.float64)
        slope: wp.array(dtype=wp.float64)  # g.p at the iterate
        norm: wp.array(dtype=wp.float64)  # |g| in the D^-1 norm
        relative: wp.array(dtype=wp.float64)  # |g| over the largest force, of the worst component
        excess: wp.array(dtype=wp.float64)  # largest norm over accepted norm of the components
        floor_excess: wp.array(dtype=wp.float64)  # the same over what rounding of positions alone may cause
        solve_norm: wp.array(dtype=wp.float64)  # |g| of the components that are not converged
        solve_accept: wp.array(dtype=wp.float64)  # smallest accepted norm among them
        component_sums: wp.array3d(dtype=wp.float64)  # [COMPONENT_ROWS, world, component], with several components
        quiet: wp.array2d(dtype=wp.int32)  # [world, component] converged
        reduction: wp.array(dtype=wp.float64)  # norm over that of the iterate before
        forcing: wp.array(dtype=wp.float64)  # Eisenstat-Walker eta
        predicted: wp.array(dtype=wp.int32)  # the first iterate is extrapolated
        reused: wp.array(dtype=wp.int32)  # the operator is of an earlier iterate; 2: and led nowhere
        min_J: wp.array(dtype=wp.float64)
        domain_J: wp.array(dtype=wp.float64)  # smallest J of the laws that need J > 0
        history: wp.array2d(dtype=wp.float64)  # [world, iteration] norm / scale
        slot_sums: wp.array2d(dtype=wp.float64)  # gather.RESIDUAL_ROWS
        elem_sums: wp.array2d(dtype=wp.float64)  # strain energy, viscous potential
        slope_sum: wp.array2d(dtype=wp.float64)
        follower_sum: wp.array2d(dtype=wp.float64)  # p.K p of the follower loads, 0 without
        dq_dv: wp.array(dtype=wp.float64)
        violation: wp.array2d(dtype=wp.float64)  # [world, component] largest |c|, m; with constraints
        term_sums: wp.array2d(dtype=wp.float64)  # [TERM_ROWS, world], with terms that have a potential of their own
        limit: wp.array(dtype=wp.float64)  # largest step along the direction; with terms that limit it
        stepped: wp.array(dtype=wp.int32)  # the trial was accepted
        outer: wp.array(dtype=wp.int32)  # multiplier updates of this step
        constraint_tol: wp.float64  # m
        open: wp.array(dtype=wp.float64)  # largest violation over its tolerance; with constraints
        slack: wp.float64  # norm of PCG over the norm that is judged, across constraints
        classical: wp.int32  # multipliers change in an outer loop
        force: wp.array(dtype=wp.float64)  # |g| over the free components, N
        force_tol: wp.float64  # N; accepted without regard to the size of the forces; 0: never
        first_forcing: wp.float64
        fixed_forcing: wp.int32  # all solves go as far as the first, whatever Newton's method needs
        tol: wp.float64
        eps: wp.float64
        rough: wp.array(dtype=wp.int32)  # a substep of this step was accepted short of the tolerance
        max_iterations: wp.int32
        components: wp.int32
        nonpotential: wp.int32

    return NewtonControl


@functools.cache
def newton_kernels(dtype: str, traits: Traits = NO_TERMS) -> _types.SimpleNamespace:
    """Kernels of the Newton iteration in one precision of the vectors; scalars are float64.

    Of the traits "stored", "gated" and "limited" count.
    """
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    f64 = wp.float64
    Control = control_struct()
    stored, gated, limited = traits.stored, traits.gated, traits.limited
    module = kernel_module(f"newton_{dtype}{traits.suffix('stored', 'gated', 'limited')}")

    @wp.func
    def objective(ctl: Control, world: int) -> f64:
        """Phi of Eq. (18) at the trial, over dq/dv, with what terms hold in the search."""
        energy = ctl.elem_sums[0, world] + ctl.elem_sums[1, world]
        if wp.static(stored):
            energy += ctl.term_sums[0, world]
        return ctl.slot_sums[4, world] + energy / ctl.dq_dv[world]

    @wp.func
    def magnitude(ctl: Control, world: int) -> f64:
        """Sum of the magnitudes of Phi's parts: its rounding is a few eps of it."""
        energy = wp.abs(ctl.elem_sums[0, world]) + wp.abs(ctl.elem_sums[1, world])
        if wp.static(stored):
            energy += ctl.term_sums[2, world]
        return ctl.slot_sums[5, world] + energy / ctl.dq_dv[world]

    @wp.func
    def largest_violation(ctl: Control, world: int) -> f64:
        """Of the constraints of all components, m."""
        largest = f64(0.0)
        for c in range(ctl.components):
            largest = wp.max(largest, ctl.violation[world, c])
        return largest

    @wp.func
    def measure(ctl: Control, world: int):
        """Norms and acceptance of the residual just evaluated, for each component apart where there are several.

        Components that do not touch must not hide behind each other's forces, and a converged one is left alone.
        """
        force = wp.sqrt(ctl.slot_sums[9, world])
        ctl.force[world] = force
        largest = f64(0.0)
        excess = f64(0.0)
        floor_excess = f64(0.0)
        solve = f64(0.0)
        solve_accept = f64(1.0e300)
        for c in range(ctl.components):
            g2 = ctl.slot_sums[0, world]
            f2 = wp.max(ctl.slot_sums[1, world], wp.max(ctl.slot_sums[2, world], ctl.slot_sums[3, world]))
            spread = ctl.slot_sums[8, world]
            if ctl.components > 1:
                g2 = ctl.component_sums[0, world, c]
                f2 = wp.max(
                    ctl.component_sums[1, world, c],
                    wp.max(ctl.component_sums[2, world, c], ctl.component_sums[3, world, c]),
                )
                spread = ctl.component_sums[4, world, c]
            norm = wp.sqrt(g2)
            scale = wp.sqrt(f2)
            accept = (ctl.tol + f64(FLOOR) * ctl.eps) * scale
            if force > f64(0.0):
                # the force's tolerance in this norm, as they compare at this iterate
                accept = wp.max(accept, norm * (ctl.force_tol / force))
            if ctl.predicted[world] != 0:
                accept = f64(PREDICTED) * accept  # what is left would add up over steps that none solves for
            loud = norm > accept
            if wp.static(gated):
                if ctl.violation[world, c] > ctl.constraint_tol:
                    loud = True
                    excess = wp.max(excess, ctl.violation[world, c] / ctl.constraint_tol)
                    floor_excess = f64(1.0e300)
            ctl.quiet[world, c] = wp.where(loud, 0, 1)
            if loud:
                solve += g2
                solve_accept = wp.min(solve_accept, accept)
                rounding = f64(2.0) * ctl.eps * wp.sqrt(spread)
                if wp.static(gated):
                    if ctl.classical != 0:  # the residual holds rho c, and so kappa times the rounding of places
                        rounding = rounding / (ctl.slack * ctl.slack)
                floor_excess = wp.max(floor_excess, norm / (rounding + f64(1.0e-300)))
            ratio = norm / wp.max(scale, f64(1.0e-300))
            largest = wp.max(largest, ratio)
            excess = wp.max(excess, norm / wp.max(accept, f64(1.0e-300)))
        if wp.static(gated):
            ctl.open[world] = largest_violation(ctl, world) / ctl.constraint_tol
        ctl.norm[world] = wp.sqrt(ctl.slot_sums[0, world])
        ctl.relative[world] = largest
        ctl.excess[world] = excess
        ctl.floor_excess[world] = floor_excess
        ctl.solve_norm[world] = wp.sqrt(solve)
        ctl.solve_accept[world] = solve_accept

    @wp.func
    def record(ctl: Control, world: int):
        """Keep the relative residual of the iterate, for messages."""
        k = ctl.iterations[world]
        if k < ctl.history.shape[1]:
            ctl.history[world, k] = ctl.relative[world]

    @wp.func
    def unsatisfied(ctl: Control, world: int) -> bool:
        """Whether forces balance but constraints do not hold: more iterations only raise the multipliers."""
        balanced = wp.max(ctl.tol, wp.min(f64(1.0e3) * ctl.tol, f64(1.0e-4)))
        return ctl.relative[world] <= balanced and ctl.open[world] > f64(1.0)

    @wp.func
    def settle(ctl: Control, world: int):
        """End the iteration where it has converged, stands still within rounding, or used up its iterations."""
        record(ctl, world)
        stalled = ctl.iterations[world] > 0 and ctl.reduction[world] > f64(0.5) and ctl.reused[world] == 0
        if ctl.excess[world] <= f64(1.0) or (stalled and ctl.floor_excess[world] <= f64(1.0)):
            ctl.active[world] = 0
        elif ctl.iterations[world] >= ctl.max_iterations:
            ctl.active[world] = 0
            ctl.failed[world] = FAIL_ITERATIONS
            if wp.static(gated):
                if unsatisfied(ctl, world):
                    ctl.failed[world] = FAIL_CONSTRAINT

    @wp.func
    def fail(ctl: Control, world: int, why: int):
        """End without convergence, unless rounding alone explains what is left of the residual."""
        ctl.active[world] = 0
        ctl.searching[world] = 0
        within = ctl.floor_excess[world] <= f64(1.0) and ctl.iterations[world] > 0
        if not (within and why != FAIL_NAN):
            ctl.failed[world] = why
            if wp.static(gated):
                if why != FAIL_NAN and why != FAIL_JACOBIAN and unsatisfied(ctl, world):
                    ctl.failed[world] = FAIL_CONSTRAINT

    @wp.kernel(module=module)
    def reset_min_J(ctl: Control, active: wp.array(dtype=wp.int32)):
        """Before an evaluation: forget the smallest J."""
        world = wp.tid()
        if active[world] != 0:
            ctl.min_J[world] = f64(1.0e30)
            ctl.domain_J[world] = f64(1.0e30)

    @wp.kernel(module=module)
    def begin(ctl: Control):
        """Judge the first iterate."""
        world = wp.tid()
        if ctl.active[world] == 0:
            return
        measure(ctl, world)
        phi = objective(ctl, world) + ctl.slot_sums[7, world]
        ctl.phi[world] = phi
        ctl.phi_magnitude[world] = magnitude(ctl, world)
        ctl.forcing[world] = ctl.first_forcing
        ctl.reused[world] = 0
        if ctl.domain_J[world] <= f64(0.0):
            fail(ctl, world, FAIL_JACOBIAN)
        elif not (wp.isfinite(phi) and wp.isfinite(ctl.norm[world])):
            fail(ctl, world, FAIL_NAN)
        else:
            settle(ctl, world)

    @wp.kernel(module=module)
    def free_step(ctl: Control):
        """Before terms limit a step: the full one."""
        world = wp.tid()
        if ctl.active[world] != 0:
            ctl.limit[world] = f64(1.0)

    @wp.kernel(module=module)
    def begin_search(ctl: Control):
        """Take the slope along the new direction; try the full step first."""
        world = wp.tid()
        if ctl.active[world] == 0:
            ctl.searching[world] = 0
            return
        slope = ctl.slope_sum[0, world]
        ctl.slope[world] = slope
        ctl.alpha[world] = f64(1.0)
        if wp.static(limited):
            ctl.alpha[world] = wp.min(ctl.limit[world], f64(1.0))
        ctl.searches[world] = 0
        ctl.searching[world] = 1
        ctl.predicted[world] = 0
        if wp.static(stored):
            ctl.stepped[world] = 0
        if wp.static(gated):
            if ctl.classical == 0:
                ctl.outer[world] = ctl.outer[world] + 1
        if not wp.isfinite(slope):
            fail(ctl, world, FAIL_NAN)
        elif slope >= f64(0.0):
            if ctl.reused[world] != 0:
                ctl.alpha[world] = f64(0.0)
            else:
                fail(ctl, world, FAIL_CURVATURE)

    @wp.kernel(module=module)
    def judge_trial(ctl: Control):
        """Armijo on Phi while it is not blind, else the sign of the slope; then convergence."""
        world = wp.tid()
        if ctl.searching[world] == 0:
            return
        alpha = ctl.alpha[world]
        old_norm = ctl.norm[world]
        # follower loads are held in the search with their symmetric tangent: Phi is then as curved as H says
        bend = ctl.dq_dv[world] * ctl.follower_sum[0, world]
        phi = objective(ctl, world) - f64(0.5) * alpha * alpha * bend
        norm = wp.sqrt(ctl.slot_sums[0, world])
        change = phi - ctl.phi[world]
        noise = f64(NOISE) * ctl.eps * (ctl.phi_magnitude[world] + magnitude(ctl, world))
        good = wp.isfinite(phi) and wp.isfinite(norm)
        if good:
            if wp.abs(change) > noise:
                good = change <= f64(ARMIJO) * alpha * ctl.slope[world]
            else:
                good = ctl.slot_sums[6, world] - alpha * bend <= f64(WOLFE) * wp.abs(ctl.slope[world])
            if ctl.nonpotential != 0 and norm <= f64(0.5) * old_norm:
                good = True
        if ctl.domain_J[world] <= f64(0.0):
            good = False
        if ctl.reused[world] != 0 and ctl.iterations[world] == 0 and not norm <= f64(0.5) * old_norm:
            good = False  # a step must not begin worse than with an operator of its own
            ctl.searches[world] = REUSED_SEARCH
        stands = alpha == f64(0.0)
        if good or stands:
            ctl.searching[world] = 0
            measure(ctl, world)
            ctl.phi[world] = objective(ctl, world) + ctl.slot_sums[7, world]
            if wp.static(stored):
                ctl.stepped[world] = 1
                more = ctl.term_sums[1, world] - ctl.term_sums[0, world]
                ctl.phi[world] = ctl.phi[world] + more / ctl.dq_dv[world]
            ctl.phi_magnitude[world] = magnitude(ctl, world)
            if stands:
                ctl.reused[world] = 2
            else:
                ctl.iterations[world] = ctl.iterations[world] + 1
            ctl.total_iterations[world] = ctl.total_iterations[world] + 1
            ratio = norm / wp.max(old_norm, f64(1.0e-300))
            ctl.reduction[world] = ratio
            eta = f64(0.9) * ratio * ratio
            guard = f64(0.9) * ctl.forcing[world] * ctl.forcing[world]
            if guard > f64(0.1):
                eta = wp.max(eta, guard)
            if ctl.fixed_forcing == 0 and not stands:
                ctl.forcing[world] = wp.clamp(eta, f64(1.0e-6), f64(0.1))
            settle(ctl, world)
        else:
            ctl.searches[world] = ctl.searches[world] + 1
            ctl.alpha[world] = f64(0.5) * alpha
            if ctl.reused[world] != 0 and ctl.searches[world] > REUSED_SEARCH:
                # not the iterate is to blame: stand still, and go on with an operator of its own
                ctl.alpha[world] = f64(0.0)
            if ctl.searches[world] > MAX_SEARCH:
                why = FAIL_LINE_SEARCH
                if ctl.domain_J[world] <= f64(0.0):
                    why = FAIL_JACOBIAN
                fail(ctl, world, why)

    @wp.kernel(module=module)
    def judge_outer(ctl: Control, running: wp.array(dtype=wp.int32), tol: f64, limit: int):
        """Classical multiplier updates: another inner solve where a constraint is still violated."""
        world = wp.tid()
        ctl.stepped[world] = 0
        if running[world] == 0 or ctl.failed[world] != 0:
            return
        if largest_violation(ctl, world) <= tol:
            return
        if ctl.outer[world] >= limit:
            ctl.failed[world] = FAIL_CONSTRAINT
            return
        ctl.outer[world] = ctl.outer[world] + 1
        ctl.iterations[world] = 0
        ctl.active[world] = 1
        ctl.stepped[world] = 1

    @wp.kernel(module=module)
    def any_set(flags: wp.array(dtype=wp.int32), out: wp.array(dtype=wp.int32)):
        """out[0] = 1 where any world's flag is set; out must be 0 before."""
        world = wp.tid()
        if flags[world] != 0:
            wp.atomic_max(out, 0, 1)

    @wp.kernel(module=module)
    def component_partial(
        start: wp.array(dtype=wp.int32),
        slot: wp.array(dtype=wp.int32),
        rows: wp.array3d(dtype=f64),
        active: wp.array(dtype=wp.int32),
        partial: wp.array4d(dtype=f64),
    ):
        """Strided partial sums of the residual's norms over the slots of a component."""
        world, component, lane = wp.tid()
        if active[world] == 0:
            return
        for row in range(COMPONENT_ROWS):
            source = wp.where(row == 4, 8, row)
            total = f64(0.0)
            for k in range(start[component] + lane, start[component + 1], LANES):
                total += rows[source, world, slot[k]]
            partial[row, world, component, lane] = total

    @wp.kernel(module=module)
    def component_sum(partial: wp.array4d(dtype=f64), active: wp.array(dtype=wp.int32), out: wp.array3d(dtype=f64)):
        """Sum of the lanes, in order."""
        row, world, component = wp.tid()
        if active[world] == 0:
            return
        total = f64(0.0)
        for lane in range(LANES):
            total += partial[row, world, component, lane]
        out[row, world, component] = total

    @wp.kernel(module=module)
    def update_position(
        q_tilde: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        dq_dv: wp.array(dtype=f64),
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
    ):
        """q = q~ + (dq/dv) v."""
        world, slot = wp.tid()
        if active[world] != 0:
            u[world, slot] = q_tilde[world, slot] + T(dq_dv[world]) * v[world, slot]

    @wp.kernel(module=module)
    def trial_velocity(
        ctl: Control,
        base: wp.array2d(dtype=vec3),
        direction: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
    ):
        """v = base + alpha p."""
        world, slot = wp.tid()
        if ctl.searching[world] != 0:
            v[world, slot] = base[world, slot] + T(ctl.alpha[world]) * direction[world, slot]

    @wp.kernel(module=module)
    def copy_active(source: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), target: wp.array2d(dtype=vec3)):
        """target = source in the active worlds."""
        world, slot = wp.tid()
        if active[world] != 0:
            target[world, slot] = source[world, slot]

    @wp.kernel(module=module)
    def dot_rows(
        a: wp.array2d(dtype=vec3),
        b: wp.array2d(dtype=vec3),
        active: wp.array(dtype=wp.int32),
        rows: wp.array3d(dtype=f64),
    ):
        """a.b per slot."""
        world, slot = wp.tid()
        if active[world] != 0:
            rows[0, world, slot] = f64(wp.dot(a[world, slot], b[world, slot]))

    return _types.SimpleNamespace(
        module=module,
        measure=measure,
        record=record,
        reset_min_J=reset_min_J,
        begin=begin,
        free_step=free_step,
        begin_search=begin_search,
        judge_trial=judge_trial,
        judge_outer=judge_outer,
        any_set=any_set,
        component_partial=component_partial,
        component_sum=component_sum,
        update_position=update_position,
        trial_velocity=trial_velocity,
        copy_active=copy_active,
        dot_rows=dot_rows,
    )
