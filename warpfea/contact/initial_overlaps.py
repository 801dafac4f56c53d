"""Initial overlaps: rejected or stored as offsets."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..kernels.contact.thickness import depth_kernel
from ..model.surfaces import measure_to_skin

if TYPE_CHECKING:
    from .collider_tables import ContactTables
    from .facet_tables import PairTables

__all__ = ["reference_position_text", "refuse_deep_overlaps", "store_overlaps", "touching_depth"]

TOUCHING_DEPTH_RATIO = 1e-9
"""Initial depth over the model's size treated as touching; round-off of displacements is added."""

MIN_DEEP_OVERLAP_RATIO = 0.1
"""Smallest depth, over the depth limit of the body's thinnest facet, at which an unassigned point counts as inside: the
inside test uses flat triangles."""


def touching_depth(size: float, u: np.ndarray) -> np.ndarray:
    """Largest depth (worlds,), m, treated as touching, at displacements u (worlds, slots, 3)."""
    return np.asarray(TOUCHING_DEPTH_RATIO * size + 4.0 * np.finfo(u.dtype).eps * np.abs(u).max(axis=(1, 2)))


def reference_position_text(tables: ContactTables | PairTables, k: int, point: int) -> str:
    """Reference position of a contact point, as text."""
    X = tables.host[k].X.reshape(-1, 3)[point]
    return "(" + ", ".join(f"{x:.4g}" for x in X) + ")"


def store_overlaps(term: Any, depth: np.ndarray, touching: np.ndarray, overlap: np.ndarray) -> None:
    """Store depths (worlds, points), m, above the touching depth in `overlap` (worlds, points); `term`: of the points.

    Raises:
        ModelError: an overlap with `overlap` "refuse".
    """
    tables = term.tables
    for k, contact in enumerate(tables.contacts):
        points = slice(tables.first[k], tables.first[k + 1])
        mine = depth[:, points]
        deep = mine.max(axis=1) > touching
        if not deep.any():
            continue
        if contact.overlap == "refuse":
            world, point = np.unravel_index(int(mine.argmax()), mine.shape)
            body, other, _ = term.sides_text(contact)
            raise ModelError(
                f"contact {contact.name!r}: body {body!r} begins {mine.max():.3g} m inside {other} "
                f"(world {world}, reference point {reference_position_text(tables, k, int(point))}); move one of them, "
                "or take overlap='offset', which stores the overlap and lets it decay"
            )
        kept = np.maximum(mine[deep], 0.0)
        overlap[deep, points] = kept.max(axis=1, keepdims=True) if contact.model == "sphere" else kept


def refuse_deep_overlaps(
    tables: PairTables, u: np.ndarray, places: np.ndarray, facets: np.ndarray, new: np.ndarray
) -> None:
    """Reject bodies that begin deeper in another body than any of its facets reaches.

    Args:
        u: displacements (worlds, slots, 3), m.
        places: positions of the points (worlds, points, 3), m.
        facets: facets that the points are assigned to, -1 for none, (worlds, points).
        new: (worlds,) flags of the worlds that begin.

    Raises:
        ModelError: such a point in a contact with `overlap` "refuse".
    """
    for k, contact in enumerate(tables.contacts):
        if contact.overlap != "refuse":
            continue
        body, points = contact.master.body, slice(tables.first[k], tables.first[k + 1])
        limit = tables.masters[tables.master_of[k]].depth_limit
        least = MIN_DEEP_OVERLAP_RATIO * float(limit.min())
        beyond = (0.0 if body.family.solid else float(limit.max())) - least  # margin of the nodal bounding box
        nodes = body.slot_kind == 0
        spans = body.reference[nodes] + body.origin + u[:, body.slots[nodes]]
        low, high = (end(axis=1)[:, None] for end in (spans.min, spans.max))
        x = places[:, points]
        near = ((x > low - beyond) & (x < high + beyond)).all(axis=2) & (facets[:, points] < 0)
        near &= new[:, None] & (tables.host[k].area.ravel() > 0.0)
        seen = set()
        for world in np.flatnonzero(near.any(axis=1)):
            key = (u[world, body.slots].tobytes(), x[world, near[world]].tobytes())
            if key in seen:
                continue
            seen.add(key)
            depth = measure_to_skin(body, depth_kernel(), x[world, near[world]], u=u[world, body.slots])
            if depth.max() > least:
                point = int(np.flatnonzero(near[world])[depth.argmax()])
                raise ModelError(
                    f"contact {contact.name!r}: body {contact.slave.body.name!r} begins within body {body.name!r} "
                    f"(world {world}, reference point {reference_position_text(tables, k, point)}, "
                    f"{depth.max():.3g} m deep), where no facet of the contact reaches; move one of them, or leave "
                    "these faces out of the contact"
                )
