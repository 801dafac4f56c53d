"""Neighbours of colliders at whose seams side faces are hidden, see kernels/contact/collider_seams.py."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..kernels.contact.collider_shapes import BOX, CYLINDER, HALF_SPACE, MESH
from ..model.contacts import Collider, Contact
from ..model.shapes import HalfSpace, Shape
from ..model.triangle_mesh import TriMesh

__all__ = ["SEAM_RATIO", "SeamTables", "seam_tables"]

SEAM_RATIO = 1e-3
"""Default `seam` over the width of a surface: the second largest edge of its bounding box."""
REACH_RATIO = 0.2
"""Widest gap that a surface passes level, over its width."""
DEPTH_RATIO = 0.02
"""Largest depth below the level at which a point at a gap belongs to it, over the width of the surface."""

EDGED = {HALF_SPACE, BOX, CYLINDER, MESH}
"""Kinds of shapes with flat faces."""


@dataclass(frozen=True, eq=False)
class SeamTables:
    """Neighbours of the colliders of contacts.

    Attributes:
        neighbor_start: (contacts + 1,) first neighbour of each contact.
        neighbor: colliders. neighbor_shares: 1 where the body's contact with it has the same points.
        seam_lengths: (contacts, 3) `seam`, reach and depth, m.
    """

    neighbor_start: np.ndarray
    neighbor: np.ndarray
    neighbor_shares: np.ndarray
    seam_lengths: np.ndarray


def seam_tables(contacts: Sequence[Contact], surfaces: Sequence[np.ndarray]) -> SeamTables | None:
    """Neighbours of the contacts; None if none has any.

    Args:
        surfaces: (n, 3) points of each contact, m.
    """
    width = np.array([np.sort(np.ptp(X, axis=0))[1] for X in surfaces])
    found = [_neighbors(contact, contacts, REACH_RATIO * w) for contact, w in zip(contacts, width)]
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
    p, q = a.mesh()[0], b.mesh()[0]
    return bool(np.all(p.min(axis=0) <= q.max(axis=0) + reach) and np.all(q.min(axis=0) <= p.max(axis=0) + reach))
