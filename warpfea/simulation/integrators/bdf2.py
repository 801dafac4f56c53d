"""BDF2 with variable steps: Hairer and Wanner, Solving ODEs I, section III.5."""

import warp as wp

from .backward_euler import backward_euler
from .scheme import Integrator

__all__ = ["BDF2", "bdf2"]


@wp.func
def bdf2(h: wp.float64, previous: wp.float64, parameter: wp.float64):
    """Coefficients of BDF2 for the step h after a step `previous`; backward Euler where there is none before."""
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


BDF2 = Integrator("bdf2", bdf2, order=2, multistep=True)
