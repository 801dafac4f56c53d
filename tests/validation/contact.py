"""Deformable bodies on rigid obstacles beside Hertz and Mindlin, a ball beside finer runs, bodies that friction holds.

hertz      a rigid sphere on a quarter block 60 contact radii deep: contact radius and peak pressure, from a line
           through the squares of the points' pressures, beside those of the force.
mindlin    the same on a half block with friction, then sideways: stiffness ratio, and where all slips.
rebound    an elastic ball on a plane: restitution and duration, and those of a quarter of the step and half the mesh.
wall       a cube pressed to a wall: how far it moves in 10 s, after 10 s of settling.
turntable  a cube on a plate that turns: how far it moves on it in ten turns; the paper's law walks.
stack      ten cubes on each other: how far they move in 10 s, also under a last one of a thousand times the mass.
"""

from __future__ import annotations

import itertools
import math
import time as clock
from collections.abc import Callable
from typing import Any

import numpy as np

import warpfea as wf
from warpfea.contact.colliders import ColliderContact
from warpfea.simulation.statics import begin_static, run_static

from .table import Part, Row, Table, cases

__all__ = ["TABLE", "hertz_case", "rebound_case", "stack_case", "turntable_case", "wall_case"]

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
    *, nu: float, inner: int, outer: int, depth: float, half: bool, path: Any, mu: float, stiffness: float | None
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
    chosen: Any = {} if stiffness is None else {"stiffness": ("region", stiffness), "radius": A}
    pad = b.add_contact(body.surface("z+"), sphere, mu=mu, name="pad", **chosen)
    return b, body, pad


