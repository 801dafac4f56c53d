"""Frames of a run and their rendering: camera, colour bar, time label, palette of an animation."""

import functools
import pathlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.console import progress_bar
from ..base.lazy import pillow
from ..base.writer import write_atomically
from .colormap import map_colors
from .look import Look
from .obstacles import OBSTACLE_COLOR, clip_to_box
from .overlay import BAR_WIDTH, Overlay, draw_labels, unit_prefix
from .raycaster import Camera, Image, Renderer, to_z_up

__all__ = ["Animation", "Frame"]

Floats = npt.NDArray[np.floating[Any]]
_BODY_COLOR = (0.62, 0.66, 0.72)
# of bodies without a field, by their order
_LEGEND_COLORS = (
    (0.45, 0.60, 0.80), (0.86, 0.62, 0.42), (0.52, 0.72, 0.54), (0.74, 0.56, 0.76), (0.80, 0.76, 0.45),
)  # fmt: skip
REAL_TIME = (2.0, 20.0)
AUTOMATIC_SECONDS = 3.0
"""Run times, s, of which an animation without a speed is shown in real time; else it takes the second."""
MAX_NAME = 40
"""Longest name of a body in a picture; longer ones are cut."""
_LAST_FRAME_SECONDS = 0.6  # duration of the last frame, s


@dataclass
class Frame:
    """One state: time (s), points (P, 3) float32 about the animation's origin (m), values of its field at the bodies'.

    The origin is the centre of the bodies' box at the start.
    """

    time: float
    points: Floats
    values: Floats | None
    marks: Floats | None = None  # (n, 3) points of the animation's marks, about its origin


