"""What an integrator is: how q~ and v~ follow from the state, and what a step then solves."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

__all__ = ["Integrator"]


@dataclass(frozen=True)
class Integrator:
    """A time discretisation, see the folder's docstring for the step that it stands for.

    Attributes:
        name: how users select it.
        coefficients: wp.func (h, previous h, parameter) -> `Coefficients` (kernels/step/control.py).
        order: order of convergence in h.
        multistep: keeps the state before the last, q_{n-1} and v_{n-1}.
        takes_velocity: q~ takes v_n.
        midpoint: forces are those of the middle of the step, and conserve energy and momenta.
        static: no inertia; v is the displacement increment of a load step.
        parameter: the number that `coefficients` gets, such as a spectral radius.
        stabilise: N/m per kg, of statics: springs from the last equilibrium to the next, fading with the load.
    """

    name: str
    coefficients: Any
    order: int
    multistep: bool = False
    takes_velocity: bool = False
    midpoint: bool = False
    static: bool = False
    # kernels don't depend on these
    parameter: float = field(default=0.0, compare=False)
    stabilise: float = field(default=0.0, compare=False)

    @property
    def variant(self) -> str:
        """Name of its kernels."""
        flags = [name for name in ("multistep", "takes_velocity", "midpoint", "static") if getattr(self, name)]
        return "_".join([self.coefficients.key, *flags])
