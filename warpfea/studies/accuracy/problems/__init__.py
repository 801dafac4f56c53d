"""Scenes made for `warpfea study`, with motions that are known: the module NAME holds the scene NAME.

Each is imported when it is asked for; `warpfea run NAME` runs it too.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

from ....builder.scene import Scene

__all__ = ["find_problem", "problem_names"]


def problem_names() -> list[str]:
    """Names of the problems. Imports none of them."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def find_problem(name: str) -> Scene[Any]:
    """The problem of a name that `problem_names` gives."""
    found = getattr(importlib.import_module(f"{__name__}.{name}"), name)
    assert isinstance(found, Scene)
    return found
