"""Cross-sections of beams.

An element sees a section by its area, its principal axes and radii of gyration, and the shear and torsion constants:
its parent square is the rectangle with these axes and radii, and its points carry the section's area. So the
integrations and remedies of warpfea.elements.ancf_beam are those of a rectangle; outlines are for faces and drawing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..base.checks import check_positive, float_array
from ..base.errors import ModelError
from .outlines import Cell, checked_outline, disc_cells, polygon_area, polygon_cells, torsion_constant

__all__ = ["BeamSection", "Circle", "Rectangle", "Section", "Tube", "section_along"]

SAME_SHAPE = 1e-9
"""Relative difference of two shapes that counts as rounding."""
MAX_AREA_MISMATCH = 0.05
"""Largest difference of the areas of an outline without holes and of the weights, over the latter. A bound:
a circle by 12 chords lacks 4.5 %, and a round hole of 5 % takes 0.25 % of the torsion."""


class BeamSection:
    """Base of the sections.

    Attributes:
        width, height: sides, m, of the rectangle with the section's radii of gyration; the height lies along the
            beam's normal, turned by `angle`, rad, from the normal towards minus the width.
        area, polar: m^2; polar moment of area, m^4.
        shear, torsion_ratio: shear correction factor; torsion constant over polar moment.
        extents: least and second extent, m.
        cells: cells of the section, its wall first, in units of width and height; empty for a rectangle.
    """

    width: float
    height: float
    shear: float
    angle: float = 0.0
    area: float

    @property
    def polar(self) -> float:
        """Polar moment of area, m^4."""
        return self.area * (self.width**2 + self.height**2) / 12.0

    @property
    def torsion_ratio(self) -> float:
        """Torsion constant over polar moment."""
        return 1.0

    @property
    def extents(self) -> tuple[float, float]:
        """Least and second extent, m."""
        points = np.concatenate([c.corners for c in self.cells[0]]) * (self.width, self.height)
        low, high = sorted(np.ptp(points, axis=0).tolist())
        return low, high

    @property
    def cells(self) -> tuple[list[Cell], list[Cell], list[Cell]]:
        """Sides outward, inner sides, and cells of the ends, in units of width and height."""
        return [], [], []

    def sides_at(self, s: float) -> tuple[float, float]:
        """Width and height at s in [0, 1] along the beam, m."""
        return self.width, self.height

    def torsion_ratio_at(self, width: np.ndarray, height: np.ndarray) -> Any:
        """Torsion ratio of elements with sides (E,), m."""
        return self.torsion_ratio

    @property
    def area_ratio(self) -> float:
        """Area over width times height."""
        return self.area / (self.width * self.height)

    @property
    def shape(self) -> np.ndarray:
        """Numbers that two sections of one shape, of any size, have in common."""
        return np.array([self.area_ratio, self.torsion_ratio, self.angle])


@dataclass(frozen=True)
class Rectangle(BeamSection):
    """Rectangular section: width and height, m; the height lies along the beam's normal.

    The section of an element stays plane, hence too stiff in shear and torsion, where a real one warps;
    integration "tied" corrects both with the constants of beam theory.

    Args:
        width, height: sides of the rectangle, m.
        shear: shear correction factor; Reissner's 5/6 by default.
        torsion: torsion constant, m^4; Saint-Venant's by default.

    Raises:
        ModelError: a size or factor that is not positive and finite, or a torsion constant above the polar moment.
    """

    width: float
    height: float
    shear: float = 5.0 / 6.0
    torsion: float | None = None

    def __post_init__(self) -> None:
        given = {name: value for name, value in vars(self).items() if name != "torsion" or value is not None}
        check_positive("Rectangle", **given)
        _check_torsion(self)

    @property
    def area(self) -> float:  # type: ignore[override]
        """Area, m^2."""
        return self.width * self.height

    @property
    def extents(self) -> tuple[float, float]:
        """The sides, the smaller first, m."""
        low, high = sorted((self.width, self.height))
        return low, high

    @property
    def torsion_ratio(self) -> float:
        """Torsion constant over polar moment."""
        if self.torsion is not None:
            return self.torsion / self.polar
        b, a = sorted((self.width, self.height))  # Timoshenko and Goodier, Theory of Elasticity, 109
        odd = np.arange(1, 60, 2)
        series = float(np.sum(np.tanh(odd * np.pi * a / (2.0 * b)) / odd**5))
        return a * b**3 / 3.0 * (1.0 - 192.0 * b / (np.pi**5 * a) * series) / self.polar

    @property
    def shape(self) -> np.ndarray:
        """A given torsion constant; else rectangles of any sides are of one shape."""
        return np.array([0.0 if self.torsion is None else self.torsion_ratio])


@dataclass(frozen=True)
class Circle(BeamSection):
    """Circular section.

    Args:
        r: radius, m.
        shear: shear correction factor; 6/7 by default (Cowper 1966, J. Appl. Mech. 33:335, nu = 0).

    Raises:
        ModelError: a radius or factor that is not positive and finite.
    """

    r: float
    shear: float = 6.0 / 7.0

    def __post_init__(self) -> None:
        check_positive("Circle", **vars(self))

    @property
    def area(self) -> float:  # type: ignore[override]
        """Area, m^2."""
        return math.pi * self.r**2

    @property
    def width(self) -> float:  # type: ignore[override]
        """Side of the square with the same radii of gyration, m."""
        return math.sqrt(3.0) * self.r

    height = width

    @property
    def cells(self) -> tuple[list[Cell], list[Cell], list[Cell]]:
        """See BeamSection."""
        return disc_cells(self.r / self.width, 0.0)


@dataclass(frozen=True)
class Tube(BeamSection):
    """Circular hollow section.

    Args:
        r: outer radius, m.
        thickness: of the wall, m, below r.
        shear: shear correction factor; None: Cowper's for nu = 0, from 6/7 (no bore) to 1/2 (a thin wall).

    Raises:
        ModelError: a size or factor that is not positive and finite, or a wall as thick as the radius.
    """

    r: float
    thickness: float
    shear: float = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        check_positive("Tube", r=self.r, thickness=self.thickness)
        if not self.thickness < self.r:
            raise ModelError(f"Tube: thickness = {self.thickness!r} must be below the radius r = {self.r!r}; "
                             "a section without a bore is a Circle")  # fmt: skip
        if self.shear is None:
            m = (self.bore / self.r) ** 2
            object.__setattr__(self, "shear", 6.0 * (1.0 + m) ** 2 / (7.0 * (1.0 + m) ** 2 + 20.0 * m))
        check_positive("Tube", shear=self.shear)

    @property
    def bore(self) -> float:
        """Inner radius, m."""
        return self.r - self.thickness

    @property
    def area(self) -> float:  # type: ignore[override]
        """Area, m^2."""
        return math.pi * (self.r + self.bore) * self.thickness

    @property
    def width(self) -> float:  # type: ignore[override]
        """Side of the square with the same radii of gyration, m."""
        return math.sqrt(3.0 * (self.r**2 + self.bore**2))

    height = width

    @property
    def cells(self) -> tuple[list[Cell], list[Cell], list[Cell]]:
        """See BeamSection."""
        return disc_cells(self.r / self.width, self.bore / self.width)


@dataclass(frozen=True, eq=False)
class Section(BeamSection):
    """A section of any shape, by points that carry its area; the beam's axis passes through their centroid.

    Args:
        points: (n, 2) coordinates along width and height (the beam's normal), m, of any origin. The four Gauss points
            of a rectangle stand for it.
        weights: (n,) areas of the points, m^2.
        outline: (k, 2) vertices of the outer edge in the same coordinates, in order, for faces, contact and pictures;
            None: the rectangle with the section's radii of gyration.
        torsion: torsion constant, m^4; None: that of the outline by Saint-Venant's theory (Prandtl's stress function
            in quadratic elements), of a section without holes.
        shear: shear correction factor for both directions.

    Raises:
        ModelError: weights that are not positive, points on a line, an outline that crosses itself or whose area is
            not that of the weights where its torsion is asked for, a torsion constant above the polar moment.
    """

    points: Any
    weights: Any
    outline: Any = None
    torsion: float | None = None
    shear: float = 5.0 / 6.0
    area: float = field(init=False, default=0.0)
    width: float = field(init=False, default=0.0)
    height: float = field(init=False, default=0.0)
    angle: float = field(init=False, default=0.0)
    polygon: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        x, w = float_array(self.points), float_array(self.weights)
        if x.ndim != 2 or x.shape[1] != 2 or not np.all(np.isfinite(x)):
            raise ModelError(f"Section: points must be finite, of shape (n, 2), m, got shape {x.shape}")
        if w.shape != (len(x),) or not np.all(np.isfinite(w) & (w > 0.0)):
            raise ModelError(
                f"Section: weights must be {len(x)} positive areas of the points, m^2, got {self.weights!r}"
            )
        check_positive("Section", shear=self.shear, **({} if self.torsion is None else {"torsion": self.torsion}))
        area, center = float(w.sum()), w @ x / w.sum()
        x = x - center
        second = np.einsum("n,ni,nj->ij", w, x, x) / area
        if not np.linalg.eigvalsh(second)[0] > 1e-12 * np.trace(second):
            raise ModelError("Section: the points lie on a line; give points across the section in both directions")
        gap = second[1, 1] - second[0, 0]
        skew = abs(second[0, 1]) > 1e-12 * np.trace(second)
        angle = 0.0 if not skew else 0.5 * math.atan(-2.0 * second[0, 1] / gap) if gap else math.pi / 4.0
        turn = np.array([(math.cos(angle), math.sin(angle)), (-math.sin(angle), math.cos(angle))])
        width, height = np.sqrt(12.0 * np.diag(turn @ second @ turn.T)).tolist()
        sides = 0.5 * np.array([(-width, -height), (width, -height), (width, height), (-width, height)])
        polygon = sides if self.outline is None else checked_outline(self.outline, center) @ turn.T
        for name, value in {"points": x, "weights": w, "area": area, "width": width, "height": height, "angle": angle,
                            "polygon": polygon}.items():  # fmt: skip
            object.__setattr__(self, name, value)
        if self.torsion is None and self.outline is not None:
            outer = polygon_area(polygon)
            if abs(outer - area) > MAX_AREA_MISMATCH * area:
                raise ModelError(
                    f"Section: the outline has {outer:.4g} m^2, the weights sum to {area:.4g} m^2: give torsion= of a "
                    "section with holes, or weights that cover the outline"
                )
            object.__setattr__(self, "torsion", torsion_constant(polygon))
        _check_torsion(self)

    @property
    def torsion_ratio(self) -> float:
        """Torsion constant over polar moment."""
        return Rectangle(self.width, self.height).torsion_ratio if self.torsion is None else self.torsion / self.polar

    @property
    def cells(self) -> tuple[list[Cell], list[Cell], list[Cell]]:
        """See BeamSection."""
        return polygon_cells(self.polygon / (self.width, self.height))

    @property
    def shape(self) -> np.ndarray:
        """See BeamSection."""
        return np.append(super().shape, (self.polygon / (self.width, self.height)).ravel())


class Taper(BeamSection):
    """A section that passes linearly from one to another of its shape along the beam; extents are the larger ones."""

    def __init__(self, first: BeamSection, last: BeamSection) -> None:
        self.first, self.last = first, last
        self.shear, self.angle = first.shear, first.angle

    def __repr__(self) -> str:
        return f"({self.first!r}, {self.last!r})"

    @property
    def extents(self) -> tuple[float, float]:
        """Least and second extent, m."""
        return max(self.first.extents, self.last.extents)

    @property
    def cells(self) -> tuple[list[Cell], list[Cell], list[Cell]]:
        """See BeamSection."""
        return self.first.cells

    @property
    def area_ratio(self) -> float:
        """See BeamSection."""
        return self.first.area_ratio

    def sides_at(self, s: float) -> tuple[float, float]:
        """See BeamSection."""
        a, b = self.first, self.last
        return (1.0 - s) * a.width + s * b.width, (1.0 - s) * a.height + s * b.height

    def torsion_ratio_at(self, width: np.ndarray, height: np.ndarray) -> Any:
        """See BeamSection."""
        if isinstance(self.first, Rectangle) and self.first.torsion is None:
            return np.array([Rectangle(*sides).torsion_ratio for sides in np.column_stack([width, height]).tolist()])
        return self.first.torsion_ratio


def section_along(what: str, section: Any) -> BeamSection:
    """A section, or the taper between two. ModelError for anything else, or two of different shapes."""
    if isinstance(section, BeamSection):
        return section
    pair = tuple(section) if isinstance(section, (tuple, list)) else ()
    if len(pair) != 2 or not all(isinstance(end, BeamSection) for end in pair):
        raise ModelError(
            f"{what}: section must be a Rectangle, Circle, Tube or Section, or two of them, got {section!r}"
        )
    first, last = pair
    shapes = first.shape, last.shape
    same = type(first) is type(last) and len(shapes[0]) == len(shapes[1]) and first.shear == last.shear
    if not same or np.abs(shapes[0] - shapes[1]).max() > SAME_SHAPE * np.abs(shapes[0]).max():
        raise ModelError(
            f"{what}: the two sections {first!r} and {last!r} must be of one shape at two sizes (rectangles of any "
            "sides; tubes of one thickness / r), with one shear factor"
        )
    return Taper(first, last)


def _check_torsion(section: BeamSection) -> None:
    if section.torsion_ratio > 1.0 + 1e-12:
        raise ModelError(
            f"{type(section).__name__}: torsion = {section.torsion!r} is above the polar moment "  # type: ignore[attr-defined]
            f"{section.polar:.4g} m^4"
        )
