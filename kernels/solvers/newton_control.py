"""Newton control data of each world, and failure codes."""

import functools

import warp as wp

__all__ = [
    "FAIL_CONSTRAINT",
    "FAIL_CURVATURE",
    "FAIL_ELEMENT_INVERTED",
    "FAIL_ENERGY_GROWTH",
    "FAIL_ITERATIONS",
    "FAIL_JACOBIAN",
    "FAIL_LINE_SEARCH",
    "FAIL_LOCAL_ERROR",
    "FAIL_NAN",
    "FAIL_RESIDUAL_GROWTH",
    "FAIL_ROUNDOFF",
    "FAIL_STEP_LIMIT",
    "FAIL_WORK",
    "FLOOR_LANES",
    "FLOOR_ROWS",
    "GROUP_LANES",
    "GROUP_ROUNDOFF",
    "GROUP_ROWS",
    "GROUP_STRAIN_ENERGY",
    "ROW_FORCE",
    "ROW_FROZEN_CHANGE",
    "ROW_INERTIA",
    "ROW_INTERNAL",
    "ROW_KINETIC",
    "ROW_LOADS",
    "ROW_MAGNITUDE",
    "ROW_OBJECTIVE",
    "ROW_RESIDUAL",
    "ROW_ROUNDOFF",
    "ROW_SLOPE",
    "TERM_ROWS",
    "control_struct",
]

# codes in NewtonControl.failed; messages: warpfea/simulation/failures.py
FAIL_ITERATIONS = 1
FAIL_LINE_SEARCH = 2
FAIL_JACOBIAN = 3
FAIL_NAN = 4
FAIL_CURVATURE = 5
FAIL_CONSTRAINT = 6
FAIL_RESIDUAL_GROWTH = 7
FAIL_STEP_LIMIT = 8
FAIL_ROUNDOFF = 9
FAIL_ELEMENT_INVERTED = 10
FAIL_WORK = 11
FAIL_LOCAL_ERROR = 12
FAIL_ENERGY_GROWTH = 13

(
    ROW_RESIDUAL, ROW_INTERNAL, ROW_LOADS, ROW_INERTIA, ROW_OBJECTIVE, ROW_MAGNITUDE, ROW_SLOPE, ROW_FROZEN_CHANGE,
    ROW_ROUNDOFF, ROW_FORCE, ROW_KINETIC,
) = range(11)  # fmt: skip
"""Rows of a residual's sums, RESIDUAL_ROWS of kernels/step/gather.py."""
GROUP_ROWS = 6  # squared norms of g, f_int, loads, inertia (the ROW_ constants), of the round-off; strain energy
GROUP_ROUNDOFF, GROUP_STRAIN_ENERGY = 4, 5
FLOOR_ROWS = 6  # -g.p, inertia.(v - v~), strain energy, largest |p|, |u| and |v|
GROUP_LANES, FLOOR_LANES = 32, 16
"""Partial sums per residual group, and per part of an error estimate; fixed: the same for any number of worlds."""
TERM_ROWS = 3
"""Rows summed per world over terms with stored energy: the potential with the quantities frozen in a line search
(multipliers, friction limits), the potential with their next values, and its magnitude."""


