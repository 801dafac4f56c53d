"""Rigid parts from shapes, surfaces and meshes; see ModelBuilder.add_rigid."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..base.checks import is_number
from ..base.errors import ModelError
from ..elements.rigid import NOMINAL_PERIOD, RIGID, TRIANGLE_SIDES, deviations_through
from ..materials import SVK, Material
from ..mesh import Mesh
from ..mesh.cells import TET_FACES
from ..model.rigid import RigidBody, surface_moments, volume_moments
from ..model.shapes import Box, Capsule, Cylinder, HalfSpace, Shape, Sphere, flat_ends
from ..model.triangle_mesh import TriMesh
from .checks import vector

__all__ = ["make_rigid"]

TRIANGLE_ROUND_OFF = 1e-9
"""Largest violation of the triangle inequality of principal inertias, over the largest; half of the inertia of a rod
about its axis."""
CONTACT_PERIOD = 1e-3
"""Time, s, in which a wave would pass a part without a material: its stiffness in contact with obstacles."""
MIN_SPREAD = 0.05
"""Least radius of gyration of the four points over the largest."""
TETRAHEDRON = np.array([(1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)])
"""Corners of the cube that make a regular tetrahedron."""


def make_rigid(
    name: str, shape: Any, density: Any, mass: Any, inertia: Any, com: Any, material: Material | None
) -> RigidBody:  # fmt: skip
    """A rigid part; see ModelBuilder.add_rigid."""
    what = f"rigid part {name!r}"
    points, triangles, sets = _surface(what, shape)
    closed = not isinstance(shape, TriMesh) or shape.closed
    if (density is None) == (mass is None):
        raise ModelError(f"{what}: give either density= (kg/m^3) or mass= (kg)")
    for label, value in (("density", density), ("mass", mass)):
        if value is not None and (not is_number(value) or not value > 0.0):
            raise ModelError(f"{what}: {label} = {value!r} must be a positive finite number")
    if not closed and (mass is None or inertia is None or com is None):
        raise ModelError(
            f"{what}: the mesh is open, so that it has no volume: close it, or give mass=, inertia= and com="
        )
    if com is not None and inertia is None:
        raise ModelError(f"{what}: com= is off that of a uniform density, so give inertia= about it, too")
    exact = volume_moments(shape) if isinstance(shape, Shape) else None
    nowhere: tuple[float, np.ndarray, np.ndarray] = 1.0, np.zeros(3), np.zeros((3, 3))
    volume, center, second = exact or (surface_moments(points, triangles) if closed else nowhere)
    if not volume > 0.0:
        raise ModelError(f"{what}: its volume is {volume:.3g} m^3: the surface is inside out, turn its triangles round")
    if com is not None:
        center = vector(com, f"{what}: com")
    density = float(mass) / volume if density is None else float(density)
    moments = np.zeros((4, 4))
    moments[0, 0] = volume
    moments[1:, 1:] = second if inertia is None else _second_moments(what, inertia) / density
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    given = material is not None
    if material is None:
        material = SVK.from_E_nu(E=density * (size / CONTACT_PERIOD) ** 2, nu=0.0, density=density)
    material = material.with_constants({"density": density})
    vars(material)["rigid_modulus"] = density * (size / NOMINAL_PERIOD) ** 2
    mesh = _cone_mesh(name, points, triangles, center, sets)
    corners = _equimomental_points(moments)
    frames = np.broadcast_to(np.linalg.inv(np.column_stack([np.ones(4), corners])), (len(triangles), 4, 4))
    if isinstance(shape, ROUND):
        frames = np.concatenate([frames, _deviations(shape, mesh.points[mesh.cells[:, :3]])], axis=1)
    nodes = np.vstack([mesh.points, center + corners])
    mesh = replace(mesh, points=nodes)
    return RigidBody(
        name, mesh, RIGID, [("", material)], np.zeros(len(triangles), dtype=np.int64), "rigid", "rigid", frames,
        com=center, moments=moments, elastic=given, corners=np.arange(len(nodes) - 4, len(nodes)), shape=shape,
    )  # fmt: skip


ROUND = Sphere, Capsule, Cylinder
"""Shapes whose surface is curved."""


def _deviations(shape: Any, x: np.ndarray) -> np.ndarray:
    """(T, 7, 4) of the control points of triangles x (T, 3, 3) of the drawn shape, which make them cubics through its
    surface; the last column is zero."""
    center, axes = shape.frame()
    radius, half, _ = shape.sizes
    local = (x - center) @ axes
    flat = flat_ends(shape, x)
    thirds = np.array([[(2.0, 1.0), (1.0, 2.0)]]) / 3.0
    ends = np.stack([local[:, list(side)] for side in TRIANGLE_SIDES], axis=1)
    points = np.einsum("opn,tsnk->tspk", thirds, ends)
    level = np.clip(points[..., 2:], -half, half) * (0.0, 0.0, 1.0)
    if isinstance(shape, Cylinder):
        level = points[..., 2:] * (0.0, 0.0, 1.0)
    rim = np.all(np.linalg.norm(ends[..., :2], axis=3) > 0.5 * radius, axis=2) | ~flat[:, None]

    def outward(p: np.ndarray, level: np.ndarray) -> np.ndarray:
        return level + radius * (p - level) / np.linalg.norm(p - level, axis=-1, keepdims=True)

    points = np.where(rim[:, :, None, None], outward(points, level), points)
    middle = local.mean(axis=1)
    level = (middle[:, 2:] if isinstance(shape, Cylinder) else np.clip(middle[:, 2:], -half, half)) * (0.0, 0.0, 1.0)
    out = deviations_through(local, points, outward(middle, level))
    out[flat] = deviations_through(local[flat], points[flat], None)
    return np.pad(out @ axes.T, ((0, 0), (0, 0), (0, 1)))


def _equimomental_points(moments: np.ndarray) -> np.ndarray:
    """(4, 3) points relative to the centre of mass that have the second moments with a quarter of the mass each; apart
    by `MIN_SPREAD` at least where those vanish."""
    squares, axes = np.linalg.eigh(moments[1:, 1:] / moments[0, 0])
    radii = np.sqrt(np.maximum(squares, 0.0))
    radii = np.maximum(radii, MIN_SPREAD * radii.max())
    return np.asarray(TETRAHEDRON * radii @ axes.T)


def _second_moments(what: str, inertia: Any) -> np.ndarray:
    """int x x^T dm = tr(J)/2 - J of a tensor of inertia J (3, 3), or its diagonal (3,), kg m^2."""
    try:
        J = np.asarray(inertia, dtype=float)
    except (TypeError, ValueError):
        J = np.zeros(0)
    J = np.diag(J) if J.shape == (3,) else J
    if J.shape != (3, 3) or not np.all(np.isfinite(J)) or np.abs(J - J.T).max() > 1e-12 * np.abs(J).max():
        raise ModelError(
            f"{what}: inertia = {inertia!r} must be a symmetric (3, 3) tensor or its diagonal (3,), kg m^2"
        )
    principal = np.linalg.eigvalsh(J)
    squares, axes = np.linalg.eigh(0.5 * np.trace(J) * np.eye(3) - J)
    least = TRIANGLE_ROUND_OFF * principal[2]
    if principal[2] <= 0.0 or min(principal[0], squares[0]) < -least:
        raise ModelError(
            f"{what}: principal inertias {principal.tolist()} kg m^2 must be positive, but for one of a rod, and none "
            "larger than the sum of the other two (no mass has those)"
        )
    if squares[1] < least:  # a rod: without an inertia about its axis nothing would hold its turn
        squares[:2] = least
    return np.asarray(axes * squares @ axes.T)


def _surface(what: str, shape: Any) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Points, outward triangles, and named surfaces as lists of triangles."""
    if isinstance(shape, HalfSpace) or not isinstance(shape, (Shape, Mesh)):
        raise ModelError(
            f"{what}: expected a wf.Box, Sphere, Capsule, Cylinder, TriMesh, or a mesh of a volume, got {shape!r}"
        )
    if isinstance(shape, Shape):
        points, triangles = shape.mesh()
        return points, triangles, _named_sides(shape, points[triangles])
    if shape.cell_type not in ("tetra", "tetra10", "hexahedron"):
        raise ModelError(
            f"{what}: {shape.label} has {shape.cell_type} cells; expected a volume, or a closed wf.TriMesh"
        )
    faces = shape.boundary()
    nodes = shape.faces(faces)
    cut = {3: [(0, 1, 2)], 4: [(0, 1, 2), (0, 2, 3)], 6: [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)]}[nodes.shape[1]]
    triangles = nodes[:, cut].reshape(-1, 3)
    row = {tuple(face): k for k, face in enumerate(faces.tolist())}
    sets = {}
    for label, members in shape.surface_sets.items():
        own = [row[tuple(face)] for face in members.tolist() if tuple(face) in row]
        sets[label] = (np.array(own, dtype=np.int64)[:, None] * len(cut) + np.arange(len(cut))).ravel()
    return shape.points, triangles, sets


