"""Common parts of the parsers: parser class, types of values, general options."""

import argparse
import enum
import functools
import importlib
import math
import pathlib
import re
from collections.abc import Callable
from typing import Any, NoReturn

from ..base.checks import finite_number, number_hint
from ..base.errors import UsageError
from ..base.names import did_you_mean

__all__ = [
    "Kind", "Parser", "add_options", "color_range", "existing_file", "finish_command", "load_steps",
    "number_pair", "number_tuple", "positive_integer", "positive_integers", "positive_number", "size", "step_size",
    "vector",
]  # fmt: skip


class Parser(argparse.ArgumentParser):
    """Help with its line breaks; errors as UsageError."""

    def __init__(self, *args: Any, **options: Any) -> None:
        defaults: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}
        super().__init__(*args, **(defaults | options))

    def error(self, message: str) -> NoReturn:
        """Raise UsageError with the closest known name."""
        choice = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        if choice:
            message += did_you_mean(choice[1], re.findall(r"[\w-]+", choice[2]))
        raise UsageError(f"{message} (see {self.prog} --help)")


class StoreOnce(argparse.Action):
    """Store the value of an output option: a second value would discard a file."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option: str | None = None) -> None:
        """Store the value. UsageError for a second one."""
        if getattr(namespace, self.dest) is not None:
            parser.error(f"{option} is given twice")
        setattr(namespace, self.dest, values)


def existing_file(text: str) -> pathlib.Path:
    """Path of an existing file. UsageError."""
    path = pathlib.Path(text)
    if not path.is_file():
        raise UsageError(f"{path}: is a folder, not a file" if path.is_dir() else f"{path}: no such file")
    return path


def positive_number(text: str) -> float:
    """A positive finite number."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive finite number{number_hint(text)}") from None
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive finite number")
    return value


def positive_integer(text: str) -> int:
    """A positive whole number."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive whole number")
    return int(text)


def _or_auto(parse: Callable[[str], Any], auto: Any, what: str, text: str) -> Any:
    """`auto` for "auto", else a parsed number; `what` is expected."""
    try:
        return auto if text == "auto" else parse(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither {what} nor auto") from None


step_size = functools.partial(_or_auto, positive_number, "auto", "a positive finite number")
"""A positive finite number, or "auto"."""
load_steps = functools.partial(_or_auto, positive_integer, 1, "a positive whole number")
"""Number of load steps; "auto": one, halved by the solver if rejected."""


def positive_integers(text: str) -> list[int]:
    """Positive whole numbers separated by commas; 1e5 counts as one."""
    values = [finite_number(part) for part in text.split(",")]
    if not all(v >= 1 and v == int(v) for v in values):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of positive whole numbers")
    return [int(v) for v in values]


def number_tuple(text: str, size: int) -> tuple[float, ...]:
    """Finite numbers separated by commas."""
    values = tuple(map(finite_number, text.split(",")))
    if len(values) != size or any(map(math.isnan, values)):
        expected = "a finite number" if size == 1 else f"{size} finite numbers with commas"
        raise argparse.ArgumentTypeError(f"{text!r} is not {expected}")
    return values


vector = functools.partial(number_tuple, size=3)
"""x,y,z."""
number_pair = functools.partial(number_tuple, size=2)
"""Two numbers separated by a comma."""


def color_range(text: str) -> tuple[float, ...]:
    """Two finite increasing numbers separated by a comma."""
    low, high = number_tuple(text, 2)
    if not low < high:
        raise argparse.ArgumentTypeError(f"{text!r} does not rise: give LOW,HIGH")
    return low, high


def size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT in pixels."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, such as 960x540")
    return int(match[1]), int(match[2])


class Kind(enum.Enum):
    """Actions of options: a switch; repeatable; an output, given once."""

    FLAG = "store_true"
    APPEND = "append"
    ONCE = StoreOnce


def add_options(to: Any, *rows: tuple[Any, ...]) -> None:
    """Add options, a row (flag, kind, metavar, help) or (flag, kind, metavar, help, default) each.

    Kinds are a `Kind`, a type of values, a tuple of choices, or None for text; a tuple as metavar: choices of
    a repeatable option. Flags with synonyms are separated by blanks.
    """
    for flags, kind, shown, text, *default in rows:
        how: dict[str, Any] = {"action": kind.value} if isinstance(kind, Kind) else {"type": kind}
        choices = kind if isinstance(kind, tuple) else shown
        if isinstance(choices, tuple):
            how = {"action": how.get("action"), "choices": choices}
        elif shown:
            how["metavar"] = shown
        if default or kind is Kind.APPEND:
            how["default"] = default[0] if default else []
        to.add_argument(*flags.split(), help=text, **how)


def finish_command(to: Any, module: str, function: str, quiet: str = "no bars and no summary table") -> None:
    """Options common to all commands, and the command, imported on call; `quiet` is the help of --quiet."""
    add_options(
        to.add_argument_group("general"),
        ("--quiet", Kind.FLAG, None, quiet),
        ("--no-progress", Kind.FLAG, None, "no bars; there are none without a terminal"),
        ("--debug", Kind.FLAG, None, "errors as Python tracebacks"),
    )

    def command(arguments: argparse.Namespace) -> int:
        return int(getattr(importlib.import_module(module, __package__), function)(arguments) or 0)

    to.set_defaults(command=command)
