"""Colliders as writers draw them: meshes in their own axes, and where they are in every world.

A simulation with contact has `collider_poses()`: places (B, K, 3), m, turns (B, K, 3, 3) whose columns are the local
axes, and by how much surfaces lie further out (B, K), m. Others have nothing to draw here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from warpfea.kernels.terms.contact_mesh import MESH
from warpfea.model.shapes import BOX, CAPSULE, CYLINDER, HALF_SPACE
from warpfea.outputs.normals import smooth_corners, vertex_normals

__all__ = ["GREY", "SHEET", "Obstacle", "Obstacles", "names_beside", "near"]

Array = npt.NDArray[np.floating[Any]]
Floats = npt.NDArray[np.float64]
GREY = (0.60, 0.60, 0.61)
"""Colour of obstacles, sRGB."""
SHEET = 6.0
"""Side of the square that stands for a half-space, over the size of the bodies at the start."""


@dataclass(frozen=True, eq=False)
class Obstacle:
    """One collider.

    Attributes:
        name: of the collider.
        kind: name of its shape's class.
        points: (B, n, 3) in its local axes, m; points on sharp edges are there once for each smooth face.
        triangles: (T, 3), outward.
        moves: it has a path.
    """

    name: str
    kind: str
    points: Floats
    triangles: npt.NDArray[np.int32]
    moves: bool

    @property
    def sheet(self) -> bool:
        """A half-space, drawn as a square."""
        return self.kind == "HalfSpace"


class Obstacles:
    """The colliders of a simulation.

    Args:
        low, high: box of the bodies at the start, (3,) m: half-spaces are drawn around it.
    """

    def __init__(self, sim: Any, low: Floats, high: Floats) -> None:
        poses = getattr(sim, "collider_poses", None)
        self._sim = sim if poses is not None and poses() is not None else None
        self.all: list[Obstacle] = []
        if self._sim is None:
            return
        place, turn, grow = sim.collider_poses()
        side = SHEET * float(np.linalg.norm(high - low))
        middle = 0.5 * (low + high)
        for k, collider in enumerate(sim.model.description.colliders):
            shape = collider.shape
            center, axes = shape.frame()
            if shape.kind == HALF_SPACE:
                # the plane may be turned already: the square lies where the bodies are now
                around = center + axes @ (turn[0, k].T @ (middle - place[0, k]))
                points, triangles = shape.mesh(size=side, around=around)
            else:
                points, triangles = shape.mesh(48)
            points, triangles = split_edges((points - center) @ axes, triangles)
            grown = np.stack([_grown(shape, points, triangles, by) for by in grow[:, k]])
            self.all.append(Obstacle(collider.name, type(shape).__name__, grown, triangles, collider.moves))

    def narrow(self, width: float) -> None:
        """Make squares at most so wide, m."""
        for k, obstacle in enumerate(self.all):
            if obstacle.sheet:
                middle = obstacle.points.mean(axis=1, keepdims=True)
                part = min(1.0, width / np.linalg.norm(obstacle.points[0, 1] - obstacle.points[0, 0]))
                self.all[k] = replace(obstacle, points=middle + part * (obstacle.points - middle))

    def __len__(self) -> int:
        return len(self.all)

    def poses(self) -> tuple[Floats, Floats]:
        """Places (B, K, 3), m, and turns (B, K, 3, 3) now."""
        assert self._sim is not None
        place, turn, grow = self._sim.collider_poses()
        sheets = np.array([obstacle.sheet for obstacle in self.all])
        return place + np.where(sheets, grow, 0.0)[:, :, None] * turn[:, :, :, 2], turn

    def points(self) -> list[Floats]:
        """(B, n, 3) present points of each, m."""
        if not self.all:
            return []
        place, turn = self.poses()
        return [
            place[:, k, None] + np.einsum("bnj,bij->bni", obstacle.points, turn[:, k])
            for k, obstacle in enumerate(self.all)
        ]

    def bounded(self) -> list[Floats]:
        """(B, n, 3) present points of those that are no half-spaces, m."""
        return [points for points, obstacle in zip(self.points(), self.all) if not obstacle.sheet]


def near(points: Array, low: Array, high: Array, part: float) -> Array:
    """Points (..., 3) brought into the box from low to high, grown each way by a part of its diagonal."""
    margin = part * float(np.linalg.norm(high - low))
    return np.clip(points, low - margin, high + margin)


def split_edges(points: Floats, triangles: npt.NDArray[np.integer[Any]]) -> tuple[Floats, npt.NDArray[np.int32]]:
    """The same triangles with a point of their own for each smooth face at an edge."""
    group, count = smooth_corners(points, triangles)
    corner = np.empty(count, dtype=np.int64)
    corner[group] = triangles.ravel()
    return points[corner], group.reshape(-1, 3).astype(np.int32)


def _grown(shape: Any, points: Floats, triangles: npt.NDArray[np.int32], by: float) -> Floats:
    """Local points of a shape whose surface lies further out; half-spaces are moved instead."""
    if by == 0.0 or shape.kind == HALF_SPACE:
        return points
    if shape.kind == MESH:
        return points + by * vertex_normals(points, triangles)
    first, second, third = shape.sizes
    size = np.full(3, first)
    if shape.kind == BOX:
        size = np.array([first, second, third])
    elif shape.kind == CYLINDER:
        size[2] = second
    ends = np.zeros_like(points)
    if shape.kind == CAPSULE:
        ends[:, 2] = second * np.sign(points[:, 2])
    return ends + (points - ends) * (size + by) / size


def names_beside(taken: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """Names made unique among each other and those that are taken."""
    out: list[str] = []
    for name in wanted:
        while name in taken or name in out:
            name += "_"
        out.append(name)
    return out
