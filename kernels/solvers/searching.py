"""Line search of Newton's method: acceptance of trials and choice of the next step length. One thread per world."""

import types as _types

import warp as wp

from ..common.traits import Traits
from .control import FAIL_JACOBIAN, FAIL_LINE_SEARCH, control_struct
from .judging import judging_functions

__all__ = ["NOISE", "TURN", "search_kernels"]

ARMIJO = 1.0e-4
WOLFE = 0.8
NOISE = 100.0  # roundings of its parts below which changes of Phi are noise
MAX_SEARCH = 20
REUSED_SEARCH = 2
LEAPS = 5
"""Consecutive full steps that may raise Phi: with the predicted stress in H, a slender body reaches equilibrium over
iterates whose membrane energy is far above that of both ends (Magisano, Leonetti and Garcea 2017)."""
TURN, SHRINK = 0.5, 0.4
"""Largest rotation or stretch of an element in such a step, and its reduction factor after restoring the best
iterate."""
LOST = 10  # solves without a step after which the exact tangent is used; with 0 soft solids take longer
GROWN = 30  # maximum doublings of a step along which Phi is concave
EXCURSIONS = 1  # maximum deep penetrations by full steps in an attempt: the return may end at the start
KINK, KINKS = 0.5, 8
"""Contact: a positive slope of Phi at a trial above KINK times that at the iterate indicates that slipping points have
reversed and Phi has a kink before. It is located by at most KINKS trials: a step beyond it makes the points slip back,
again and again, while one that ends near it makes them stick."""


