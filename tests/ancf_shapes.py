"""Geometries for every ANCF family, and what is measured on them."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
from ancf_bodies import SHIFT, SVK, TURN, ball, placed, rolled

import warpfea as wf
from warpfea import elements


def lifted(mesh, amount=0.2, plane=False, seed=0):
    """The mesh with its inner nodes moved at random, by a part of an element's size."""
    rng = np.random.default_rng(seed)
    points = mesh.points.copy()
    outer = mesh.cells[mesh.boundary()[:, 0, None], mesh.kind.faces[mesh.boundary()[:, 1]]]
    inner = np.setdiff1d(mesh.used_nodes, outer)
    size = np.prod(np.ptp(points, axis=0)[: 2 if plane else 3]) / len(mesh.cells)
    moves = amount * size ** (1 / 2 if plane else 1 / 3) * rng.uniform(-1, 1, (len(inner), 3))
    points[inner] += moves * ([1, 1, 0] if plane else [1, 1, 1])
    return replace(mesh, points=points)


def beam(curve, normal=(0.2, -0.3, 1.0)):
    def make(b, n, t=0.1, **options):
        section = wf.Rectangle(1.5 * t, t)
        return b.add_beam(curve, elements=n, section=section, normal=normal, material=SVK, **options)

    return make


def arc(s):
    return np.array([math.cos(1.5 * s), math.sin(1.5 * s), 0.3 * s]) @ TURN.T + SHIFT


def uneven(s):
    """A straight line whose parameter runs unevenly: elements start and end with different dX/dxi."""
    return SHIFT + (s + 0.25 * s**2) / 1.25 * TURN[:, 0]


def turning(s):
    return np.array([0.0, math.cos(s), math.sin(s)])


def shell(map=None, distort=False, normals=None):
    def make(b, n, t=0.1, **options):
        cells = (n, n) if n != 2 else (2, 1)
        mesh = wf.mesh.grid((1, 1), cells=cells, map=None if distort else map)
        if distort:
            mesh = lifted(mesh, plane=True)
            mesh = replace(mesh, points=map(mesh.points))
        return b.add_shell(mesh, thickness=t, material=SVK, normals=normals, **options)

    return make


def skew(X):
    return X @ np.array([[1.3, 0.2, 0.0], [0.5, 0.8, 0.0], [0.0, 0.0, 1.0]])


def corner_moved(X):
    """One corner of the unit square or cube drawn out: a single element is no parallelogram."""
    return X * (1 + 0.25 * np.prod(X[:, :2], axis=1, keepdims=True)) @ TURN.T + SHIFT


def solid(element, map=None, source=None):
    def make(b, n, **options):
        cells = {1: (1, 1, 1), 2: (2, 1, 1)}.get(n, (n, n, n - 1))
        if source:
            mesh = source()
        else:
            mesh = wf.mesh.box((1.0, 0.8, 0.6), cells=cells, element="T4" if element != "H3843" else element)
            mesh = lifted(mesh)
            mesh = replace(mesh, points=map(mesh.points)) if map else mesh
        if n == 1 and mesh.cell_type == "tetra":
            mesh = wf.mesh.Mesh(mesh.points[mesh.cells[2]], np.arange(4)[None], "tetra")
        return b.add_solid(mesh, material=SVK, element=element, **options)

    return make


SHAPES = {
    "beam straight": beam([SHIFT, SHIFT + TURN[:, 0]]),
    "beam uneven": beam(uneven),
    "beam arc": beam(arc),
    "beam twisted": beam([(0, 0, 0), (1, 0, 0)], turning),
    "shell square": shell(placed),
    "shell skew": shell(lambda X: placed(skew(X))),
    "shell distorted": shell(corner_moved, distort=True),
    "shell rolled": shell(lambda X: placed(rolled(X))),
    "ENMC": solid("ENMC", placed),
    "ENMC curved": solid("ENMC", source=ball),
    "FN": solid("FN", placed),
    "FN18": solid("FN18", placed),
    "FN18 curved": solid("FN18", source=ball),
    "H3843 skew": solid("H3843", lambda X: placed(skew(X))),
    "H3843 distorted": solid("H3843", corner_moved),
}
INTEGRATIONS = {
    "beam": (*elements.get_family("3243").schemes, "full"),
    "shell": (*elements.get_family("3443").schemes, "full"),
}
SPLIT = [(name, i) for name in SHAPES for i in INTEGRATIONS.get(name.split()[0], ())]


@functools.cache
def build(name, integration=None, n=3, dtype="float64", t=None):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    options = {"integration": integration} if integration else {}
    body = SHAPES[name](b, n, **options, **({"t": t} if t else {}))
    return body, b.finalize(device="cpu", dtype=dtype)


def affine(body, A, shift=(0, 0, 0)):
    """Slot displacements of x = A X + shift, X from the body's origin."""
    return body.reference @ (A - np.eye(3)).T + (body.slot_kind == 0)[:, None] * shift


def difference(f, h):
    """Derivative at 0 by central differences with an error of O(h^6)."""
    one, two, three = ((f(k * h) - f(-k * h)) / (60 * h) for k in (1, 2, 3))
    return 45 * one - 9 * two + three
