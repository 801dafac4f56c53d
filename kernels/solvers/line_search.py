"""Line search of Newton's method: acceptance of trials and choice of the next step length. One thread per world."""

import warp as wp

from ..common.modules import KernelSet, kernel_set, masked_kernel
from ..common.traits import Traits
from ..common.types import f64
from .convergence import convergence_functions
from .newton_control import Failure, Row, control_struct

__all__ = ["MAX_BACKTRACKS", "MAX_TRUST_RADIUS", "PHI_NOISE_ROUNDINGS", "line_search_kernels"]

ARMIJO_FACTOR, WOLFE_FACTOR = 1.0e-4, 0.8
"""Sufficient decrease of Phi, and of |slope|, over the predicted one and over that at the iterate."""
PHI_NOISE_ROUNDINGS = 100.0
"""Roundings of the parts of Phi below which its changes are noise."""
MAX_BACKTRACKS, MAX_REUSED_BACKTRACKS = 20, 2
"""Maximum halvings of a step; with an operator of an earlier iterate."""
MAX_NONMONOTONE = 5
"""Consecutive full steps that may raise Phi: with the predicted stress in H, a slender body reaches equilibrium over
iterates whose membrane energy is far above that of both ends (Magisano, Leonetti and Garcea 2017)."""
MAX_TRUST_RADIUS, RADIUS_SHRINK = 0.5, 0.4
"""Largest rotation or stretch of an element in such a step, and its reduction factor after restoring the best
iterate."""
SOLVES_WITHOUT_STEP = 10  # solves without a step after which the exact tangent is used; with 0 soft solids take longer
MAX_DOUBLINGS = 30  # maximum doublings of a step along which Phi is concave
MAX_PENETRATING_STEPS = 1  # maximum deep penetrations by full steps in an attempt: the return may end at the start
KINK_SLOPE_RATIO, MAX_KINK_TRIALS = 0.5, 8
"""Contact: a positive slope of Phi at a trial above KINK_SLOPE_RATIO times that at the iterate indicates that slipping
points have reversed and Phi has a kink before. It is located by at most MAX_KINK_TRIALS trials: a step beyond it makes
the points slip back, again and again, while one that ends near it makes them stick."""
QUADRATIC_SLOPE_RATIO = 0.2
"""Contact in motion: a step after which Phi still falls by more than this ratio of its slope at the iterate is doubled.
A full step leaves a quarter of it where the force grows with the square of the depth, and would halve the depth
only."""


