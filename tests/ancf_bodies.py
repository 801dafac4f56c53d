"""ANCF bodies of each family, their places and states."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
from element_meshes import rotation

import warpfea as wf
from warpfea.model.discretisation import element_functions

E_MODULUS, NU, RHO = 1e6, 0.3, 7.0
SVK = wf.SVK(E=E_MODULUS, nu=NU, density=RHO)
SECTION = wf.Rectangle(0.15, 0.1)
A = np.array([[1.1, 0.3, -0.1], [0.05, 0.9, 0.1], [-0.1, 0.2, 1.2]])


TURN = rotation(50.0, (1.0, 2.0, -0.7))
SHIFT = np.array([2.0, -1.0, 0.5])


def placed(X):
    return X @ TURN.T + SHIFT


def radial(s):
    return np.array([math.cos(1.5 * s), math.sin(1.5 * s), 0.0])


def arc(s):
    """1.5 rad of a circle of radius 1."""
    return placed(radial(s))


def rolled(X):
    """The unit square onto a cylinder of radius 1 about y."""
    return np.column_stack([np.sin(X[:, 0]), X[:, 1], np.cos(X[:, 0])])


def hexes(cells=(3, 2, 2)):
    mesh = wf.mesh.box((1, 0.8, 0.6), cells=cells, element="H3843")
    return replace(mesh, points=placed(mesh.points * (1 + 0.1 * np.prod(mesh.points, axis=1, keepdims=True))))


def tets(element):
    mesh = wf.mesh.box((1, 0.8, 0.6), cells=(2, 1, 1), element=element)
    return replace(mesh, points=placed(mesh.points))


BODIES = {
    "beam": lambda b, **o: b.add_beam(
        [SHIFT, SHIFT + TURN[:, 0]], elements=3, section=SECTION, normal=TURN[:, 2], material=SVK, **o
    ),
    "beam split": lambda b, **o: BODIES["beam"](b, integration="split", **o),
    "beam full": lambda b, **o: BODIES["beam"](b, integration="full", **o),
    "arc": lambda b, **o: b.add_beam(
        arc, elements=6, section=SECTION, normal=lambda s: TURN @ radial(s), material=SVK, **o
    ),
    "plate": lambda b, **o: b.add_shell(
        wf.mesh.grid((1, 0.8), cells=(2, 2), map=placed), thickness=0.1, material=SVK, **o
    ),
    "plate full": lambda b, **o: BODIES["plate"](b, integration="full", **o),
    "roof": lambda b, **o: b.add_shell(
        wf.mesh.grid((1, 1), cells=(4, 2), map=rolled),
        thickness=0.1,
        material=SVK,
        normals=lambda X: X * [1, 0, 1],
        **o,
    ),
    "ENMC": lambda b, **o: b.add_solid(tets("ENMC"), material=SVK, element="ENMC", **o),
    "FN": lambda b, **o: b.add_solid(tets("FN"), material=SVK, element="FN", **o),
    "FN18": lambda b, **o: b.add_solid(tets("FN18"), material=SVK, element="FN18", **o),
    "ball": lambda b, **o: b.add_solid(ball(), material=SVK, element="ENMC", **o),
    "H3843": lambda b, **o: b.add_solid(hexes(), material=SVK, element="H3843", **o),
}


def ball():
    return wf.mesh.sphere(0.7, cells=2, center=(3, -2, 1))


def scene(name, gravity=(0, 0, 0), **options):
    b = wf.ModelBuilder(gravity=gravity)
    return b, BODIES[name](b, **options)


def finalize(b):
    return b.finalize(device="cpu")


@functools.cache
def plain(name):
    b, body = scene(name)
    return body, finalize(b)


def affine(body, F, shift=(0, 0, 0)):
    """Slot displacements of x = F X + shift, X from the body's origin."""
    return body.reference @ (F - np.eye(3)).T + (body.slot_kind == 0)[:, None] * shift


def state_of(model, u):
    state = model.state()
    state.displacement.assign(np.asarray(u)[None])
    return state


def reference_at(body, elements, xi):
    s, _ = element_functions(body, elements, xi)
    return np.einsum("eqs,esk->eqk", s, body.reference[body.connectivity[elements]]) + body.origin


def parent_points(family, count=4, seed=0):
    rng = np.random.default_rng(seed)
    if family.parent.low is None:
        return rng.dirichlet(np.ones(4), count)[:, 1:]
    return rng.uniform(family.parent.low, family.parent.high, (count, 3))


def add_beam(curve, normal=(0, 0, 1), elements=4, b=None, **options):
    b = b or wf.ModelBuilder()
    options = {"section": SECTION, "material": SVK} | options
    return b.add_beam(curve, elements=elements, normal=normal, **options)


M = np.array([2.0, -3.0, 5.0])


def turned(name):
    """Builder, body, what a moment is put on."""
    if name == "T10 point":
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        body = b.add_solid(tets("T10"), material=SVK)
        return b, body, body.at(body.mesh.points[body.mesh.cells[1]].mean(axis=0))
    b, body = scene(name.split()[0])
    where = {
        "end": lambda: body.end,
        "edge": lambda: body.edge("x+"),
        "node": lambda: body.nodes([body.mesh.cells[0, 1]]),
        "point": lambda: body.at(reference_at(body, np.array([1]), parent_points(body.family, 1))[0, 0]),
    }[name.split()[1]]
    return b, body, where()
