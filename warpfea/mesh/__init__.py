"""Meshes: :class:`Mesh`, :func:`read` for files, :func:`from_meshio` for meshio's meshes, :func:`from_surface`
and :func:`from_cad` for shapes, generators with named sides, :func:`check` and :func:`linear`.

Lengths are in metres once read (``scale``). Set names come from the file's groups, or from the generator's sides.
"""

from .adapter import FORMATS, from_meshio, is_meshio, read
from .cad import CAD_FORMATS, from_cad
from .cells import CELL_TYPES, CellType
from .checks import check
from .convert import linear
from .generators import box, cylinder, sphere
from .grids import grid
from .mesh import Mesh
from .surface import from_surface

__all__ = [
    "CAD_FORMATS", "CELL_TYPES", "FORMATS", "CellType", "Mesh", "box", "check", "cylinder", "from_cad", "from_meshio",
    "from_surface", "grid", "is_meshio", "linear", "read", "sphere",
]  # fmt: skip
