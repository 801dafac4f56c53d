"""Frames of a run and their rendering: camera, colour bar, time label, palette of an animation."""

import pathlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.console import progress_bar
from ..base.lazy import pillow
from ..base.writer import write_atomically
from .colormap import map_colors
from .obstacles import OBSTACLE_COLOR, clip_to_box
from .raycaster import Camera, Image, Renderer, to_z_up

__all__ = ["Animation", "Frame"]

Floats = npt.NDArray[np.floating[Any]]
_TEXT_COLOR = (45, 50, 60)
_BODY_COLOR = (0.62, 0.66, 0.72)
_BAR_WIDTH = 0.17  # width fraction of the colour bar
# the font has no µ
_UNIT_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "u"), (1e-9, "n"))
_LAST_FRAME_SECONDS = 0.6  # duration of the last frame, s


@dataclass
class Frame:
    """One state: time (s), points (P, 3) float32 about the animation's origin (m), values of its field at the bodies'.

    The origin is the centre of the bodies' box at the start.
    """

    time: float
    points: Floats
    values: Floats | None


@dataclass
class Animation:
    """Frames of one surface and their display options.

    Attributes:
        color_range: (low, high); None: the extremes.
        static: the frames' times are load factors.
        body_points: number of points of bodies, which come first; None: all. The others belong to obstacles.
        plane_squares: first of the four points of each square drawn for a half-space.
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
    frames: list[Frame] = field(default_factory=list)

    def draw(
        self, size: tuple[int, int], view: tuple[float, float], chosen: list[int], ground: bool = True
    ) -> Iterator[Image]:
        """Pictures of the chosen frames; camera, ground and colours are those of all frames."""
        n = self.body_points or len(self.start_points)
        stride = max(1, n * len(self.frames) // 50_000)
        swept = np.concatenate([frame.points[k % stride : n : stride] for k, frame in enumerate(self.frames)])
        box = swept.min(axis=0), swept.max(axis=0)  # obstacles count in its neighbourhood, for the camera
        obstacles = [clip_to_box(frame.points[n:], *box, 0.15) for frame in self.frames if len(frame.points) > n]
        swept = np.concatenate([swept, *obstacles])
        low, high = self.color_limits()
        longest = max(abs(frame.time) for frame in self.frames)
        decimals = int(np.clip(3 - np.floor(np.log10(longest)), 1, 12)) if longest > 0 else 1
        barred = self.frames[0].values is not None
        margins = (0.05, _BAR_WIDTH if barred else 0.05, 0.09, 0.07)
        camera = Camera.framing(to_z_up(swept, self.up_axis), view=view, aspect=size[0] / size[1], margins=margins)
        height, hidden_squares = self._ground_height(camera)
        shown = ~np.isin(self.triangles[:, 0], [first + k for first in hidden_squares for k in range(4)])
        used, triangles = np.unique(self.triangles[shown], return_inverse=True)
        renderer = Renderer(
            triangles.reshape(-1, 3),
            reference=self.start_points[used],
            up_axis=self.up_axis,
            ground=height if ground else None,
        )
        for k in chosen:
            frame = self.frames[k]
            colors = np.full(frame.points.shape, OBSTACLE_COLOR, dtype=np.float32)
            colors[:n] = _BODY_COLOR
            if frame.values is not None:
                finite = np.isfinite(frame.values)
                colors[:n][finite] = map_colors(frame.values[finite], low, high)
            image = renderer.render(frame.points[used], colors[used], camera, size)
            yield draw_labels(
                image,
                f"load {100.0 * frame.time:.4g} %" if self.static else f"t = {frame.time:.{decimals}f} s",
                (low, high, self.title, self.units) if barred else None,
            )

    def _ground_height(self, camera: Camera) -> tuple[float | None, list[int]]:
        """Height of the ground, and hidden squares.

        A horizontal fixed half-space is the ground; with other half-spaces there is none, without any it is at the
        lowest point. Squares seen from behind are hidden, as they would cover the bodies.
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
        if not self.plane_squares:
            up = 2 if self.up_axis == "Z" else 1
            return min(float(frame.points[:, up].min()) for frame in self.frames), hidden_squares
        if not level or max(level.values()) - min(level.values()) > slack:
            return None, hidden_squares
        return max(level.values()), hidden_squares + list(level)

    def color_limits(self) -> tuple[float, float]:
        """Colour range: as given, or the extremes over all frames."""
        if self.color_range is not None:
            return self.color_range
        values = [frame.values[np.isfinite(frame.values)] for frame in self.frames if frame.values is not None]
        values = [v for v in values if v.size]
        if not values:
            return 0.0, 0.0
        return min(float(v.min()) for v in values), max(float(v.max()) for v in values)

    def save_png(self, target: pathlib.Path, size: tuple[int, int], view: tuple[float, float], ground: bool) -> None:
        """Draw the last frame. OutputError if the file can't be written."""
        image = next(self.draw(size, view, [len(self.frames) - 1], ground))
        write_atomically(target, lambda path: pillow.Image.fromarray(image).save(path, format="PNG"))

    def save_gif(
        self,
        target: pathlib.Path,
        size: tuple[int, int],
        view: tuple[float, float],
        ground: bool,
        speed: float = 1.0,
        progress: bool | None = None,
    ) -> None:
        """Draw all frames, with one palette made from five of them."""
        count = len(self.frames)
        palette_frames = sorted({round(k) for k in np.linspace(0, count - 1, min(5, count))})
        palette = make_palette(list(self.draw(size, view, palette_frames, ground)), self.frames[0].values is not None)
        clock = np.round(np.array([frame.time for frame in self.frames]) / speed * 100.0)
        durations = [int(d) for d in np.maximum(np.diff(clock), 2.0) * 10.0] + [int(1000 * _LAST_FRAME_SECONDS)]
        with progress_bar("drawing", "frame", count, progress) as bar:
            pictures = []
            for image in self.draw(size, view, list(range(count)), ground):
                pictures.append(to_palette(image, palette))
                bar.update()

        def save(path: pathlib.Path) -> None:
            pictures[0].save(path, format="GIF", save_all=True, append_images=pictures[1:], duration=durations, loop=0)

        write_atomically(target, save)


