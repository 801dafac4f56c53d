"""One self-contained HTML page of a run: surfaces, fields and records, packed for a browser with WebGL2.

The page is `page.html` with its style, its programs (`page_scene.js`: unpacking and drawing, `page_plots.js`,
`page_view.js`: controls), a header (JSON) and one block of bytes, deflated, in base64. In the block each array is a
table of unsigned integers (rows, columns), as byte planes of their differences:

    rest     (1, 3 P) 16 bits    points at rest, x of all, then y and z, over the box of the surface
    moves    (F, 3 P) 14 bits    displacements of each frame from there, over their own range
    values   (F, P)    8 bits    a field, 0 .. 254 over its range, 255 for NaN
    and triangles, edges, nodes, points of vertices

Displacements have a range of their own: small ones are shown as well, multiplied by the scale of deformation.
"""

import base64
import concurrent.futures
import html
import importlib.resources
import json
import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from .colormap import hex_tables
from .normals import smooth_corners

__all__ = ["MOVE_LEVELS", "NO_VALUE", "REST_LEVELS", "Page", "PageSurface"]

Array = npt.NDArray[Any]
MOVE_LEVELS, REST_LEVELS = (1 << 14) - 1, (1 << 16) - 1
SCRIPTS = ("page_scene.js", "page_plots.js", "page_view.js")
WINDOW, PIECE = 1 << 15, 1 << 19
"""Bytes that deflate looks back, and of a piece that one thread compresses."""
NO_VALUE = 255
"""Code of NaN; finite values are 0 .. 254."""


@dataclass(eq=False)
class PageSurface:
    """One body or obstacle, or the points of markers, in all worlds of the page.

    Attributes:
        kind: "body", "collider", "plane" (a square of a half-space) or "points" (not drawn).
        rest: (W, P, 3) points at rest, m.
        triangles: (T, 3), outward. edges: (E, 2) of elements. nodes: (P,) node of the mesh at or next to each point.
        points: (W, P, 3) of each frame, float32; one entry: it does not move.
        values: (W, P) of each frame, by field.
    """

    name: str
    kind: str
    rest: Array
    triangles: Array = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int32))
    edges: Array | None = None
    nodes: Array | None = None
    points: list[Array] = field(default_factory=list)
    values: dict[str, list[Array]] = field(default_factory=dict)


