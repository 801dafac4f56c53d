"""Integration points of contact with obstacles on faces, and effective body constants of the contact law."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.checks import is_count
from ..base.errors import ModelError
from ..elements import Rule
from ..elements.quadrature import lobatto_square, triangle_3, triangle_7
from ..materials import Material
from . import assembly
from .discretisation import Discretisation
from .handles import SurfaceSet, once_per_surface
from .masses import all_mass_parts
from .narrow import rules_for_width

__all__ = [
    "CONTACT_RULES",
    "ContactPoints",
    "Modulus",
    "body_mass_total",
    "check_contact_points",
    "contact_points",
    "corner_points",
    "effective_modulus",
    "elastic_constants",
    "element_depths",
    "element_edge_and_depth",
    "lagrange_basis",
    "points_by_faces",
    "points_by_rules",
    "rules_of_faces",
]

Modulus = Callable[[Discretisation, SurfaceSet | None], tuple[float, float]]
"""Young's modulus, Pa, and Poisson's ratio of a body at a surface."""
CONTACT_RULES: Mapping[int, Mapping[int, Rule]] = {
    3: {3: triangle_3(), 7: triangle_7()},
    4: {n * n: lobatto_square(n) for n in (2, 3, 4, 5)},
}
"""Rules including the face corners, by the numbers of corners and of points."""
ALIKE = 4.0
"""Ratio of the depths of elements that share a contact stiffness."""
DEFAULT_POINTS = {3: 7, 4: 16}
"""Points of a face by the number of its corners."""


@dataclass(frozen=True, eq=False)
class ContactPoints:
    """Points of the faces of a surface.

    Attributes:
        conn: (F, L) body slots; faces that use fewer repeat their first one with functions of zero.
        shape: (F, P, L) functions: the position of a point is sum_i shape_i e_i, plus the body's origin.
        area: (F, P) reference area of each point, m^2; their sum is the area of the surface. Faces with fewer points
            than others repeat their last one with area 0.
        X: (F, P, 3) reference positions, m.
        normal: (F, P, 3) outward unit normals in the reference; 0 for degenerate faces.
        faces: (F, 2) rows (element, local face).
        rows: facet of each row; by default one each, else those of segments, and of points on edges last.
    """

    conn: np.ndarray
    shape: np.ndarray
    area: np.ndarray
    X: np.ndarray
    normal: np.ndarray
    faces: np.ndarray
    rows: Any = ...


def contact_points(surface: SurfaceSet, points: int | None = None, width: float | None = None) -> ContactPoints:
    """The points of a surface, corners included.

    Triangles have 7 points (degree 3, area weights 1/20, 2/15, 9/20 of vertices, mid-sides and centre), quadrilaterals
    Lobatto's 4 x 4 (degree 5 along each side).

    Args:
        surface: faces of a body of any family; beams with their section, shells with their thickness.
        points: number of points per face: 3 (the vertices, degree 1: on a T10 face they miss the mid-side
            nodes) or 7 of triangles; 4, 9, 16 or 25 of quadrilaterals.
        width: without `points`, m: equidistant ones that a thing of this width can't pass between.

    Raises:
        ModelError: another number, or one without a rule for all faces.
    """
    if points is None and width is not None:
        return points_by_faces(surface, rules_for_width(surface, width))
    check_contact_points(surface, points)
    return points_by_rules(surface, CONTACT_RULES, DEFAULT_POINTS, points)


def points_by_rules(
    surface: SurfaceSet, known: Mapping[int, Mapping[int, Rule]], default: Mapping[int, int], points: int | None
) -> ContactPoints:
    """The points of a surface by rules that are known by the corners of a face and their own number."""
    rules = {corners: those[default[corners] if points is None else points] for corners, those in known.items()
             if points is None or points in those}  # fmt: skip
    return points_by_faces(surface, rules_of_faces(surface, rules))


def rules_of_faces(surface: SurfaceSet, rules: Mapping[int, Rule]) -> dict[int, Rule]:
    """Rule of each local face in a surface, from rules by the number of corners."""
    return {int(face): rules[len(surface.body.family.faces[face])] for face in np.unique(surface.faces[:, 1])}


def points_by_faces(surface: SurfaceSet, rules: Mapping[int, Rule]) -> ContactPoints:
    """The points of a surface by the rules of its local faces."""
    body = surface.body
    t = assembly.facet_tables(surface, rules=rules)
    normal = assembly.facet_area_vectors(body, t)
    length = np.linalg.norm(normal, axis=2)
    np.divide(normal, length[..., None], out=normal, where=length[..., None] > 0.0)
    return ContactPoints(t.conn, t.shape, length * t.weights, assembly.facet_positions(body, t), normal, surface.faces)


def corner_points(p: ContactPoints) -> np.ndarray:
    """(F, 3) points of each face whose cross product (x_1 - x_0) x (x_2 - x_0) points outward; -1 if none.

    The second is the farthest from the first, the third spans the largest triangle with both.
    """
    face = np.arange(len(p.X))
    way = np.where(p.area[..., None] > 0.0, p.X - p.X[:, :1], 0.0)
    j = np.argmax(np.einsum("fpk,fpk->fp", way, way), axis=1)
    cross = np.cross(way[face, j][:, None], way)
    size = np.linalg.norm(cross, axis=2)
    k = np.argmax(size, axis=1)
    side = np.einsum("fk,fk->f", cross[face, k], p.normal.sum(axis=1))
    out = np.stack([np.zeros_like(j), np.where(side > 0.0, j, k), np.where(side > 0.0, k, j)], axis=1)
    flat = (size[face, k] <= 1e-6 * np.einsum("fk,fk->f", way[face, j], way[face, j])) | (side == 0.0)
    return np.where(flat[:, None], -1, out).astype(np.int32)


def lagrange_basis(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lagrange polynomials of the points of a rule in `CONTACT_RULES`, equal on common edges.

    Returns:
        Coefficients (P, M), and the exponents (M, 2) of the monomials; of 7 points all of degree 2 and the bubble
        ab - a^2 b - a b^2.
    """
    side = math.isqrt(len(points))
    if len(points) == 3:
        power = [(0, 0), (1, 0), (0, 1)]
    elif len(points) == 7:
        power = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (2, 1), (1, 2)]
    else:
        power = [(j, k) for j in range(side) for k in range(side)]
    exponents = np.array(power)
    values = np.prod(points[:, None, :] ** exponents, axis=2)
    if len(points) != 7:
        return np.linalg.inv(values).T, exponents
    functions = np.eye(8)[:7]
    functions[6] = 0.0
    functions[6, [4, 6, 7]] = 1.0, -1.0, -1.0
    return np.linalg.solve((values @ functions.T).T, functions), exponents


