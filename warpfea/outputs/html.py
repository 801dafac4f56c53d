"""`HTMLWriter`: the page of a run, one file for any browser with WebGL2, without a network."""

import os
import pathlib
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.checks import is_count
from ..base.console import format_number
from ..base.errors import ModelError, OutputError
from ..base.notebook import page_frame
from ..base.provenance import versions
from ..base.writer import Output, check_target, write_atomically
from ..model.surfaces import reference_points
from ..simulation.plots import energy_plot, record_plots, run_warnings
from .frames import (
    DrawnSurface,
    FrameClock,
    check_colors,
    check_fields,
    field_label,
    field_names,
    frame_time,
    is_static,
)
from .markers import Markers, group_marks
from .page import Page, PageSurface
from .raycaster import DEFAULT_VIEW, check_view

__all__ = ["MAX_WORLDS", "HTMLWriter"]

Array = npt.NDArray[Any]
MAX_WORLDS = 64
"""Largest number of worlds in a page."""


@dataclass
class _Snapshot:
    """Data of a frame: time, points of all surfaces (W, P, 3), fields of bodies (W, P), energies, load directions."""

    time: float
    points: list[Array]
    values: dict[str, list[Array]]
    energies: dict[str, Array]
    vectors: list[Array | None]


@dataclass(eq=False, repr=False)
class HTMLWriter(Output):
    """Writes `path` (.html): a page that turns, plays and cuts the model, with its fields and records.

    Args:
        fps: frames per simulated second; above `max_frames` every second frame is dropped and the rate halved.
        fields: scalar fields of the page. color: the one shown first, or None for grey.
        color_range: (low, high) of it, by default its extremes over all frames.
        worlds: numbers of the worlds shown, at most 64; by default the first 16.
        view: (azimuth, elevation) of the camera, degrees. spacing: of worlds on their grid (m), as for USDWriter.
        title: of the page, by default the name of the file. parameters, command: of the run, told on the page.

    Frames are kept in memory (float32) and written at `close`.

    ModelError: a bad option. OutputError: a bad suffix or folder, worlds that the model lacks (at `open`), a file that
    can't be written (at `close`).
    """

    path: str | os.PathLike[str]
    _: KW_ONLY
    fps: float = 60.0
    max_frames: int = 120
    fields: Sequence[str] = ("von_mises", "displacement")
    color: str | None = "von_mises"
    color_range: tuple[float, float] | None = None
    worlds: Sequence[int] | None = None
    view: tuple[float, float] = DEFAULT_VIEW
    spacing: float | tuple[float, float] | None = None
    title: str | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)
    command: str | None = None

    def __post_init__(self) -> None:
        self.path = pathlib.Path(self.path)
        self.rate = FrameClock(self.fps).fps
        self.view, self.color_range = check_view(self.view), check_colors(self.color_range)
        names = field_names(self.fields, self.color)
        if not isinstance(self.title, (str, type(None))) or not isinstance(self.parameters, Mapping):
            raise ModelError(
                f"title must be a text and parameters a dictionary, got {self.title!r} and {self.parameters!r}"
            )
        if not (is_count(self.max_frames) and self.max_frames >= 2):
            raise ModelError(f"max_frames must be at least 2, got {self.max_frames!r}")
        self._names = sorted(names, key=lambda name: name != self.color)
        self._frames: list[_Snapshot] | None = None

    def open(self, sim: Any) -> None:
        self.abort()
        self._target = check_target(self.path, (".html", ".htm"))
        check_fields(sim, self._names)
        count = int(sim.model.worlds)
        given: Any = range(min(count, 16)) if self.worlds is None else self.worlds
        worlds = list(given) if np.iterable(given) else []
        whole = all(is_count(w) and 0 <= w < count for w in worlds) and len(set(worlds)) == len(worlds)
        if not (whole and 0 < len(worlds) <= MAX_WORLDS):
            raise OutputError(
                f"worlds: a page shows 1 to {MAX_WORLDS} of the worlds 0 to {count - 1}, each once, got {given!r}"
            )
        self._worlds = worlds = [int(w) for w in worlds]
        self._surface = DrawnSurface(sim, self.spacing)
        self._markers = Markers(sim, self._surface.bodies)
        self._clock = FrameClock(self.fps)
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for body in self._surface.bodies:
            points = self._surface.skin_points(sim, body, worlds)
            low, high = np.minimum(low, points.min(axis=(0, 1))), np.maximum(high, points.max(axis=(0, 1)))
        self._origin = 0.5 * (low + high)
        self._frames = []

    def write(self, sim: Any) -> None:
        if self._frames is not None and self._clock.due(frame_time(sim)):
            self._append(sim)

    def _append(self, sim: Any) -> None:
        assert self._frames is not None
        bodies, worlds, time = self._surface.bodies, self._worlds, frame_time(sim)
        blocks = [self._surface.skin_points(sim, body, worlds) for body in bodies]
        blocks += [points[worlds] for points in self._surface.obstacles.points()]
        blocks.append(self._markers.points(sim, worlds=worlds))
        points = [np.asarray(block - self._origin, dtype=np.float32) for block in blocks]
        values = {
            name: [np.asarray(sim.skin_field(name, body, worlds), dtype=np.float32) for body in bodies]
            for name in self._names
        }
        energies = {} if is_static(sim) or not _has_ledger(sim) else sim.energies()
        vectors = self._markers.vectors(*((0.0, time) if is_static(sim) else (time, 1.0)))
        self._frames.append(_Snapshot(time, points, values, energies, vectors))
        if len(self._frames) > self.max_frames:
            del self._frames[1::2]
            slower = FrameClock(0.5 * self._clock.fps)
            slower.due(self._frames[-1].time)
            self._clock = slower

    def close(self, sim: Any) -> None:
        if self._frames is None:
            return
        try:
            if frame_time(sim) > self._clock.last:
                self._append(sim)
            text = self.page(sim).html()
            write_atomically(self._target, lambda path: path.write_text(text, encoding="utf-8"))
        finally:
            self.abort()

    def abort(self) -> None:
        """Discard the frames; nothing is on disk before `close`."""
        self._frames = None

    def _repr_html_(self) -> str:
        """The page in a frame of a notebook, once it is written."""
        file = pathlib.Path(self.path)
        return page_frame(file.read_text("utf-8")) if file.is_file() else ""

    def page(self, sim: Any) -> Page:
        """The page of the frames so far."""
        assert self._frames
        frames = self._frames
        texts = [(name, format_number(v, 6) if isinstance(v, float) else str(v)) for name, v in self.parameters.items()]
        pairs = [(str(name), text) for name, text in texts if text not in ("None", "", "[]")]
        page = Page(
            self.title or getattr(sim, "label", "") or pathlib.Path(self.path).stem,
            ", ".join(f"{name} = {value}" for name, value in pairs),
            self._surface.up_axis, is_static(sim), self._origin, self._surface.offsets[: len(self._worlds)],
            self._worlds, {name: field_label(sim, name) for name in self._names}, self.color, self.color_range,
            self.view, self._surfaces(), [frame.time for frame in frames],
        )  # fmt: skip
        page.markers = self._marks(len(page.surfaces) - 1)
        recorded = hasattr(sim, "statistics")
        page.plots = record_plots(sim, self._worlds) if recorded else []
        page.plots += energy_plot(page.times, [frame.energies for frame in frames if frame.energies], self._worlds)
        page.warnings = run_warnings(sim)
        facts = {"simulation": repr(sim) if recorded else "", "command": str(self.command or "")}
        facts |= dict(pairs) | versions()
        page.facts = [(name, text) for name, text in facts.items() if text]
        return page

    def _surfaces(self) -> list[PageSurface]:
        """Bodies, obstacles and points of marks, in the order of the points of frames."""
        from scipy.spatial import cKDTree

        assert self._frames
        frames, out = self._frames, []
        for k, body in enumerate(self._surface.bodies):
            first = frames[0].points[k]
            rest, nodes, edges = first, None, getattr(body.skin, "edges", None)
            if hasattr(body.skin, "slot_weights"):
                reference = reference_points(body, body.skin.slot_weights)
                rest = np.broadcast_to(reference - self._origin, first.shape)
                drawn = np.unique(body.skin.node_weights.indices // body.family.node_samples.shape[1])
                nodes = drawn[cKDTree(body.mesh.points[drawn]).query(reference)[1]]
            surface = PageSurface(body.name, "body", rest, body.skin.triangles, edges, nodes)
            surface.values = {name: [frame.values[name][k] for frame in frames] for name in self._names}
            out.append(surface)
        for obstacle in self._surface.obstacles.all:
            kind = "plane" if obstacle.is_plane else "collider"
            out.append(PageSurface(obstacle.name, kind, frames[0].points[len(out)], obstacle.triangles))
        out.append(PageSurface("marks", "points", frames[0].points[-1]))
        for k, surface in enumerate(out):
            still = all((frame.points[k] == frames[0].points[k]).all() for frame in frames)
            surface.points = [frame.points[k] for frame in (frames[:1] if still else frames)]
        return [surface for surface in out if surface.rest.shape[1]]

    def _marks(self, last: int) -> list[dict[str, Any]]:
        """Markers for the page; `last`: the surface of their own points."""
        assert self._frames
        out: list[dict[str, Any]] = []
        mark: dict[str, Any]
        for kind, name, body, points in self._markers.on_surface:
            mark = {"kind": "support" if kind == "support" else "load", "name": name, "surface": body}
            out.append({**mark, "points": points.tolist()} | ({"normal": 1} if kind == "pressure" else {}))
        rows = [frame.vectors for frame in self._frames]
        sizes = [float(np.linalg.norm(v)) for row in rows for v in row if v is not None]
        largest = max(sizes, default=0.0) or 1.0
        for kind, group in group_marks([kind for kind, _ in self._markers.own]):
            k = group[0]
            mark = {"kind": kind, "name": self._markers.own[k][1], "surface": last, "points": group}
            if rows[0][k] is not None:
                mark["vectors"] = [[round(float(x), 4) for x in np.asarray(row[k]) / largest] for row in rows]
            out.append(mark)
        return out


def _has_ledger(sim: Any) -> bool:
    """True for a simulation that keeps the ledger of energies."""
    return bool(getattr(getattr(sim, "stepper", None), "ledger", False))
