"""The mesh of one body: nodes, cells of one type, and named sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..base.checks import finite_number
from ..base.errors import MeshError
from ..base.names import did_you_mean, listing
from .cells import CELL_TYPES, CellType, Floats, Ints, element_volumes, row_keys

__all__ = ["Mesh", "Selection", "check_range", "transformation"]

Selection = str | Callable[[Floats], Any] | Sequence[int] | np.ndarray
"""A set name, a predicate of coordinates (K, 3) returning a mask (K,), or indices / a mask."""


@dataclass(frozen=True, eq=False, repr=False)
class Mesh:
    """A mesh of one cell type in metres. All arrays are read-only; the node order is the file's.

    The cell types are solids ("tetra", "tetra10", "hexahedron"), the surface in space "quad" (shells), and two that
    files don't hold: "line" (beams) and "tetra_faces", a tetrahedron with a node at each face's centroid. The
    "faces" of a quad are its edges, a line has none.

    Parameters
    ----------
    points : (N, 3) float64
        Reference positions X (m). Unused nodes ("orphans") keep their numbers.
    cells : (M, n) int64
        Node numbers in meshio's order, n = 4, 10, 8, 4, 2, 8 in the order of ``cell_type`` below. T10 mid-edge
        nodes of the corner pairs 01, 12, 20, 03, 13, 23; face nodes 4 .. 7 of the faces 021, 013, 123, 032.
    cell_type : {"tetra", "tetra10", "hexahedron", "quad", "line", "tetra_faces"}
    node_sets, element_sets : dict of str to (K,) int64
        Sorted node and element numbers.
    surface_sets : dict of str to (K, 2) int64
        Rows (element, local face); of quads (element, local edge).
    name : str
        Stem of the file, or the generator's name.
    path : str or None
        Source file.

    Raises
    ------
    MeshError
        Wrong shapes, unknown cell type, or numbers out of range. Geometry is checked by
        :func:`warpfea.mesh.check`.
    """

    points: Floats
    cells: Ints
    cell_type: str
    node_sets: dict[str, Ints] = field(default_factory=dict)
    element_sets: dict[str, Ints] = field(default_factory=dict)
    surface_sets: dict[str, Ints] = field(default_factory=dict)
    name: str = "mesh"
    path: str | None = None

    def __post_init__(self) -> None:
        put = lambda key, value: object.__setattr__(self, key, value)  # noqa: E731
        if self.cell_type not in CELL_TYPES:
            raise MeshError(f"{self.label}: unknown cell type {self.cell_type!r}, known are {sorted(CELL_TYPES)}")
        put("points", _read_only_array(self.points, np.float64))
        put("cells", _read_only_array(self.cells, np.int64))
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise MeshError(f"{self.label}: points have shape {self.points.shape}, expected (N, 3)")
        if self.cells.ndim != 2 or self.cells.shape[1] != self.kind.nodes:
            raise MeshError(
                f"{self.label}: cells have shape {self.cells.shape}, expected (M, {self.kind.nodes}) for "
                f"{self.cell_type}"
            )
        check_range(self.cells, len(self.points), f"{self.label}: cells")
        limits = {"node_sets": len(self.points), "element_sets": len(self.cells), "surface_sets": len(self.cells)}
        for attribute, limit in limits.items():
            sets = {str(key): _read_only_array(value, np.int64) for key, value in getattr(self, attribute).items()}
            for key, value in sets.items():
                where = f"{self.label}: {attribute}[{key!r}]"
                columns = value.reshape(-1, 2) if attribute == "surface_sets" else value.reshape(-1, 1)
                check_range(columns[:, 0], limit, where)
                if attribute == "surface_sets":
                    check_range(columns[:, 1], len(self.kind.faces), where)
                    sets[key] = _read_only_array(columns, np.int64)
            put(attribute, sets)

    def __repr__(self) -> str:
        sets = sorted({*self.node_sets, *self.element_sets, *self.surface_sets})
        return (
            f"Mesh({self.name!r}, {len(self.points)} nodes, {len(self.cells)} {self.cell_type}"
            + (f", sets: {', '.join(sets)}" if sets else "")
            + ")"
        )

    # identification

    @property
    def kind(self) -> CellType:
        """The row of the cell table."""
        return CELL_TYPES[self.cell_type]

    @property
    def label(self) -> str:
        """Name in messages: the path if there is one, else the name."""
        return self.path or self.name

    @cached_property
    def used_nodes(self) -> Ints:
        """Sorted numbers of used nodes."""
        return _read_only_array(np.flatnonzero(self._used_mask), np.int64)

    @cached_property
    def orphan_nodes(self) -> Ints:
        """Sorted numbers of unused nodes."""
        return _read_only_array(np.flatnonzero(~self._used_mask), np.int64)

    @cached_property
    def _used_mask(self) -> np.ndarray:
        mask = np.zeros(len(self.points), dtype=bool)
        mask[self.cells] = True
        return mask

    # geometry

    def volumes(self) -> Floats:
        """Volume of each element (m^3), (M,), exact for curved sides too ("tetra_faces": of the four corners).

        Of a quad it is the area (m^2), of a line the length (m), so that weighted averages work for any body.
        """
        return element_volumes(self.points, self.cells, self.kind)

    def volume(self) -> float:
        """Total volume (m^3); area (m^2) of quads, length (m) of lines."""
        return float(self.volumes().sum())

    def centroids(self) -> Floats:
        """Mean of each element's corners (m), (M, 3)."""
        return self.points[self.cells[:, : self.kind.corners]].mean(axis=1)

    def bounding_box(self) -> tuple[Floats, Floats]:
        """Lowest and highest corner (m) of the box around the used nodes, two (3,) arrays."""
        used = self.points[self.used_nodes]
        return used.min(axis=0), used.max(axis=0)

    def straight_sided(self, tol: float = 1e-10) -> np.ndarray:
        """Mask (M,) of elements whose mid-edge nodes lie within ``tol`` edge lengths of the mid-points; True for
        cells without such nodes."""
        if not self.kind.has_mid_nodes:
            return np.ones(len(self.cells), dtype=bool)
        straight = np.ones(len(self.cells), dtype=bool)
        for k, (a, b) in enumerate(self.kind.edges):
            xa, xb = self.points[self.cells[:, a]], self.points[self.cells[:, b]]
            off = self.points[self.cells[:, self.kind.corners + k]] - 0.5 * (xa + xb)
            size2 = ((xb - xa) ** 2).sum(axis=1)
            # the last term is the round-off of coordinates far from the origin
            round_off = 16.0 * (np.finfo(float).eps ** 2) * ((xa**2).sum(axis=1) + (xb**2).sum(axis=1))
            straight &= (off**2).sum(axis=1) <= tol**2 * size2 + round_off
        return straight

    # surfaces

    def faces(self, table: Selection) -> Ints:
        """Node numbers of a surface: (K, 3) of T4, (K, 6) of T10, (K, 4) of hexahedra, corners in outward order,
        then mid-edges; (K, 4) with face nodes, that node last; (K, 2) of quads, the two
        ends of each edge.

        Parameters
        ----------
        table : (K, 2) int array of (element, local face), or anything that :meth:`surface` takes
        """
        rows = self.surface(table)
        return self.cells[rows[:, 0, None], self.kind.faces[rows[:, 1]]]

    def face_centroids(self, table: Selection) -> Floats:
        """Mean of each face's corners (m), (K, 3); of an edge of quads its mid-point."""
        return self.points[self.faces(table)[:, : self.kind.face_corners]].mean(axis=1)

    def boundary(self) -> Ints:
        """All outer faces, (K, 2) rows of (element, local face), in the order of the elements; of quads the
        (element, local edge) of border edges.
        """
        return self._boundary

    @cached_property
    def _boundary(self) -> Ints:
        _, first, count = np.unique(self._face_keys, return_index=True, return_counts=True)
        alone = np.sort(first[count == 1])
        return _read_only_array(np.column_stack(np.divmod(alone, len(self.kind.faces))), np.int64)

    @cached_property
    def _face_keys(self) -> Ints:
        """Key per (element, local face), (M * faces,), equal for faces with the same corners."""
        return row_keys(self._sorted_faces(), len(self.points))

    def _sorted_faces(self) -> Ints:
        """Sorted corners of each (element, local face), (M * faces, corners)."""
        corners = self.kind.faces[:, : self.kind.face_corners]
        return np.sort(self.cells[:, corners].reshape(-1, self.kind.face_corners), axis=1)

    # selections

    def nodes(self, selection: Selection) -> Ints:
        """Node numbers of a set name, a predicate of X (N, 3), a mask (N,) or an array of numbers.

        A predicate selects among the used nodes. An empty selection is returned as such.

        Raises
        ------
        MeshError
            Unknown name (the message lists the known ones), numbers out of range, or a mask of another
            length.
        """
        if isinstance(selection, str):
            return self._set_by_name("node", self.node_sets, selection)
        if callable(selection):
            used = self.used_nodes
            return used[self._predicate_mask(selection, self.points[used], "nodes")]
        return self._checked_numbers(selection, len(self.points), "nodes")

    def elements(self, selection: Selection) -> Ints:
        """Element numbers of a set name, a predicate of the centroids (M, 3), a mask (M,) or an array of
        numbers.

        Raises
        ------
        MeshError
            As :meth:`nodes`.
        """
        if isinstance(selection, str):
            return self._set_by_name("element", self.element_sets, selection)
        if callable(selection):
            return np.flatnonzero(self._predicate_mask(selection, self.centroids(), "elements"))
        return self._checked_numbers(selection, len(self.cells), "elements")

    def surface(self, selection: Selection) -> Ints:
        """Rows (element, local face), (K, 2), of a set name, a predicate of the outer faces' centroids, or
        an array.

        Raises
        ------
        MeshError
            As :meth:`nodes`.
        """
        if isinstance(selection, str):
            return self._set_by_name("surface", self.surface_sets, selection)
        if callable(selection):
            table = self._boundary
            return table[self._predicate_mask(selection, self.face_centroids(table), "surface")]
        rows = np.asarray(selection)
        if rows.size == 0:
            return np.empty((0, 2), dtype=np.int64)
        if rows.ndim != 2 or rows.shape[1] != 2 or rows.dtype.kind not in "iu":
            raise MeshError(
                f"{self.label}: a surface is an integer array (K, 2) of (element, local face), "
                f"got shape {rows.shape} of {rows.dtype}"
            )
        check_range(rows[:, 0], len(self.cells), f"{self.label}: surface, element")
        check_range(rows[:, 1], len(self.kind.faces), f"{self.label}: surface, local face")
        return rows.astype(np.int64)

    def _set_by_name(self, what: str, sets: dict[str, Ints], name: str) -> Ints:
        if name not in sets:
            kinds = {"elements": self.element_sets, "faces": self.surface_sets, "nodes": self.node_sets}
            elsewhere = [kind for kind, of_kind in kinds.items() if name in of_kind]
            hint = f"; {name!r} is a set of {' and '.join(elsewhere)}" if elsewhere else did_you_mean(name, sets)
            found = listing(sorted(sets)) if sets else "none; give a function of the positions instead, X -> mask"
            raise MeshError(f"{self.label}: no {what} set named {name!r}; there are: {found}{hint}")
        return sets[name]

    def _predicate_mask(self, predicate: Callable[[Floats], Any], coordinates: Floats, what: str) -> np.ndarray:
        mask = np.asarray(predicate(coordinates))
        if mask.shape != (len(coordinates),) or mask.dtype != bool:
            raise MeshError(
                f"{self.label}: the predicate for {what} must return a bool array of shape "
                f"({len(coordinates)},), "
                f"got {mask.dtype} {mask.shape}"
            )
        return mask

    def _checked_numbers(self, selection: Any, limit: int, what: str) -> Ints:
        numbers = np.asarray(selection)
        if numbers.size == 0 and numbers.dtype != bool:
            return np.empty(0, dtype=np.int64)
        if numbers.ndim != 1 or numbers.dtype.kind not in "iub":
            raise MeshError(
                f"{self.label}: {what} are selected by a 1D array of integers or a mask, "
                f"got shape {numbers.shape} of {numbers.dtype}"
            )
        if numbers.dtype == bool:
            if len(numbers) != limit:
                raise MeshError(f"{self.label}: the mask for {what} has {len(numbers)} entries, expected {limit}")
            return np.flatnonzero(numbers)
        check_range(numbers, limit, f"{self.label}: {what}")
        return numbers.astype(np.int64)

    # transformation

    def transformed(self, *, scale: float = 1.0, transform: Any = None) -> Mesh:
        """A copy with X' = A (scale X) + t; see :func:`transformation` for ``transform``.

        Raises
        ------
        MeshError
            Non-positive scale, a singular or reflecting A, or wrong shapes.
        """
        a, t = transformation(scale, transform, self.label)
        return replace(self, points=self.points @ a.T + t)


