"""Meshes: :class:`Mesh`, :func:`read` for files, generators with named sides, and :func:`check`.

Lengths are in metres once read (``scale``). Set names come from the file's groups, or from the generator's
sides.
"""

from __future__ import annotations

from typing import Any

from .adapter import read
from .cells import CELL_TYPES, CellType
from .checks import check
from .generators import box, cylinder, sphere
from .mesh import Mesh

__all__ = ["CELL_TYPES", "CellType", "Mesh", "box", "check", "cylinder", "grid", "read", "sphere"]


def grid(*args: Any, **kwargs: Any) -> Mesh:
    """Not delivered yet: a flat grid of quadrilaterals for shells."""
    raise NotImplementedError("mesh.grid (quadrilateral grids for shells) is not delivered yet")
