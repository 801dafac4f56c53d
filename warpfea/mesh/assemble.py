"""Assembly of a :class:`Mesh` with its sets from the cell blocks and groups of a file."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..base.errors import MeshError
from ..base.names import listing
from .cells import FILE_CELLS, Floats, Ints, cell_dimension, row_keys
from .checks import check_topology
from .mesh import Mesh, check_range

__all__ = ["RawMesh", "assemble_mesh"]

_CELL_NOUNS = {
    "tetra": ("tetrahedron", "tetrahedra"),
    "tetra10": ("tetrahedron", "tetrahedra"),
    "hexahedron": ("hexahedron", "hexahedra"),
    "quad": ("quad", "quads"),
}
_BOUNDARY_CELLS = {"tetra": "triangle", "tetra10": "triangle", "hexahedron": "quad"}
"""Type prefixes of boundary cells."""


@dataclass
class RawMesh:
    """Contents of a file before validation.

    ``points`` (N, 3); ``blocks``: (meshio cell type, (K, n) node numbers); ``groups``: (name, block, numbers
    of the block's cells); ``node_groups``, ``faces``: sets named by the file, ``faces`` as (block,
    cell, local face). ``duplicates``: equal cells stand for membership in several groups.
    """

    points: Floats
    blocks: list[tuple[str, Ints]]
    groups: list[tuple[str, int, Ints]] = field(default_factory=list)
    node_groups: dict[str, Ints] = field(default_factory=dict)
    faces: dict[str, Ints] = field(default_factory=dict)
    duplicates: bool = False


def assemble_mesh(raw: RawMesh, file: Path, cell_type: str | None) -> Mesh:
    """Mesh with validated topology, and sets from the file's groups.

    Raises
    ------
    MeshError
        Solid cells of unknown or of two types, no solids and surface cells other than quads, boundary cells that are
        not faces, and :func:`check_topology`'s.
    """
    label = str(file)
    body = _body_cell_type(raw, label, cell_type)
    where = [k for k, (kind, _) in enumerate(raw.blocks) if kind == body]
    cells = np.concatenate([raw.blocks[k][1] for k in where])
    offsets = dict(zip(where, np.cumsum([0] + [len(raw.blocks[k][1]) for k in where])))
    number = np.arange(len(cells))
    if raw.duplicates and cells.min() >= 0:  # equal cells: keep the first of each, and all their memberships
        _, first, inverse = np.unique(row_keys(cells, int(cells.max()) + 1), return_index=True, return_inverse=True)
        rank = np.empty(len(first), dtype=np.int64)
        rank[np.argsort(first)] = np.arange(len(first))
        number, cells = rank[inverse], cells[np.sort(first)]
    check_topology(raw.points, cells, body, label)
    mesh = Mesh(raw.points, cells, body, name=file.stem, path=label)

    element_sets: dict[str, list[Ints]] = {}
    surface_sets: dict[str, list[Ints]] = {}
    node_sets: dict[str, list[Ints]] = {}
    for name, k, numbers in raw.groups:
        kind, block = raw.blocks[k]
        nodes = block[numbers]
        if k in offsets:
            element_sets.setdefault(name, []).append(number[offsets[k] + numbers])
        elif cell_dimension(kind) == 2:
            table = _find_faces(mesh, kind, nodes, name)
            surface_sets.setdefault(name, []).append(table)
            nodes = mesh.faces(table)
        else:
            check_range(nodes, len(raw.points), f"{label}: group {name!r}, node")
        node_sets.setdefault(name, []).append(nodes.ravel())
    for name, rows in raw.faces.items():
        table = np.array([(number[offsets[b] + e], f) for b, e, f in rows if b in offsets], dtype=np.int64)
        if len(table) != len(rows) or not len(rows):
            raise MeshError(f"{label}: surface {name!r} holds faces of cells that are not {_CELL_NOUNS[body][1]}")
        surface_sets.setdefault(name, []).append(table)
        node_sets.setdefault(name, []).append(mesh.faces(table).ravel())
    node_sets.update({name: [nodes] for name, nodes in raw.node_groups.items()})
    return replace(
        mesh,
        node_sets={name: np.unique(np.concatenate(parts)) for name, parts in node_sets.items()},
        element_sets={name: np.unique(np.concatenate(parts)) for name, parts in element_sets.items()},
        surface_sets={name: np.unique(np.concatenate(parts), axis=0) for name, parts in surface_sets.items()},
    )


def _body_cell_type(raw: RawMesh, label: str, cell_type: str | None) -> str:
    """Cell type of the body: that of the solids, of one known type, or else quads."""
    cell_counts: dict[str, int] = {}
    for kind, cells in raw.blocks:
        if len(cells):
            cell_counts[kind] = cell_counts.get(kind, 0) + len(cells)
    held = ", ".join(f"{n} {kind}" for kind, n in cell_counts.items()) or "no cells"
    solids = [kind for kind in cell_counts if cell_dimension(kind) == 3]
    surfaces = [kind for kind in cell_counts if cell_dimension(kind) == 2]
    for kind in solids:
        if kind not in FILE_CELLS:
            raise MeshError(
                f"{label}: unknown cell type {kind!r} ({cell_counts[kind]} cells); known are {', '.join(FILE_CELLS)}, "
                "and wedge and pyramid without cells of higher order; read(..., corners=True) takes their corners"
            )
    if len(solids) > 1:
        what = "solid cells" if "hexahedron" in solids else "tetrahedra"
        raise MeshError(f"{label}: holds {held}; all {what} must be of one type")
    if not solids and surfaces != ["quad"]:
        if "quad" in surfaces:
            raise MeshError(f"{label}: holds {held}; a shell needs quads of 4 nodes only: recombine the others")
        hint = ": is this a 2D mesh? A shell needs quads of 4 nodes (recombine)" if surfaces else ""
        if any(kind.startswith("quad") for kind in surfaces):
            hint += f"; read(..., corners=True) takes the corners of {surfaces[0]!r}"
        names = dict.fromkeys(name for name, k, _ in raw.groups if cell_dimension(raw.blocks[k][0]) == 2)
        if names and not any(cell_dimension(raw.blocks[k][0]) == 3 for _, k, _ in raw.groups):
            hint += (
                f"; all its groups are surfaces ({listing(names)}), and Gmsh saves only what is in a group: name the "
                'volume too, Physical Volume("body") = {1};, or save all elements (Mesh.SaveAll = 1;)'
            )
        raise MeshError(f"{label}: no quads, no hexahedra and no tetrahedra, the file holds {held}{hint}")
    body = solids[0] if solids else "quad"
    if cell_type is not None and body != cell_type:
        raise MeshError(f"{label}: holds {held}, but cell_type={cell_type!r} was asked for")
    return body


def _find_faces(mesh: Mesh, kind: str, nodes: Ints, name: str) -> Ints:
    """Rows (element, local face) of boundary cells (K, n) of the surface `name`, found by their corners."""
    label = mesh.label
    row, boundary, (solid, solids) = mesh.kind, _BOUNDARY_CELLS[mesh.cell_type], _CELL_NOUNS[mesh.cell_type]
    if not kind.startswith(boundary):
        raise MeshError(f"{label}: surface {name!r} holds {len(nodes)} cells of type {kind!r}, not faces of {solids}")
    corners = nodes[:, : row.face_corners]
    check_range(corners, len(mesh.points), f"{label}: surface {name!r}, node")
    # keys of faces and queries are numbered together: row_keys may compress
    table, local = mesh._sorted_faces(), row.faces[:, : row.face_corners]
    keys = row_keys(np.concatenate([table, np.sort(corners, axis=1)]), len(mesh.points))
    keys, wanted = keys[: len(table)], keys[len(table) :]
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    low, high = np.searchsorted(ordered, wanted), np.searchsorted(ordered, wanted, side="right")
    lost = np.flatnonzero(low == high)
    if lost.size:
        raise MeshError(
            f"{label}: surface {name!r}: {boundary} {lost[0]} with nodes {corners[lost[0]].tolist()} is "
            f"not the face of a {solid} ({lost.size} such)"
        )
    face = order[low]
    inside = np.flatnonzero(high - low == 2)  # between two elements: the one on the back of its normal
    for other in (order[low[inside]], order[high[inside] - 1]):
        element, side = np.divmod(other, len(local))
        own = mesh.cells[element[:, None], local[side]]
        start = (own == corners[inside, :1]).argmax(axis=1)
        following = np.take_along_axis(own, ((start + 1) % row.face_corners)[:, None], axis=1)[:, 0]
        agrees = following == corners[inside, 1]
        face[inside[agrees]] = other[agrees]
    return np.column_stack(np.divmod(face, len(local)))
