"""Stress at the nodes of a thick cylinder under pressure (Lame) and of a slab with a hole (Kirsch), in plane strain,
beside an L2 projection and superconvergent patch recovery (Zienkiewicz and Zhu 1992).

Run as `python tests/stress_recovery.py --out FILE`.
"""

import argparse
import dataclasses
import json
import pathlib
import sys
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

import warpfea as wf
from warpfea.base.provenance import provenance_of
from warpfea.elements.lagrange import TET_EDGES
from warpfea.model.assembly import shape_and_jacobian

E, NU, LOAD = 1e9, 0.3, 1e3
RADII = {"lame": 2.0, "kirsch": 3.0}
"""Outer radius, m, around a hole of radius 1 m."""


def polar(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.hypot(X[:, 0], X[:, 1]), np.arctan2(X[:, 1], X[:, 0])


def stress(problem: str, X: np.ndarray) -> np.ndarray:
    """Exact stress (n, 6), Pa."""
    r, t = polar(X)
    out = np.zeros((len(X), 6))
    if problem == "lame":
        A = LOAD / (RADII["lame"] ** 2 - 1.0)
        radial, hoop = A * (1 - RADII["lame"] ** 2 / r**2), A * (1 + RADII["lame"] ** 2 / r**2)
        c, s = np.cos(t), np.sin(t)
        out[:, 0], out[:, 1] = radial * c**2 + hoop * s**2, radial * s**2 + hoop * c**2
        out[:, 5] = (radial - hoop) * c * s
    else:
        far, near = r**-2.0, 1.5 * r**-4.0
        out[:, 0] = LOAD * (1 - far * (1.5 * np.cos(2 * t) + np.cos(4 * t)) + near * np.cos(4 * t))
        out[:, 1] = LOAD * (-far * (0.5 * np.cos(2 * t) - np.cos(4 * t)) - near * np.cos(4 * t))
        out[:, 5] = LOAD * (-far * (0.5 * np.sin(2 * t) + np.sin(4 * t)) + near * np.sin(4 * t))
    out[:, 2] = NU * (out[:, 0] + out[:, 1])
    return out


def kirsch_displacement(X: np.ndarray) -> np.ndarray:
    """Exact displacement (n, 3), m."""
    r, t = polar(X)
    kappa, factor = 3.0 - 4.0 * NU, LOAD * (1.0 + NU) / (4.0 * E)
    x = r * (kappa + 1) * np.cos(t) + 2 / r * ((1 + kappa) * np.cos(t) + np.cos(3 * t)) - 2 / r**3 * np.cos(3 * t)
    y = r * (kappa - 3) * np.sin(t) + 2 / r * ((1 - kappa) * np.sin(t) + np.sin(3 * t)) - 2 / r**3 * np.sin(3 * t)
    return factor * np.column_stack([x, y, 0.0 * r])


def solved(problem: str, cells: int, element: str) -> tuple[Any, Any]:
    """Static result of a quarter, one element thick, and the body."""
    mesh = wf.mesh.box((1, 1, 1.0 / cells), cells=(cells, cells, 1), element=element)
    r, t = 1.0 + (RADII[problem] - 1.0) * mesh.points[:, 0], 0.5 * np.pi * mesh.points[:, 1]
    points = np.column_stack([r * np.cos(t), r * np.sin(t), mesh.points[:, 2]])
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(dataclasses.replace(mesh, points=points), material=wf.SVK(E=E, nu=NU), name="quarter")
    for side, component in (("z-", "z"), ("z+", "z"), ("y-", "y"), ("y+", "x")):
        nodes = body.nodes(side)
        if problem == "kirsch" and component != "z":  # those of the outer side are driven
            nodes = body.nodes(nodes.indices[polar(points[nodes.indices])[0] < RADII["kirsch"] - 1e-9])
        b.clamp(nodes, components=component)
    if problem == "lame":
        b.add_pressure(body.surface("x-"), LOAD)
    else:
        outer = body.nodes("x+")
        values = np.stack([np.zeros((len(outer), 3)), kirsch_displacement(points[outer.indices])])
        b.drive(outer, displacement=([0, 1], values), components="xy")
    return wf.solve_static(b.finalize(device="cpu"), load_steps=1, unstable="ignore", tol=1e-10), body


def point_stresses(r: Any, body: Any) -> tuple[Any, np.ndarray, np.ndarray]:
    """Rule, positions (elements, points, 3) and stresses of the quadrature points."""
    (rule,) = {block.key.rule for block, _ in r.simulation.model.evaluation.stresses(r.state, body)}
    s = body.family.shape(rule.points, np.zeros((1, body.family.slots, 3)))[0][0]
    return rule, np.einsum("qs,esk->eqk", s, body.mesh.points[body.mesh.cells]), r.field("cauchy", body, at="points")[0]


def l2_projection(r: Any, body: Any) -> np.ndarray:
    """Nodal values of the functions of the element closest to the stress in the mean square."""
    rule, _, values = point_stresses(r, body)
    cells, n, k = body.mesh.cells, len(body.mesh.points), body.mesh.cells.shape[1]
    every = np.arange(len(cells))

    def weighted(rule: Any) -> tuple[np.ndarray, np.ndarray]:
        s, _, _, det = shape_and_jacobian(body, every, rule.points)
        return s[0], det * rule.weights

    s, w = weighted(body.family.curved_mass_rule)
    M = np.einsum("eq,qi,qj->eij", w, s, s)
    M = sp.csr_matrix((M.ravel(), (np.repeat(cells, k, 1).ravel(), np.tile(cells, (1, k)).ravel())), shape=(n, n))
    s, w = weighted(rule)
    load = np.zeros((n, 6))
    np.add.at(load, cells, np.einsum("eq,qi,eqk->eik", w, s, values))
    return spsolve(M.tocsc(), load)


def patch_recovery(r: Any, body: Any) -> np.ndarray:
    """Polynomials of the element's degree fitted to the points around each vertex; mid-side nodes: mean of two."""
    _, at, values = point_stresses(r, body)
    X, cells = body.mesh.points, body.mesh.cells

    def basis(d: np.ndarray) -> np.ndarray:
        x, y, z = d.T
        square = [x * x, y * y, z * z, y * z, x * z, x * y] if cells.shape[1] == 10 else []
        return np.stack([np.ones(len(d)), x, y, z, *square], axis=1)

    fits = {}
    for v in np.unique(cells[:, :4]):
        own = (cells[:, :4] == v).any(axis=1)
        d = at[own].reshape(-1, 3) - X[v]
        size = np.abs(d).max()
        P = basis(d / size)
        singular = np.linalg.svd(P, compute_uv=False)
        if len(P) >= P.shape[1] and singular[-1] > 1e-3 * singular[0]:
            fits[v] = size, np.linalg.lstsq(P, values[own].reshape(-1, 6), rcond=None)[0]
    ends = {cell[4 + k]: cell[[i, j]] for cell in cells if len(cell) == 10 for k, (i, j) in enumerate(TET_EDGES)}
    out = np.zeros((len(X), 6))
    for n in range(len(X)):
        own = [v for v in ends.get(n, [n]) if v in fits]
        around = own or [v for v in np.unique(cells[(cells == n).any(axis=1)][:, :4]) if v in fits]
        out[n] = np.mean([(basis((X[n] - X[v])[None] / fits[v][0]) @ fits[v][1])[0] for v in around], axis=0)
    return out


METHODS = {
    "average": lambda r, body: r.field("cauchy", body)[0],
    "l2_projection": l2_projection,
    "patch_recovery": patch_recovery,
}


def errors(problem: str, cells: int, element: str, methods: Any = METHODS) -> dict[str, Any]:
    """Root mean square and largest error at the nodes, over the largest stress, by method."""
    r, body = solved(problem, cells, element)
    exact = stress(problem, body.mesh.points)
    row: dict[str, Any] = {"problem": problem, "element": element, "cells": cells}
    for name in methods:
        miss = (METHODS[name](r, body) - exact) / np.abs(exact).max()
        row[name] = [float(np.sqrt((miss**2).sum(axis=1).mean())), float(np.abs(miss).max())]
    return row


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    options = parser.parse_args()
    rows = [errors(p, cells, element) for p in RADII for element in ("T10", "T4") for cells in (4, 8, 16)]
    content = provenance_of([], "cpu") | {"command": " ".join(["python", *sys.argv]), "rows": rows}
    options.out.write_text(json.dumps(content, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
