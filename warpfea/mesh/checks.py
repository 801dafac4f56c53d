"""Checks of a mesh. Each failure names the file, the element or node (0-based) and the value."""

import warnings

import numpy as np

from ..base.errors import MeshError, MeshWarning
from .cells import CELL_TYPES, CellType, Floats, Ints, det_j0, row_keys
from .mesh import Mesh

__all__ = ["COINCIDENCE_TOL", "check", "check_topology", "check_volumes"]

COINCIDENCE_TOL = 1e-10
"""Distance of used nodes, over the mesh size, below which they count as one unmerged node."""
FLATNESS_TOL = 1e-12
"""Volume or det J0 over the cube (area: square) of the longest edge below which an element is degenerate."""
_LEFT_HANDED_HINTS = {
    "tetra": "swap two corners",
    "tetra10": "swap two corners and their mid-edge nodes",
    "hexahedron": "swap the nodes 0 .. 3 and 4 .. 7",
    "tetra_faces": "swap two corners and their face nodes",
}
_INVERSION_PLACES = {"hexahedron": "a corner, centre or quadrature point (too distorted)"}


def check(mesh: Mesh) -> Mesh:
    """Check numbering and geometry; return the mesh.

    Raises
    ------
    MeshError
        No elements, NaN or infinite coordinates, a repeated node in an element, duplicate elements,
        coincident nodes, mid-edge nodes out of order, zero-volume or inverted elements. Of quads: zero area,
        non-convex corners, an edge of more than two quads, neighbours of opposite orientation.

    Warns
    -----
    MeshWarning
        Unused nodes.
    """
    check_topology(mesh.points, mesh.cells, mesh.cell_type, mesh.label)
    orphans = mesh.orphan_nodes
    if orphans.size:
        warnings.warn(
            f"{mesh.label}: {orphans.size} orphan node{_plural(orphans)} belong to no element (first: "
            f"{_list_numbers(orphans)}); "
            "they keep their place in the numbering and stay where they are",
            MeshWarning,
            stacklevel=2,
        )
    _check_coincident(mesh)
    if mesh.cell_type == "quad":
        _check_quads(mesh)
        _check_manifold(mesh)
        return mesh
    curved = np.flatnonzero(~mesh.straight_sided(1e-12))
    if mesh.kind.has_mid_nodes:
        _check_mid_nodes(mesh, curved)
    check_volumes(mesh)
    return mesh


def check_topology(points: Floats, cells: Ints, cell_type: str, label: str) -> None:
    """Checks before any computation of geometry; arrays as in :class:`Mesh`.

    Raises
    ------
    MeshError
        Points not (N, 3), no elements, NaN or infinite coordinates, numbers out of range, repeated nodes,
        duplicates.
    """
    kind = CELL_TYPES[cell_type]
    if points.ndim != 2 or points.shape[1] != 3:
        width = points.shape[-1] if points.size else 0
        raise MeshError(f"{label}: the nodes have {width} coordinates, expected 3: is this a 2D mesh?")
    if not len(cells):
        raise MeshError(f"{label}: no elements (0 of type {cell_type})")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise MeshError(
            f"{label}: node {bad[0]} has the coordinates {_vector_text(points[bad[0]])}, which are not finite "
            f"({bad.size} such node{_plural(bad)})"
        )
    outside = (cells < 0) | (cells >= len(points))
    if outside.any():
        e, k = np.argwhere(outside)[0]
        raise MeshError(
            f"{label}: element {e} refers to node {cells[e, k]}, out of range 0 .. {len(points) - 1} "
            f"({int(outside.any(axis=1).sum())} such elements)"
        )
    ordered = np.sort(cells, axis=1)
    repeated = np.argwhere(ordered[:, 1:] == ordered[:, :-1])
    if repeated.size:
        e, k = repeated[0]
        hint = "; a cell can't be collapsed to one of fewer corners" if cell_type in ("hexahedron", "quad") else ""
        raise MeshError(f"{label}: element {e} holds node {ordered[e, k]} twice: {cells[e].tolist()}{hint}")
    keys = row_keys(np.sort(cells[:, : kind.corners], axis=1), len(points))
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    if same.size:
        a, b = order[same[0]], order[same[0] + 1]
        raise MeshError(
            f"{label}: elements {a} and {b} have the same corners {cells[a, : kind.corners].tolist()} "
            f"({same.size} duplicate element{_plural(same)})"
        )


