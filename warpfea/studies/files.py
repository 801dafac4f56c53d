"""The CSV of a study, and the reference data and meshes of a checkout."""

import csv
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from ..base.errors import UsageError
from ..base.writer import write_atomically

__all__ = ["DATA_FOLDER", "data_file", "reference_data", "write_csv"]

DATA_FOLDER = pathlib.Path(__file__).resolve().parents[2] / "tests" / "data"
"""Files of a checkout, absent in the installed package."""


def write_csv(path: pathlib.Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows; tuples as their values with blanks, None as nothing. OutputError."""

    def text(value: Any) -> Any:
        return " ".join(map(repr, value)) if isinstance(value, (tuple, list)) else value

    def write(target: pathlib.Path) -> None:
        with open(target, "w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerows([columns, *([text(row.get(name)) for name in columns] for row in rows)])

    write_atomically(path, write)


def data_file(name: str) -> pathlib.Path:
    """A file of tests/data. UsageError where it is not there."""
    path = DATA_FOLDER / name
    if not path.is_file():
        raise UsageError(f"{path}: no such file; this study reads tests/data and needs a checkout of the repository")
    return path


def reference_data(name: str) -> Any:
    """The content of tests/data/NAME.json: results that were made without warpfea, and their source."""
    return json.loads(data_file(f"{name}.json").read_text())