class _Block:
    """The block of bytes; equal arrays are stored once."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self._places: dict[bytes, int] = {}

    def add(self, table: Array, width: int, order: int = 0) -> list[int]:
        """Append unsigned integers (rows, columns) of `width` bytes as differences of an order between rows.

        Returns [offset, rows, columns, width, order].
        """
        kind = np.dtype(f"<u{width}")
        code = np.array(table, dtype=kind, order="C", ndmin=2)
        shape = code.shape
        for first in range(1, order + 1):  # modulo 2^bits, undone in the reverse order
            code[first:] = code[first:] - code[first - 1 : -1]
        signed = code.view(f"<i{width}")
        code = ((signed << 1) ^ (signed >> (8 * width - 1))).view(kind)
        data = np.ascontiguousarray(code.reshape(-1, 1).view(np.uint8).T).tobytes()
        if data not in self._places:
            self._places[data] = self.size
            self.parts.append(data)
            self.size += len(data)
        return [self._places[data], *shape, width, order]

    def add_smooth(self, table: Array, width: int) -> list[int]:
        """Append a table whose rows follow each other in time, in the order with the smaller differences."""
        some = table[:, :: max(1, table.shape[1] // 4096)].astype(np.int32)
        size = [np.abs(np.diff(some, n=order, axis=0)).mean() if len(table) > order else np.inf for order in (0, 1, 2)]
        return self.add(table, width, int(np.argmin(size)) if len(table) > 2 else len(table) - 1)

    def text(self) -> str:
        """The block, deflated, in base64."""
        return base64.b64encode(deflate(b"".join(self.parts))).decode()


def deflate(data: bytes) -> bytes:
    """A zlib stream of the data, its pieces compressed side by side, each with the end of the one before known."""

    def piece(first: int) -> bytes:
        before = data[max(first - WINDOW, 0) : first]
        packer = zlib.compressobj(9, zlib.DEFLATED, -15, zdict=before) if before else zlib.compressobj(9, wbits=-15)
        last = first + PIECE >= len(data)
        return packer.compress(data[first : first + PIECE]) + packer.flush(zlib.Z_FINISH if last else zlib.Z_SYNC_FLUSH)

    with concurrent.futures.ThreadPoolExecutor() as pool:
        packed = b"".join(pool.map(piece, range(0, max(len(data), 1), PIECE)))
    return b"\x78\xda" + packed + zlib.adler32(data).to_bytes(4, "big")


def quantise(values: Array, low: float, step: float, levels: int) -> Array:
    """Nearest of the codes 0 .. levels of low + code x step; levels of 16 bits at most."""
    return np.clip(np.rint((values - low) / (step or 1.0)), 0, levels).astype(np.uint16)


@dataclass(eq=False)
class Page:
    """Contents of a page.

    Attributes:
        origin: (3,) m, subtracted from all points. offsets: (W, 3) of the grid of worlds, m; worlds: their numbers.
        times: of frames, s; of statics load factors.
        fields: (title, units) by name; color: the one shown first, or None. color_range: of it, or None.
        markers: supports, joints and loads, see `markers`. plots: see `records`.
        facts: rows (name, text) told below the picture. warnings: of the run.
    """

    title: str
    subtitle: str
    up_axis: str
    static: bool
    origin: Array
    offsets: Array
    worlds: list[int]
    fields: dict[str, tuple[str, str]]
    color: str | None
    color_range: tuple[float, float] | None
    view: tuple[float, float]
    surfaces: list[PageSurface] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    markers: list[dict[str, Any]] = field(default_factory=list)
    plots: list[dict[str, Any]] = field(default_factory=list)
    facts: list[tuple[str, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def html(self) -> str:
        """The page."""
        block = _Block()
        ranges = {name: self._range(name) for name in self.fields}
        content = {
            "title": self.title, "subtitle": self.subtitle, "up": self.up_axis, "static": self.static,
            "origin": self.origin.tolist(), "offsets": self.offsets.tolist(), "worlds": self.worlds,
            "times": [float(f"{t:.9g}") for t in self.times],
            "fields": [{"name": name, "title": label[0], "units": label[1], "low": ranges[name][0],
                        "step": (ranges[name][1] - ranges[name][0]) / (NO_VALUE - 1)}
                       for name, label in self.fields.items()],
            "color": self._first_shown(ranges), "range": self.color_range,
            "view": self.view, "maps": hex_tables(), "markers": self.markers, "plots": self.plots,
            "surfaces": [self._pack(block, surface, ranges) for surface in self.surfaces],
            "facts": self.facts, "warnings": self.warnings,
        }  # fmt: skip
        # no text of the header can end its element: < is written as an escape
        header = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
        folder = importlib.resources.files(__package__)
        parts = {
            "STYLE": (folder / "page.css").read_text("utf-8"), "TITLE": html.escape(self.title), "HEADER": header,
            "SCRIPT": "".join((folder / name).read_text("utf-8") for name in SCRIPTS),
            "BLOCK": block.text(),
        }  # fmt: skip
        pieces = (folder / "page.html").read_text("utf-8").split("@@")
        return "".join(parts[piece] if k % 2 else piece for k, piece in enumerate(pieces))

    def _first_shown(self, ranges: dict[str, tuple[float, float]]) -> int:
        """Number of the field shown first: `color`, or where all of its values are one the first that has more."""
        if self.color is None:
            return -1
        order = [self.color] if self.color_range else [self.color, *self.fields]
        shown = next((name for name in order if ranges[name][0] < ranges[name][1]), self.color)
        return list(self.fields).index(shown)

    def _range(self, name: str) -> tuple[float, float]:
        """Extremes of a field over all frames, worlds and bodies; (0, 0) without a finite value."""
        low, high = np.inf, -np.inf
        for values in (v for surface in self.surfaces for v in surface.values.get(name, ())):
            finite = values[np.isfinite(values)]
            if finite.size:
                low, high = min(low, float(finite.min())), max(high, float(finite.max()))
        if low > high:
            return 0.0, 0.0
        return (0.0 if 0.0 < low < 1e-9 * high else low), high  # round-off is no end of a range

    def _pack(self, block: _Block, surface: PageSurface, ranges: dict[str, tuple[float, float]]) -> dict[str, Any]:
        """Header of a surface; its arrays are appended to the block."""
        out: dict[str, Any] = {"name": surface.name, "kind": surface.kind, "worlds": []}
        if len(surface.triangles):
            # points on sharp edges are doubled there, for the normals of both sides
            group, count = smooth_corners(surface.rest[0], surface.triangles)
            source = np.empty(count, dtype=np.int64)
            source[group] = surface.triangles.ravel()
            order = np.argsort(source, kind="stable")
            rank = np.empty(count, dtype=np.int64)
            rank[order] = np.arange(count)
            out["source"] = block.add(source[order, None], 4, 1)
            out["triangles"] = block.add(rank[group].reshape(-1, 1), 4, 1)
            edges = (
                surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
                if surface.edges is None
                else surface.edges
            )
            out["edges"] = block.add(np.unique(np.sort(edges, axis=1), axis=0), 4, 1)
        if surface.nodes is not None:
            out["nodes"] = block.add(surface.nodes[:, None], 4, 1)
        for world in range(len(self.worlds)):
            rest = np.asarray(surface.rest[world], dtype=np.float64)
            low = rest.min(axis=0)
            step = float(np.ptp(rest, axis=0).max()) / REST_LEVELS
            code = quantise(rest, low, step, REST_LEVELS)
            base = low + step * code
            moves = [(points[world] - base).astype(np.float32).T for points in surface.points]  # each fits a cache
            least = np.min([move.min(axis=1) for move in moves], axis=0).astype(np.float64)
            quantum = float(np.max([move.max(axis=1) - least for move in moves])) / MOVE_LEVELS
            table = np.stack([quantise(move, least[:, None], quantum, MOVE_LEVELS).ravel() for move in moves])
            packed = {"low": low.tolist(), "step": step, "rest": block.add(code.T.reshape(-1, 1), 2, 1)}
            packed |= {"least": least.tolist(), "quantum": quantum, "moves": block.add_smooth(table, 2), "values": []}
            for name, pair in ranges.items() if surface.values else ():
                step = (pair[1] - pair[0]) / (NO_VALUE - 1)
                rows = []
                for values in (v[world] for v in surface.values[name]):
                    finite = np.isfinite(values)
                    code = quantise(np.where(finite, values, pair[0]), pair[0], step, NO_VALUE - 1)
                    rows.append(np.where(finite, code, NO_VALUE))
                packed["values"].append(block.add_smooth(np.stack(rows), 1))
            out["worlds"].append(packed)
        return out
