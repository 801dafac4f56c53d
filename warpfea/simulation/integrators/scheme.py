"""Integrator definition: predictors q~, v~ and the step equation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from ...base.errors import ModelError

__all__ = ["DampedIntegrator", "Integrator"]


@dataclass(frozen=True)
class Integrator:
    """Time discretisation; see the folder's docstring for the step equation.

    Attributes:
        name: name for users.
        coefficients: wp.func (h, previous h, parameter) -> `Coefficients` (kernels/step/step_control.py).
        order: order of convergence in h.
        multistep: uses the state before the last, q_{n-1} and v_{n-1}.
        takes_velocity: q~ depends on v_n.
        midpoint: forces are those of the middle of the step, and conserve energy and momenta.
        accelerated: acceleration-level scheme, with algorithmic accelerations a_n and those of the equilibrium w_n;
            needs consistent initial values.
        error_weights: wp.func (h, previous h) -> vec3d, the weights (s) of v_{n+1}, v_n and v_{n-1}, of sum 0, that
            give the local error in position, m; None: no adaptive steps.
        static: no inertia; v is the displacement increment of a load step.
        parameter: argument of `coefficients`, such as a spectral radius.
        stabilise: N/m per kg, statics: springs from the last equilibrium to the next, fading with the load.
    """

    name: str
    coefficients: Any
    order: int
    multistep: bool = False
    takes_velocity: bool = False
    midpoint: bool = False
    accelerated: bool = False
    static: bool = False
    error_weights: Any = field(default=None, compare=False)  # follows from the coefficients
    # no kernel depends on these
    parameter: float = field(default=0.0, compare=False)
    stabilise: float = field(default=0.0, compare=False)

    @property
    def label(self) -> str:
        """Name with the options that affect results, in the form that users may give."""
        return self.name

    @property
    def dissipation(self) -> float:
        """chi of the dissipative mid-point scheme, see kernels/elements/energy_momentum.py; 0 for others."""
        return 0.0

    @property
    def history_arrays(self) -> tuple[str, str]:
        """State arrays besides q_n and v_n: those of the previous step, or accelerations."""
        if self.accelerated:
            return "algorithmic_acceleration", "acceleration"
        return ("previous_displacement", "previous_velocity") if self.multistep else ("displacement", "velocity")

    @property
    def kernel_variant(self) -> str:
        """Name of the variant of the kernels that it takes."""
        names = ("multistep", "takes_velocity", "midpoint", "accelerated", "static")
        flags = [name for name in names if getattr(self, name)]
        return "_".join([self.coefficients.key, *flags])


class DampedIntegrator(Integrator):
    """Integrator whose parameter is rho_inf, between 0 and 1; ModelError for another one."""

    def __init__(self, name: str, coefficients: Any, rho_inf: float, **flags: Any) -> None:
        known = isinstance(rho_inf, (int, float)) and not isinstance(rho_inf, bool)
        if not (known and math.isfinite(rho_inf) and 0.0 <= rho_inf <= 1.0):
            raise ModelError(f"{type(self).__name__}: rho_inf = {rho_inf!r} must lie between 0 and 1")
        super().__init__(name, coefficients, parameter=float(rho_inf), **flags)

    @property
    def rho_inf(self) -> float:
        """Spectral radius at infinite frequency: damping factor of motions unresolved by the step."""
        return self.parameter

    @property
    def label(self) -> str:
        return f"{self.name}(rho_inf={self.parameter!r})"

    def __repr__(self) -> str:
        return f"{type(self).__name__}(rho_inf={self.parameter!r})"
