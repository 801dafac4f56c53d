"""What a study found: rows, and their table, JSON and CSV."""

from __future__ import annotations

import itertools
import pathlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from ...base.console import plain, write_json
from ...base.provenance import origin
from ...base.writer import write_whole
from ..files import prepare, write_csv

__all__ = ["Row", "Study"]

SCHEMA = 1


@dataclass(frozen=True)
class Row:
    """One element on one mesh.

    Attributes:
        problem, element: names.
        cells: cells of the box along x, y, z.
        elements, unknowns: counts; unknowns are free components.
        error: largest distance of the tip from the reference, over the bar's length. rigid: from the rigid body in the
            same time steps, which is free of the time error; large: at the end; sudden: over all steps.
        error_exact: rigid: the same from the exact rigid motion, time error included; None elsewhere.
        order: of convergence from the next coarser mesh, with h = unknowns^(-1/3). None: first mesh, or rigid, where
            errors end at the bar's own flexibility.
        mesh_order: the same with h = size of a cell.
        seconds: run time, median of `repeats`, without set-up and compilation.
        ms_per_step: run time per time step; None in statics.
        newton, pcg: iterations in all.
        setup_s: seconds for model, compilation and recording of the launches, in the first run.
        tip: last displacement of the tip, m.
    """

    problem: str
    element: str
    cells: tuple[int, int, int]
    elements: int
    unknowns: int
    error: float
    error_exact: float | None
    order: float | None
    mesh_order: float | None
    seconds: float
    ms_per_step: float | None
    newton: int
    pcg: int
    repeats: int
    setup_s: float
    tip: tuple[float, float, float]


def with_orders(rows: list[Row]) -> list[Row]:
    """The rows of one element on finer and finer meshes, with observed orders."""
    out = rows[:1]
    for coarse, fine in itertools.pairwise(rows):
        fall = np.log(coarse.error / fine.error)
        out.append(
            replace(
                fine,
                order=float(3.0 * fall / np.log(fine.unknowns / coarse.unknowns)),
                mesh_order=float(fall / np.log(fine.cells[1] / coarse.cells[1])),
            )
        )
    return out


@dataclass(frozen=True)
class Study:
    """A study.

    Attributes:
        name: what its files are called.
        settings: all that the numbers depend on.
        references: for each problem, what errors are measured against and how good that is.
        rows: the measurements.
    """

    name: str
    settings: dict[str, Any]
    references: dict[str, dict[str, Any]]
    rows: list[Row] = field(repr=False)

    def of(self, problem: str, element: str) -> list[Row]:
        """Rows of one element on one problem, coarse to fine."""
        return [r for r in self.rows if r.problem == problem and r.element == element]

    def table(self) -> str:
        """The rows for reading, a block per problem with its reference."""
        parts = []
        for problem, reference in self.references.items():
            body = [[_cell(r, c) for c in COLUMNS] for r in self.rows if r.problem == problem]
            lines = [" ".join(text.rjust(w) for text, w in zip(line, COLUMNS.values())) for line in [[*COLUMNS], *body]]
            parts.append("\n".join([f"{problem}: {reference['about']}", *lines]))
        return "\n\n".join(parts)

    def content(self, words: Sequence[str], device: Any) -> dict[str, Any]:
        """What the JSON file holds."""
        return {
            "schema": SCHEMA,
            **origin(words, device),
            "settings": plain(self.settings),
            "references": plain(self.references),
            "rows": [plain(asdict(row)) for row in self.rows],
        }

    def write(
        self, folder: str | pathlib.Path, *, words: Sequence[str] = ("study", "ancf-tets"), device: Any = None
    ) -> list[pathlib.Path]:
        """Write NAME.json, NAME.csv and NAME.png into the folder, made if its parent is there.

        words: of the command line, without "warpfea".

        Raises:
            OutputError: the folder can't be made or written, or matplotlib is missing.
        """
        from .plots import draw

        out = prepare(folder)
        paths = [out / f"{self.name}.{suffix}" for suffix in ("json", "csv", "png")]
        write_json(str(paths[0]), self.content(words, device))
        write_csv(paths[1], [f.name for f in fields(Row)], [asdict(row) for row in self.rows])
        write_whole(paths[2], lambda path: draw(self, path))
        return paths


COLUMNS = {
    "element": 7,
    "elements": 8,
    "unknowns": 8,
    "error": 9,
    "order": 6,
    "mesh order": 10,
    "seconds": 9,
    "ms/step": 8,
    "newton": 6,
    "pcg": 7,
}


def _cell(row: Row, column: str) -> str:
    """The text of one cell of the table."""
    value = getattr(row, {"mesh order": "mesh_order", "ms/step": "ms_per_step"}.get(column, column))
    if value is None:
        return "-"
    if column == "error":
        return f"{value:.2e}"
    if column == "seconds":
        return f"{value:.3f}"
    return f"{value:.2f}" if isinstance(value, float) else str(value)
