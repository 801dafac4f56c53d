"""What the commands share: a quiet Warp, bars, tables, JSON."""

from __future__ import annotations

import contextlib
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

from .writer import write_whole

__all__ = ["compile_bar", "number", "quiet_warp", "size", "table", "write_json"]

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


class quiet_warp:
    """A context in which Warp, started if need be, prints no greeting and no lines about modules.

    Warnings and errors still show, and so does all that Warp prints where its user asked for more than it prints by
    default (`wp.config.log_level` below LOG_INFO, or `wp.config.verbose`). The level is as before afterwards.
    """

    def __enter__(self) -> None:
        self.before = wp.config.log_level
        asked = self.before < wp.LOG_INFO or bool(getattr(wp.config, "verbose", False))
        if not asked:
            wp.config.log_level = max(self.before, wp.LOG_WARNING)
        if not _started:
            _start()

    def __exit__(self, *_: object) -> None:
        wp.config.log_level = self.before


_started: list[bool] = []


def _start() -> None:
    """wp.init; that there is no CUDA driver, which the native library says on descriptor 2, is no news."""
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
    _started.append(True)


@contextlib.contextmanager
def compile_bar(show: bool | None) -> Iterator[Callable[[int, int, str], None]]:
    """A bar "compiling kernels" on stderr, with how many modules are ready; None: when stderr is a terminal."""
    if show is None:
        show = sys.stderr.isatty()
    if not show:
        yield lambda done, total, name: None
        return
    from tqdm import tqdm

    with tqdm(desc="compiling kernels", unit="module", file=sys.stderr, leave=False) as bar:

        def update(done: int, total: int, name: str) -> None:
            bar.total = total
            bar.set_postfix_str(name.removeprefix("warpfea.kernels."), refresh=False)
            bar.update(done - bar.n)

        yield update


def table(rows: Sequence[Sequence[str]], *, indent: str = "", right: Sequence[int] = ()) -> str:
    """Rows in columns two spaces apart; the columns in `right` end at their right side."""
    widths = [max(len(row[k]) for row in rows if k < len(row)) for k in range(max(map(len, rows)))]
    lines = []
    for row in rows:
        cells = [text.rjust(w) if k in right else text.ljust(w) for k, (text, w) in enumerate(zip(row, widths))]
        lines.append((indent + "  ".join(cells)).rstrip())
    return "\n".join(lines)


def number(value: float, digits: int = 4) -> str:
    """A number for reading."""
    return f"{value:.{digits}g}"


def size(count: int) -> str:
    """Bytes for reading."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count} B"


def write_json(target: str, content: dict[str, Any]) -> None:
    """Write JSON to a file, whole or not at all, or to stdout for "-". OutputError."""
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    if target == "-":
        sys.stdout.write(text)
        sys.stdout.flush()
    else:
        write_whole(pathlib.Path(target), lambda path: path.write_text(text))


def plain(value: Any) -> Any:
    """The value as JSON can hold it: lists for arrays and tuples, null for numbers that are not finite."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return str(value)
