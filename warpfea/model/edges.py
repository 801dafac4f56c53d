"""Sharp convex edges of the facets of a surface, which can meet those of another body; see kernels/contact/edges.py."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..elements import Rule
from ..kernels.contact.edges import EDGE_MARGIN
from .assembly import at_points, facet_tables
from .contact_points import ContactPoints, element_edge_and_depth
from .handles import SurfaceSet, once_per_surface

__all__ = ["Edges", "parts_of", "sharp_edges_of", "sharp_sides", "with_edges"]

CORNERS = {
    3: np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]),
    4: np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]),
}
"""Face coordinates of corners, anticlockwise: a side goes from each one to the next."""
INWARD = {3: np.array([(0, 1), (-1, -1), (1, 0)]), 4: np.array([(0, 1), (-1, 0), (0, -1), (1, 0)])}
"""Vector from each side into the facet."""


@dataclass(frozen=True, eq=False)
class Edges:
    """Sharp edges of a surface, each a side of one of its facets, as cubics of a place from 0 to 1.

    Attributes:
        facet, side: (E,) of the surface; across: the facet beyond it. conn: (E, L) slots of the facet.
        half_angle: (E,) between the normals of both facets, rad.
        depth: (E,) least depth of the elements behind both, m.
        shape: (2, 4, L, E) coefficients of the functions of the facet's slots, X: (2, 4, E, 3) of the position, m, and
            of a vector into the facet.
    """

    facet: np.ndarray
    side: np.ndarray
    across: np.ndarray
    conn: np.ndarray
    half_angle: np.ndarray
    depth: np.ndarray
    shape: np.ndarray
    X: np.ndarray

    def take(self, of: np.ndarray) -> Edges:
        """Some of the edges, by mask or number."""
        rest = {name: getattr(self, name)[of] for name in ("facet", "side", "across", "conn", "half_angle", "depth")}
        return Edges(**rest, shape=self.shape[..., of], X=self.X[:, :, of])


@once_per_surface
def sharp_edges_of(surface: SurfaceSet, *, both: bool = False) -> Edges:
    """Sharp edges of a surface: convex ones between two facets with more than twice `EDGE_MARGIN` to either side, each
    once, or with `both` as a side of each of the two."""
    family, kind = surface.body.family, surface.faces[:, 1]
    corners = {int(face): len(family.faces[face]) for face in np.unique(kind)}
    sides = np.array([corners[int(face)] for face in kind])
    facet, side = np.nonzero(np.arange(max(corners.values())) < sides[:, None])
    conn, (shape, into, along) = _on_sides(surface, facet, side, np.array([0.5]))
    e = surface.body.reference[conn]
    x, inward, tangent = (at_points(s, e)[:, 0] for s in (shape, into, along))
    normal = np.cross(tangent, inward)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    key = np.round(x / (1e-7 * np.ptp(x, axis=0).max())).astype(np.int64)
    _, first, number, count = np.unique(key, axis=0, return_index=True, return_inverse=True, return_counts=True)
    order = np.argsort(number.ravel(), kind="stable")
    start = np.cumsum(count) - count
    a, b = order[start[count == 2]], order[start[count == 2] + 1]
    half = 0.5 * np.arccos(np.clip(np.einsum("ek,ek->e", normal[a], normal[b]), -1.0, 1.0))
    sharp = (half > 2.0 * EDGE_MARGIN) & (np.einsum("ek,ek->e", inward[a], normal[b]) < 0.0)
    a, b, half = a[sharp], b[sharp], half[sharp]
    if both:
        a, b, half = np.concatenate([a, b]), np.concatenate([b, a]), np.tile(half, 2)
    else:
        a, b = owners(facet, a, b)
    order = np.lexsort((side[a], facet[a]))
    a, b, half = a[order], b[order], half[order]
    depth = element_edge_and_depth(surface)[1]
    places = np.array([0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0])
    conn, (shape, into, _) = _on_sides(surface, facet[a], side[a], places)
    fit = np.linalg.inv(places[:, None] ** np.arange(4))
    cubic = np.stack([np.einsum("mq,eqi->mie", fit, s) for s in (shape, into)])
    X = np.einsum("nmie,eik->nmek", cubic, surface.body.reference[conn])
    X[0, 0] += surface.body.origin
    least = np.minimum(depth[facet[a]], depth[facet[b]])
    return Edges(facet[a], side[a], facet[b], conn, half, least, cubic, X)


def _on_sides(
    surface: SurfaceSet, facet: np.ndarray, side: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Slots (E, L) of facets, and (E, places, L) values of their functions at places from 0 to 1 of a side each, and
    derivatives into the facet and along the side."""
    family, (of, item) = surface.body.family, np.unique(facet, return_inverse=True)
    used, rules = replace(surface, faces=surface.faces[of]), {}
    sides = np.array([len(family.faces[int(face)]) for face in used.faces[:, 1]])
    for face in np.unique(used.faces[:, 1]).tolist():
        c = CORNERS[len(family.faces[face])]
        points = (c[:, None] + places[:, None] * (np.roll(c, -1, axis=0) - c)[:, None]).reshape(-1, 2)
        rules[face] = Rule("sides", points, np.ones(len(points)), 1)
    t = facet_tables(used, rules=rules)
    rows = item[:, None], len(places) * side[:, None] + np.arange(len(places))
    d_a, d_b = t.d_a[rows], t.d_b[rows]
    along = {n: np.roll(c, -1, axis=0) - c for n, c in CORNERS.items()}
    ways = [np.where(sides[item, None] == 3, way[3][np.minimum(side, 2)], way[4][side]) for way in (INWARD, along)]
    return t.conn[item], [t.shape[rows], *(w[:, 0, None, None] * d_a + w[:, 1, None, None] * d_b for w in ways)]