@functools.cache
def control_struct():
    """Newton control data of each world."""

    @wp.struct
    class NewtonControl:
        active: wp.array(dtype=wp.int32)  # iterating
        searching: wp.array(dtype=wp.int32)  # in a line search
        failed: wp.array(dtype=wp.int32)  # 0 or a FAIL_ code
        iterations: wp.array(dtype=wp.int32)  # of this attempt
        search_trials: wp.array(dtype=wp.int32)  # rejected trials of this line search
        doublings: wp.array(dtype=wp.int32)  # doublings of the step along a concave Phi; -1: exhausted
        step_iterations: wp.array(dtype=wp.int32)  # of this step
        alpha: wp.array(dtype=wp.float64)  # step length
        phi: wp.array(dtype=wp.float64)  # objective of the line search at the iterate, N m/s
        phi_magnitude: wp.array(dtype=wp.float64)  # sum of the magnitudes of its parts
        slope: wp.array(dtype=wp.float64)  # g.p at the iterate
        residual_norm: wp.array(dtype=wp.float64)  # |g| in the D^-1 norm
        relative_residual: wp.array(dtype=wp.float64)  # |g| over the largest force, of the worst group
        convergence_ratio: wp.array(dtype=wp.float64)  # largest norm over accepted norm, constraint violations included
        rounding_ratio: wp.array(dtype=wp.float64)  # residual over that of rounded positions
        unconverged_norm: wp.array(dtype=wp.float64)  # |g| of the unconverged groups
        unconverged_tol: wp.array(dtype=wp.float64)  # smallest accepted norm among them
        group_sums: wp.array3d(dtype=wp.float64)  # [GROUP_ROWS, world, residual group]; if there are several
        component_of_group: wp.array(dtype=wp.int32)  # [residual group]
        residual_ratio: wp.array(dtype=wp.float64)  # largest norm over accepted norm of the groups, without constraints
        component_converged: wp.array2d(dtype=wp.int32)  # [world, component] converged
        residual_reduction: wp.array(dtype=wp.float64)  # norm of the residual over that of the previous iterate
        forcing: wp.array(dtype=wp.float64)  # Eisenstat-Walker eta
        extrapolated_start: wp.array(dtype=wp.int32)  # 1: the first iterate is extrapolated, and not yet solved for
        operator_reused: wp.array(dtype=wp.int32)  # 1: the operator is of an earlier iterate; 2: and its search failed
        min_J: wp.array(dtype=wp.float64)  # smallest J of all elements
        domain_J: wp.array(dtype=wp.float64)  # smallest J of the laws that need J > 0
        residual_history: wp.array2d(dtype=wp.float64)  # [world, iteration] relative residual
        slot_sums: wp.array2d(dtype=wp.float64)  # [RESIDUAL_ROWS of kernels/step/gather.py, world]
        elem_sums: wp.array2d(dtype=wp.float64)  # [2, world] strain energy, viscous potential, J
        slope_sum: wp.array2d(dtype=wp.float64)  # [1, world] g.p
        tangent_sum: wp.array2d(dtype=wp.float64)  # [1, world] p.K p of the non-conservative forces, else 0
        dq_dv: wp.array(dtype=wp.float64)  # derivative of positions by velocities in a step, s
        violation: wp.array2d(dtype=wp.float64)  # [world, component] largest |c|, m; with constraints
        term_sums: wp.array2d(dtype=wp.float64)  # [TERM_ROWS, world], with terms that have a potential of their own
        limit: wp.array(dtype=wp.float64)  # largest step along the direction; with terms that limit steps
        trial_accepted: wp.array(dtype=wp.int32)  # the trial was accepted
        multiplier_updates: wp.array(dtype=wp.int32)  # of this step
        constraint_tol: wp.float64  # m
        constraint_acceleration_tol: (
            wp.float64
        )  # m/s^2: tolerance also this times (dq/dv)^2, at least `constraint_tol_min`; 0: off
        constraint_tol_min: wp.float64  # m
        violation_ratio: wp.array(dtype=wp.float64)  # largest violation over its tolerance; with constraints
        penalty_norm_ratio: wp.float64  # norm of PCG over the norm of the convergence test, across constraints
        classical_multipliers: wp.int32  # 1: multipliers change only in an outer loop
        residual_force: wp.array(dtype=wp.float64)  # |g| over the free components, N
        force_tol: wp.float64  # N; absolute tolerance of the force; 0: off
        first_forcing: wp.float64  # forcing term of the first solve
        fixed_forcing: wp.int32  # 1: all solves use the first forcing term
        tol: wp.float64  # relative tolerance of the residual
        eps: wp.float64  # round-off unit of the vectors
        any_rare_branch: wp.array(dtype=wp.int32)  # 1 if any world needs a rare branch: any of the flags below
        # nonmonotone steps, see kernels/solvers/line_search.py
        nonmonotone_steps: wp.array(dtype=wp.int32)  # nonmonotone steps since the best iterate
        predicted_stress: wp.array(dtype=wp.int32)  # 1: H has the predicted stress; 2: positive semi-definite
        nonmonotone_trial: wp.array(
            dtype=wp.int32
        )  # 1: a nonmonotone trial is requested, its length is due; 2: the trial is one
        direction_gradient: wp.array(dtype=wp.float64)  # largest gradient of the direction
        trust_radius: wp.array(
            dtype=wp.float64
        )  # trust radius: largest rotation or stretch of an element in such a step
        require_armijo: wp.array(dtype=wp.int32)  # the next step must satisfy Armijo
        store_best: wp.array(dtype=wp.int32)  # store the base of the last step as the best iterate
        restore_best: wp.array(dtype=wp.int32)  # the trial is the best iterate
        best_phi: wp.array(dtype=wp.float64)  # phi and residual norm of the best iterate
        best_norm: wp.array(dtype=wp.float64)
        frozen_updated: wp.array(dtype=wp.int32)  # frozen quantities of terms were updated; with unilateral forces
        partly_updated: wp.array(
            dtype=wp.int32
        )  # they were updated only partly: the residual is not that of the iterate
        contact_active: wp.array(dtype=wp.int32)  # unilateral forces act at the iterate
        penetrating_steps: wp.array(dtype=wp.int32)  # nonmonotone steps into obstacles in this attempt
        bracket_low: wp.array(dtype=wp.vec2d)  # bracket: step length where Phi falls, and its slope there
        bracket_high: wp.array(dtype=wp.vec2d)  # bracket: step length beyond which Phi rises; with unilateral forces
        unilateral_changed: wp.array(dtype=wp.int32)  # the updated quantities may activate unilateral forces again
        # round-off floor of the residual
        estimate_error: wp.array(dtype=wp.int32)  # 1: the next solve estimates the error; 2: done
        any_estimate_error: wp.array(dtype=wp.int32)  # 1 if any world's next solve does
        linear_solves: wp.array(dtype=wp.int32)  # linear solves of this attempt
        error_estimates: wp.array(dtype=wp.int32)  # their number in this attempt
        error_estimate: wp.array(dtype=wp.float64)  # error estimate relative to the solution, of the last such solve
        last_error_estimate: wp.array(dtype=wp.float64)
        floor_error: wp.array(dtype=wp.float64)  # error estimate of a residual accepted at its round-off floor; 0: none
        max_floor_error: wp.float64  # largest acceptable error estimate
        floor_sums: wp.array4d(dtype=wp.float64)  # [FLOOR_ROWS, world, part, lane]
        negative_curvature: wp.array(dtype=wp.int32)  # the last solve met a direction without positive curvature
        pcg_unconverged: wp.array(dtype=wp.int32)  # the last solve for a step ended at `max_iterations`
        # the first iterate
        met_negative_curvature: wp.array(dtype=wp.int32)  # a solve of this attempt met negative curvature
        strain_energy: wp.array(dtype=wp.float64)  # strain energy of the state, J
        strain_energy_start: wp.array(dtype=wp.float64)  # of the state that the step began from, J
        step_floor_error: wp.array(dtype=wp.float64)  # the largest `floor_error` of the accepted substeps
        choose_first_iterate: wp.array(dtype=wp.int32)  # 1: among alternatives
        inversion_suspected: wp.array(dtype=wp.int32)  # the accepted iterate has J <= 0 somewhere
        inverted: wp.array(dtype=wp.int32)  # it inverted an element
        refuse_inversion: wp.int32  # 1: an iterate that inverts an element fails
        linear_stress: wp.int32  # all stresses are linear in the Green-Lagrange strain
        accepted_unconverged: wp.array(dtype=wp.int32)  # a substep of this step was accepted short of the tolerance
        max_iterations: wp.int32  # Newton iterations of an attempt
        component_count: wp.int32  # connected components of the model
        group_count: wp.int32  # residual groups: components, subdivided by materials of similar stiffness
        has_nonpotential: wp.int32  # 1: forces without a potential act
        is_static: wp.int32
        model_size: wp.float64  # m

    return NewtonControl