def _check_coincident(mesh: Mesh) -> None:
    from scipy.spatial import cKDTree

    low, high = mesh.bounding_box()
    size = float(np.linalg.norm(high - low))
    used = mesh.used_nodes
    tree = cKDTree(mesh.points[used] - low, balanced_tree=False, compact_nodes=False)
    pairs = tree.query_pairs(COINCIDENCE_TOL * size, output_type="ndarray")
    if len(pairs):
        pairs = np.sort(used[pairs], axis=1)
        a, b = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))[0]]
        gap = float(np.linalg.norm(mesh.points[a] - mesh.points[b]))
        raise MeshError(
            f"{mesh.label}: nodes {a} and {b} coincide at {_vector_text(mesh.points[a])}, {gap:.3g} m apart "
            f"({len(pairs)} such pair{_plural(pairs)}); merge them, or the body falls apart there"
        )


def _check_mid_nodes(mesh: Mesh, curved: Ints) -> None:
    """Each mid-edge node must lie nearest to its own edge's mid-point, of the six of its element."""
    if not curved.size:
        return
    kind = mesh.kind
    x = mesh.points[mesh.cells[curved]]
    middle = 0.5 * (x[:, kind.edges[:, 0]] + x[:, kind.edges[:, 1]])
    distance2 = ((x[:, kind.corners :, None, :] - middle[:, None, :, :]) ** 2).sum(axis=3)
    nearest = distance2.argmin(axis=2)
    wrong = np.take_along_axis(distance2, nearest[:, :, None], axis=2)[:, :, 0] < np.einsum("mkk->mk", distance2)
    if not wrong.any():
        return
    out_of_order = curved[wrong.any(axis=1)]
    corners = mesh.points[mesh.cells[out_of_order, :4]]
    left = out_of_order[np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0] if kind.name == "tetra10" else curved[:0]
    if left.size:
        raise MeshError(
            f"{mesh.label}: element {left[0]} is inverted: its corners {mesh.cells[left[0], :4].tolist()} are "
            f"numbered left-handed, and its mid-side nodes are not those of its edges ({left.size} such "
            f"element{_plural(left)}); {_swap_hint(mesh, int(left[0]))}"
        )
    i, k = np.argwhere(wrong)[0]
    own, other = kind.edges[k], kind.edges[nearest[i, k]]
    swapped = (nearest[wrong.any(axis=1)] == (0, 1, 2, 3, 5, 4)).all()
    hint = "; edges 13 and 23 are swapped in all of them, which is Gmsh's own order" if swapped else ""
    raise MeshError(
        f"{mesh.label}: element {curved[i]}, mid-side nodes out of order: node "
        f"{mesh.cells[curved[i], kind.corners + k]} "
        f"stands for edge {own[0]}{own[1]} but lies nearer to edge {other[0]}{other[1]}, "
        f"{np.sqrt(distance2[i, k, nearest[i, k]]):.6g} m against {np.sqrt(distance2[i, k, k]):.6g} m "
        f"({int(wrong.any(axis=1).sum())} such elements{hint})"
    )


def _swap_hint(mesh: Mesh, element: int) -> str:
    """Hint for an inverted quadratic tetrahedron: the two swapped corners, if that is the only error."""
    edges = mesh.kind.edges
    x = mesh.points[mesh.cells[element]]
    for a, b in edges:
        order = np.arange(4)
        order[[a, b]] = b, a
        middle = 0.5 * (x[order[edges[:, 0]]] + x[order[edges[:, 1]]])
        if (np.linalg.norm(x[4:, None] - middle, axis=2).argmin(axis=1) == np.arange(6)).all():
            return f"corners {a} and {b} were swapped without them: cells[e, [{a}, {b}]] = cells[e, [{b}, {a}]]"
    return f"{_LEFT_HANDED_HINTS[mesh.cell_type]}"


def check_volumes(mesh: Mesh) -> None:
    """Check that solids (and lines) have a volume (length) and det J0 > 0 at all checked points.

    Raises
    ------
    MeshError
        Zero-volume or inverted elements.
    """
    kind: CellType = mesh.kind
    volumes, longest = _nonzero_sizes(mesh)
    scale = longest**kind.dimension
    lowest = volumes / kind.rule[1].sum()  # mean det J0; constant in a straight simplex
    simplex = kind.corners == kind.dimension + 1
    bent = np.flatnonzero(~mesh.straight_sided(1e-12)) if simplex else np.arange(len(mesh.cells))
    if bent.size:
        at = det_j0(mesh.points, mesh.cells[bent], kind, kind.check_points)
        lowest[bent] = np.minimum(lowest[bent], at.min(axis=1))
    inverted = np.flatnonzero(lowest <= FLATNESS_TOL * scale)
    if not inverted.size:
        return
    e = inverted[np.argmin(lowest[inverted] / scale[inverted])]
    if len(inverted) == len(mesh.cells) and (volumes < 0.0).all():
        raise MeshError(
            f"{mesh.label}: all {len(inverted)} elements are inverted (element 0 has det J0 = {lowest[0]:.6g} m^3): "
            f"they are numbered left-handed ({_LEFT_HANDED_HINTS[mesh.cell_type]}), or the mesh is mirrored"
        )
    where = _INVERSION_PLACES.get(mesh.cell_type, "a corner, mid-edge or quadrature point (too curved)")
    raise MeshError(
        f"{mesh.label}: element {e} is inverted{'' if volumes[e] < 0.0 else f' at {where}'}: smallest det J0 = "
        f"{lowest[e]:.6g} m^3, volume {volumes[e]:.6g} m^3 "
        f"({inverted.size} such element{_plural(inverted)}, first: {_list_numbers(inverted)})"
    )


