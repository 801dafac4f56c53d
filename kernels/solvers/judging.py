"""How an iterate of Newton's method is judged: Phi, norms, convergence, failure. Functions of one world."""

import functools
import types as _types

import warp as wp

from ..common.traits import NO_TERMS, Traits
from .control import (
    FAIL_CONSTRAINT,
    FAIL_CURVATURE,
    FAIL_FLOOR,
    FAIL_ITERATIONS,
    FAIL_JACOBIAN,
    FAIL_LINE_SEARCH,
    FAIL_NAN,
    control_struct,
)

__all__ = ["COARSE", "SWIFT", "TRIES", "judging_functions"]

FLOOR = 16.0
PREDICTED = 1.0e-3
STALLED = 0.5
"""A reduction of the residual that is no better than this is none."""
CLOSING = 4
"""Iterations in which constraints are closed to what accelerations need, where `constraint_tol` asks for less."""
NEAR = 1.0e3
"""Roundings of the positions, as they change the residual, within which a stall may be put down to rounding."""
NEAR_MIDPOINT = 4.0
"""The same of mid-point schemes, whose unsymmetric linear solves may stall long before rounding does."""
SETTLING = 10.0
"""A residual can only be at its floor when the last step was below this many accepted errors."""
FAR = 3
"""An attempt may take so many times more iterations where `patience` says so."""
ALIKE = 64.0
"""A stall may be put down to rounding too where the last step was below this many roundings in the norm of energy: of
laws that are steep at small J the stress rounds far more than the positions."""
DROWNED = 32.0
"""Roundings of the positions up to which a residual as large as the forces says nothing of the equilibrium."""
COARSE = 1.0e-10
"""Rounding above which the precision is single."""
SWIFT = 1.0e4
"""Roundings of its speed below which, in double precision, an error of a body's velocities is none."""
REACTION = 1.0e-6
"""Share of twice the strain energy in the squared scale of a residual group."""
ROUNDED = 8.0
"""Roundings of the positions up to which, in double precision, the residual of a group among others is none."""
TRIES = 3
"""Solves that may find the error of a stalled iterate too large before the step is given up."""


