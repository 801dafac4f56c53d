"""Rigid shapes for contact: placement, size, drawing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ..base.checks import is_count, is_number
from ..base.errors import ModelError
from ..kernels.contact.collider_shapes import BOX, CAPSULE, CYLINDER, HALF_SPACE, SPHERE

__all__ = [
    "BOX",
    "CAPSULE",
    "CYLINDER",
    "HALF_SPACE",
    "SPHERE",
    "Box",
    "Capsule",
    "Cylinder",
    "HalfSpace",
    "Shape",
    "Sphere",
    "flat_ends",
    "set_checked",
]

ORTHONORMAL = 1e-6
"""Tolerance of orthonormality; axes are then orthonormalised to round-off."""


@dataclass(frozen=True, eq=False)
class Shape:
    """Rigid solid at displacement 0; base of the shapes.

    Attributes:
        kind: HALF_SPACE, SPHERE, BOX, CAPSULE or CYLINDER; MESH of a TriMesh: an index of `SHAPE_KINDS`.
    """

    kind: ClassVar[int]

    def frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre (3,), m, and the local axes in the world, the columns of (3, 3), right-handed."""
        raise NotImplementedError

    @property
    def sizes(self) -> np.ndarray:
        """Sizes (3,), m: half-space 0, 0, 0; sphere radius, 0, 0; box half edges; capsule and cylinder radius, half
        axis, 0.
        """
        raise NotImplementedError

    @property
    def radius_of_curvature(self) -> float:
        """Radius, m, of spheres, capsules and cylinders; infinite for half-spaces, boxes and other shapes."""
        return np.inf

    def mesh(self, resolution: int = 24) -> tuple[np.ndarray, np.ndarray]:
        """The surface for drawing.

        Args:
            resolution: segments of a full circle, at least 3; boxes and half-spaces need none.

        Returns:
            points (n, 3), m, and triangles (m, 3), outward by the right hand, each edge shared by two.

        Raises:
            ModelError: a resolution that is not a whole number, or below 3.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class HalfSpace(Shape):
    """Half-space n.x <= offset; bodies are on the side of the normal.

    Args:
        normal: (3,), any length but zero; kept with length 1.
        offset: m from the origin to the plane, along the normal of length 1.

    Raises:
        ModelError: a zero normal, or a value that is not finite.
    """

    normal: Any
    offset: float = 0.0
    kind: ClassVar[int] = HALF_SPACE

    def __post_init__(self) -> None:
        set_checked(self, normal=_unit_vector(self, "normal"), offset=_checked_number(self, "offset"))

    def frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Point of the plane closest to the origin, and axes with the normal as third."""
        return self.offset * self.normal, _axes_along(self.normal)

    @property
    def sizes(self) -> np.ndarray:
        return np.zeros(3)

    def mesh(
        self, resolution: int = 24, *, size: float = 2.0, around: Any = (0.0, 0.0, 0.0)
    ) -> tuple[np.ndarray, np.ndarray]:
        """Square of the plane with sides `size`, m, centred at the projection of `around` (3,), m."""
        _, axes = self.frame()
        place = np.asarray(around, dtype=float)
        middle = place + (self.offset - place @ self.normal) * self.normal
        corners = 0.5 * size * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
        return middle + corners @ axes[:, :2].T, np.array([(0, 1, 2), (0, 2, 3)])


