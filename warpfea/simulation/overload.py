"""Hint for implausibly large loads (nominal stress over E) in error messages."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..model.assembly import element_volumes
from ..model.contact_points import effective_modulus

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["overload_text"]

MIN_OVERLOAD_RATIO = 0.3
"""Smallest reported nominal stress over E."""


def overload_text(model: Model) -> str:
    """Load with the largest nominal stress over E of its body, if above MIN_OVERLOAD_RATIO; else "".

    Nominal stress: the value of a traction or pressure; force over the mean section (volume over longest side) for a
    point load; density times g times the longest side for gravity.
    """
    found = [(0.0, "", 0.0, "", "")]
    d = model.description
    for load in d.dead_loads:
        if load.name == "traction":
            found.append(_load_entry(load.body, "traction", _largest_value(load.law), _largest_value(load.law), "Pa"))
        else:
            side = float(np.ptp(load.body.mesh.bounding_box(), axis=0).max())
            section = float(element_volumes(load.body).sum()) / side
            found.append(
                _load_entry(load.body, load.name, _largest_value(load.law), _largest_value(load.law) / section, "N")
            )
    for pressure in d.pressures:
        found.append(
            _load_entry(
                pressure.surface.body, "pressure", _largest_value(pressure.law), _largest_value(pressure.law), "Pa"
            )
        )
    g = float(np.linalg.norm(model.terms.dead_loads.gravity.numpy(), axis=1).max())
    for body in model.bodies if g > 0.0 else ():
        side = float(np.ptp(body.mesh.bounding_box(), axis=0).max())
        weight = model.masses.total_of_body(body) / float(element_volumes(body).sum()) * g * side
        found.append(_load_entry(body, "weight", weight, weight, "Pa"))
    ratio, what, value, unit, name = max(found)
    if ratio < MIN_OVERLOAD_RATIO:
        return ""
    E = max(effective_modulus(body)[0] for body in model.bodies if body.name == name)
    nominal = "" if unit == "Pa" else ", as a stress,"
    return (
        f"; the {what} of {value:.3g} {unit} on body {name!r}{nominal} is {ratio:.3g} times E = {E:.3g} Pa: check the "
        "units of load and E"
    )


def _load_entry(body: Any, what: str, value: float, stress: float, unit: str) -> tuple[float, str, float, str, str]:
    return stress / effective_modulus(body)[0], what, value, unit, body.name


def _largest_value(law: Any) -> float:
    """Largest value of a time law, 0 for a function of time or a control."""
    return float(np.linalg.norm(law.values, axis=1).max()) if len(law.times) else 0.0