def _nonzero_sizes(mesh: Mesh) -> tuple[Floats, Floats]:
    """Volumes (m^3; areas, lengths) and longest edges, m, of the elements. MeshError for a size of zero."""
    ends = mesh.points[mesh.cells[:, mesh.kind.edges]]
    longest = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2).max(axis=1)
    sizes, dimension = mesh.volumes(), mesh.kind.dimension
    flat = np.flatnonzero(np.abs(sizes) <= FLATNESS_TOL * longest**dimension)
    if flat.size:
        e, noun = flat[0], "quad" if dimension == 2 else "element"
        what, unit = {1: ("length", "m"), 2: ("area", "m^2"), 3: ("volume", "m^3")}[dimension]
        raise MeshError(
            f"{mesh.label}: {noun} {e} has zero {what} ({sizes[e]:.3g} {unit}, longest edge {longest[e]:.3g} m; "
            f"{flat.size} such {noun}{_plural(flat)})"
        )
    return sizes, longest


def _check_quads(mesh: Mesh) -> None:
    """Each quad has an area, and is convex with respect to its mean normal."""
    _, longest = _nonzero_sizes(mesh)
    x = mesh.points[mesh.cells]
    normals = np.cross(np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x)
    mean = normals.mean(axis=1)
    size = np.linalg.norm(mean, axis=1)
    along = np.einsum("mki,mi->mk", normals, mean / np.where(size > 0.0, size, 1.0)[:, None])
    bad = np.flatnonzero(along.min(axis=1) <= FLATNESS_TOL * longest**2)
    if bad.size:
        e = bad[0]
        k = int(along[e].argmin())
        raise MeshError(
            f"{mesh.label}: quad {e} is not convex: at corner {k} (node {mesh.cells[e, k]}) the edges span "
            f"{along[e, k]:.3g} m^2 along the mean normal, which must be positive at all four "
            f"({bad.size} such quad{_plural(bad)}); move the node, or put the nodes in the order of a walk around"
        )


def _check_manifold(mesh: Mesh) -> None:
    """An edge belongs to at most two quads, with opposite directions."""
    sides = len(mesh.kind.edges)
    edges = mesh.cells[:, mesh.kind.edges].reshape(-1, 2)
    keys = row_keys(np.sort(edges, axis=1), len(mesh.points))
    _, edge, count = np.unique(keys, return_inverse=True, return_counts=True)
    many = np.flatnonzero(count > 2)
    if many.size:
        rows = np.flatnonzero(edge == edge[np.isin(edge, many).argmax()])
        a, b = edges[rows[0]]
        raise MeshError(
            f"{mesh.label}: the edge between nodes {a} and {b} is shared by {len(rows)} quads "
            f"({_list_numbers(rows // sides)}; {many.size} such edge{_plural(many)}): a shell can't branch, use one "
            "body per sheet"
        )
    order = np.argsort(edge, kind="stable")
    one, other = order[count[edge[order]] == 2].reshape(-1, 2).T
    same = np.flatnonzero(edges[one, 0] == edges[other, 0])
    if same.size:
        i = same[np.argmin(one[same])]
        a, b = edges[one[i]]
        raise MeshError(
            f"{mesh.label}: quads {one[i] // sides} and {other[i] // sides} both run from node {a} to node {b} through "
            f"the edge they share, so that their normals disagree ({same.size} such edge{_plural(same)}): flip one of "
            "them (reverse the order of its nodes)"
        )


def _list_numbers(numbers: Ints, count: int = 5) -> str:
    return ", ".join(str(int(n)) for n in numbers[:count]) + (", ..." if len(numbers) > count else "")


def _vector_text(x: Floats) -> str:
    return "(" + ", ".join(f"{v:.6g}" for v in x) + ")"


def _plural(items: np.ndarray) -> str:
    return "" if len(items) == 1 else "s"
