"""Two elastic bodies pressed together, with meshes that do not match: balls and cylinders beside Hertz."""

from __future__ import annotations

import math
import time as clock
from typing import Any

import numpy as np

import warpfea as wf

from ....simulation.statics import begin_static, run_static
from ....terms.pairs import Pairs
from .block import WIDTH, A, E, fitted_pressure, grading

__all__ = ["RADIUS", "balls_case", "cylinders_case"]

RADIUS = 2.0
"""Of each surface, m: of both together 1 m."""
MODULI = (E, 2.0 * E)
"""Of the lower body and of the upper one, Pa."""


FLAT = 10.0
"""Beyond so many contact radii faces level off: 5 10^-5 of the curvature there, and far elements keep their shape."""


def _curved(place: Any, inner: int, flip: bool, across: tuple[int, ...]) -> Any:
    """A graded block whose upper face is a paraboloid, or a parabolic cylinder; turned over for the upper body.

    Edges are curved in the evenly meshed zone only: far elements are too long for it.
    """

    def drop(X: np.ndarray) -> np.ndarray:
        square = (place(X)[:, across] ** 2).sum(axis=1)
        return np.asarray(square / (2.0 * RADIUS) / np.sqrt(1.0 + (square / (FLAT * A) ** 2) ** 2))

    def done(X: np.ndarray) -> np.ndarray:
        twice = np.rint(2.0 * X)
        ends = [np.floor(0.5 * twice), np.ceil(0.5 * twice)]
        near = np.max([np.abs(e[:, (0, 2)] if len(across) == 1 else e).max(axis=1) for e in ends], axis=0) <= inner
        x = place(X)
        x[:, 2] -= np.where(near, drop(X), 0.5 * (drop(ends[0]) + drop(ends[1])))
        if not flip:
            return x
        return np.asarray(x[:, [1, 0, 2]] * (1.0, 1.0, -1.0) if len(across) == 2 else x * (1.0, -1.0, -1.0))

    return done