def point_pressures(sim: wf.Simulation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance to the axis (points,), m, pressure, Pa, and area, m^2, of the contact's points."""
    (term,) = (term for term in sim.model.terms.all if isinstance(term, ColliderContact))
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


def fit_errors(r: np.ndarray, pressure: np.ndarray, area: np.ndarray, radius: float, peak: float) -> Row:
    """Fitted contact radius and peak pressure beside expected ones, and the scatter of the pressures, over the peak."""
    a, p0 = fitted_pressure(r, pressure, area, radius)
    inside = (r < 0.9 * radius) & (area > 0.0)
    expected = p0 * np.sqrt(np.maximum(1.0 - (r[inside] / a) ** 2, 0.0))
    scatter = float(np.sqrt(np.average((pressure[inside] - expected) ** 2, weights=area[inside])) / p0)
    return {"points_inside": int(inside.sum()), "a": a, "p0": p0, "a_error": a / radius - 1.0,
            "p0_error": p0 / peak - 1.0, "pressure_scatter": scatter}  # fmt: skip


def solved(b: wf.ModelBuilder, load_steps: int, device: Any) -> tuple[wf.Simulation, Any, float]:
    """The simulation at full load, its result and the seconds of the solution, without compilation."""
    sim = begin_static(b.finalize(device=device), load_steps=load_steps)
    began = clock.perf_counter()
    found = run_static(sim, unstable="ignore")
    return sim, found, clock.perf_counter() - began


def hertz_case(
    nu: float, *, inner: int = 8, outer: int = 8, depth: float = 60.0, stiffness: float | None = None,
    load_steps: int = 4, device: Any = "cpu",
) -> dict[str, Any]:  # fmt: skip
    """Press the sphere in by A^2/R, and compare the fitted radius and peak pressure with Hertz's of the force."""
    path = ([0.0, 1.0], [(0.0, 0.0, 0.0), (0.0, 0.0, -(A**2))])
    b, _, pad = block(nu=nu, inner=inner, outer=outer, depth=depth, half=False, path=path, mu=0.0, stiffness=stiffness)
    sim, found, seconds = solved(b, load_steps, device)
    force = 4.0 * abs(float(found.contact_force(pad)[0, 2]))
    modulus = E / (1.0 - nu**2)
    radius = (0.75 * force / modulus) ** (1.0 / 3.0)
    peak = 1.5 * force / (math.pi * radius**2)
    penetration = float(sim.contact_record(pad).penetration[0, -1])
    return {
        "nu": nu, "unknowns": int(sim.model.free_slots.sum()), "cells_per_radius": inner / WIDTH,
        "depth_over_a": depth * A / radius, "a_over_R": radius, "stiffness": stiffness, "force": force,
        "force_over_hertz": force / (4.0 / 3.0 * modulus * A**3), **fit_errors(*point_pressures(sim), radius, peak),
        "penalty_share": penetration / A**2, "load_steps": load_steps, "newton": int(found.newton[0]),
        "pcg": int(found.pcg[0]), "seconds": seconds,
    }  # fmt: skip


NORMAL = (0.2, 0.4, 0.6, 0.8, 1.0)
FRACTIONS = (0.02, 0.1, 0.25, 0.5, 0.7, 0.8, 0.85, 0.9, 0.925, 0.95, 0.975, 1.0, 1.025, 1.05, 1.1)


def mindlin_case(
    nu: float = 0.45, *, mu: float = 0.3, inner: int = 4, outer: int = 5, depth: float = 60.0,
    stiffness: float | None = None, fractions: Any = FRACTIONS, pressed_mu: float = 0.0, device: Any = "cpu",
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
        "nu": nu, "mu": mu, "unknowns": int(model.free_slots.sum()), "cells_per_radius": inner / WIDTH,
        "depth_over_a": depth * A / radius, "stiffness": stiffness, "pressed_mu": pressed_mu,
        "pressed_share": float(tangent[last] / (mu * normal[last])), "normal_power": float(power),
        "normal_force": float(N[0]), "a": float(radius), "first_share": float(share[0]),
        "slope_ratio": float(k_tangent / k_normal),
        "slope_ratio_error": float(k_tangent / k_normal / (2.0 * (1.0 - nu) / (2.0 - nu)) - 1.0),
        "normal_stiffness_error": float(k_normal / (2.0 * modulus * radius) - 1.0),
        "tangential_stiffness_error": float(k_tangent / (8.0 * shear * radius / (2.0 - nu)) - 1.0),
        "full_slip": float(full), "full_slip_fitted_error": float(-top / slope / full - 1.0),
        "full_slip_first_error": float(way[slid[0]] / full - 1.0) if len(slid) else None,
        "displacement_over_full": (way / full).tolist(), "force_share": share.tolist(),
        "mindlin_share": expected.tolist(), "stick": stick.tolist(), "load_steps": steps, "newton": sum(newton),
        "newton_most": max(newton), "newton_per_step": newton, "halvings": halvings,
        "pcg": int(sim.totals["pcg"][0]), "seconds": seconds,
    }  # fmt: skip


RADIUS, BALL_E, NU, DENSITY, THROWN = 0.05, 1e6, 0.3, 1000.0, 1.0


def hertz_time() -> float:
    """Duration of Hertz's impact of the ball on a rigid plane, s."""
    mass = DENSITY * 4.0 / 3.0 * math.pi * RADIUS**3
    modulus = BALL_E / (1.0 - NU**2)
    return 2.87 * (mass**2 / (RADIUS * modulus**2 * THROWN)) ** 0.2


def rebound_case(
    *, cells: int = 6, steps: int = 50, stiffness: float = 100.0, integrator: str = "bdf2", device: Any = "cpu"
) -> dict[str, Any]:
    """A ball of T10 that falls on a half-space without gravity, damping or friction; `steps` per Hertz's duration.

    The speed after it is that of the centre of mass, by the impulse of the contact's records. The duration is between
    the times at which the force first exceeds and last falls below 1 % of its largest, linearly between steps.
    """
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.sphere(RADIUS, cells=cells, center=(0, 0, RADIUS))
    ball = b.add_solid(mesh, material=wf.SVK(E=BALL_E, nu=NU, density=DENSITY), name="ball")
    b.set_initial(ball, velocity=(0, 0, -THROWN))
    floor = b.add_collider(wf.HalfSpace((0, 0, 1), 0.0), name="floor")
    pad = b.add_contact(ball, floor, restitution=1.0, stiffness=("region", stiffness), radius=0.3 * RADIUS, name="pad")
    model = b.finalize(device=device)
    dt = hertz_time() / steps
    sim = wf.Simulation(model, dt=dt, integrator=integrator)
    newton: list[int] = []
    halvings = resting = 0
    began = clock.perf_counter()
    while resting < 5 and len(newton) < 3 * steps:
        report = sim.step()
        newton.append(int(report.newton[0]))
        halvings += int(report.halvings[0])
        touching = float(sim.contact_record(pad).normal_force[0, -1]) > 0.0
        resting = 0 if touching or len(newton) < steps // 4 else resting + 1
    seconds = clock.perf_counter() - began
    record = sim.contact_record(pad)
    force, time = np.concatenate([[0.0], record.force[0, :, 2]]), np.concatenate([[0.0], record.time])
    low = 0.01 * force.max()
    over = np.flatnonzero(force > low)
    first, last = over[0], over[-1]
    start = np.interp(low, force[first - 1 : first + 1], time[first - 1 : first + 1])
    end = time[last] + dt * (force[last] - low) / (force[last] - force[last + 1])
    assert model.mass is not None
    mass = float(model.mass)
    energies = sim.energies()
    return {
        "cells": cells, "unknowns": int(model.free_slots.sum()), "dt": dt, "integrator": integrator,
        "stiffness": stiffness, "restitution": float(force.sum() * dt / mass / THROWN - 1.0),
        "duration": float(end - start), "duration_over_hertz": float((end - start) / hertz_time()),
        "force_most": float(force.max()),
        "ledger_residual": float(energies["ledger_residual"][0] / (0.5 * mass * THROWN**2)),
        "kinetic": float(energies["kinetic"][0] / (0.5 * mass * THROWN**2)),
        "strain": float(energies["strain"][0] / (0.5 * mass * THROWN**2)),
        "integrator_loss": float(energies["integrator"][0] / (0.5 * mass * THROWN**2)), "steps": len(newton),
        "newton": sum(newton), "newton_most": max(newton), "halvings": halvings, "pcg": int(sim.totals["pcg"][0]),
        "seconds": seconds,
    }  # fmt: skip


EDGE, G = 0.1, 9.81
CUBE = {"edge": EDGE, "mass": 1.0, "nu": 0.3, "tol": 1e-10}
"""Of 1000 kg/m^3."""
PRESSED, DT = 20.0, 1e-2
SPEED, TURN_STEPS = 10.0, 200
REST, RAMP = 200, 20
"""Steps before the plate turns, and those in which it comes to its speed."""


def _cube(b: wf.ModelBuilder, element: str, E: float, origin: tuple[float, float, float]) -> Any:
    mesh = wf.mesh.box((EDGE, EDGE, EDGE), cells=(1, 1, 1), element=element, origin=origin)
    return b.add_solid(mesh, material=wf.SVK(E=E, nu=0.3, density=1000.0), name="cube")


def _simulation(b: wf.ModelBuilder, dt: float, device: Any) -> wf.Simulation:
    return wf.Simulation(b.finalize(device=device), dt=dt, solver=wf.NewtonPCG(tol=CUBE["tol"]), record=False)


def _cost(sim: wf.Simulation, began: float) -> dict[str, Any]:
    """Steps, iterations, residual of the ledger and seconds of a run."""
    return {
        "steps": sim.steps, "newton": int(sim.totals["newton"][0]), "pcg": int(sim.totals["pcg"][0]),
        "ledger_residual": float(sim.energies()["ledger_residual"][0]), "seconds": clock.perf_counter() - began,
    }  # fmt: skip


def wall_case(element: str, *, settle: float = 10.0, hold: float = 10.0, device: Any = "cpu") -> dict[str, Any]:
    """A cube of E = 1e6 Pa that 20 N press to a wall of mu = 1 under its weight: how far any node moves in `hold` s
    after `settle` s from rest, m, and what the wall bears, N."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body = _cube(b, element, 1e6, (0.0, 0.0, 0.0))
    b.add_traction(body.surface("x+"), (-PRESSED / EDGE**2, 0, 0))
    wall = b.add_collider(wf.HalfSpace((1, 0, 0)), name="wall")
    pad = b.add_contact(body.surface("x-"), wall, mu=1.0, restitution=0.5, name="pad")
    sim = _simulation(b, DT, device)
    began = clock.perf_counter()
    sim.step(round(settle / DT))
    before = sim.positions(body).copy()
    sim.step(round(hold / DT))
    return {
        "element": element, "dt": DT, "settle_s": settle, "hold_s": hold,
        "moved": float(np.abs(sim.positions(body) - before).max()), "force": sim.contact_force(pad)[0, :3].tolist(),
        **_cost(sim, began),
    }  # fmt: skip


def turntable_case(law: str, *, turns: int = 10, device: Any = "cpu") -> dict[str, Any]:
    """A cube of E = 1e8 Pa on a plate that turns at 10 rad/s, 200 steps a turn: by how much its nodes have moved on the
    plate from the end of the first turn to that of the last, over its edge."""
    dt = 2.0 * math.pi / SPEED / TURN_STEPS
    first = REST + RAMP
    times = dt * np.arange(first + TURN_STEPS * turns + 1)
    angle = SPEED * dt * np.maximum(np.arange(len(times)) - REST - RAMP / 2, 0.0)
    angle[REST : first + 1] = 0.5 * SPEED * dt * np.arange(RAMP + 1) ** 2 / RAMP
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    centre = 0.5 * EDGE
    path = wf.Rotation(anchor=(centre, centre, 0), axis=(0, 0, 1), angle=(times, angle))
    plate = b.add_collider(wf.HalfSpace((0, 0, 1)), path=path, name="plate")
    body = _cube(b, "T4", 1e8, (0.2 * EDGE, 0.0, 0.0))
    b.add_contact(body.surface("z-"), plate, mu=0.8, restitution=0.5, stiffness=("region", 0.1), law=law, name="pad")
    sim = _simulation(b, dt, device)
    began = clock.perf_counter()
    sim.step(first)
    places = []
    for turn in range(turns):
        sim.step(TURN_STEPS)
        a = angle[first + TURN_STEPS * (turn + 1)]
        R = np.array([[math.cos(a), math.sin(a), 0], [-math.sin(a), math.cos(a), 0], [0, 0, 1]])
        places.append((sim.positions(body)[0] - (centre, centre, 0)) @ R.T)
    moved = [float(np.abs(place - places[0]).max() / EDGE) for place in places]
    return {"law": law, "dt": dt, "turns": turns, "moved": moved[-1], "moved_by_turn": moved, **_cost(sim, began)}


SIDE = 0.1
STACK_SIZE = {"side": SIDE, "density": DENSITY, "nu": 0.3, "mu": 0.5, "element": "T4", "cells": 1}
"""Of the cubes; the lowest is clamped below."""


def stack_case(
    E: float, top: float, *, cubes: int = 10, duration: float = 10.0, dt: float = 1e-2, stiffness: float = 20.0,
    device: Any = "cpu",
) -> dict[str, Any]:  # fmt: skip
    """Let a stack rest whose last cube is `top` times as heavy; creep is counted from a tenth of the duration on.

    A stack is a column whose joints turn: with springs of k = 3.3 10^-2 stiffness E side in the joints those of E = 1e7
    buckle by their weight at `stiffness` 1 (q L^3/EI = 16 > 7.84 of Greenhill's column), and not at 20 (2.2).
    """
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    bodies = []
    for k in range(cubes):
        mesh = wf.mesh.box((SIDE,) * 3, cells=(1, 1, 1), origin=(0, 0, k * SIDE), element="T4")
        density = DENSITY * (top if k == cubes - 1 else 1.0)
        bodies.append(b.add_solid(mesh, material=wf.SVK(E=E, nu=0.3, density=density), name=f"cube {k}"))
    b.clamp(bodies[0].nodes("z-"))
    pairs = [
        b.add_contact(upper, lower, mu=0.5, restitution=0.5, stiffness=("region", stiffness))
        for lower, upper in itertools.pairwise(bodies)
    ]
    sim = wf.Simulation(b.finalize(device=device), dt=dt)
    steps, rest = round(duration / dt), max(round(0.1 * duration / dt), round(0.5 / dt))
    newton: list[int] = []
    creep, began, places = 0.0, clock.perf_counter(), None
    for k in range(steps):
        newton.append(int(sim.step().newton[0]))
        now = np.stack([sim.positions(body)[0] for body in bodies])
        if k + 1 == rest:
            places = now
        elif places is not None:
            creep = max(creep, float(np.abs(now - places).max()) / SIDE)
    seconds = clock.perf_counter() - began
    mass = DENSITY * SIDE**3
    weight = [G * mass * (top + cubes - 2 - k) for k in range(cubes - 1)]
    records = [sim.contact_record(pair) for pair in pairs]
    force = [float(np.abs(record.force[0, -1, 2])) for record in records]
    return {
        "E": E, "top": top, "cubes": cubes, "duration": duration, "dt": dt, "stiffness": stiffness, "creep": creep,
        "creep_from": rest * dt, "penetration": max(float(record.penetration[0, -1]) for record in records) / SIDE,
        "force_error": max(abs(f / w - 1.0) for f, w in zip(force, weight)),
        "speed": max(float(np.abs(sim.velocities(body)[0]).max()) for body in bodies), "steps": steps,
        "newton": sum(newton), "newton_most": max(newton), "pcg": int(sim.totals["pcg"][0]), "seconds": seconds,
    }  # fmt: skip


CASES: dict[str, tuple[str, Callable[..., Row], list[Row]]] = {
    "hertz": ("two meshes at two Poisson's ratios", hertz_case,
              [{"nu": nu, "inner": i, "outer": o} for nu in (0.3, 0.45) for i, o in ((4, 5), (6, 6))]),
    "mindlin": ("two meshes", mindlin_case, [{"outer": outer} for outer in (5, 8)]),
    "rebound": ("the run, and with a quarter of its step and half its mesh size", rebound_case,
                [{"cells": 8 * k, "steps": 50 * k**2} for k in (1, 2)]),
    "wall": ("both tetrahedra", wall_case, [{"element": name} for name in ("T4", "T10")]),
    "turntable": ("the default law and the paper's", turntable_case, [{"law": law} for law in ("default", "paper")]),
    "stack": ("equal cubes, and a last one of a thousand times the mass, each soft and hard", stack_case,
              [{"E": E, "top": top} for E, top in ((1e7, 1.0), (1e10, 1.0), (2e9, 1e3), (1e10, 1e3))]),
}  # fmt: skip
"""Part -> its rows in words, function of a row, its arguments."""
PARTS: dict[str, Part] = {name: cases(about, case, rows) for name, (about, case, rows) in CASES.items()}
OUT = "--out tests/results/"
TABLE = Table(
    about=__doc__,
    parts=PARTS,
    results={
        "contact_hertz_cpu.json": f"contact --only hertz --only mindlin --only rebound {OUT}contact_hertz_cpu.json",
        "contact_rest_cpu.json": f"contact --only wall --only turntable {OUT}contact_rest_cpu.json",
        "contact_pairs_cpu.json": f"contact --only stack {OUT}contact_pairs_cpu.json",
    },
    settings={
        "block": {"E": E, "sphere_radius": 1.0, "contact_radius": A, "even_zone_in_radii": WIDTH, "tol": 1e-8},
        "ball": {"E": BALL_E, "nu": NU, "density": DENSITY, "radius": RADIUS, "speed": THROWN, "tol": 1e-8},
        "cube": CUBE,
        "stack": STACK_SIZE,
    },
)
