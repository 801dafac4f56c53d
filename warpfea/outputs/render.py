"""Pictures and animations: `PNGWriter` and `GIFWriter` of a run, `render_usd` of a file made by `USDWriter`.

Common layout: parallel worlds laid out on the same grid as in the USD file, a camera that frames the whole motion,
one colour range for all frames, a colour bar and the time.
"""

import os
import pathlib
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..base.checks import is_count, is_number
from ..base.errors import ModelError
from ..base.lazy import pxr
from ..base.names import did_you_mean
from ..base.writer import Output, check_target, write_atomically
from .animation import Animation, Frame
from .frames import DrawnSurface, FrameClock, check_colors, check_fields, field_label, frame_time, is_static
from .look import Look
from .markers import MARKED_WORLDS, Markers
from .raycaster import DEFAULT_VIEW, Camera, Renderer, check_view
from .usd_check import error_text
from .usd_marks import read_kinds, stage_marks
from .usd_obstacles import EDGES
from .usd_page import usd_page

__all__ = ["Camera", "GIFWriter", "PNGWriter", "Renderer", "render_usd"]

Floats = npt.NDArray[np.floating[Any]]
EVERY_STEP = 1e12
"""Frames per second of a clock by which every step is due."""


def _checked_size(size: Any) -> tuple[int, int]:
    try:
        width, height = size
        valid = all(32 <= k <= 8192 and k == int(k) for k in (width, height))
    except (TypeError, ValueError):
        valid = False
    if not valid:
        raise ModelError(f"size: a picture must have (width, height) of 32 to 8192 pixels each way, got {size!r}")
    return int(width), int(height)


@dataclass(eq=False, repr=False)
class _PictureWriter(Look, Output):
    """Common parts of PNGWriter and GIFWriter: collection of frames."""

    path: str | os.PathLike[str]
    _: KW_ONLY
    field: str | None = "von_mises"
    size: tuple[int, int] = (960, 540)
    view: tuple[float, float] = DEFAULT_VIEW
    color_range: tuple[float, float] | None = None
    spacing: float | tuple[float, float] | None = None
    suffix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        if not isinstance(self.field, (str, type(None))):
            raise ModelError(f"field must be the name of a field, or None for grey, got {self.field!r}")
        self.path = pathlib.Path(self.path)
        self.size, self.view = _checked_size(self.size), check_view(self.view)
        self.color_range = check_colors(self.color_range)
        self.check_look()
        self._animation: Animation | None = None

    def open(self, sim: Any) -> None:
        self.abort()
        self._target = check_target(self.path, (self.suffix,))
        check_fields(sim, [self.field] if self.field else [])
        self._surface = DrawnSurface(sim, self.spacing)
        start = self._surface.points(sim)
        body_points = start[: self._surface.body_points]
        self._origin = 0.5 * (body_points.min(axis=0) + body_points.max(axis=0))
        rest = self._surface.rest_points(start)
        self._rest = np.asarray(rest - self._origin, dtype=np.float32)
        rigid = all(getattr(body, "rigid", False) for body in self._surface.bodies)
        self._shown = None if rigid and self.field == "von_mises" else self.field  # rigid parts have no stress
        title, units = field_label(sim, self._shown) if self._shown else ("", "")
        animation = self._animation = Animation(
            self._surface.triangles(), self._surface.up_axis, np.asarray(start - self._origin, dtype=np.float32), title,
            units, self.color_range, is_static(sim), self._surface.body_points, self._surface.plane_squares(),
        )  # fmt: skip
        animation.origin, animation.parts, animation.rest = self._origin, self._surface.parts(), self._rest
        animation.label, animation.by_body = getattr(sim, "label", ""), rigid
        animation.worlds = self._surface.worlds
        self.check_names([name for name, _, _ in animation.parts])
        if self.edges:
            animation.edges = self._surface.edges()
        self._markers = Markers(sim, self._surface.bodies) if self._surface.worlds <= MARKED_WORLDS else None
        if self._markers is not None:
            animation.mark_kinds = self._markers.kinds(self._surface.worlds)

    def _frame(self, sim: Any) -> Frame:
        assert self._animation is not None
        points = np.asarray(self._surface.points(sim) - self._origin, dtype=np.float32)
        n = self._surface.body_points
        points[:n] = self._rest[:n] + self.scale * (points[:n] - self._rest[:n])
        marks = None
        if self._markers is not None:
            own = self._markers.points(sim, self.scale) + self._surface.offsets[:, None, :] - self._origin
            firsts = [first for _, first, _ in self._animation.parts]
            marks = self._markers.all_points(points, firsts, self._surface.point_counts, own)
        return Frame(frame_time(sim), points, self._surface.values(sim, self._shown) if self._shown else None, marks)

    def abort(self) -> None:
        """Discard the frames; nothing is on disk before `close`."""
        self._animation = None


