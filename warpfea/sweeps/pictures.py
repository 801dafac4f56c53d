"""Pictures of a sweep: its table, and a contact sheet of chosen designs."""

from __future__ import annotations

import math
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..base.lazy import pillow, require_matplotlib
from ..base.writer import write_atomically
from ..outputs.render import PNGWriter
from .worker import Group, find_scene

__all__ = ["SHEET_SUFFIXES", "TABLE_SUFFIXES", "check_designs", "draw_sheet", "plot_table"]

TABLE_SUFFIXES = (".png", ".svg", ".pdf")
SHEET_SUFFIXES = (".png",)
PANEL = 2.8
"""Size of a panel, inches."""
PICTURE = (480, 360)
"""Size of a picture of a contact sheet, pixels."""


def check_designs(what: str, designs: Any, count: int) -> None:
    """ModelError unless these are numbers of some of so many designs."""
    if not designs or not all(isinstance(k, int) and 0 <= k < count for k in designs):
        raise ModelError(f"{what} = {designs!r} must be numbers from 0 to {count - 1}")


def plot_table(result: Any, target: pathlib.Path, pareto: Sequence[str]) -> None:
    """Each measure over each parameter, or one measure over another with the Pareto front. OutputError."""
    Figure = require_matplotlib()
    names = result.design.columns
    pairs: list[Any] = [[tuple(pareto)]] if pareto else [[(x, y) for x in names] for y in result.measures]
    figure = Figure(figsize=(1.0 + PANEL * len(pairs[0]), 0.6 + PANEL * len(pairs)), layout="constrained")
    axes: Any = figure.subplots(len(pairs), len(pairs[0]), squeeze=False)
    for line, row in zip(axes, pairs):
        for axis, (x, y) in zip(line, row):
            _draw(axis, result, x, y)
            if pareto:
                front = result.pareto(x, y)
                axis.plot(result[x][front], result[y][front], "o-", color="tab:red", markersize=4)
    write_atomically(target, lambda path: figure.savefig(path, dpi=150))


def _draw(axis: Any, result: Any, x: str, y: str) -> None:
    """One panel; a logarithmic axis for values over more than a decade."""
    values = result[x]
    numbers = values.dtype.kind in "iuf" and values.ndim == 1
    axis.plot(values if numbers else [str(value) for value in values.tolist()], result[y], ".", color="tab:blue")
    axis.set(xlabel=x, ylabel=y)
    if numbers and np.nanmin(values) > 0.0 and np.nanmax(values) > 10.0 * np.nanmin(values):
        axis.set_xscale("log")


class _Tile(PNGWriter):
    """A picture that is drawn when the colours of all are known."""

    def close(self, sim: Any) -> None:
        assert self._animation is not None
        self.drawn, self._animation.frames = self._animation, [self._frame(sim)]


def draw_sheet(result: Any, target: pathlib.Path, designs: Sequence[int], field: str | None) -> None:
    """Pictures of designs side by side, each with its number and measures. ModelError, OutputError."""
    study = result.study
    scene, columns = find_scene(study.scene, study.source), math.ceil(math.sqrt(len(designs)))
    check_designs("sheet: designs", designs, len(result))
    width, height = PICTURE
    sheet = pillow.Image.new("RGB", (width * columns, height * math.ceil(len(designs) / columns)), "white")
    tiles = []
    for index in designs:
        values = result.design[index]
        group = Group(study, scene, {name: value for name, value in values.items() if name in scene.parameters})
        own = {name: [value] for name, value in values.items() if name not in scene.parameters}
        tile = _Tile(target, field=field, size=PICTURE)
        group.simulate(group.model(1), own, outputs=[tile])
        tiles.append(tile)
    limits = np.array([tile.drawn.color_limits(tile) for tile in tiles])
    low, high = float(limits[:, 0].min()), float(limits[:, 1].max())
    for place, (index, tile) in enumerate(zip(designs, tiles)):
        tile.drawn.color_range = (low, high) if low < high else None
        x, y = width * (place % columns), height * (place // columns)
        (image,) = tile.drawn.draw(PICTURE, tile.view, [0], tile)
        sheet.paste(pillow.Image.fromarray(image).convert("RGB"), (x, y))
        label = f"{index}: " + ", ".join(f"{name} {result[name][index]:.4g}" for name in result.measures)
        pillow.ImageDraw.Draw(sheet).text((x + 8, y + 8), label, fill="black")
    write_atomically(target, lambda path: sheet.save(path))