def _pressures(sim: wf.Simulation, across: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance to the axis (points,), m, pressure, Pa, and area, m^2, of the points of the slave surface."""
    (term,) = (term for term in sim.model.terms.all if isinstance(term, Pairs))
    (p,) = term.tables.host
    force = sim.stepper.at.scratch[term.name]["attempt"].force.numpy()[0]
    state = sim.stepper.at.scratch[term.name]["attempt"].state.numpy()[0]
    u = sim.state.displacement.numpy()[0][p.conn + term.tables.contacts[0].slave.body.slot_offset]
    x = (p.X + np.einsum("fpl,flk->fpk", p.shape, u)).reshape(-1, 3)
    area = p.area.ravel()
    pressure = np.where(state != 0, np.abs(force[:, 2]), 0.0) / np.maximum(area, 1e-300)
    return np.linalg.norm(x[:, across], axis=1), pressure, area


def _solve(
    b: wf.ModelBuilder, pair: Any, load_steps: int, device: Any
) -> tuple[wf.Simulation, Any, float]:  # fmt: skip
    """The simulation at full load, its result and seconds of the solution."""
    model = b.finalize(device=device)
    sim = begin_static(model, load_steps=load_steps)  # compiles, so that the time is that of the solution
    began = clock.perf_counter()
    found = run_static(sim, unstable="ignore")
    return sim, found, clock.perf_counter() - began


def _row(
    sim: wf.Simulation, found: Any, pair: Any, across: tuple[int, ...], radius: float, peak: float
) -> dict[str, Any]:  # fmt: skip
    """Width and pressure beside Hertz's."""
    r, pressure, area = _pressures(sim, across)
    a, p0 = fitted_pressure(r, pressure, area, radius)
    inside = (r < 0.9 * radius) & (area > 0.0)
    expected = p0 * np.sqrt(np.maximum(1.0 - (r[inside] / a) ** 2, 0.0))
    return {
        "unknowns": int(sim.model.free_slots.sum()),
        "slave": pair.slave.body.name,
        "points_inside": int(inside.sum()),
        "a": a,
        "p0": p0,
        "a_error": a / radius - 1.0,
        "p0_error": p0 / peak - 1.0,
        "pressure_scatter": float(np.sqrt(np.average((pressure[inside] - expected) ** 2, weights=area[inside])) / p0),
        "penetration": float(sim.contact_record(pair).penetration[0, -1]),
        "newton": int(found.newton[0]),
        "pcg": int(found.pcg[0]),
    }


def balls_case(
    nu: float = 0.3, *, inner: tuple[int, int] = (4, 5), outer: tuple[int, int] = (5, 6), depth: float = 60.0,
    stiffness: float = 300.0, load_steps: int = 4, device: Any = "cpu",
) -> dict[str, Any]:  # fmt: skip
    """Press a quarter of one elastic ball into that of another of twice the modulus by A^2/R, R = 1 m of both.

    The approach of Hertz is that of points far away; here of the outer faces, `depth` A away, where the bodies still
    move by F (1 - nu^2)/(pi E depth A) each: `approach_error` is without a correction.
    """
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bodies = []
    for k, name in enumerate(("lower", "upper")):
        n = inner[k] + outer[k]
        place = _curved(grading(inner[k], outer[k], depth), inner[k], k == 1, (0, 1))
        mesh = wf.mesh.box((n, n, n), cells=(n, n, n), origin=(0, 0, -n), map=place, element="T10")
        body = b.add_solid(mesh, material=wf.SVK(E=MODULI[k], nu=nu, density=1000.0), name=name)
        sides = ("x-", "y-") if k == 0 else ("y-", "x-")
        for side in ("z-", "x+", "y+"):
            if k == 0:
                b.clamp(body.nodes(side))
            else:
                b.clamp(body.nodes(side), components="xy")
                b.drive(body.nodes(side), displacement=([0.0, 1.0], [(0, 0, 0), (0, 0, -(A**2))]), components="z")
        for side, axis in zip(sides, "xy"):
            b.clamp(body.nodes(side), components=axis)
        bodies.append(body)
    pair = b.add_contact(bodies[0].surface("z+"), bodies[1].surface("z+"), stiffness=stiffness, radius=A, name="pair")
    sim, found, seconds = _solve(b, pair, load_steps, device)
    force = 4.0 * abs(float(found.contact_force(pair)[0, 2]))
    modulus = 1.0 / sum((1.0 - nu**2) / e for e in MODULI)
    radius = (0.75 * force / modulus) ** (1.0 / 3.0)
    row = _row(sim, found, pair, (0, 1), radius, 1.5 * force / (math.pi * radius**2))
    given = {"nu": nu, "cells_per_radius": [n / WIDTH for n in inner], "depth_over_a": depth * A / radius}
    given |= {"a_over_R": radius / RADIUS, "stiffness": stiffness, "load_steps": load_steps}
    return given | row | {
        "force": force,
        "approach_error": (A**2 - row["penetration"]) / radius**2 - 1.0,
        "seconds": seconds,
    }  # fmt: skip


def cylinders_case(
    nu: float = 0.3, *, inner: tuple[int, int] = (8, 11), outer: tuple[int, int] = (7, 9), depth: float = 40.0,
    stiffness: float = 300.0, load_steps: int = 4, push: float = 2.0, device: Any = "cpu",
) -> dict[str, Any]:  # fmt: skip
    """Press half of one elastic cylinder onto that of another of twice the modulus, in plane strain, R = 1 m of both.

    The outer faces, `depth` A away, approach by `push` A^2/R; the width and the pressure are those of the force.
    """
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bodies, thick = [], 0.2 * A
    for k, name in enumerate(("lower", "upper")):
        n = inner[k] + outer[k]
        flat = grading(inner[k], outer[k], depth)

        def place(X: np.ndarray, flat: Any = flat) -> np.ndarray:
            x = flat(X * (1.0, 0.0, 1.0))
            x[:, 1] = (X[:, 1] - 0.5) * thick
            return x

        mesh = wf.mesh.box((n, 1, n), cells=(n, 1, n), origin=(0, 0, -n), map=_curved(place, inner[k], k == 1, (0,)),
                           element="T10")  # fmt: skip
        body = b.add_solid(mesh, material=wf.SVK(E=MODULI[k], nu=nu, density=1000.0), name=name)
        for side in ("z-", "x+"):
            if k == 0:
                b.clamp(body.nodes(side))
            else:
                b.clamp(body.nodes(side), components="xy")
                down = ([0.0, 1.0], [(0, 0, 0), (0, 0, -push * A**2)])
                b.drive(body.nodes(side), displacement=down, components="z")
        for side, axis in (("x-", "x"), ("y-", "y"), ("y+", "y")):
            b.clamp(body.nodes(side), components=axis)
        bodies.append(body)
    reach = math.sqrt(A * thick / math.pi)
    pair = b.add_contact(bodies[0].surface("z+"), bodies[1].surface("z+"), stiffness=stiffness, radius=reach,
                         name="pair")  # fmt: skip
    sim, found, seconds = _solve(b, pair, load_steps, device)
    force = 2.0 * abs(float(found.contact_force(pair)[0, 2])) / thick
    modulus = 1.0 / sum((1.0 - nu**2) / e for e in MODULI)
    radius = math.sqrt(4.0 * force / (math.pi * modulus))
    row = _row(sim, found, pair, (0,), radius, 2.0 * force / (math.pi * radius))
    given = {"nu": nu, "cells_per_radius": [n / WIDTH * radius / A for n in inner], "depth_over_a": depth * A / radius}
    given |= {"a_over_R": radius / RADIUS, "stiffness": stiffness, "load_steps": load_steps}
    return given | row | {"force_per_length": force, "seconds": seconds}
