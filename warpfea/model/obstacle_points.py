"""Contact of points of an obstacle with the facets of a body: for obstacles narrower than these, which the points of
the facets would miss."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from ..elements.quadrature import lobatto_square, triangle_16
from .contact_points import ContactPoints, element_depths
from .contacts import Collider
from .handles import SurfaceSet
from .narrow import WIDEST_GAP, body_widths, facet_size, is_narrow
from .pairs import FacetOptions
from .shapes import BOX, CYLINDER, HALF_SPACE, SPHERE, Shape
from .triangle_mesh import TriMesh

__all__ = ["ObstacleContact", "has_own_points", "narrow_width", "obstacle_points"]

SAGITTA_RATIO = 0.001
"""Height of a curved obstacle between two of its points, over the smaller of the side and the depth of an element."""
PATCH_ANGLES = math.radians(10.0), math.radians(45.0)
"""Least and largest angle of a patch of a round obstacle."""
MAX_PATCHES = 64
"""Largest number of patches along an edge of an obstacle."""
MAX_BISECTIONS = 12
"""Largest number of bisections of a triangle of an obstacle."""
Chart = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Coordinates s, t (n,) -> positions (n, 3), m, outward unit normals, area per ds dt (n,)."""


@dataclass(eq=False)
class ObstacleContact(FacetOptions):
    """Contact of a surface with an obstacle narrower than its facets; made by ModelBuilder.add_contact.

    Attributes:
        surface: faces of the body, whose facets the points of the obstacle touch.
        collider: the obstacle.
    """

    surface: SurfaceSet
    collider: Collider
    name: str
    sign = -1.0
    shadow = 0.25
    one_sided = 1

    @property
    def surfaces(self) -> tuple[SurfaceSet, ...]:
        return (self.surface,)

    @property
    def roles(self) -> tuple[Any, Any]:
        return self.collider, self.body

    def slave_points(self) -> tuple[ContactPoints, Any]:
        return obstacle_points(self)

    def own_depths(self, points: ContactPoints) -> np.ndarray:
        """Zero: an obstacle does not yield."""
        return np.zeros(len(points.conn))

    def __repr__(self) -> str:
        return f"ObstacleContact({self.name!r}, body {self.body.name!r} with collider {self.collider.name!r})"


def _widths(shape: Shape) -> tuple[float, float]:
    """Least and second extent of a shape, m, its radius if it is round; infinite for half-spaces and sheets."""
    if shape.kind == HALF_SPACE or (isinstance(shape, TriMesh) and not shape.closed):
        return math.inf, math.inf
    if math.isfinite(shape.radius_of_curvature):
        return shape.radius_of_curvature, shape.radius_of_curvature
    extent = np.sort(np.ptp(shape.points, axis=0) if isinstance(shape, TriMesh) else 2.0 * shape.sizes)
    return float(extent[0]), float(extent[1])


def narrow_width(surface: SurfaceSet, collider: Collider) -> float | None:
    """Least extent of an obstacle narrower than the facets of a surface, m; None of another one."""
    widths = _widths(collider.shape)
    return widths[0] if math.isfinite(widths[0]) and is_narrow(widths, facet_size(surface)[0]) else None


def has_own_points(surface: SurfaceSet) -> bool:
    """True if a narrow obstacle has points that see the facets of a surface: facets of one kind."""
    kinds = {len(surface.body.family.faces[int(face)]) for face in np.unique(surface.faces[:, 1])}
    return len(kinds) == 1


@dataclass(frozen=True)
class Patches:
    """Patches of 16 points on an obstacle in its own frame.

    Attributes:
        X, normal: (F, 16, 3) positions, m, and outward normals. area: (F, 16) m^2.
        width: (F,) length over which a contact on the patch extends, m.
    """

    X: np.ndarray
    normal: np.ndarray
    area: np.ndarray
    width: np.ndarray


def _patches(chart: Chart, s: np.ndarray, t: np.ndarray, width: float) -> Patches:
    """Patches between the coordinates s and t of a chart."""
    rule = lobatto_square(4)
    ds, dt = np.diff(s), np.diff(t)
    at_s = s[:-1, None, None] + ds[:, None, None] * rule.points[:, 0] + 0.0 * dt[:, None]
    at_t = t[:-1, None] + dt[:, None] * rule.points[:, 1] + 0.0 * ds[:, None, None]
    X, normal, density = chart(at_s.ravel(), at_t.ravel())
    area = density.reshape(at_s.shape) * (ds[:, None, None] * dt[:, None]) * rule.weights
    count = len(ds) * len(dt)
    return Patches(
        X.reshape(count, -1, 3), normal.reshape(count, -1, 3), area.reshape(count, -1), np.full(count, width)
    )


def _parts(length: float, side: float) -> int:
    return int(np.clip(math.ceil(length / side - 1e-9), 1, MAX_PATCHES))


def _box(half: np.ndarray, side: float) -> list[Patches]:
    """Faces of a box."""
    out = []
    for axis, sign in product(range(3), (-1.0, 1.0)):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        width = 2.0 * float(min(half[a], half[b]))

        def chart(s: np.ndarray, t: np.ndarray, axis: int = axis, sign: float = sign) -> Any:
            X = np.zeros((len(s), 3))
            X[:, axis], X[:, (axis + 1) % 3], X[:, (axis + 2) % 3] = sign * half[axis], s, t
            return X, np.tile(sign * np.eye(3)[axis], (len(s), 1)), np.ones(len(s))

        cuts = [np.linspace(-half[k], half[k], _parts(2.0 * half[k], min(side, 4.0 * width)) + 1) for k in (a, b)]
        out.append(_patches(chart, cuts[0], cuts[1], width))
    return out


