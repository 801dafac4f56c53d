"""What options of solvers may be."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

__all__ = ["is_count", "is_number"]


def is_number(value: Any) -> bool:
    """A finite number."""
    return (
        isinstance(value, (int, float, np.integer, np.floating))
        and not isinstance(value, bool)
        and math.isfinite(value)
    )


def is_count(value: Any) -> bool:
    """A whole number."""
    return is_number(value) and value == int(value)