def transformation(scale: float, transform: Any, label: str) -> tuple[Floats, Floats]:
    """The matrix (3, 3), with the scale in it, and the translation (3,) (m) of a scale and a transform.

    ``transform``: None, a 4x4 matrix with the last row 0 0 0 1, or a pair of a 3x3 matrix and a 3-vector (m).
    A reflection (det < 0) would invert every element and is refused.
    """
    factor = finite_number(scale)
    if not factor > 0.0:
        raise MeshError(f"{label}: scale must be a positive number, got {scale!r}")
    if transform is None:
        return factor * np.eye(3), np.zeros(3)
    try:
        if isinstance(transform, (tuple, list)) and len(transform) == 2:
            a, t = np.array(transform[0], dtype=float), np.array(transform[1], dtype=float)
        else:
            whole = np.array(transform, dtype=float)
            if whole.shape != (4, 4) or not np.allclose(whole[3], (0.0, 0.0, 0.0, 1.0), rtol=0.0, atol=1e-12):
                raise ValueError
            a, t = whole[:3, :3], whole[:3, 3]
        if a.shape != (3, 3) or t.shape != (3,) or not (np.isfinite(a).all() and np.isfinite(t).all()):
            raise ValueError
    except (TypeError, ValueError):
        raise MeshError(
            f"{label}: transform must be a finite 4x4 matrix with last row 0 0 0 1, or (3x3 matrix, 3-vector)"
        ) from None
    det = float(np.linalg.det(a))
    if det <= 1e-12 * np.abs(a).max() ** 3:
        kind = "is a reflection" if det < 0.0 else "is singular"
        raise MeshError(f"{label}: transform {kind} (determinant {det:.6g}); it would invert or flatten every element")
    return factor * a, t


def _read_only_array(values: Any, dtype: Any) -> np.ndarray:
    """Read-only C-contiguous array; copied only if it is writable elsewhere."""
    array = np.asarray(values)
    if dtype == np.int64 and array.dtype.kind not in "iub" and array.size:
        raise MeshError(f"expected integers, got {array.dtype}")
    if array.dtype != dtype or array.flags.writeable or not array.flags.c_contiguous:
        array = np.array(array, dtype=dtype, order="C")
        array.flags.writeable = False
    return array


def check_range(numbers: np.ndarray, limit: int, where: str) -> None:
    """Raise a MeshError that begins with ``where`` for numbers outside 0 .. limit - 1."""
    bad = np.flatnonzero((numbers.reshape(-1) < 0) | (numbers.reshape(-1) >= limit))
    if bad.size:
        raise MeshError(f"{where}: {numbers.reshape(-1)[bad[0]]} is out of range 0 .. {limit - 1}")
