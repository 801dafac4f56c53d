"""Time discretisations. Each is a small object: how q depends on v, and what the inertia term is.

With q~ = a0 q_n - a1 q_{n-1} and v~ likewise, a step solves for v in

    M (v - v~) / (beta h) + f_int(q~ + beta h v, v) = f(t_{n+1}),      q_{n+1} = q~ + beta h v.

Backward Euler is (a0, a1, beta) = (1, 0, 1), which is Eq. (17).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from ..base.errors import ModelError
from ..base.names import did_you_mean

__all__ = ["INTEGRATORS", "Integrator", "get"]


@wp.func
def backward_euler(h: wp.float64, previous: wp.float64) -> wp.vec3d:
    """Coefficients of backward Euler."""
    return wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(1.0))


@wp.func
def bdf2(h: wp.float64, previous: wp.float64) -> wp.vec3d:
    """Coefficients of BDF2 for the step h after a step `previous`; backward Euler where there is none before."""
    one = wp.float64(1.0)
    if previous <= wp.float64(0.0):
        return wp.vec3d(one, wp.float64(0.0), one)
    w = h / previous
    d = one + wp.float64(2.0) * w
    return wp.vec3d((one + w) * (one + w) / d, w * w / d, (one + w) / d)


@dataclass(frozen=True)
class Integrator:
    """A time discretisation.

    Attributes:
        name: how users select it.
        coefficients: wp.func (h, previous h) -> (a0, a1, beta).
        multistep: keeps the state before the last.
        static: no inertia; v is the displacement increment of a load step.
        order: order of convergence in h.
        stabilise: N/m per kg, of statics: springs from the last equilibrium to the next, fading with the load.
    """

    name: str
    coefficients: Any
    multistep: bool
    static: bool
    order: int
    stabilise: float = 0.0


INTEGRATORS = {
    "backward_euler": Integrator("backward_euler", backward_euler, False, False, 1),
    "bdf2": Integrator("bdf2", bdf2, True, False, 2),
    "static": Integrator("static", backward_euler, False, True, 0),
}


def get(name: str | Integrator) -> Integrator:
    """The integrator `name`, or the one that is given. Raises ModelError listing the names."""
    if isinstance(name, Integrator):
        return name
    if name == "energy_momentum":
        raise NotImplementedError("integrator 'energy_momentum' is not part of this version")
    if name not in INTEGRATORS or name == "static":
        names = [n for n in INTEGRATORS if n != "static"]
        raise ModelError(f"integrator {name!r} is unknown; there are {', '.join(names)}{did_you_mean(name, names)}")
    return INTEGRATORS[name]
