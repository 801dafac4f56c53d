"""Reference model of a slider-crank whose rod bends, made without warpfea: a floating frame along the chord."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq

from .rigid import integrate

__all__ = ["Rod", "floating_frame_slider_crank", "tolerance"]


class _Motion(NamedTuple):
    """The rod's points and the slider (last row) at one instant; vectors by components along and across the chord."""

    to_world: np.ndarray  # (2, 2)
    place: np.ndarray  # (2, points + 1), from the crank pin
    velocity: np.ndarray  # (2, points + 1)
    jacobian: np.ndarray  # (2, points + 1, n): d velocity / d rates
    bias: np.ndarray  # (2, points + 1): acceleration where the rates do not change
    strain: tuple[np.ndarray, np.ndarray]  # axial and bending, at the rod's points
    strain_by: tuple[np.ndarray, np.ndarray]  # derivatives by the coordinates


class Rod:
    """The equations of `floating_frame_slider_crank`; state y = (q, q'), q = (a_1 .. a_modes, b_0 .. b_(axial-1))."""

    def __init__(self, crank: float, rod: float, speed: float, E: float, density: float, side: float,
                 slider_mass: float, modes: int, axial: int, points: int) -> None:  # fmt: skip
        if not rod > crank > 0.0:
            raise ValueError("the rod must be longer than the crank")
        self.crank, self.rod, self.speed, self.n = crank, rod, speed, modes + axial
        x, weight = np.polynomial.legendre.leggauss(points)
        s, self.weight = 0.5 * rod * (x + 1.0), 0.5 * rod * weight
        self.mass = np.append(density * side**2 * self.weight, slider_mass)
        self.EA, self.EI = E * side**2, E * side**4 / 12.0
        # integral from 0 to each point and to the end: exact for the polynomial through the points
        powers = np.polynomial.legendre.legvander(x, points - 1)
        upto = [np.polynomial.legendre.legval(np.append(x, 1.0), np.polynomial.legendre.legint(c, lbnd=-1.0))
                for c in np.eye(points)]  # fmt: skip
        self.upto = 0.5 * rod * np.linalg.solve(powers.T, np.array(upto)).T
        k = np.arange(1, modes + 1) * np.pi / rod
        none = np.zeros((points, axial))
        self.w = np.hstack([np.vstack([np.sin(np.outer(s, k)), np.zeros(modes)]), np.zeros((points + 1, axial))])
        self.w1 = np.hstack([k * np.cos(np.outer(s, k)), none])
        self.w2 = np.hstack([-(k**2) * np.sin(np.outer(s, k)), none])
        heavy = density * side**2 * rod
        root = [brentq(lambda z: slider_mass * z * math.sin(z) - heavy * math.cos(z), j * np.pi, (j + 0.5) * np.pi,
                       xtol=1e-14) for j in range(axial)]  # fmt: skip
        c = np.array(root) / rod
        none = np.zeros((points, modes))
        self.e = np.hstack([none, np.cos(np.outer(s, c))])
        self.e1 = np.hstack([none, -c * np.sin(np.outer(s, c))])
        self.middle = np.append(np.sin(0.5 * rod * k), np.zeros(axial))

    def chord(self, t: float, q: np.ndarray) -> tuple[np.ndarray, float, float, float]:
        """Slope dx/ds of the rod along its chord, chord length, sine and cosine of the chord's angle."""
        g = np.sqrt((1.0 + self.e @ q) ** 2 - (self.w1 @ q) ** 2)
        length = float(self.weight @ g)
        sin = -self.crank * math.sin(self.speed * t) / length
        return g, length, sin, math.sqrt(1.0 - sin**2)

    def slider(self, t: float, q: np.ndarray) -> float:
        """The slider's x, m."""
        _, length, _, cos = self.chord(t, q)
        return self.crank * math.cos(self.speed * t) + length * cos

    def motion(self, t: float, y: np.ndarray) -> _Motion:
        """Place, velocity and strains of the rod at time t (s) in state y."""
        q, v = y[: self.n], y[self.n :]
        g, length, sin, cos = self.chord(t, q)
        turn = self.speed * t
        to_chord = np.array([[cos, sin], [-sin, cos]])
        pin1 = self.crank * self.speed * np.array([-math.sin(turn), math.cos(turn)])
        pin2 = -self.crank * self.speed**2 * np.array([math.cos(turn), math.sin(turn)])
        # along the chord: g^2 = h^2 - p^2, differentiated by q, once and twice by time at q'' = 0, then summed along s
        h, p, dh, dp = 1.0 + self.e @ q, self.w1 @ q, self.e @ v, self.w1 @ v
        g_q = (h[:, None] * self.e - p[:, None] * self.w1) / g[:, None]
        g_t = g_q @ v
        u, u_q, u_t, u_tt = (self.upto @ z for z in (g, g_q, g_t, (dh**2 - dp**2 - g_t**2) / g))
        w, w_t = self.w @ q, self.w @ v
        # the chord's angle from pin_y + length sin = 0
        angle_q = -sin / (cos * length) * u_q[-1]
        angle_t = -(pin1[1] + sin * u_t[-1]) / (cos * length)
        angle_tt = -(pin2[1] + sin * u_tt[-1] + (2.0 * cos * u_t[-1] - length * sin * angle_t) * angle_t)
        angle_tt /= cos * length
        velocity = np.array([u_t - w * angle_t, w_t + u * angle_t]) + (to_chord @ pin1)[:, None]
        jacobian = np.array([u_q - np.outer(w, angle_q), self.w + np.outer(u, angle_q)])
        bias = np.array([u_tt - 2.0 * w_t * angle_t - u * angle_t**2 - w * angle_tt,
                         2.0 * u_t * angle_t - w * angle_t**2 + u * angle_tt])  # fmt: skip
        bias += (to_chord @ pin2)[:, None]
        # curvature: the derivative by s of arcsin(p / h)
        p1, h1 = self.w2 @ q, self.e1 @ q
        bend = (p1 * h - p * h1) / (h * g)
        bend_q = self.w2 * h[:, None] + p1[:, None] * self.e - self.w1 * h1[:, None] - p[:, None] * self.e1
        bend_q = (bend_q / g[:, None] - bend[:, None] * self.e) / h[:, None] - (bend / g)[:, None] * g_q
        return _Motion(to_chord.T, np.array([u, w]), velocity, jacobian, bias, (h - 1.0, bend), (self.e, bend_q))

    def acceleration(self, m: _Motion) -> np.ndarray:
        """Second derivatives (n,) of the coordinates, by d'Alembert's principle."""
        weighted = self.mass[:, None] * m.jacobian
        M = weighted[0].T @ m.jacobian[0] + weighted[1].T @ m.jacobian[1]
        f = weighted[0].T @ m.bias[0] + weighted[1].T @ m.bias[1]
        for stiffness, strain, by in zip((self.EA, self.EI), m.strain, m.strain_by):
            f += stiffness * (by.T @ (self.weight * strain))
        return -np.linalg.solve(M, f)

    def rhs(self, t: float, y: np.ndarray) -> np.ndarray:
        """dy/dt."""
        return np.concatenate([y[self.n :], self.acceleration(self.motion(t, y))])

    def energy(self, t: float, y: np.ndarray) -> float:
        """Kinetic and strain energy of rod and slider, J."""
        m = self.motion(t, y)
        strain = self.EA * m.strain[0] ** 2 + self.EI * m.strain[1] ** 2
        return 0.5 * float(self.mass @ (m.velocity**2).sum(0) + self.weight @ strain)

    def power(self, t: float, y: np.ndarray) -> float:
        """Of the crank pin's force on the rod, W, by Newton's law and moments about the pin, not by Lagrange's."""
        m = self.motion(t, y)
        accelerated = m.to_world @ (m.bias + m.jacobian @ self.acceleration(m))
        force = self.mass * accelerated  # world axes; the slider's row has no y
        place = m.to_world @ m.place
        guide = float((place[0] * force[1] - place[1] * force[0]).sum()) / place[0, -1]
        pin = force.sum(1) - [0.0, guide]
        turn = self.speed * t
        return self.crank * self.speed * float(pin[1] * math.cos(turn) - pin[0] * math.sin(turn))