def _ball(radius: float, half: float, width: float, parts: int) -> list[Patches]:
    """A sphere, or the ends of a capsule, by the faces of a cube, seen at equal angles."""
    cuts = np.linspace(-0.25 * math.pi, 0.25 * math.pi, 2 * -(-parts // 2) + 1)
    out = []
    for axis, sign in product(range(3), (-1.0, 1.0)):

        def chart(s: np.ndarray, t: np.ndarray, axis: int = axis, sign: float = sign) -> Any:
            x, y = np.tan(s), np.tan(t)
            d = np.zeros((len(s), 3))
            d[:, axis], d[:, (axis + 1) % 3], d[:, (axis + 2) % 3] = sign, x, y
            length = np.sqrt(1.0 + x * x + y * y)
            return radius * d / length[:, None], d / length[:, None], radius**2 * (1 + x * x) * (1 + y * y) / length**3

        found = _patches(chart, cuts, cuts, width)
        shift = np.sign(np.round(found.X[:, :, 2].mean(axis=1) / radius, 9)) * half
        found.X[:, :, 2] += shift[:, None]
        out.append(found)
    return out


def _round(shape: Shape, side: float, width: float) -> list[Patches]:
    """Spheres, capsules and cylinders."""
    radius, half, _ = shape.sizes
    angle = float(np.clip(width / (WIDEST_GAP * radius), *PATCH_ANGLES))
    ends = [] if shape.kind == CYLINDER else _ball(radius, half, width, _parts(0.5 * math.pi, angle))
    if shape.kind == SPHERE:
        return ends
    count = 4 * _parts(0.5 * math.pi, angle)  # as symmetric as bodies may be, without a point on their middle
    turns = 2.0 * math.pi * (np.arange(count + 1) - 0.5) / count

    def mantle(s: np.ndarray, t: np.ndarray) -> Any:
        n = np.stack([np.cos(s), np.sin(s), np.zeros(len(s))], axis=1)
        return radius * n + t[:, None] * (0.0, 0.0, 1.0), n, np.full(len(s), radius)

    along = np.linspace(-half, half, _parts(2.0 * half, min(side, 4.0 * radius)) + 1)
    out = [*ends, _patches(mantle, turns, along, width)]
    for sign in (-1.0, 1.0) if shape.kind == CYLINDER else ():

        def disc(s: np.ndarray, t: np.ndarray, sign: float = sign) -> Any:
            X = np.stack([t * np.cos(s), t * np.sin(s), np.full(len(s), sign * half)], axis=1)
            return X, np.tile((0.0, 0.0, sign), (len(s), 1)), t

        out.append(_patches(disc, np.linspace(0.0, 2.0 * math.pi, 9), np.array([0.0, radius]), radius))
    return out


def _triangles(shape: TriMesh, side: float) -> list[Patches]:
    """Triangles of a mesh in the world, bisected until their longest edge is at most `side`."""
    rule = triangle_16()
    x = shape.points[shape.triangles]
    for _ in range(MAX_BISECTIONS):
        length = np.linalg.norm(x - np.roll(x, -1, axis=1), axis=2)
        long = length.max(axis=1) > side
        if not long.any():
            break
        first = np.argmax(length[long], axis=1)[:, None] + np.arange(3)
        a, b, c = np.moveaxis(np.take_along_axis(x[long], (first % 3)[:, :, None], axis=1), 1, 0)
        m = 0.5 * (a + b)
        x = np.concatenate([x[~long], np.stack([a, m, c], axis=1), np.stack([m, b, c], axis=1)])
    cross = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    double = np.linalg.norm(cross, axis=1)
    X = x[:, :1] + np.einsum("qk,fkc->fqc", rule.points, x[:, 1:] - x[:, :1])
    normal = np.repeat((cross / double[:, None])[:, None], len(rule.points), axis=1)
    width = double / np.linalg.norm(x - np.roll(x, -1, axis=1), axis=2).max(axis=1)
    return [Patches(X, normal, np.outer(double, rule.weights), width)]


def obstacle_points(contact: ObstacleContact) -> tuple[ContactPoints, np.ndarray]:
    """Points of the obstacle of a contact, without slots, and the factor (F, 1) on their stiffness by area.

    Their distance follows the width of the obstacle, or its curvature and the elements of the body. Elements bear a
    pressure on their own depth of material, on a width below it only that width: the factor is their ratio.
    """
    shape, surface = contact.collider.shape, contact.surface
    side, depth = facet_size(surface)[0], float(element_depths(surface).min())
    least, second = body_widths(surface.body)
    if second < side:  # a bar, which may lie across: it would pass between points of longer patches
        side = min(side, 2.0 * least)
    center, axes = shape.frame()
    if isinstance(shape, TriMesh):
        found, center, axes = _triangles(shape, 0.5 * side), np.zeros(3), np.eye(3)
    elif shape.kind == BOX:
        found = _box(shape.sizes, 0.5 * side)
    else:
        radius = float(shape.sizes[0])
        found = _round(shape, 0.5 * side, math.sqrt(8.0 * SAGITTA_RATIO * radius * min(side, depth)))
    X, normal, area, width = (np.concatenate([getattr(p, name) for p in found])
                              for name in ("X", "normal", "area", "width"))  # fmt: skip
    F = len(X)
    none = np.zeros((F, 1), dtype=int)
    points = ContactPoints(none, np.zeros((F, X.shape[1], 1)), area, center + X @ axes.T, normal @ axes.T,
                           np.full((F, 2), -1))  # fmt: skip
    return points, np.maximum(1.0, depth / width)[:, None]
