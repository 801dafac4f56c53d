"""`warpfea study`: the studies of the registry."""

from __future__ import annotations

import argparse
import contextlib

from ..studies.registry import STUDIES
from . import DONE

__all__ = ["study"]


def study(options: argparse.Namespace) -> int:
    """Do `warpfea study STUDY`."""
    with contextlib.redirect_stdout(None) if options.quiet else contextlib.nullcontext():
        STUDIES[options.study].run(options)
    return DONE