@dataclass(eq=False, repr=False, kw_only=True)
class PNGWriter(_PictureWriter):
    """Draws one state to `path` (.png).

    Args:
        field: scalar shown in colour, or None for grey. size: (width, height), pixels.
        time: the first state at or after this time (s) is drawn; without it, or if never reached, the last.
        view: (azimuth, elevation) of the camera, degrees.
        color_range: (low, high) of the colours, by default the extremes of the drawn values.
        spacing: distance of neighbouring worlds (m), one number or (x, y).
        ground, marks, axes, edges, undeformed, scale, extremes, legend, hide, opacity, collider_grid, colors, target,
        zoom, follow, cut, percentile, range_body: see :class:`warpfea.outputs.look.Look`.

    ModelError: a bad size, view or field. OutputError: a bad colour range, a bad suffix or folder (at `open`), a file
    that can't be written (at `close`).
    """

    time: float | None = None
    suffix = ".png"
    animates = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.time is not None and not is_number(self.time):
            raise ModelError(f"time must be a finite number of seconds, or None for the last state, got {self.time!r}")
        self.output_times = () if self.time is None else (self.time,)

    def write(self, sim: Any) -> None:
        if self._animation is None or self.time is None or self._animation.frames:
            return
        if frame_time(sim) >= self.time - 1e-9 * max(1.0, abs(self.time)):
            self._animation.frames = [self._frame(sim)]

    def close(self, sim: Any) -> None:
        if self._animation is None:
            return
        try:
            self._animation.frames = self._animation.frames or [self._frame(sim)]
            self._animation.save_png(self._target, self.size, self.view, self)
        finally:
            self.abort()


@dataclass(eq=False, repr=False, kw_only=True)
class GIFWriter(_PictureWriter):
    """Draws an animation to `path` (.gif).

    Args:
        fps: frames per second of the animation, at most 50 (the format counts hundredths of a second).
        speed: simulated seconds per second of the animation; None: real time where that takes 2 to 20 s, else slower or
            faster, so that it takes 3 s.
        max_frames: above this, every second one is dropped and the frame rate halved.
        progress: show a bar while drawing; None: if stderr is a terminal.
        field, size, view, color_range, spacing, and what is drawn beside: see :class:`PNGWriter`.

    Frames (points and field, float32) are kept in memory and drawn at `close`, when the colour range is known.
    """

    size: tuple[int, int] = (640, 360)
    fps: float = 20.0
    speed: float | None = None
    max_frames: int = 240
    progress: bool | None = None
    suffix = ".gif"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rates(self.fps, self.speed, self.max_frames)
        self.rate = None if self.speed is None else self.fps / self.speed

    def open(self, sim: Any) -> None:
        super().open(sim)
        self._clock = FrameClock(self.rate or EVERY_STEP)

    def write(self, sim: Any) -> None:
        if self._animation is not None and self._clock.due(frame_time(sim)):
            self._append(sim)

    def _append(self, sim: Any) -> None:
        assert self._animation is not None
        frames = self._animation.frames
        frames.append(self._frame(sim))
        if len(frames) > self.max_frames:
            del frames[1::2]
            slower = FrameClock((len(frames) - 1) / (frames[-1].time - frames[0].time))
            slower.due(frames[-1].time)
            self._clock = slower

    def close(self, sim: Any) -> None:
        if self._animation is None:
            return
        try:
            if frame_time(sim) > self._clock.last:
                self._append(sim)
            speed = self.speed
            if speed is None:
                speed = self._animation.thin_frames(self.fps)
            self._animation.save_gif(self._target, self.size, self.view, self, speed, self.progress)
        finally:
            self.abort()


