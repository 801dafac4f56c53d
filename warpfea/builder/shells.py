"""Geometry of shells: axes and frames dX/dxi of each quad at its nodes, with directors shared by adjacent elements."""

import math
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..mesh import Mesh

__all__ = ["shell_geometry"]

MAX_CORNER_ANGLE = math.radians(30.0)


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
    if not (isinstance(thickness, (int, float, np.floating)) and math.isfinite(thickness) and thickness > 0.0):
        raise ModelError(f"{label}: thickness = {thickness!r} must be a positive length (m)")
    if corners not in ("error", "weld"):
        raise ModelError(f"{label}: corners = {corners!r} is neither 'error' nor 'weld'")
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
    frames = np.stack([along, across, float(thickness) * own], axis=3)
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
