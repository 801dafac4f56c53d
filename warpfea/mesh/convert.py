"""Conversion of cell types with their sets: T10 to T4, and T4 to T4 with face nodes."""

from dataclasses import replace

import numpy as np

from ..base.errors import MeshError
from .cells import CELL_TYPES, Floats, Ints
from .checks import check_volumes
from .mesh import Mesh

__all__ = ["linear", "with_face_nodes"]


def linear(mesh: Mesh) -> Mesh:
    """T10 mesh as T4 on its corner nodes; a T4 mesh unchanged.

    Mid-edge nodes are dropped, the others keep their order (unused nodes, too). Node sets lose the mid-edge nodes
    and may become empty; element and surface sets are unchanged. Curved sides become flat.

    Raises
    ------
    MeshError
        Cells of another type, or an element that is inverted once its edges are straight.
    """
    if mesh.cell_type == "tetra":
        return mesh
    if mesh.cell_type != "tetra10":
        raise MeshError(f"{mesh.label}: linear() takes tetra10 (or tetra) cells, the mesh has {mesh.cell_type}")
    corners = mesh.cells[:, : mesh.kind.corners]
    keep = np.ones(len(mesh.points), dtype=bool)
    keep[mesh.used_nodes] = False
    keep[corners] = True
    new_number = np.cumsum(keep) - 1
    sets = {name: new_number[nodes[keep[nodes]]] for name, nodes in mesh.node_sets.items()}
    out = replace(mesh, points=mesh.points[keep], cells=new_number[corners], cell_type="tetra", node_sets=sets)
    try:
        check_volumes(out)
    except MeshError as error:
        raise MeshError(f"{error}; this is with straight edges between the corners of the T10 elements") from None
    return out


def with_face_nodes(mesh: Mesh, face_points: Floats | None = None) -> Mesh:
    """T4 mesh with one node per face, shared by its two elements: cell type "tetra_faces".

    Face nodes are numbered after the nodes of the mesh, in the order of first occurrence by element. A node
    set gains the node of a face if it holds its three corners and the face is in the surface set of the same name,
    or belongs to an element of the element set of that name, or, without either set, is a boundary face. Element and
    surface sets are unchanged.

    Parameters
    ----------
    face_points : (M, 4, 3) or None
        Positions of the face nodes (m), per element and local face, for curved faces; by default the mean of the
        three corners. A shared face must get the same point from both elements, to 1e-9 of the mesh's size.

    Raises
    ------
    MeshError
        Cells other than "tetra", ``face_points`` of another shape, not finite, or different on the two sides.
    """
    if mesh.cell_type != "tetra":
        raise MeshError(f"{mesh.label}: face nodes need tetra cells, the mesh has {mesh.cell_type}")
    corners = mesh.cells[:, CELL_TYPES["tetra"].faces].reshape(-1, 3)  # row 4 e + k is face k of element e
    _, first, inverse = np.unique(mesh._face_keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(first), dtype=np.int64)
    rank[order] = np.arange(len(first))
    face, first = rank[inverse], first[order]  # face of every row; first row of every face
    if face_points is None:
        added = mesh.points[np.sort(corners[first], axis=1)].mean(axis=1)
    else:
        added = _shared_points(mesh, face_points, face, first)
    start = len(mesh.points)
    sets = {
        name: np.concatenate([nodes, start + np.unique(face[_face_rows_of_set(mesh, name, nodes, corners)])])
        for name, nodes in mesh.node_sets.items()
    }
    points, cells = np.concatenate([mesh.points, added]), np.hstack([mesh.cells, start + face.reshape(-1, 4)])
    return replace(mesh, points=points, cells=cells, cell_type="tetra_faces", node_sets=sets)


def _face_rows_of_set(mesh: Mesh, name: str, nodes: Ints, corners: Ints) -> Ints:
    """Indices 4 e + k (element e, local face k) of the faces whose face nodes join the node set ``name``."""
    rows = []
    if name in mesh.surface_sets:
        rows.append(mesh.surface_sets[name] @ (4, 1))
    if name in mesh.element_sets:
        rows.append((4 * mesh.element_sets[name][:, None] + np.arange(4)).ravel())
    among = np.concatenate(rows) if rows else mesh.boundary() @ (4, 1)
    inside = np.zeros(len(mesh.points), dtype=bool)
    inside[nodes] = True
    return among[inside[corners[among]].all(axis=1)]


def _shared_points(mesh: Mesh, face_points: Floats, face: Ints, first: Ints) -> Floats:
    """Face points (F, 3), m, from face_points (M, 4, 3), checked to agree on both sides of a shared face."""
    given = np.asarray(face_points, dtype=float)
    if given.shape != (len(mesh.cells), 4, 3):
        raise MeshError(f"{mesh.label}: face_points have shape {given.shape}, expected ({len(mesh.cells)}, 4, 3)")
    bad = np.argwhere(~np.isfinite(given).all(axis=2))
    if bad.size:
        e, k = bad[0]
        raise MeshError(f"{mesh.label}: face_points of element {e}, face {k} are {given[e, k].tolist()}: not finite")
    rows = given.reshape(-1, 3)
    gap = np.linalg.norm(rows - rows[first][face], axis=1)
    low, high = mesh.bounding_box()
    worst = int(gap.argmax())
    if gap[worst] > 1e-9 * np.linalg.norm(high - low):
        (e, k), (other, side) = divmod(worst, 4), divmod(int(first[face[worst]]), 4)
        raise MeshError(
            f"{mesh.label}: face_points differ by {gap[worst]:.3g} m between face {k} of element {e} and "
            f"face {side} of element {other}, which are the same face"
        )
    return rows[first]
