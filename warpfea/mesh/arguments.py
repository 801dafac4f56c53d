"""Checks of the generators' arguments; messages begin with ``what``, "<generator>: <argument>"."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..base.checks import float_array, is_number
from ..base.errors import MeshError
from ..base.names import did_you_mean
from .cells import ELEMENT_CELLS, Floats

__all__ = ["PointMap", "cell_counts", "cell_type_of", "check_even", "finite_numbers", "map_points", "positive_numbers"]

PointMap = Callable[[Floats], Any]
"""Positions X (n, 3) in m -> (n, 3) in m."""


def _number_array(what: str, values: Any, count: int) -> Floats:
    array = float_array(values)
    if array.shape != (count,):
        hint = f"; write {(values,) * count!r}" if np.ndim(values) == 0 and is_number(values) else ""
        raise MeshError(f"{what}: expected {count} number{'s' if count > 1 else ''}, got {values!r}{hint}")
    return array


def finite_numbers(what: str, values: Any, count: int) -> Floats:
    """``count`` finite numbers, (count,)."""
    array = _number_array(what, values, count)
    if not np.isfinite(array).all():
        raise MeshError(f"{what} must be finite, got {values!r}")
    return array


def positive_numbers(what: str, values: Any, count: int) -> Floats:
    """``count`` positive numbers, (count,)."""
    array = finite_numbers(what, values, count)
    if not (array > 0.0).all():
        raise MeshError(f"{what} must be positive, got {array.tolist()}")
    return array


def cell_counts(what: str, values: Any, count: int) -> tuple[int, ...]:
    """``count`` whole numbers of at least 1."""
    array = _number_array(what, values, count)
    if not ((array >= 1) & (array == np.round(array))).all():
        raise MeshError(f"{what} must be integers of at least 1, got {values!r}")
    return tuple(int(v) for v in array)


def check_even(what: str, value: int) -> None:
    """Refuse an odd number."""
    if value % 2:
        raise MeshError(f"{what} must be an even number, got {value}")


def cell_type_of(what: str, element: Any) -> str:
    """The cell type of an element of :data:`ELEMENT_CELLS`."""
    if not isinstance(element, str) or element not in ELEMENT_CELLS:
        hint = did_you_mean(element, ELEMENT_CELLS)
        raise MeshError(f"{what}: unknown element {element!r}, known are {', '.join(ELEMENT_CELLS)}{hint}")
    return ELEMENT_CELLS[element]


def map_points(what: str, points: Floats, function: PointMap | None) -> Floats:
    """``function`` of the points (n, 3), or the points themselves if it is None.

    Raises
    ------
    MeshError
        Not a function, another shape, or values that are not finite.
    """
    if function is None:
        return points
    if not callable(function):
        raise MeshError(f"{what} must be a function X (n, 3) -> (n, 3), got {type(function).__name__}")
    values = function(points.copy())
    out = float_array(values)
    if out.shape != points.shape:
        raise MeshError(f"{what} must return numbers of shape {points.shape}, got shape {np.shape(values)}")
    bad = np.flatnonzero(~np.isfinite(out).all(axis=1))
    if bad.size:
        raise MeshError(f"{what} makes {out[bad[0]].tolist()} of the point {points[bad[0]].tolist()}: not finite")
    return out