@functools.cache
def judging_functions(traits: Traits = NO_TERMS) -> _types.SimpleNamespace:
    """The functions; of the traits "stored", "gated", "midpoint" and "walls" count."""
    f64 = wp.float64
    Control = control_struct()
    stored, gated, midpoint, walls = traits.stored, traits.gated, traits.midpoint, traits.walls
    BOUND = NEAR_MIDPOINT if midpoint else NEAR

    @wp.func
    def objective(ctl: Control, world: int) -> f64:
        """Phi of Eq. (18) at the trial, over dq/dv, with what terms hold in the search.

        Phi = 1/2 (v - v~).M (v - v~) c_M - f_held.v + [Psi_el + Psi_visc + Psi_terms] / (dq/dv), whose derivative by v
        is the residual, Eq. (17). Of the sums over a world: inertia and the forces held, f_held (dead loads, and forces
        without a potential as the search began), are slot_sums[4], row 4 of `residual`; Psi_el and Psi_visc, J, are
        elem_sums[0] and [1], of `internal_force`; Psi_terms, J, of constraints lambda.c + rho/2 c.c, is term_sums[0].
        With the trait "midpoint" there is no Phi: half of the squared D^-1 norm of the residual stands in its place.
        """
        if wp.static(midpoint):
            return ctl.slot_sums[4, world]
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
    def closure(ctl: Control, world: int, tol: f64) -> f64:
        """Violation that is allowed, m: accelerations in the state are off by it over (dq/dv)^2.

        Far from the reference, where places are rounded by more, a few iterations look for it in vain.
        """
        if ctl.constraint_pace > f64(0.0) and tol < f64(1.0e200) and ctl.iterations[world] < CLOSING:
            pace = ctl.constraint_pace * ctl.dq_dv[world] * ctl.dq_dv[world]
            return wp.min(tol, wp.max(pace, ctl.constraint_least))
        return tol

    @wp.func
    def largest_violation(ctl: Control, world: int) -> f64:
        """Of the constraints of all components, m."""
        largest = f64(0.0)
        for c in range(ctl.components):
            largest = wp.max(largest, ctl.violation[world, c])
        return largest

    @wp.func
    def squared_sums(ctl: Control, world: int, group: int):
        """Squared norms of g, of the largest forces, and of the rounding of the positions, of a residual group.

        Of its stress forces a small part counts, as of reactions: a group between others may bear no load of its own.
        """
        if ctl.groups == 1:
            f2 = wp.max(ctl.slot_sums[1, world], wp.max(ctl.slot_sums[2, world], ctl.slot_sums[3, world]))
            return wp.vec3d(ctl.slot_sums[0, world], f2, ctl.slot_sums[8, world])
        f2 = wp.max(
            ctl.group_sums[1, world, group], wp.max(ctl.group_sums[2, world, group], ctl.group_sums[3, world, group])
        )
        stress = f64(2.0) * f64(REACTION) * wp.abs(ctl.group_sums[5, world, group]) / ctl.dq_dv[world]
        return wp.vec3d(ctl.group_sums[0, world, group], wp.max(f2, stress), ctl.group_sums[4, world, group])

    @wp.func
    def rounded(ctl: Control, world: int, group: int, norm: f64, rounding: f64) -> bool:
        """True where, in float64, a group's residual is that of rounded positions, and within the tolerance of all
        groups of its component: solving on would not make it smaller."""
        if ctl.groups == ctl.components or ctl.eps > f64(COARSE) or norm > f64(ROUNDED) * rounding:
            return False
        internal, loads, inertia = f64(0.0), f64(0.0), f64(0.0)
        for other in range(ctl.groups):
            if ctl.component_of_group[other] == ctl.component_of_group[group]:
                internal += ctl.group_sums[1, world, other]
                loads += ctl.group_sums[2, world, other]
                inertia += ctl.group_sums[3, world, other]
        return norm <= ctl.tol * wp.sqrt(wp.max(internal, wp.max(loads, inertia)))

    @wp.func
    def measure(ctl: Control, world: int):
        """Norms and acceptance of the residual just evaluated, for each residual group apart where there are several.

        Components, and materials of unlike stiffness in each, must not hide behind each other's forces, and a component
        of the model all of whose groups have converged is left alone.
        """
        force = wp.sqrt(ctl.slot_sums[9, world])
        ctl.force[world] = force
        largest = f64(0.0)
        worst = f64(0.0)
        excess = f64(0.0)
        floor_excess = f64(0.0)
        solve = f64(0.0)
        solve_accept = f64(1.0e300)
        for c in range(ctl.components):
            ctl.quiet[world, c] = 1
        for group in range(ctl.groups):
            sums = squared_sums(ctl, world, group)
            g2 = sums[0]
            norm = wp.sqrt(g2)
            scale = wp.sqrt(sums[1])
            accept = (ctl.tol + f64(FLOOR) * ctl.eps) * scale
            if force > f64(0.0):
                # the force's tolerance in this norm, as they compare at this iterate
                accept = wp.max(accept, norm * (ctl.force_tol / force))
            if ctl.predicted[world] != 0:
                accept = f64(PREDICTED) * accept  # what is left would add up over steps that none solves for
            rounding = f64(2.0) * ctl.eps * wp.sqrt(sums[2])
            if norm > accept and rounded(ctl, world, group, norm, rounding):
                accept = norm
            loud = norm > accept
            if wp.static(gated):
                allowed = closure(ctl, world, ctl.constraint_tol)
                violation = ctl.violation[world, ctl.component_of_group[group]]
                if violation > allowed:
                    loud = True
                    excess = wp.max(excess, violation / allowed)
                    floor_excess = f64(1.0e300)
            if loud:
                ctl.quiet[world, ctl.component_of_group[group]] = 0
                solve += g2
                solve_accept = wp.min(solve_accept, accept)
                if wp.static(gated):
                    if ctl.classical != 0:  # the residual holds rho c, and so kappa times the rounding of places
                        rounding = rounding / (ctl.slack * ctl.slack)
                floor_excess = wp.max(floor_excess, norm / (rounding + f64(1.0e-300)))
            largest = wp.max(largest, norm / wp.max(scale, f64(1.0e-300)))
            worst = wp.max(worst, norm / wp.max(accept, f64(1.0e-300)))
        if wp.static(gated):
            ctl.open[world] = largest_violation(ctl, world) / closure(ctl, world, ctl.constraint_tol)
        ctl.norm[world] = wp.sqrt(ctl.slot_sums[0, world])
        ctl.relative[world] = largest
        ctl.worst[world] = worst
        ctl.excess[world] = wp.max(excess, worst)
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
    def accept(ctl: Control, world: int):
        """End the iteration with this iterate; where J <= 0 it is looked at once more."""
        ctl.active[world] = 0
        ctl.searching[world] = 0
        if ctl.refuse_inversion != 0 and ctl.min_J[world] <= f64(0.0):
            ctl.suspect[world] = 1
            wp.atomic_max(ctl.any_hard, 0, 1)

    @wp.func
    def ask(ctl: Control, world: int):
        """Let the next solve tell how large an error the residual stands for; see `judge_floor`."""
        ctl.strict[world] = 1
        wp.atomic_max(ctl.any_strict, 0, 1)
        ctl.mixed[world] = 0

    @wp.func
    def patience(ctl: Control, world: int) -> int:
        """How many times `max_iterations` an attempt may take: more where it begins far from its end, or where a law
        that keeps its own tangent left a state without positive curvature, which shorter steps meet again."""
        far = wp.max(ctl.choose[world], ctl.bent[world] * (1 - ctl.linear_stress))
        return 1 + FAR * far

    @wp.func
    def give_up(ctl: Control, world: int, why: int):
        """End without convergence. In single precision a residual as large as the forces, of no more than `DROWNED`
        roundings, is put down to those in statics, whatever it ends by: a smaller load has smaller forces in the same
        noise."""
        ctl.active[world] = 0
        ctl.searching[world] = 0
        ctl.failed[world] = why
        stuck = why == FAIL_ITERATIONS or why == FAIL_LINE_SEARCH or why == FAIL_CURVATURE
        drowned = ctl.floor_excess[world] <= f64(DROWNED) and ctl.relative[world] > f64(0.5)
        if stuck and drowned and ctl.eps > f64(COARSE) and ctl.iterations[world] > 0 and ctl.equilibrium != 0:
            ctl.failed[world] = FAIL_FLOOR
        if wp.static(gated):
            if why != FAIL_NAN and why != FAIL_JACOBIAN and unsatisfied(ctl, world):
                ctl.failed[world] = FAIL_CONSTRAINT

    @wp.func
    def settle(ctl: Control, world: int):
        """End the iteration where it has converged or used up its iterations; where it stands still within rounding,
        ask for the error that is left."""
        record(ctl, world)
        # the energy that the last step promised, over what there is
        energy = f64(2.0) * wp.abs(ctl.elem_sums[0, world]) + ctl.dq_dv[world] * ctl.slot_sums[5, world]
        step = wp.abs(ctl.slope[world]) * ctl.dq_dv[world]
        most = f64(SETTLING) * ctl.floor_bound
        limit = ctl.max_iterations * patience(ctl, world)
        settling = step <= most * most * energy or ctl.iterations[world] + 1 >= limit
        alike = f64(ALIKE) * ctl.eps
        near = ctl.floor_excess[world] <= f64(BOUND)
        if wp.static(not midpoint) and not near and ctl.floor_excess[world] < f64(1.0e300):  # there g.p is no energy
            near = step <= alike * alike * energy
        if wp.static(walls):
            # gaps of bodies that glide are rounded as places are, and there may be no other force
            fine = f64(SWIFT) * ctl.eps
            if ctl.eps < f64(COARSE) and step <= fine * fine * ctl.dq_dv[world] * ctl.slot_sums[10, world]:
                near = True
                settling = True
        near = near and ctl.strict_count[world] < TRIES
        still = ctl.reduction[world] > f64(STALLED) and ctl.reused[world] == 0
        if ctl.excess[world] <= f64(1.0):
            accept(ctl, world)
        elif near and ctl.iterations[world] > 0 and still and settling:
            ask(ctl, world)
        elif ctl.iterations[world] >= limit:
            give_up(ctl, world, FAIL_ITERATIONS)

    @wp.func
    def fail(ctl: Control, world: int, why: int):
        """No step was found. Where rounding alone may explain that, stand still and ask for the error that is left."""
        near = ctl.floor_excess[world] <= f64(BOUND) and ctl.strict_count[world] < TRIES
        enough = False
        if wp.static(gated):  # only accelerations ask for more, and rounding does not give it
            if ctl.constraint_pace > f64(0.0) and ctl.relative[world] <= ctl.tol + f64(FLOOR) * ctl.eps:
                enough = largest_violation(ctl, world) <= ctl.constraint_tol
        if enough and (why == FAIL_LINE_SEARCH or why == FAIL_CURVATURE):
            accept(ctl, world)
        elif near and (why == FAIL_LINE_SEARCH or why == FAIL_CURVATURE):
            ask(ctl, world)
            ctl.alpha[world] = f64(0.0)
        elif (why == FAIL_LINE_SEARCH or why == FAIL_CURVATURE) and ctl.eta[world] < f64(1.0e30):
            give_up(ctl, world, FAIL_FLOOR)
        else:
            give_up(ctl, world, why)

    return _types.SimpleNamespace(
        objective=objective, magnitude=magnitude, closure=closure, largest_violation=largest_violation, measure=measure,
        record=record, accept=accept, ask=ask, patience=patience, give_up=give_up, settle=settle, fail=fail,
    )  # fmt: skip
