"""Validation of solver options."""

import math
import re
from typing import Any

import numpy as np

from .errors import ModelError

__all__ = [
    "check_positive", "finite_number", "float_array", "is_count", "is_number", "number_hint", "number_pair",
]  # fmt: skip

UNIT_FACTORS = {
    **dict.fromkeys(("", "s", "m", "Pa", "N", "kg", "kg/m^3", "kg/m3"), 1.0),
    **dict.fromkeys(("ms", "mm"), 1e-3),
    **dict.fromkeys(("us", "um"), 1e-6),
    **dict.fromkeys(("kPa", "kN", "g/cm^3", "g/cm3"), 1e3),
    **{"cm": 1e-2, "MPa": 1e6, "GPa": 1e9},
}
"""Factors to SI units of the units that users write after numbers."""


def is_number(value: Any) -> bool:
    """A finite number, which a float can hold."""
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    try:
        return number and math.isfinite(value)
    except OverflowError:
        return False


def is_count(value: Any) -> bool:
    """A whole number."""
    return is_number(value) and value == int(value)


def check_positive(owner: str, **values: Any) -> None:
    """ModelError for a value that is no positive finite number."""
    for name, value in values.items():
        if not (is_number(value) and value > 0.0):
            raise ModelError(f"{owner}: {name} = {value!r} must be a positive finite number{number_hint(value)}")


def finite_number(value: Any) -> float:
    """A finite number, also from its text; nan for anything else."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return math.nan
    return number if math.isfinite(number) else math.nan


def float_array(values: Any) -> np.ndarray:
    """A copy of numbers of any shape; (1, 1) of nan for anything else."""
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError):
        return np.full((1, 1), np.nan)


def number_pair(values: Any) -> tuple[float, float]:
    """Two numbers; nan for anything else."""
    try:
        first, second = map(float, values)
    except (TypeError, ValueError):
        return math.nan, math.nan
    return first, second


def number_hint(value: Any) -> str:
    """The text "; write 0.005, a bare number in SI units" for a text such as "5 ms", else nothing."""
    found = re.fullmatch(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(\D.*)?", value) if isinstance(value, str) else None
    factor = UNIT_FACTORS.get((found[2] or "").strip()) if found else None
    if found is None or factor is None:
        return ""
    try:
        number = float(found[1]) * factor
    except ValueError:
        return ""
    short = f"{number:g}" if float(f"{number:g}") == number else f"{number:.12g}"
    return f"; write {short}, a bare number in SI units"
