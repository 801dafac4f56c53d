"""Reference models of planar mechanisms, made without warpfea: numpy and scipy only, SI units, angles in radians.

    python tests/mechanism_models.py

prints the checks that the docstrings quote (about a minute). Tests compare warpfea's multibody results with:

- `slider_crank_kinematics`, `slider_crank_velocities`, `four_bar_kinematics`: rigid mechanisms, closed form;
- `double_pendulum`, `double_pendulum_tip`: two rigid links under gravity;
- `floating_frame_slider_crank`: a slider-crank whose rod bends.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

STANDARD: dict[str, Any] = {"crank": 0.15, "rod": 0.30, "speed": 150.0, "E": 2.0e11, "density": 7870.0, "side": 0.008,
            "slider_mass": 0.0755}  # fmt: skip
"""The slider-crank of Chu and Pan (1975) and of Simeon (1996), arguments of `floating_frame_slider_crank`."""


def slider_crank_kinematics(angle: Any, crank: float, rod: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place of an in-line slider-crank: crank pivot in the origin, slider on the x axis at positive x.

    pin = crank (cos angle, sin angle), sin psi = -crank sin(angle) / rod with cos psi >= 0,
    slider = crank cos(angle) + rod cos(psi).

    Args:
        angle: of the crank from the x axis, any shape.
        crank, rod: lengths, m.

    Returns:
        Crank pin (..., 2), slider's x (...) and rod angle psi (...): of the direction from crank pin to slider, from x.
        Slider and rod angle are nan where the rod does not reach the axis.
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

    Checked: central differences of the places agree to 1e-10 of the largest value.
    """
    angle = np.asarray(angle, dtype=float)
    psi = slider_crank_kinematics(angle, crank, rod)[2]
    pin = crank * speed * np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    turn = -pin[..., 1] / (rod * np.cos(psi))
    return pin, pin[..., 0] - rod * np.sin(psi) * turn, turn