def floating_frame_slider_crank(
    times: Any, *, crank: float, rod: float, speed: float, E: float, density: float, side: float, slider_mass: float,
    modes: int = 4, axial: int = 1, points: int | None = None, rtol: float = 1e-9,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """A slider-crank with an elastic rod, in a plane without gravity: a floating frame along the chord of the pins.

    The crank turns at the constant speed, from the x axis at time 0. The rod, of square section, is pinned to the
    crank's end and to a point mass that slides along x without friction. With s the material coordinate, 0 <= s <= L,
    and w across the chord,

        r(s, t) = pin(t) + u(s, t) e1 + w(s, t) e2,     w = sum_k a_k sin(k pi s / L),
        u(s) = int_0^s sqrt((1 + e)^2 - w'^2) ds,       e = sum_j b_j cos(c_j s / L),

    where e is the axial strain, in the shapes of the straight rod with the slider at its end (c tan c = rod's mass /
    slider's mass, which gives its axial ringing the right frequency with one shape). The shortening of the chord, int
    w'^2 / 2 to the second order, is kept in full, and with it the stiffening and softening of the rod by its axial
    force. The chord's length u(L) and the line of the slider give the chord's angle. q = (a, b) follows Lagrange's
    equations, here as d'Alembert's principle with J = dr/dq by formula and integrals by Gauss points,

        int rho A J^T r'' ds + m J_slider^T r''_slider + d/dq int (EA e^2 + EI kappa^2) / 2 ds = 0,
        kappa = d/ds arcsin(w' / (1 + e)),

    with all terms of the inertia (no order of a dropped). Assumed: Euler-Bernoulli, thus no shear and no rotary
    inertia; the two together lower a thick rod's first frequency by about (pi side / L)^2 (1 + 3.1) / 24, 0.12 % at
    side / L = 0.008 / 0.3. No damping. At time 0 the rod is straight and unstrained with the rigid mechanism's
    velocities, so that the axial force and the bending ring.

    Args:
        times: ascending, s.
        crank, rod, side: m; rod > crank.
        speed: rad/s, not zero.
        E, density, slider_mass: Pa, kg/m^3, kg.
        modes: bending shapes.
        axial: axial shapes; 0 for an inextensible rod.
        points: of Gauss along the rod; 8 + 6 modes by default.
        rtol: of the integrator, DOP853.

    Returns:
        Deflection (n,) of the rod's middle (s = L / 2) from the chord, positive to the left of the direction from crank
        pin to slider pin, and the slider's x (n,), m.

    Checked (numbers in `_check_elastic` of checks.py): modes, axial shapes, Gauss points and tolerance; a chain of
    point masses that shares no equation; the rigid and the linear limits; the energy against the work of the pin's
    force.
    """
    times = np.asarray(times, dtype=float)
    points = 8 + 6 * modes if points is None else points
    model = Rod(crank, rod, speed, E, density, side, slider_mass, modes, axial, points)
    y = integrate(model.rhs, np.zeros(2 * model.n), times, rtol, tolerance(model, rtol, modes))
    q = y[:, : model.n]
    return q @ model.middle, np.array([model.slider(t, x) for t, x in zip(times, q)])


def tolerance(model: Rod, rtol: float, modes: int) -> np.ndarray:
    """Absolute: deflections count from 1e-3 of the rod, strains from 1e-5."""
    size = np.where(np.arange(model.n) < modes, 1e-3 * model.rod, 1e-5)
    return rtol * np.concatenate([size, size * abs(model.speed)])
