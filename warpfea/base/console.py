"""Shared console output of the commands: quiet Warp, progress bars, tables, JSON."""

import contextlib
import functools
import json
import math
import os
import pathlib
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import warp as wp

from .writer import write_atomically

__all__ = [
    "compile_progress_bar", "format_bytes", "format_number", "format_table", "progress_bar", "quiet_warp", "to_json",
    "write_json",
]  # fmt: skip

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


class quiet_warp:
    """Context without Warp's greeting and module lines; initialises Warp.

    Warnings and errors are shown, and everything if the user raised the verbosity (`wp.config.log_level` below
    LOG_INFO, or `wp.config.verbose`). The level is restored on exit.
    """

    def __enter__(self) -> None:
        self.before = wp.config.log_level
        asked = self.before < wp.LOG_INFO or bool(getattr(wp.config, "verbose", False))
        if not asked:
            wp.config.log_level = max(self.before, wp.LOG_WARNING)
        _init_warp()

    def __exit__(self, *_: object) -> None:
        wp.config.log_level = self.before


@functools.cache
def _init_warp() -> None:
    """wp.init; suppresses the native library's message (descriptor 2) about a missing CUDA driver."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as file:
        saved = os.dup(2)
        os.dup2(file.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
        file.seek(0)
        for line in file:
            if _NO_DRIVER not in line:
                os.write(2, line)


@contextlib.contextmanager
def progress_bar(label: str, unit: str, total: int | None = None, show: bool | None = None) -> Iterator[Any]:
    """tqdm bar on stderr; `show=None`: only if stderr is a terminal."""
    from tqdm import tqdm

    hide = None if show is None else not show
    with tqdm(desc=label, unit=unit, total=total, file=sys.stderr, disable=hide, leave=False) as bar:
        yield bar


@contextlib.contextmanager
def compile_progress_bar(show: bool | None) -> Iterator[Callable[[int, int, str], None]]:
    """Progress bar "compiling kernels" on stderr with the number of loaded modules; None: if stderr is a terminal."""
    if show is None:
        show = sys.stderr.isatty()
    if not show:
        yield lambda done, total, name: None
        return
    with progress_bar("compiling kernels", "module", show=True) as bar:

        def update(done: int, total: int, name: str) -> None:
            bar.total = total
            bar.set_postfix_str(name.removeprefix("warpfea.kernels."), refresh=False)
            bar.update(done - bar.n)

        yield update


def format_table(rows: Sequence[Sequence[str]], *, right: Sequence[int] = ()) -> str:
    """Rows in columns two spaces apart; the columns in `right` are right-aligned."""
    widths = [max(len(row[k]) for row in rows if k < len(row)) for k in range(max(map(len, rows)))]
    lines = []
    for row in rows:
        cells = [text.rjust(w) if k in right else text.ljust(w) for k, (text, w) in enumerate(zip(row, widths))]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def format_number(value: float, digits: int = 4) -> str:
    """Readable number."""
    return f"{value:.{digits}g}"


def format_bytes(count: int) -> str:
    """Readable size in bytes."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count} B"


def write_json(target: str, content: dict[str, Any]) -> None:
    """Write JSON to a file (atomically), or to stdout for "-". OutputError."""
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    if target == "-":
        sys.stdout.write(text)
        sys.stdout.flush()
    else:
        write_atomically(pathlib.Path(target), lambda path: path.write_text(text))


def to_json(value: Any) -> Any:
    """Convert to JSON types: lists for arrays and tuples, null for non-finite numbers."""
    if isinstance(value, dict):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return to_json(value.tolist())
    if isinstance(value, (list, tuple)):
        return [to_json(item) for item in value]
    if isinstance(value, np.generic):
        return to_json(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return str(value)
