"""Common parts of output writers: protocol, frame times, file replacement, drawn surface.

A writer receives the simulation and reads `time` (B,), of statics `load` (B,), `dt`, `model.bodies`,
`model.worlds`, `model.description.up_axis`, `fields` by name, `skin_points(body, worlds)` (B, P, 3) and
`skin_field(name, body, worlds)` (B, P) of all worlds (None) or of those numbers and, for nodal formats, `positions`,
`displacements`, `velocities` and `field`. Bodies without a skin are not drawn.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.checks import is_number, number_pair
from ..base.errors import ModelError, OutputError
from ..model.surfaces import reference_points
from .obstacles import Obstacles, clip_to_box

__all__ = [
    "DrawnSurface", "FrameClock", "check_colors", "check_fields", "field_label", "field_names", "grid_offsets",
    "is_static",
]  # fmt: skip

Array = npt.NDArray[Any]


def field_label(sim: Any, name: str) -> tuple[str, str]:
    """(title, units) of a field; one that the simulation lacks is its own title, without units. Units told apart by
    commas are of equal shares of the components."""
    whole, _, part = name.partition(".")
    spec = sim.fields.get(whole)
    if spec is None:
        return name.replace("_", " "), ""
    units = spec.units.split(", ")
    if part in spec.components:
        units = [units[spec.components.index(part) * len(units) // len(spec.components)]]
    return f"{spec.title} {part}".rstrip(), ", ".join(units)


def field_names(fields: Any, color: Any = None) -> list[str]:
    """Names of the fields of a writer, each once, the shown one too. ModelError for anything else."""
    names: list[Any] = list(fields) if isinstance(fields, Iterable) and not isinstance(fields, str) else [None]
    if not all(isinstance(name, str) for name in names):
        raise ModelError(f"fields must be names of fields, such as ('von_mises',), got {fields!r}")
    if not isinstance(color, (str, type(None))):
        raise ModelError(f"color must be the name of a field, or None for grey, got {color!r}")
    return list(dict.fromkeys([*names, *([color] if color else [])]))


def frame_time(sim: Any) -> float:
    """The simulated time (s) of a frame: that of the most advanced world (frozen worlds lag).

    In statics the load factor, 0 to 1.
    """
    load = getattr(sim, "load", None)
    return float(np.max(np.asarray(sim.time if load is None else load, dtype=np.float64)))


def is_static(sim: Any) -> bool:
    """True for statics, whose frames are load factors."""
    return getattr(sim, "load", None) is not None


def check_fields(sim: Any, names: Sequence[str], *, scalar: bool = True) -> None:
    """Raise the simulation's ModelError for a missing field, or one with components, before any computation."""
    check = getattr(sim, "check_field", None)
    if check is not None:
        for name in names:
            check(name, scalar=scalar)


def check_colors(pair: Any) -> tuple[float, float] | None:
    """The colour range (low, high), or None. OutputError unless it is two finite rising numbers."""
    if pair is None:
        return None
    low, high = number_pair(pair)
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise OutputError(f"color_range must be two finite rising numbers, got {pair!r}")
    return low, high


class FrameClock:
    """Frame schedule: frame k at time k / fps.

    The first state is always due. A frame is due at the first state at or after its time; once for the latest if a
    step passes several frame times. Writers store the state under its own time, never the nominal one: samples are
    exact at their times, and players interpolate linearly in between.
    """

    def __init__(self, fps: float) -> None:
        if not (is_number(fps) and fps > 0):
            raise ModelError(f"fps: frames per second must be positive and finite, got {fps!r}")
        self.fps = float(fps)
        self.last = -np.inf
        self._next_frame = -np.inf

    def due(self, time: float) -> bool:
        """True if the state at `time` (s) is a frame; once per frame."""
        frame = time * self.fps
        slack = 1e-6 + 1e-12 * abs(frame)
        if frame < self._next_frame - slack:
            return False
        self._next_frame = np.floor(frame + slack) + 1.0
        self.last = time
        return True

    def time_code(self, time: float) -> float:
        """Time code of `time`: time * fps, rounded to a whole number within round-off."""
        frame = time * self.fps
        nearest = float(np.round(frame))
        return nearest if abs(frame - nearest) <= 1e-6 + 1e-12 * abs(frame) else frame


def grid_offsets(worlds: int, spacing: tuple[float, float], up_axis: str = "Z") -> npt.NDArray[np.float64]:
    """(B, 3) origins (m) of worlds on a near-square horizontal grid; world 0 stays at the origin."""
    columns = int(np.ceil(np.sqrt(worlds)))
    row, column = np.divmod(np.arange(worlds), columns)
    offsets = np.zeros((worlds, 3))
    offsets[:, 0] = column * spacing[0]
    offsets[:, 1 if up_axis == "Z" else 2] = row * spacing[1] * (1.0 if up_axis == "Z" else -1.0)
    return offsets