def owners(facet: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sides a and b of facets that meet at edges, the first of each that of a facet with more of them: few facets."""
    of: dict[int, list[int]] = {}
    for k, both in enumerate(zip(facet[a].tolist(), facet[b].tolist())):
        for f in both:
            of.setdefault(f, []).append(k)
    first = np.full(len(a), -1)
    for least in (4, 3, 2, 1):
        for f, edges in of.items():
            left = [k for k in edges if first[k] < 0]
            if len(left) >= least:
                first[left] = f
    swap = first != facet[a]
    return np.where(swap, b, a), np.where(swap, a, b)


def parts_of(edges: Edges, width: float) -> Edges:
    """The edges in equal parts of about a width, m: each part sees one edge of the other side."""
    counts = np.ceil(np.linalg.norm(edges.X[0, 1:].sum(axis=0), axis=1) / width - 0.5).clip(1).astype(int)
    of = np.repeat(np.arange(len(counts)), counts)
    size = 1.0 / counts[of]
    begin = size * (np.arange(len(of)) - (np.cumsum(counts) - counts)[of])
    turn = np.array([[math.comb(n, m) * begin ** (n - m) * size**m if n >= m else 0.0 * size for n in range(4)]
                     for m in range(4)])  # fmt: skip
    out = edges.take(of)
    shape, X = np.einsum("mne,anie->amie", turn, out.shape), np.einsum("mne,anek->amek", turn, out.X)
    return replace(out, shape=shape, X=X)


def edge_places(edges: Edges, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `count` points, (E,), one or more for each facet with edges, and (E,) number of each edge in its row."""
    number = np.arange(len(edges.facet)) - np.searchsorted(edges.facet, edges.facet)
    _, row = np.unique(np.stack([edges.facet, number // count], axis=1), axis=0, return_inverse=True)
    return row.ravel(), number % count


def with_edges(p: ContactPoints, edges: Edges) -> ContactPoints:
    """Points of a surface, and rows of points on its edges, without an area of their own."""
    row = edge_places(edges, p.area.shape[1])[0]
    facet = edges.facet[np.unique(row, return_index=True)[1]]
    rows = np.arange(len(p.conn)) if p.rows is ... else p.rows
    of = np.searchsorted(rows, facet)
    more = {"conn": p.conn[of], "X": p.X[of], "faces": p.faces[of]}
    more |= {name: np.zeros_like(getattr(p, name)[of]) for name in ("shape", "area", "normal")}
    both = {name: np.concatenate([getattr(p, name), values]) for name, values in more.items()}
    return ContactPoints(**both, rows=np.concatenate([rows, facet]))


@once_per_surface
def sharp_sides(surface: SurfaceSet) -> np.ndarray:
    """(4, F) half the angle between the normals at sharp sides of facets, rad, else 0."""
    out, edges = np.zeros((4, len(surface.faces))), sharp_edges_of(surface)
    out[edges.side, edges.facet] = edges.half_angle
    return out
