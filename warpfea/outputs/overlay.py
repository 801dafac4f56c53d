"""Writing over a picture: time, colour bar, marks of supports and joints, axes, names, extremes."""

import functools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.lazy import pillow
from .colormap import map_colors
from .raycaster import Camera, Image

__all__ = ["BAR_WIDTH", "Overlay", "draw_labels", "unit_prefix"]

Floats = npt.NDArray[np.floating[Any]]
_TEXT_COLOR = (45, 50, 60)
BAR_WIDTH = 0.17
"""Width of the colour bar as a fraction of the picture's."""
# the font has no µ
_UNIT_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "u"), (1e-9, "n"))
_MARK_COLORS = {
    "support": (27, 122, 61),
    "joint": (176, 74, 0),
    "spring": (90, 96, 110),
    "load": (179, 18, 59),
    "probe": (35, 39, 46),
}
_AXIS_COLORS = ((195, 51, 51), (42, 143, 42), (51, 102, 204))


@functools.lru_cache(maxsize=8)
def _font(size: float) -> Any:
    return pillow.ImageFont.load_default(size)


@dataclass
class Overlay:
    """Marks of one frame, at points (n, 3) in the frame with z up.

    Attributes:
        marks: (kind, point) of each; kinds as of `Look.marks`.
        texts: (text, point), with a circle where `ring` is True.
        axes: three unit vectors of the triad, or None.
    """

    marks: list[tuple[str, Floats]] = field(default_factory=list)
    texts: list[tuple[str, Floats, bool]] = field(default_factory=list)
    axes: Floats | None = None

    def draw(self, draw: Any, camera: Camera, size: tuple[int, int]) -> None:
        """Draw onto a picture by PIL."""
        unit = size[1] / 90.0
        font = _font(max(9.0, size[1] / 38))
        springs = [camera.project(point, size) for kind, point in self.marks if kind == "spring"]
        for first, second in zip(springs[::2], springs[1::2]):
            draw.line([*first, *second], fill=_MARK_COLORS["spring"], width=max(1, round(0.4 * unit)))
        for kind, point in self.marks:
            if kind == "spring":
                continue
            x, y = camera.project(point, size)
            color = _MARK_COLORS[kind]
            if kind == "support":
                draw.polygon([(x, y), (x - 0.75 * unit, y + 1.3 * unit), (x + 0.75 * unit, y + 1.3 * unit)], fill=color)
            else:
                r = unit if kind == "joint" else 0.6 * unit
                wide = max(1, round(0.3 * unit))
                draw.ellipse((x - r, y - r, x + r, y + r), outline=color, width=wide, fill=None)
                if kind == "joint":
                    draw.ellipse((x - 0.35 * r, y - 0.35 * r, x + 0.35 * r, y + 0.35 * r), fill=color)
        for text, point, ring in self.texts:
            x, y = camera.project(point, size)
            if ring:
                draw.ellipse(
                    (x - unit, y - unit, x + unit, y + unit), outline=_TEXT_COLOR, width=max(1, round(0.25 * unit))
                )
            beyond = x + 1.4 * unit + draw.textlength(text, font=font) > size[0]  # then to the left of its point
            shift, anchor = (-1.4 * unit, "rm") if beyond else (1.4 * unit, "lm")
            place, anchor = ((x + shift, y), anchor) if ring else ((x, y), "mm")
            draw.text(place, text, fill=_TEXT_COLOR, font=font, anchor=anchor, stroke_width=2,
                      stroke_fill=(240, 242, 244))  # fmt: skip
        if self.axes is not None:
            _, right, up = camera.axes()
            corner = np.array([7.0 * unit, 7.5 * unit])
            for name, axis, color in zip("xyz", self.axes, _AXIS_COLORS):
                along = np.array([axis @ right, -(axis @ up)]) * 5.0 * unit
                draw.line([*corner, *(corner + along)], fill=color, width=max(1, round(0.4 * unit)))
                draw.text(tuple(corner + 1.3 * along), name, fill=color, font=font, anchor="mm")


def draw_labels(
    image: Image,
    time: str,
    bar: tuple[float, float, str, str, str] | None,
    overlay: Overlay | None = None,
    camera: Camera | None = None,
) -> Image:
    """Write the time, and a colour bar for (low, high, title, units, map), onto a picture; before them the overlay."""
    height, width = image.shape[:2]
    picture = pillow.Image.fromarray(image)
    draw = pillow.ImageDraw.Draw(picture)
    if overlay is not None and camera is not None:
        overlay.draw(draw, camera, (width, height))
    font = _font(max(10.0, height / 30))
    small = _font(max(9.0, height / 36))
    line = 1.25 * height / 30
    draw.text((0.025 * width, height - 1.6 * line), time, fill=_TEXT_COLOR, font=font)
    if bar is None:
        return np.asarray(picture)
    low, high, title, units, colors = bar
    factor, prefix = unit_prefix(max(abs(low), abs(high)), units)
    left, right = round(width * (1.0 - 0.75 * BAR_WIDTH)), round(width * (1.0 - 0.61 * BAR_WIDTH))
    top, bottom = round(0.26 * height), round(0.80 * height)
    ramp = map_colors(np.linspace(1.0, 0.0, bottom - top), 0.0, 1.0 if high > low else 0.0, colors)
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


def unit_prefix(largest: float, units: str) -> tuple[float, str]:
    """Factor and prefix of a unit such that the largest value lies above one."""
    fits = (pair for pair in _UNIT_PREFIXES if units and largest >= 0.9995 * pair[0])
    return next(fits, (1.0, ""))
