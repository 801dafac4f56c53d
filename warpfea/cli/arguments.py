"""Common parts of the parsers: parser class, types of values, general options."""

from __future__ import annotations

import argparse
import math
import pathlib
import re
from typing import Any, NoReturn

from ..base.checks import number_hint
from ..base.errors import UsageError
from ..base.names import did_you_mean

__all__ = [
    "Parser",
    "StoreOnce",
    "add_general_options",
    "color_range",
    "existing_file",
    "lazy_command",
    "load_steps",
    "number_pair",
    "number_tuple",
    "positive_integer",
    "positive_integers",
    "positive_number",
    "size",
    "step_size",
    "vector",
]


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


def step_size(text: str) -> float | str:
    """A positive finite number, or "auto"."""
    if text == "auto":
        return text
    try:
        return positive_number(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a positive finite number nor auto") from None


def positive_integer(text: str) -> int:
    """A positive whole number."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive whole number")
    return int(text)


def load_steps(text: str) -> int:
    """Number of load steps; "auto": one, halved by the solver if rejected."""
    if text == "auto":
        return 1
    try:
        return positive_integer(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a positive whole number nor auto") from None


def positive_integers(text: str) -> list[int]:
    """Positive whole numbers separated by commas; 1e5 counts as one."""
    try:
        values = [float(part) for part in text.split(",")]
        assert all(math.isfinite(v) and v >= 1 and v == int(v) for v in values)
    except (ValueError, AssertionError):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of positive whole numbers") from None
    return [int(v) for v in values]


def number_tuple(text: str, size: int) -> tuple[float, ...]:
    """Finite numbers separated by commas."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != size or not all(map(math.isfinite, values)):
        expected = "a finite number" if size == 1 else f"{size} finite numbers with commas"
        raise argparse.ArgumentTypeError(f"{text!r} is not {expected}")
    return values


def vector(text: str) -> tuple[float, ...]:
    """x,y,z."""
    return number_tuple(text, 3)


def number_pair(text: str) -> tuple[float, ...]:
    """Two numbers separated by a comma."""
    return number_tuple(text, 2)


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


def lazy_command(module: str, function: str) -> Any:
    """The command, imported on call."""

    def command(arguments: argparse.Namespace) -> int:
        import importlib

        return int(getattr(importlib.import_module(f"{__package__}.{module}"), function)(arguments))

    return command


def add_general_options(to: argparse.ArgumentParser, quiet: str = "no bars and no summary table") -> None:
    """Options common to all commands; `quiet` is the help of --quiet."""
    group = to.add_argument_group("general")
    group.add_argument("--quiet", action="store_true", help=quiet)
    group.add_argument("--no-progress", action="store_true", help="no bars; there are none without a terminal")
    group.add_argument("--debug", action="store_true", help="errors as Python tracebacks")
