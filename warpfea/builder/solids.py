"""Geometry of ANCF solids: face-centroid nodes, and the frames dX/dxi at the nodes, from a mesh of tets or hexes."""

import numpy as np

from ..base.errors import ModelError
from ..elements import Family
from ..elements.lagrange import T10, TET_CORNERS, TET_FACES
from ..mesh import Mesh, linear
from ..mesh.cells import CELL_TYPES
from ..mesh.convert import with_face_nodes

__all__ = ["solid_geometry"]


def solid_geometry(name: str, mesh: Mesh, family: Family) -> tuple[Mesh, np.ndarray | None]:
    """Mesh of the family, and its frames (elements, n, 3, 3) = dX/dxi at the element nodes, m.

    ANCF tetrahedra use the corner nodes of a T10 mesh; ENMC, a complete cubic, keeps curved sides by its frames and
    face nodes.

    Raises:
        ModelError: the family does not fit the cells.
    """
    label = f"body {name!r}"
    if not family.solid:
        raise ModelError(f"{label}: element {family.name} is not a solid; use add_beam or add_shell")
    if not family.has_gradients:
        if family.cell_type != mesh.cell_type:
            raise ModelError(
                f"{label}: element {family.name} needs {family.cell_type} cells, {mesh.label} has {mesh.cell_type}"
            )
        return mesh, None
    if family.parent.low is not None:
        if mesh.cell_type != "hexahedron":
            raise ModelError(f"{label}: element {family.name} needs hexahedra, {mesh.label} has {mesh.cell_type}")
        return mesh, _node_frames(mesh, CELL_TYPES["hexahedron"].gradients(family.node_points))
    if mesh.cell_type not in ("tetra", "tetra10"):
        raise ModelError(f"{label}: element {family.name} needs tetrahedra, {mesh.label} has {mesh.cell_type}")
    frames = _node_frames(mesh, CELL_TYPES[mesh.cell_type].gradients(TET_CORNERS))
    corner = linear(mesh)
    if family.cell_type == "tetra":
        return corner, frames
    centroids = None
    if mesh.cell_type == "tetra10":
        middle = np.array([TET_CORNERS[list(face)].mean(axis=0) for face in TET_FACES])
        s, _ = T10.shape(middle, mesh.points[:1])
        centroids = np.einsum("ps,esk->epk", s[0], mesh.points[mesh.cells])
    full = with_face_nodes(corner, centroids)
    # face nodes have no gradients: their frames are not used
    return full, np.concatenate([frames, np.broadcast_to(np.eye(3), (len(frames), 4, 3, 3))], axis=1)


def _node_frames(mesh: Mesh, gradients: np.ndarray) -> np.ndarray:
    """dX/dxi (E, n, 3, 3) at points with shape derivatives (n, nodes, 3)."""
    return np.einsum("esk,nsl->enkl", mesh.points[mesh.cells], gradients)
