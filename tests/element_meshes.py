"""Meshes that tests of elements share."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import replace

import numpy as np

import warpfea as wf
from warpfea import elements

RHO = 7.0
LAWS = {
    "svk": wf.SVK(E=1e6, nu=0.3, density=RHO),
    "mooney_rivlin": wf.MooneyRivlin(mu10=3e5, mu01=1e5, k=1e6, density=RHO),
    "neo_hookean": wf.NeoHookean(mu=4e5, k=1e6, density=RHO),
}
AFFINE = np.array([[0.1, 0.3, -0.1], [0.05, -0.2, 0.1], [-0.1, 0.2, 0.25]])


def rotation(angle, axis=(1.0, -2.0, 0.5)):
    """Rotation matrix (Rodrigues), angle in degrees."""
    a, (x, y, z) = math.radians(angle), np.array(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(a) * K + (1 - math.cos(a)) * K @ K


def lift(mesh, seed=0, amount=0.2):
    """The mesh with its inner corners moved at random; mid-edge nodes are put back in the middle."""
    rng = np.random.default_rng(seed)
    points = mesh.points.copy()
    inner = np.setdiff1d(mesh.used_nodes, mesh.faces(mesh.boundary()))
    size = np.cbrt(mesh.volumes().mean())
    corners = np.intersect1d(inner, mesh.cells[:, :4])
    points[corners] += amount * size * rng.uniform(-1, 1, (len(corners), 3))
    if mesh.cells.shape[1] == 10:
        for k, (a, b) in enumerate(mesh.kind.edges, start=4):
            points[mesh.cells[:, k]] = 0.5 * (points[mesh.cells[:, a]] + points[mesh.cells[:, b]])
    return replace(mesh, points=points)


def bend(mesh, seed=0, amount=0.05):
    """The mesh with its inner mid-edge nodes moved at random: every inner edge is curved."""
    rng = np.random.default_rng(seed)
    points = mesh.points.copy()
    inner = np.setdiff1d(mesh.cells[:, 4:], mesh.faces(mesh.boundary()))
    points[inner] += amount * np.cbrt(mesh.volumes().mean()) * rng.uniform(-1, 1, (len(inner), 3))
    return replace(mesh, points=points)


@functools.cache
def mesh(name):
    return {
        "T4": lambda: lift(wf.mesh.box((1, 1, 1), cells=(3, 3, 3), element="T4")),
        "T10": lambda: lift(wf.mesh.box((1, 1, 1), cells=(3, 2, 2))),
        "bent": lambda: bend(wf.mesh.box((1, 1, 1), cells=(2, 2, 2))),
        "sphere": lambda: wf.mesh.sphere(0.7, cells=2, center=(3, -2, 1)),
        "cylinder": lambda: wf.mesh.cylinder(0.3, 1.2, cells=(2, 2)),
        "tet": lambda: unit_tetrahedron(),
    }[name]()


def unit_tetrahedron():
    return wf.mesh.Mesh(elements.lagrange.T10.node_points, np.arange(10)[None], "tetra10", name="tet")


def displaced(model, values):
    state = model.state()
    state.displacement.assign(np.asarray(values)[None])
    return state


def monomials(dimension, degree):
    """Exponents of all monomials of a total degree."""
    return [e for e in itertools.product(range(degree + 1), repeat=dimension) if sum(e) == degree]


def gauss_tetrahedron(n=8):
    """Points and weights of a Duffy-mapped Gauss-Legendre rule, exact for degree 2 n - 3; not one of ours."""
    x, w = np.polynomial.legendre.leggauss(n)
    x, w = (1 + x) / 2, w / 2
    a, b, c = (g.ravel() for g in np.meshgrid(x, x, x, indexing="ij"))
    weights = np.einsum("i,j,k->ijk", w, w, w).ravel() * (1 - a) ** 2 * (1 - b)
    return np.column_stack([a, b * (1 - a), c * (1 - a) * (1 - b)]), weights