def check_contact_points(surface: SurfaceSet, points: Any) -> None:
    """Raise ModelError unless `points` is None or has a rule for all faces."""
    if points is None:
        return
    family = surface.body.family
    for corners in sorted({len(family.faces[face]) for face in np.unique(surface.faces[:, 1])}):
        known = CONTACT_RULES[corners]
        if not is_count(points) or points not in known:
            faces = {3: "triangles", 4: "quadrilaterals"}[corners]
            numbers = ", ".join(map(str, known))
            raise ModelError(
                f"points = {points!r}: the faces of body {surface.body.name!r} ({family.name}) are {faces}, which have "
                f"rules of {numbers} points; None takes {DEFAULT_POINTS[corners]}"
            )


@once_per_surface
def element_edge_and_depth(surface: SurfaceSet) -> tuple[np.ndarray, np.ndarray]:
    """Edge of each face of a surface, and depth of the element behind it, both (F,), m.

    Edge of a square of the face's area (of a triangle: of twice its area), and volume over that area (of a tetrahedron
    its height), in the reference.
    """
    body, faces = surface.body, surface.faces
    area = assembly.facet_areas(body, assembly.facet_tables(surface)).sum(axis=1)
    triangle = np.array([len(face) == 3 for face in body.family.faces])[faces[:, 1]]
    if body.rigid_depth is not None:  # cones of any volume
        return np.sqrt(2.0 * area), np.full(len(area), body.rigid_depth)
    volume = assembly.element_volumes(body)[faces[:, 0]]
    share = np.where(triangle, 3.0, np.array(body.family.face_shares or [1.0] * len(body.family.faces))[faces[:, 1]])
    return np.sqrt(np.where(triangle, 2.0, 1.0) * area), share * volume / area


def effective_modulus(
    body: Discretisation, surface: SurfaceSet | None = None, materials: Sequence[Material] = ()
) -> tuple[float, float]:
    """Young's modulus, Pa, and Poisson's ratio at small strain, for any law.

    Of several materials at the surface (None: in the body), that with the largest Young's modulus: a contact has one
    stiffness. `materials`: those of the body in a world, by default as built.
    """
    materials = materials or [material for _, material in body.materials]
    elements = slice(None) if surface is None else surface.faces[:, 0]
    return max(elastic_constants(materials[int(k)]) for k in np.unique(body.material_of[elements]))


def elastic_constants(material: Material) -> tuple[float, float]:
    """Young's modulus, Pa, and Poisson's ratio at small strain."""
    lam, mu = material.lame
    return mu * (3.0 * lam + 2.0 * mu) / (lam + mu), lam / (2.0 * (lam + mu))


def element_depths(surface: SurfaceSet) -> np.ndarray:
    """(F,) depth of the element behind each face, m, for the stiffness of contact.

    Of several materials at the surface, times the Young's modulus of `effective_modulus` over that of the element. The
    least depth of a surface stands for those below `ALIKE` times it, and so on: a contact of uniform stiffness alone
    leaves a uniform pressure uniform.
    """
    body, elements = surface.body, surface.faces[:, 0]
    moduli = np.array([elastic_constants(material)[0] for _, material in body.materials])
    depth = (
        element_edge_and_depth(surface)[1] * effective_modulus(body, surface)[0] / moduli[body.material_of[elements]]
    )
    least = float(depth.min())
    return np.asarray(least * ALIKE ** np.floor(np.log(depth / least) / math.log(ALIKE)))


def body_mass_total(body: Discretisation) -> float:
    """Mass of a body as built, kg; 0 for a material without density (statics only)."""
    if any(material.density is None for _, material in body.materials):
        return 0.0
    return sum(part.scale * part.scaled_mass for part in all_mass_parts(body))