def draw_labels(image: Image, time: str, bar: tuple[float, float, str, str] | None) -> Image:
    """Write the time, and a colour bar for (low, high, title, units), onto a picture."""
    height, width = image.shape[:2]
    picture = pillow.Image.fromarray(image)
    draw = pillow.ImageDraw.Draw(picture)
    font = pillow.ImageFont.load_default(max(10.0, height / 30))
    small = pillow.ImageFont.load_default(max(9.0, height / 36))
    line = 1.25 * height / 30
    draw.text((0.025 * width, height - 1.6 * line), time, fill=_TEXT_COLOR, font=font)
    if bar is None:
        return np.asarray(picture)
    low, high, title, units = bar
    fits = (pair for pair in _UNIT_PREFIXES if units and max(abs(low), abs(high)) >= 0.9995 * pair[0])
    factor, prefix = next(fits, (1.0, ""))
    left, right = round(width * (1.0 - 0.75 * _BAR_WIDTH)), round(width * (1.0 - 0.61 * _BAR_WIDTH))
    top, bottom = round(0.26 * height), round(0.80 * height)
    ramp = map_colors(np.linspace(1.0, 0.0, bottom - top), 0.0, 1.0 if high > low else 0.0)
    strip = np.broadcast_to(np.round(255 * ramp)[:, None, :], (bottom - top, right - left, 3)).astype(np.uint8)
    picture.paste(pillow.Image.fromarray(np.ascontiguousarray(strip)), (left, top))
    draw.rectangle((left - 1, top - 1, right, bottom), outline=_TEXT_COLOR)
    ticks = np.linspace(low, high, 5) if high > low else np.array([low])
    texts = _tick_texts(ticks / factor)
    for k, text in enumerate(texts):
        y = bottom - (bottom - top) * (k / 4 if len(texts) > 1 else 0.0)
        draw.line((right, y, right + 0.005 * width, y), fill=_TEXT_COLOR)
        draw.text((right + 0.009 * width, y), text, fill=_TEXT_COLOR, font=small, anchor="lm")
    words = title.split()
    rows = [" ".join(words[:-1]), words[-1]] if len(title) > 12 and len(words) > 1 else [title]
    if units:
        rows[-1] += f" ({prefix}{units})"
    for k, row in enumerate(reversed(rows)):
        y = top - line * (0.9 + k)
        x = min(left - 1, 0.985 * width - draw.textlength(row, font=font))
        draw.text((x, y), row, fill=_TEXT_COLOR, font=font, anchor="lm")
    return np.asarray(picture)


def _tick_texts(ticks: Floats) -> list[str]:
    """Ticks with the decimals needed to distinguish neighbours."""
    step = float(np.ptp(ticks)) / 4.0
    largest = float(np.abs(ticks).max())
    if largest and not 1e-4 <= largest < 1e6:
        return [f"{tick:.2e}" for tick in ticks]
    decimals = max(0, 1 - int(np.floor(np.log10(step)))) if step else 3
    return [f"{tick + 0.0:.{min(decimals, 6)}f}" for tick in ticks]


def make_palette(images: list[Image], barred: bool) -> Any:
    """A PIL picture holding 256 colours for all `images`.

    With a colour bar 64 of them are the colour map. Vivid pixels (bodies) and dull ones (ground, sky) are
    quantised separately, since the latter are numerous and smooth and would take nearly all entries.
    """
    colors = np.round(255 * map_colors(np.linspace(0, 1, 64 if barred else 0), 0, 1)).astype(np.uint8)
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


def to_palette(image: Image, palette: Any) -> Any:
    """Picture in the palette's colours, with ordered dithering: no banding, static pattern."""
    pattern = np.zeros((1, 1))
    for _ in range(3):
        pattern = np.block([[4 * pattern, 4 * pattern + 2], [4 * pattern + 3, 4 * pattern + 1]])
    height, width = image.shape[:2]
    tiles = np.tile((pattern / 63.0 - 0.5) * 8.0, (height // 8 + 1, width // 8 + 1))[:height, :width, None]
    spread = np.clip(np.round(image + tiles), 0, 255).astype(np.uint8)
    return pillow.Image.fromarray(spread).quantize(palette=palette, dither=pillow.Image.Dither.NONE)
