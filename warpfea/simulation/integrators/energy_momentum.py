"""Conserving mid-point scheme of Simo and Tarnow (1992), with Gonzalez' discrete gradient (2000).

M (v - v_n)/h + f(q_n, q) = f(t_n + h/2) with q = q_n + h/2 (v_n + v), and internal forces whose work equals the change
of strain energy exactly: see kernels/elements/energy_momentum.py. Constraints hold at the end of the step and act along
their gradient in its middle.

With rho_inf < 1 stresses include (chi/2) C0 : (E_{n+1} - E_n), chi = (1 - rho_inf)/(1 + rho_inf): the stress
dissipation of the energy-decaying scheme of Armero and Romero (2001), without its velocity dissipation.
"""

import warp as wp

from ...kernels.step.step_control import Coefficients
from .scheme import DampedIntegrator

__all__ = ["EnergyMomentum", "energy_momentum"]


@wp.func
def energy_momentum(h: wp.float64, previous: wp.float64, parameter: wp.float64):
    """Coefficients of the mid-point scheme."""
    c = Coefficients()
    c.a0 = wp.float64(1.0)
    c.b = wp.float64(0.5) * h
    c.dq_dv = wp.float64(0.5) * h
    c.mass_factor = wp.float64(1.0) / h
    return c


class EnergyMomentum(DampedIntegrator):
    """Mid-point scheme that conserves both momenta and conserves or dissipates energy, never gaining any.

    Args:
        rho_inf: damping factor of strains unresolved by the step, 0 to 1: 1 conserves energy, of order 2; less is of
            order 1 in deformations, and leaves rigid motions undamped.

    Raises:
        ModelError: rho_inf is not between 0 and 1.
    """

    def __init__(self, *, rho_inf: float = 1.0) -> None:
        order = 2 if rho_inf == 1.0 else 1
        super().__init__("energy_momentum", energy_momentum, rho_inf, order=order, takes_velocity=True, midpoint=True)

    @property
    def dissipation(self) -> float:
        return (1.0 - self.parameter) / (1.0 + self.parameter)

    @property
    def label(self) -> str:
        return self.name if self.parameter == 1.0 else super().label
