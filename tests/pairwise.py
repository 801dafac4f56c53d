"""Tables of parameters of which every pair of values is tried at once, and the rest of the product is slow."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import pytest

from warpfea.studies.stress.build import covering_array

__all__ = ["covering", "on_devices"]


def covering(*axes: Sequence[Any], strength: int = 2) -> list[Any]:
    """The product of axes as cases; those that a covering array of this strength leaves out are marked slow.

    A greedy choice: each next case is the first of those that bring most new combinations. With a strength of 1 every
    value is tried once.

    Args:
        axes: values of each parameter.
        strength: how many parameters are combined fully.
    """
    chosen = {repr(case) for case in covering_array(*axes, strength=strength)}
    marks = {True: [], False: [pytest.mark.slow]}
    return [pytest.param(*case, marks=marks[repr(case) in chosen]) for case in itertools.product(*axes)]


def on_devices(*axes: Sequence[Any], strength: int = 2, cuda: Sequence[Sequence[Any]] | None = None) -> list[Any]:
    """Cases with a device before them: those of `covering` on the CPU, the product of axes, or of `cuda`, on a GPU."""
    on_gpu = [pytest.param("cuda", *case, marks=pytest.mark.cuda) for case in itertools.product(*(cuda or axes))]
    return covering(["cpu"], *axes, strength=strength) + on_gpu
