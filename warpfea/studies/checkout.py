"""Files that lie in a checkout of the repository but not in the installed package: reference data, large meshes."""

from __future__ import annotations

import json
import pathlib
from typing import Any

from ..base.errors import UsageError

__all__ = ["DATA_FOLDER", "data_file", "reference_data"]

DATA_FOLDER = pathlib.Path(__file__).resolve().parents[2] / "tests" / "data"


def data_file(name: str) -> pathlib.Path:
    """A file of tests/data. UsageError where it is not there."""
    path = DATA_FOLDER / name
    if not path.is_file():
        raise UsageError(f"{path}: no such file; this study reads tests/data and needs a checkout of the repository")
    return path


def reference_data(name: str) -> Any:
    """The content of tests/data/NAME.json: results that were made without warpfea, and their source."""
    return json.loads(data_file(f"{name}.json").read_text())
