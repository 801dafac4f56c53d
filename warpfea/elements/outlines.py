"""Outlines of cross-sections: cells with straight or circular sides, triangulation, Saint-Venant's torsion constant."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

from ..base.checks import float_array
from ..base.errors import ModelError

__all__ = ["Cell", "checked_outline", "disc_cells", "polygon_area", "polygon_cells", "torsion_constant"]

ARCS, END_ARCS = 12, 4
"""Arcs of a circle as sides of a beam, and as sides of the cells of its ends: cubics within 1e-7 and 3e-4 of r."""
MIN_TRIANGLES = 4000
"""Triangles of the torsion problem, of quadratic functions."""


@dataclass(frozen=True, eq=False)
class Cell:
    """A quadrilateral of a section, counter-clockwise, or the side from corner 0 to 1.

    Attributes:
        corners: (4, 2), or (2, 2).
        bulge: control points of cubics off the thirds of the chords, (2, 2, 2): of the sides 0-3 and 1-2; of a side
            (2, 2); None: straight.
    """

    corners: np.ndarray
    bulge: np.ndarray | None = None


def _arcs(r: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Ends (count, 2, 2) and bulges (count, 2, 2) of counter-clockwise arcs."""
    angle = 2.0 * np.pi * np.arange(count + 1) / count
    x = r * np.column_stack([np.cos(angle), np.sin(angle)])
    reach = 4.0 / 3.0 * math.tan(math.pi / (2.0 * count)) * x @ np.array([(0.0, 1.0), (-1.0, 0.0)])
    ends = np.stack([x[:-1], x[1:]], axis=1)
    third = (ends[:, 1] - ends[:, 0]) / 3.0
    return ends, np.stack([reach[:-1] - third, third - reach[1:]], axis=1)


def disc_cells(r: float, bore: float) -> tuple[list[Cell], list[Cell], list[Cell]]:
    """Outer sides, inner sides, and cells of the ends of a disc with a bore of radius `bore`, or none."""
    outer = [Cell(*arc) for arc in zip(*_arcs(r, ARCS))]
    ends, bulges = _arcs(r, END_ARCS)
    inner, inner_bulges = _arcs(bore or 0.5 * r, END_ARCS)
    if not bore:
        inner_bulges = 0.0 * inner_bulges
    ring = [
        Cell(np.stack([a[0], b[0], b[1], a[1]]), np.stack(both))
        for a, b, *both in zip(inner, ends, inner_bulges, bulges)
    ]
    if not bore:
        return outer, [], [*ring, Cell(inner[:, 0])]
    return outer, [Cell(x[::-1], d[::-1]) for x, d in zip(*_arcs(bore, ARCS))], ring


def polygon_cells(outline: np.ndarray) -> tuple[list[Cell], list[Cell], list[Cell]]:
    """The same of a polygon (k, 2), counter-clockwise: convex quadrilaterals."""
    sides = [Cell(np.stack(pair)) for pair in zip(outline, np.roll(outline, -1, axis=0))]
    if len(outline) == 4 and _turns(outline).min() > 0.0:
        return sides, [], [Cell(outline)]
    cells = []
    for x in outline[_triangles(outline)]:
        middle, center = 0.5 * (x + np.roll(x, -1, axis=0)), x.mean(axis=0)
        cells += [Cell(np.stack([center, middle[k - 1], x[k], middle[k]])) for k in range(3)]
    return sides, [], cells


def polygon_area(x: np.ndarray) -> float:
    """Signed area of a polygon (k, 2), m^2."""
    return 0.5 * float(np.sum(_cross(x, np.roll(x, -1, axis=0))))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _turns(x: np.ndarray) -> np.ndarray:
    """Twice the area of the triangle at each vertex, positive at convex ones."""
    return _cross(x - np.roll(x, 1, axis=0), np.roll(x, -1, axis=0) - x)


