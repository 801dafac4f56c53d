"""Result of a sweep: its table in the order of the designs, files derived from it, pictures."""

from __future__ import annotations

import csv
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..base.names import check_known
from ..base.writer import check_target, write_atomically
from .design import Design, require_pyarrow
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
        failures: reason by index of each design without a result.
        seconds: of the workers' starts ("start") and of the rest ("run").
        retries: number of tasks that were lost with their worker.
    """

    def __init__(self, folder: pathlib.Path, design: Design, study: Study, record: Record, keep: Any = None) -> None:
        self.folder, self.design, self.study, self._keep = folder, design, study, keep
        self.measures = tuple(study.measures)
        self.failures: dict[int, str] = {}
        self._values = np.full((len(self.measures), len(design)), np.nan)
        for row in record.rows():
            if row["status"] != "done":
                self.failures[row["design"]] = row["reason"] or row["status"]
            for k, name in enumerate(self.measures):
                self._values[k, row["design"]] = row["values"].get(name, np.nan)
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
        values = self[name] if largest else -self[name]
        if np.isnan(values).all():
            raise ModelError(f"no design has a value of {name!r}")
        index = int(np.nanargmax(values))
        return {"design": index} | self.design[index] | {each: float(self[each][index]) for each in self.measures}

    def pareto(self, first: str, second: str) -> np.ndarray:
        """Indices of the designs that no other beats in both measures, smaller is better, by the first."""
        x, y = self[first], self[second]
        order = [k for k in np.lexsort((y, x)) if not np.isnan(x[k] + y[k])]
        best, out = np.inf, []
        for k in order:
            if y[k] < best:
                best = y[k]
                out.append(int(k))
        return np.array(out, dtype=int)

    def plot(self, path: str | pathlib.Path, *, pareto: Sequence[str] = ()) -> None:
        """Picture (.png, .svg, .pdf) of each measure over each parameter, or with two measures in `pareto` of one over
        the other with the designs that are best. OutputError, also without matplotlib."""
        from .pictures import plot_table

        plot_table(self, check_target(path, (".png", ".svg", ".pdf")), pareto)

    def sheet(
        self, path: str | pathlib.Path, designs: Sequence[int] | None = None, *, field: str | None = None
    ) -> None:
        """Contact sheet (.png): pictures of some designs at their ends, each run again here, by default of the first
        twelve without a failure. ModelError, OutputError."""
        from .pictures import draw_sheet

        good = [k for k in range(len(self)) if k not in self.failures][:12]
        draw_sheet(self, check_target(path, (".png",)), good if designs is None else list(designs), field)

    def series(self, index: int) -> dict[str, np.ndarray]:
        """Time series of a design by name, and "time". ModelError where none was kept."""
        file = self.folder / "series" / f"{index:06d}.npz"
        if not file.is_file():
            raise ModelError(f"{file}: no time series; give series= to the sweep, or the design failed")
        with np.load(file) as stored:
            return {name: stored[name] for name in stored.files}


def write_tables(folder: pathlib.Path, design: Design, measures: Sequence[str], record: Record) -> None:
    """Derive table.csv, with pyarrow also table.parquet, from the record: the same bytes in whatever order its lines
    are. OutputError."""
    names = ["design", *design.columns, *measures, "status", "reason"]

    def rows() -> Iterator[list[Any]]:
        for k, row in enumerate(record.rows()):
            values = [row["values"].get(name) for name in measures]
            yield [k, *design[k].values(), *values, row["status"], row["reason"]]

    def write_csv(target: pathlib.Path) -> None:
        with open(target, "w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(names)
            writer.writerows([" ".join(map(repr, x)) if isinstance(x, tuple) else x for x in row] for row in rows())

    write_atomically(folder / "table.csv", write_csv)
    try:
        arrow = require_pyarrow()
    except ModelError:
        return
    kinds: dict[str, Any] = {name: arrow.array(column[:1]).type for name, column in design.columns.items()}
    for name, column in design.columns.items():
        if {type(value) for value in column} == {int, float}:
            kinds[name] = arrow.float64()
    kinds |= {"design": arrow.int64(), "status": arrow.string(), "reason": arrow.string()}
    schema = arrow.schema([(name, kinds.get(name, arrow.float64())) for name in names])

    def write_parquet(target: pathlib.Path) -> None:
        with arrow.parquet.ParquetWriter(target, schema) as writer:
            chunk: list[list[Any]] = []
            for row in rows():
                chunk.append(row)
                if len(chunk) == CHUNK:
                    writer.write_table(_arrow_table(arrow, schema, chunk))
                    chunk = []
            if chunk:
                writer.write_table(_arrow_table(arrow, schema, chunk))

    write_atomically(folder / "table.parquet", write_parquet)


def _arrow_table(arrow: Any, schema: Any, rows: list[list[Any]]) -> Any:
    columns = [arrow.array(column, type=field.type) for field, column in zip(schema, zip(*rows))]
    return arrow.Table.from_arrays(columns, schema=schema)
