"""The folder and the CSV of a study, and what pictures need."""

from __future__ import annotations

import csv
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from ..base.errors import OutputError
from ..base.writer import check_folder, write_atomically

__all__ = ["make_folder", "require_matplotlib", "write_csv"]


def make_folder(folder: str | pathlib.Path) -> pathlib.Path:
    """Make the folder if it is not there. OutputError for one that can't be written."""
    path = pathlib.Path(folder)
    if not path.exists():
        check_folder(path.absolute().parent, path)
        path.mkdir()
    check_folder(path, path)
    return path


def write_csv(path: pathlib.Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows; tuples as their values with blanks, None as nothing. OutputError."""

    def text(value: Any) -> Any:
        if isinstance(value, (tuple, list)):
            return " ".join(map(repr, value))
        return "" if value is None else value

    def write(target: pathlib.Path) -> None:
        with open(target, "w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            for row in rows:
                writer.writerow([text(row.get(name)) for name in columns])

    write_atomically(path, write)


def require_matplotlib() -> Any:
    """matplotlib's Figure class. OutputError where it is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise OutputError(f"the plot needs matplotlib: pip install 'warpfea[plots]' ({error})") from error
    return Figure
