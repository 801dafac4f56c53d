"""Structured meshes of a box, a cylinder and a sphere, deterministic, with named sides.

Each cell of a grid is a hexahedron, or cut into six tetrahedra around its diagonal (Kuhn), so that face
diagonals match. Cylinder and sphere are the box of the parent square or cube, mapped shell by shell; their cells
are mirrored about the centre, so that the diagonals run outward and no tetrahedron has two faces on the curved
side (its corner would be flat).
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from ..base.errors import MeshError
from .arguments import PointMap, cell_counts, cell_type_of, check_even, finite_numbers, map_points, positive_numbers
from .cells import CELL_TYPES, Floats, Ints
from .checks import check
from .mesh import Mesh

__all__ = ["box", "cylinder", "sphere"]

_BOX_SIDES = ("x-", "x+", "y-", "y+", "z-", "z+")


def box(
    size: Sequence[float],
    *,
    cells: Sequence[int],
    element: str = "T10",
    origin: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    map: PointMap | None = None,
    name: str = "box",
) -> Mesh:
    """A box of ``cells`` = (nx, ny, nz) cells from ``origin`` to ``origin + size`` (m).

    Surface and node sets "x-", "x+", "y-", "y+", "z-", "z+". Nodes are numbered with x running fastest.

    Parameters
    ----------
    element : {"T4", "T10", "ENMC", "FN", "FN18", "H3843"}
        T10: six tetrahedra of 10 nodes per cell; H3843: one hexahedron; the others: six tetrahedra of 4 nodes.
    map : function X (n, 3) -> (n, 3), or None
        Moves the nodes (m), mid-edge nodes too; the mesh is then checked. Sides keep their names, and must not
        coincide.

    Raises
    ------
    MeshError
        Non-positive size, fewer than one cell, unknown element; a map without (n, 3) finite values, or with a mesh
        that fails :func:`warpfea.mesh.check`, e.g. a reflection.
    """
    lengths = positive_numbers("box: size", size, 3)
    numbers = cell_counts("box: cells", cells, 3)
    low = finite_numbers("box: origin", origin, 3)
    kind = cell_type_of("box", element)
    if kind == "hexahedron":
        lattice, corners = _hexahedral_grid(numbers)
    else:
        lattice, corners = _kuhn_tetrahedra(numbers, kind, (False, False, False))
    points = map_points("box: map", low + lengths * (lattice / lattice[-1]), map)
    mesh = _make_mesh(points, corners, kind, _grid_sides(lattice, corners, kind), name)
    return mesh if map is None else check(mesh)


def cylinder(
    radius: float,
    length: float,
    *,
    cells: Sequence[int],
    element: str = "T10",
    origin: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    name: str = "cylinder",
) -> Mesh:
    """A cylinder about the z axis, from ``origin`` (centre of the bottom) to ``origin`` + (0, 0, length) (m).

    Parameters
    ----------
    cells : (n, nz)
        n cells across the diameter (even), nz along the axis; 6 n n nz elements.
    element : {"T4", "T10", "ENMC", "FN", "FN18"}
        With T10 the side's mid-edge nodes lie on the circle; the other edges are straight.

    Surface and node sets "bottom", "top", "side".

    Raises
    ------
    MeshError
        Non-positive radius or length, an odd n, unknown element.
    """
    (r,) = positive_numbers("cylinder: radius", [radius], 1)
    (height,) = positive_numbers("cylinder: length", [length], 1)
    n, nz = cell_counts("cylinder: cells", cells, 2)
    check_even("cylinder: cells across the diameter", n)
    low = finite_numbers("cylinder: origin", origin, 3)

    def parent_map(p: Floats) -> Floats:
        x, y = _map_to_disk(p[:, 0], p[:, 1])
        return np.column_stack([r * x, r * y, 0.5 * height * (p[:, 2] + 1.0)]) + low

    kind = _round_cell_type("cylinder", element)
    lattice, corners = _kuhn_tetrahedra((n, n, nz), kind, (True, True, False))
    sides = _grid_sides(lattice, corners, kind)
    named = {"bottom": sides["z-"], "top": sides["z+"], "side": _merge_sides(sides, ("x-", "x+", "y-", "y+"))}
    return _make_mesh(_round_points(lattice, corners, kind, parent_map, (0, 1)), corners, kind, named, name)


def sphere(
    radius: float, *, cells: int, element: str = "T10", center: Sequence[float] = (0.0, 0.0, 0.0), name: str = "sphere"
) -> Mesh:
    """A ball of ``radius`` about ``center`` (m), made of ``cells`` (even) cells across the diameter; 6 n^3
    elements.

    With T10 the surface's mid-edge nodes lie on the sphere; the other edges are straight. Set "surface".

    Raises
    ------
    MeshError
        Non-positive radius, an odd number of cells, unknown element.
    """
    (r,) = positive_numbers("sphere: radius", [radius], 1)
    (n,) = cell_counts("sphere: cells", [cells], 1)
    check_even("sphere: cells", n)
    middle = finite_numbers("sphere: center", center, 3)
    kind = _round_cell_type("sphere", element)
    lattice, corners = _kuhn_tetrahedra((n, n, n), kind, (True, True, True))
    points = _round_points(lattice, corners, kind, lambda p: middle + r * _map_to_ball(p), (0, 1, 2))
    named = {"surface": _merge_sides(_grid_sides(lattice, corners, kind), _BOX_SIDES)}
    return _make_mesh(points, corners, kind, named, name)


def _round_cell_type(what: str, element: str) -> str:
    """Cell type of an element available for round bodies."""
    kind = cell_type_of(what, element)
    if kind == "hexahedron":
        raise MeshError(
            f"{what}: element {element!r} isn't available: the hexahedra at the corners of the parent square would be "
            "flat on the round side; take tetrahedra, or a box with map="
        )
    return kind


def _lattice(shape: Sequence[int]) -> Ints:
    """Integer points (N, 3) of a lattice, x fastest."""
    z, y, x = (a.ravel() for a in np.meshgrid(*(np.arange(s) for s in shape[::-1]), indexing="ij"))
    return np.column_stack([x, y, z])


def _hexahedral_grid(numbers: Sequence[int]) -> tuple[Ints, Ints]:
    """Lattice points (N, 3) and hexahedra (M, 8), x fastest, of a grid of ``cells``."""
    nx, ny, nz = numbers
    base = _lattice((nx, ny, nz)) @ (1, nx + 1, (nx + 1) * (ny + 1))
    up = (nx + 1) * (ny + 1)
    bottom = np.array([0, 1, nx + 2, nx + 1])
    return _lattice((nx + 1, ny + 1, nz + 1)), base[:, None] + np.concatenate([bottom, bottom + up])


def _kuhn_tetrahedra(numbers: Sequence[int], kind: str, mirrored: Sequence[bool]) -> tuple[Ints, Ints]:
    """Lattice points (N, 3), x fastest, and tetrahedra of a grid of ``cells``.

    The lattice has step 2 per cell with T10 (all its points are nodes), 1 with T4. In a mirrored axis the
    cells below the middle are reflected.
    """
    step = 2 if CELL_TYPES[kind].has_mid_nodes else 1
    shape = step * np.asarray(numbers) + 1
    strides = np.array([1, shape[0], shape[0] * shape[1]])
    base = _lattice(numbers)
    flip = np.asarray(mirrored) & (2 * base < np.asarray(numbers))
    odd = flip.sum(axis=1) % 2 == 1
    # the six tetrahedra 0, e_a, e_a + e_b, 1 of the unit cell, right-handed
    unit = np.zeros((6, 4, 3), dtype=np.int64)
    for row, axes in zip(unit, itertools.permutations(range(3))):
        row[1, axes[0]] = 1
        row[2, list(axes[:2])] = 1
        row[3] = 1
        if np.linalg.det(row[1:]) < 0:
            row[[1, 2]] = row[[2, 1]]
    local = np.where(flip[:, None, None, :], 1 - unit, unit)  # (cells, 6, 4, 3)
    local[odd] = local[odd][:, :, [0, 2, 1, 3]]
    corner = step * (base[:, None, None, :] + local).reshape(-1, 4, 3)
    nodes = corner
    if step == 2:
        a, b = CELL_TYPES[kind].edges.T
        nodes = np.concatenate([corner, (corner[:, a] + corner[:, b]) // 2], axis=1)
    return _lattice(tuple(shape)), nodes @ strides


def _grid_sides(lattice: Ints, cells: Ints, kind: str) -> dict[str, Ints]:
    """Surface tables of the six sides of the grid."""
    row = CELL_TYPES[kind]
    top = lattice[-1]
    faces = row.faces[:, : row.face_corners]
    sides = {}
    for axis, name in enumerate("xyz"):
        coordinate = lattice[:, axis]
        for sign, value in (("-", 0), ("+", top[axis])):
            at = (coordinate == value)[cells[:, : row.corners]]
            sides[name + sign] = np.argwhere(at[:, faces].all(axis=2))
    return sides


def _merge_sides(sides: dict[str, Ints], names: Sequence[str]) -> Ints:
    return np.unique(np.concatenate([sides[n] for n in names]), axis=0)


def _round_points(
    lattice: Ints, cells: Ints, kind: str, parent_map: Callable[[Floats], Floats], round_axes: tuple[int, ...]
) -> Floats:
    """Points of the mapped lattice, with straight edges except on the round side."""
    parent = 2.0 * lattice / lattice[-1] - 1.0  # -1 .. 1, exact at both ends and in the middle
    points = parent_map(parent)
    row = CELL_TYPES[kind]
    if row.has_mid_nodes:
        outside = np.abs(parent[:, round_axes]).max(axis=1) == 1.0
        mids, a, b = (cells[:, index].ravel() for index in (slice(4, None), row.edges[:, 0], row.edges[:, 1]))
        inner = ~outside[mids]
        points[mids[inner]] = 0.5 * (points[a[inner]] + points[b[inner]])
    return points


def _map_to_disk(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """The square [-1, 1]^2 onto the unit disk: concentric squares onto circles, with equal angles."""
    big = np.maximum(np.abs(x), np.abs(y))
    first = np.abs(x) >= np.abs(y)
    safe = np.where(big > 0.0, np.where(first, x, y), 1.0)
    angle = 0.25 * np.pi * np.where(first, y, x) / safe
    along, across = safe * np.cos(angle), safe * np.sin(angle)
    zero = big == 0.0
    return np.where(zero, 0.0, np.where(first, along, across)), np.where(zero, 0.0, np.where(first, across, along))


def _map_to_ball(p: Floats) -> Floats:
    """The cube [-1, 1]^3 onto the unit ball: concentric cubes onto spheres, with equal angles."""
    big = np.abs(p).max(axis=1, keepdims=True)
    direction = np.tan(0.25 * np.pi * p / np.where(big > 0.0, big, 1.0))
    norm = np.linalg.norm(direction, axis=1, keepdims=True)
    return big * direction / np.where(norm > 0.0, norm, 1.0)


def _make_mesh(points: Floats, cells: Ints, kind: str, surfaces: dict[str, Ints], name: str) -> Mesh:
    faces = CELL_TYPES[kind].faces
    nodes = {key: np.unique(cells[table[:, 0, None], faces[table[:, 1]]]) for key, table in surfaces.items()}
    return Mesh(points, cells, kind, node_sets=nodes, surface_sets=surfaces, name=name)
