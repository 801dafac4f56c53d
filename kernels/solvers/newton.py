"""Newton's method per world: convergence, forcing terms, line search, acceptance. One thread per world."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.traits import NO_TERMS, Traits
from ..common.types import f64, int_1d
from .augmented_lagrangian import outer_loop_kernels
from .convergence import MAX_ERROR_ESTIMATES, SINGLE_PRECISION_EPS, convergence_functions
from .frozen_update import frozen_update_kernels
from .line_search import MAX_BACKTRACKS, MAX_TRUST_RADIUS, PHI_NOISE_ROUNDINGS, line_search_kernels
from .newton_control import FLOOR_LANES, Failure, Row, control_struct
from .pcg import pcg_struct
from .perturbation import SCATTER_FACTOR

__all__ = ["newton_kernels"]

MAX_SOLVES_PER_ITERATION = 3
"""Maximum linear solves of an attempt per allowed iteration: bounds solves without a step."""
DISPLACEMENT_ROUNDINGS = 64.0
"""Roundings of the displacements below which an error is negligible, whatever the reference energy."""
CONTACT_ROUNDINGS = 2048.0
"""Roundings of the positions, in float64 with contact, below which an error up to `MAX_CONTACT_NOISE` is accepted: at
rest, a stiff body lies as deep in its contact as the positions resolve."""
MAX_CONTACT_NOISE = 0.1
"""Largest error estimate accepted so."""
ALTERNATIVE_START_FORCING = 0.1
"""Forcing term of the first solve after an alternative first iterate, far from the end: a tighter one is wasted."""
MAX_START_ENERGY_RATIO = 3.0
"""Strain energy increase of a first iterate, in kinetic energies, above which other first iterates are tried."""


@functools.cache
def newton_kernels(traits: Traits = NO_TERMS) -> KernelSet:
    """Kernels of the Newton iteration, of one thread per world; scalars are float64.

    They depend on the traits "stored", "has_constraints", "limited", "unilateral" and "midpoint".
    """
    Control = control_struct()
    PCG = pcg_struct()
    convergence = convergence_functions(traits)
    module = kernel_module(
        f"newton{traits.suffix('stored', 'has_constraints', 'limited', 'unilateral', 'midpoint')}", light=True
    )

    searching = line_search_kernels(traits, module)

    @masked_kernel(module, "active")
    def reset_min_J(ctl: Control, active: int_1d):
        """Reset the smallest J before an evaluation."""
        world = wp.tid()
        ctl.min_J[world] = f64(1.0e30)
        ctl.domain_J[world] = f64(1.0e30)
        if wp.static(traits.unilateral):
            ctl.frozen.contact_active[world] = 0

    @wp.func
    def initialise_iteration(ctl: Control, world: int):
        """Initialise the iteration at its first iterate, and test that for convergence."""
        convergence.evaluate_norms(ctl, world)
        phi = convergence.objective(ctl, world) + ctl.slot_sums[Row.FROZEN_CHANGE, world]
        ctl.search.phi[world] = phi
        ctl.search.phi_magnitude[world] = convergence.objective_magnitude(ctl, world)
        ctl.solve.forcing[world] = ctl.solve.first_forcing
        ctl.solve.operator_reused[world] = 0
        ctl.nonmonotone.steps[world] = 0
        ctl.solve.predicted_stress[world] = 0
        ctl.nonmonotone.require_armijo[world] = 0
        ctl.nonmonotone.store_best[world] = 0
        ctl.nonmonotone.restore_best[world] = 0
        ctl.nonmonotone.trust_radius[world] = f64(MAX_TRUST_RADIUS)
        ctl.floor.estimate_error[world] = 0
        ctl.floor.estimates[world] = 0
        ctl.solve.negative_curvature[world] = 0
        ctl.solve.pcg_unconverged[world] = 0
        ctl.solve.met_negative_curvature[world] = 0
        ctl.solve.count[world] = 0
        ctl.solve.stalled_solves[world] = 0
        ctl.floor.error_estimate[world] = f64(1.0e30)
        ctl.search.slope[world] = f64(0.0)
        if wp.static(traits.unilateral):
            ctl.frozen.updated[world] = 0
            ctl.frozen.continued[world] = 0
            ctl.frozen.unilateral_changed[world] = 0
            ctl.nonmonotone.penetrating_steps[world] = 0
        if ctl.domain_J[world] <= f64(0.0):
            convergence.give_up(ctl, world, Failure.JACOBIAN)
        elif not (wp.isfinite(phi) and wp.isfinite(ctl.norms.residual_norm[world])):
            convergence.give_up(ctl, world, Failure.NAN)
        elif wp.static(traits.unilateral) and ctl.norms.residual_norm[world] > f64(0.0):
            convergence.record_residual(ctl, world)  # frozen quantities are of another iterate: no acceptance
        else:
            convergence.check_convergence(ctl, world)

    @wp.func
    def is_poor_first_iterate(ctl: Control, world: int) -> bool:
        """True if other first iterates should be tried: Phi exceeds a bound of Phi at q_n, or J <= 0.

        At q_n Phi is the strain energy of the state plus a kinetic energy (`Row.KINETIC` of `residual`): all of it for
        backward Euler, a third for BDF2. Midpoint schemes, which have no Phi, compare its potentials, with contact: an
        iterate deep in an obstacle takes many iterations to leave it.
        """
        phi = convergence.objective(ctl, world)
        if wp.static(traits.midpoint and not traits.unilateral):
            return not (wp.isfinite(phi) and ctl.min_J[world] > f64(0.0))
        if wp.static(traits.midpoint):
            phi = wp.where(wp.isfinite(phi), convergence.potential_energy(ctl, world) / ctl.dq_dv[world], phi)
        bound = (
            ctl.strain_energy[world] / ctl.dq_dv[world]
            + f64(MAX_START_ENERGY_RATIO) * ctl.slot_sums[Row.KINETIC, world]
        )
        bound += f64(PHI_NOISE_ROUNDINGS) * ctl.floor.eps * convergence.objective_magnitude(ctl, world)
        return not (phi <= bound and wp.isfinite(phi) and ctl.min_J[world] > f64(0.0))

    @wp.kernel(module=module)
    def begin_iteration(ctl: Control, stage: int):
        """Start with the first iterate; `stage` 0: no alternatives; 1: some follow if it is poor; 2: the best."""
        world = wp.tid()
        if stage != 2:
            ctl.start.has_alternatives[world] = 0
        if ctl.active[world] == 0 or (stage == 2 and ctl.start.has_alternatives[world] == 0):
            return
        if stage == 1:
            if is_poor_first_iterate(ctl, world):
                ctl.start.has_alternatives[world] = 1
                wp.atomic_max(ctl.any_rare_branch, 0, 1)
                return
        initialise_iteration(ctl, world)
        if stage == 2 and ctl.solve.fixed_forcing == 0:
            ctl.solve.forcing[world] = f64(ALTERNATIVE_START_FORCING)

    @wp.kernel(module=module)
    def compare_first_iterates(ctl: Control, first: int, better: int_1d):
        """Flag the worlds where the first iterate just evaluated is the best so far: J > 0 before Phi."""
        world = wp.tid()
        better[world] = 0
        if ctl.start.has_alternatives[world] == 0:
            return
        phi = convergence.objective(ctl, world)
        if not (wp.isfinite(phi) and ctl.domain_J[world] > f64(0.0)):
            phi = f64(1.0e300)
        low = wp.min(ctl.min_J[world], f64(0.0))
        if (
            first != 0
            or low > ctl.nonmonotone.best_norm[world]
            or (low == ctl.nonmonotone.best_norm[world] and phi < ctl.nonmonotone.best_phi[world])
        ):
            ctl.nonmonotone.best_phi[world] = phi
            ctl.nonmonotone.best_norm[world] = low
            better[world] = 1
            if first == 0:
                ctl.start.is_extrapolated[world] = 0

    @wp.func
    def check_direction(ctl: Control, world: int):
        """Check the search direction and start the line search."""
        ctl.solve.met_negative_curvature[world] = wp.max(
            ctl.solve.met_negative_curvature[world], ctl.solve.negative_curvature[world]
        )
        ctl.search.active[world] = 1
        barred = False
        if wp.static(traits.limited):
            barred = not ctl.search.limit[world] > f64(0.0)
        if not wp.isfinite(ctl.search.slope[world]):
            convergence.handle_failed_search(ctl, world, Failure.NAN)
        elif barred:
            convergence.handle_failed_search(ctl, world, Failure.STEP_LIMIT)
        elif ctl.solve.negative_curvature[world] != 0 and ctl.solve.predicted_stress[world] == 1:
            if ctl.nonmonotone.steps[world] > 0:
                ctl.nonmonotone.restore_best[world] = 1
            else:
                ctl.solve.predicted_stress[world] = wp.where(searching.tangent_needed(ctl, world), 0, 2)
                ctl.nonmonotone.require_armijo[world] = 1
                ctl.search.alpha[world] = f64(0.0)
        elif ctl.search.slope[world] >= f64(0.0) and wp.static(not traits.midpoint):  # midpoint: |g| can still fall
            if ctl.solve.operator_reused[world] != 0:
                ctl.search.alpha[world] = f64(0.0)
            elif ctl.nonmonotone.steps[world] > 0:
                ctl.nonmonotone.restore_best[world] = 1
            elif wp.static(traits.has_constraints) and searching.only_multipliers_change(ctl, world):
                ctl.search.trials[world] = MAX_BACKTRACKS  # a single trial
            else:
                convergence.handle_failed_search(ctl, world, Failure.CURVATURE)

    @wp.func
    def part_error(ctl: Control, world: int, part: int, whole: f64, largest: f64) -> f64:
        """Error estimate of a part of the model (its residual parts), see `check_rounding_floor`.

        `whole`: -g.p of all parts, W; `largest`: the largest length in the round-off bound, m.
        """
        dq = ctl.dq_dv[world]
        work, kinetic, strain, step = f64(0.0), f64(0.0), f64(0.0), f64(0.0)
        for lane in range(FLOOR_LANES):
            work += ctl.floor.sums[0, world, part, lane]
            kinetic += ctl.floor.sums[1, world, part, lane]
            strain += ctl.floor.sums[2, world, part, lane]
            step = wp.max(step, ctl.floor.sums[3, world, part, lane])
        eta = f64(1.0e30)
        if ctl.solve.negative_curvature[world] == 0 and wp.isfinite(work) and whole > f64(0.0):
            eta = wp.sqrt(wp.abs(work) * dq / wp.max(f64(2.0) * strain + kinetic * dq, f64(1.0e-300)))
            if ctl.floor.eps > f64(SINGLE_PRECISION_EPS):  # a soft direction may be invisible to the energy
                eta = wp.max(eta, f64(SCATTER_FACTOR) * dq * step / wp.max(largest, f64(1.0e-300)))
            if eta > ctl.floor.max_error and dq * step <= f64(DISPLACEMENT_ROUNDINGS) * ctl.floor.eps * largest:
                eta = dq * step / wp.max(largest, f64(1.0e-300))
        return eta

    @wp.func
    def is_noise(ctl: Control, world: int, part: int, estimate: f64, largest: f64) -> bool:
        """True if the error of a part in contact is that of the positions; `largest`: of `part_error`."""
        step = f64(0.0)
        for lane in range(FLOOR_LANES):
            step = wp.max(step, ctl.floor.sums[3, world, part, lane])
        near = ctl.dq_dv[world] * step <= f64(CONTACT_ROUNDINGS) * ctl.floor.eps * largest
        return near and estimate <= f64(MAX_CONTACT_NOISE) and ctl.floor.eps <= f64(SINGLE_PRECISION_EPS)

    @wp.kernel(module=module)
    def check_rounding_floor(ctl: Control, component_of_part: int_1d):
        """Error estimate of a stalled residual, relative to the solution, of the worst part.

        With H p = -g in the energy norm: eta = sqrt(-g.p dq/dv) / sqrt(2 strain energy + dv.M dv); for each part
        separately, since a stiff part would hide the error of a soft one joined to it.
        """
        world = wp.tid()
        if ctl.floor.estimate_error[world] != 2:
            return
        ctl.floor.estimate_error[world] = 0
        single = ctl.floor.eps > f64(SINGLE_PRECISION_EPS)
        # this solve cannot give the error either
        if ctl.solve.pcg_unconverged[world] != 0 and single:
            convergence.give_up(ctl, world, Failure.ROUNDOFF)
            return
        largest, whole = f64(0.0), f64(0.0)
        for part in range(component_of_part.shape[0]):
            for lane in range(FLOOR_LANES):
                whole += ctl.floor.sums[0, world, part, lane]
                largest = wp.max(largest, ctl.floor.sums[4, world, part, lane])
        if wp.static(traits.unilateral):  # gaps have position round-off
            largest = wp.max(largest, ctl.model_size)
        elif wp.static(traits.has_constraints):  # so have angles of joints, whose forces vanish at rest
            if ctl.is_static == 0 and not single:
                largest = wp.max(largest, ctl.model_size)
        worst, noise = f64(0.0), f64(0.0)
        for part in range(component_of_part.shape[0]):
            if ctl.norms.component_converged[world, component_of_part[part]] == 0:
                error = part_error(ctl, world, part, whole, largest)
                if wp.static(traits.unilateral):
                    if is_noise(ctl, world, part, error, largest):
                        noise = wp.max(noise, error)
                        error = f64(0.0)
                worst = wp.max(worst, error)
        ctl.floor.error_estimate[world] = worst
        if worst <= ctl.floor.max_error:
            ctl.floor.error[world] = wp.max(ctl.floor.error[world], wp.max(worst, noise))
            convergence.accept_iterate(ctl, world)
            return
        tries = ctl.floor.estimates[world] + 1
        ctl.floor.estimates[world] = tries
        known = worst < f64(1.0e30)
        if tries >= MAX_ERROR_ESTIMATES or (
            known and tries > 1 and worst > f64(0.5) * ctl.floor.last_error_estimate[world]
        ):
            convergence.give_up(ctl, world, wp.where(known, Failure.ROUNDOFF, Failure.CURVATURE))
            return
        ctl.floor.last_error_estimate[world] = worst
        check_direction(ctl, world)

    @wp.kernel(module=module)
    def begin_search(ctl: Control, pcg: PCG):
        """Slope along the new direction; the first trial is the full step."""
        world = wp.tid()
        if ctl.active[world] == 0:
            ctl.search.active[world] = 0
            return
        ctl.search.slope[world] = ctl.search.slope_sum[0, world]
        ctl.search.alpha[world] = f64(1.0)
        if wp.static(traits.limited):
            ctl.search.alpha[world] = wp.min(ctl.search.limit[world], f64(1.0))
        ctl.solve.count[world] = ctl.solve.count[world] + 1
        ctl.solve.stalled_solves[world] = (ctl.solve.stalled_solves[world] + 1) * ctl.solve.pcg_unconverged[world]
        ctl.search.trials[world] = 0
        ctl.search.doublings[world] = wp.where(ctl.solve.negative_curvature[world] != 0 and ctl.is_static != 0, 0, -1)
        if wp.static(traits.unilateral):
            ctl.search.bracket_low[world] = wp.vec2d(f64(0.0), ctl.search.slope_sum[0, world])
            ctl.search.bracket_high[world] = wp.vec2d()
        ctl.nonmonotone.trial[world] = 0
        ctl.nonmonotone.direction_gradient[world] = f64(0.0)
        ctl.search.active[world] = 1
        ctl.start.is_extrapolated[world] = 0
        ctl.nonmonotone.store_best[world] = 0
        if wp.static(traits.stored):
            ctl.search.trial_accepted[world] = 0
        if wp.static(traits.has_constraints):
            if ctl.classical_multipliers == 0:
                ctl.multiplier_updates[world] = ctl.multiplier_updates[world] + 1
        if ctl.floor.estimate_error[world] != 0 and pcg.step_iterations[world] < pcg.max_work:
            # estimate the error before following the direction
            ctl.floor.estimate_error[world] = 2
            ctl.search.active[world] = 0
            wp.atomic_max(ctl.any_rare_branch, 0, 1)
        elif pcg.step_iterations[world] >= pcg.max_work:
            convergence.give_up(ctl, world, Failure.WORK)
        elif ctl.solve.max_stalled_solves > 0 and ctl.solve.stalled_solves[world] >= ctl.solve.max_stalled_solves:
            convergence.give_up(ctl, world, Failure.ROUNDOFF)
        elif (
            ctl.solve.count[world]
            > MAX_SOLVES_PER_ITERATION * convergence.iteration_factor(ctl, world) * ctl.max_iterations
        ):
            convergence.give_up(ctl, world, Failure.ITERATIONS)
        else:
            check_direction(ctl, world)

    outer, frozen = outer_loop_kernels(traits, module), frozen_update_kernels(traits, module)
    return kernel_set(vars(outer) | vars(frozen) | vars(searching) | locals())