@dataclass(frozen=True, eq=False)
class Sphere(Shape):
    """Sphere.

    Args:
        center: (3,) m.
        radius: m.

    Raises:
        ModelError: a radius that is not positive, or a value that is not finite.
    """

    center: Any
    radius: float
    kind: ClassVar[int] = SPHERE

    def __post_init__(self) -> None:
        set_checked(self, center=_checked_vector(self, "center"), radius=_checked_positive(self, "radius"))

    def frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre, and global axes."""
        return self.center.copy(), np.eye(3)

    @property
    def sizes(self) -> np.ndarray:
        return np.array([self.radius, 0.0, 0.0])

    @property
    def radius_of_curvature(self) -> float:
        return self.radius

    def mesh(self, resolution: int = 24) -> tuple[np.ndarray, np.ndarray]:
        """See Shape."""
        n = _segments(self, resolution)
        return _surface_of_revolution(self, _unit_arc(-np.pi / 2, np.pi / 2, max(2, n // 2)) * self.radius, n)


@dataclass(frozen=True, eq=False)
class Box(Shape):
    """Box.

    Args:
        center: (3,) m.
        size: (3,) lengths of its edges, m.
        axes: (3, 3) rows: the directions of the edges, orthonormal and right-handed; by default those of the world.

    Raises:
        ModelError: a size that is not positive, axes that are not orthonormal or left-handed, or a value that is not
            finite.
    """

    center: Any
    size: Any
    axes: Any = None
    kind: ClassVar[int] = BOX

    def __post_init__(self) -> None:
        set_checked(self, center=_checked_vector(self, "center"), size=_checked_vector(self, "size"))
        if not np.all(self.size > 0.0):
            raise ModelError(f"Box: size = {self.size.tolist()} must be three positive lengths of edges, m")
        set_checked(self, axes=_checked_axes(self, "axes"))

    def frame(self) -> tuple[np.ndarray, np.ndarray]:
        """The centre, and the directions of the edges as columns."""
        return self.center.copy(), self.axes.T.copy()

    @property
    def sizes(self) -> np.ndarray:
        return 0.5 * self.size

    def mesh(self, resolution: int = 24) -> tuple[np.ndarray, np.ndarray]:
        """See Shape."""
        signs = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], dtype=float)
        quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
        triangles = np.array([(q[0], q[i], q[i + 1]) for q in quads for i in (1, 2)])
        return self.center + (signs * self.sizes) @ self.axes, triangles


@dataclass(frozen=True, eq=False)
class _AxisShape(Shape):
    """Common parts of capsules and cylinders: axis from start to end, and radius."""

    start: Any
    end: Any
    radius: float

    def __post_init__(self) -> None:
        set_checked(
            self,
            start=_checked_vector(self, "start"),
            end=_checked_vector(self, "end"),
            radius=_checked_positive(self, "radius"),
        )
        if not np.linalg.norm(self.end - self.start) > 0.0:
            raise ModelError(
                f"{_shape_name(self)}: end = {self.end.tolist()} is the start; the two ends of the axis must be apart"
            )

    def frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Middle of the axis, and axes whose third points from start to end."""
        along = self.end - self.start
        return 0.5 * (self.start + self.end), _axes_along(along / np.linalg.norm(along))

    @property
    def sizes(self) -> np.ndarray:
        return np.array([self.radius, 0.5 * float(np.linalg.norm(self.end - self.start)), 0.0])

    @property
    def radius_of_curvature(self) -> float:
        return self.radius


