"""Contact between bodies by segments: points on the pieces into which the facets of one side cut those of the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.spatial import cKDTree

from ..elements import Rule
from ..elements.quadrature import triangle_6
from ..kernels.contact.facet_candidates import BORDER_TOLERANCE
from ..kernels.contact.kinematics import OPPOSING_COSINE
from .contact_points import ContactPoints, points_by_faces, rules_of_faces
from .edges import CORNERS
from .handles import SurfaceSet
from .pairs import PAIR_RULES, PairContact, monomials, pair_points

__all__ = ["SEGMENT_POINTS", "SegmentContact", "has_segments", "segment_points"]

Polygon = list[complex]
"""Corners a + i b in the coordinates (a, b) of a facet, anticlockwise."""
SEGMENT_POINTS = 7, 16
"""Points of a segment: of degree 3 between triangles, and for the cubic functions of squares."""
SMALLEST_PIECE = 1e-12
"""Area of a piece over that of its facet below which it is round-off."""
SPHERE_MARGIN = 1.001
"""Factor on the radii of spheres around facets, so that round-off decides nothing where they touch."""
MAX_STEPS = 8
"""Maximum number of Newton steps for coordinates on a facet."""
THINNEST = 20.0 * BORDER_TOLERANCE
"""Width of a piece beside the other side, over the side of its facet, below which it has no points."""
WHOLE: dict[int, Polygon] = {n: (x @ (1.0, 1.0j)).tolist() for n, x in CORNERS.items()}
QUARTERS: list[Polygon] = [[0.0, 0.5, 0.5j], [0.5, 1.0, 0.5 + 0.5j], [0.5j, 0.5 + 0.5j, 1.0j], [0.5 + 0.5j, 0.5j, 0.5]]
"""Facets in local coordinates, and a triangle that nothing cuts, on which what slides there later is not cut either."""


@dataclass(eq=False)
class SegmentContact(PairContact):
    """Contact of two surfaces with points on segments; made by ModelBuilder.add_contact(clipping=True).

    A uniform pressure gives the slots of both sides their consistent forces: on a segment the functions of both are
    polynomials (Puso and Laursen, Comput. Methods Appl. Mech. Engrg. 193, 2004).
    """

    row_per_facet: ClassVar[bool] = False

    def slave_points(self) -> tuple[ContactPoints, Any]:
        return segment_points(self.slave, self.master, self.points), 1.0


def area_of(polygon: Polygon) -> float:
    """Area of a polygon, positive anticlockwise."""
    return 0.5 * sum((a.conjugate() * b).imag for a, b in zip(polygon, [*polygon[1:], polygon[0]]))


def cut(polygon: Polygon, a: complex, b: complex) -> tuple[Polygon, Polygon]:
    """Parts of a convex polygon on the left and on the right of the line from a to b."""
    way = (b - a).conjugate()
    side = [(way * (p - a)).imag for p in polygon]
    left, right = [], []
    for k, p in enumerate(polygon):
        before = side[k - 1]
        if before * side[k] < 0.0:
            crossing = polygon[k - 1] + before / (before - side[k]) * (p - polygon[k - 1])
            left.append(crossing)
            right.append(crossing)
        if side[k] >= 0.0:
            left.append(p)
        if side[k] <= 0.0:
            right.append(p)
    return left, right


def parted(piece: Polygon, other: Polygon, smallest: float) -> tuple[list[Polygon], list[Polygon]]:
    """Part of a convex polygon in another one, if above an area, and convex parts beside it."""
    left, beside = piece, []
    for a, b in zip(other, [*other[1:], other[0]]):
        left, right = cut(left, a, b)
        if len(left) < 3 or area_of(left) <= smallest:
            return [], [piece]
        if len(right) > 2 and area_of(right) > smallest:
            beside.append(right)
    return [left], beside


def pieces_of(whole: Polygon, others: list[Polygon]) -> tuple[list[Polygon], list[Polygon]]:
    """Convex parts of a convex polygon in each of others, which may overlap, and those in none."""
    smallest = SMALLEST_PIECE * area_of(whole)
    inside = [part for other in others for part in parted(whole, other, smallest)[0]]
    if abs(sum(map(area_of, inside)) - area_of(whole)) <= len(others) * smallest:
        return inside, []
    inside, outside = [], [whole]
    for other in others:
        both = [parted(piece, other, smallest) for piece in outside]
        inside += [part for found, _ in both for part in found]
        outside = [part for _, found in both for part in found]
    return inside, outside


def is_thin(piece: Polygon) -> bool:
    """True for a piece in which points are no farther from its border than surfaces count as flush."""
    return area_of(piece) <= THINNEST * max(abs(p - q) for p in piece for q in piece)


def cells_of(polygon: Polygon, most: int) -> Iterator[Polygon]:
    """Triangles of a convex polygon, or with `most` = 4 as many quadrilaterals as there are."""
    k = 1
    while k < len(polygon) - 1:
        cell = [polygon[0], *polygon[k : k + most - 1]]
        yield cell
        k += len(cell) - 2


def points_in(cells: np.ndarray, rule: Rule) -> tuple[np.ndarray, np.ndarray]:
    """Points (F, Q, 2) and weights (F, Q) in triangles or quadrilaterals (F, n)."""
    a, b, c = (cells[:, k, None] for k in (0, 1, -1))
    twist = cells[:, 2, None] - b - (c - a) if cells.shape[1] == 4 else 0.0 * a
    s, t = rule.points.T
    u, v = b - a + t * twist, c - a + s * twist
    x = a + s * (b - a) + t * v
    return np.stack([x.real, x.imag], axis=2), rule.weights * (u.conj() * v).imag


def local_coordinates(corners: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Coordinates (..., 2) of the projections of positions x (..., 3) on a flat facet of 3 or 4 corners."""
    u, v = corners[1] - corners[0], corners[-1] - corners[0]
    twist = corners[2] - corners[1] - v if len(corners) == 4 else 0.0 * u
    out = np.zeros((*x.shape[:-1], 2))
    for _ in range(MAX_STEPS):
        a, b = out[..., :1], out[..., 1:]
        tangents = np.stack([u + b * twist, v + a * twist], axis=-1)
        step = np.einsum("...ik,...k->...i", np.linalg.pinv(tangents), x - corners[0] - a * u - b * (v + a * twist))
        out += step
        if np.abs(step).max(initial=0.0) < 1e-14:
            break
    return out


