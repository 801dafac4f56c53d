"""Bodies and obstacles narrower than the facets of a surface, which could pass between the points of these."""

from __future__ import annotations

import math

import numpy as np

from ..elements import Rule
from ..elements.quadrature import trapezoidal_rule
from . import assembly
from .discretisation import Discretisation
from .handles import SurfaceSet, once_per_surface

__all__ = ["WIDEST_GAP", "body_widths", "facet_size", "is_narrow", "rules_for_width"]

NARROW_RATIO = 0.55
"""Width of an obstacle or body over the side of facets up to which its own points see the facets, not theirs it."""
TALL_RATIO = 2.0
"""Height of a rail or wall over that side up to which all of it has points."""
WIDEST_GAP = 0.45
"""Largest distance of points over the width that they must see, or over the side of a patch of an obstacle."""
MAX_PARTS = 128
"""Largest number of parts of a facet along a side."""


def _sides(surface: SurfaceSet) -> tuple[np.ndarray, np.ndarray]:
    """(F, 2) lengths of facets along their coordinates, m, of a triangle its longest side twice; (F,) areas, m^2."""
    body = surface.body
    t = assembly.facet_tables(surface)
    x = body.reference[t.conn]
    a, b = (np.einsum("fqi,fik->fqk", d, x) for d in (t.d_a, t.d_b))
    length = np.stack([np.linalg.norm(way, axis=2).mean(axis=1) for way in (a, b, b - a)], axis=1)
    triangle = np.array([len(face) == 3 for face in body.family.faces])[surface.faces[:, 1]]
    sides = np.where(triangle[:, None], length.max(axis=1, keepdims=True), length[:, :2])
    return sides, assembly.facet_areas(body, t).sum(axis=1)


@once_per_surface
def facet_size(surface: SurfaceSet) -> tuple[float, float]:
    """Mean longer side of facets by their area, of triangles over sqrt(2), and root of their mean area, m."""
    sides, area = _sides(surface)
    triangle = np.array([len(face) == 3 for face in surface.body.family.faces])[surface.faces[:, 1]]
    side = np.average(sides.max(axis=1) / np.where(triangle, math.sqrt(2.0), 1.0), weights=area)
    return float(side), math.sqrt(float(area.mean()))


def body_widths(body: Discretisation) -> tuple[float, float]:
    """Least and second extent of a body in the reference, m; of a beam the sides of its section."""
    if body.section is not None:
        return body.section.extents  # type: ignore[no-any-return]
    X = body.mesh.points[np.unique(body.mesh.cells)]
    axes = np.linalg.svd(X - X.mean(axis=0), full_matrices=False)[2]
    extents = np.sort(np.ptp(X @ axes.T, axis=0))
    thickness = assembly.element_volumes(body).sum() / (
        extents[1] * extents[2]
    )  # at most its extent, of shells it counts
    return float(max(extents[0], thickness)), float(extents[1])


def is_narrow(widths: tuple[float, float], side: float) -> bool:
    """True for a thing of a least and a second extent that is narrower than facets of a side, m."""
    return widths[0] < NARROW_RATIO * side and widths[1] < TALL_RATIO * side


def rules_for_width(surface: SurfaceSet, width: float) -> dict[int, Rule]:
    """Rule of each local face with points at most `WIDEST_GAP` times a width, m, apart."""
    sides, kinds = _sides(surface)[0], surface.faces[:, 1]
    parts = np.clip(np.ceil(sides / (WIDEST_GAP * width)), 1, MAX_PARTS).astype(int)
    return {
        int(face): trapezoidal_rule(len(surface.body.family.faces[face]), tuple(parts[kinds == face].max(axis=0)))
        for face in np.unique(kinds)
    }
