"""Initial penetration check of bodies across a sheet of triangles."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.launch import Launcher
from ..kernels.contact.collider_sheets import sheet_kernels
from ..model.triangle_mesh import TriMesh
from .collider_tables import ContactTables
from .initial_overlaps import reference_position_text

__all__ = ["check_sheet_sides"]


def check_sheet_sides(
    term: Any, other: Any, displacement: wp.array, tolerance: np.ndarray, new: np.ndarray, launch: Launcher
) -> None:  # fmt: skip
    """Raise ModelError for a body that begins on both sides of a sheet.

    Args:
        term: the contact term.
        other: current collider poses.
        tolerance, new: (worlds,) m, and flags of the worlds to check.
    """
    t = term.tables
    points = _points_behind(t, other, displacement, tolerance, launch)
    for world, row in np.argwhere((points > 0) & new[:, None])[:1]:
        k = int(np.searchsorted(t.row_start, row, side="right")) - 1
        contact, where = t.contacts[k], reference_position_text(t, k, int(points[world, row]) - 1 - int(t.first[k]))
        raise ModelError(
            f"contact {contact.name!r}: body {contact.body.name!r} begins on both sides of collider "
            f"{contact.collider.name!r}, or on it and behind (world {world}, reference point {where}); move one of "
            "them: bodies on a sheet of triangles are in front of it"
        )


def _points_behind(
    tables: ContactTables, other: Any, displacement: wp.array, tolerance: np.ndarray, launch: Launcher
) -> np.ndarray:  # fmt: skip
    """One point (worlds, facets) of each facet, + 1, behind a sheet while others are in front, or 0."""
    m = tables.model
    found = wp.zeros((m.worlds, tables.rows), dtype=wp.int32, device=m.device)
    limit: Any = wp.array(tolerance, dtype=wp.float64, device=m.device)
    for group in tables.groups:
        args = [other, group.data, displacement, limit, found]
        launch(sheet_kernels(m.dtype).find_crossed_sheets, (m.worlds, group.count), args)
    sheet = [isinstance(c.collider.shape, TriMesh) and not c.collider.shape.closed for c in tables.contacts]
    return np.where(np.repeat(sheet, np.diff(tables.row_start)), found.numpy(), 0)
