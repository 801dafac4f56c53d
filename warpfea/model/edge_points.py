"""Contact of sharp edges of the touched side with the facets of the other: what an edge within a facet bears, which the
points of the facet would miss."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..elements import Rule
from ..kernels.contact.facet_structs import EDGES
from .contact_points import ContactPoints, element_depths, points_by_faces
from .contacts import Collider, Contact, ContactOptions
from .discretisation import Discretisation
from .edges import CORNERS
from .handles import SurfaceSet
from .narrow import MAX_PARTS, WIDEST_GAP, facet_size
from .pairs import FacetOptions, PairContact
from .shapes import Shape

__all__ = ["EdgeContact", "edges_of", "has_edges"]

SHARP_COSINE = math.cos(math.radians(30.0))
"""Cosine of the normals of two faces below which their convex edge is sharp."""
EDGE_WIDTH = 1.0 / 12.0
"""Width of the strip along an edge that its points stand for, over the side of a facet: that of a border point of
Lobatto's rule of 4 points."""
PARTS = 4
"""Parts of a row of points along an edge of an obstacle."""
RESOLUTION = 96
"""Sides of the polygon of a round edge."""


@dataclass(eq=False)
class EdgeContact(FacetOptions):
    """Contact of the edges of the touched side of a contact with the facets of its points; made by
    ModelBuilder.add_contact(clipping=True).

    Attributes:
        of: the contact.
    """

    of: Contact | PairContact
    name: str
    one_sided = EDGES

    @property
    def surfaces(self) -> tuple[SurfaceSet, ...]:
        return self.of.surfaces[::-1]

    @property
    def roles(self) -> tuple[Any, Any]:
        return self.of.roles[::-1]

    @property
    def sign(self) -> float:
        """As of `ContactOptions`."""
        return -float(self.of.sign)

    def slave_points(self) -> tuple[ContactPoints, Any]:
        spacing = WIDEST_GAP * facet_size(self.facets)[0]
        touched = self.of.roles[1]
        points = obstacle_edges(touched.shape, spacing) if self.grounded else body_edges(self.surfaces[0], spacing)
        points.area[:] *= EDGE_WIDTH * facet_size(self.facets)[0]
        factors = np.ones(points.area.shape)
        factors[:, -1] = 0.0
        return points, factors

    def region_area(self, points: ContactPoints) -> float:
        """As of `ContactOptions`; that of the contact."""
        return self.of.region_area(self.of.slave_points()[0])

    def own_depths(self, points: ContactPoints) -> np.ndarray:
        """As of `ContactOptions`; zero of obstacles."""
        if self.grounded:
            return np.zeros(len(points.conn))
        return element_depths(SurfaceSet(self.surfaces[0].body, points.faces))

    def __repr__(self) -> str:
        return f"EdgeContact({self.name!r}, edges of {self.texts[0]})"


def edges_of(contact: Contact | PairContact, index: int) -> EdgeContact:
    """Contact of the edges of the touched side, number `index` of the contacts with facets."""
    options = {f.name: getattr(contact, f.name) for f in fields(ContactOptions) if f.name != "edges"}
    options |= {"points": None, "seam": None, "index": index}
    return EdgeContact(of=contact, name=f"{contact.name} edges", **options)


def has_edges(contact: Contact | PairContact) -> bool:
    """True if the touched side of a contact has a sharp edge."""
    touched = contact.roles[1]
    found = _sharp_edges(touched.shape) if isinstance(touched, Collider) else _sharp_sides(contact.surfaces[-1])
    return len(found[0]) > 0


def _line_weights(X: np.ndarray) -> np.ndarray:
    """(F, P) trapezoidal weights of points (F, P, 3) on lines, m."""
    half = 0.5 * np.linalg.norm(np.diff(X, axis=1), axis=2)
    return np.asarray(np.pad(half, ((0, 0), (0, 1))) + np.pad(half, ((0, 0), (1, 0))))


def _is_convex_and_sharp(normals: np.ndarray, inward: np.ndarray) -> np.ndarray:
    """(E,) True where faces with normals (E, 2, 3) meet in a sharp convex edge; `inward`: a way along the second."""
    cosine = np.einsum("ei,ei->e", normals[:, 0], normals[:, 1])
    return np.asarray((cosine < SHARP_COSINE) & (np.einsum("ei,ei->e", normals[:, 0], inward) < 0.0))


