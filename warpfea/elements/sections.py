"""Cross-sections of beams."""

from dataclasses import dataclass

import numpy as np

from ..base.checks import check_positive
from ..base.errors import ModelError

__all__ = ["Rectangle"]


@dataclass(frozen=True)
class Rectangle:
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
        if self.torsion_ratio > 1.0 + 1e-12:
            raise ModelError(f"Rectangle: torsion = {self.torsion!r} is above the polar moment {self.polar:.4g} m^4")

    @property
    def area(self) -> float:
        """Area, m^2."""
        return self.width * self.height

    @property
    def polar(self) -> float:
        """Polar moment of area, m^4."""
        return self.area * (self.width**2 + self.height**2) / 12.0

    @property
    def torsion_ratio(self) -> float:
        """Torsion constant over polar moment."""
        if self.torsion is not None:
            return self.torsion / self.polar
        b, a = sorted((self.width, self.height))  # Timoshenko and Goodier, Theory of Elasticity, 109
        odd = np.arange(1, 60, 2)
        series = float(np.sum(np.tanh(odd * np.pi * a / (2.0 * b)) / odd**5))
        return a * b**3 / 3.0 * (1.0 - 192.0 * b / (np.pi**5 * a) * series) / self.polar
