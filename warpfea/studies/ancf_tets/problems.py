"""The three problems of `warpfea study ancf-tets`: bars of 1 x 0.2 x 0.2 m in cells of 0.2/n m, SVK, nu = 0.3.

rigid: a stiff bar hinged along the edge x = 0, z = 0.2, let go from the horizontal under gravity.
large: half of a soft bar on its plane of symmetry x = 0, static; its weight grows with x and is balanced by a uniform
    traction on the face z = 0, so that the end droops by half a metre. No support carries a shear force and no edge is
    clamped: the solution is as smooth as boxes allow, and orders of convergence show. (At a clamped edge every element
    ends at h^1.4, and a soft bar on a hinge line sinks into it with the logarithm of the mesh.)
sudden: the same bar in motion, under half of these loads from t = 0.

T4, T10, ENMC, FN and FN18: 6 tetrahedra per cell; H3843: one brick.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ... import mesh as meshes
from ...builder.builder import ModelBuilder
from ...materials import SVK
from ...model.bodies import Body
from ...model.handles import NodeSet

__all__ = ["ELEMENTS", "PROBLEMS", "build", "cells_of", "level_for"]

LENGTH, SIDE = 1.0, 0.2  # m
ELEMENTS = ("T4", "T10", "FN", "FN18", "ENMC", "H3843")
PROBLEMS = ("rigid", "large", "sudden")
GRAVITY = 9.81
NU = 0.3
DENSITY = 1000.0
STIFF, SOFT = 1e9, 2e6  # Pa
WEIGHT = 2400.0  # N, of `large`


def cells_of(level: int) -> tuple[int, int, int]:
    """Cells of a bar with `level` cells across its side."""
    return 5 * level, level, level


def total_unknowns(element: str, level: int) -> int:
    """Unknowns of the bar before anything is held."""
    order = 2 if element == "T10" else 1
    nodes = np.prod([order * n + 1 for n in cells_of(level)])
    slots = nodes * (1 if element in ("T4", "T10") else 4)
    if element == "ENMC":
        slots += 60 * level**3 + 22 * level**2  # faces of the tetrahedra
    return 3 * int(slots)


def level_for(element: str, unknowns: int) -> int:
    """The level whose number of unknowns is nearest in ratio."""
    level = 1
    while total_unknowns(element, level + 1) * total_unknowns(element, level) <= unknowns**2:
        level += 1
    return level


def build(problem: str, element: str, level: int) -> ModelBuilder:
    """The problem with the probe "tip": the mean of the face x = 1 m."""
    return _BUILDERS[problem](element, level)


def _bar(b: ModelBuilder, element: str, level: int, law: SVK) -> Body:
    mesh = meshes.box((LENGTH, SIDE, SIDE), cells=cells_of(level), element=element)
    body = b.add_solid(mesh, material=law, element=element, name="bar")
    b.add_probe("tip", body.surface("x+"))
    return body


def _hold(b: ModelBuilder, nodes: NodeSet, across: str, components: str) -> None:
    """Hold components of positions, and of the gradients along a face or edge but not `across` it (letters of "xyz").

    With positions alone the cubic face moves between its nodes; the gradient across, held, takes away the strain there.
    """
    b.clamp(nodes, slots="position", components=components)
    along = [f"gradient-{axis}" for axis in "xyz" if axis not in across]
    if nodes.body.family.has_gradients:
        b.clamp(nodes, slots="+".join(along), components=components)


def _rigid(element: str, level: int) -> ModelBuilder:
    b = ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    body = _bar(b, element, level, SVK(E=STIFF, nu=NU, density=DENSITY))
    eps = 1e-6 * SIDE
    edge = body.nodes(lambda X: (X[:, 0] < eps) & (X[:, 2] > SIDE - eps))
    _hold(b, edge, "xz", "xyz")
    return b


def _balanced(element: str, level: int, weight: float) -> tuple[ModelBuilder, Body]:
    """A bar on planes of symmetry, its weight in N balanced by a traction: free to move along z."""
    b = ModelBuilder(gravity=(0.0, 0.0, -weight / (DENSITY * LENGTH * SIDE * SIDE)))
    body = _bar(b, element, level, SVK(E=SOFT, nu=NU, density=_growing))
    _hold(b, body.nodes("x-"), "x", "x")
    _hold(b, body.nodes("y-"), "y", "y")
    b.add_traction(body.surface("z-"), (0.0, 0.0, weight / (LENGTH * SIDE)))
    return b, body


def _growing(X: np.ndarray) -> np.ndarray:
    """Density, kg/m^3, with the mean DENSITY."""
    return DENSITY * (0.1 + 1.8 * X[:, 0] / LENGTH)


def _large(element: str, level: int) -> ModelBuilder:
    b, body = _balanced(element, level, WEIGHT)
    corner = body.nodes(lambda X: np.abs(X).max(axis=1) < 1e-6 * SIDE)
    b.clamp(corner, slots="position", components="z")  # carries nothing: the loads are in balance
    return b


def _sudden(element: str, level: int) -> ModelBuilder:
    return _balanced(element, level, 0.5 * WEIGHT)[0]


_BUILDERS: dict[str, Callable[[str, int], ModelBuilder]] = {"rigid": _rigid, "large": _large, "sudden": _sudden}
