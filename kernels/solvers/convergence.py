"""Objective Phi, residual norms, convergence and failure of a Newton iterate. Functions of one world."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.traits import NO_TERMS, Traits
from ..common.types import f64
from .newton_control import GROUP_ROUNDOFF, Failure, Row, control_struct

__all__ = ["EXTRA_ITERATION_FACTOR", "MAX_ERROR_ESTIMATES", "SINGLE_PRECISION_EPS", "convergence_functions"]

EXTRAPOLATED_TOL_FACTOR, UNSOLVED_TOL_FACTOR = 1.0e-3, 0.1
"""Fractions of the tolerance that a first iterate must meet: extrapolated; in float32 with parts of unlike stiffness.
The residual of an unsolved iterate lies in the softest directions and accumulates over steps without iterations."""
STALL_RATIO = 0.5
"""Residual ratio above which an iteration counts as stalled."""
TIGHT_CONSTRAINT_ITERATIONS = 4
"""Iterations in which constraints are closed to the tolerance of accelerations, if `constraint_tol` is looser."""
STALL_ROUNDINGS = 1.0e3
"""Multiple of the residual of rounded positions below which a stall may be due to round-off."""
MAX_STALL_STEP = 10.0
"""Largest last step of a residual at its round-off floor, in largest accepted errors (`max_floor`)."""
EXTRA_ITERATION_FACTOR = 3
"""Multiple of the iteration limit that `iteration_factor` adds."""
STALL_ENERGY_ROUNDINGS = 64.0
"""Last step in the energy norm, over the round-off unit, below which a stall may also be due to round-off: laws that
are steep at small J amplify round-off of the positions in the stress."""
NOISE_DOMINATED_ROUNDINGS = 32.0
"""Roundings of the positions below which, for a residual as large as the forces, round-off dominates the residual."""
SINGLE_PRECISION_EPS = 1.0e-10
"""Round-off unit above which the precision is single."""
VELOCITY_ROUNDINGS = 1.0e4
"""Roundings of the velocities below which, in double precision, a change is their round-off."""
GROUP_ROUNDINGS = 8.0
"""Roundings of the positions below which, in double precision, the residual of one group of several is negligible."""
MAX_ERROR_ESTIMATES = 3
"""Maximum number of error estimates of a stalled iterate before the step is given up."""


@functools.cache
def convergence_functions(traits: Traits = NO_TERMS) -> KernelSet:
    """Device functions; traits used: "stored", "has_constraints", "unilateral" and "midpoint"."""
    Control = control_struct()

    @wp.func
    def potential_energy(ctl: Control, world: int) -> f64:
        """Strain energy, viscous potential, and those of terms, J."""
        energy = ctl.elem_sums[0, world] + ctl.elem_sums[1, world]
        if wp.static(traits.stored):
            energy += ctl.term_sums[0, world]
        return energy

    @wp.func
    def objective(ctl: Control, world: int) -> f64:
        """Phi of Eq. (18) at the trial, over dq/dv, with the quantities frozen during the line search.

        Phi = 1/2 (v - v~).M (v - v~) c_M - f_frozen.v + [Psi_el + Psi_visc + Psi_terms] / (dq/dv); its derivative by v
        is the residual, Eq. (17). Sums over a world: inertia and the frozen forces f_frozen (dead loads, and
        non-conservative forces at the start of the search) are slot_sums[Row.OBJECTIVE], of `residual`; Psi_el and
        Psi_visc, J, are elem_sums[0] and [1], of `internal_force`; Psi_terms, J, is term_sums[0]: of constraints
        lambda.c + rho/2 c.c, of contact its potential, of other terms their own. With the trait
        "midpoint" Phi does not exist: half of the squared D^-1 norm of the residual replaces it, infinite where
        Psi_terms is: a point went through an obstacle.
        """
        if wp.static(traits.midpoint):
            if wp.static(traits.stored):
                return wp.where(wp.isfinite(ctl.term_sums[0, world]), ctl.slot_sums[Row.OBJECTIVE, world], f64(wp.inf))
            return ctl.slot_sums[Row.OBJECTIVE, world]
        return ctl.slot_sums[Row.OBJECTIVE, world] + potential_energy(ctl, world) / ctl.dq_dv[world]

    @wp.func
    def objective_magnitude(ctl: Control, world: int) -> f64:
        """Sum of the magnitudes of the parts of Phi, in its unit; the round-off of Phi is a few eps of it."""
        energy = wp.abs(ctl.elem_sums[0, world]) + wp.abs(ctl.elem_sums[1, world])
        if wp.static(traits.stored):
            energy += ctl.term_sums[2, world]
        return ctl.slot_sums[Row.MAGNITUDE, world] + energy / ctl.dq_dv[world]

    @wp.func
    def allowed_violation(ctl: Control, world: int, tol: f64) -> f64:
        """Allowed violation, m; violation/(dq/dv)^2 is the error of the accelerations in the state.

        Only in the first iterations: far from the reference the round-off of positions prevents tighter values.
        """
        if (
            ctl.norms.constraint_acceleration_tol > f64(0.0)
            and tol < f64(1.0e200)
            and ctl.iterations[world] < TIGHT_CONSTRAINT_ITERATIONS
        ):
            tightened = ctl.norms.constraint_acceleration_tol * ctl.dq_dv[world] * ctl.dq_dv[world]
            return wp.min(tol, wp.max(tightened, ctl.norms.constraint_tol_min))
        return tol

    @wp.func
    def largest_violation(ctl: Control, world: int) -> f64:
        """Largest constraint violation over all components, m."""
        largest = f64(0.0)
        for c in range(ctl.norms.component_count):
            largest = wp.max(largest, ctl.norms.violation[world, c])
        return largest

    @wp.func
    def squared_group_norms(ctl: Control, world: int, group: int):
        """Squared norms of g, of the largest forces, and of the position round-off, of a residual group."""
        if ctl.norms.group_count == 1:
            f2 = wp.max(
                ctl.slot_sums[Row.INTERNAL, world],
                wp.max(ctl.slot_sums[Row.LOADS, world], ctl.slot_sums[Row.INERTIA, world]),
            )
            return wp.vec3d(ctl.slot_sums[Row.RESIDUAL, world], f2, ctl.slot_sums[Row.ROUNDOFF, world])
        f2 = wp.max(
            ctl.norms.group_sums[Row.INTERNAL, world, group],
            wp.max(ctl.norms.group_sums[Row.LOADS, world, group], ctl.norms.group_sums[Row.INERTIA, world, group]),
        )
        return wp.vec3d(
            ctl.norms.group_sums[Row.RESIDUAL, world, group],
            f2,
            ctl.norms.group_sums[GROUP_ROUNDOFF, world, group],
        )

    @wp.func
    def is_unsolved_unlike_stiffness(ctl: Control, world: int) -> bool:
        """True in float32 at a first iterate of motion where bodies have parts of unlike stiffness."""
        first = ctl.iterations[world] == 0 and ctl.is_static == 0
        return first and ctl.norms.group_count > ctl.norms.component_count and ctl.floor.eps > f64(SINGLE_PRECISION_EPS)

    @wp.func
    def component_sum(ctl: Control, world: int, group: int, row: int) -> f64:
        """Sum of a row of `group_sums` over the groups of a group's component."""
        total = f64(0.0)
        for other in range(ctl.norms.group_count):
            if ctl.norms.component_of_group[other] == ctl.norms.component_of_group[group]:
                total += ctl.norms.group_sums[row, world, other]
        return total

    @wp.func
    def is_group_roundoff(ctl: Control, world: int, group: int, norm: f64, rounding: f64) -> bool:
        """True in float64 if a group's residual is position round-off, and within the tolerance of all groups of its
        component: further iterations would not reduce it."""
        if (
            ctl.norms.group_count == ctl.norms.component_count
            or ctl.floor.eps > f64(SINGLE_PRECISION_EPS)
            or norm > f64(GROUP_ROUNDINGS) * rounding
        ):
            return False
        internal, loads = component_sum(ctl, world, group, Row.INTERNAL), component_sum(ctl, world, group, Row.LOADS)
        return norm <= ctl.norms.tol * wp.sqrt(
            wp.max(internal, wp.max(loads, component_sum(ctl, world, group, Row.INERTIA)))
        )

    @wp.func
    def evaluate_norms(ctl: Control, world: int):
        """Norms and acceptance of the current residual, separately for each residual group.

        The forces of one component or stiff material must not hide the residual of another; a component of the model
        whose groups have all converged is excluded from further solves.
        """
        force = wp.sqrt(ctl.slot_sums[Row.FORCE, world])
        ctl.norms.residual_force[world] = force
        largest = f64(0.0)
        worst = f64(0.0)
        excess = f64(0.0)
        floor_excess = f64(0.0)
        solve = f64(0.0)
        unconverged_tol = f64(1.0e300)
        for c in range(ctl.norms.component_count):
            ctl.norms.component_converged[world, c] = 1
        for group in range(ctl.norms.group_count):
            sums = squared_group_norms(ctl, world, group)
            g2 = sums[0]
            norm = wp.sqrt(g2)
            scale = wp.sqrt(sums[1])
            accepted_norm = ctl.norms.tol * scale
            if force > f64(0.0):
                # the force tolerance in this norm, by their ratio at this iterate
                accepted_norm = wp.max(accepted_norm, norm * (ctl.norms.force_tol / force))
            if ctl.start.is_extrapolated[world] != 0:
                accepted_norm = f64(EXTRAPOLATED_TOL_FACTOR) * accepted_norm
            elif is_unsolved_unlike_stiffness(ctl, world):
                accepted_norm = f64(UNSOLVED_TOL_FACTOR) * accepted_norm
            rounding = f64(2.0) * ctl.floor.eps * wp.sqrt(sums[2])
            if norm > accepted_norm and is_group_roundoff(ctl, world, group, norm, rounding):
                accepted_norm = norm
            unconverged = norm > accepted_norm
            if wp.static(traits.has_constraints):
                allowed = allowed_violation(ctl, world, ctl.norms.constraint_tol)
                violation = ctl.norms.violation[world, ctl.norms.component_of_group[group]]
                if violation > allowed:
                    unconverged = True
                    excess = wp.max(excess, violation / allowed)
                    floor_excess = f64(1.0e300)
            if unconverged:
                ctl.norms.component_converged[world, ctl.norms.component_of_group[group]] = 0
                solve += g2
                unconverged_tol = wp.min(unconverged_tol, accepted_norm)
                if ctl.norms.group_count > ctl.norms.component_count:
                    # forces between groups have the round-off of both
                    rounding = f64(2.0) * ctl.floor.eps * wp.sqrt(component_sum(ctl, world, group, GROUP_ROUNDOFF))
                if wp.static(traits.has_constraints):
                    if ctl.classical_multipliers != 0:  # the residual contains rho c: position round-off times kappa
                        rounding = rounding / (ctl.norms.penalty_norm_ratio * ctl.norms.penalty_norm_ratio)
                floor_excess = wp.max(floor_excess, norm / (rounding + f64(1.0e-300)))
            largest = wp.max(largest, norm / wp.max(scale, f64(1.0e-300)))
            worst = wp.max(worst, norm / wp.max(accepted_norm, f64(1.0e-300)))
        if wp.static(traits.has_constraints):
            ctl.norms.violation_ratio[world] = largest_violation(ctl, world) / allowed_violation(
                ctl, world, ctl.norms.constraint_tol
            )
        ctl.norms.residual_norm[world] = wp.sqrt(ctl.slot_sums[Row.RESIDUAL, world])
        ctl.norms.relative_residual[world] = largest
        ctl.norms.residual_ratio[world] = worst
        ctl.norms.ratio[world] = wp.max(excess, worst)
        ctl.floor.rounding_ratio[world] = floor_excess
        ctl.norms.unconverged_norm[world] = wp.sqrt(solve)
        ctl.norms.unconverged_tol[world] = unconverged_tol

    @wp.func
    def record_residual(ctl: Control, world: int):
        """Store the relative residual of the iterate, for messages."""
        k = ctl.iterations[world]
        if k < ctl.norms.residual_history.shape[1]:
            ctl.norms.residual_history[world, k] = ctl.norms.relative_residual[world]

    @wp.func
    def is_only_constraint_violated(ctl: Control, world: int) -> bool:
        """True if forces balance but constraints are violated: more iterations only raise the multipliers."""
        balanced = wp.max(ctl.norms.tol, wp.min(f64(1.0e3) * ctl.norms.tol, f64(1.0e-4)))
        return ctl.norms.relative_residual[world] <= balanced and ctl.norms.violation_ratio[world] > f64(1.0)

    @wp.func
    def accept_iterate(ctl: Control, world: int):
        """End the iteration with this iterate; with J <= 0 it is checked again."""
        ctl.active[world] = 0
        ctl.search.active[world] = 0
        if wp.static(traits.unilateral):
            ctl.frozen.penalty_factor[world] = f64(1.0)
        if ctl.refuse_inversion != 0 and ctl.min_J[world] <= f64(0.0):
            ctl.inversion_suspected[world] = 1
            wp.atomic_max(ctl.any_rare_branch, 0, 1)

    @wp.func
    def request_error_estimate(ctl: Control, world: int):
        """Request an error estimate from the next solve, see `check_rounding_floor`."""
        ctl.floor.estimate_error[world] = 1
        wp.atomic_max(ctl.floor.any_estimate_error, 0, 1)
        ctl.solve.predicted_stress[world] = 0

    @wp.func
    def iteration_factor(ctl: Control, world: int) -> int:
        """Factor on `max_iterations` of an attempt: larger for a start far from the solution, with a continuation, or
        after negative curvature with a law that has its own tangent, since shorter steps meet it again."""
        far = wp.max(
            ctl.start.has_alternatives[world], ctl.solve.met_negative_curvature[world] * (1 - ctl.linear_stress)
        )
        if wp.static(traits.unilateral):
            far = wp.max(far, ctl.frozen.continued[world])
        return 1 + EXTRA_ITERATION_FACTOR * far

    @wp.func
    def give_up(ctl: Control, world: int, why: int):
        """End without convergence, with the failure code `why`.

        A residual as large as the forces but below `NOISE_DOMINATED_ROUNDINGS` roundings is reported as round-off in
        single-precision statics, whatever the failure: a smaller load has smaller forces with the same noise.
        """
        ctl.active[world] = 0
        ctl.search.active[world] = 0
        ctl.failed[world] = why
        if wp.static(traits.unilateral):
            ctl.frozen.penalty_factor[world] = f64(1.0)
        stuck = why == Failure.ITERATIONS or why == Failure.LINE_SEARCH or why == Failure.CURVATURE
        drowned = ctl.floor.rounding_ratio[world] <= f64(NOISE_DOMINATED_ROUNDINGS)
        drowned = drowned and ctl.norms.relative_residual[world] > f64(0.5)
        if (
            stuck
            and drowned
            and ctl.floor.eps > f64(SINGLE_PRECISION_EPS)
            and ctl.iterations[world] > 0
            and ctl.is_static != 0
        ):
            ctl.failed[world] = Failure.ROUNDOFF
        if wp.static(traits.has_constraints):
            if why != Failure.NAN and why != Failure.JACOBIAN and is_only_constraint_violated(ctl, world):
                ctl.failed[world] = Failure.CONSTRAINT

    @wp.func
    def is_velocity_roundoff(ctl: Control, world: int) -> bool:
        """True in float64 if the last step changes velocities by their round-off: what a moving body vibrates by, or
        the forces of its gaps, may be no more than the round-off of its positions."""
        fine = f64(VELOCITY_ROUNDINGS) * ctl.floor.eps
        step = wp.abs(ctl.search.slope[world])
        return ctl.floor.eps < f64(SINGLE_PRECISION_EPS) and step <= fine * fine * ctl.slot_sums[Row.KINETIC, world]

    @wp.func
    def is_far_below_rounding(ctl: Control, world: int) -> bool:
        """True in motion with constraints if the residual is a thousandth of a rounding of the positions, which moves
        none; sets the error, relative to positions, in the D norm."""
        if wp.static(traits.has_constraints and not traits.unilateral):
            ratio = ctl.floor.rounding_ratio[world]
            if f64(STALL_ROUNDINGS) * ratio <= f64(1.0) and ctl.iterations[world] > 0 and ctl.is_static == 0:
                ctl.floor.error[world] = wp.max(ctl.floor.error[world], f64(2.0) * ctl.floor.eps * ratio)
                return True
        return False

    @wp.func
    def check_convergence(ctl: Control, world: int):
        """End the iteration if it has converged or used up its iterations; if it stalls within round-off, request an
        error estimate."""
        record_residual(ctl, world)
        # predicted energy change of the last step, relative to the energy
        energy = f64(2.0) * wp.abs(ctl.elem_sums[0, world]) + ctl.dq_dv[world] * ctl.slot_sums[Row.MAGNITUDE, world]
        step = wp.abs(ctl.search.slope[world]) * ctl.dq_dv[world]
        most = f64(MAX_STALL_STEP) * ctl.floor.max_error
        limit = ctl.max_iterations * iteration_factor(ctl, world)
        settling = step <= most * most * energy or ctl.iterations[world] + 1 >= limit
        alike = f64(STALL_ENERGY_ROUNDINGS) * ctl.floor.eps
        near = ctl.floor.rounding_ratio[world] <= f64(STALL_ROUNDINGS)
        if wp.static(not traits.midpoint):  # g.p: no energy
            if not near and ctl.floor.rounding_ratio[world] < f64(1.0e300):
                near = step <= alike * alike * energy
        if is_velocity_roundoff(ctl, world):
            near = True
            settling = True
        if wp.static(traits.has_constraints):  # a part at rest on another, or in free flight, has no energy to compare
            bare = ctl.is_static == 0
            if wp.static(traits.unilateral):
                bare = ctl.floor.eps < f64(SINGLE_PRECISION_EPS)
            settling = settling or (bare and ctl.floor.rounding_ratio[world] <= f64(1.0))
        near = near and ctl.floor.estimates[world] < MAX_ERROR_ESTIMATES
        still = ctl.norms.residual_reduction[world] > f64(STALL_RATIO) and ctl.solve.operator_reused[world] == 0
        done = ctl.norms.ratio[world] <= f64(1.0)
        if not done:
            done = is_far_below_rounding(ctl, world)
        if done:
            accept_iterate(ctl, world)
        elif near and ctl.iterations[world] > 0 and still and settling:
            request_error_estimate(ctl, world)
        elif ctl.iterations[world] >= limit:
            give_up(ctl, world, Failure.ITERATIONS)

    @wp.func
    def handle_failed_search(ctl: Control, world: int, why: int):
        """Failed search: if round-off may explain it, keep the iterate and request an error estimate, else give up."""
        at_roundoff = ctl.floor.rounding_ratio[world] <= f64(STALL_ROUNDINGS) or is_velocity_roundoff(ctl, world)
        near = at_roundoff and ctl.floor.estimates[world] < MAX_ERROR_ESTIMATES
        if wp.static(traits.unilateral):
            near = near and ctl.frozen.penalty_factor[world] == f64(1.0)
        at_roundoff = at_roundoff or ctl.floor.eps > f64(SINGLE_PRECISION_EPS)
        enough = False
        if wp.static(traits.has_constraints):  # only accelerations need the tighter tolerance, which round-off prevents
            if ctl.norms.constraint_acceleration_tol > f64(0.0) and ctl.norms.relative_residual[world] <= ctl.norms.tol:
                enough = largest_violation(ctl, world) <= ctl.norms.constraint_tol
        if enough and (why == Failure.LINE_SEARCH or why == Failure.CURVATURE):
            accept_iterate(ctl, world)
        elif near and (why == Failure.LINE_SEARCH or why == Failure.CURVATURE):
            request_error_estimate(ctl, world)
            ctl.search.alpha[world] = f64(0.0)
        elif (
            (why == Failure.LINE_SEARCH or why == Failure.CURVATURE)
            and at_roundoff
            and ctl.floor.error_estimate[world] < f64(1.0e30)
        ):
            give_up(ctl, world, Failure.ROUNDOFF)
        else:
            give_up(ctl, world, why)

    return kernel_set(locals())
