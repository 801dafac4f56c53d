"""Time discretisations, one file each: definitions of q(v) and of the inertia term.

With q~ = a0 q_n - a1 q_{n-1} + b v_n + q_a a_n and v~ = a0 v_n - a1 v_{n-1} + v_a a_n + v_w w_n (accelerations a_n and
w_n in acceleration-level schemes), a step solves for v in

    m M (v - v~) + f_int(q, v) = f(t_{n+1}),      q_{n+1} = q~ + d v,      d = dq/dv, m the mass factor.

Backward Euler is (a0, a1, b, d, m) = (1, 0, 0, h, 1/h), which is Eq. (17).
"""

from __future__ import annotations

import inspect
import re
from typing import Any

from ...base.errors import ModelError
from ...base.names import did_you_mean
from .backward_euler import BACKWARD_EULER, STATIC
from .bdf2 import BDF2
from .energy_momentum import EnergyMomentum
from .generalized_alpha import GeneralizedAlpha
from .scheme import Integrator

__all__ = ["INTEGRATORS", "EnergyMomentum", "GeneralizedAlpha", "Integrator", "find_integrator"]

SCHEMES = (BACKWARD_EULER, BDF2, EnergyMomentum(), GeneralizedAlpha(), STATIC)
INTEGRATORS = {scheme.name: scheme for scheme in SCHEMES}
NAME_WITH_OPTIONS = re.compile(r"(\w+)\s*\((.*)\)")
"""Pattern of a name with options."""


def find_integrator(name: str | Integrator) -> Integrator:
    """Integrator from an instance, a name, or a name with options: "generalized_alpha(rho_inf=0.8)".

    Raises:
        ModelError: an unknown name (the known ones are listed) or option.
    """
    if isinstance(name, Integrator):
        return name
    call = NAME_WITH_OPTIONS.fullmatch(name.strip()) if isinstance(name, str) else None
    word = call[1] if call else name.strip() if isinstance(name, str) else name
    if word not in INTEGRATORS or word == "static":
        names = [n for n in INTEGRATORS if n != "static"]
        hint = did_you_mean(word, names) if isinstance(word, str) else ""
        raise ModelError(f"integrator {name!r} is unknown; there are {', '.join(names)}{hint}")
    return _with_options(INTEGRATORS[word], name, call[2]) if call else INTEGRATORS[word]


def _with_options(scheme: Integrator, text: str, inside: str) -> Integrator:
    """Integrator of the same kind with the options of `name(option=number, ...)`."""
    kind: Any = type(scheme)
    known = list(inspect.signature(kind).parameters) if kind is not Integrator else []
    options: dict[str, float] = {}
    for part in filter(None, (part.strip() for part in inside.split(","))):
        key, equals, value = (word.strip() for word in part.partition("="))
        if key not in known:
            has = f"it has {', '.join(known)}{did_you_mean(key, known)}" if known else "it has none"
            raise ModelError(f"integrator {text!r}: {scheme.name} has no option {key!r}; {has}")
        try:
            options[key] = float(value)
        except ValueError:
            raise ModelError(f"integrator {text!r}: {key}={value} is not a number") from None
    return kind(**options) if known else scheme
