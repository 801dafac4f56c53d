"""Backward Euler, Eq. (17), and the same form without inertia: the load steps of statics."""

import warp as wp

from ...kernels.step.control import Coefficients
from .scheme import Integrator

__all__ = ["BACKWARD_EULER", "STATIC", "backward_euler"]


@wp.func
def backward_euler(h: wp.float64, previous: wp.float64, parameter: wp.float64):
    """Coefficients of backward Euler."""
    c = Coefficients()
    c.a0 = wp.float64(1.0)
    c.dq_dv = h
    c.mass_factor = wp.float64(1.0) / h
    return c


BACKWARD_EULER = Integrator("backward_euler", backward_euler, order=1)
STATIC = Integrator("static", backward_euler, order=0, static=True)
