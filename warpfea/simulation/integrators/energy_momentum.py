"""The conserving mid-point scheme of Simo and Tarnow (1992), with Gonzalez' discrete gradient (2000).

M (v - v_n)/h + f(q_n, q) = f(t_n + h/2) with q = q_n + h/2 (v_n + v), and internal forces that do exactly the work by
which the strain energy changes: see kernels/elements/conserving.py. Constraints hold at the end of the step and act
along their gradient in its middle.
"""

import warp as wp

from ...kernels.step.control import Coefficients
from .scheme import Integrator

__all__ = ["ENERGY_MOMENTUM", "energy_momentum"]


@wp.func
def energy_momentum(h: wp.float64, previous: wp.float64, parameter: wp.float64):
    """Coefficients of the mid-point scheme."""
    c = Coefficients()
    c.a0 = wp.float64(1.0)
    c.b = wp.float64(0.5) * h
    c.dq_dv = wp.float64(0.5) * h
    c.mass_factor = wp.float64(1.0) / h
    return c


ENERGY_MOMENTUM = Integrator("energy_momentum", energy_momentum, order=2, takes_velocity=True, midpoint=True)
