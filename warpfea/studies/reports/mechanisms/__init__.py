"""`warpfea study mechanisms`: joints and constraints against mechanisms that were computed without warpfea.

The references are the models of rigid.py and rod.py, and closed forms. All options of the solver are the defaults
unless a row names others. tests/results/mechanisms.json is the committed result.
"""

from __future__ import annotations

import argparse
import pathlib

from ..parts import Part, check_out, run_parts
from .chain import hanging_chain
from .drift import no_drift, swing
from .fall import OUTER, TIES, fall_of_a_pair, free_fall
from .pendulum import double_pendulum
from .slider_crank import flexible_slider_crank, rigid_slider_crank

__all__ = [
    "OUTER",
    "PARTS",
    "TIES",
    "double_pendulum",
    "fall_of_a_pair",
    "flexible_slider_crank",
    "free_fall",
    "hanging_chain",
    "no_drift",
    "rigid_slider_crank",
    "run",
    "swing",
]

PARTS: dict[str, Part] = {
    f.__name__: f
    for f in (rigid_slider_crank, flexible_slider_crank, double_pendulum, hanging_chain, free_fall, no_drift)
}


def run(options: argparse.Namespace) -> None:
    """Do `warpfea study mechanisms`; no_drift keeps a checkpoint beside the result, and goes on from it."""
    more = {}
    if options.out is not None:
        check_out(options)
        more["no_drift"] = {"checkpoint": pathlib.Path(options.out).with_suffix(".no_drift.npz")}
    run_parts(options, PARTS, **more)
