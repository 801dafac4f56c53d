"""Compile and load the modules of a step."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from functools import partial
from typing import Any

import warp as wp

from ..base.errors import ModelError

__all__ = ["OnCompile", "load_modules"]

OnCompile = Callable[[int, int, str], None]


def load_modules(modules: dict[str, wp.Module], device: Any, on_compile: OnCompile | None) -> None:
    """Compile modules by name on several threads; loaded ones are free. `on_compile(done, total, name)` is called for
    each.

    Raises:
        ModelError: a user's function that Warp can't compile.
    """
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 4)) as pool:
        load = partial(wp.force_load, device, max_workers=0)
        waiting = {pool.submit(load, [module]): name for name, module in modules.items()}
        for done, future in enumerate(as_completed(waiting)):
            _raise_compile_error(future, waiting[future])
            if on_compile:
                on_compile(done + 1, len(waiting), waiting[future])


def _raise_compile_error(future: Future[Any], name: str) -> None:
    """Re-raise compilation errors; those of a user's function as ModelError."""
    try:
        future.result()
    except Exception as error:
        if ".law_" in name or ".field_" in name:
            reason = str(error).strip().splitlines()[-1]
            raise ModelError(
                f"Warp can't compile a wp.func given as a time law or field ({name.rpartition('.')[2]}): {reason}; "
                "write it in the precision of its annotations, such as def f(t: wp.float64) -> wp.float64: return "
                "wp.float64(2.0) * t"
            ) from error
        raise
