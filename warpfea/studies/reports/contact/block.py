"""A rigid sphere on a deep elastic block: Hertz's pressure, and Mindlin's tangential stiffness and full slip."""

from __future__ import annotations

import math
import time as clock
from typing import Any

import numpy as np

import warpfea as wf

from ....simulation.statics import begin_static, run_static
from ....terms.contact import Contact

__all__ = ["fitted_pressure", "hertz_case", "mindlin_case"]

E = 1e6
A = 0.01
"""Contact radius that is aimed at, m; the sphere's is 1 m."""
WIDTH = 1.3
"""Half of the evenly meshed zone, contact radii."""


def grading(inner: int, outer: int, depth: float) -> Any:
    """Map of a lattice of unit cells: cells of `inner` even ones to WIDTH A, then `outer` that grow up to `depth` A.

    Radial, along surfaces of the 6-norm: planes through the origin stay, and far cells keep their shape. Mid-edge nodes
    lie midway: edges join lattice points whose coordinates differ by 0 or 1 alike.
    """
    size = WIDTH * A / inner
    target = depth * A / size - inner
    low, high = 1e-6, 5.0
    for _ in range(100):
        rate = 0.5 * (low + high)
        low, high = (rate, high) if math.expm1(rate * outer) / rate < target else (low, rate)

    def corner(X: np.ndarray) -> np.ndarray:
        s = (np.abs(X) ** 6).sum(axis=1) ** (1.0 / 6.0)
        far = inner + np.expm1(rate * np.maximum(s - inner, 0.0)) / rate
        return size * X * np.where(s > inner, far / np.maximum(s, 1e-9), 1.0)[:, None]

    def place(X: np.ndarray) -> np.ndarray:
        twice = np.rint(2.0 * X)
        return 0.5 * (corner(np.floor(0.5 * twice)) + corner(np.ceil(0.5 * twice)))

    return place


def block(
    *, nu: float, inner: int, outer: int, depth: float, half: bool, path: Any, mu: float, stiffness: float
) -> tuple[wf.ModelBuilder, Any, Any]:
    """A quarter, or half, of a block under a sphere of 1 m whose path is given: builder, body and contact."""
    n = inner + outer
    low, wide = (-n, 2 * n) if half else (0, n)
    mesh = wf.mesh.box(
        (wide, n, n), cells=(wide, n, n), origin=(low, 0, -n), map=grading(inner, outer, depth), element="T10"
    )
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(mesh, material=wf.SVK(E=E, nu=nu, density=1000.0), name="block")
    for side in ("z-", "x+", "y+", *(["x-"] if half else [])):
        b.clamp(body.nodes(side))
    if not half:
        b.clamp(body.nodes("x-"), components="x")
    b.clamp(body.nodes("y-"), components="y")
    sphere = b.add_collider(wf.Sphere((0, 0, 1.0), 1.0), path=path, name="sphere")
    pad = b.add_contact(body.surface("z+"), sphere, mu=mu, stiffness=stiffness, radius=A, name="pad")
    return b, body, pad


