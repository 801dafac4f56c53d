"""The rigid bar on a hinge at its edge: its exact motion, and its motion in the steps of the flexible one.

phi is the angle of the bar's axis above the horizontal (rad), X = (x, z) a place relative to the hinge (m).
"""

from __future__ import annotations

import numpy as np

from .problems import GRAVITY, LENGTH, SIDE

__all__ = ["exact_tip", "stepped_tip"]

CENTER = np.array([0.5 * LENGTH, -0.5 * SIDE])
TIP = np.array([LENGTH, -0.5 * SIDE])
MOMENTS = np.array([[LENGTH**2 / 3, -LENGTH * SIDE / 4], [-LENGTH * SIDE / 4, SIDE**2 / 3]])  # mean of X X^T, m^2
TOLERANCE = 1e-12


def exact_tip(times: np.ndarray) -> np.ndarray:
    """(n, 3) tip, m, of the compound pendulum at rest at t = 0, integrated to 1e-12."""
    from scipy.integrate import solve_ivp

    def rates(_: float, y: np.ndarray) -> list[float]:
        return [y[1], -GRAVITY * (_turn(y[0], slope=True) @ CENTER)[1] / np.trace(MOMENTS)]

    # the tolerance also bounds the error at the times between the integrator's own steps
    options = {"method": "DOP853", "rtol": TOLERANCE, "atol": TOLERANCE, "max_step": 0.01}
    y = solve_ivp(rates, (0.0, float(times[-1])), [0.0, 0.0], t_eval=times, **options).y
    return np.array([_place(_turn(phi)) for phi in y[0]])


def stepped_tip(dt: float, steps: int) -> np.ndarray:
    """(steps, 3) tip, m, of the same body in steps of BDF2, the first of backward Euler.

    Each step is that of the flexible bar (simulation/integrators.py) restricted to rotations: with the affine
    predictor A = q~ + beta h v~ it minimises the mean over the body of |R X - A X|^2 / 2 + (beta h)^2 g (R X)_z.
    """
    Q = Q_before = np.eye(2)
    V = V_before = np.zeros((2, 2))
    phi = 0.0
    out = []
    for k in range(steps):
        a0, a1, beta = (4 / 3, 1 / 3, 2 / 3) if k else (1.0, 0.0, 1.0)
        h = beta * dt
        Q_tilde = a0 * Q - a1 * Q_before
        B = (Q_tilde + h * (a0 * V - a1 * V_before)) @ MOMENTS
        for _ in range(50):
            R, dR = _turn(phi), _turn(phi, slope=True)
            slope = h * h * GRAVITY * (dR @ CENTER)[1] - np.sum(dR * B)
            change = slope / (np.sum(R * B) - h * h * GRAVITY * (R @ CENTER)[1])
            phi -= change
            if abs(change) < 1e-14:
                break
        R = _turn(phi)
        Q_before, V_before = Q, V
        Q, V = R, (R - Q_tilde) / h
        out.append(_place(R))
    return np.array(out)


def _turn(phi: float, *, slope: bool = False) -> np.ndarray:
    """(2, 2) rotation, or its derivative by phi."""
    c, s = np.cos(phi), np.sin(phi)
    return np.array([[-s, -c], [c, -s]]) if slope else np.array([[c, -s], [s, c]])


def _place(R: np.ndarray) -> np.ndarray:
    x, z = R @ TIP
    return np.array([x, 0.5 * SIDE, SIDE + z])
