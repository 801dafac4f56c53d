"""Cells of other kinds as those of the elements: corners of cells of higher order, tetrahedra of prisms, pyramids and
the hexahedra beside them.

A cell is cut from its node of the smallest number, and so are its faces of four corners: neighbours cut a shared face
alike (Dompierre et al. 1999, How to subdivide pyramids, prisms and hexahedra into tetrahedra).
"""

from dataclasses import replace

import numpy as np

from ..base.errors import MeshError
from .assemble import RawMesh
from .cells import HEX_FACES, Ints, cell_dimension

__all__ = ["corners_only", "split_cells"]

CORNER_CELLS = {
    "tetra10": ("tetra", 4), "wedge15": ("wedge", 6), "wedge18": ("wedge", 6), "pyramid13": ("pyramid", 5),
    "pyramid14": ("pyramid", 5), "hexahedron20": ("hexahedron", 8), "hexahedron27": ("hexahedron", 8),
    "quad8": ("quad", 4), "quad9": ("quad", 4), "triangle6": ("triangle", 3), "line3": ("line", 2),
}  # fmt: skip
"""Cells of higher order, with the cell of their corners."""
SPLIT_FACES: dict[str, list[tuple[int, ...]]] = {
    "wedge": [(0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)],
    "pyramid": [(0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)],
    "hexahedron": [tuple(face) for face in HEX_FACES.tolist()],
}
"""Faces of the cells that are cut, outward."""


def corners_only(raw: RawMesh) -> RawMesh:
    """Cells of higher order as those of their corners; nodes that were no corner of a cell are dropped."""
    blocks, middle = [], np.zeros(len(raw.points), dtype=bool)
    for kind, cells in raw.blocks:
        name, count = CORNER_CELLS.get(kind, (kind, cells.shape[1]))
        inside = cells[:, count:]
        middle[inside[(inside >= 0) & (inside < len(middle))]] = True
        blocks.append((name, cells[:, :count]))
    for _, cells in blocks:
        middle[cells[(cells >= 0) & (cells < len(middle))]] = False
    number = np.cumsum(~middle) - 1

    def renumbered(nodes: Ints) -> Ints:
        known = (nodes >= 0) & (nodes < len(number))
        return np.where(known, number[np.where(known, nodes, 0)], nodes)

    groups = {name: renumbered(nodes[~middle[nodes]]) for name, nodes in raw.node_groups.items()}
    blocks = [(kind, renumbered(cells)) for kind, cells in blocks]
    return replace(raw, points=raw.points[~middle], blocks=blocks, node_groups=groups)


def split_cells(raw: RawMesh) -> RawMesh:
    """Prisms and pyramids, with the hexahedra and quads beside them, as tetrahedra and triangles; unchanged without, or
    next to solids of higher order.

    Raises
    ------
    MeshError
        A surface of a file that counts faces of cells that are cut.
    """
    solids = {kind for kind, cells in raw.blocks if len(cells) and cell_dimension(kind) == 3}
    if not solids & {"wedge", "pyramid"} or not solids <= {"tetra", *SPLIT_FACES}:
        return raw
    if raw.faces:
        name = next(iter(raw.faces))
        raise MeshError(f"surface {name!r}: faces of prisms and pyramids, which are cut, have no number; use node sets")
    blocks, sources = [], []
    for kind, cells in raw.blocks:
        parts, source = cells, np.arange(len(cells))
        if kind in SPLIT_FACES:
            kind, (parts, source) = "tetra", _tetrahedra(cells, SPLIT_FACES[kind])
        elif kind == "quad":
            kind, parts = "triangle", np.concatenate([_triangles(cells)[:, k] for k in (0, 1)])
            source = np.tile(source, 2)
        blocks.append((kind, parts))
        sources.append(source)
    groups = [(name, k, np.flatnonzero(np.isin(sources[k], numbers))) for name, k, numbers in raw.groups]
    return replace(raw, blocks=blocks, groups=groups)


def _triangles(quads: Ints) -> Ints:
    """(n, 2, 3) halves of quads, cut at the node of the smallest number."""
    turned = (np.argmin(quads, axis=1)[:, None] + np.arange(4)) % 4
    a, b, c, d = np.take_along_axis(quads, turned, axis=1).T
    return np.stack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)], axis=1)


def _tetrahedra(cells: Ints, faces: list[tuple[int, ...]]) -> tuple[Ints, Ints]:
    """Tetrahedra between the smallest node of each cell and the faces that do not hold it, and the cell of each."""
    apex = cells.min(axis=1)
    parts, source = [], []
    for face in faces:
        corners = cells[:, face]
        halves = corners[:, None] if len(face) == 3 else _triangles(corners)
        for k in range(halves.shape[1]):
            far = np.flatnonzero((corners != apex[:, None]).all(axis=1))
            a, b, c = halves[far, k].T
            parts.append(np.stack([a, c, b, apex[far]], axis=1))
            source.append(far)
    order = np.argsort(np.concatenate(source), kind="stable")
    return np.concatenate(parts)[order], np.concatenate(source)[order]
