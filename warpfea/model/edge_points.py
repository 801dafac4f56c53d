"""Contact of sharp edges of the touched side with the facets of the other: what an edge within a facet bears, which the
points of the facet would miss."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..kernels.contact.edges import EDGE_MARGIN
from ..kernels.contact.facet_structs import EDGES
from .contact_points import ContactPoints, element_depths
from .contacts import Contact, ContactOptions
from .edges import parts_of, sharp_edges_of
from .handles import SurfaceSet
from .narrow import WIDEST_GAP, facet_size
from .pairs import FacetOptions, PairContact
from .shapes import Shape

__all__ = ["EdgeContact", "edge_contact"]

EDGE_WIDTH = 1.0 / 12.0
"""Width of the strip along an edge that its points stand for, over the side of a facet: that of a border point of
Lobatto's rule of 4 points."""
PARTS = 4
"""Parts of a row of points along an edge."""
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


def edge_contact(contact: Contact | PairContact, index: int) -> EdgeContact | None:
    """Contact of the edges of the touched side, number `index` of the contacts with facets; None if it has none."""
    options = {f.name: getattr(contact, f.name) for f in fields(ContactOptions) if f.name != "edges"}
    options |= {"points": None, "seam": None, "index": index}
    out = EdgeContact(of=contact, name=f"{contact.name} edges", **options)
    return out if len(out.slave_points()[0].conn) else None


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
    cosine = np.einsum("ei,ei->e", n[one // 3], n[two // 3])
    convex = np.einsum("ei,ei->e", n[one // 3], middle[two // 3] - points[ends[one, 0]]) < 0.0
    one = one[convex & (cosine < math.cos(4.0 * EDGE_MARGIN))]
    return points[ends[one]], n[one // 3], middle[one // 3]


def obstacle_edges(shape: Shape, spacing: float) -> ContactPoints:
    """Points on the sharp edges of an obstacle, without slots, at most `spacing`, m, apart, once for each face at the
    edge; areas per width, m. The last point of a row lies in its face: with the others it tells the outward side.
    Edges are sharp as those of `sharp_edges_of`."""
    ends, normal, inside = _sharp_edges(shape)
    pieces = np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / (PARTS * spacing) - 1e-9).astype(int)
    pieces = np.maximum(pieces, 1)
    edge = np.repeat(np.arange(len(ends)), pieces)
    first = np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    at = (first[:, None] + np.linspace(0.0, 1.0, PARTS + 1)) / pieces[edge, None]
    X = ends[edge, :1] + at[:, :, None] * (ends[edge, 1:] - ends[edge, :1])
    X = np.concatenate([X, inside[edge, None]], axis=1)
    F, P = X.shape[:2]
    return _rows(np.zeros((F, 1), dtype=int), np.zeros((F, P, 1)), X, normal[edge], np.full((F, 2), -1))


def body_edges(surface: SurfaceSet, spacing: float) -> ContactPoints:
    """Points on the sharp edges of a body that bound faces of a surface, as of `obstacle_edges`."""
    skin, count = SurfaceSet(surface.body, surface.body.boundary), len(surface.body.family.faces)
    own = np.isin(skin.faces @ (count, 1), surface.faces @ (count, 1))
    edges = sharp_edges_of(skin, both=True)
    edges = parts_of(edges.take(own[edges.facet] | own[edges.across]), PARTS * spacing / 1.5)
    power = np.append(np.linspace(0.0, 1.0, PARTS + 1), 0.5)[:, None] ** np.arange(4)
    inside = np.append(np.zeros(PARTS + 1), 0.5)[:, None] * power
    shape, X = (np.einsum("aqm,amek->eqk", [power, inside], v) for v in (np.swapaxes(edges.shape, 2, 3), edges.X))
    normal = np.cross(X[:, PARTS] - X[:, 0], X[:, -1] - X[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return _rows(edges.conn, shape, X, normal, skin.faces[edges.facet])


def _rows(conn: np.ndarray, shape: np.ndarray, X: np.ndarray, normal: np.ndarray, faces: np.ndarray) -> ContactPoints:
    """Rows of points along edges and one inside of the face, with trapezoidal lengths in place of areas, m."""
    half = 0.5 * np.linalg.norm(np.diff(X[:, :-1], axis=1), axis=2)
    length = np.pad(half, ((0, 0), (0, 1))) + np.pad(half, ((0, 0), (1, 0)))
    length = np.pad(length, ((0, 0), (0, 1)), mode="edge")
    return ContactPoints(conn, shape, length, X, np.repeat(normal[:, None], X.shape[1], axis=1), faces)