@dataclass
class Animation:
    """Frames of one surface and their display options.

    Attributes:
        color_range: (low, high); None: the extremes.
        static: the frames' times are load factors.
        body_points: number of points of bodies, which come first; None: all. The others belong to obstacles.
        plane_squares: first of the four points of each square drawn for a half-space.
        origin: (3,) m, the frame's. parts: (name, first point, number of points) of bodies and obstacles.
        rest: (P, 3) points at rest; edges: (E, 2) points along edges of elements, of bodies; None: not known.
        mark_kinds: of the points of marks of frames. label: text in place of the time of a frame.
        by_body: each body has its colour where there is no field.
        worlds: number of worlds in each part.
    """

    triangles: npt.NDArray[np.integer[Any]]
    up_axis: str
    start_points: Floats
    title: str = ""
    units: str = ""
    color_range: tuple[float, float] | None = None
    static: bool = False
    body_points: int | None = None
    plane_squares: list[int] = field(default_factory=list)
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    parts: list[tuple[str, int, int]] = field(default_factory=list)
    rest: Floats | None = None
    edges: npt.NDArray[Any] | None = None
    mark_kinds: list[str] = field(default_factory=list)
    label: str = ""
    by_body: bool = False
    worlds: int = 1
    frames: list[Frame] = field(default_factory=list)

    def draw(
        self, size: tuple[int, int], view: tuple[float, float], chosen: list[int], look: Look | None = None
    ) -> Iterator[Image]:
        """Pictures of the chosen frames; camera, ground and colours are those of all frames."""
        look = look or Look()
        look.check_names([name for name, _, _ in self.parts])
        n = self.body_points or len(self.start_points)
        hidden = self._points_of(look.hide)
        low, high = self.color_limits(look)
        longest = max(abs(frame.time) for frame in self.frames)
        decimals = int(np.clip(3 - np.floor(np.log10(longest)), 1, 12)) if longest > 0 else 1
        barred = self.frames[0].values is not None
        margins = (0.05, BAR_WIDTH if barred else 0.05, 0.09, 0.07)
        swept = to_z_up(self._swept(hidden), self.up_axis)
        camera = Camera.framing(swept, view=view, aspect=size[0] / size[1], margins=margins)
        height, hidden_squares = self._ground_height(camera, look.ground)
        hidden[[first + k for first in hidden_squares for k in range(4)]] = True
        shown = ~hidden[self.triangles[:, 0]]
        used, triangles = np.unique(self.triangles[shown], return_inverse=True)
        renderer = Renderer(
            triangles.reshape(-1, 3), reference=self.start_points[used], up_axis=self.up_axis, ground=height,
            edges=self._used_edges(used) if look.edges else None,
            ghost=self._rest_surface(hidden) if look.undeformed else None,
            cut=self._cut(look) if look.cut else None, **self._surface_options(look, n, shown),
        )  # fmt: skip
        for k in chosen:
            frame = self.frames[k]
            image = renderer.render(
                frame.points[used],
                self._colors(frame, n, low, high, look)[used],
                self._aimed(camera, frame, look),
                size,
            )
            yield draw_labels(
                image,
                self.label or (f"load {100 * frame.time:.4g} %" if self.static else f"t = {frame.time:.{decimals}f} s"),
                (low, high, self.title, self.units, look.colors) if barred else None,
                self._overlay(frame, n, look),
                self._aimed(camera, frame, look),
            )

    def _points_of(self, names: Sequence[str]) -> npt.NDArray[np.bool_]:
        """Mask (P,) of the points of bodies and obstacles."""
        out = np.zeros(len(self.start_points), dtype=bool)
        for name, first, count in self.parts:
            out[first : first + count] |= name in names
        return out

    def _surface_options(self, look: Look, n: int, shown: npt.NDArray[np.bool_]) -> dict[str, Any]:
        """Opacity and grids of the triangles drawn; empty without."""
        first, out = self.triangles[shown][:, 0], {}
        if look.opacity:
            opacity = np.ones(len(self.start_points))
            for name, value in look.opacity.items():
                opacity[self._points_of([name])] = value
            out["opacity"] = opacity[first]
        if look.collider_grid:
            out["gridded"] = first >= n
        return out

    def _swept(self, hidden: npt.NDArray[np.bool_]) -> Floats:
        """Points of all frames that the camera frames: of bodies, and of obstacles next to them."""
        n = self.body_points or len(self.start_points)
        stride = max(1, n * len(self.frames) // 50_000)
        rows = np.flatnonzero(~hidden[:n]) if hidden[:n].any() and not hidden[:n].all() else np.arange(n)
        swept = np.concatenate([frame.points[rows[k % stride :: stride]] for k, frame in enumerate(self.frames)])
        box = swept.min(axis=0), swept.max(axis=0)  # obstacles count in its neighbourhood, for the camera
        others = np.flatnonzero(~hidden[n:]) + n
        obstacles = [clip_to_box(frame.points[others], *box, 0.15) for frame in self.frames if len(others)]
        return np.concatenate([swept, *obstacles])

    def _colors(self, frame: Frame, n: int, low: float, high: float, look: Look) -> Floats:
        """(P, 3) colours of the points of a frame, sRGB."""
        colors = np.full(frame.points.shape, OBSTACLE_COLOR, dtype=np.float32)
        colors[:n] = _BODY_COLOR
        if frame.values is not None:
            finite = np.isfinite(frame.values)
            colors[:n][finite] = map_colors(frame.values[finite], low, high, look.colors)
        elif look.legend or self.by_body:
            for k, (_, first, count) in enumerate(self.parts):
                if first < n:
                    colors[first : first + count] = _LEGEND_COLORS[k % len(_LEGEND_COLORS)]
        return colors

    def _aimed(self, camera: Camera, frame: Frame, look: Look) -> Camera:
        """The camera, moved to a target or a body, and nearer."""
        target = camera.target
        if look.target is not None:
            target = to_z_up(np.asarray([look.target]) - self.origin, self.up_axis)[0]
        if look.follow is not None:
            points = to_z_up(frame.points[self._points_of([look.follow])], self.up_axis)
            target = 0.5 * (points.min(axis=0) + points.max(axis=0))
        eye = target + (camera.eye - camera.target) / look.zoom
        return replace(camera, target=target, eye=eye)

    def _used_edges(self, used: npt.NDArray[np.integer[Any]]) -> npt.NDArray[Any]:
        """Edges among the points drawn; without known ones those of all triangles of bodies."""
        edges = self.edges
        if edges is None:
            n = self.body_points or len(self.start_points)
            triangles = self.triangles[self.triangles[:, 0] < n]
            edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        edges = edges[np.isin(edges, used).all(axis=1)]
        return np.searchsorted(used, edges)

    def _rest_surface(self, hidden: npt.NDArray[np.bool_]) -> tuple[Floats, npt.NDArray[np.integer[Any]]]:
        """Points and triangles of the bodies at rest."""
        n = self.body_points or len(self.start_points)
        triangles = self.triangles[(self.triangles[:, 0] < n) & ~hidden[self.triangles[:, 0]]]
        return self.start_points if self.rest is None else self.rest, triangles

    def _cut(self, look: Look) -> Floats:
        """(4,) section in the frame with z up, about the animation's origin."""
        plane = look.cut_plane()
        plane[3] -= plane[:3] @ self.origin
        plane[:3] = to_z_up(plane[None, :3], self.up_axis)[0]
        return np.asarray(plane)

    def _overlay(self, frame: Frame, n: int, look: Look) -> Overlay:
        """Marks, names, extremes and axes of a frame."""
        out = Overlay(axes=to_z_up(np.eye(3), self.up_axis) if look.axes else None)
        if frame.marks is not None and len(frame.marks):
            points = to_z_up(frame.marks, self.up_axis)
            out.marks = [(kind, point) for kind, point in zip(self.mark_kinds, points) if kind in look.marks]
        points = to_z_up(frame.points, self.up_axis)
        if look.legend:
            for name, first, count in self.parts:
                if first < n and name not in look.hide:
                    short = name if len(name) <= MAX_NAME else f"{name[: MAX_NAME - 3]}..."
                    one = points[first : first + count // self.worlds]  # in the first world
                    out.texts.append((short, one.mean(axis=0), False))
        if look.extremes and frame.values is not None and np.isfinite(frame.values).any():
            for what, find in (("min", np.nanargmin), ("max", np.nanargmax)):
                k = int(find(frame.values))
                factor, prefix = unit_prefix(abs(float(frame.values[k])), self.units)
                text = f"{what} {frame.values[k] / factor:.4g} {prefix}{self.units}"
                out.texts.append((text, points[k], True))
        return out

    def _ground_height(self, camera: Camera, wanted: bool | None) -> tuple[float | None, list[int]]:
        """Height of the ground, and hidden squares.

        A horizontal fixed half-space is the ground; with other half-spaces there is none, without any it is at the
        lowest point if it is `wanted`. Squares seen from behind are hidden, as they would cover the bodies.
        """
        level: dict[int, float] = {}
        hidden_squares = []
        slack = 1e-5 * camera.size
        for first in self.plane_squares:
            squares = [to_z_up(frame.points[first : first + 4], self.up_axis) for frame in self.frames]
            heights = np.array([square[:, 2] for square in squares])
            normals = [np.cross(square[1] - square[0], square[2] - square[1]) for square in squares]
            if np.ptp(heights) <= slack and normals[0][2] > 0.0:
                level[first] = float(heights.mean())
            elif any((camera.eye - square[0]) @ normal <= 0.0 for square, normal in zip(squares, normals)):
                hidden_squares.append(first)
        if wanted is False:
            return None, hidden_squares + list(level)
        if not self.plane_squares and not wanted:
            return None, hidden_squares
        if not self.plane_squares:
            up = 2 if self.up_axis == "Z" else 1
            return min(float(frame.points[:, up].min()) for frame in self.frames), hidden_squares
        if not level or max(level.values()) - min(level.values()) > slack:
            return None, hidden_squares
        return max(level.values()), hidden_squares + list(level)

    def color_limits(self, look: Look) -> tuple[float, float]:
        """Colour range: as given, or the extremes, or percentiles, over all frames."""
        if self.color_range is not None and look.percentile is None and look.range_body is None:
            return self.color_range
        all_values = [frame.values for frame in self.frames if frame.values is not None]
        if look.range_body is not None:
            mask = self._points_of([look.range_body])
            all_values = [values[mask[: len(values)]] for values in all_values]
        values = [v[np.isfinite(v)] for v in all_values if np.isfinite(v).any()]
        if not values:
            return 0.0, 0.0
        if look.percentile is not None:
            low, high = np.percentile(np.concatenate(values), look.percentile)
            return float(low), float(high)
        return min(float(v.min()) for v in values), max(float(v.max()) for v in values)

    def thin_frames(self, fps: float) -> float:
        """Keep the frames that an animation of `fps` needs; returns its simulated seconds per second.

        Real time within `REAL_TIME` seconds, else such that it takes `AUTOMATIC_SECONDS`.
        """
        times = np.array([frame.time for frame in self.frames])
        span = float(times[-1] - times[0])
        real = REAL_TIME[0] <= span <= REAL_TIME[1] and not self.static
        seconds = span if real else AUTOMATIC_SECONDS
        wanted = np.linspace(times[0], times[-1], round(seconds * fps) + 1)
        chosen = np.unique(np.abs(times[:, None] - wanted).argmin(axis=0))
        self.frames = [self.frames[k] for k in chosen]
        return span / seconds or 1.0

    def save_png(self, target: pathlib.Path, size: tuple[int, int], view: tuple[float, float], look: Look) -> None:
        """Draw the last frame. OutputError if the file can't be written."""
        image = next(self.draw(size, view, [len(self.frames) - 1], look))
        write_atomically(target, lambda path: pillow.Image.fromarray(image).save(path, format="PNG"))

    def save_gif(
        self,
        target: pathlib.Path,
        size: tuple[int, int],
        view: tuple[float, float],
        look: Look,
        speed: float = 1.0,
        progress: bool | None = None,
    ) -> None:
        """Draw all frames, with one palette made from five of them."""
        count = len(self.frames)
        palette_frames = sorted({round(k) for k in np.linspace(0, count - 1, min(5, count))})
        some = dict(zip(palette_frames, self.draw(size, view, palette_frames, look)))
        palette = make_palette(list(some.values()), self.frames[0].values is not None, look.colors)
        others = self.draw(size, view, [k for k in range(count) if k not in some], look)
        clock = np.round(np.array([frame.time for frame in self.frames]) / speed * 100.0)
        durations = [int(d) for d in np.maximum(np.diff(clock), 2.0) * 10.0] + [int(1000 * _LAST_FRAME_SECONDS)]
        with progress_bar("drawing", "frame", count, progress) as bar:
            pictures = []
            for k in range(count):
                pictures.append(to_palette(some[k] if k in some else next(others), palette))
                bar.update()

        def save(path: pathlib.Path) -> None:
            pictures[0].save(path, format="GIF", save_all=True, append_images=pictures[1:], duration=durations, loop=0)

        write_atomically(target, save)


def make_palette(images: list[Image], barred: bool, name: str = "viridis") -> Any:
    """A PIL picture holding 256 colours for all `images`.

    With a colour bar 64 of them are the colour map. Vivid pixels (bodies) and dull ones (ground, sky) are
    quantised separately, since the latter are numerous and smooth and would take nearly all entries.
    """
    colors = np.round(255 * map_colors(np.linspace(0, 1, 64 if barred else 0), 0, 1, name)).astype(np.uint8)
    pixels = np.concatenate([image[::2, ::2].reshape(-1, 3) for image in images])
    vivid = np.max(pixels, axis=1).astype(int) - np.min(pixels, axis=1) > 40
    room = {False: 64, True: 128} if barred else {False: 256}
    for kind, count in room.items():
        fraction = pixels[vivid == kind] if barred else pixels
        if len(fraction):
            picture = pillow.Image.fromarray(np.ascontiguousarray(fraction[None]))
            found = picture.quantize(count, method=pillow.Image.Quantize.MEDIANCUT, kmeans=1).getpalette() or []
            colors = np.concatenate([colors, np.array(found, dtype=np.uint8).reshape(-1, 3)[:count]])
    palette = pillow.Image.new("P", (1, 1))
    palette.putpalette(colors.ravel().tolist())
    return palette


@functools.lru_cache(maxsize=4)
def _dither(height: int, width: int) -> npt.NDArray[np.int16]:
    """(height, width, 1) thresholds of -4 to 4 in squares of 8 x 8 pixels."""
    pattern = np.zeros((1, 1))
    for _ in range(3):
        pattern = np.block([[4 * pattern, 4 * pattern + 2], [4 * pattern + 3, 4 * pattern + 1]])
    steps = np.round((pattern / 63.0 - 0.5) * 8.0).astype(np.int16)
    return np.tile(steps, (height // 8 + 1, width // 8 + 1))[:height, :width, None]


def to_palette(image: Image, palette: Any) -> Any:
    """Picture in the palette's colours, with ordered dithering: no banding, static pattern."""
    spread = np.clip(image + _dither(*image.shape[:2]), 0, 255).astype(np.uint8)
    return pillow.Image.fromarray(spread).quantize(palette=palette, dither=pillow.Image.Dither.NONE)
