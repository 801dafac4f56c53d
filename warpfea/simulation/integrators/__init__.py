"""Time discretisations, one file each: small objects that say how q depends on v, and what the inertia term is.

With q~ = a0 q_n - a1 q_{n-1} + b v_n and v~ = a0 v_n - a1 v_{n-1}, a step solves for v in

    m M (v - v~) + f_int(q, v) = f(t_{n+1}),      q_{n+1} = q~ + d v,      d = dq/dv, m the mass factor.

Backward Euler is (a0, a1, b, d, m) = (1, 0, 0, h, 1/h), which is Eq. (17).
"""

from __future__ import annotations

from ...base.errors import ModelError
from ...base.names import did_you_mean
from .backward_euler import BACKWARD_EULER, STATIC
from .bdf2 import BDF2
from .energy_momentum import ENERGY_MOMENTUM
from .scheme import Integrator

__all__ = ["INTEGRATORS", "Integrator", "get"]

INTEGRATORS = {scheme.name: scheme for scheme in (BACKWARD_EULER, BDF2, ENERGY_MOMENTUM, STATIC)}


def get(name: str | Integrator) -> Integrator:
    """The integrator `name`, or the one that is given. Raises ModelError listing the names."""
    if isinstance(name, Integrator):
        return name
    if name not in INTEGRATORS or name == "static":
        names = [n for n in INTEGRATORS if n != "static"]
        raise ModelError(f"integrator {name!r} is unknown; there are {', '.join(names)}{did_you_mean(name, names)}")
    return INTEGRATORS[name]
