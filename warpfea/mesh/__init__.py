"""Meshes: :class:`Mesh`, :func:`read` for files, generators with named sides, :func:`check` and :func:`linear`.

Lengths are in metres once read (``scale``). Set names come from the file's groups, or from the generator's
sides.
"""

from .adapter import read
from .cells import CELL_TYPES, CellType
from .checks import check
from .convert import linear
from .generators import box, cylinder, sphere
from .grids import grid
from .mesh import Mesh

__all__ = ["CELL_TYPES", "CellType", "Mesh", "box", "check", "cylinder", "grid", "linear", "read", "sphere"]
