"""Bodies that begin across a sheet of triangles."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..base.launch import Launcher
from ..kernels.terms.contact_sheets import sheet_kernels
from ..model.triangle_mesh import TriMesh
from .contact_tables import ContactTables

__all__ = ["points_across"]


def points_across(
    tables: ContactTables, attempt: Any, displacement: wp.array, tolerance: np.ndarray, launch: Launcher
) -> np.ndarray:  # fmt: skip
    """(worlds, facets) a point of each facet, + 1, that is behind a sheet while others are in front, or 0.

    Args:
        attempt: where colliders are.
        tolerance: (worlds,) m.
    """
    m = tables.model
    found = wp.zeros((m.worlds, tables.rows), dtype=wp.int32, device=m.device)
    limit: Any = wp.array(tolerance, dtype=wp.float64, device=m.device)
    for group in tables.groups:
        args = [tables.data, group.data, displacement, limit, attempt, found]
        launch(sheet_kernels(m.dtype).across, (m.worlds, group.count), args)
    sheet = [isinstance(c.collider.shape, TriMesh) and not c.collider.shape.closed for c in tables.contacts]
    return np.where(np.repeat(sheet, np.diff(tables.row_start)), found.numpy(), 0)
