"""Newton control data of each world, and failure codes."""

import enum
import functools

import warp as wp

from ..common.types import double_1d, double_2d, int_1d

__all__ = [
    "FLOOR_LANES", "FLOOR_ROWS", "GROUP_LANES", "GROUP_ROUNDOFF", "GROUP_ROWS", "TERM_ROWS", "Failure", "Row",
    "control_struct",
]  # fmt: skip


class Failure(enum.IntEnum):
    """Codes in NewtonControl.failed; messages: warpfea/simulation/failures.py."""

    ITERATIONS = 1
    LINE_SEARCH = 2
    JACOBIAN = 3
    NAN = 4
    CURVATURE = 5
    CONSTRAINT = 6
    RESIDUAL_GROWTH = 7
    STEP_LIMIT = 8
    ROUNDOFF = 9
    ELEMENT_INVERTED = 10
    WORK = 11
    LOCAL_ERROR = 12
    ENERGY_GROWTH = 13


class Row(enum.IntEnum):
    """Rows of a residual's sums, RESIDUAL_ROWS of kernels/step/gather.py."""

    RESIDUAL = 0
    INTERNAL = 1
    LOADS = 2
    INERTIA = 3
    OBJECTIVE = 4
    MAGNITUDE = 5
    SLOPE = 6
    FROZEN_CHANGE = 7
    ROUNDOFF = 8
    FORCE = 9
    KINETIC = 10


GROUP_ROWS, GROUP_ROUNDOFF = 5, 4  # squared norms of g, f_int, loads, inertia (see `Row`), of the round-off
FLOOR_ROWS = 5  # -g.p, inertia.(v - v~), strain energy, largest |p| and |u|
GROUP_LANES, FLOOR_LANES = 32, 16
"""Partial sums per residual group, and per part of an error estimate; fixed: the same for any number of worlds."""
TERM_ROWS = 3
"""Rows summed per world over terms with stored energy: the potential with the quantities frozen in a line search
(multipliers, friction limits), the potential with their next values, and its magnitude."""


