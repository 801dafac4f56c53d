"""`warpfea study mechanism-models`: the checks that the docstrings of the reference models quote (about a minute)."""

from __future__ import annotations

import argparse
import math
from typing import Any

import numpy as np

from .rigid import (
    STANDARD,
    double_pendulum_acceleration,
    double_pendulum_motion,
    double_pendulum_terms,
    four_bar_kinematics,
    integrate,
    slider_crank_kinematics,
    slider_crank_velocities,
)
from .rod import Rod, floating_frame_slider_crank, tolerance

__all__ = ["run"]


def run(options: argparse.Namespace) -> None:
    """Do `warpfea study mechanism-models`."""
    _check_rigid()
    _check_pendulum()
    _check_elastic()


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
    terms, rng, worst = double_pendulum_terms(**link), np.random.default_rng(0), 0.0

    def energies(q, v):
        return _double_pendulum_energies(q, v, **link)

    for _ in range(200):
        q, v = rng.uniform(-4.0, 4.0, 2), rng.uniform(-6.0, 6.0, 2)
        acc = double_pendulum_acceleration(terms, q, v)

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
    angles, rates = double_pendulum_motion(t, angles=(2.6, 2.0), rates=(0.5, -1.0), **link)
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

    return integrate(rhs, np.zeros(2 * modes), t, 1e-10, 1e-14)[:, :modes] @ np.sin(0.5 * np.pi * k)


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
        model = Rod(**data, modes=4, axial=1, points=32)

        def rhs(t, y, model=model):
            return np.append(model.rhs(t, y[:-1]), model.power(t, y[:-1]))

        atol = np.append(tolerance(model, 1e-9, 4), 1e-9)
        y = integrate(rhs, np.zeros(2 * model.n + 1), at, 1e-9, atol)
        energy = np.array([model.energy(t, x[:-1]) for t, x in zip(at, y)])
        print(f"{name}: energy {energy.min():.1f} to {energy.max():.1f} J, from the work of the pin's force "
              f"{np.abs(energy - energy[0] - y[:, -1]).max():.1e} J")  # fmt: skip
