"""Generalized-alpha: Chung and Hulbert (1993), for constrained systems Arnold and Bruels (2007).

    q_{n+1} = q_n + h v_n + h^2 (1/2 - beta) a_n + h^2 beta a_{n+1}
    v_{n+1} = v_n + h (1 - gamma) a_n + h gamma a_{n+1}
    (1 - am) a_{n+1} + am a_n = (1 - af) w_{n+1} + af w_n
    M w_{n+1} + f_int + J^T lambda = f at t_{n+1}

The forces are in equilibrium with w = q'' at the end of the step; a are averages of w: a_n belongs to t_n + c h_n,
c = am - af, with the step h_n that led there. With r = h_n / h and D = 1 + c - c r

    am = am_1 / D,  af = af_1,  gamma = (1/2 - c r) / D,  beta = gamma beta_1 / gamma_1,

where index 1 denotes equal steps (Chung and Hulbert), all averages belong to those times, so that the order is two for
any steps; dq/dv is h beta_1 / gamma_1, and stiff components decay for r from 1/4 to 4 and rho_inf below 1.
"""

import warp as wp

from ...kernels.step.step_control import Coefficients
from .scheme import DampedIntegrator

__all__ = ["GeneralizedAlpha", "generalized_alpha"]


@wp.func
def generalized_alpha(h: wp.float64, previous: wp.float64, parameter: wp.float64):
    """Coefficients for the spectral radius `parameter` at infinite frequency: a_{n+1} and w_{n+1} eliminated for v."""
    one, half = wp.float64(1.0), wp.float64(0.5)
    af = parameter / (parameter + one)
    early = (parameter - one) / (parameter + one)  # am_1 - af, and beta_1 = (1 - early)^2 / 4
    r = previous / h
    d = one + early - early * r
    am = (early + af) / d
    gamma = (half - early * r) / d
    c = Coefficients()
    c.a0 = one
    c.dq_dv = half * half * h * (one - early) * (one - early) / (half - early)
    c.b = h - c.dq_dv
    c.q_a = h * (half * h - c.dq_dv)
    c.mass_factor = (one - am) / (h * gamma * (one - af))
    c.v_a = h * (one - gamma) - h * gamma * am / (one - am)
    c.v_w = h * gamma * af / (one - am)
    c.a_v = one / (h * gamma)
    c.a_a = (one - gamma) / gamma
    return c


class GeneralizedAlpha(DampedIntegrator):
    """Generalized-alpha method of second order with adjustable high-frequency dissipation.

    Args:
        rho_inf: spectral radius at infinite frequency, 0 to 1: damping factor per step of unresolved frequencies. 1
            conserves the energy of linear systems; models with joints or drives need less than 1. Rotating bodies gain
            energy, increasingly with rho_inf (Kuhl and Crisfield 1999): with 0.2 none up to 2 rad a step, with 0.5 from
            0.6 rad on, with 0.8 from 0.2 rad on.

    Raises:
        ModelError: rho_inf is not between 0 and 1.
    """

    def __init__(self, *, rho_inf: float = 0.2) -> None:
        super().__init__(
            "generalized_alpha", generalized_alpha, rho_inf, order=2, takes_velocity=True, accelerated=True
        )