def line_search_kernels(traits: Traits, module: wp.Module) -> KernelSet:
    """Kernels in the module of Newton's method, and the function `tangent_needed`."""
    Control = control_struct()
    convergence = convergence_functions(traits)
    longest = 1.0 if traits.unilateral else 1.0e300

    @wp.func
    def tangent_needed(ctl: Control, world: int) -> bool:
        """True if solves with matrices other than the tangent have failed too often, for laws with their own tangent:
        beyond a bifurcation only the exact tangent gives descent."""
        return ctl.linear_stress == 0 and ctl.solve.count[world] - ctl.iterations[world] > SOLVES_WITHOUT_STEP

    @wp.func
    def track_best_iterate(ctl: Control, world: int, old_phi: f64, old_norm: f64):
        """Bookkeeping after a step that raised Phi and the steps that follow it: restore the best iterate if for
        MAX_NONMONOTONE steps neither the residual halved nor Phi fell below its best value."""
        if ctl.nonmonotone.steps[world] == 0:
            ctl.nonmonotone.store_best[world] = 1
            ctl.nonmonotone.best_phi[world] = old_phi
            if wp.static(traits.unilateral):
                ctl.nonmonotone.penetrating_steps[world] = ctl.nonmonotone.penetrating_steps[world] + 1
            ctl.nonmonotone.best_norm[world] = old_norm
        if wp.static(not traits.midpoint):
            ctl.solve.predicted_stress[world] = 1
        counts = True
        if wp.static(traits.unilateral):  # Phi decreases monotonically on the way back out of an obstacle
            counts = ctl.nonmonotone.steps[world] == 0 or not ctl.search.phi[world] < old_phi
        if counts:
            ctl.nonmonotone.steps[world] = ctl.nonmonotone.steps[world] + 1
        if (
            ctl.norms.residual_norm[world] <= f64(0.5) * ctl.nonmonotone.best_norm[world]
            or ctl.search.phi[world] < ctl.nonmonotone.best_phi[world]
        ):
            ctl.nonmonotone.steps[world] = 0
            ctl.nonmonotone.trust_radius[world] = wp.min(
                f64(2.0) * ctl.nonmonotone.trust_radius[world], f64(MAX_TRUST_RADIUS)
            )
        elif ctl.nonmonotone.steps[world] >= MAX_NONMONOTONE and ctl.active[world] != 0:
            ctl.nonmonotone.restore_best[world] = 1
            ctl.search.active[world] = 1

    @wp.kernel(module=module)
    def limit_nonmonotone_step(ctl: Control):
        """Length of a nonmonotone step: the rotation and stretch of elements stay below the trust radius."""
        world = wp.tid()
        if ctl.active[world] != 0 and ctl.nonmonotone.trial[world] == 1:
            ctl.nonmonotone.trial[world] = 2
            ctl.search.active[world] = 1
            most = ctl.dq_dv[world] * ctl.nonmonotone.direction_gradient[world]
            ctl.search.alpha[world] = wp.min(
                ctl.search.alpha[world], ctl.nonmonotone.trust_radius[world] / wp.max(most, f64(1.0e-300))
            )

    @wp.func
    def accept_trial(ctl: Control, world: int, stands: bool, nonmonotone: bool):
        """Accept the trial and end the search: norms, tolerance of the next solve, convergence.

        `stands`: the trial is the iterate itself or the best one. `nonmonotone`: it may have raised Phi.
        """
        old_norm = ctl.norms.residual_norm[world]
        old_worst = ctl.norms.residual_ratio[world]
        old_phi = ctl.search.phi[world]
        ctl.search.active[world] = 0
        convergence.evaluate_norms(ctl, world)
        ctl.search.phi[world] = convergence.objective(ctl, world) + ctl.slot_sums[Row.FROZEN_CHANGE, world]
        if wp.static(traits.stored):
            ctl.search.trial_accepted[world] = 1
        if wp.static(traits.stored and not traits.midpoint):
            more = ctl.term_sums[1, world] - ctl.term_sums[0, world]
            ctl.search.phi[world] = ctl.search.phi[world] + more / ctl.dq_dv[world]
        ctl.search.phi_magnitude[world] = convergence.objective_magnitude(ctl, world)
        if stands:
            if ctl.solve.operator_reused[world] != 0:
                ctl.solve.operator_reused[world] = 2
            if ctl.nonmonotone.restore_best[world] != 0:
                ctl.nonmonotone.restore_best[world] = 0
                ctl.nonmonotone.trust_radius[world] = f64(RADIUS_SHRINK) * ctl.nonmonotone.trust_radius[world]
                ctl.nonmonotone.steps[world] = 0
                if wp.static(not traits.midpoint):
                    ctl.solve.predicted_stress[world] = wp.where(tangent_needed(ctl, world), 0, 2)
                ctl.nonmonotone.require_armijo[world] = 1
        else:
            ctl.iterations[world] = ctl.iterations[world] + 1
            if ctl.nonmonotone.require_armijo[world] != 0:
                ctl.nonmonotone.require_armijo[world] = 0
                if wp.static(not traits.midpoint):
                    ctl.solve.predicted_stress[world] = wp.where(tangent_needed(ctl, world), 0, 1)
        ctl.step_iterations[world] = ctl.step_iterations[world] + 1
        ratio = ctl.norms.residual_norm[world] / wp.max(old_norm, f64(1.0e-300))
        if ctl.norms.group_count > ctl.norms.component_count:
            # one group's forces may dwarf those of the unconverged groups
            ratio = ctl.norms.residual_ratio[world] / wp.max(old_worst, f64(1.0e-300))
        ctl.norms.residual_reduction[world] = ratio
        if ratio <= f64(0.5):
            ctl.solve.stalled_solves[world] = 0
        eta = f64(0.9) * ratio * ratio
        # the fall of a quadratic force tells nothing of the convergence
        eta = wp.where(ctl.search.alpha[world] > f64(wp.static(longest)), f64(0.1), eta)
        guard = f64(0.9) * ctl.solve.forcing[world] * ctl.solve.forcing[world]
        if guard > f64(0.1):
            eta = wp.max(eta, guard)
        if ctl.solve.fixed_forcing == 0 and not stands:
            ctl.solve.forcing[world] = wp.clamp(eta, f64(1.0e-6), f64(0.1))
        if wp.static(not traits.unilateral):
            convergence.check_convergence(ctl, world)
        if not stands and ctl.floor.estimate_error[world] == 0 and (nonmonotone or ctl.nonmonotone.steps[world] > 0):
            track_best_iterate(ctl, world, old_phi, old_norm)

    @wp.func
    def shorten_step(ctl: Control, world: int, reused: bool):
        """Halve the step, or end the search; `reused`: the operator is of an earlier iterate."""
        ctl.nonmonotone.trial[world] = 0
        ctl.search.trials[world] = ctl.search.trials[world] + 1
        ctl.search.alpha[world] = f64(0.5) * ctl.search.alpha[world]
        if reused and ctl.search.trials[world] > MAX_REUSED_BACKTRACKS:
            # the reused operator is at fault: keep the iterate and solve with its own operator
            ctl.search.alpha[world] = f64(0.0)
        if ctl.search.trials[world] > MAX_BACKTRACKS:
            why = Failure.LINE_SEARCH
            if ctl.domain_J[world] <= f64(0.0):
                why = Failure.JACOBIAN
            convergence.handle_failed_search(ctl, world, why)

    @wp.func
    def lengthen_step(ctl: Control, world: int, good: bool, slope: f64) -> bool:
        """Double the step while Phi falls ever faster along it, undo the last doubling if the trial fails: replaces
        solves near a saddle. Statics, after a solve that met negative curvature."""
        alpha = ctl.search.alpha[world]
        longer = (
            good
            and slope <= ctl.search.slope[world]
            and ctl.search.doublings[world] >= 0
            and ctl.search.doublings[world] < MAX_DOUBLINGS
        )
        if wp.static(traits.limited):
            longer = longer and f64(2.0) * alpha <= ctl.search.limit[world]
        if longer:
            ctl.search.doublings[world] = ctl.search.doublings[world] + 1
            ctl.search.alpha[world] = f64(2.0) * alpha
        elif not good and ctl.search.doublings[world] > 0:
            ctl.search.doublings[world] = -1
            ctl.search.alpha[world] = f64(0.5) * alpha
            longer = True
        return longer

    @wp.func
    def bracket_step(ctl: Control, world: int, slope: f64) -> f64:
        """Next step length when the trial is beyond a kink of Phi, or still steep before it: Illinois method on slopes
        (Dowell and Jarratt 1971)."""
        alpha = ctl.search.alpha[world]
        low = wp.vec2d(ctl.search.bracket_low[world])
        high = wp.vec2d(ctl.search.bracket_high[world])
        if slope > f64(0.0):
            if high[0] > f64(0.0) and ctl.search.trials[world] > 1:
                low[1] = f64(0.5) * low[1]
            high = wp.vec2d(alpha, slope)
        else:
            high[1] = f64(0.5) * high[1]
            low = wp.vec2d(alpha, slope)
        ctl.search.bracket_low[world] = low
        ctl.search.bracket_high[world] = high
        part = wp.clamp(low[1] / (low[1] - high[1]), f64(0.05), f64(0.95))
        return low[0] + part * (high[0] - low[0])

    @wp.func
    def halves_residual(ctl: Control, world: int, norm: f64) -> bool:
        """True if a trial with residual `norm` halves that of the components that are still iterated."""
        old, part = ctl.norms.residual_norm[world], ctl.norms.unconverged_norm[world]
        return norm * norm <= old * old - f64(0.75) * part * part

    @wp.func
    def only_multipliers_change(ctl: Control, world: int) -> bool:
        """True if Phi, with its frozen multipliers, is at its minimum within round-off but the residual is not 0: a
        full step changes the multipliers alone."""
        noise = f64(2.0) * f64(PHI_NOISE_ROUNDINGS) * ctl.floor.eps * ctl.search.phi_magnitude[world]
        return ctl.classical_multipliers == 0 and ctl.search.slope[world] <= noise

    @wp.func
    def sufficient_decrease(ctl: Control, world: int, change: f64, slope: f64, norm: f64) -> bool:
        """True if a trial is good: Armijo on the change of Phi above its noise, else the sign of the slope."""
        alpha = ctl.search.alpha[world]
        noise = (
            f64(PHI_NOISE_ROUNDINGS)
            * ctl.floor.eps
            * (ctl.search.phi_magnitude[world] + convergence.objective_magnitude(ctl, world))
        )
        good = slope <= f64(WOLFE_FACTOR) * wp.abs(ctl.search.slope[world])
        if wp.static(traits.has_constraints):  # Phi has the multipliers frozen: at its minimum they still change
            good = good or (ctl.classical_multipliers == 0 and halves_residual(ctl, world, norm))
        if wp.abs(change) > noise:
            good = change <= f64(ARMIJO_FACTOR) * alpha * ctl.search.slope[world]
        if wp.static(traits.midpoint):
            good = change <= f64(-2.0) * f64(ARMIJO_FACTOR) * alpha * ctl.search.phi[world]
        return good or (ctl.has_nonpotential != 0 and norm <= f64(0.5) * ctl.norms.residual_norm[world])

    @wp.func
    def is_good_trial(ctl: Control, world: int, phi: f64, slope: f64, norm: f64) -> bool:
        """True for a trial with finite Phi, J > 0 and sufficient decrease; with a reused operator the first one must
        also halve the residual."""
        good = wp.isfinite(phi) and wp.isfinite(norm) and not ctl.domain_J[world] <= f64(0.0)
        if good:
            good = sufficient_decrease(ctl, world, phi - ctl.search.phi[world], slope, norm)
        if (
            ctl.solve.operator_reused[world] != 0
            and ctl.iterations[world] == 0
            and not norm <= f64(0.5) * ctl.norms.residual_norm[world]
        ):
            good = False  # a step must not start worse than with its own operator
            ctl.search.trials[world] = MAX_REUSED_BACKTRACKS
        return good

    @wp.func
    def is_nonmonotone_allowed(ctl: Control, world: int) -> bool:
        """True if the full step of this search may raise Phi."""
        out = (
            ctl.search.trials[world] == 0
            and ctl.nonmonotone.trial[world] == 0
            and ctl.solve.negative_curvature[world] == 0
        )
        out = out and (ctl.nonmonotone.require_armijo[world] == 0 or ctl.solve.predicted_stress[world] == 2)
        if wp.static(traits.unilateral):  # into an obstacle and back; friction is convex: full steps overshoot
            out = (
                out
                and ctl.frozen.updated[world] == 0
                and ctl.nonmonotone.penetrating_steps[world] < MAX_PENETRATING_STEPS
            )
        return out

    @wp.func
    def locate_kink(ctl: Control, world: int, slope: f64) -> bool:
        """True if a trial is beside a kink of Phi, where sticking begins: Phi rises steeply there, or still falls
        steeply within the bracket; or if Phi falls on beyond the full step. Sets the next step length."""
        if (
            ctl.nonmonotone.trial[world] != 0
            or ctl.search.trials[world] >= MAX_KINK_TRIALS
            or not ctl.domain_J[world] > f64(0.0)
        ):
            return False
        steep = f64(KINK_SLOPE_RATIO) * wp.abs(ctl.search.slope[world])
        alpha = ctl.search.alpha[world]
        if ctl.search.trials[world] == 0 and slope < f64(QUADRATIC_SLOPE_RATIO) * ctl.search.slope[world]:
            if alpha == f64(1.0) and ctl.is_static == 0 and wp.static(not traits.limited):
                ctl.search.bracket_low[world] = wp.vec2d(alpha, slope)
                ctl.search.trials[world] = 1
                ctl.search.alpha[world] = f64(2.0) * alpha
                return True
        beyond = slope > steep or (ctl.search.bracket_high[world][0] > f64(0.0) and slope < -steep)
        if beyond:
            ctl.search.trials[world] = ctl.search.trials[world] + 1
            ctl.search.alpha[world] = bracket_step(ctl, world, slope)
        return beyond

    @wp.func
    def choose_next_trial(ctl: Control, world: int, wants_nonmonotone: bool, reused: bool):
        """Next trial after a refused one: a nonmonotone step, the best iterate, or half the step."""
        if wants_nonmonotone:
            ctl.nonmonotone.trial[world] = 1
            ctl.search.active[world] = 0
            wp.atomic_max(ctl.any_rare_branch, 0, 1)
        elif ctl.nonmonotone.steps[world] > 0:
            ctl.nonmonotone.restore_best[world] = 1
        else:
            shorten_step(ctl, world, reused)

    @masked_kernel(module, "ctl.search.active")
    def check_trial(ctl: Control):
        """Acceptance of a trial, Armijo on Phi, Eq. (18), or the next step length; then convergence."""
        world = wp.tid()
        alpha = ctl.search.alpha[world]
        # frozen forces keep their symmetric tangent: the curvature of Phi then agrees with H
        bend = ctl.dq_dv[world] * ctl.search.tangent_sum[0, world]
        phi = convergence.objective(ctl, world) - f64(0.5) * alpha * alpha * bend
        slope = ctl.slot_sums[Row.SLOPE, world] - alpha * bend
        norm = wp.sqrt(ctl.slot_sums[Row.RESIDUAL, world])
        finite = wp.isfinite(phi) and wp.isfinite(norm)
        good = is_good_trial(ctl, world, phi, slope, norm)
        reused = ctl.solve.operator_reused[world] != 0
        stands = alpha == f64(0.0) or ctl.nonmonotone.restore_best[world] != 0
        usable = finite and not (stands or reused)
        wants_nonmonotone = usable and not good and is_nonmonotone_allowed(ctl, world)
        if wp.static(traits.unilateral and not traits.midpoint):
            if usable and not wants_nonmonotone:
                if locate_kink(ctl, world, slope):
                    return
        if lengthen_step(ctl, world, good and not (stands or reused), slope):
            return
        nonmonotone = ctl.nonmonotone.trial[world] == 2 and finite and ctl.min_J[world] > f64(0.0)
        if good or stands or nonmonotone:
            accept_trial(ctl, world, stands, nonmonotone)
        else:
            choose_next_trial(ctl, world, wants_nonmonotone, reused)

    return kernel_set(locals())