def _named_sides(shape: Shape, x: np.ndarray) -> dict[str, np.ndarray]:
    """Triangles of the sides of a shape that is drawn by x (n, 3, 3), along its own axes, named as those of meshes."""
    if isinstance(shape, Box):
        return {label: np.array([2 * k, 2 * k + 1]) for k, label in enumerate(("z-", "z+", "y-", "y+", "x-", "x+"))}
    if isinstance(shape, Cylinder):
        flat, far = flat_ends(shape, x), (x[:, 0] - shape.frame()[0]) @ shape.frame()[1][:, 2] > 0.0
        return {name: np.flatnonzero(part)
                for name, part in (("bottom", flat & ~far), ("top", flat & far), ("side", ~flat))}  # fmt: skip
    return {} if isinstance(shape, TriMesh) else {"surface": np.arange(len(x))}


def _cone_mesh(
    name: str, points: np.ndarray, triangles: np.ndarray, apex: np.ndarray, sets: dict[str, np.ndarray]
) -> Mesh:
    """Tetrahedra from the apex to the triangles, whose faces 0 they are; the first of the largest volume."""
    x = points[triangles] - apex
    first = int(np.argmax(np.linalg.det(x)))
    order = np.append(first, np.delete(np.arange(len(triangles)), first))
    rank = np.argsort(order)
    apexes = np.full(len(triangles), len(points))
    cells = np.column_stack([triangles[:, 0], triangles[:, 2], triangles[:, 1], apexes])[order]
    assert tuple(TET_FACES[0]) == (0, 2, 1)
    surfaces = {k: np.column_stack([np.sort(rank[v]), np.zeros(len(v), dtype=np.int64)]) for k, v in sets.items()}
    nodes = {k: np.unique(triangles[v]) for k, v in sets.items()}
    return Mesh(np.vstack([points, apex]), cells, "tetra", nodes, {}, surfaces, name)
