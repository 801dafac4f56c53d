"""Bodies from meshes, materials and options; unique names.

Geometry of ANCF solids: face-centroid nodes, and the frames dX/dxi at the nodes, from a mesh of tets or hexes.
Geometry of shells: axes and frames dX/dxi of each quad at its nodes, with directors shared by adjacent elements.
"""

import math
import pathlib
from typing import Any

import numpy as np

from .. import elements as element_families
from .. import mesh as meshes
from ..base.checks import float_array
from ..base.errors import ModelError
from ..base.names import check_choice
from ..elements import Family
from ..elements.beam_sections import beam_family
from ..elements.lagrange import T10, TET_CORNERS, TET_FACES
from ..elements.sections import BeamSection
from ..mesh import Mesh, linear
from ..mesh.cells import CELL_TYPES
from ..mesh.convert import with_face_nodes
from ..model.bodies import Body
from .checks import assign_materials

__all__ = ["MeshLike", "as_mesh", "make_solid", "make_structure", "shell_geometry", "unused_name"]

MeshLike = str | pathlib.Path | Mesh | Any
"""File, Mesh or meshio.Mesh (not imported here)."""
MAX_CORNER_ANGLE = math.radians(30.0)


def as_mesh(mesh: MeshLike, what: str, scale: float, transform: Any) -> Mesh:
    """Checked mesh, m, from a file, a Mesh or a meshio.Mesh. ModelError for anything else, MeshError for a bad mesh."""
    if isinstance(mesh, (str, pathlib.Path)):
        return meshes.read(mesh, scale=scale, transform=transform)
    if meshes.is_meshio(mesh):
        return meshes.from_meshio(mesh, scale=scale, transform=transform)
    if not isinstance(mesh, Mesh):
        kind = f"{type(mesh).__module__}.{type(mesh).__qualname__}".removeprefix("builtins.")
        raise ModelError(f"{what}: mesh must be a file name, a warpfea.mesh.Mesh or a meshio.Mesh, got {kind}")
    if scale != 1.0 or transform is not None:
        mesh = mesh.transformed(scale=scale, transform=transform)
    return meshes.check(mesh)


def make_solid(name: str, mesh: Mesh, material: Any, element: str | None, quadrature: str | None) -> Body:
    """A solid body; see ModelBuilder.add_solid."""
    if len(mesh.cells) == 0:
        raise ModelError(f"body {name!r}: the mesh has no elements")
    if element is None and mesh.cell_type in ("quad", "line"):
        raise ModelError(
            f"body {name!r}: {mesh.label} is a surface of {mesh.cell_type} cells, not a solid; use add_shell(mesh, "
            "thickness=...)"
        )
    family = element_families.get_family(element) if element else element_families.family_for_cell(mesh.cell_type)
    mesh, frames = solid_geometry(name, mesh, family)
    rule = family.rule(quadrature).name
    curved = family.curved_rule.name if quadrature is None else rule
    return Body(name, mesh, family, *assign_materials(name, mesh, material), rule, curved, frames)


def make_structure(
    name: str,
    mesh: Mesh,
    element: str,
    material: Any,
    integration: str | None,
    axes: np.ndarray,
    frames: np.ndarray,
    section: BeamSection | None = None,
) -> Body:
    """A beam or shell with the axes and frames of its geometry; see ModelBuilder.add_beam and add_shell."""
    materials, index = assign_materials(name, mesh, material)
    family = element_families.get_family(element) if section is None else beam_family(section)
    split = all(law.law == "svk" for _, law in materials)
    scheme = integration or ("tied" if split else "full")
    check_choice(f"body {name!r}: integration", scheme, [*family.schemes, *family.rules])
    if scheme in family.schemes and not split:
        bad = next(law for _, law in materials if law.law != "svk")
        raise ModelError(
            f"body {name!r}: integration = {scheme!r} splits the St. Venant-Kirchhoff law; use 'full' with "
            f"{type(bad).__name__}"
        )
    return Body(name, mesh, family, materials, index, scheme, scheme, frames, axes, section)


def unused_name(name: Any, default: str, taken: set[str], what: str) -> str:
    """The given name, or a new one from `default`; `what`: "body" or "joint".

    Raises:
        ModelError: the name is not text, or already used.
    """
    if name is None:
        k = 1
        first = f"{default}_1" if what == "joint" else default
        while (out := first if k == 1 else f"{default}_{k}") in taken:
            k += 1
        return out
    if not isinstance(name, str) or not name:
        raise ModelError(f"{what} name {name!r} is no text")
    if name in taken:
        raise ModelError(f"{what} name {name!r} is used twice")
    return name


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