def search_kernels(traits: Traits, module: wp.Module) -> _types.SimpleNamespace:
    """Kernels in the module of Newton's method, and the function `lost`."""
    f64 = wp.float64
    Control = control_struct()
    stored, walls, midpoint, limited = traits.stored, traits.walls, traits.midpoint, traits.limited
    judging = judging_functions(traits)
    objective, magnitude, measure = judging.objective, judging.magnitude, judging.measure
    settle, fail = judging.settle, judging.fail

    @wp.func
    def lost(ctl: Control, world: int) -> bool:
        """True if solves with matrices other than the tangent have failed too often, for laws with their own tangent:
        beyond a bifurcation only the exact tangent gives descent."""
        return ctl.linear_stress == 0 and ctl.rounds[world] - ctl.iterations[world] > LOST

    @wp.func
    def watch(ctl: Control, world: int, old_phi: f64, old_norm: f64):
        """Bookkeeping after a step that raised Phi and the steps that follow it: restore the best iterate if for LEAPS
        steps neither the residual halved nor Phi fell below its best value."""
        if ctl.leaps[world] == 0:
            ctl.mark[world] = 1
            ctl.best_phi[world] = old_phi
            if wp.static(walls):
                ctl.excursions[world] = ctl.excursions[world] + 1
            ctl.best_norm[world] = old_norm
        if wp.static(not midpoint):
            ctl.mixed[world] = 1
        counts = True
        if wp.static(walls):  # Phi decreases monotonically on the way back out of an obstacle
            counts = ctl.leaps[world] == 0 or not ctl.phi[world] < old_phi
        if counts:
            ctl.leaps[world] = ctl.leaps[world] + 1
        if ctl.norm[world] <= f64(0.5) * ctl.best_norm[world] or ctl.phi[world] < ctl.best_phi[world]:
            ctl.leaps[world] = 0
            ctl.radius[world] = wp.min(f64(2.0) * ctl.radius[world], f64(TURN))
        elif ctl.leaps[world] >= LEAPS and ctl.active[world] != 0:
            ctl.restoring[world] = 1
            ctl.searching[world] = 1

    @wp.kernel(module=module)
    def plan_leap(ctl: Control):
        """Length of a nonmonotone step: the rotation and stretch of elements stay below the trust radius."""
        world = wp.tid()
        if ctl.active[world] != 0 and ctl.wish[world] == 1:
            ctl.wish[world] = 2
            ctl.searching[world] = 1
            most = ctl.dq_dv[world] * ctl.turn[world]
            ctl.alpha[world] = wp.min(ctl.alpha[world], ctl.radius[world] / wp.max(most, f64(1.0e-300)))

    @wp.func
    def take(ctl: Control, world: int, stands: bool, leap: bool):
        """Accept the trial and end the search: norms, tolerance of the next solve, convergence.

        `stands`: the trial is the iterate itself or the best one. `leap`: it may have raised Phi.
        """
        old_norm = ctl.norm[world]
        old_worst = ctl.worst[world]
        old_phi = ctl.phi[world]
        ctl.searching[world] = 0
        measure(ctl, world)
        ctl.phi[world] = objective(ctl, world) + ctl.slot_sums[7, world]
        if wp.static(stored):
            ctl.stepped[world] = 1
        if wp.static(stored and not midpoint):
            more = ctl.term_sums[1, world] - ctl.term_sums[0, world]
            ctl.phi[world] = ctl.phi[world] + more / ctl.dq_dv[world]
        ctl.phi_magnitude[world] = magnitude(ctl, world)
        if stands:
            if ctl.reused[world] != 0:
                ctl.reused[world] = 2
            if ctl.restoring[world] != 0:
                ctl.restoring[world] = 0
                ctl.radius[world] = f64(SHRINK) * ctl.radius[world]
                ctl.leaps[world] = 0
                if wp.static(not midpoint):
                    ctl.mixed[world] = wp.where(lost(ctl, world), 0, 2)
                ctl.tame[world] = 1
        else:
            ctl.iterations[world] = ctl.iterations[world] + 1
            if ctl.tame[world] != 0:
                ctl.tame[world] = 0
                if wp.static(not midpoint):
                    ctl.mixed[world] = wp.where(lost(ctl, world), 0, 1)
        ctl.total_iterations[world] = ctl.total_iterations[world] + 1
        ratio = ctl.norm[world] / wp.max(old_norm, f64(1.0e-300))
        if ctl.groups > ctl.components:  # one group's forces may dwarf those of the unconverged groups
            ratio = ctl.worst[world] / wp.max(old_worst, f64(1.0e-300))
        ctl.reduction[world] = ratio
        eta = f64(0.9) * ratio * ratio
        guard = f64(0.9) * ctl.forcing[world] * ctl.forcing[world]
        if guard > f64(0.1):
            eta = wp.max(eta, guard)
        if ctl.fixed_forcing == 0 and not stands:
            ctl.forcing[world] = wp.clamp(eta, f64(1.0e-6), f64(0.1))
        if wp.static(not walls):
            settle(ctl, world)
        if not stands and ctl.strict[world] == 0 and (leap or ctl.leaps[world] > 0):
            watch(ctl, world, old_phi, old_norm)

    @wp.func
    def shorten(ctl: Control, world: int, reused: bool):
        """Halve the step, or end the search; `reused`: the operator is of an earlier iterate."""
        ctl.wish[world] = 0
        ctl.searches[world] = ctl.searches[world] + 1
        ctl.alpha[world] = f64(0.5) * ctl.alpha[world]
        if reused and ctl.searches[world] > REUSED_SEARCH:
            # the reused operator is at fault: keep the iterate and solve with its own operator
            ctl.alpha[world] = f64(0.0)
        if ctl.searches[world] > MAX_SEARCH:
            why = FAIL_LINE_SEARCH
            if ctl.domain_J[world] <= f64(0.0):
                why = FAIL_JACOBIAN
            fail(ctl, world, why)

    @wp.func
    def lengthen(ctl: Control, world: int, good: bool, slope: f64) -> bool:
        """Double the step while Phi falls ever faster along it, undo the last doubling if the trial fails: replaces
        solves near a saddle. Statics, after a solve that met negative curvature."""
        alpha = ctl.alpha[world]
        longer = good and slope <= ctl.slope[world] and ctl.grown[world] >= 0 and ctl.grown[world] < GROWN
        if wp.static(limited):
            longer = longer and f64(2.0) * alpha <= ctl.limit[world]
        if longer:
            ctl.grown[world] = ctl.grown[world] + 1
            ctl.alpha[world] = f64(2.0) * alpha
        elif not good and ctl.grown[world] > 0:
            ctl.grown[world] = -1
            ctl.alpha[world] = f64(0.5) * alpha
            longer = True
        return longer

    @wp.func
    def between(ctl: Control, world: int, slope: f64) -> f64:
        """Next step length when the trial is beyond a kink of Phi, or still steep before it: Illinois method on slopes
        (Dowell and Jarratt 1971)."""
        alpha = ctl.alpha[world]
        low = wp.vec2d(ctl.lower[world])
        high = wp.vec2d(ctl.upper[world])
        if slope > f64(0.0):
            if high[0] > f64(0.0) and ctl.searches[world] > 1:
                low[1] = f64(0.5) * low[1]
            high = wp.vec2d(alpha, slope)
        else:
            high[1] = f64(0.5) * high[1]
            low = wp.vec2d(alpha, slope)
        ctl.lower[world] = low
        ctl.upper[world] = high
        part = wp.clamp(low[1] / (low[1] - high[1]), f64(0.05), f64(0.95))
        return low[0] + part * (high[0] - low[0])

    @wp.kernel(module=module)
    def judge_trial(ctl: Control):
        """Armijo test on Phi above its noise, else sign of the slope; then convergence."""
        world = wp.tid()
        if ctl.searching[world] == 0:
            return
        alpha = ctl.alpha[world]
        old_norm = ctl.norm[world]
        old_phi = ctl.phi[world]
        # frozen forces keep their symmetric tangent: the curvature of Phi then agrees with H
        bend = ctl.dq_dv[world] * ctl.tangent_sum[0, world]
        phi = objective(ctl, world) - f64(0.5) * alpha * alpha * bend
        norm = wp.sqrt(ctl.slot_sums[0, world])
        change = phi - old_phi
        noise = f64(NOISE) * ctl.eps * (ctl.phi_magnitude[world] + magnitude(ctl, world))
        finite = wp.isfinite(phi) and wp.isfinite(norm)
        good = finite
        if good:
            if wp.abs(change) > noise:
                good = change <= f64(ARMIJO) * alpha * ctl.slope[world]
            else:
                good = ctl.slot_sums[6, world] - alpha * bend <= f64(WOLFE) * wp.abs(ctl.slope[world])
            if wp.static(midpoint):
                good = finite and change <= f64(-2.0) * f64(ARMIJO) * alpha * old_phi
            if ctl.nonpotential != 0 and norm <= f64(0.5) * old_norm:
                good = True
        if ctl.domain_J[world] <= f64(0.0):
            good = False
        reused = ctl.reused[world] != 0
        if reused and ctl.iterations[world] == 0 and not norm <= f64(0.5) * old_norm:
            good = False  # a step must not start worse than with its own operator
            ctl.searches[world] = REUSED_SEARCH
        stands = alpha == f64(0.0) or ctl.restoring[world] != 0
        wishes = finite and not (good or stands or reused) and ctl.searches[world] == 0
        wishes = wishes and ctl.wish[world] == 0 and ctl.negative[world] == 0
        wishes = wishes and (ctl.tame[world] == 0 or ctl.mixed[world] == 2)
        if wp.static(walls):  # into an obstacle and back; friction has a convex potential, and full steps overshoot
            wishes = wishes and ctl.refreshed[world] == 0 and ctl.excursions[world] < EXCURSIONS
        if wp.static(walls and not midpoint):  # sticking begins where Phi rises again
            slope = ctl.slot_sums[6, world] - alpha * bend
            steep = f64(KINK) * wp.abs(ctl.slope[world])
            tries = not (stands or wishes or reused) and ctl.wish[world] == 0 and ctl.searches[world] < KINKS
            beyond = slope > steep or (ctl.upper[world][0] > f64(0.0) and slope < -steep)
            if tries and beyond and finite and ctl.domain_J[world] > f64(0.0):
                ctl.searches[world] = ctl.searches[world] + 1
                ctl.alpha[world] = between(ctl, world, slope)
                return
        if lengthen(ctl, world, good and not (stands or reused), ctl.slot_sums[6, world] - alpha * bend):
            return
        leap = ctl.wish[world] == 2 and finite and ctl.min_J[world] > f64(0.0)
        if good or stands or leap:
            take(ctl, world, stands, leap)
        elif wishes:
            ctl.wish[world] = 1
            ctl.searching[world] = 0
            wp.atomic_max(ctl.any_hard, 0, 1)
        elif ctl.leaps[world] > 0:
            ctl.restoring[world] = 1
        else:
            shorten(ctl, world, reused)

    return _types.SimpleNamespace(lost=lost, plan_leap=plan_leap, judge_trial=judge_trial)
