"""Outer loop of Newton's method: classical multiplier updates, updates of frozen quantities, step limits."""

import warp as wp

from ..common.modules import KernelSet, kernel_set, masked_kernel
from ..common.traits import Traits
from ..common.types import int_1d
from .convergence import STALL_ROUNDINGS, convergence_functions
from .newton_control import FAIL_CONSTRAINT, FAIL_ITERATIONS, ROW_FROZEN_CHANGE, control_struct

__all__ = ["outer_loop_kernels"]

RESIDUAL_GROWTH, LOOSE_FORCING = 3.0, 0.03
"""If the residual grows by more than this factor when frozen quantities are updated, the next linear solve has at least
this relative tolerance."""
FROZEN_UPDATE_RESIDUAL = 0.1
"""Relative residual below which frozen quantities (friction limits) are updated at each iterate."""


def outer_loop_kernels(traits: Traits, module: wp.Module) -> KernelSet:
    """Kernels of the outer loop, in the module of Newton's method."""
    f64 = wp.float64
    Control = control_struct()
    convergence = convergence_functions(traits)
    allowed_violation = convergence.allowed_violation
    objective, objective_magnitude, largest_violation = (
        convergence.objective,
        convergence.objective_magnitude,
        convergence.largest_violation,
    )
    evaluate_norms, check_convergence, record_residual, give_up = (
        convergence.evaluate_norms,
        convergence.check_convergence,
        convergence.record_residual,
        convergence.give_up,
    )

    @wp.kernel(module=module)
    def begin_frozen_update(ctl: Control, flags: int_1d):
        """Flag the worlds whose frozen quantities are due for an update: the residual is small enough."""
        world = wp.tid()
        flags[world] = 0
        if ctl.active[world] != 0 and ctl.frozen.contact_active[world] == 0:
            check_convergence(ctl, world)  # nothing is frozen
        elif ctl.active[world] != 0:
            last = ctl.iterations[world] + 1 >= ctl.max_iterations
            # within round-off the residual may not fall further
            rounding = ctl.floor.rounding_ratio[world] <= f64(STALL_ROUNDINGS)
            if ctl.norms.relative_residual[world] <= f64(FROZEN_UPDATE_RESIDUAL) or rounding or last:
                flags[world] = 1
            else:
                record_residual(ctl, world)

    @wp.kernel(module=module)
    def end_frozen_update(ctl: Control, flags: int_1d):
        """Re-evaluate the iterate of the flagged worlds with the updated frozen quantities."""
        world = wp.tid()
        if ctl.active[world] != 0 and flags[world] != 0:
            before = ctl.norms.residual_norm[world]
            evaluate_norms(ctl, world)
            if ctl.solve.fixed_forcing == 0 and ctl.norms.residual_norm[world] > f64(RESIDUAL_GROWTH) * before:
                # the frozen quantities were the larger error: tighter solves are wasted
                ctl.solve.forcing[world] = wp.max(ctl.solve.forcing[world], f64(LOOSE_FORCING))
            ctl.search.phi[world] = objective(ctl, world) + ctl.slot_sums[ROW_FROZEN_CHANGE, world]
            ctl.search.phi_magnitude[world] = objective_magnitude(ctl, world)
            ctl.nonmonotone.steps[world] = 0
            ctl.frozen.updated[world] = 1 - ctl.frozen.unilateral_changed[world]
            ctl.frozen.unilateral_changed[world] = 0
            part = ctl.frozen.partly_updated[world] != 0
            ctl.frozen.partly_updated[world] = 0
            if not part:
                check_convergence(ctl, world)
            else:
                record_residual(ctl, world)
                if ctl.iterations[world] >= ctl.max_iterations:
                    give_up(ctl, world, FAIL_ITERATIONS)

    @wp.kernel(module=module)
    def check_constraints(ctl: Control, running: int_1d, tol: f64, limit: int):
        """Classical multiplier updates: start another inner solve if a constraint is still violated."""
        world = wp.tid()
        ctl.search.trial_accepted[world] = 0
        if running[world] == 0 or ctl.failed[world] != 0:
            return
        if largest_violation(ctl, world) <= allowed_violation(ctl, world, tol):
            return
        if ctl.multiplier_updates[world] >= limit:
            ctl.failed[world] = FAIL_CONSTRAINT
            return
        ctl.multiplier_updates[world] = ctl.multiplier_updates[world] + 1
        ctl.iterations[world] = 0
        ctl.inversion_suspected[world] = 0
        ctl.inverted[world] = 0
        ctl.active[world] = 1
        ctl.search.trial_accepted[world] = 1

    @masked_kernel(module, "ctl.active")
    def reset_step_limit(ctl: Control):
        """Reset the step limit to the full step."""
        world = wp.tid()
        ctl.search.limit[world] = f64(1.0)

    return kernel_set(locals())
