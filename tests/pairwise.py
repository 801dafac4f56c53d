"""Tables of parameters of which every pair of values is tried at once, and the rest of the product is slow."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import pytest

__all__ = ["covering", "on_devices"]


def covering(*axes: Sequence[Any], strength: int = 2) -> list[Any]:
    """The product of axes as cases; those that a covering array of this strength leaves out are marked slow.

    A greedy choice: each next case is the first of those that bring most new combinations. With a strength of 1 every
    value is tried once.

    Args:
        axes: values of each parameter.
        strength: how many parameters are combined fully.
    """
    cases = list(itertools.product(*axes))
    groups = list(itertools.combinations(range(len(axes)), strength))
    covers = [{(g, *(repr(case[k]) for k in g)) for g in groups} for case in cases]
    left = set().union(*covers)
    chosen = set()
    while left:
        best = max(range(len(cases)), key=lambda k: (len(covers[k] & left), -k))
        chosen.add(best)
        left -= covers[best]
    return [pytest.param(*case, marks=[] if k in chosen else [pytest.mark.slow]) for k, case in enumerate(cases)]


def on_devices(*axes: Sequence[Any], strength: int = 2, cuda: Sequence[Sequence[Any]] | None = None) -> list[Any]:
    """Cases with a device before them: those of `covering` on the CPU, the product of axes, or of `cuda`, on a GPU."""
    on_gpu = [pytest.param("cuda", *case, marks=pytest.mark.cuda) for case in itertools.product(*(cuda or axes))]
    return covering(["cpu"], *axes, strength=strength) + on_gpu
