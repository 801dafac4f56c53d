"""`warpfea study ancf`: the ANCF elements against references that were not made with warpfea.

The references are copies under tests/data (their `source` says where they come from). Every row names the integration;
"tied" is the default. tests/results/ancf_reference.json is the committed result.
"""

from __future__ import annotations

import argparse

from ..parts import Part, run_parts
from .bending import princeton, rollup, slender, static_beam, static_shell
from .manufactured import manufactured, manufactured_structures
from .vibration import frequencies, pendulum

__all__ = [
    "PARTS",
    "frequencies",
    "manufactured",
    "manufactured_structures",
    "pendulum",
    "princeton",
    "rollup",
    "run",
    "slender",
    "static_beam",
    "static_shell",
]

PARTS: dict[str, Part] = {
    f.__name__: f
    for f in (
        static_beam,
        static_shell,
        rollup,
        princeton,
        frequencies,
        pendulum,
        slender,
        manufactured,
        manufactured_structures,
    )
}


def run(options: argparse.Namespace) -> None:
    """Do `warpfea study ancf`."""
    run_parts(options, PARTS)
