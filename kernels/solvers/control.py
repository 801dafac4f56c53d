"""What Newton's method knows of each world, and why it may fail."""

import functools

import warp as wp

__all__ = [
    "FAIL_CONSTRAINT",
    "FAIL_CURVATURE",
    "FAIL_ENERGY",
    "FAIL_ERROR",
    "FAIL_FLOOR",
    "FAIL_GROWTH",
    "FAIL_INVERTED",
    "FAIL_ITERATIONS",
    "FAIL_JACOBIAN",
    "FAIL_LIMIT",
    "FAIL_LINE_SEARCH",
    "FAIL_NAN",
    "FAIL_WORK",
    "FLOOR_LANES",
    "FLOOR_ROWS",
    "GROUP_ROWS",
    "LANES",
    "TERM_ROWS",
    "control_struct",
]

FAIL_ITERATIONS = 1
FAIL_LINE_SEARCH = 2
FAIL_JACOBIAN = 3
FAIL_NAN = 4
FAIL_CURVATURE = 5
FAIL_CONSTRAINT = 6
FAIL_GROWTH = 7
FAIL_LIMIT = 8
FAIL_FLOOR = 9
FAIL_INVERTED = 10
FAIL_WORK = 11
FAIL_ERROR = 12
FAIL_ENERGY = 13

