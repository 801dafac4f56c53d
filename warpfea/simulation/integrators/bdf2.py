"""BDF2 with variable steps: Hairer and Wanner, Solving ODEs I, section III.5."""

import warp as wp

from .backward_euler import backward_euler, euler_error
from .scheme import Integrator

__all__ = ["BDF2", "bdf2", "bdf2_error"]


@wp.func
def bdf2(h: wp.float64, previous: wp.float64, parameter: wp.float64):
    """Coefficients of BDF2 for the step h after a step `previous`; backward Euler for the first step."""
    c = backward_euler(h, previous, parameter)
    if previous > wp.float64(0.0):
        one = wp.float64(1.0)
        w = h / previous
        d = one + wp.float64(2.0) * w
        beta = (one + w) / d
        c.a0 = (one + w) * (one + w) / d
        c.a1 = w * w / d
        c.dq_dv = beta * h
        c.mass_factor = one / (beta * h)
    return c


@wp.func
def bdf2_error(h: wp.float64, previous: wp.float64):
    """Milne's device: error of linear extrapolation of the velocities, for the third derivative q3 of q.

    With w = h / previous the formula leaves h^3 (1 + w)^2 / (6 w (1 + 2 w)) q3, and v_{n+1} - v_n - w (v_n - v_{n-1})
    is h^2 (1 + 1/w) q3 / 2. The first step is backward Euler's.
    """
    c = euler_error(h, previous)
    if previous > wp.float64(0.0):
        one = wp.float64(1.0)
        w = h / previous
        k = h * (one + w) / (wp.float64(3.0) * (one + wp.float64(2.0) * w))
        c = wp.vec3d(k, -k * (one + w), k * w)
    return c


BDF2 = Integrator("bdf2", bdf2, order=2, multistep=True, error_weights=bdf2_error)
