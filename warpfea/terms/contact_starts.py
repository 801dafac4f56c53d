"""What overlaps where contact begins: refused, or stored as the contact says."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..base.errors import ModelError
from ..model.contacts import Contact
from ..model.pairs import PairContact

if TYPE_CHECKING:
    from .contact_tables import ContactTables
    from .pair_tables import PairTables

__all__ = ["reference_place", "store_overlaps", "touching_depth"]

TOUCHING = 1e-9
"""Depth at the start, over the model's size, that counts as touch; roundings of displacements come on top."""


def touching_depth(size: float, u: np.ndarray) -> np.ndarray:
    """(worlds,) m that count as touch, at displacements u (worlds, slots, 3)."""
    return np.asarray(TOUCHING * size + 4.0 * np.finfo(u.dtype).eps * np.abs(u).max(axis=(1, 2)))


def reference_place(tables: ContactTables | PairTables, k: int, point: int) -> str:
    """Reference place of a point of a contact."""
    X = tables.host[k].X.reshape(-1, 3)[point]
    return "(" + ", ".join(f"{x:.4g}" for x in X) + ")"


def store_overlaps(
    tables: ContactTables | PairTables, depth: np.ndarray, touching: np.ndarray, overlap: np.ndarray
) -> None:  # fmt: skip
    """Put depths (worlds, points), m, above touch into `overlap` (worlds, points).

    Raises:
        ModelError: a contact whose `overlap` is "refuse" has one.
    """
    contacts: list[Contact | PairContact] = [*tables.contacts]
    for k, contact in enumerate(contacts):
        points = slice(tables.first[k], tables.first[k + 1])
        mine = depth[:, points]
        deep = mine.max(axis=1) > touching
        if not deep.any():
            continue
        if contact.overlap == "refuse":
            world, point = np.unravel_index(int(mine.argmax()), mine.shape)
            if isinstance(contact, PairContact):
                other = f"body {contact.master.body.name!r}"
            else:
                other = f"collider {contact.collider.name!r}"
            raise ModelError(
                f"contact {contact.name!r}: body {contact.body.name!r} begins {mine.max():.3g} m inside {other} "
                f"(world {world}, reference point {reference_place(tables, k, int(point))}); move one of them, or take "
                "overlap='offset', which stores the overlap and lets it decay"
            )
        kept = np.maximum(mine[deep], 0.0)
        overlap[deep, points] = kept.max(axis=1, keepdims=True) if contact.model == "sphere" else kept