GROUP_ROWS = 6  # squared norms of g, f_int, loads, inertia, rounding; strain energy
FLOOR_ROWS = 6  # -g.p, inertia.(v - v~), strain energy, largest |p|, |u| and |v|
LANES, FLOOR_LANES = 32, 16
TERM_ROWS = 3
"""Rows summed per world of what terms store: the potential with what is held in a line search (multipliers, caps), the
potential with what they would hold next, and its magnitude."""


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
        grown: wp.array(dtype=wp.int32)  # doublings of the step along a concave Phi; -1: no more
        total_iterations: wp.array(dtype=wp.int32)  # of this step
        alpha: wp.array(dtype=wp.float64)
        phi: wp.array(dtype=wp.float64)
        phi_magnitude: wp.array(dtype=wp.float64)
        slope: wp.array(dtype=wp.float64)  # g.p at the iterate
        norm: wp.array(dtype=wp.float64)  # |g| in the D^-1 norm
        relative: wp.array(dtype=wp.float64)  # |g| over the largest force, of the worst group
        excess: wp.array(dtype=wp.float64)  # the same over what is accepted, violations of constraints as well
        floor_excess: wp.array(dtype=wp.float64)  # the same over what rounding of positions alone may cause
        solve_norm: wp.array(dtype=wp.float64)  # |g| of the groups that are not converged
        solve_accept: wp.array(dtype=wp.float64)  # smallest accepted norm among them
        group_sums: wp.array3d(dtype=wp.float64)  # [GROUP_ROWS, world, residual group], with several groups
        component_of_group: wp.array(dtype=wp.int32)  # [residual group]
        worst: wp.array(dtype=wp.float64)  # largest norm over accepted norm of the groups, constraints not counted
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
        tangent_sum: wp.array2d(dtype=wp.float64)  # p.K p of the forces without a potential, 0 without
        dq_dv: wp.array(dtype=wp.float64)
        violation: wp.array2d(dtype=wp.float64)  # [world, component] largest |c|, m; with constraints
        term_sums: wp.array2d(dtype=wp.float64)  # [TERM_ROWS, world], with terms that have a potential of their own
        limit: wp.array(dtype=wp.float64)  # largest step along the direction; with terms that limit it
        stepped: wp.array(dtype=wp.int32)  # the trial was accepted
        outer: wp.array(dtype=wp.int32)  # multiplier updates of this step
        constraint_tol: wp.float64  # m
        constraint_pace: wp.float64  # m/s^2: it also is this times (dq/dv)^2, but not below `constraint_least`; 0: not
        constraint_least: wp.float64  # m
        open: wp.array(dtype=wp.float64)  # largest violation over its tolerance; with constraints
        slack: wp.float64  # norm of PCG over the norm that is judged, across constraints
        classical: wp.int32  # multipliers change in an outer loop
        force: wp.array(dtype=wp.float64)  # |g| over the free components, N
        force_tol: wp.float64  # N; accepted without regard to the size of the forces; 0: never
        first_forcing: wp.float64
        fixed_forcing: wp.int32  # all solves go as far as the first, whatever Newton's method needs
        tol: wp.float64
        eps: wp.float64
        any_hard: wp.array(dtype=wp.int32)  # a world needs what most steps do not: any of the flags below
        # where full steps are taken although Phi rises, see judging.py
        leaps: wp.array(dtype=wp.int32)  # such steps since the best iterate
        mixed: wp.array(dtype=wp.int32)  # H has the stress of the linear prediction
        wish: wp.array(dtype=wp.int32)  # 1: such a step is wanted, how long may it be? 2: the trial is one
        turn: wp.array(dtype=wp.float64)  # largest gradient of the direction
        radius: wp.array(dtype=wp.float64)  # most that such a step may turn or stretch an element
        tame: wp.array(dtype=wp.int32)  # the next step must satisfy Armijo
        mark: wp.array(dtype=wp.int32)  # the base of the last step is the best iterate
        restoring: wp.array(dtype=wp.int32)  # the trial is the best iterate
        best_phi: wp.array(dtype=wp.float64)
        best_norm: wp.array(dtype=wp.float64)
        refreshed: wp.array(dtype=wp.int32)  # terms have taken anew what they hold; with walls
        unsettled: wp.array(dtype=wp.int32)  # they have taken but a part of it: the residual is not that of the iterate
        touching: wp.array(dtype=wp.int32)  # they act at the iterate
        excursions: wp.array(dtype=wp.int32)  # leaps into obstacles of this attempt
        lower: wp.array(dtype=wp.vec2d)  # a length of the search where Phi falls, and its slope there
        upper: wp.array(dtype=wp.vec2d)  # one beyond which Phi rises; with walls
        new_walls: wp.array(dtype=wp.int32)  # what they hold now may set in suddenly again
        # where rounding stops the residual
        strict: wp.array(dtype=wp.int32)  # the next solve tells the error that is left; 2: it has been done
        any_strict: wp.array(dtype=wp.int32)  # a world's next solve does
        rounds: wp.array(dtype=wp.int32)  # linear solves of this attempt
        strict_count: wp.array(dtype=wp.int32)
        eta: wp.array(dtype=wp.float64)  # that error, over the size of the solution; of the last such solve
        last_eta: wp.array(dtype=wp.float64)
        floor: wp.array(dtype=wp.float64)  # the eta that was accepted in this attempt, 0: none
        floor_bound: wp.float64  # largest that is
        floor_sums: wp.array4d(dtype=wp.float64)  # [FLOOR_ROWS, world, residual part, lane]
        negative: wp.array(dtype=wp.int32)  # the last solve met a direction without positive curvature
        unsolved: wp.array(dtype=wp.int32)  # the last solve for a step ended at `max_iterations`
        # the first iterate
        bent: wp.array(dtype=wp.int32)  # a solve of this attempt did
        potential: wp.array(dtype=wp.float64)  # strain energy of the state, J
        potential_start: wp.array(dtype=wp.float64)  # of the state that the step began from
        step_floor: wp.array(dtype=wp.float64)  # the largest floor of the accepted substeps
        choose: wp.array(dtype=wp.int32)  # it is to be chosen among others
        suspect: wp.array(dtype=wp.int32)  # the accepted iterate has J <= 0 somewhere
        turned: wp.array(dtype=wp.int32)  # it turned an element inside out
        refuse_inversion: wp.int32
        linear_stress: wp.int32  # all stresses are linear in the Green-Lagrange strain
        rough: wp.array(dtype=wp.int32)  # a substep of this step was accepted short of the tolerance
        max_iterations: wp.int32
        components: wp.int32
        groups: wp.int32  # components, and materials of like stiffness in each
        nonpotential: wp.int32
        equilibrium: wp.int32  # statics
        length: wp.float64  # of the model, m

    return NewtonControl
