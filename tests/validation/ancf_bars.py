"""The problems of the table ancf_tets: bars of 1 x 0.2 x 0.2 m in cells of 0.2/n m, SVK, nu = 0.3.

rigid: a stiff bar hinged along the edge x = 0, z = 0.2, let go from the horizontal under gravity.
large: half of a soft bar on its plane of symmetry x = 0, static; its weight grows with x and is balanced by a uniform
    traction on the face z = 0, so that the end droops by half a metre. No support carries a shear force and no edge is
    clamped: the solution is as smooth as boxes allow, and orders of convergence show. (At a clamped edge every element
    ends at h^1.4, and a soft bar on a hinge line sinks into it with the logarithm of the mesh.)
sudden: the same bar in motion, under half of these loads from t = 0.

T4, T10, ENMC, FN and FN18: 6 tetrahedra per cell; H3843: one brick.

Of the rigid bar: its exact motion, and its motion in the steps of the flexible one, with phi the angle of its axis
above the horizontal (rad) and X = (x, z) a place relative to the hinge (m).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import warpfea as wf
from warpfea import mesh as meshes
from warpfea.model.bodies import Body
from warpfea.model.handles import NodeSet

__all__ = ["ELEMENTS", "PROBLEMS", "build", "cells_of", "exact_tip", "level_for", "stepped_tip", "total_unknowns"]

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


def build(problem: str, element: str, level: int) -> wf.ModelBuilder:
    """The problem with the probe "tip": the mean of the face x = 1 m."""
    return _BUILDERS[problem](element, level)


def _bar(b: wf.ModelBuilder, element: str, level: int, law: wf.SVK) -> Body:
    mesh = meshes.box((LENGTH, SIDE, SIDE), cells=cells_of(level), element=element)
    body = b.add_solid(mesh, material=law, element=element, name="bar")
    b.add_probe("tip", body.surface("x+"))
    return body


def _hold(b: wf.ModelBuilder, nodes: NodeSet, across: str, components: str) -> None:
    """Hold components of positions, and of the gradients along a face or edge but not `across` it (letters of "xyz").

    With positions alone the cubic face moves between its nodes; the gradient across, held, takes away the strain there.
    """
    b.clamp(nodes, slots="position", components=components)
    along = [f"gradient-{axis}" for axis in "xyz" if axis not in across]
    if nodes.body.family.has_gradients:
        b.clamp(nodes, slots="+".join(along), components=components)


def _rigid(element: str, level: int) -> wf.ModelBuilder:
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    body = _bar(b, element, level, wf.SVK(E=STIFF, nu=NU, density=DENSITY))
    eps = 1e-6 * SIDE
    edge = body.nodes(lambda X: (X[:, 0] < eps) & (X[:, 2] > SIDE - eps))
    _hold(b, edge, "xz", "xyz")
    return b


def _balanced(element: str, level: int, weight: float) -> tuple[wf.ModelBuilder, Body]:
    """A bar on planes of symmetry, its weight in N balanced by a traction: free to move along z."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -weight / (DENSITY * LENGTH * SIDE * SIDE)))
    body = _bar(b, element, level, wf.SVK(E=SOFT, nu=NU, density=_growing))
    _hold(b, body.nodes("x-"), "x", "x")
    _hold(b, body.nodes("y-"), "y", "y")
    b.add_traction(body.surface("z-"), (0.0, 0.0, weight / (LENGTH * SIDE)))
    return b, body


def _growing(X: np.ndarray) -> np.ndarray:
    """Density, kg/m^3, with the mean DENSITY."""
    return DENSITY * (0.1 + 1.8 * X[:, 0] / LENGTH)


def _large(element: str, level: int) -> wf.ModelBuilder:
    b, body = _balanced(element, level, WEIGHT)
    corner = body.nodes(lambda X: np.abs(X).max(axis=1) < 1e-6 * SIDE)
    b.clamp(corner, slots="position", components="z")  # carries nothing: the loads are in balance
    return b


def _sudden(element: str, level: int) -> wf.ModelBuilder:
    return _balanced(element, level, 0.5 * WEIGHT)[0]


_BUILDERS: dict[str, Callable[[str, int], wf.ModelBuilder]] = {"rigid": _rigid, "large": _large, "sudden": _sudden}

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
