"""Short reprs of objects that hold arrays."""

import dataclasses
import textwrap
from typing import Any

import numpy as np

__all__ = ["MAX_ITEMS", "short_repr", "truncated_lines", "use_short_repr"]

MAX_WIDTH, MAX_LINES = 118, 5
"""Maximum characters of a line and lines of a repr."""
MAX_ITEMS = 4
"""Maximum number of array items shown."""
MAX_TEXT = 60
"""Maximum characters of a value."""


def short_repr(value: Any) -> str:
    """Short text of a value: for arrays of more than 4 items the shape and the range."""
    if isinstance(value, np.ndarray):
        return _array_text(value)
    if isinstance(value, (tuple, list)) and any(isinstance(item, np.ndarray) for item in value):
        return f"({', '.join(map(short_repr, value))})"
    if callable(value) and not isinstance(value, type) and hasattr(value, "__name__"):
        return f"{value.__name__}()"
    return textwrap.shorten(repr(value), MAX_TEXT, placeholder=" ...")


def _array_text(a: np.ndarray) -> str:
    if a.size == 1:
        return _number_text(a.ravel()[0])
    if a.size <= MAX_ITEMS and a.ndim == 1:
        return f"[{', '.join(map(_number_text, a))}]"
    if a.dtype == bool:
        return f"{int(a.sum())} of {a.size} true"
    shape = "x".join(map(str, a.shape))
    known = a[np.isfinite(a)] if a.dtype.kind in "fiu" else a[:0]
    if not known.size:
        return f"array {shape}"
    low, high = _number_text(known.min()), _number_text(known.max())
    return f"array {shape}, {f'all {low}' if low == high else f'{low} to {high}'}"


def _number_text(x: Any) -> str:
    return f"{x:.4g}" if isinstance(x, (float, np.floating)) else str(x)


def truncated_lines(text: str) -> str:
    """Text truncated to five lines."""
    out = textwrap.wrap(text, MAX_WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)
    return "\n".join(out if len(out) <= MAX_LINES else [*out[: MAX_LINES - 1], "    ..."])


def use_short_repr(self: Any) -> str:
    """Repr of a dataclass without the fields that are None."""
    values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.repr}
    shown = ", ".join(f"{name}={short_repr(value)}" for name, value in values.items() if value is not None)
    return truncated_lines(f"{type(self).__name__}({shown})")
