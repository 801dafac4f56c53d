"""Per-world logic of Newton's method: convergence, forcing terms, line search, acceptance. One thread per world."""

import functools
import types as _types

import warp as wp

from ..common.traits import NO_TERMS, Traits
from ..common.types import kernel_module
from .control import (
    FAIL_CONSTRAINT,
    FAIL_CURVATURE,
    FAIL_ITERATIONS,
    FAIL_JACOBIAN,
    FAIL_LIMIT,
    FAIL_LINE_SEARCH,
    FAIL_NAN,
    control_struct,
)
from .vectors import vector_kernels

__all__ = ["newton_kernels"]

ARMIJO = 1.0e-4
WOLFE = 0.8
NOISE = 100.0  # Phi is blind below this many roundings of its parts
FLOOR = 16.0
MAX_SEARCH = 20
REUSED_SEARCH = 2
PREDICTED = 1.0e-3


@functools.cache
def newton_kernels(dtype: str, traits: Traits = NO_TERMS) -> _types.SimpleNamespace:
    """Kernels of the Newton iteration in one precision of the vectors; scalars are float64.

    Of the traits "stored", "gated" and "limited" count.
    """
    f64 = wp.float64
    Control = control_struct()
    stored, gated, limited = traits.stored, traits.gated, traits.limited
    module = kernel_module(f"newton_{dtype}{traits.suffix('stored', 'gated', 'limited')}")

    @wp.func
    def objective(ctl: Control, world: int) -> f64:
        """Phi of Eq. (18) at the trial, over dq/dv, with what terms hold in the search.

        Phi = 1/2 (v - v~).M (v - v~) c_M - f_held.v + [Psi_el + Psi_visc + Psi_terms] / (dq/dv), whose derivative by v
        is the residual, Eq. (17). Of the sums over a world: inertia and the forces held, f_held (dead loads, and forces
        without a potential as the search began), are slot_sums[4], row 4 of `residual`; Psi_el and Psi_visc, J, are
        elem_sums[0] and [1], of `internal_force`; Psi_terms, J, of constraints lambda.c + rho/2 c.c, is term_sums[0].
        """
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
        barred = False
        if wp.static(limited):
            barred = not ctl.limit[world] > f64(0.0)
        if not wp.isfinite(slope):
            fail(ctl, world, FAIL_NAN)
        elif barred:
            fail(ctl, world, FAIL_LIMIT)
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
        # forces held in the search are held with their symmetric tangent: Phi is then as curved as H says
        bend = ctl.dq_dv[world] * ctl.tangent_sum[0, world]
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
        stands = alpha == f64(0.0) and ctl.reused[world] != 0
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

    vectors = vector_kernels(dtype, module)
    return _types.SimpleNamespace(
        **vars(vectors),
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
    )
