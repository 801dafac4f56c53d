"""Bodies as returned by a builder: named sets, points, drawn geometry; element and parent coordinates of a reference
position."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..base.errors import ModelError
from . import surfaces
from .assembly import orthonormal
from .discretisation import Discretisation, element_functions
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
        points outside the body."""
        a, b = point_coordinates(self, start), point_coordinates(self, end)
        return [self.at(a + t * (b - a)) for t in np.linspace(0.0, 1.0, count)]

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
    def skin(self) -> surfaces.Skin:
        """Drawn surface."""
        return surfaces.make_skin(self)

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
    parent = body.family.parent
    near, size = _nearby_elements(body, x)
    best = (np.inf, -1, np.zeros(3))
    if len(near):
        E = (
            body.reference[body.connectivity[near]]
            + (body.slot_kind[body.connectivity[near]] == 0)[:, :, None] * body.origin
        )
        xi = np.tile(parent.center, (len(near), 1))
        for _ in range(20):
            s, ds = _shape_at_own_points(body, near, xi)
            residual = np.einsum("es,esk->ek", s, E) - x
            J = np.einsum("esk,esl->ekl", E, ds)
            step = np.linalg.solve(J, residual[:, :, None])[:, :, 0]
            last, xi = xi, np.clip(xi - step, -2.0, 3.0)
            if np.abs(xi - last).max() < 1e-14:
                break
        s, _ = _shape_at_own_points(body, near, xi)
        miss = np.linalg.norm(np.einsum("es,esk->ek", s, E) - x, axis=1) / size
        outside_distance = parent.outside_distance(xi) + miss
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
    s, ds = _shape_at_own_points(body, np.array([element]), xi[None])
    conn = body.connectivity[element]
    J0 = body.reference[conn].T @ ds[0]
    axes = np.eye(3) if body.family.solid else orthonormal(J0)
    return MaterialPoint(body, conn, s[0].copy(), X, ds[0] @ np.linalg.inv(J0), axes, element, xi)


def _shape_at_own_points(body: Discretisation, elements: np.ndarray, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Functions (E, S), (E, S, 3) of each element at its own point (E, 3)."""
    s, ds = element_functions(body, elements[:1], xi)
    if s.shape[0] == 1 and body.frames is None:
        return s[0], ds[0]
    parts = [element_functions(body, elements[k : k + 1], xi[k : k + 1]) for k in range(len(elements))]
    return np.stack([p[0][0, 0] for p in parts]), np.stack([p[1][0, 0] for p in parts])


def _nearby_elements(body: Discretisation, x: np.ndarray) -> tuple[np.ndarray, float]:
    """Elements whose bounding box, enlarged by a tenth of the largest, contains x; and the largest size (m)."""
    low, high, size = body.element_boxes
    return np.flatnonzero(np.all((low - 0.1 * size <= x) & (high + 0.1 * size >= x), axis=1)), size
