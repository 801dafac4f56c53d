"""Outer loop of Newton's method: classical multiplier updates, step limits."""

import warp as wp

from ..common.modules import KernelSet, kernel_set, masked_kernel
from ..common.traits import Traits
from ..common.types import f64, int_1d
from .convergence import convergence_functions
from .newton_control import Failure, control_struct

__all__ = ["outer_loop_kernels"]


def outer_loop_kernels(traits: Traits, module: wp.Module) -> KernelSet:
    """Kernels of the outer loop, in the module of Newton's method."""
    Control = control_struct()
    convergence = convergence_functions(traits)

    @wp.kernel(module=module)
    def check_constraints(ctl: Control, running: int_1d, tol: f64, limit: int):
        """Classical multiplier updates: start another inner solve if a constraint is still violated."""
        world = wp.tid()
        ctl.search.trial_accepted[world] = 0
        if running[world] == 0 or ctl.failed[world] != 0:
            return
        if convergence.largest_violation(ctl, world) <= convergence.allowed_violation(ctl, world, tol):
            return
        if ctl.multiplier_updates[world] >= limit:
            ctl.failed[world] = Failure.CONSTRAINT
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
