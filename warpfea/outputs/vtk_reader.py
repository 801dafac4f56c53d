"""Results read back from a series that VTUWriter wrote."""

from __future__ import annotations

import json
import os
import pathlib
import re
import xml.etree.ElementTree as ElementTree
from functools import cached_property
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..base.lazy import meshio
from ..base.names import check_known
from ..mesh.adapter import meshio_errors
from ..terms.fields import ELEMENT_FIELDS, SYMMETRIC

__all__ = ["SavedResults", "listed_names", "read_results", "read_series"]

FILE = re.compile(r"(.*)_(\d{4})_\d{6}\.vtu")
"""Body, world and frame of a file."""


def read_series(path: pathlib.Path) -> list[tuple[float, list[str]]]:
    """Times and files of a .pvd. OSError, ParseError, KeyError, ValueError for a bad one."""
    frames: list[tuple[float, list[str]]] = []
    for entry in ElementTree.parse(path).getroot().iter("DataSet"):
        time, file = float(entry.attrib["timestep"]), entry.attrib["file"]
        if not frames or time != frames[-1][0]:
            frames.append((time, []))
        frames[-1][1].append(file)
    return frames


def listed_names(path: pathlib.Path, what: str) -> list[str]:
    """Names that a .pvd lists: its "symmetric" tensors, its "bodies"."""
    return list(json.loads(next(ElementTree.parse(path).getroot().iter("Collection")).get(what, "[]")))


def read_results(path: str | os.PathLike[str]) -> SavedResults:
    """Results of a series of VTUWriter.

    Args:
        path: its .pvd file; or a folder with one of its name.

    Raises:
        ModelError: no such file, or one that is no series of VTUWriter. MeshError, when they are asked for: a file of
            the series that is missing or damaged.
    """
    target = pathlib.Path(path)
    if target.suffix == ".vtu":
        raise ModelError(f"{target}: is one state, which meshio.read reads; a series is a .pvd")
    if target.is_dir():
        target = target / f"{target.resolve().name}.pvd"
    try:
        frames = read_series(target)
    except (OSError, ElementTree.ParseError, KeyError, ValueError) as error:
        raise ModelError(f"{target}: can't be read as a series ({error})") from error
    if not frames or not all(FILE.fullmatch(file) for _, files in frames for file in files):
        raise ModelError(f"{target}: is no series of VTUWriter")
    of_elements = {name for name, spec in ELEMENT_FIELDS.items() if spec.components == SYMMETRIC}
    symmetric = of_elements.union(listed_names(target, "symmetric"))
    return SavedResults(target, frames, symmetric, listed_names(target, "bodies"))


class SavedResults:
    """Frames of a series, read when they are asked for.

    Attributes:
        time: (frames,) s, or load factors.
        bodies: names of the bodies; of a series that does not list them, as in the names of its files.
        worlds: number of worlds.
    """

    def __init__(
        self, path: pathlib.Path, frames: list[tuple[float, list[str]]], symmetric: set[str], bodies: list[str]
    ) -> None:
        self._folder, self._frames, self._symmetric = path.parent, [files for _, files in frames], symmetric
        self.time = np.array([time for time, _ in frames])
        found = [FILE.fullmatch(file) for file in self._frames[0]]
        self.bodies = bodies or list(dict.fromkeys(str(match[1]) for match in found if match))
        self.worlds = len(found) // len(self.bodies)

    def __repr__(self) -> str:
        return f"SavedResults({', '.join(self.bodies)}: {len(self.time)} frames, {self.worlds} worlds)"

    @cached_property
    def _cached(self) -> dict[str, list[list[Any]]]:
        return {}

    def _meshes(self, body: str) -> list[list[Any]]:
        """Meshes of a body, frame by frame and world by world."""
        check_known("body", body, self.bodies)
        if body not in self._cached:
            k = self.bodies.index(body) * self.worlds
            self._cached[body] = [[self._read(file) for file in files[k : k + self.worlds]] for files in self._frames]
        return self._cached[body]

    def _read(self, file: str) -> Any:
        with meshio_errors(str(self._folder / file)):
            return meshio.read(self._folder / file)

    def positions(self, body: str) -> np.ndarray:
        """Positions (frames, worlds, nodes, 3), m."""
        return np.array([[mesh.points for mesh in worlds] for worlds in self._meshes(body)])

    def fields(self, body: str) -> list[str]:
        """Names of the fields of a body."""
        return list(self._meshes(body)[0][0].point_data)

    def field(self, name: str, body: str) -> np.ndarray:
        """A field (frames, worlds, nodes), or (frames, worlds, nodes, k); symmetric tensors as xx yy zz yz xz xy."""
        check_known("field", name, self.fields(body))
        values = np.array([[mesh.point_data[name] for mesh in worlds] for worlds in self._meshes(body)])
        return values[..., [0, 1, 2, 4, 5, 3]] if name in self._symmetric else values