def _sharp_edges(shape: Shape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends (E, 2, 3), m, of the sharp edges of an obstacle with an inside, each once for both of its triangles, normals
    (E, 3), and points inside of these (E, 3), m."""
    points, triangles = shape.mesh(RESOLUTION)
    x = points[triangles]
    n = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    n /= np.linalg.norm(n, axis=1)[:, None]
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    order = np.lexsort(np.sort(ends, axis=1).T)
    one, two = order[:-1], order[1:]
    paired = (np.sort(ends[one], axis=1) == np.sort(ends[two], axis=1)).all(axis=1)
    one, two = np.concatenate([one[paired], two[paired]]), np.concatenate([two[paired], one[paired]])
    middle = x.mean(axis=1)
    sharp = _is_convex_and_sharp(n[np.stack([one, two], axis=1) // 3], middle[two // 3] - points[ends[one, 0]])
    one = one[sharp]
    return points[ends[one]], n[one // 3], middle[one // 3]


def obstacle_edges(shape: Shape, spacing: float) -> ContactPoints:
    """Points on the sharp edges of an obstacle, without slots, at most `spacing`, m, apart, once for each face at the
    edge; areas per width, m. The last point of a row lies in its face: with the others it tells the outward side."""
    ends, normal, inside = _sharp_edges(shape)
    pieces = np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / (PARTS * spacing) - 1e-9).astype(int)
    pieces = np.maximum(pieces, 1)
    edge = np.repeat(np.arange(len(ends)), pieces)
    first = np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    at = (first[:, None] + np.linspace(0.0, 1.0, PARTS + 1)) / pieces[edge, None]
    X = ends[edge, :1] + at[:, :, None] * (ends[edge, 1:] - ends[edge, :1])
    area = np.pad(_line_weights(X), ((0, 0), (0, 1)), mode="edge")
    X = np.concatenate([X, inside[edge, None]], axis=1)
    F, P = area.shape
    normals = np.repeat(normal[edge, None], P, axis=1)
    return ContactPoints(np.zeros((F, 1), dtype=int), np.zeros((F, P, 1)), area, X, normals, np.full((F, 2), -1))


def _along_side(surface: SurfaceSet, side: int, at: np.ndarray) -> ContactPoints:
    """Points at `at` (P,) from 0 to 1 along a side of each face, and last one inside of it."""
    rules = {}
    for face in np.unique(surface.faces[:, 1]).tolist():
        corners = CORNERS[len(surface.body.family.faces[face])]
        ends = corners[side], corners[(side + 1) % len(corners)]
        points = np.vstack([ends[0] + at[:, None] * (ends[1] - ends[0]), corners.mean(axis=0)])
        rules[face] = Rule("side", points, np.zeros(len(points)), 0)
    return points_by_faces(surface, rules)


def _faces_with(body: Discretisation, faces: np.ndarray, side: int) -> np.ndarray:
    count = np.array([len(face) for face in body.family.faces])
    return faces[count[faces[:, 1]] > side]


def _sharp_sides(surface: SurfaceSet) -> tuple[np.ndarray, np.ndarray]:
    """Faces (E, 2) at the sharp edges of a body that bound a face of the surface, and sides of these (E,)."""
    body = surface.body
    faces, sides, middle, normal, inside = [], [], [], [], []
    for side in range(4):
        chosen = _faces_with(body, body.boundary, side)
        if len(chosen):
            p = _along_side(SurfaceSet(body, chosen), side, np.array([0.5]))
            faces.append(chosen)
            sides.append(np.full(len(chosen), side))
            middle.append(p.X[:, 0])
            normal.append(p.normal[:, 0])
            inside.append(p.X[:, 1])
    f, s, x, n, y = map(np.concatenate, (faces, sides, middle, normal, inside))
    size = float(np.linalg.norm(np.ptp(x, axis=0)))
    number = np.unique(np.round(x / (1e-8 * size)).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(number, kind="stable")
    one, two = order[:-1], order[1:]
    paired = number[one] == number[two]
    one, two = np.concatenate([one[paired], two[paired]]), np.concatenate([two[paired], one[paired]])
    count = len(body.family.faces)
    own = np.isin(f @ (count, 1), surface.faces @ (count, 1))
    sharp = (own[one] | own[two]) & _is_convex_and_sharp(np.stack([n[one], n[two]], axis=1), y[two] - x[two])
    return f[one[sharp]], s[one[sharp]]


def body_edges(surface: SurfaceSet, spacing: float) -> ContactPoints:
    """Points on the sharp edges of a body that bound faces of a surface, as of `obstacle_edges`."""
    faces, sides = _sharp_sides(surface)
    count = 1
    found: list[ContactPoints] = []
    for at in (np.linspace(0.0, 1.0, 3), None):
        grid = np.linspace(0.0, 1.0, count + 1) if at is None else at
        found = [_along_side(SurfaceSet(surface.body, faces[sides == side]), side, grid) for side in np.unique(sides)]
        length = max(float(_line_weights(p.X[:, :-1]).sum(axis=1).max()) for p in found)
        count = int(np.clip(math.ceil(length / spacing), 1, MAX_PARTS))
    width = max(p.conn.shape[1] for p in found)
    for p in found:
        p.area[:] = np.pad(_line_weights(p.X[:, :-1]), ((0, 0), (0, 1)), mode="edge")
    conn = np.concatenate([np.pad(p.conn, ((0, 0), (0, width - p.conn.shape[1])), mode="edge") for p in found])
    shape = np.concatenate([np.pad(p.shape, ((0, 0), (0, 0), (0, width - p.shape.shape[2]))) for p in found])
    rest = {name: np.concatenate([getattr(p, name) for p in found]) for name in ("area", "X", "normal", "faces")}
    return ContactPoints(conn, shape, **rest)
