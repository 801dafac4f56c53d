"""What the reports share: the parts of a report run one after another, their rows printed and written.

A part is a function that gives rows (dicts that JSON can hold), all at once or one by one. The file is written after
each part; with --only the other parts stay in it as they are.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import time as clock
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from ...base.console import plain, quiet_warp, write_json
from ...base.errors import UsageError
from ...base.provenance import origin
from ...base.writer import check_target

__all__ = ["Part", "Rows", "check_out", "run_parts", "run_tables", "show"]

SCHEMA = 1
Rows = list[dict[str, Any]]
Part = Callable[..., Iterable[dict[str, Any]]]


def run_parts(options: argparse.Namespace, parts: Mapping[str, Part], **more: Mapping[str, Any]) -> None:
    """Run parts that are measured on their own: each stands in the file with its own command, commit and machine.

    Args:
        options: device, quick, only, out and words of the command line.
        parts: name -> function (device, quick) that gives rows; its docstring stands beside them.
        more: part -> further arguments.
    """
    content = _started(options) or {"schema": SCHEMA, "parts": {}}
    device = options.device or "cpu"
    with quiet_warp():
        for name in options.only or parts:
            print(f"{name} ...", flush=True)
            began = clock.perf_counter()
            rows = _collect(parts[name](device, options.quick, **more.get(name, {})))
            seconds = clock.perf_counter() - began
            about = {"about": parts[name].__doc__, "rows": rows, "wall_s": seconds}
            content["parts"][name] = about | origin(options.words, device)
            print(f"{name}: {seconds:.0f} s", flush=True)
            _write(options, content)


def run_tables(options: argparse.Namespace, tables: Mapping[str, Part], settings: Any, **given: Any) -> None:
    """Run parts that share one origin: the file holds it once, the settings, and a list of rows for each.

    Args:
        options: device, only, out and words of the command line.
        tables: name -> function that gives rows.
        settings: all that the numbers depend on.
        given: arguments of the functions.
    """
    content = _started(options) or {}
    with quiet_warp():
        content |= {"schema": SCHEMA, **origin(options.words, options.device), "settings": settings}
        for name in getattr(options, "only", None) or tables:
            content[name] = _collect(tables[name](**given))
            _write(options, content)


def check_out(options: argparse.Namespace) -> None:
    """Refuse an --out that can't be written, before any work. UsageError, OutputError."""
    if options.out is not None:
        if pathlib.Path(options.out).suffix != ".json":
            raise UsageError(f"--out {options.out}: the file name must end in .json")
        check_target(options.out, (".json",))


def show(row: Mapping[str, Any]) -> None:
    """A row as one line."""
    print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True)


def _collect(found: Iterable[dict[str, Any]]) -> Rows:
    """The rows, each printed as it comes."""
    rows = []
    for row in found:
        show(row)
        rows.append(row)
    return rows


def _started(options: argparse.Namespace) -> dict[str, Any] | None:
    """What the file holds that some parts are to be replaced in."""
    check_out(options)
    path = pathlib.Path(options.out) if options.out else None
    keep = getattr(options, "only", None) and path and path.exists()
    return json.loads(path.read_text()) if path and keep else None


def _write(options: argparse.Namespace, content: dict[str, Any]) -> None:
    if options.out is not None:
        write_json(options.out, plain(content))