def four_bar_kinematics(
    angle: Any, crank: float, coupler: float, rocker: float, ground: float, branch: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Joints of a planar four-bar whose ground pivots are the origin (crank) and (ground, 0) (rocker).

    The rocker pin is where the circle of radius coupler about the crank pin meets the circle of radius rocker about the
    rocker's pivot: with d from crank pin to rocker pivot, along = (d^2 + coupler^2 - rocker^2) / (2 d) on that line and
    sqrt(coupler^2 - along^2) across it.

    Args:
        angle: of the crank from the x axis, any shape.
        crank, coupler, rocker, ground: lengths, m.
        branch: 1, rocker pin to the left of the direction from crank pin to rocker pivot; -1, to the right. One
            assembly of a Grashof crank-rocker keeps its branch for the whole turn; a linkage that passes a stretched
            position (a parallelogram at angle 0) may change it there.

    Returns:
        Crank pin and rocker pin, (..., 2) each; the rocker pin is nan where the linkage does not close.
    """
    if branch not in (1, -1):
        raise ValueError(f"branch = {branch!r} must be 1 or -1")
    angle = np.asarray(angle, dtype=float)
    pin = crank * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    line = np.array([ground, 0.0]) - pin
    d = np.linalg.norm(line, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        line = line / d[..., None]
        along = (d**2 + coupler**2 - rocker**2) / (2.0 * d)
        across = branch * np.sqrt(coupler**2 - along**2)
        left = np.stack([-line[..., 1], line[..., 0]], axis=-1)
        return pin, pin + along[..., None] * line + across[..., None] * left


def _double_pendulum_terms(masses: Any, lengths: Any, centers: Any, inertias: Any, gravity: float) -> tuple:
    """(A, B, C, G1, G2) of `double_pendulum`."""
    (m1, m2), (l1, _), (c1, c2), (i1, i2) = masses, lengths, centers, inertias
    return (i1 + m1 * c1**2 + m2 * l1**2, m2 * l1 * c2, i2 + m2 * c2**2, (m1 * c1 + m2 * l1) * gravity,
            m2 * c2 * gravity)  # fmt: skip


def _double_pendulum_acceleration(terms: tuple, angles: np.ndarray, rates: np.ndarray) -> np.ndarray:
    a, b, c, g1, g2 = terms
    cos, sin = math.cos(angles[0] - angles[1]), math.sin(angles[0] - angles[1])
    f1 = -b * sin * rates[1] ** 2 - g1 * math.sin(angles[0])
    f2 = b * sin * rates[0] ** 2 - g2 * math.sin(angles[1])
    det = a * c - (b * cos) ** 2
    return np.array([(c * f1 - b * cos * f2) / det, (a * f2 - b * cos * f1) / det])


def double_pendulum(
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
    terms = _double_pendulum_terms(masses, lengths, centers, inertias, gravity)
    start = np.concatenate([np.asarray(angles, dtype=float), np.asarray(rates, dtype=float)])

    def rhs(t: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[2:], _double_pendulum_acceleration(terms, y[:2], y[2:])])

    y = _integrate(rhs, start, times, 1e-12, 1e-12)
    return y[:, :2], y[:, 2:]


def double_pendulum_tip(angles: Any, lengths: Any) -> tuple[np.ndarray, np.ndarray]:
    """Elbow and tip (..., 2), as (x, z) with z up, of links at angles (..., 2) as in `double_pendulum`."""
    angles = np.asarray(angles, dtype=float)
    link = np.asarray(lengths, dtype=float)[:, None] * np.stack([np.sin(angles), -np.cos(angles)], axis=-1)
    return link[..., 0, :], link[..., 0, :] + link[..., 1, :]


def _integrate(rhs: Any, start: np.ndarray, times: np.ndarray, rtol: float, atol: Any) -> np.ndarray:
    """States (n, ...) at the times, of which time 0 has the start."""
    if times.ndim != 1 or times[0] < 0.0 or np.any(np.diff(times) <= 0.0):
        raise ValueError("times must ascend from 0 or later")
    if times[-1] == 0.0:
        return start[None]
    # DOP853's dense output is of order 7, the steps of order 8: both are below what the tests compare to
    solution = solve_ivp(rhs, (0.0, times[-1]), start, method="DOP853", t_eval=times, rtol=rtol, atol=atol)
    if not solution.success:
        raise RuntimeError(solution.message)
    return solution.y.T


class _Motion(NamedTuple):
    """The rod's points and the slider (last row) at one instant; vectors by components along and across the chord."""

    to_world: np.ndarray  # (2, 2)
    place: np.ndarray  # (2, points + 1), from the crank pin
    velocity: np.ndarray  # (2, points + 1)
    jacobian: np.ndarray  # (2, points + 1, n): d velocity / d rates
    bias: np.ndarray  # (2, points + 1): acceleration where the rates do not change
    strain: tuple[np.ndarray, np.ndarray]  # axial and bending, at the rod's points
    strain_by: tuple[np.ndarray, np.ndarray]  # derivatives by the coordinates


class _Rod:
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
        _, length, _, cos = self.chord(t, q)
        return self.crank * math.cos(self.speed * t) + length * cos

    def motion(self, t: float, y: np.ndarray) -> _Motion:
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
        weighted = self.mass[:, None] * m.jacobian
        M = weighted[0].T @ m.jacobian[0] + weighted[1].T @ m.jacobian[1]
        f = weighted[0].T @ m.bias[0] + weighted[1].T @ m.bias[1]
        for stiffness, strain, by in zip((self.EA, self.EI), m.strain, m.strain_by):
            f += stiffness * (by.T @ (self.weight * strain))
        return -np.linalg.solve(M, f)

    def rhs(self, t: float, y: np.ndarray) -> np.ndarray:
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

    Checked (numbers in `_check_elastic`): modes, axial shapes, Gauss points and tolerance; a chain of point masses that
    shares no equation; the rigid and the linear limits; the energy against the work of the pin's force.
    """
    times = np.asarray(times, dtype=float)
    points = 8 + 6 * modes if points is None else points
    model = _Rod(crank, rod, speed, E, density, side, slider_mass, modes, axial, points)
    y = _integrate(model.rhs, np.zeros(2 * model.n), times, rtol, _tolerance(model, rtol, modes))
    q = y[:, : model.n]
    return q @ model.middle, np.array([model.slider(t, x) for t, x in zip(times, q)])


def _tolerance(model: _Rod, rtol: float, modes: int) -> np.ndarray:
    """Absolute: deflections count from 1e-3 of the rod, strains from 1e-5."""
    size = np.where(np.arange(model.n) < modes, 1e-3 * model.rod, 1e-5)
    return rtol * np.concatenate([size, size * abs(model.speed)])


def _chain_slider_crank(
    times: np.ndarray, segments: int, *, crank: float, rod: float, speed: float, E: float, density: float, side: float,
    slider_mass: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """The same as a chain of point masses in world axes with springs against stretch and turn, by central differences.

    Shares no equation with the floating frame; its error falls with 1 / segments^2.
    """
    l0 = rod / segments
    mass = np.full(segments + 1, density * side**2 * l0)
    mass[-1] = 0.5 * mass[-1] + slider_mass
    EA, EI = E * side**2, E * side**4 / 12.0
    dt = 0.3 * l0 / math.sqrt(E / density)
    steps = math.ceil(times[-1] / dt)
    x = np.stack([crank + l0 * np.arange(segments + 1.0), np.zeros(segments + 1)])
    # half a step back of the rigid mechanism's velocity: the acceleration at time 0 is taken in full, then halved
    v = np.stack([np.zeros(segments + 1), crank * speed * np.linspace(1.0, 0.0, segments + 1)])
    seen, at = np.zeros((steps + 1, 2)), dt * np.arange(steps + 1)
    for i in range(steps + 1):
        d = x[:, 1:] - x[:, :-1]
        size = np.sqrt(d[0] ** 2 + d[1] ** 2)
        across = np.stack([-d[1], d[0]]) / size
        chord = x[:, -1] - x[:, 0]
        middle = x[:, segments // 2] - x[:, 0]
        seen[i] = (chord[0] * middle[1] - chord[1] * middle[0]) / math.hypot(*chord), x[0, -1]
        cross, dot = d[0, :-1] * d[1, 1:] - d[1, :-1] * d[0, 1:], (d[:, :-1] * d[:, 1:]).sum(0)
        moment = np.concatenate([[0.0], EI / l0 * np.arctan2(cross, dot), [0.0]])
        pull = EA / l0 * (size - l0) / size * d + (moment[:-1] - moment[1:]) / size * across
        force = np.zeros_like(x)
        force[:, :-1] += pull
        force[:, 1:] -= pull
        v = v + (0.5 if i == 0 else 1.0) * dt * force / mass
        v[1, -1] = 0.0
        x = x + dt * v
        turn = speed * dt * (i + 1)
        x[:, 0] = crank * math.cos(turn), crank * math.sin(turn)
    return np.interp(times, at, seen[:, 0]), np.interp(times, at, seen[:, 1])


def _double_pendulum_energies(
    angles: np.ndarray, rates: np.ndarray, masses: Any, lengths: Any, centers: Any, inertias: Any, gravity: float
) -> tuple[Any, Any]:
    """Kinetic and potential from the places and velocities of the centres of mass; complex angles are allowed."""
    way = [np.array([np.sin(a), -np.cos(a)]) for a in angles]
    pace = [np.array([np.cos(a), np.sin(a)]) * r for a, r in zip(angles, rates)]
    places = (centers[0] * way[0], lengths[0] * way[0] + centers[1] * way[1])
    velocities = (centers[0] * pace[0], lengths[0] * pace[0] + centers[1] * pace[1])
    kinetic = sum(0.5 * m * (v**2).sum() + 0.5 * i * r**2 for m, v, i, r in zip(masses, velocities, inertias, rates))
    return kinetic, sum(m * gravity * x[1] for m, x in zip(masses, places))


def _check_rigid() -> None:
    angle, h, (crank, rod) = np.linspace(-7.0, 7.0, 1001), 1e-5, (0.15, 0.30)
    ahead, behind = (slider_crank_kinematics(angle + z, crank, rod) for z in (h, -h))
    for name, a, b, v in zip(["pin", "slider", "rod"], ahead, behind, slider_crank_velocities(angle, 2.0, crank, rod)):
        print(f"slider-crank {name}: velocity {np.abs((a - b) / h - v).max() / np.abs(v).max():.1e} from differences")
    for sizes in ((0.1, 0.3, 0.25, 0.35), (0.2, 0.15, 0.2, 0.3)):
        for branch in (1, -1):
            pin, far = four_bar_kinematics(angle, *sizes, branch=branch)
            gap = np.stack([np.linalg.norm(far - pin, axis=1) - sizes[1],
                            np.linalg.norm(far - [sizes[3], 0.0], axis=1) - sizes[2]])  # fmt: skip
            d = np.linalg.norm(pin - [sizes[3], 0.0], axis=1)
            closes = (d <= sizes[1] + sizes[2]) & (d >= abs(sizes[1] - sizes[2]))
            assert np.array_equal(closes, np.isfinite(far).all(1))
            print(f"four-bar {sizes}, {branch}: lengths {np.nanmax(np.abs(gap)):.1e} m, closes {closes.mean():.0%}")


def _check_pendulum() -> None:
    link: dict[str, Any] = {"masses": (1.3, 0.7), "lengths": (0.5, 0.8), "centers": (0.21, 0.47),
                            "inertias": (0.03, 0.05), "gravity": 9.81}  # fmt: skip
    terms, rng, worst = _double_pendulum_terms(**link), np.random.default_rng(0), 0.0

    def energies(q, v):
        return _double_pendulum_energies(q, v, **link)

    for _ in range(200):
        q, v = rng.uniform(-4.0, 4.0, 2), rng.uniform(-6.0, 6.0, 2)
        acc = _double_pendulum_acceleration(terms, q, v)

        def momentum(t, q=q, v=v, acc=acc):
            x, r = q + v * t + 0.5 * acc * t**2, v + acc * t
            # T is quadratic in the rates: its central difference is exact
            return np.array([0.5 * (energies(x, r + e)[0] - energies(x, r - e)[0]) for e in np.eye(2)])

        h = 3e-4
        rate = (8.0 * (momentum(h) - momentum(-h)) - momentum(2.0 * h) + momentum(-2.0 * h)) / (12.0 * h)
        slope = []
        for e in np.eye(2):
            kinetic, potential = energies(q + 1e-30j * e, v)
            slope.append((kinetic - potential).imag / 1e-30)
        worst = max(worst, np.abs(rate - slope).max() / max(1.0, np.abs(slope).max()))
    t = np.linspace(0.0, 5.0, 501)
    angles, rates = double_pendulum(t, angles=(2.6, 2.0), rates=(0.5, -1.0), **link)
    total = np.array([sum(energies(q, v)) for q, v in zip(angles, rates)])
    potential = np.array([energies(q, v)[1] for q, v in zip(angles, rates)])
    print(f"double pendulum: Lagrange {worst:.1e}, energy {np.abs(total - total[0]).max() / np.ptp(potential):.1e} of "
          f"its range, second angle {angles[:, 1].min():.1f} to {angles[:, 1].max():.1f}")  # fmt: skip


def _linear(t: np.ndarray, *, modes: int, crank: float, rod: float, speed: float, E: float, density: float,
            side: float, slider_mass: float) -> np.ndarray:  # fmt: skip
    """Middle of a pinned beam, without axial force, under the inertia of the rigid rod's acceleration across it."""
    k = np.arange(1, modes + 1)
    stiff = E * side**2 / (12.0 * density) * (k * np.pi / rod) ** 4

    def rhs(t, y):
        pin, _, psi = slider_crank_kinematics(speed * t, crank, rod)
        turn = slider_crank_velocities(speed * t, speed, crank, rod)[2]
        spin = (turn**2 * np.sin(psi) * rod + pin[1] * speed**2) / (rod * np.cos(psi))
        first = speed**2 * (pin[0] * np.sin(psi) - pin[1] * np.cos(psi))  # at the crank pin; + spin s along the rod
        load = 2.0 / (k * np.pi) * (first * (1.0 - (-1.0) ** k) - spin * rod * (-1.0) ** k)
        return np.concatenate([y[modes:], -load - stiff * y[:modes]])

    return _integrate(rhs, np.zeros(2 * modes), t, 1e-10, 1e-14)[:, :modes] @ np.sin(0.5 * np.pi * k)


def _check_elastic() -> None:
    """Of `floating_frame_slider_crank`, over the first turn with the `STANDARD` data where no other is named.

    - Middle of the rod: 1.6370e-3 m at 3.90 ms, -1.8652e-3 m at 35.90 ms; of that largest value:
    - 2 instead of 4 modes 0.51 %, 6 and 8 modes 0.05 %; 2 axial shapes 0.02 %, none 0.16 %. The slider: 4e-6 m with 6
      or 8 modes, 3e-6 m with 2 axial shapes, 3.4e-5 m with none: the axial ringing, at 18100 rad/s, is then left out.
      64 Gauss points 1e-16 m, rtol 1e-11 2e-13 m.
    - The chain of point masses, carried to its limit: 4 modes 0.07 %, slider 7e-6 m; 6 modes 0.03 %, 4e-6 m. With
      E = 25 GPa, deflection 5.4 % of the rod, half a turn: 0.06 % and 0.03 %.
    - Rigid limit: deflection and the slider's distance from the closed form fall in proportion to 1 / E (1.6e-5 and
      3.4e-7 m at 100 E).
    - Linear limit, a pinned beam under the rigid rod's inertia, without axial force: 12 %, 1.3 %, 0.4 % at E, 10 E,
      100 E (at last the phase of the ringing, that goes with 1 / sqrt(E)): what the axial force does is not small.
    - Energy of rod and slider against the work of the pin's force, which Newton's law gives: 1e-9 J of 55 J.
    """
    turn = 2.0 * np.pi / STANDARD["speed"]
    t = np.linspace(0.0, turn, 2001)

    def away(name, a, b):
        part = [np.abs(x - y).max() for x, y in zip(a, b)]
        print(f"{name}: deflection {part[0]:.1e} m ({part[0] / np.abs(b[0]).max():.2%}), slider {part[1]:.1e} m")

    base = floating_frame_slider_crank(t, **STANDARD)
    i, j = base[0].argmax(), base[0].argmin()
    print(f"mid-rod deflection {base[0][i]:.4e} m at {t[i]:.5f} s, {base[0][j]:.4e} m at {t[j]:.5f} s")
    for change in ({"modes": 2}, {"modes": 6}, {"modes": 8}, {"axial": 0}, {"axial": 2}, {"points": 64},
                   {"rtol": 1e-7}, {"rtol": 1e-11}):  # fmt: skip
        away(f"from {change}", base, floating_frame_slider_crank(t, **STANDARD, **change))

    soft, short = STANDARD | {"E": 2.5e10}, t[: len(t) // 2]
    for name, data, at in (("chain", STANDARD, t), ("chain, E = 25 GPa", soft, short)):
        coarse, fine = (_chain_slider_crank(at, n, **data) for n in (40, 80))
        limit = tuple(b + (b - a) / 3.0 for a, b in zip(coarse, fine))
        away(f"{name}, 40 to 80 segments", coarse, fine)
        for modes in (4, 6):
            away(f"{name} to 1 / n^2, {modes} modes", floating_frame_slider_crank(at, **data, modes=modes), limit)
        print(f"    deflection / rod to {np.abs(limit[0]).max() / data['rod']:.3f}")

    few = t[: len(t) // 5]
    rigid = slider_crank_kinematics(STANDARD["speed"] * few, STANDARD["crank"], STANDARD["rod"])[1]
    for factor in (1.0, 10.0, 100.0):
        data = STANDARD | {"E": factor * STANDARD["E"]}
        got = floating_frame_slider_crank(few, **data, modes=2)
        print(f"E x {factor:.0f}: deflection {np.abs(got[0]).max():.2e} m, slider {np.abs(got[1] - rigid).max():.2e} m "
              f"from the rigid one, {np.abs(got[0] - _linear(few, modes=2, **data)).max() / np.abs(got[0]).max():.2%} "
              "from the linear beam")  # fmt: skip

    for name, data, at in (("standard", STANDARD, t), ("E = 25 GPa", soft, short)):
        model = _Rod(**data, modes=4, axial=1, points=32)

        def rhs(t, y, model=model):
            return np.append(model.rhs(t, y[:-1]), model.power(t, y[:-1]))

        atol = np.append(_tolerance(model, 1e-9, 4), 1e-9)
        y = _integrate(rhs, np.zeros(2 * model.n + 1), at, 1e-9, atol)
        energy = np.array([model.energy(t, x[:-1]) for t, x in zip(at, y)])
        print(f"{name}: energy {energy.min():.1f} to {energy.max():.1f} J, from the work of the pin's force "
              f"{np.abs(energy - energy[0] - y[:, -1]).max():.1e} J")  # fmt: skip


if __name__ == "__main__":
    _check_rigid()
    _check_pendulum()
    _check_elastic()
