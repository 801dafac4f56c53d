"""Options of pictures: what is drawn beside the surfaces, and from where."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..base.checks import is_number, number_pair
from ..base.errors import ModelError
from ..base.names import check_known
from .colormap import hex_tables
from .markers import KINDS

__all__ = ["Look"]


@dataclass(eq=False, repr=False, kw_only=True)
class Look:
    """Options common to pictures of a run and of a file.

    Args:
        ground: True draws a ground at the lowest point, False none; None: where a horizontal half-space is.
        marks: kinds of marks drawn: "support", "joint", "spring", "load", "probe".
        axes: draw a triad of the axes. edges: draw the edges of elements. undeformed: draw the shape at rest, too, seen
            through.
        scale: factor of the displacements drawn. extremes: write the least and the largest value where they are.
        legend: write the names of bodies; without a field each has its colour.
        hide: names of bodies and colliders that are not drawn. opacity: of some by name, 0 to 1, such as {"case": 0.3}.
        collider_grid: draw colliders with a grid that moves with them.
        colors: colour map: "viridis", "cividis", or "coolwarm", whose low end is light enough to show form.
        target: (x, y, z) in the middle of the picture, m; zoom: 2 is twice as near. follow: name of a body kept in the
            middle.
        cut: ("+y", 0.01) leaves out what lies beyond y = 0.01 m, "-y" what lies before.
        percentile: (low, high) of the values, percent, as range of the colours in place of their extremes.
        range_body: name of the body whose values give the range.
    """

    ground: bool | None = None
    marks: Sequence[str] = ("support", "joint", "spring")
    axes: bool = False
    edges: bool = False
    undeformed: bool = False
    scale: float = 1.0
    extremes: bool = False
    legend: bool = False
    hide: Sequence[str] = ()
    opacity: Mapping[str, float] = field(default_factory=dict)
    collider_grid: bool = False
    colors: str = "viridis"
    target: tuple[float, float, float] | None = None
    zoom: float = 1.0
    follow: str | None = None
    cut: tuple[str, float] | None = None
    percentile: tuple[float, float] | None = None
    range_body: str | None = None

    def check_look(self) -> None:
        """ModelError for an option out of range."""
        for name in ("zoom", "scale"):
            value = getattr(self, name)
            if not (is_number(value) and (value > 0 or name == "scale")):
                raise ModelError(f"{name} must be a finite number{' above 0' * (name == 'zoom')}, got {value!r}")
        self._check_lists()
        check_known("colors", self.colors, hex_tables())
        if self.target is not None and (np.shape(self.target) != (3,) or not np.isfinite(self.target).all()):
            raise ModelError(f"target must be three finite numbers, got {self.target!r}")
        if self.percentile is not None:
            low, high = number_pair(self.percentile)
            if not 0.0 <= low < high <= 100.0:
                raise ModelError(f"percentile must be two rising numbers from 0 to 100, got {self.percentile!r}")
        if self.cut is not None:
            self.cut_plane()

    def _check_lists(self) -> None:
        """ModelError for marks, hidden names or opacities that are none."""
        for name, what in (("marks", "kinds of marks, such as ('support',)"), ("hide", "names, such as ['case']")):
            given = getattr(self, name)
            if isinstance(given, str) or not isinstance(given, Iterable):
                raise ModelError(f"{name} must be {what}, got {given!r}")
        if not isinstance(self.opacity, Mapping):
            raise ModelError(f"opacity must be numbers by name, such as {{'case': 0.3}}, got {self.opacity!r}")
        for name, value in self.opacity.items():
            if not (is_number(value) and 0.0 <= value <= 1.0):
                raise ModelError(f"opacity of {name!r} must be a number from 0 to 1, got {value!r}")
        for kind in self.marks:
            check_known("marks", kind, KINDS)

    def cut_plane(self) -> Any:
        """(4,) direction and place of the section; x beyond it, direction . x > place, is left out."""
        assert self.cut is not None
        try:
            side, place = self.cut
            sign, axis = tuple(side)
            plane = np.zeros(4)
            plane["xyz".index(axis)] = {"+": 1.0, "-": -1.0}[sign]
            plane[3] = float(place) * plane[:3].sum()
        except (TypeError, ValueError, KeyError, IndexError):
            plane = np.full(4, np.nan)
        if not np.isfinite(plane).all():
            raise ModelError(f"cut must be a side and a place such as ('+y', 0.01), got {self.cut!r}")
        return plane

    def check_names(self, names: Sequence[str]) -> None:
        """ModelError for a body or collider that there is not."""
        for option, wanted in (
            ("hide", tuple(self.hide)),
            ("opacity", tuple(self.opacity)),
            ("follow", (self.follow,)),
            ("range_body", (self.range_body,)),
        ):
            for name in wanted:
                if name is not None:
                    check_known(option, name, names)
        if set(names) <= set(self.hide):
            raise ModelError(f"hide leaves nothing to draw of {', '.join(names)}")