def checked_outline(outline: Any, center: np.ndarray) -> np.ndarray:
    """Vertices (k, 2) about a centre, counter-clockwise, without repeated ones. ModelError for a bad outline."""
    x = float_array(outline)
    if x.ndim != 2 or x.shape[1] != 2 or len(x) < 3 or not np.all(np.isfinite(x)):
        raise ModelError(f"Section: outline must be finite vertices (k, 2), m, with k >= 3, got shape {x.shape}")
    x = x[np.linalg.norm(x - np.roll(x, 1, axis=0), axis=1) > 1e-12 * np.ptp(x, axis=0).max()] - center
    area = polygon_area(x) if len(x) >= 3 else 0.0
    if abs(area) <= 1e-12 * float(np.prod(np.ptp(x, axis=0))):
        raise ModelError("Section: the outline has no area")
    x = x if area > 0.0 else x[::-1]
    a, b = x[:, None], np.roll(x, -1, axis=0)[:, None]
    c, d = np.swapaxes(a, 0, 1), np.swapaxes(b, 0, 1)
    crossing = (_cross(b - a, c - a) * _cross(b - a, d - a) < 0.0) & (_cross(d - c, a - c) * _cross(d - c, b - c) < 0.0)
    if crossing.any():
        k = np.argwhere(crossing)[0].tolist()
        raise ModelError(f"Section: the outline crosses itself: its sides {k[0]} and {k[1]} meet")
    return np.ascontiguousarray(x)


def _triangles(x: np.ndarray) -> np.ndarray:
    """(k - 2, 3) triangles of a polygon by cutting ears off."""
    left, out = list(range(len(x))), []
    while len(left) > 3:
        best, ear = -1.0, -1
        turn = _turns(x[left])
        for k in np.flatnonzero(turn > 0.0).tolist():
            corner = x[[left[k - 1], left[k], left[(k + 1) % len(left)]]]
            others = x[[n for n in left if not (x[n] == corner).all(axis=1).any()]]
            inside = np.all(
                [_cross(corner[j] - corner[j - 1], others - corner[j - 1]) >= 0.0 for j in range(3)], axis=0
            )
            longest = np.linalg.norm(corner - np.roll(corner, 1, axis=0), axis=1).max()
            if not inside.any() and turn[k] / longest**2 > best:
                best, ear = turn[k] / longest**2, k
        if ear < 0:
            raise ModelError("Section: the outline crosses or touches itself")
        out.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    return np.array([*out, tuple(left)])


def torsion_constant(outline: np.ndarray) -> float:
    """Saint-Venant's torsion constant 2 int phi, m^4, with -laplace phi = 2 and phi = 0 on the outline."""
    x, triangles = outline, _triangles(outline)
    while True:
        sides = np.sort(triangles[:, [(0, 1), (1, 2), (2, 0)]].reshape(-1, 2), axis=1)
        edges, number, uses = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
        number = len(x) + number.reshape(-1, 3)
        if len(triangles) >= MIN_TRIANGLES:
            break
        x = np.concatenate([x, x[edges].mean(axis=1)])
        a, b, c = triangles.T
        d, e, f = number.T
        triangles = np.concatenate([np.stack(t, axis=1) for t in ((a, d, f), (d, b, e), (f, e, c), (d, e, f))])
    conn, corner = np.hstack([triangles, number]), x[triangles]
    edge = np.roll(corner, -2, axis=1) - np.roll(corner, -1, axis=1)  # opposite to each corner
    area = 0.5 * _cross(edge[:, 0], edge[:, 1])
    gradient = np.stack([-edge[..., 1], edge[..., 0]], axis=2) / (2.0 * area[:, None, None])
    L = np.array([(0.5, 0.5, 0.0), (0.0, 0.5, 0.5), (0.5, 0.0, 0.5)])  # mid-sides: exact for quadratics
    dN = np.zeros((3, 6, 3))  # of the functions L (2 L - 1) and 4 L_i L_j
    dN[:, [0, 1, 2], [0, 1, 2]] = 4.0 * L - 1.0
    for k in range(3):
        dN[:, 3 + k, k], dN[:, 3 + k, (k + 1) % 3] = 4.0 * L[:, (k + 1) % 3], 4.0 * L[:, k]
    G = np.einsum("qnl,tlk->tqnk", dN, gradient)
    K = np.einsum("tqnk,tqmk,t->tnm", G, G, area / 3.0)
    size = len(x) + len(edges)
    rows, columns = np.repeat(conn, 6, axis=1).ravel(), np.tile(conn, 6).ravel()
    load = 2.0 * np.bincount(number.ravel(), weights=np.repeat(area / 3.0, 3), minlength=size)
    free = np.ones(size, dtype=bool)
    free[edges[uses == 1]] = False
    free[len(x) + np.flatnonzero(uses == 1)] = False
    matrix = sp.csr_matrix((K.ravel(), (rows, columns)), shape=(size, size))[free][:, free]
    return float(load[free] @ scipy.sparse.linalg.spsolve(matrix.tocsc(), load[free]))
