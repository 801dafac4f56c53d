"""`warpfea stress`: the suite of stiff and extreme cases."""

from __future__ import annotations

import argparse

from . import DONE, NOT_CONVERGED

__all__ = ["stress"]


def stress(options: argparse.Namespace) -> int:
    """Run `warpfea stress`; 3 if a row fails its criterion."""
    from ..studies.stress import suite

    return DONE if suite.stress(options) else NOT_CONVERGED