def at_corners(surface: SurfaceSet) -> tuple[ContactPoints, np.ndarray]:
    """Corners of the facets of a surface in place of points, and their numbers (F,)."""
    rules = {n: Rule("corners", x, np.ones(n), 1) for n, x in CORNERS.items()}
    count = np.array([len(face) for face in surface.body.family.faces])
    return points_by_faces(surface, rules_of_faces(surface, rules)), count[surface.faces[:, 1]]


def facets_in_reach(slave: SurfaceSet, master: SurfaceSet) -> list[np.ndarray]:
    """Facets of a master that oppose each of a slave, the spheres around both overlapping."""
    (centre, radius, normal), (others, reach, facing) = (
        (p.X.mean(axis=1), np.linalg.norm(p.X - p.X.mean(axis=1, keepdims=True), axis=2).max(axis=1), p.normal[:, 0])
        for p, _ in map(at_corners, (slave, master))
    )  # fmt: skip
    radius, reach = SPHERE_MARGIN * radius, SPHERE_MARGIN * reach
    out = []
    for x, r, n, near in zip(centre, radius, normal, cKDTree(others).query_ball_point(centre, radius + reach.max())):
        k = np.array(sorted(near), dtype=int)
        close = np.linalg.norm(others[k] - x, axis=1) <= r + reach[k]
        out.append(k[close & (facing[k] @ n < -OPPOSING_COSINE)])
    return out


def has_segments(contact: PairContact) -> bool:
    """True if the surfaces of a contact begin near each other, and neither must be seen by equidistant points."""
    return contact.width is None and any(map(len, facets_in_reach(contact.slave, contact.master)))


def segment_points(slave: SurfaceSet, master: SurfaceSet, points: int | None = None) -> ContactPoints:
    """Points of a slave surface in rows, one for each segment or part of it; `rows`: the facet of each.

    Corners of segments are points, since what rests on an edge rests there; what is beside the master has points inside
    only, which its border does not touch.
    """
    (own, sides), (other, other_sides) = at_corners(slave), at_corners(master)
    count = points or SEGMENT_POINTS[int(max(sides.max(), other_sides.max()) > 3)]
    closed = {n: PAIR_RULES[n][count] for n in (3, 4) if count in PAIR_RULES[n]}
    cells: dict[tuple[int, bool], list[tuple[int, Polygon]]] = {}
    for f, near in enumerate(facets_in_reach(slave, master)):
        n = int(sides[f])
        xi = local_coordinates(own.X[f, :n], other.X[near])
        others = [polygon[: other_sides[k]][::-1] for k, polygon in zip(near, (xi @ (1.0, 1.0j)).tolist())]
        inside, outside = pieces_of(WHOLE[n], others)
        if not others or (len(inside) == 1 and not outside):
            inside, outside = QUARTERS if n == 3 and count == SEGMENT_POINTS[0] else [WHOLE[n]], []
        for polygons, border in (inside, True), ([piece for piece in outside if not is_thin(piece)], False):
            for cell in (cell for polygon in polygons for cell in cells_of(polygon, max(closed) if border else 3)):
                cells.setdefault((len(cell), border), []).append((f, cell))
    facets, places, weights = [], [], []
    for (n, border), found in cells.items():
        x, w = points_in(np.array([cell for _, cell in found]), closed[n] if border else triangle_6())
        facets += [f for f, _ in found]
        places.append(np.pad(x, ((0, 0), (0, count - w.shape[1]), (0, 0)), mode="edge"))
        weights.append(np.pad(w, ((0, 0), (0, count - w.shape[1]))))
    order = np.argsort(facets, kind="stable")
    rows, ab, weight = (np.concatenate(v)[order] for v in ([facets], places, weights))
    p, values = pair_points(slave, 16), np.empty((*weight.shape, 16))
    area = p.area.copy()
    for n in np.unique(sides):
        of, known = sides[rows] == n, PAIR_RULES[n][16]
        at = monomials(ab[of].reshape(-1, 2), n, 3) @ np.linalg.pinv(monomials(known.points, n, 3))
        values[of] = at.reshape(-1, *values.shape[1:])
        area[sides == n] /= known.weights
    shape, X, normal = (values @ v[rows] for v in (p.shape, p.X, p.normal * area[..., None]))
    density = np.linalg.norm(normal, axis=2)
    np.divide(normal, density[..., None], out=normal, where=density[..., None] > 0.0)
    return ContactPoints(p.conn[rows], shape, density * weight, X, normal, p.faces[rows], rows)