def shell_geometry(name: str, mesh: Mesh, thickness: Any, normals: Any, corners: str) -> tuple[np.ndarray, np.ndarray]:
    """Axes and frames of a shell.

    Args:
        normals: directors at the nodes, (nodes, 3) or a function X (n, 3) -> (n, 3); None: the mean of the quads'
            normals.

    Returns:
        Node axes (nodes, 3, 3), columns two tangents and the director; frames (elements, 4, 3, 3) = dX/dxi in those
        axes, m. The lines of the quads are made tangent to the surface at each node: a smooth surface is curved.

    Raises:
        ModelError: as ModelBuilder.add_shell.
    """
    label = f"body {name!r}"
    if mesh.cell_type != "quad":
        raise ModelError(f"{label}: a shell needs quad cells, {mesh.label} has {mesh.cell_type}")
    thick = float_array(thickness(mesh.points) if callable(thickness) else thickness)
    if thick.shape not in ((), (len(mesh.points),)) or not np.all(np.isfinite(thick) & (thick > 0.0)):
        raise ModelError(f"{label}: thickness = {thickness!r} must be a positive length (m), one per node, or f(X)")
    check_choice(f"{label}: corners", corners, ("error", "weld"))
    x = mesh.points[mesh.cells]
    along = np.stack([x[:, 1] - x[:, 0], x[:, 1] - x[:, 0], x[:, 2] - x[:, 3], x[:, 2] - x[:, 3]], axis=1)
    across = np.stack([x[:, 3] - x[:, 0], x[:, 2] - x[:, 1], x[:, 2] - x[:, 1], x[:, 3] - x[:, 0]], axis=1)
    normal = np.cross(along, across)
    normal = normal / np.linalg.norm(normal, axis=2, keepdims=True)
    director = _directors(label, mesh, normal, normals)
    d = director[mesh.cells]
    agree = np.sum(d * normal, axis=2)
    sharp = agree < math.cos(MAX_CORNER_ANGLE)
    if sharp.any() and corners == "error":
        e, n = np.unravel_index(int(np.argmin(agree)), agree.shape)
        raise ModelError(
            f"{label}: the surface of {mesh.label} has a corner at node {int(mesh.cells[e, n])}: the normal of quad "
            f"{int(e)} lies {math.degrees(math.acos(max(-1.0, agree[e, n]))):.3g} degrees off the mean there. Use one "
            "shell per side, a finer mesh, or corners='weld', which makes a rigid corner"
        )
    smooth = ~_corner_mask(mesh, sharp)
    own = np.where(smooth[:, :, None], d, normal)
    along, across = (_tangent_lines(a, own, smooth) for a in (along, across))
    frames = np.stack([along, across, np.broadcast_to(thick, len(mesh.points))[mesh.cells][..., None] * own], axis=3)
    axes = _node_axes(mesh, director, along)
    return axes, np.einsum("enck,encl->enkl", axes[mesh.cells], frames)


def _directors(label: str, mesh: Mesh, normal: np.ndarray, given: Any) -> np.ndarray:
    if given is None:
        out = np.zeros_like(mesh.points)
        np.add.at(out, mesh.cells, normal)
    else:
        out = np.asarray(given(mesh.points) if callable(given) else given, dtype=float)
        if out.shape != mesh.points.shape or not np.all(np.isfinite(out)):
            raise ModelError(f"{label}: normals must be finite and of shape {mesh.points.shape}, got {out.shape}")
    length = np.linalg.norm(out, axis=1, keepdims=True)
    flat = np.flatnonzero(length[mesh.used_nodes, 0] < 1e-9)
    if len(flat):
        raise ModelError(f"{label}: the normal at node {int(mesh.used_nodes[flat[0]])} of {mesh.label} is zero")
    return out / np.where(length > 0.0, length, 1.0)


def _corner_mask(mesh: Mesh, sharp: np.ndarray) -> np.ndarray:
    """(E, 4) True if the element's node lies on a corner of the surface."""
    nodes = np.zeros(len(mesh.points), dtype=bool)
    nodes[mesh.cells[sharp]] = True
    return nodes[mesh.cells]


def _tangent_lines(line: np.ndarray, director: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    """Lines (E, 4, 3) rotated into the tangent plane; a smooth surface keeps their arc length."""
    flat = line - np.sum(line * director, axis=2, keepdims=True) * director
    length = np.linalg.norm(flat, axis=2, keepdims=True)
    chord = np.linalg.norm(line, axis=2, keepdims=True)
    angle = np.arccos(np.clip(length / chord, -1.0, 1.0))
    # half the arc's angle lies between chord and tangent: arc = chord x angle / sin(angle)
    arc = chord * np.where(angle > 1e-6, angle / np.maximum(np.sin(angle), 1e-12), 1.0)
    return np.where(smooth[:, :, None], flat / length * arc, line)


def _node_axes(mesh: Mesh, director: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Node axes (nodes, 3, 3): an element's line projected perpendicular to the director, its cross product, the
    director.
    """
    first = np.zeros_like(mesh.points)
    cells, lines = mesh.cells[::-1], along[::-1]
    first[cells.ravel()] = lines.reshape(-1, 3)  # the lowest element writes last
    first -= np.sum(first * director, axis=1, keepdims=True) * director
    length = np.linalg.norm(first, axis=1, keepdims=True)
    lost = length[:, 0] < 1e-12
    first = np.where(lost[:, None], np.eye(3)[0], first / np.where(length > 0.0, length, 1.0))
    d = np.where(lost[:, None], np.eye(3)[2], director)
    return np.stack([first, np.cross(d, first), d], axis=2)