class DrawnSurface:
    """Drawn surfaces of a simulation: bodies and obstacles, and the grid of worlds.

    `spacing` (m) is the distance of neighbouring worlds, one number or (first, second horizontal axis);
    without it, 1.25 times the size of one world when the run starts, at least half of its largest size.
    """

    def __init__(self, sim: Any, spacing: float | tuple[float, float] | None = None) -> None:
        self.bodies = [body for body in sim.model.bodies if getattr(body, "skin", None) is not None]
        self.worlds = int(sim.model.worlds)
        self.up_axis = str(sim.model.description.up_axis).upper()
        if not self.bodies:
            raise OutputError("nothing to draw: no body has a surface")
        start = [self.skin_points(sim, body) for body in self.bodies]
        self.point_counts = [points.shape[1] for points in start]
        self.rest = [
            reference_points(body, body.skin.slot_weights) if hasattr(body.skin, "slot_weights") else points[0]
            for body, points in zip(self.bodies, start)
        ]
        low = np.min([points.min(axis=(0, 1)) for points in start], axis=0)
        high = np.max([points.max(axis=(0, 1)) for points in start], axis=0)
        self.obstacles = Obstacles(sim, low, high)
        start += [
            np.asarray(clip_to_box(points, low, high, 0.5), dtype=np.float64)
            for points, obstacle in zip(self.obstacles.points(), self.obstacles.all)
            if not obstacle.is_plane
        ]
        distance = self._grid_spacing(start, spacing)
        self.offsets = grid_offsets(self.worlds, distance, self.up_axis)
        if min(distance) > 0.0:  # a plane must not hide the bodies of other worlds
            self.obstacles.limit_plane_size(min(distance))

    def _grid_spacing(
        self, start: list[npt.NDArray[np.float64]], spacing: float | tuple[float, float] | None
    ) -> tuple[float, float]:
        if self.worlds == 1:
            return 0.0, 0.0
        if spacing is not None:
            pair = np.broadcast_to(np.asarray(spacing, dtype=np.float64), (2,))
            if not (np.isfinite(pair).all() and (pair >= 0).all()):
                raise OutputError(f"spacing must be finite and not negative, got {spacing!r}")
            return float(pair[0]), float(pair[1])
        low = np.min([points.min(axis=1) for points in start], axis=0)
        high = np.max([points.max(axis=1) for points in start], axis=0)
        size = (high - low).max(axis=0)
        size = np.maximum(size, 0.5 * size.max())
        return 1.25 * float(size[0]), 1.25 * float(size[1 if self.up_axis == "Z" else 2])

    @staticmethod
    def skin_points(sim: Any, body: Any, worlds: Sequence[int] | None = None) -> npt.NDArray[np.float64]:
        """(B, P, 3) current surface points (m), of all worlds or some, without the grid offsets; OutputError for
        non-finite ones."""
        points = np.asarray(sim.skin_points(body, worlds), dtype=np.float64)
        if not np.isfinite(points).all():
            first = int(np.argmin(np.isfinite(points).all(axis=(1, 2))))
            world = first if worlds is None else worlds[first]
            raise OutputError(
                f"body {body.name!r}, world {world}: positions are not finite at t = {frame_time(sim):g} s"
            )
        return points

    def triangles(self) -> npt.NDArray[np.int32]:
        """(T, 3) triangles of all worlds, bodies and obstacles in the order of `points`."""
        blocks, first = [], 0
        for triangles, count in self._meshes():
            for _ in range(self.worlds):
                blocks.append(np.asarray(triangles, dtype=np.int32) + first)
                first += count
        return np.concatenate(blocks)

    def _meshes(self) -> list[tuple[Array, int]]:
        """Triangles of a world and points of each body, then of each obstacle."""
        bodies = [(body.skin.triangles, count) for body, count in zip(self.bodies, self.point_counts, strict=True)]
        return bodies + [(obstacle.triangles, obstacle.points.shape[1]) for obstacle in self.obstacles.all]

    @property
    def body_points(self) -> int:
        """Number of `points` of bodies, which come first."""
        return self.worlds * sum(self.point_counts)

    def parts(self) -> list[tuple[str, int, int]]:
        """(name, first point, number of points of all worlds) of each body and obstacle, in the order of `points`."""
        names = [body.name for body in self.bodies] + [obstacle.name for obstacle in self.obstacles.all]
        counts = [self.worlds * count for _, count in self._meshes()]
        firsts = np.cumsum([0, *counts[:-1]])
        return [(name, int(first), count) for name, first, count in zip(names, firsts, counts)]

    def edges(self) -> npt.NDArray[np.int64]:
        """(E, 2) points along the edges of elements of all bodies and worlds."""
        blocks = [np.zeros((0, 2), dtype=np.int64)]
        for body, count, (_, first, _) in zip(self.bodies, self.point_counts, self.parts()):
            of_triangles = body.skin.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
            edges = np.asarray(getattr(body.skin, "edges", of_triangles))
            blocks += [edges + first + world * count for world in range(self.worlds)]
        return np.concatenate(blocks)

    def rest_points(self, start: Array) -> Array:
        """(P, 3) points at rest, m, of all worlds in the order of `points`; where none are known those at the start."""
        out = start.copy()
        for rest, (_, first, total) in zip(self.rest, self.parts()):
            out[first : first + total] = (rest + self.offsets[:, None, :]).reshape(-1, 3)
        return out

    def plane_squares(self) -> list[int]:
        """First point of each square drawn for a half-space, in the order of `points`."""
        out, first = [], self.body_points
        for obstacle in self.obstacles.all:
            count = obstacle.points.shape[1]
            if obstacle.is_plane:
                out += [first + world * count for world in range(self.worlds)]
            first += self.worlds * count
        return out

    def points(self, sim: Any) -> npt.NDArray[np.float64]:
        """(P, 3) current points (m) of all worlds, of the bodies and then the obstacles, with the grid offsets."""
        blocks = [self.skin_points(sim, body) for body in self.bodies] + self.obstacles.points()
        return np.concatenate([(block + self.offsets[:, None, :]).reshape(-1, 3) for block in blocks])

    def values(self, sim: Any, field: str) -> npt.NDArray[np.float32]:
        """(body_points,) values of a scalar field in the order of `points`."""
        values = [np.asarray(sim.skin_field(field, body), dtype=np.float32).ravel() for body in self.bodies]
        return np.concatenate(values)
