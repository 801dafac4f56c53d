"""Backward Euler, Eq. (17), and its form without inertia: the load steps of statics."""

import warp as wp

from ...kernels.step.step_control import Coefficients
from .scheme import Integrator

__all__ = ["BACKWARD_EULER", "STATIC", "backward_euler", "euler_error"]


@wp.func
def backward_euler(h: wp.float64, previous: wp.float64, parameter: wp.float64):
    """Coefficients of backward Euler."""
    c = Coefficients()
    c.a0 = wp.float64(1.0)
    c.dq_dv = h
    c.mass_factor = wp.float64(1.0) / h
    return c


@wp.func
def euler_error(h: wp.float64, previous: wp.float64):
    """Local error h^2 a / 2 = h/2 (v_{n+1} - v_n)."""
    half = wp.float64(0.5) * h
    return wp.vec3d(half, -half, wp.float64(0.0))


BACKWARD_EULER = Integrator("backward_euler", backward_euler, order=1, error_weights=euler_error)
STATIC = Integrator("static", backward_euler, order=0, static=True)
