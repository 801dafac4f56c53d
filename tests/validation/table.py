"""A table: declared here, run by runner.py."""

from __future__ import annotations

import fnmatch
import pathlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from warpfea.base.errors import UsageError

__all__ = ["Part", "Row", "Run", "Table", "cases"]

Row = dict[str, Any]
"""JSON-compatible numbers and texts, by name."""


@dataclass
class Run:
    """Options and rows of a run of a table.

    Attributes:
        device: that of --device, or of the table.
        quick: a trial: few and small rows, no result.
        labels: of --rows, with * for any text; empty for all.
        out: file of --out.
        options: those of the table, with the values of --set.
        made: part -> its rows, of those made or kept so far.
    """

    device: Any = "cpu"
    quick: bool = False
    labels: tuple[str, ...] = ()
    out: pathlib.Path | None = None
    options: dict[str, Any] = field(default_factory=dict)
    made: dict[str, Any] = field(default_factory=dict)

    def wants(self, label: str) -> bool:
        """True for a row named by --rows, and for every row without it."""
        return not self.labels or any(fnmatch.fnmatchcase(label, pattern) for pattern in self.labels)

    def checkpoint(self, name: str) -> pathlib.Path | None:
        """Checkpoint file beside --out of a long run; None without --out."""
        return self.out and self.out.with_suffix(f".{name.replace(' ', '_')}.npz")


Part = Callable[[Run], "Iterable[Row] | Mapping[str, Any]"]
"""Function returning rows, one by one or all at once, or a single object; its docstring is its help."""


def cases(about: str, case: Callable[..., Row], rows: Iterable[Mapping[str, Any]]) -> Part:
    """Part of one row for each set of arguments of a function of the arguments and the device."""

    def part(run: Run) -> Iterator[Row]:
        for arguments in rows:
            yield case(**arguments, device=run.device)

    part.__doc__ = about
    return part


@dataclass(frozen=True)
class Table:
    """Rows of results against references or of costs, printed and written as one JSON file.

    Attributes:
        about: help text; by convention the docstring of its module.
        parts: name, a key of the file -> function returning its rows.
        results: file of tests/results -> its command line after `python -m tests.validation`.
        settings: constants of influence, as in the file.
        options: further settings that parts read from `Run.options`: numbers, texts or lists of them, changed with
            --set NAME=VALUE.
        columns: printed names; empty for all. The file contains all.
        device: without --device.
        takes: duration on two cores.
        apart: each part is measured separately, stored in the file's "parts" with its own command, commit and
            machine; otherwise the file has one origin, and a list of rows for each part.
        check: raises an error of warpfea for an impossible run, before any work.
    """

    about: str | None
    parts: Mapping[str, Part]
    results: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    columns: tuple[str, ...] = ()
    device: str = "cpu"
    takes: str = "minutes"
    apart: bool = False
    check: Callable[[Run], None] | None = None

    def changed(self, texts: Iterable[str]) -> dict[str, Any]:
        """The options with values NAME=VALUE in place; lists with commas. UsageError."""
        out = dict(self.options)
        for text in texts:
            name, equals, value = text.partition("=")
            now = out.get(name)
            first = now[0] if isinstance(now, (tuple, list)) and now else now
            if not equals or name not in out:
                raise UsageError(f"--set {text}: give NAME=VALUE, NAME one of {', '.join(out) or '(there is none)'}")
            try:
                values = [_read(word, first) for word in value.split(",")]
            except ValueError:
                raise UsageError(f"--set {text}: {value!r} is no {type(first).__name__}") from None
            out[name] = values[0] if now is first else values
        return out


def _read(word: str, like: Any) -> Any:
    """A word as a value of the type of another; 1e5 counts as a whole number. ValueError."""
    if isinstance(like, bool):
        return {"true": True, "false": False}[word.lower()] if word.lower() in ("true", "false") else int("no")
    if isinstance(like, int):
        number = float(word)
        if number != int(number):
            raise ValueError(word)
        return int(number)
    return type(like)(word)
