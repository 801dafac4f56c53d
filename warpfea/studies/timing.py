"""Repeated runs, for their times."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

__all__ = ["NOT_REPEATED", "repeated"]

T = TypeVar("T")
NOT_REPEATED = 2.0
"""s; a run that takes longer is done once."""


def repeated(run: Callable[[], T], seconds: Callable[[T], float], repeat: int) -> list[T]:
    """What `run` gives, up to `repeat` times; after a run of more than NOT_REPEATED seconds no more."""
    out = [run()]
    while len(out) < repeat and seconds(out[-1]) <= NOT_REPEATED:
        out.append(run())
    return out
