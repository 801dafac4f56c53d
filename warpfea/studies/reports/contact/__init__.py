"""`warpfea study contact`: deformable bodies on rigid obstacles beside Hertz and Mindlin, a ball beside finer runs, and
bodies that friction holds for long.

hertz      a rigid sphere on a quarter block 60 contact radii deep: contact radius and peak pressure, from a line
           through the squares of the points' pressures, beside those of the force.
mindlin    the same on a half block with friction, then sideways: stiffness ratio, and where all slips.
rebound    an elastic ball on a plane: restitution and duration, and those of a quarter of the step and half the mesh.
wall       a cube pressed to a wall: how far it moves in 10 s, after 10 s of settling.
turntable  a cube on a plate that turns: how far it moves on it in ten turns; the paper's law walks.
balls      two elastic balls with meshes that do not match: contact radius, peak pressure and approach beside Hertz.
cylinders  the same of two cylinders in plane strain: width and pressure.
stack      ten cubes on each other: how far they move in 10 s, also under a last one of a thousand times the mass.

Each row has its iterations and time. tests/results/contact_hertz_cpu.json (the first three), contact_rest_cpu.json
(wall, turntable) and contact_pairs_cpu.json (the last three) are the committed results.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from ..parts import Part, run_tables
from .ball import DENSITY, NU, RADIUS, SPEED, rebound_case
from .ball import E as BALL_E
from .block import WIDTH, A, E, hertz_case, mindlin_case
from .pairs import MODULI, balls_case, cylinders_case
from .pairs import RADIUS as PAIR_RADIUS
from .rest import CUBE, turntable_case, wall_case
from .stack import STACK, stack_case

__all__ = ["PARTS", "balls", "cylinders", "hertz", "mindlin", "rebound", "run", "stack", "turntable", "wall"]


def hertz(device: Any) -> Iterator[dict[str, Any]]:
    """Two meshes at two Poisson's ratios."""
    for nu in (0.3, 0.45):
        for inner, outer in ((4, 5), (6, 6)):
            yield hertz_case(nu, inner=inner, outer=outer, device=device)


def mindlin(device: Any) -> Iterator[dict[str, Any]]:
    """One row."""
    yield mindlin_case(device=device)


def rebound(device: Any) -> Iterator[dict[str, Any]]:
    """The run, and with a quarter of its step and half its mesh size."""
    for integrator in ("bdf2",):
        for factor in (1, 2):
            yield rebound_case(cells=8 * factor, steps=50 * factor**2, integrator=integrator, device=device)


def wall(device: Any) -> Iterator[dict[str, Any]]:
    """Both tetrahedra."""
    for element in ("T4", "T10"):
        yield wall_case(element, device=device)


def turntable(device: Any) -> Iterator[dict[str, Any]]:
    """The default law and the paper's."""
    for law in ("default", "paper"):
        yield turntable_case(law, device=device)


def balls(device: Any) -> Iterator[dict[str, Any]]:
    """Two pairs of meshes."""
    yield balls_case(inner=(4, 5), outer=(5, 6), device=device)
    yield balls_case(inner=(6, 8), outer=(6, 6), device=device)


def cylinders(device: Any) -> Iterator[dict[str, Any]]:
    """Two pairs of meshes."""
    yield cylinders_case(inner=(5, 7), outer=(6, 7), device=device)
    yield cylinders_case(inner=(10, 14), outer=(8, 9), device=device)


def stack(device: Any) -> Iterator[dict[str, Any]]:
    """Equal cubes, and a last one of a thousand times the mass, each soft and hard."""
    for modulus, top in ((1e7, 1.0), (1e10, 1.0), (2e9, 1e3), (1e10, 1e3)):
        yield stack_case(modulus, top, device=device)


PARTS: dict[str, Part] = {f.__name__: f for f in (hertz, mindlin, rebound, wall, turntable, balls, cylinders, stack)}


def run(options: argparse.Namespace) -> None:
    """Do `warpfea study contact`."""
    options.device = options.device or "cpu"
    settings = {
        "block": {"E": E, "sphere_radius": 1.0, "contact_radius": A, "even_zone_in_radii": WIDTH, "tol": 1e-8},
        "ball": {"E": BALL_E, "nu": NU, "density": DENSITY, "radius": RADIUS, "speed": SPEED, "tol": 1e-8},
        "cube": CUBE,
        "pairs": {"E": MODULI, "surface_radius": PAIR_RADIUS, "contact_radius": 0.01},
        "stack": STACK,
    }
    run_tables(options, PARTS, settings, device=options.device)