def point_pressures(sim: wf.Simulation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance to the axis (points,), m, pressure, Pa, and area, m^2, of the contact's points."""
    (term,) = (term for term in sim.model.terms.all if isinstance(term, Contact))
    _, force = term.at_points(sim.state)
    (p,) = term.tables.host
    u = sim.state.displacement.numpy()[0][p.conn]
    x = p.X + np.einsum("fpl,flk->fpk", p.shape, u)
    area = p.area.ravel()
    return np.hypot(x[..., 0], x[..., 1]).ravel(), np.abs(force[0, :, 2]) / np.maximum(area, 1e-300), area


def fitted_pressure(r: np.ndarray, pressure: np.ndarray, area: np.ndarray, radius: float) -> tuple[float, float]:
    """Contact radius and peak pressure of p^2 = p0^2 (1 - r^2/a^2), by area within 0.9 of an expected radius."""
    used = (r < 0.9 * radius) & (area > 0.0)
    w = np.sqrt(area[used])
    columns = np.stack([np.ones(used.sum()), r[used] ** 2], axis=1) * w[:, None]
    (top, slope), *_ = np.linalg.lstsq(columns, pressure[used] ** 2 * w, rcond=None)
    return math.sqrt(-top / slope), math.sqrt(top)


def hertz_case(
    nu: float, *, inner: int = 8, outer: int = 8, depth: float = 60.0, stiffness: float = 300.0, load_steps: int = 4,
    device: Any = "cpu",
) -> dict[str, Any]:  # fmt: skip
    """Press the sphere in by A^2/R, and compare the fitted radius and peak pressure with Hertz's of the force."""
    path = ([0.0, 1.0], [(0.0, 0.0, 0.0), (0.0, 0.0, -(A**2))])
    b, _, pad = block(nu=nu, inner=inner, outer=outer, depth=depth, half=False, path=path, mu=0.0, stiffness=stiffness)
    model = b.finalize(device=device)
    sim = begin_static(model, load_steps=load_steps)  # compiles, so that the time is that of the solution
    began = clock.perf_counter()
    found = run_static(sim, unstable="ignore")
    seconds = clock.perf_counter() - began
    force = 4.0 * abs(float(found.contact_force(pad)[0, 2]))
    modulus = E / (1.0 - nu**2)
    radius = (0.75 * force / modulus) ** (1.0 / 3.0)
    peak = 1.5 * force / (math.pi * radius**2)
    r, pressure, area = point_pressures(sim)
    a, p0 = fitted_pressure(r, pressure, area, radius)
    inside = (r < 0.9 * radius) & (area > 0.0)
    expected = p0 * np.sqrt(1.0 - (r[inside] / a) ** 2)
    scatter = np.sqrt(np.average((pressure[inside] - expected) ** 2, weights=area[inside])) / p0
    penetration = float(sim.contact_record(pad).penetration[0, -1])
    return {
        "nu": nu,
        "unknowns": int(model.free_slots.sum()),
        "cells_per_radius": inner / WIDTH,
        "depth_over_a": depth * A / radius,
        "a_over_R": radius,
        "stiffness": stiffness,
        "force": force,
        "force_over_hertz": force / (4.0 / 3.0 * modulus * A**3),
        "a": a,
        "p0": p0,
        "a_error": a / radius - 1.0,
        "p0_error": p0 / peak - 1.0,
        "pressure_scatter": float(scatter),
        "penalty_share": penetration / A**2,
        "load_steps": load_steps,
        "newton": int(found.newton[0]),
        "pcg": int(found.pcg[0]),
        "seconds": seconds,
    }


NORMAL = (0.2, 0.4, 0.6, 0.8, 1.0)
FRACTIONS = (0.02, 0.1, 0.25, 0.5, 0.7, 0.8, 0.85, 0.9, 0.925, 0.95, 0.975, 1.0, 1.025, 1.05, 1.1)


def mindlin_case(
    nu: float = 0.45, *, mu: float = 0.3, inner: int = 4, outer: int = 5, depth: float = 60.0, stiffness: float = 300.0,
    fractions: Any = FRACTIONS, pressed_mu: float = 0.0, device: Any = "cpu",
) -> dict[str, Any]:  # fmt: skip
    """Press the sphere in, then move it sideways beyond full slip; stiffnesses and slip beside Mindlin's.

    The stiffness against pressing is the slope of a power law through the steps, that against shearing the first
    tangential step's, corrected for the slip that Mindlin gives at its Q. Mindlin begins without tangential traction:
    friction is there from the first tangential step on, or with `pressed_mu` while the sphere is pressed in.
    """
    shear = E / (2.0 * (1.0 + nu))
    modulus = E / (1.0 - nu**2)
    aim = mu * A**2 * (2.0 - nu) / (2.0 * (1.0 - nu))  # 3 mu N (2 - nu)/(16 G A), N by Hertz of A
    places = [(0.0, 0.0, 0.0)] + [(0.0, 0.0, -d * A**2) for d in NORMAL]
    places += [(f * aim, 0.0, -(A**2)) for f in fractions]
    steps = len(places) - 1
    path = (np.linspace(0.0, 1.0, steps + 1), places)
    b, _, pad = block(nu=nu, inner=inner, outer=outer, depth=depth, half=True, path=path, mu=mu, stiffness=stiffness)
    model = b.finalize(device=device)
    sim = begin_static(model, load_steps=steps)
    newton, halvings = [], 0
    model.set_parameter("pad.mu", pressed_mu)
    model.set_parameter("pad.mu_static", pressed_mu)
    began = clock.perf_counter()
    for k in range(steps):
        if k == len(NORMAL):
            model.set_parameter("pad.mu_static", mu)
            model.set_parameter("pad.mu", mu)
        report = sim.step()
        newton.append(int(report.newton[0]))
        halvings += int(report.halvings[0])
    seconds = clock.perf_counter() - began
    record = sim.contact_record(pad)
    normal, tangent = 2.0 * np.abs(record.force[0, :, 2]), 2.0 * np.abs(record.force[0, :, 0])
    last = len(NORMAL) - 1
    power, _ = np.polyfit(np.log(NORMAL[1:]), np.log(normal[1 : last + 1]), 1)
    k_normal = power * normal[last] / A**2
    N, Q = normal[last + 1 :], tangent[last + 1 :] - tangent[last]
    way = np.array(fractions) * aim
    share = Q / (mu * N)
    radius = (0.75 * N[0] / modulus) ** (1.0 / 3.0)
    full = 3.0 * mu * N[0] * (2.0 - nu) / (16.0 * shear * radius)
    secant = 1.5 * (1.0 - (1.0 - share[0]) ** (2.0 / 3.0)) / share[0]
    k_tangent = Q[0] / way[0] * secant
    stick = record.stick[0, last + 1 :]
    slid = np.flatnonzero(stick < 1e-9)
    # of (1 - Q/(mu N))^(2/3) = 1 - way/full: where a line through the points below full slip ends
    used = (share > 0.1) & (share < 0.98)
    slope, top = np.polyfit(way[used], (1.0 - share[used]) ** (2.0 / 3.0), 1)
    expected = 1.0 - np.maximum(1.0 - way / full, 0.0) ** 1.5
    return {
        "nu": nu,
        "mu": mu,
        "unknowns": int(model.free_slots.sum()),
        "cells_per_radius": inner / WIDTH,
        "depth_over_a": depth * A / radius,
        "stiffness": stiffness,
        "pressed_mu": pressed_mu,
        "pressed_share": float(tangent[last] / (mu * normal[last])),
        "normal_power": float(power),
        "normal_force": float(N[0]),
        "a": float(radius),
        "first_share": float(share[0]),
        "slope_ratio": float(k_tangent / k_normal),
        "slope_ratio_error": float(k_tangent / k_normal / (2.0 * (1.0 - nu) / (2.0 - nu)) - 1.0),
        "normal_stiffness_error": float(k_normal / (2.0 * modulus * radius) - 1.0),
        "tangential_stiffness_error": float(k_tangent / (8.0 * shear * radius / (2.0 - nu)) - 1.0),
        "full_slip": float(full),
        "full_slip_fitted_error": float(-top / slope / full - 1.0),
        "full_slip_first_error": float(way[slid[0]] / full - 1.0) if len(slid) else None,
        "displacement_over_full": (way / full).tolist(),
        "force_share": share.tolist(),
        "mindlin_share": expected.tolist(),
        "stick": stick.tolist(),
        "load_steps": steps,
        "newton": sum(newton),
        "newton_most": max(newton),
        "newton_per_step": newton,
        "halvings": halvings,
        "pcg": int(sim.totals["pcg"][0]),
        "seconds": seconds,
    }