@functools.cache
def control_struct():
    """Newton control data of each world: of the iteration, and one struct for each of its concerns."""
    d1, d2, i1 = double_1d, double_2d, int_1d

    @wp.struct
    class LineSearch:
        active: i1  # in a line search
        alpha: d1  # step length
        phi: d1  # objective of the line search at the iterate, N m/s
        phi_magnitude: d1  # sum of the magnitudes of its parts
        slope: d1  # g.p at the iterate
        slope_sum: d2  # [1, world] g.p
        tangent_sum: d2  # [1, world] p.K p of the non-conservative forces, else 0
        trials: i1  # rejected trials of this search
        doublings: i1  # doublings of the step along a concave Phi; -1: exhausted
        trial_accepted: i1  # the trial was accepted
        limit: d1  # largest step along the direction; with terms that limit steps
        bracket_low: wp.array(dtype=wp.vec2d)  # bracket: step length where Phi falls, and its slope there
        bracket_high: wp.array(dtype=wp.vec2d)  # bracket: step length beyond which Phi rises; with unilateral forces

    @wp.struct
    class Convergence:
        tol: wp.float64  # relative tolerance of the residual
        force_tol: wp.float64  # N; absolute tolerance of the force; 0: off
        constraint_tol: wp.float64  # m
        constraint_tol_min: wp.float64  # m
        # m/s^2: tolerance also this times (dq/dv)^2, at least `constraint_tol_min`; 0: off
        constraint_acceleration_tol: wp.float64
        penalty_norm_ratio: wp.float64  # norm of PCG over the norm of the convergence test, across constraints
        component_count: wp.int32  # connected components of the model
        group_count: wp.int32  # residual groups: components, subdivided by materials of similar stiffness
        component_of_group: i1  # [residual group]
        residual_norm: d1  # |g| in the D^-1 norm
        residual_force: d1  # |g| over the free components, N
        relative_residual: d1  # |g| over the largest force, of the worst group
        residual_ratio: d1  # largest norm over accepted norm of the groups, without constraints
        ratio: d1  # largest norm over accepted norm, constraint violations included
        residual_reduction: d1  # norm of the residual over that of the previous iterate
        unconverged_norm: d1  # |g| of the unconverged groups
        unconverged_tol: d1  # smallest accepted norm among them
        group_sums: wp.array3d(dtype=wp.float64)  # [GROUP_ROWS, world, residual group]; if there are several
        component_converged: wp.array2d(dtype=wp.int32)  # [world, component] converged
        violation: d2  # [world, component, and one more] `Multipliers.violation`; with constraints
        violation_ratio: d1  # largest violation over its tolerance; with constraints
        residual_history: d2  # [world, iteration] relative residual

    @wp.struct
    class RoundingFloor:
        eps: wp.float64  # round-off unit of the vectors
        max_error: wp.float64  # largest acceptable error estimate
        rounding_ratio: d1  # residual over that of rounded positions
        estimate_error: i1  # 1: the next solve estimates the error; 2: done
        any_estimate_error: i1  # 1 if any world's next solve does
        estimates: i1  # error estimates in this attempt
        error_estimate: d1  # error estimate relative to the solution, of the last such solve
        last_error_estimate: d1
        error: d1  # error estimate of a residual accepted at its round-off floor; 0: none
        step_error: d1  # the largest `error` of the accepted substeps
        sums: wp.array4d(dtype=wp.float64)  # [FLOOR_ROWS, world, part, lane]
        accepted_unconverged: i1  # a substep of this step was accepted short of the tolerance

    @wp.struct
    class FirstIterate:
        has_alternatives: i1  # 1: choose among alternatives
        is_extrapolated: i1  # 1: the first iterate is extrapolated, and not yet solved for

    @wp.struct
    class NonmonotoneSteps:  # the globalisation, see kernels/solvers/line_search.py
        steps: i1  # nonmonotone steps since the best iterate
        trial: i1  # 1: a nonmonotone trial is requested, its length is due; 2: the trial is one
        direction_gradient: d1  # largest gradient of the direction
        trust_radius: d1  # trust radius: largest rotation or stretch of an element in such a step
        require_armijo: i1  # the next step must satisfy Armijo
        store_best: i1  # store the base of the last step as the best iterate
        restore_best: i1  # the trial is the best iterate
        best_phi: d1  # phi and residual norm of the best iterate
        best_norm: d1
        penetrating_steps: i1  # nonmonotone steps into obstacles in this attempt

    @wp.struct
    class LinearSolve:
        forcing: d1  # Eisenstat-Walker eta
        first_forcing: wp.float64  # forcing term of the first solve
        fixed_forcing: wp.int32  # 1: all solves use the first forcing term
        operator_reused: i1  # 1: the operator is of an earlier iterate; 2: and its search failed
        predicted_stress: i1  # 1: H has the predicted stress; 2: positive semi-definite
        count: i1  # linear solves of this attempt
        negative_curvature: i1  # the last solve met a direction without positive curvature
        met_negative_curvature: i1  # a solve of this attempt did
        pcg_unconverged: i1  # the last solve for a step ended at `max_iterations`
        stalled_solves: i1  # successive solves that did and whose steps did not halve the residual
        max_stalled_solves: wp.int32  # of them, in single precision, after which round-off is told; 0: any number

    @wp.struct
    class FrozenQuantities:  # quantities of terms that a line search freezes; with unilateral forces
        updated: i1  # they were updated
        partly_updated: i1  # they were updated only partly: the residual is not that of the iterate
        contact_active: i1  # unilateral forces act at the iterate
        unilateral_changed: i1  # the updated quantities may activate unilateral forces again
        penalty_factor: d1  # factor on the stiffness of contact, below 1 during a continuation
        continued: i1  # a continuation has begun in this attempt
        update_due: i1  # they are updated next

    @wp.struct
    class NewtonControl:
        search: LineSearch
        norms: Convergence
        floor: RoundingFloor
        start: FirstIterate
        nonmonotone: NonmonotoneSteps
        solve: LinearSolve
        frozen: FrozenQuantities
        active: i1  # iterating
        failed: i1  # 0 or a `Failure`
        iterations: i1  # of this attempt
        step_iterations: i1  # of this step
        max_iterations: wp.int32  # of an attempt
        multiplier_updates: i1  # of this step
        classical_multipliers: wp.int32  # 1: multipliers change only in an outer loop
        slot_sums: d2  # [RESIDUAL_ROWS of kernels/step/gather.py, world]
        elem_sums: d2  # [2, world] strain energy, viscous potential, J
        term_sums: d2  # [TERM_ROWS, world], with terms that have a potential of their own
        dq_dv: d1  # derivative of positions by velocities in a step, s
        min_J: d1  # smallest J of all elements
        domain_J: d1  # smallest J of the laws that need J > 0
        inversion_suspected: i1  # the accepted iterate has J <= 0 somewhere
        inverted: i1  # it inverted an element
        refuse_inversion: wp.int32  # 1: an iterate that inverts an element fails
        any_rare_branch: i1  # 1 if any world needs a rare branch: any of the flags in `_run_rare_branch`
        strain_energy: d1  # strain energy of the state, J
        strain_energy_start: d1  # of the state that the step began from, J
        linear_stress: wp.int32  # all stresses are linear in the Green-Lagrange strain
        has_nonpotential: wp.int32  # 1: forces without a potential act
        is_static: wp.int32
        model_size: wp.float64  # m

    return NewtonControl
