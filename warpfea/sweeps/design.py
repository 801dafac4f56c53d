"""Designs: the points of a sweep, as a grid, a list or samples."""

from __future__ import annotations

import csv
import itertools
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..base.checks import is_count, is_number
from ..base.errors import ModelError
from ..base.names import check_choice, did_you_mean

__all__ = ["KINDS", "Design", "as_range", "check_keys", "require_pyarrow"]

KINDS = ("grid", "list", "random", "lhs", "sobol")
AXIS_KEYS = ("low", "high", "count", "log", "whole")
TABLE_KEYS = {"grid": ("over",), "list": ("file", "rows"), **dict.fromkeys(KINDS[2:], ("over", "count", "seed"))}
"""Keys of a design in TOML besides its kind."""


class Design:
    """Parameters of each run of a sweep.

    Attributes:
        columns: values by parameter, each list in the order of the designs: numbers, texts, truth values, or tuples.

    Raises:
        ModelError: no parameter, no design, or columns of different lengths.
    """

    def __init__(self, columns: Mapping[str, Sequence[Any]]) -> None:
        self.columns = {str(name): list(map(_plain, values)) for name, values in columns.items()}
        lengths = {name: len(values) for name, values in self.columns.items()}
        if not lengths or 0 in lengths.values() or len(set(lengths.values())) > 1:
            raise ModelError(f"design: every parameter needs as many values as there are designs, got {lengths}")

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __getitem__(self, index: int) -> dict[str, Any]:
        return {name: values[index] for name, values in self.columns.items()}

    def __repr__(self) -> str:
        return f"Design({len(self)} of {', '.join(self.columns)})"

    @classmethod
    def grid(cls, over: Mapping[str, Any], *, where: str = "design") -> Design:
        """All combinations, the last parameter fastest.

        Args:
            over: values by parameter, or a range {"low", "high", "count", "log"}.
            where: start of the key's path in errors.

        Raises:
            ModelError: an empty list or range.
        """
        axes = {name: _axis_values(f"{where}.over.{name}", axis) for name, axis in over.items()}
        return cls(dict(zip(axes, zip(*itertools.product(*axes.values())))))

    @classmethod
    def samples(cls, kind: str, over: Mapping[str, Any], *, count: int, seed: int = 0, where: str = "design") -> Design:
        """Samples of ranges, the same for the same seed.

        Args:
            kind: "random", "lhs" (Latin hypercube) or "sobol" (scrambled).
            over: (low, high) by parameter, or {"low", "high", "log", "whole"}: evenly in the logarithm, whole numbers.
            count: of designs. seed: of the generator. where: start of the key's path in errors.

        Raises:
            ModelError: an unknown kind, an empty range or no count.
        """
        from scipy.stats import qmc

        check_choice(f"{where}.kind", kind, KINDS[2:])
        _check_count(f"{where}.count", count, 1)
        _check_count(f"{where}.seed", seed, 0)
        ranges = {name: as_range(f"{where}.over.{name}", axis) for name, axis in over.items()}
        size, rng = len(ranges), np.random.default_rng(seed)
        if kind == "random":
            points = rng.random((count, size))
        elif kind == "lhs":
            points = qmc.LatinHypercube(size, rng=rng).random(count)
        else:
            points = qmc.Sobol(size, rng=rng).random_base2(max(count - 1, 0).bit_length())[:count]
        return cls({name: _scaled(axis, points[:, k]) for k, (name, axis) in enumerate(ranges.items())})

    @classmethod
    def read(cls, path: str | pathlib.Path) -> Design:
        """Designs of a CSV or Parquet file with one column per parameter. ModelError."""
        file = pathlib.Path(path)
        if not file.is_file():
            raise ModelError(f"{file}: no such file")
        if file.suffix.lower() == ".parquet":
            return cls(require_pyarrow().parquet.read_table(file).to_pydict())
        check_choice(f"{file}: the type", file.suffix.lower(), (".csv", ".parquet"))
        with open(file, encoding="utf-8-sig", newline="") as stream:
            rows = [row for row in csv.reader(stream) if row]
        if len(rows) < 2 or any(len(row) != len(rows[0]) for row in rows):
            raise ModelError(f"{file}: expected a line of names and lines of as many values")
        return cls({name: [_from_text(row[k]) for row in rows[1:]] for k, name in enumerate(rows[0])})

    @classmethod
    def of(cls, given: Any, where: str = "design") -> Design:
        """A design from a Design, a list of {parameter: value}, or a table as in TOML. ModelError."""
        if isinstance(given, Design):
            return given
        if isinstance(given, (list, tuple)) and given and all(isinstance(row, Mapping) for row in given):
            for k, row in enumerate(given):
                check_keys(f"{where}[{k}]", row, given[0])
                for name in given[0].keys() - row.keys():
                    raise ModelError(f"{where}[{k}].{name} is missing")
            return cls({name: [row[name] for row in given] for name in given[0]})
        if not isinstance(given, Mapping):
            raise ModelError(f"{where} = {given!r} must be a wf.Design, a list of {{name: value}}, or a table")
        table = dict(given)
        kind = table.pop("kind", "grid")
        check_choice(f"{where}.kind", kind, KINDS)
        check_keys(where, table, TABLE_KEYS[kind])
        if kind == "list":
            if len(table) != 1:
                raise ModelError(f"{where}: a list needs either file or rows")
            return cls.read(table["file"]) if "file" in table else cls.of(table["rows"], f"{where}.rows")
        if not isinstance(table.get("over"), Mapping) or not table["over"]:
            raise ModelError(f"{where}.over is empty: give parameters and their values")
        if kind == "grid":
            return cls.grid(table["over"], where=where)
        return cls.samples(kind, table["over"], count=table.get("count", 0), seed=table.get("seed", 0), where=where)


