"""Contact of round rigid parts with obstacles by points that roll; see kernels/contact/rolling.py."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from .contact_points import ContactPoints, contact_points
from .contacts import Contact
from .handles import SurfaceSet
from .shapes import Capsule, Cylinder, flat_ends

__all__ = ["ROLLING_SHAPES", "RollingContact"]

ROLLING_SHAPES = Capsule, Cylinder
MAX_PLACES = 64
"""Largest number of places on an axis; up to it they are half a radius apart."""


@dataclass(eq=False, repr=False)
class RollingContact(Contact):
    """Contact of a `RigidBody` made from a capsule or a cylinder with an obstacle.

    Its points lie about places on the axis, those of a cylinder's flat ends on their facets. They represent the
    rectangle through the axis: where they lie changes, not their share.
    """

    @cached_property
    def places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places on the axis (N, 3), m; 1 and -1 (N,) at the balls of the ends, else 0; areas (N,), m^2."""
        shape = self._shape
        center, axes = shape.frame()
        radius, half, _ = shape.sizes
        count = min(math.ceil(4.0 * half / radius) + 1, MAX_PLACES)
        z = np.linspace(-1.0, 1.0, max(count, 2))
        share = np.full(len(z), 4.0 * half * radius / (len(z) - 1))
        share[[0, -1]] *= 0.5
        end = np.zeros(len(z))
        if isinstance(shape, Capsule):
            end[[0, -1]] = -1.0, 1.0
            share[[0, -1]] += 0.5 * math.pi * radius**2
        return center + half * z[:, None] * axes[:, 2], end, share

    @property
    def axis(self) -> np.ndarray:
        """(4,) direction of the axis, and the radius, m."""
        return np.append(self._shape.frame()[1][:, 2], self._shape.sizes[0])

    @property
    def _shape(self) -> Any:
        body: Any = self.body
        return body.shape

    def slave_points(self) -> tuple[ContactPoints, Any]:
        """Points of the flat ends, then rows of the places on the axis."""
        body: Any = self.body
        faces = body.boundary
        flat = flat_ends(body.shape, body.mesh.points[body.mesh.cells[faces[:, 0], :3]])
        ends = contact_points(SurfaceSet(body, faces[flat] if flat.any() else faces[:1]), self.points)
        X, _, share = self.places
        width = ends.area.shape[1]
        rows, first = -(-len(X) // width), len(ends.conn) if flat.any() else 0
        place = np.minimum(np.arange(rows * width), len(X) - 1).reshape(rows, width)
        area = np.where(np.arange(rows * width) < len(X), share[place.ravel()], 0.0).reshape(rows, width)
        shape = np.stack([body.point(x).weights for x in X])[place]
        added = {
            "conn": np.tile(np.arange(4), (rows, 1)), "shape": shape, "area": area, "X": X[place],
            "normal": np.zeros((rows, width, 3)), "faces": faces[np.zeros(rows, dtype=int)],
        }  # fmt: skip
        both = {name: np.concatenate([getattr(ends, name)[:first], new]) for name, new in added.items()}
        return ContactPoints(**both, rows=np.zeros(first + rows, dtype=int)), 1.0

    def rolling_rows(self, points: ContactPoints) -> dict[str, np.ndarray]:
        """Row numbers of the places on the axis, and what `kernels/contact/rolling.py` needs of each row."""
        body: Any = self.body
        X, end, _ = self.places
        width = points.area.shape[1]
        rows = -(-len(X) // width)
        return {
            "row": len(points.conn) - rows + np.arange(rows),
            "rolling_axis": np.tile(self.axis, (rows, 1)),
            "rolling_end": np.pad(end, (0, rows * width - len(X))).reshape(rows, width),
            "rolling_gradient": np.tile(body.affine[1:].T, (rows, 1, 1)),
        }
