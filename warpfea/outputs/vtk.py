"""VTU series for ParaView: a file per frame, body and world, and a .pvd index with their times."""

import functools
import json
import os
import pathlib
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from ..base.checks import is_count
from ..base.errors import OutputError
from ..base.lazy import meshio
from ..base.writer import Output, check_target, make_folder, write_atomically
from ..model.surfaces import reference_points
from ..terms.fields import SYMMETRIC
from .frames import FrameClock, check_fields, field_names, frame_time
from .obstacles import Obstacles
from .vtk_reader import listed_names, read_series

__all__ = ["VTUFile", "VTUWriter"]

MAX_NAME = 100
"""Largest length of a body's name in file names, which file systems bound at 255 with the rest."""


class VTUWriter(Output):
    """Writes `folder`/<body>_<world>_<frame>.vtu and `folder`/<folder name>.pvd.

    Args:
        folder: the target folder; made if its parent exists. Files of the same names are overwritten.
        every: write each n-th accepted step (the default, with 1). fps: or by time, as USD does. Not both.
        fields: fields at the mesh nodes, SI units; symmetric tensors, which the .pvd lists, in ParaView's order XX YY
            ZZ XY YZ XZ.
        extend: extend the existing series of the resumed run; its frames after the current time are removed and
            rewritten.

    Points are the *current* positions in float64, without grid offsets of worlds; subtract the
    point data `displacement` for the reference shape. `velocity` is written if the simulation has it.
    Element groups are 0/1 cell data named `set:<group>`. In the .pvd, `part` counts bodies and within them
    worlds. Every file is written atomically, so the series is always valid; the .pvd lags by at
    most a tenth of the frames until `close`, which also writes the last state.

    Colliders are a series of their own, <folder name>_colliders.pvd, of files collider_<name>_<world>_<frame>.vtu:
    triangles at the current position, a square for a half-space. Frames of a resting collider share a file.

    OutputError: a folder that can't be created or written (at `open`), or a file (at `write`).
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        every: int | None = None,
        fps: float | None = None,
        fields: Sequence[str] = ("von_mises",),
        extend: bool = False,
    ) -> None:
        if every is not None and fps is not None:
            raise OutputError("VTUWriter takes every= or fps=, not both")
        if every is not None and (int(every) != every or every < 1):
            raise OutputError(f"every must be a whole number of steps, at least 1, got {every!r}")
        self.folder = pathlib.Path(folder).resolve()  # "" and "." have a name, too
        self.every = int(every or 1)
        self.fps = self.rate = None if fps is None else FrameClock(fps).fps
        self.fields = [name for name in field_names(fields) if name not in ("displacement", "velocity")]
        self.extend = extend
        self._open = False

    @property
    def series(self) -> pathlib.Path:
        """The .pvd file."""
        return self.folder / f"{self.folder.name}.pvd"

    @property
    def collider_series(self) -> pathlib.Path:
        """The .pvd file of the colliders, if any."""
        return self.folder / f"{self.folder.name}_colliders.pvd"

    def open(self, sim: Any) -> None:
        check_fields(sim, self.fields, scalar=False)
        self._folder_created = not self.folder.exists()
        make_folder(self.folder)
        self._open = True
        kinds = {name: sim.fields[name].components for name in self.fields if name in sim.fields}
        self._symmetric = {name for name, components in kinds.items() if components == SYMMETRIC}
        self._clock = None if self.fps is None else FrameClock(self.fps)
        self._write_calls = 0
        self._last_time = -np.inf
        self._frames: list[tuple[float, list[str]]] = []
        self._colliders: list[tuple[float, list[str]]] = []
        self._indexed_frames = 0
        self._bodies = [body.name for body in sim.model.bodies]
        self._names = self._file_names(self._bodies)
        points = np.concatenate([np.asarray(sim.positions(body)).reshape(-1, 3) for body in sim.model.bodies])
        self._obstacles = Obstacles(sim, points.min(axis=0), points.max(axis=0))  # half-spaces around the bodies
        named = [f"collider_{obstacle.name}" for obstacle in self._obstacles.all]
        self._collider_names = self._file_names([*self._names, *named])[len(self._names) :]
        self._last_written: dict[tuple[int, int], tuple[np.ndarray, str]] = {}
        self._kept_frames = 0
        if self.extend and self.series.is_file():
            self._resume(frame_time(sim))

    def _resume(self, now: float) -> None:
        """Extend the frames of the series up to the time `now`, s."""
        self._frames = self._read_series(self.series, now)
        self._symmetric |= set(listed_names(self.series, "symmetric"))
        if self.collider_series.is_file():
            self._colliders = self._read_series(self.collider_series, now)
        self._kept_frames = self._indexed_frames = len(self._frames)
        if self._frames:
            self._last_time = self._frames[-1][0]
            if self._clock:
                self._clock.due(self._last_time)

    def _read_series(self, path: pathlib.Path, now: float) -> list[tuple[float, list[str]]]:
        """Times up to `now`, s, and files of a .pvd."""
        try:
            frames = read_series(path)
        except (OSError, ElementTree.ParseError, KeyError, ValueError) as error:
            self._open = False
            raise OutputError(f"{path}: can't go on with this series ({error}); give another folder") from error
        return [(time, files) for time, files in frames if time <= now + 1e-9 * max(1.0, abs(now))]

    @staticmethod
    def _file_names(given: Sequence[str]) -> list[str]:
        """Names valid in file names, cut to MAX_NAME, still unique."""
        names: list[str] = []
        for text in given:
            name = re.sub(r"[^A-Za-z0-9.-]", "_", text[:MAX_NAME]).strip(".") or "body"
            while name.lower() in (other.lower() for other in names):
                name += "-"
            names.append(name)
        return names

    def write(self, sim: Any) -> None:
        time = frame_time(sim)
        due = self._clock.due(time) if self._clock else self._write_calls % self.every == 0
        self._write_calls += 1
        if due and time > self._last_time:
            self._write_frame(sim, time)

    def _write_frame(self, sim: Any, time: float) -> None:
        frame = len(self._frames)
        files: list[str] = []
        self._frames.append((time, files))
        self._last_time = time
        for body, name in zip(sim.model.bodies, self._names, strict=True):
            points, data, cells = _frame_data(sim, body, self.fields)
            for world in range(int(sim.model.worlds)):
                file = f"{name}_{world:04d}_{frame:06d}.vtu"
                of_world = {key: np.ascontiguousarray(value[world]) for key, value in data.items()}
                write_atomically(self.folder / file, functools.partial(_write_vtu, cells, points[world], of_world))
                files.append(file)
        if len(self._obstacles):
            self._colliders.append((time, self._collider_files(frame)))
        if frame + 1 >= self._indexed_frames + max(1, self._indexed_frames // 10):
            self._write_series()

    def _collider_files(self, frame: int) -> list[str]:
        """Files of the colliders in a frame; only those moved since their last are written."""
        files = []
        drawn = zip(self._obstacles.all, self._collider_names, self._obstacles.points())
        for k, (obstacle, name, points) in enumerate(drawn):
            cells: Cells = ("triangle", obstacle.triangles, {})
            for world in range(len(points)):
                before, file = self._last_written.get((k, world), (None, ""))
                if before is None or not np.array_equal(before, points[world]):
                    file = f"{name}_{world:04d}_{frame:06d}.vtu"
                    write_atomically(self.folder / file, functools.partial(_write_vtu, cells, points[world], {}))
                    self._last_written[k, world] = (points[world], file)
                files.append(file)
        return files

    def _write_series(self) -> None:
        _write_pvd(self.series, self._frames, symmetric=sorted(self._symmetric), bodies=self._bodies)
        if self._colliders:
            _write_pvd(self.collider_series, self._colliders)
        self._indexed_frames = len(self._frames)

    def close(self, sim: Any) -> None:
        if not self._open:
            return
        time = frame_time(sim)
        if time > self._last_time:
            self._write_frame(sim, time)
        self._write_series()
        self._open = False

    def abort(self) -> None:
        """Remove the files of this run, and the folder if this run created it and it is empty."""
        if not self._open:
            return
        kept = {file for _, files in self._colliders[: self._kept_frames] for file in files}
        for _, files in self._frames[self._kept_frames :] + self._colliders[self._kept_frames :]:
            for file in files:
                if file not in kept:
                    (self.folder / file).unlink(missing_ok=True)
        if self._kept_frames:
            self._frames, self._colliders = self._frames[: self._kept_frames], self._colliders[: self._kept_frames]
            self._write_series()
        elif self._indexed_frames:
            self.series.unlink(missing_ok=True)
            self.collider_series.unlink(missing_ok=True)
        if self._folder_created and not any(self.folder.iterdir()):
            self.folder.rmdir()
        self._open = False


class VTUFile(Output):
    """Writes one state to `path` (.vtu): all bodies in one file, cell data `body` is their number.

    Args:
        fields: fields at the nodes, as of VTUWriter; NaN on bodies without them.
        world: the world written.
    """

    animates = False

    def __init__(self, path: str | os.PathLike[str], *, fields: Sequence[str] = ("von_mises",), world: int = 0) -> None:
        self.path = pathlib.Path(path)
        self.fields = [name for name in field_names(fields) if name not in ("displacement", "velocity")]
        self.world = world

    def open(self, sim: Any) -> None:
        check_fields(sim, self.fields, scalar=False)
        self._target = check_target(self.path, (".vtu",))
        if not (is_count(self.world) and 0 <= self.world < sim.model.worlds):
            raise OutputError(f"{self.path}: world = {self.world!r} must be a number from 0 to {sim.model.worlds - 1}")

    def write(self, sim: Any) -> None:
        parts = [_frame_data(sim, body, self.fields) for body in sim.model.bodies]
        points = [part[0][self.world] for part in parts]
        counts = [len(x) for x in points]
        first = np.cumsum([0, *counts[:-1]])
        data = {}
        for name in dict.fromkeys(name for part in parts for name in part[1]):
            shape = next(part[1][name].shape[2:] for part in parts if name in part[1])
            own = [
                part[1][name][self.world] if name in part[1] else np.full((count, *shape), np.nan)
                for part, count in zip(parts, counts)
            ]
            data[name] = np.concatenate(own)
        blocks = [(part[2][0], np.asarray(part[2][1]) + k) for part, k in zip(parts, first)]
        number = [np.full(len(cells), k, dtype=np.int32) for k, (_, cells) in enumerate(blocks)]
        mesh = meshio.Mesh(np.concatenate(points), blocks, point_data=data, cell_data={"body": number})
        write_atomically(self._target, lambda path: mesh.write(path, file_format="vtu"))


Cells = tuple[str, np.ndarray, dict[str, np.ndarray]]


def _frame_data(sim: Any, body: Any, fields: Sequence[str]) -> tuple[np.ndarray, dict[str, np.ndarray], Cells]:
    """Points and point data (worlds first) of a body, and its cells with their groups.

    T4 and T10 are written as their mesh; other elements as drawn cells, with section and thickness.
    """
    mesh = body.mesh
    kinds = {field: getattr(sim.fields.get(field.partition(".")[0]), "cell_type", "") for field in fields}
    fields = [field for field in fields if kinds[field] in ("", mesh.cell_type)]
    family = getattr(body, "family", None)
    if family is None or not family.has_gradients:
        points = np.asarray(sim.positions(body), dtype=np.float64)
        data = {"displacement": np.asarray(sim.displacements(body), dtype=np.float64)}
        if hasattr(sim, "velocities"):
            data["velocity"] = np.asarray(sim.velocities(body), dtype=np.float64)
        data |= {field: _in_vtk_order(sim, field, sim.field(field, body)) for field in fields}
        return points, data, (mesh.cell_type, mesh.cells, _element_set_flags(mesh, np.arange(len(mesh.cells))))
    drawn = body.drawing
    points = sim.point_positions(body, drawn.slot_weights)
    v = sim.state.velocity.numpy()[:, body.slot_range].astype(float)
    data = {
        "displacement": points - reference_points(body, drawn.slot_weights),
        "velocity": np.stack([drawn.slot_weights @ row for row in v]),
    }
    data |= {field: _in_vtk_order(sim, field, sim.field_on(field, body, drawn)) for field in fields}
    return points, data, (drawn.cell_type, drawn.cells, _element_set_flags(mesh, drawn.element))


def _in_vtk_order(sim: Any, field: str, values: np.ndarray) -> np.ndarray:
    """Values (worlds, points, k); symmetric tensors xx yy zz yz xz xy as xx yy zz xy yz xz."""
    spec = sim.fields.get(field)
    values = np.asarray(values, dtype=np.float64)
    return values[..., [0, 1, 2, 5, 3, 4]] if spec and spec.components == SYMMETRIC else values


def _write_pvd(target: pathlib.Path, frames: list[tuple[float, list[str]]], **listed: list[str]) -> None:
    """Index of a series: files of each time, s, and lists of names: symmetric tensors, bodies."""
    names = "".join(f" {what}={quoteattr(json.dumps(some))}" for what, some in listed.items() if some)
    lines = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">', f"<Collection{names}>"]
    for time, files in frames:
        lines += [
            f'<DataSet timestep="{time!r}" group="" part="{part}" file={quoteattr(file)}/>'
            for part, file in enumerate(files)
        ]
    lines += ["</Collection>", "</VTKFile>", ""]
    write_atomically(target, lambda path: path.write_text("\n".join(lines), encoding="utf-8"))


def _element_set_flags(mesh: Any, element: np.ndarray) -> dict[str, np.ndarray]:
    """0/1 flags of the cells of each element group; `element`: the element of each cell."""
    sets = getattr(mesh, "element_sets", None) or {}
    return {f"set:{name}": np.isin(element, np.asarray(members)).astype(np.int32) for name, members in sets.items()}


def _write_vtu(cells: Cells, points: np.ndarray, data: dict[str, np.ndarray], path: pathlib.Path) -> None:
    """One VTU file. All arguments are copied, since meshio modifies its input."""
    mesh = meshio.Mesh(
        np.array(points),
        [(cells[0], np.array(cells[1]))],
        point_data={name: np.array(value) for name, value in data.items()},
        cell_data={name: [np.array(flags)] for name, flags in cells[2].items()},
    )
    mesh.write(path, file_format="vtu")