@dataclass(frozen=True, eq=False)
class Capsule(_AxisShape):
    """Cylinder with hemispherical ends: all points within `radius` of the segment from start to end.

    Args:
        start, end: (3,) m, centres of the hemispheres.
        radius: m.

    Raises:
        ModelError: start and end are one point, a radius that is not positive, or a value that is not finite.
    """

    kind: ClassVar[int] = CAPSULE

    def mesh(self, resolution: int = 24) -> tuple[np.ndarray, np.ndarray]:
        """See Shape."""
        n = _segments(self, resolution)
        radius, half, _ = self.sizes
        quarter = max(1, n // 4)
        low, high = (radius * _unit_arc(*span, quarter) for span in ((-np.pi / 2, 0.0), (0.0, np.pi / 2)))
        return _surface_of_revolution(self, np.concatenate([low - (0.0, half), high + (0.0, half)]), n)


@dataclass(frozen=True, eq=False)
class Cylinder(_AxisShape):
    """A cylinder with flat ends.

    Args:
        start, end: (3,) m, the centres of the two ends.
        radius: m.

    Raises:
        ModelError: start and end are one point, a radius that is not positive, or a value that is not finite.
    """

    kind: ClassVar[int] = CYLINDER

    def mesh(self, resolution: int = 24) -> tuple[np.ndarray, np.ndarray]:
        """See Shape."""
        radius, half, _ = self.sizes
        profile = np.array([(0.0, -half), (radius, -half), (radius, half), (0.0, half)])
        return _surface_of_revolution(self, profile, _segments(self, resolution))


def flat_ends(shape: Shape, x: np.ndarray) -> np.ndarray:
    """(T,) True for triangles x (T, 3, 3) of the drawn shape, m, on the flat ends of a cylinder."""
    if not isinstance(shape, Cylinder):
        return np.zeros(len(x), dtype=bool)
    center, axes = shape.frame()
    half, z = shape.sizes[1], (x - center) @ axes[:, 2]
    return np.asarray(np.all(np.abs(np.abs(z) - half) < 1e-9 * half, axis=1) & (np.ptp(z, axis=1) < half))


# checks; each returns the stored value


def _shape_name(shape: Shape) -> str:
    return type(shape).__name__


def set_checked(shape: Shape, **values: Any) -> None:
    """Set checked values of a frozen shape; arrays become read-only."""
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
        object.__setattr__(shape, name, value)


def _checked_array(shape: Shape, name: str, size: tuple[int, ...], wanted: str) -> np.ndarray:
    value = getattr(shape, name)
    try:
        out = np.array(value, dtype=float)
    except (TypeError, ValueError):
        out = np.full(1, np.nan)
    if out.shape != size or not np.all(np.isfinite(out)):
        shown = value.tolist() if isinstance(value, np.ndarray) else value
        raise ModelError(f"{_shape_name(shape)}: {name} = {shown!r} must be {wanted}")
    return out


def _checked_vector(shape: Shape, name: str) -> np.ndarray:
    return _checked_array(shape, name, (3,), "three finite numbers, m")


def _unit_vector(shape: Shape, name: str) -> np.ndarray:
    out = _checked_array(shape, name, (3,), "three finite numbers that are not all zero")
    length = np.linalg.norm(out)
    if not length > 0.0:
        raise ModelError(f"{_shape_name(shape)}: {name} = {out.tolist()} is zero; give the outward normal")
    return out / length


def _checked_axes(shape: Shape, name: str) -> np.ndarray:
    if getattr(shape, name) is None:
        return np.eye(3)
    wanted = "(3, 3) rows that are orthonormal and right-handed, the directions of the edges"
    out = _checked_array(shape, name, (3, 3), wanted)
    if np.abs(out @ out.T - np.eye(3)).max() > ORTHONORMAL or np.linalg.det(out) < 0.0:
        raise ModelError(f"{_shape_name(shape)}: {name} = {out.tolist()} must be {wanted}")
    u, _, v = np.linalg.svd(out)
    return u @ v


def _checked_number(shape: Shape, name: str) -> float:
    value = getattr(shape, name)
    if not is_number(value):
        raise ModelError(f"{_shape_name(shape)}: {name} = {value!r} must be a finite number, m")
    return float(value)


def _checked_positive(shape: Shape, name: str) -> float:
    value = getattr(shape, name)
    if not is_number(value) or value <= 0.0:
        raise ModelError(f"{_shape_name(shape)}: {name} = {value!r} must be a positive finite number, m")
    return float(value)


def _segments(shape: Shape, resolution: Any) -> int:
    if not is_count(resolution) or resolution < 3:
        raise ModelError(f"{_shape_name(shape)}: resolution = {resolution!r} must be a whole number of at least 3")
    return int(resolution)


# geometry


def _axes_along(n: np.ndarray) -> np.ndarray:
    """Right-handed orthonormal axes (columns) with third axis n (3,)."""
    least = np.eye(3)[int(np.argmin(np.abs(n)))]
    first = np.cross(least, n)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(n, first), n])


def _unit_arc(start: float, end: float, parts: int) -> np.ndarray:
    """(parts + 1, 2) distance from the axis, and height, on a unit circle, from low to high."""
    angle = np.linspace(start, end, parts + 1)
    distance = np.cos(angle)
    distance[np.abs(distance) < 1e-15] = 0.0
    return np.column_stack([distance, np.sin(angle)])


def _surface_of_revolution(shape: Shape, profile: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Surface of revolution of a profile (k, 2) of radii and heights about the local z axis; its ends lie on the
    axis.
    """
    center, axes = shape.frame()
    turn = 2.0 * np.pi * np.arange(n) / n
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    rings = [np.column_stack([r * circle, np.full(n, z)]) for r, z in profile[1:-1]]
    poles = [np.array([[0.0, 0.0, z]]) for z in profile[[0, -1], 1]]
    points = np.concatenate([*rings, *poles])
    a = np.arange(n)
    b = (a + 1) % n
    low, high = len(points) - 2, len(points) - 1
    top = (len(rings) - 1) * n
    triangles = [np.column_stack([np.full(n, low), b, a]), np.column_stack([np.full(n, high), top + a, top + b])]
    for k in range(len(rings) - 1):
        first, second = k * n, (k + 1) * n
        triangles.append(np.column_stack([first + a, first + b, second + b]))
        triangles.append(np.column_stack([first + a, second + b, second + a]))
    return center + points @ axes.T, np.concatenate(triangles)