def check_rates(fps: float, speed: float | None, max_frames: int) -> None:
    """ModelError for invalid options of an animation."""
    if not (is_number(fps) and 0 < fps <= 50):
        raise ModelError(f"a GIF plays up to 50 frames per second, got fps={fps!r}")
    if speed is not None and not (is_number(speed) and speed > 0):
        raise ModelError(f"speed must be positive and finite, got {speed!r}")
    if not (is_count(max_frames) and max_frames >= 2):
        raise ModelError(f"max_frames must be at least 2, got {max_frames!r}")


def render_usd(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    fps: float = 20.0,
    speed: float = 1.0,
    max_frames: int = 240,
    field: str | None = None,
    time: float | None = None,
    view: tuple[float, float] = DEFAULT_VIEW,
    color_range: tuple[float, float] | None = None,
    progress: bool | None = None,
    **look: Any,
) -> pathlib.Path:
    """Draw a USD file of :class:`warpfea.USDWriter` to `out` (.png, .gif or .html) and return that path.

    Args:
        field: a field of the file, or "none" for grey; None: the field of its colours.
        time: of the state drawn to a PNG (s); None: the last in the file.
        fps, speed, max_frames: of a GIF, which spans the whole file; more frames are spread over the span. A page
            holds the frames of the file, every n-th one above max_frames.
        color_range: (low, high) of the colours; None: those of the file, or the extremes of the run.
        size: (width, height), default (960, 540) for PNG and (640, 360) for GIF.
        look: options of :class:`warpfea.outputs.look.Look`.

    Raises:
        ModelError: an option out of range, a file that is missing or not one of warpfea, no such field or time.
        OutputError: `out` can't be written, or has an unknown suffix.
    """
    target = check_target(out, (".png", ".gif", ".html"))
    animated = target.suffix.lower() == ".gif"
    size = _checked_size(size or ((640, 360) if animated else (960, 540)))
    check_rates(fps, speed, max_frames)
    color_range = check_colors(color_range)
    view = check_view(view)
    options = Look(**look)
    options.check_look()
    source = _StageReader(pathlib.Path(path))
    if target.suffix.lower() == ".html":
        text = usd_page(source, field, view, color_range, max_frames).html()
        write_atomically(target, lambda to: to.write_text(text, encoding="utf-8"))
        return target
    if animated:
        count = int(np.floor((source.end - source.start) * fps / speed * (1 + 1e-9))) + 1
        times = source.start + np.arange(count) * speed / fps
        if times[-1] < source.end - 1e-9 * max(1.0, abs(source.end)):
            times = np.append(times, source.end)
        if len(times) > max_frames:
            times = np.linspace(source.start, source.end, max_frames)
    else:
        at = source.end if time is None else float(time)
        slack = 1e-6 * max(1.0, source.end - source.start)
        if not source.start - slack <= at <= source.end + slack:
            raise ModelError(f"{path}: time {at:g} s lies outside {source.start:g} .. {source.end:g} s")
        times = np.array([at])
    animation = source.animation(field, times)
    animation.color_range = color_range or animation.color_range
    if animated:
        animation.save_gif(target, size, view, options, speed, progress)
    else:
        animation.save_png(target, size, view, options)
    return target


