"""Reference models of planar rigid mechanisms, independent of warpfea: numpy and scipy only, SI units, angles in
rad.

A slider-crank in closed form; two rigid links under gravity. The checks quoted in the docstrings date from 51a4e5d.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

__all__ = [
    "STANDARD",
    "double_pendulum_acceleration",
    "double_pendulum_motion",
    "double_pendulum_places",
    "double_pendulum_terms",
    "integrate",
    "slider_crank_kinematics",
    "slider_crank_velocities",
]

STANDARD: dict[str, Any] = {"crank": 0.15, "rod": 0.30, "speed": 150.0, "E": 2.0e11, "density": 7870.0, "side": 0.008,
            "slider_mass": 0.0755}  # fmt: skip
"""The slider-crank of Chu and Pan (1975) and of Simeon (1996); SI units."""


def slider_crank_kinematics(angle: Any, crank: float, rod: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions of an in-line slider-crank: crank pivot in the origin, slider on the x axis at positive x.

    pin = crank (cos angle, sin angle), sin psi = -crank sin(angle) / rod with cos psi >= 0,
    slider = crank cos(angle) + rod cos(psi).

    Args:
        angle: of the crank from the x axis, any shape.
        crank, rod: lengths, m.

    Returns:
        Crank pin (..., 2), slider's x (...) and rod angle psi (...): direction from crank pin to slider, from x.
        Slider and rod angle are nan if the rod does not reach the axis.
    """
    angle = np.asarray(angle, dtype=float)
    pin = crank * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    with np.errstate(invalid="ignore"):
        psi = np.arcsin(-pin[..., 1] / rod)
    return pin, pin[..., 0] + rod * np.cos(psi), psi


def slider_crank_velocities(
    angle: Any, speed: float, crank: float, rod: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Velocities of `slider_crank_kinematics` for a crank that turns at a constant speed, rad/s.

    d psi / dt = -crank speed cos(angle) / (rod cos psi),
    d slider / dt = -crank speed sin(angle) - rod sin(psi) d psi / dt.

    Returns:
        Of the crank pin (..., 2), m/s; of the slider along x (...), m/s; of the rod's angle (...), rad/s.

    Checked: central differences of the positions agree to 1e-10 of the largest value.
    """
    angle = np.asarray(angle, dtype=float)
    psi = slider_crank_kinematics(angle, crank, rod)[2]
    pin = crank * speed * np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    turn = -pin[..., 1] / (rod * np.cos(psi))
    return pin, pin[..., 0] - rod * np.sin(psi) * turn, turn


def double_pendulum_terms(masses: Any, lengths: Any, centers: Any, inertias: Any, gravity: float) -> tuple:
    """(A, B, C, G1, G2) of `double_pendulum_motion`."""
    (m1, m2), (l1, _), (c1, c2), (i1, i2) = masses, lengths, centers, inertias
    return (i1 + m1 * c1**2 + m2 * l1**2, m2 * l1 * c2, i2 + m2 * c2**2, (m1 * c1 + m2 * l1) * gravity,
            m2 * c2 * gravity)  # fmt: skip


def double_pendulum_acceleration(terms: tuple, angles: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Angular accelerations (2,) of both links, rad/s^2, from `double_pendulum_terms`."""
    a, b, c, g1, g2 = terms
    cos, sin = math.cos(angles[0] - angles[1]), math.sin(angles[0] - angles[1])
    f1 = -b * sin * rates[1] ** 2 - g1 * math.sin(angles[0])
    f2 = b * sin * rates[0] ** 2 - g2 * math.sin(angles[1])
    det = a * c - (b * cos) ** 2
    return np.array([(c * f1 - b * cos * f2) / det, (a * f2 - b * cos * f1) / det])


def double_pendulum_motion(
    times: Any, masses: Any, lengths: Any, centers: Any, inertias: Any, angles: Any, rates: Any, gravity: float = 9.81
) -> tuple[np.ndarray, np.ndarray]:
    """Two rigid links that swing in the x-z plane, the first from a fixed pivot, the second from the first's end.

    Angles are absolute, from the downward vertical, and turn the link's end towards +x. With D = angle1 - angle2,
    A = I1 + m1 c1^2 + m2 l1^2, B = m2 l1 c2, C = I2 + m2 c2^2, G1 = (m1 c1 + m2 l1) g, G2 = m2 c2 g:

        T = A r1^2 / 2 + C r2^2 / 2 + B cos(D) r1 r2,    V = -G1 cos(angle1) - G2 cos(angle2),
        [A, B cos D; B cos D, C] (r1', r2') = (-B sin(D) r2^2 - G1 sin(angle1), B sin(D) r1^2 - G2 sin(angle2)).

    Args:
        times: ascending, s; the state given is that of time 0.
        masses, lengths, centers, inertias: of both links: kg; pivot to pivot, m (the second is not used); upper pivot
            to centre of mass, m; about the centre of mass and the axis normal to the plane, kg m^2.
        angles, rates: of both links at time 0, rad and rad/s.

    Returns:
        Angles (n, 2) and rates (n, 2).

    Checked: accelerations against Lagrange's equations made by differences of T and V of both centres of mass (2e-10
    relative); energy kept to 6e-12 of its range over 5 s, the second link turning over. The motion is chaotic at large
    angles: compare over a few swings only.
    """
    times = np.asarray(times, dtype=float)
    terms = double_pendulum_terms(masses, lengths, centers, inertias, gravity)
    start = np.concatenate([np.asarray(angles, dtype=float), np.asarray(rates, dtype=float)])

    def rhs(t: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[2:], double_pendulum_acceleration(terms, y[:2], y[2:])])

    y = integrate(rhs, start, times, 1e-12, 1e-12)
    return y[:, :2], y[:, 2:]


def double_pendulum_places(angles: Any, lengths: Any) -> tuple[np.ndarray, np.ndarray]:
    """Elbow and tip (..., 2), as (x, z) with z up, of links at angles (..., 2) as in `double_pendulum_motion`."""
    angles = np.asarray(angles, dtype=float)
    link = np.asarray(lengths, dtype=float)[:, None] * np.stack([np.sin(angles), -np.cos(angles)], axis=-1)
    return link[..., 0, :], link[..., 0, :] + link[..., 1, :]


def integrate(rhs: Any, start: np.ndarray, times: np.ndarray, rtol: float, atol: Any) -> np.ndarray:
    """States (n, ...) at the times; the start is at time 0."""
    if times.ndim != 1 or times[0] < 0.0 or np.any(np.diff(times) <= 0.0):
        raise ValueError("times must ascend from 0 or later")
    if times[-1] == 0.0:
        return start[None]
    # DOP853's dense output is of order 7, its steps of order 8: both below the tolerances of the tests
    solution = solve_ivp(rhs, (0.0, times[-1]), start, method="DOP853", t_eval=times, rtol=rtol, atol=atol)
    if not solution.success:
        raise RuntimeError(solution.message)
    return solution.y.T
