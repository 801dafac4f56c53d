"""Updates of the quantities that Newton's method solves with frozen values of, such as friction limits."""

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.traits import Traits
from ..common.types import f64, int_1d
from .convergence import EXTRA_ITERATION_FACTOR, STALL_ROUNDINGS, convergence_functions
from .newton_control import Failure, Row, control_struct

__all__ = ["FROZEN_UPDATE_RESIDUAL", "frozen_update_kernels"]

RESIDUAL_GROWTH, LOOSE_FORCING = 3.0, 0.03
"""If the residual grows by more than this factor when frozen quantities are updated, the next linear solve has at least
this relative tolerance."""
FROZEN_UPDATE_RESIDUAL = 0.1
"""Relative residual at or below which frozen quantities (friction limits) are updated, after each iteration."""
CONTINUATION_START = 10
"""Iterations of an attempt in statics after which, above `FROZEN_UPDATE_RESIDUAL`, a continuation begins."""
SOFTEST_PENALTY, PENALTY_RATIO = 1.0e-4, 10.0
"""Factor on the stiffness of contact that a continuation begins with, and ratio of one factor to the next."""


def frozen_update_kernels(traits: Traits, module: wp.Module) -> KernelSet:
    """Kernels of frozen updates, in the module of Newton's method."""
    Control = control_struct()
    convergence = convergence_functions(traits)

    @wp.func
    def continuation_is_due(ctl: Control, world: int) -> bool:
        """True in statics if Newton's method does not find the points in contact: their forces are so steep that the
        line search moves the border of a contact by a facet or less. From soft to stiff contact it moves along the
        solutions (Hintermueller and Kunisch 2006)."""
        slow = ctl.is_static != 0 and ctl.iterations[world] >= CONTINUATION_START
        return slow and ctl.frozen.continued[world] == 0

    @wp.func
    def most_iterations(ctl: Control, world: int) -> int:
        """Iterations in which the frozen quantities of an attempt settle."""
        return ctl.max_iterations * (1 + EXTRA_ITERATION_FACTOR * ctl.frozen.continued[world])

    @wp.func
    def set_penalty_factor(ctl: Control, world: int, factor: f64):
        """Begin a stage of a continuation: nothing else changes before its residual is small."""
        ctl.frozen.penalty_factor[world] = wp.min(factor, f64(1.0))
        ctl.frozen.partly_updated[world] = 1
        ctl.frozen.continued[world] = 1

    @wp.kernel(module=module)
    def begin_frozen_update(ctl: Control, flags: int_1d):
        """Flag the worlds whose frozen quantities are due for an update: the residual is small enough or within
        round-off, or no iteration is left; and those where a stage of a continuation begins."""
        world = wp.tid()
        flags[world] = 0
        ctl.frozen.update_due[world] = 0
        if ctl.active[world] != 0 and ctl.frozen.contact_active[world] == 0:
            convergence.check_convergence(ctl, world)  # nothing is frozen
        elif ctl.active[world] != 0:
            last = ctl.iterations[world] + 1 >= most_iterations(ctl, world)
            # within round-off the residual may not fall further
            rounding = ctl.floor.rounding_ratio[world] <= f64(STALL_ROUNDINGS)
            factor = ctl.frozen.penalty_factor[world]
            if ctl.norms.relative_residual[world] <= f64(FROZEN_UPDATE_RESIDUAL) or rounding or last:
                flags[world] = 1
                if factor < f64(1.0):
                    set_penalty_factor(ctl, world, f64(PENALTY_RATIO) * factor)
                else:
                    ctl.frozen.update_due[world] = 1
            else:
                convergence.record_residual(ctl, world)
                if continuation_is_due(ctl, world):
                    flags[world] = 1
                    set_penalty_factor(ctl, world, f64(SOFTEST_PENALTY))

    @wp.kernel(module=module)
    def end_frozen_update(ctl: Control, flags: int_1d):
        """Re-evaluate the iterate of the flagged worlds with the updated frozen quantities."""
        world = wp.tid()
        if ctl.active[world] != 0 and flags[world] != 0:
            before = ctl.norms.residual_norm[world]
            convergence.evaluate_norms(ctl, world)
            if ctl.solve.fixed_forcing == 0 and ctl.norms.residual_norm[world] > f64(RESIDUAL_GROWTH) * before:
                # the frozen quantities were the larger error: tighter solves are wasted
                ctl.solve.forcing[world] = wp.max(ctl.solve.forcing[world], f64(LOOSE_FORCING))
            ctl.search.phi[world] = convergence.objective(ctl, world) + ctl.slot_sums[Row.FROZEN_CHANGE, world]
            ctl.search.phi_magnitude[world] = convergence.objective_magnitude(ctl, world)
            ctl.nonmonotone.steps[world] = 0
            ctl.frozen.updated[world] = 1 - ctl.frozen.unilateral_changed[world]
            ctl.frozen.unilateral_changed[world] = 0
            part = ctl.frozen.partly_updated[world] != 0
            ctl.frozen.partly_updated[world] = 0
            if not part:
                convergence.check_convergence(ctl, world)
            else:
                convergence.record_residual(ctl, world)
                if ctl.iterations[world] >= most_iterations(ctl, world):
                    convergence.give_up(ctl, world, Failure.ITERATIONS)

    return kernel_set(locals())
