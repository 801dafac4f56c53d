"""Bodies as returned by a builder: named sets, points, drawn geometry; element and parent coordinates of a reference
position."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..base.checks import is_count
from ..base.errors import ModelError
from . import surfaces
from .assembly import orthonormal
from .discretisation import Discretisation
from .embedding import embedded_skin, parent_coordinates, shape_at_own_points
from .handles import ElementSet, MaterialPoint, NodeSet, SurfaceSet

__all__ = ["Body", "locate", "point_coordinates"]


@dataclass(eq=False, repr=False)
class Body(Discretisation):
    """Flexible body. Made by ModelBuilder; nodes and elements are numbered as in its mesh."""

    # named sets

    def nodes(self, selection: Any) -> NodeSet:
        """Nodes by group name, predicate of X (n, 3) -> mask, or indices. MeshError lists the known names."""
        return NodeSet(self, self.mesh.nodes(selection), _label(selection))

    def surface(self, selection: Any) -> SurfaceSet:
        """Faces by group name, predicate of face centroids, or rows (element, local face).

        Beams name "start", "end", "side-", "side+", "normal-", "normal+"; shells "top", "bottom" and the strips over
        their named edges.
        """
        return SurfaceSet(self, surfaces.select_faces(self, selection), _label(selection))

    def elements(self, selection: Any) -> ElementSet:
        """Elements by group name, predicate of centroids, or indices."""
        return ElementSet(self, self.mesh.elements(selection), _label(selection))

    def at(self, X: Any) -> MaterialPoint:
        """The material point at the reference position X (3,), m. Raises ModelError for X outside the body."""
        return locate(self, X)

    def line(self, start: Any, end: Any, count: int = 50) -> list[MaterialPoint]:
        """Material points evenly spaced on a straight line from start to end (3,), m, in the reference. ModelError for
        points outside the body, or no count of at least 1."""
        if not (is_count(count) and count >= 1):
            raise ModelError(f"line: count = {count!r} must be a whole number of points, at least 1")
        a, b = point_coordinates(self, start), point_coordinates(self, end)
        return [self.at(a + t * (b - a)) for t in np.linspace(0.0, 1.0, int(count))]

    @property
    def start(self) -> NodeSet:
        """First node of a beam. MeshError for other bodies."""
        return self.nodes("start")

    @property
    def end(self) -> NodeSet:
        """Last node of a beam."""
        return self.nodes("end")

    def edge(self, name: str) -> NodeSet:
        """Nodes of a named edge of a shell."""
        return self.nodes(name)

    @cached_property
    def face_skin(self) -> surfaces.Skin:
        """The faces of the elements."""
        return surfaces.make_skin(self)

    @cached_property
    def skin(self) -> surfaces.Skin:
        """Drawn surface, by default the faces of the elements."""
        return self.face_skin

    def render_skin(
        self, points: np.ndarray, triangles: np.ndarray, distance: float | None, what: str
    ) -> surfaces.Skin:
        """A surface (n, 3), (m, 3) that follows the body; see `embedded_skin`."""
        return embedded_skin(self, points, triangles, distance, what)

    @cached_property
    def drawing(self) -> surfaces.Drawing:
        """Drawn cells."""
        return surfaces.make_drawing(self)


def _label(selection: Any) -> str:
    return selection if isinstance(selection, str) else ""


def point_coordinates(body: Discretisation, X: Any) -> np.ndarray:
    """Three finite numbers (3,), m. Raises ModelError."""
    try:
        x = np.asarray(X, dtype=float)
    except (TypeError, ValueError):
        x = np.zeros(0)
    if x.shape != (3,) or not np.all(np.isfinite(x)):
        raise ModelError(f"body {body.name!r}: a point must be three finite numbers (m), got {X!r}")
    return x


def locate(body: Discretisation, X: Any, slack: float = 1e-9) -> MaterialPoint:
    """Material point at X (3,), m, in the reference of a body, by Newton's method in every nearby element.

    Points outside by at most `slack` times the element size count as inside.

    Raises:
        ModelError: X is not three finite numbers, or lies outside of the body.
    """
    x = point_coordinates(body, X)
    near, size = _nearby_elements(body, x)
    best = (np.inf, -1, np.zeros(3))
    if len(near):
        xi, miss = parent_coordinates(body, near, np.tile(x, (len(near), 1)))
        outside_distance = body.family.parent.outside_distance(xi) + miss / size
        k = int(np.argmin(outside_distance))
        best = (float(outside_distance[k]), int(near[k]), xi[k])
    if best[0] > max(slack, 1e-12 * float(np.abs(x).max()) / size):
        low, high = body.mesh.bounding_box()
        raise ModelError(
            f"body {body.name!r}: point {x.tolist()} lies outside of it (its nodes fill the box "
            f"{np.asarray(low).tolist()} to {np.asarray(high).tolist()} m)"
        )
    return material_point_at(body, best[1], best[2], x)


def material_point_at(body: Discretisation, element: int, xi: np.ndarray, X: np.ndarray) -> MaterialPoint:
    """The material point at parent coordinates xi (3,) of an element."""
    s, ds = shape_at_own_points(body, np.array([element]), xi[None])
    conn = body.connectivity[element]
    J0 = body.reference[conn].T @ ds[0]
    axes = np.eye(3) if body.family.solid else orthonormal(J0)
    return MaterialPoint(body, conn, s[0].copy(), X, ds[0] @ np.linalg.inv(J0), axes, element, xi)


def _nearby_elements(body: Discretisation, x: np.ndarray) -> tuple[np.ndarray, float]:
    """Elements whose bounding box, enlarged by a tenth of the largest, contains x; and the largest size (m)."""
    low, high, size = body.element_boxes
    return np.flatnonzero(np.all((low - 0.1 * size <= x) & (high + 0.1 * size >= x), axis=1)), size
