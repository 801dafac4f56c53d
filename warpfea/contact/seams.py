"""Neighbours of colliders and bodies at whose seams side faces are hidden, see kernels/contact/collider_seams.py and
facet_seams.py."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..base.errors import ModelWarning
from ..kernels.contact.collider_seams import LEVEL_COSINE
from ..kernels.contact.collider_shapes import BOX, CYLINDER, HALF_SPACE, MESH
from ..model.assembly import connected_components
from ..model.contacts import Collider, Contact
from ..model.description import Description
from ..model.handles import SurfaceSet
from ..model.pairs import FacetOptions, MasterFacets, facet_point_areas, pair_points
from ..model.shapes import HalfSpace, Shape
from ..model.triangle_mesh import TriMesh

__all__ = ["SEAM_RATIO", "LevelFacets", "MixedSeam", "SeamTables", "facet_seam_tables", "mixed_seams", "seam_tables"]

SEAM_RATIO = 1e-3
"""Default `seam` over the width of a surface: the second largest edge of its bounding box."""
REACH_RATIO = 0.2
"""Widest gap that a surface passes level, over its width."""
DEPTH_RATIO = 0.02
"""Largest depth below the level at which a point at a gap belongs to it, over the width of the surface."""
MAX_FLAT = 1000
"""Triangles of a collider above which none is looked for that continues a body's face: a bound of time. Obstacles of
flat faces have dozens, ground from scans many thousands, whose faces continue none; any number between does."""
EDGED = {HALF_SPACE, BOX, CYLINDER, MESH}
"""Kinds of shapes with flat faces."""


@dataclass(frozen=True, eq=False)
class SeamTables:
    """Neighbours of the colliders of contacts.

    Attributes:
        neighbor_start: (contacts + 1,) first neighbour of each contact.
        neighbor: colliders, -1: bodies. neighbor_shares: 1 where the body's contact with it has the same points.
        seam_lengths: (contacts, 3) `seam`, reach and depth, m.
    """

    neighbor_start: np.ndarray
    neighbor: np.ndarray
    neighbor_shares: np.ndarray
    seam_lengths: np.ndarray


@dataclass(frozen=True, eq=False)
class LevelFacets:
    """Triangles of an obstacle that continue a surface of a body, as facets without slots.

    Attributes:
        body: that body. faces: (T, 9) corners, m. normal: of all. width: of the body that slides on both, m.
    """

    body: Any
    faces: np.ndarray
    normal: np.ndarray
    width: float

    def facets(self) -> MasterFacets:
        """As polynomials 1, b, a of the coordinates a, b; their size enlarges no box."""
        x, count = self.faces.reshape(-1, 3, 3), len(self.faces)
        n, none = np.zeros_like(x), np.zeros((count, 3, 1))
        n[:, 0] = self.normal
        X = np.stack([x[:, 0], x[:, 2] - x[:, 0], x[:, 1] - x[:, 0]], axis=1)
        depth = np.full(count, 2.0 * DEPTH_RATIO * self.width)
        conn = np.zeros((count, 1), dtype=np.int64)
        return MasterFacets(conn, none, none, X, n, 3, 1, np.zeros(count), depth, np.zeros((4, count)))


@dataclass(frozen=True, eq=False)
class MixedSeam:
    """A collider and a body at one level, both touched by another body.

    Attributes:
        contact: of that one with the collider. surface: of the body at the level. level: of the collider.
        reach: widest gap, m and over the side of the body's facets.
    """

    contact: Contact
    surface: SurfaceSet
    level: LevelFacets
    reach: tuple[float, float]


def seam_tables(
    contacts: Sequence[Contact], surfaces: Sequence[np.ndarray], mixed: Sequence[MixedSeam]
) -> SeamTables | None:
    """Neighbours of the contacts; None if none has any.

    Args:
        surfaces: (n, 3) points of each contact, m.
    """
    beside = [seam.contact for seam in mixed if seam.contact.collider.shape.kind != HALF_SPACE]
    width = np.array([np.sort(np.ptp(X, axis=0))[1] for X in surfaces])
    found = [_neighbors(contact, contacts, REACH_RATIO * w) for contact, w in zip(contacts, width)]
    found = [rows + [(-1, 0)] * (contact in beside) for rows, contact in zip(found, contacts)]
    if not any(found):
        return None
    lengths = width[:, None] * (SEAM_RATIO, REACH_RATIO, DEPTH_RATIO)
    for k, contact in enumerate(contacts):
        if contact.seam is not None:
            lengths[k, 0] = contact.seam
    rows = np.array([row for rows in found for row in rows])
    return SeamTables(np.cumsum([0, *map(len, found)]), rows[:, 0], rows[:, 1], lengths)


def _neighbors(contact: Contact, contacts: Sequence[Contact], reach: float) -> list[tuple[int, int]]:
    """Colliders near that of a contact that its body touches too, moved by the same path, and 1 for the same points."""
    mine = contact.collider
    several = isinstance(mine.shape, TriMesh) and mine.shape.part_count > 1
    out = {mine.index: 0} if several else {}
    for other in contacts:
        a, b = mine, other.collider
        if other.body is contact.body and a is not b and _same_path(a, b) and _are_near(a.shape, b.shape, reach):
            points = other.points == contact.points and "sphere" not in (other.model, contact.model)
            same = points and np.array_equal(other.surface.faces, contact.surface.faces)
            out[b.index] = max(out.get(b.index, 0), int(same))
    return list(out.items())


def mixed_seams(description: Description) -> list[MixedSeam]:
    """Bodies above a collider and another body whose faces are at one level.

    Warns:
        ModelWarning: a collider that moves: what slides meets a side face.
    """
    pairs = [c for c in description.contacts_of(FacetOptions) if not c.grounded]
    out = []
    for contact in description.contacts_of(Contact):
        body, collider = contact.body, contact.collider
        near = {_key(s): s for c in pairs if body in c.sides for s in c.surfaces if s.body is not body}
        if not near or collider.shape.kind not in EDGED:
            continue
        X = pair_points(contact.surface).X.reshape(-1, 3)
        width = float(np.sort(np.ptp(X, axis=0))[1])
        for surface in near.values():
            seam = SEAM_RATIO * width if contact.seam is None else contact.seam
            level = _continued(collider.shape, surface, X, width, seam)
            if level is None:
                continue
            if not collider.moves:
                size = math.sqrt(facet_point_areas(surface).sum(axis=1).min())
                reach = REACH_RATIO * width
                out.append(MixedSeam(contact, surface, level, (reach, reach / size)))
                continue
            warnings.warn(
                f"body {body.name!r} touches collider {collider.name!r}, which moves, and body {surface.body.name!r}, "
                "which are at one level: what slides from one to the other meets a side face; make the collider a "
                "rigid part, b.add_rigid(shape, ...) with its nodes driven: seams of parts and bodies are passed",
                ModelWarning,
                stacklevel=2,
            )
    return out


def _continued(shape: Shape, surface: SurfaceSet, above: np.ndarray, width: float, seam: float) -> LevelFacets | None:
    """The flat face of a shape that facets of a body continue, near it, with all points `above` on it, or None."""
    p = pair_points(surface)
    size = float(np.ptp(p.X.reshape(-1, 3), axis=0).max())
    points, triangles = shape.mesh(size=4.0 * size, around=p.X[0, 0]) if isinstance(shape, HalfSpace) else shape.mesh()
    reach = REACH_RATIO * width
    if len(triangles) > MAX_FLAT or not _boxes_are_near(points, p.X.reshape(-1, 3), reach):
        return None
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for x, n in zip(corners, normals):
        level = (np.abs((p.X - x[0]) @ n) <= seam).all(axis=1) & (p.normal[:, 0] @ n > LEVEL_COSINE)
        low, high = p.X[level].min(axis=1) - reach, p.X[level].max(axis=1) + reach
        near = ((low <= x.max(axis=0)) & (high >= x.min(axis=0))).all(axis=1)
        if near.any() and ((above - x[0]) @ n).min() > -seam:
            flush = (np.abs((corners - x[0]) @ n) <= seam).all(axis=1) & (normals @ n > LEVEL_COSINE)
            return LevelFacets(surface.body, corners[flush].reshape(-1, 9), n, width)
    return None


def _same_path(a: Collider, b: Collider) -> bool:
    """True for colliders that keep their relative position."""
    if a.rotation is not None and b.rotation is not None:
        same = np.array_equal(a.rotation.anchor, b.rotation.anchor) and np.array_equal(a.rotation.axis, b.rotation.axis)
        return same and _same_law(a.rotation.angle, b.rotation.angle)
    return a.rotation is b.rotation and _same_law(a.law, b.law)


def _same_law(a: Any, b: Any) -> bool:
    """True for time laws of equal values."""
    if a is None or b is None:
        return a is b
    same = a.function is b.function and a.control == b.control
    return same and np.array_equal(a.times, b.times) and np.array_equal(a.values, b.values)


def _are_near(a: Shape, b: Shape, reach: float) -> bool:
    """True for shapes with edges if the bounding box of one is within `reach` of the other, or of its bounding box."""
    if not {a.kind, b.kind} <= EDGED or a.kind == b.kind == HALF_SPACE:
        return False
    for plane, other in ((a, b), (b, a)):
        if isinstance(plane, HalfSpace):
            return bool((other.mesh()[0] @ plane.normal).min() <= plane.offset + reach)
    return _boxes_are_near(a.mesh()[0], b.mesh()[0], reach)


def _boxes_are_near(p: np.ndarray, q: np.ndarray, reach: float) -> bool:
    """True if the bounding boxes of two sets of points are within `reach`, m."""
    return bool(np.all(p.min(axis=0) <= q.max(axis=0) + reach) and np.all(q.min(axis=0) <= p.max(axis=0) + reach))


def facet_seam_tables(
    contacts: Sequence[FacetOptions], number: Callable[[Any], int], mixed: Sequence[MixedSeam]
) -> dict[str, np.ndarray]:
    """Neighbours of both sides of contacts between bodies, as fields of `master_struct`; empty if none has any.

    Neighbours of a side are surfaces near it that the body of the other side touches, too, at any distance where the
    contact has a `seam`, and the parts of its own; of a side that a collider continues that one's level faces.

    Args:
        number: number of a surface or of level facets, which then has facets.
    """
    touched: dict[int, dict[Any, SurfaceSet]] = {}
    for contact in contacts:
        for mine, other in permutations(contact.surfaces, 2):
            touched.setdefault(mine.body.index, {})[_key(other)] = other
    points: dict[Any, np.ndarray] = {}

    def box(surface: SurfaceSet) -> np.ndarray:
        """Lower and upper corner."""
        key = _key(surface)
        if key not in points:
            X = pair_points(surface).X.reshape(-1, 3)
            points[key] = np.stack([X.min(axis=0), X.max(axis=0)])
        return points[key]

    rows: list[list[Any]] = []
    lengths = np.zeros((2 * len(contacts), 3))
    for contact in contacts:
        for side, other in ((contact.surfaces[k], contact.surfaces[-1 - k]) for k in (-1, 0)):
            near: list[SurfaceSet] = []
            if not contact.grounded:
                near = [s for key, s in touched[other.body.index].items() if key != _key(side) or _has_parts(s)]
            continued = [m.level for m in mixed if m.contact.body is other.body and _key(m.surface) == _key(side)]
            if near or continued:
                width = float(np.sort(np.ptp(box(other), axis=0))[1])
                lengths[len(rows)] = width * np.array((SEAM_RATIO, REACH_RATIO, DEPTH_RATIO))
                reach = math.inf if contact.seam is not None else REACH_RATIO * width
                near = [s for s in near if _boxes_are_near(box(s), box(side), reach)]
            if contact.seam is not None:
                lengths[len(rows), 0] = contact.seam
            rows.append([*(s for s in near if max(_corners(s), _corners(side)) == 1), *continued])
    if not any(rows):
        return {}
    sides = [contact.surfaces[k] for contact in contacts for k in (-1, 0)]
    return {
        "neighbor_start": np.cumsum([0, *map(len, rows)]),
        "neighbor": np.array([number(surface) for row in rows for surface in row]),
        "seam_surface": np.array([number(side) if row else -1 for side, row in zip(sides, rows)]),
        "seam_lengths": lengths,
    }


def _key(surface: SurfaceSet) -> tuple[int, bytes]:
    """Key of the faces of a surface."""
    return surface.body.index, surface.faces.tobytes()


def _corners(surface: SurfaceSet) -> int:
    """Number of kinds of faces, by their corners."""
    return len({len(surface.body.family.faces[int(face)]) for face in np.unique(surface.faces[:, 1])})


def _has_parts(surface: SurfaceSet) -> bool:
    """True for a surface of a body of several parts that are not connected."""
    body = surface.body
    for elements in (surface.faces[:, 0], np.arange(len(body.connectivity))):
        conn = len(elements) + body.connectivity[elements]
        row = np.repeat(np.arange(len(conn)), conn.shape[1])
        size = len(elements) + len(body.reference)
        graph = sp.coo_matrix((np.ones(len(row)), (row, conn.ravel())), shape=(size, size))
        if not connected_components(graph)[: len(elements)].any():
            return False
    return True
