"""Result of a sweep: its table in the order of the designs, files derived from it, pictures."""

from __future__ import annotations

import csv
import math
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..base.names import check_known
from ..base.writer import check_target, write_atomically
from .design import Design, require_pyarrow
from .pictures import SHEET_SUFFIXES, TABLE_SUFFIXES, draw_sheet, plot_table
from .record import Record
from .worker import Study

__all__ = ["SweepResult", "write_tables"]

CHUNK = 65536
"""Rows of a group of a Parquet file."""


class SweepResult:
    """Result of a sweep.

    Attributes:
        folder: of its files: record.jsonl, table.csv, table.parquet (with pyarrow), times.csv, series/.
        design: the designs. study: settings of their runs. measures: names.
        status, failures: of each design without a result by index, failed or killed, and the reason.
        seconds: of the workers' starts ("start") and of the rest ("run").
        retries: number of tasks that were lost with their worker.
    """

    def __init__(self, folder: pathlib.Path, design: Design, study: Study, record: Record, keep: Any = None) -> None:
        self.folder, self.design, self.study, self._keep = folder, design, study, keep
        self.measures = tuple(study.measures)
        left = {int(k): ("open", "") for k in np.flatnonzero(~record.done)}
        self.status = {k: status for k, (status, _) in (record.failures | left).items()}
        self.failures = {k: reason for k, (_, reason) in (record.failures | left).items()}
        self._values = record.values
        self.seconds: dict[str, float] = {}
        self.retries = record.retries

    def __len__(self) -> int:
        return len(self.design)

    def __repr__(self) -> str:
        return f"SweepResult({len(self)} designs, {len(self.failures)} failed, {', '.join(self.measures)})"

    def __getitem__(self, name: str) -> np.ndarray:
        """Column (designs,) of a measure, NaN where it failed, or of a parameter. ModelError."""
        check_known("column", name, [*self.design.columns, *self.measures])
        if name in self.measures:
            return self._values[self.measures.index(name)]
        return np.array(self.design.columns[name])

    def best(self, name: str, *, largest: bool = False) -> dict[str, Any]:
        """Design with the smallest or largest measure: its index, parameters and measures. ModelError."""
        values = np.array(self[name] if largest else -self[name], dtype=float)
        if name in self.measures:
            values[list(self.failures)] = np.nan
        if np.isnan(values).all():
            raise ModelError(f"no design has a value of {name!r}")
        index = int(np.nanargmax(values))
        return {"design": index} | self.design[index] | {each: float(self[each][index]) for each in self.measures}

    def pareto(self, first: str, second: str) -> np.ndarray:
        """Indices of the designs that no other beats in both measures, smaller is better, by the first."""
        x, y = self[first], self[second]
        order = [k for k in np.lexsort((y, x)) if k not in self.failures]
        best, out = np.inf, []
        for k in order:
            if y[k] < best:
                best = y[k]
                out.append(int(k))
        return np.array(out, dtype=int)

    def plot(self, path: str | pathlib.Path, *, pareto: Sequence[str] = ()) -> None:
        """Picture (.png, .svg, .pdf) of each measure over each parameter, or with two measures in `pareto` of one over
        the other with the designs that are best. OutputError, also without matplotlib."""
        plot_table(self, check_target(path, TABLE_SUFFIXES), pareto)

    def sheet(
        self, path: str | pathlib.Path, designs: Sequence[int] | None = None, *, field: str | None = None
    ) -> None:
        """Contact sheet (.png): pictures of some designs at their ends, each run again here, by default of the first
        twelve without a failure. ModelError, OutputError."""
        good = [k for k in range(len(self)) if k not in self.failures][:12]
        draw_sheet(self, check_target(path, SHEET_SUFFIXES), good if designs is None else list(designs), field)

    def series(self, index: int) -> dict[str, np.ndarray]:
        """Time series of a design by name, and "time". ModelError where none was kept."""
        file = self.folder / "series" / f"{index:06d}.npz"
        if not file.is_file():
            raise ModelError(f"{file}: no time series; give series= to the sweep, or the design failed")
        with np.load(file) as stored:
            return {name: stored[name] for name in stored.files}


def _texts_of_tuples(column: Sequence[Any]) -> Sequence[Any]:
    """A column with texts for tuples, as `Design.read` reads them."""
    if tuple not in set(map(type, column)):
        return column
    return [" ".join(map(repr, value)) if isinstance(value, tuple) else value for value in column]


def write_tables(result: SweepResult) -> None:
    """Derive table.csv, with pyarrow also table.parquet: the same bytes in whatever order the record's lines are.
    OutputError."""
    names = ["design", *result.design.columns, *result.measures, "status", "reason"]

    def columns(first: int, last: int) -> list[Sequence[Any]]:
        """Columns of some designs, None for measures that there are not."""
        values = [[None if math.isnan(x) else x for x in result[name][first:last].tolist()] for name in result.measures]
        status = [result.status.get(k, "done") for k in range(first, last)]
        reason = [result.failures.get(k, "") for k in range(first, last)]
        own = [column[first:last] for column in result.design.columns.values()]
        return [range(first, last), *own, *values, status, reason]

    chunks = [(k, min(k + CHUNK, len(result))) for k in range(0, len(result), CHUNK)]

    def write_csv(target: pathlib.Path) -> None:
        with open(target, "w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(names)
            for chunk in chunks:
                writer.writerows(zip(*map(_texts_of_tuples, columns(*chunk))))

    write_atomically(result.folder / "table.csv", write_csv)
    try:
        arrow = require_pyarrow()
    except ModelError:
        return
    kinds = {name: arrow.float64() for name in result.measures} | {"design": arrow.int64()}
    for name, column in result.design.columns.items():
        mixed = {type(value) for value in column} == {int, float}
        kinds[name] = arrow.float64() if mixed else arrow.array(column[:1]).type
    schema = arrow.schema([(name, kinds.get(name, arrow.string())) for name in names])

    def write_parquet(target: pathlib.Path) -> None:
        with arrow.parquet.ParquetWriter(target, schema) as writer:
            for chunk in chunks:
                arrays = [arrow.array(column, type=each.type) for each, column in zip(schema, columns(*chunk))]
                writer.write_table(arrow.Table.from_arrays(arrays, schema=schema))

    write_atomically(result.folder / "table.parquet", write_parquet)