class _StageReader:
    """A stage written by USDWriter, opened for drawing."""

    def __init__(self, path: pathlib.Path) -> None:
        self.path = path
        if not path.is_file():
            raise ModelError(f"{path}: no such file")
        try:
            self.stage = pxr.Usd.Stage.Open(str(path))
        except pxr.Tf.ErrorException as error:
            raise ModelError(f"{path}: can't be read as USD ({error_text(error)})") from error
        meshes = [pxr.UsdGeom.Mesh(prim) for prim in self.stage.Traverse() if prim.IsA(pxr.UsdGeom.Mesh)]
        self.obstacles = [mesh for mesh in meshes if mesh.GetPrim().GetCustomDataByKey("warpfea:collider")]
        self.meshes = [mesh for mesh in meshes if not mesh.GetPrim().GetCustomDataByKey("warpfea:collider")]
        self.marks = stage_marks(self.stage)
        if not self.meshes:
            raise ModelError(f"{path}: holds no mesh")
        root = self.stage.GetDefaultPrim()
        self.metadata: Any = root.GetCustomDataByKey("warpfea") if root else None
        if not self.metadata:
            raise ModelError(f"{path}: was not written by warpfea")
        self.rate = self.stage.GetTimeCodesPerSecond()
        self.start, self.end = self.stage.GetStartTimeCode() / self.rate, self.stage.GetEndTimeCode() / self.rate

    def field_name(self, field: str | None) -> str | None:
        """Name of the field drawn, None for grey. ModelError for one that the file lacks."""
        name = None if field == "none" else field or self.metadata["color"] or None
        if name is not None and name not in self.metadata["fields"]:
            have = ", ".join(self.metadata["fields"]) or "none"
            hint = did_you_mean(name, self.metadata["fields"])
            raise ModelError(f"{self.path}: has no field {name!r}; fields: {have}{hint}")
        return name

    def animation(self, field: str | None, times: Floats) -> Animation:
        """Frames at `times` (s); USD interpolates linearly between samples."""
        name = self.field_name(field)
        triangles, point_offset, body_points, plane_squares = [], 0, 0, []
        parts: list[tuple[str, int, int]] = []
        edges: list[npt.NDArray[Any]] = []
        for k, mesh in enumerate(self.meshes + self.obstacles):
            counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get())
            if (counts != 3).any():
                raise ModelError(f"{self.path}: {mesh.GetPath()} has faces that are not triangles")
            triangles.append(np.asarray(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3) + point_offset)
            if mesh.GetPrim().GetCustomDataByKey("warpfea:collider") == "HalfSpace":
                plane_squares.append(point_offset)
            count = len(mesh.GetPointsAttr().Get(self.start * self.rate))
            parent = mesh.GetPrim().GetParent()
            parts.append((parent.GetDisplayName() or parent.GetName(), point_offset, count))
            if k < len(self.meshes):
                attribute = mesh.GetPrim().GetAttribute(EDGES)
                edges.append(
                    np.asarray(attribute.Get()).reshape(-1, 2) + point_offset if attribute else np.zeros((0, 2))
                )
                body_points = point_offset + count
            point_offset += count
        start = self._points(self.start)
        self.origin = 0.5 * (start[:body_points].min(axis=0) + start[:body_points].max(axis=0))
        reference = np.asarray(start - self.origin, dtype=np.float32)
        animation = Animation(np.concatenate(triangles), str(pxr.UsdGeom.GetStageUpAxis(self.stage)), reference)
        animation.static = bool(self.metadata.get("static", False))
        animation.body_points, animation.plane_squares = body_points, plane_squares
        animation.origin, animation.parts = self.origin, parts
        if all(len(pairs) for pairs in edges):
            animation.edges = np.concatenate(edges)
        if name is not None:
            field_metadata = self.metadata["fields"][name]
            pair = self.metadata["colorRange"] if name == self.metadata["color"] else field_metadata["range"]
            animation.title, animation.units = field_metadata["title"], field_metadata["units"]
            animation.color_range = pair[0], pair[1]
        animation.mark_kinds = read_kinds(self.marks)
        for time in map(float, times):
            points = np.asarray(self._points(time) - self.origin, dtype=np.float32)
            marks = self._points_of(self.marks, time) - self.origin if self.marks else None
            animation.frames.append(Frame(time, points, self._values(name, time) if name else None, marks))
        return animation

    def _points(self, time: float) -> npt.NDArray[np.float64]:
        """(P, 3) points of all meshes in the world (m), of the bodies first."""
        return self._points_of(self.meshes + self.obstacles, time)

    def _points_of(self, prims: list[Any], time: float) -> npt.NDArray[np.float64]:
        """(P, 3) points of prims in the world (m)."""
        code = time * self.rate
        cache = pxr.UsdGeom.XformCache(code)
        blocks = []
        for mesh in prims:
            matrix = np.array(cache.GetLocalToWorldTransform(mesh.GetPrim()))
            local = np.asarray(mesh.GetPointsAttr().Get(code), dtype=np.float64)
            blocks.append(local @ matrix[:3, :3] + matrix[3, :3])
        return np.concatenate(blocks)

    def _values(self, name: str, time: float) -> npt.NDArray[np.float32]:
        key = pxr.Tf.MakeValidIdentifier(name)
        primvars = [pxr.UsdGeom.PrimvarsAPI(mesh).GetPrimvar(key) for mesh in self.meshes]
        return np.concatenate([np.asarray(p.Get(time * self.rate), dtype=np.float32) for p in primvars])