def check_keys(where: str, table: Mapping[str, Any], known: Any) -> None:
    """ModelError with the path of a key that is not among the known ones."""
    for key in table:
        if key not in known:
            path = f"{where}.{key}" if where else key
            raise ModelError(f"{path} is unknown; there are {', '.join(known)}{did_you_mean(key, known)}")


def require_pyarrow() -> Any:
    """pyarrow with its Parquet part. ModelError where it is not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ModelError(f"Parquet needs pyarrow: pip install 'warpfea[sweep]' ({error})") from error
    return pyarrow


def _check_count(where: str, value: Any, least: int) -> None:
    if not (is_count(value) and value >= least):
        raise ModelError(f"{where} = {value!r} must be a whole number, at least {least}")


def as_range(where: str, axis: Any) -> dict[str, Any]:
    """{"low", "high", ...} of a range. ModelError."""
    if isinstance(axis, (list, tuple)) and len(axis) == 2:
        axis = {"low": axis[0], "high": axis[1]}
    if not isinstance(axis, Mapping):
        raise ModelError(f"{where} = {axis!r} must be a range: [low, high] or {{low = , high = }}")
    check_keys(where, axis, AXIS_KEYS)
    out = {"log": False, "whole": False} | dict(axis)
    for key in ("low", "high"):
        if not is_number(out.get(key)):
            raise ModelError(f"{where}.{key} = {out.get(key)!r} must be a finite number")
    if not math.isfinite(float(out["high"]) - float(out["low"])):
        raise ModelError(f"{where}: high - low is too large, from {out['low']} to {out['high']}")
    if out["whole"] and any(out[key] != int(out[key]) for key in ("low", "high")):
        raise ModelError(f"{where}: low and high of whole numbers must be whole")
    if not out["low"] < out["high"]:
        raise ModelError(f"{where} is empty: low = {out['low']} is not below high = {out['high']}")
    if out["log"] and not out["low"] > 0.0:
        raise ModelError(f"{where}.low = {out['low']} must be positive with log")
    return out


def _axis_values(where: str, axis: Any) -> list[Any]:
    """Values of an axis of a grid. ModelError."""
    if isinstance(axis, Mapping):
        given = as_range(where, axis)
        if given["whole"]:
            raise ModelError(f"{where}.whole is for samples: list the whole numbers of a grid")
        _check_count(f"{where}.count", given.get("count"), 2)
        return _scaled(given, np.linspace(0.0, 1.0, given["count"]))
    values = list(axis) if isinstance(axis, (list, tuple, range, np.ndarray)) else None
    if not values:
        raise ModelError(f"{where} = {axis!r} must be a list of values that is not empty")
    return values


def _scaled(axis: Mapping[str, Any], points: np.ndarray) -> list[Any]:
    """Values of a range at points between 0 and 1; its ends are met exactly."""
    low, high = axis["low"], axis["high"]
    if axis["whole"]:
        return [int(low + math.floor(x * (high - low + 1))) for x in points]
    scale = math.exp if axis["log"] else float
    a, b = (math.log(low), math.log(high)) if axis["log"] else (low, high)
    ends = {0.0: float(low), 1.0: float(high)}
    return [ends[x] if x in ends else scale(a + x * (b - a)) for x in points.tolist()]


def _plain(value: Any) -> Any:
    """Python's own types, as JSON keeps them; tuples for sequences. ModelError."""
    value = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
    if isinstance(value, (list, tuple)):
        return tuple(map(_plain, value))
    if isinstance(value, float) and not math.isfinite(value):
        raise ModelError(f"design: {value!r} must be finite")
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise ModelError("design: a whole number of more than 64 bits")
    if not isinstance(value, (bool, int, float, str)):
        raise ModelError(f"design: {value!r} must be a number, a text, a truth value or a list of these")
    return value


def _from_text(text: str) -> Any:
    """The value of a text in CSV: a whole number, a number, numbers with blanks, or the text."""
    for kind in (int, float, lambda word: tuple(map(float, word.split()))):
        try:
            return kind(text) or (0 if text.strip() else "")
        except ValueError:
            continue
    return {"True": True, "False": False}.get(text, text)
