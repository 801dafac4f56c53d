"""Collider meshes and poses for output.

A simulation with contact has `collider_poses()`: positions (B, K, 3), m, rotations (B, K, 3, 3) whose columns are
the local axes, and outward offsets of the surfaces (B, K), m. Others have no colliders to draw.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..kernels.contact.collider_shapes import MESH
from ..model.shapes import BOX, CAPSULE, CYLINDER, HALF_SPACE, SPHERE
from .normals import smooth_corners, vertex_normals

__all__ = ["OBSTACLE_COLOR", "PLANE_SIZE", "Obstacle", "Obstacles", "clip_to_box", "unique_names"]

Array = npt.NDArray[np.floating[Any]]
Floats = npt.NDArray[np.float64]
OBSTACLE_COLOR = (0.60, 0.60, 0.61)
"""Colour of obstacles, sRGB."""
PLANE_SIZE = 6.0
"""Side of the square drawn for a half-space, over the initial size of the bodies."""
SCALED: dict[int, Callable[[float, float, float], tuple[tuple[float, float, float], float]]] = {
    SPHERE: lambda radius, *_: ((radius, radius, radius), 0.0),
    BOX: lambda x, y, z: ((x, y, z), 0.0),
    CAPSULE: lambda radius, half, _: ((radius, radius, radius), half),
    CYLINDER: lambda radius, half, _: ((radius, radius, half), 0.0),
}
"""Shapes drawn with an outward offset by scaling, by kind: from `Shape.sizes` the lengths along the local axes that
grow by the offset, and the part of the half length along z that does not, m."""


@dataclass(frozen=True, eq=False)
class Obstacle:
    """One collider.

    Attributes:
        name: of the collider.
        kind: name of its shape's class.
        points: (B, n, 3) in its local axes, m; points on sharp edges are duplicated for each smooth face.
        triangles: (T, 3), outward.
        moves: True with a path.
    """

    name: str
    kind: str
    points: Floats
    triangles: npt.NDArray[np.int32]
    moves: bool

    @property
    def is_plane(self) -> bool:
        """A half-space, drawn as a square."""
        return self.kind == "HalfSpace"


class Obstacles:
    """The colliders of a simulation.

    Args:
        low, high: initial bounding box of the bodies, (3,) m: half-spaces are drawn around it.
    """

    def __init__(self, sim: Any, low: Floats, high: Floats) -> None:
        poses = getattr(sim, "collider_poses", None)
        self._sim = sim if poses is not None and poses() is not None else None
        self.all: list[Obstacle] = []
        if self._sim is None:
            return
        position, rotation, offsets = sim.collider_poses()
        side = PLANE_SIZE * float(np.linalg.norm(high - low))
        middle = 0.5 * (low + high)
        for k, collider in enumerate(sim.model.description.colliders):
            shape = collider.shape
            center, axes = shape.frame()
            if shape.kind == HALF_SPACE:
                # the plane may be rotated already: centre the square at the bodies' current position
                around = center + axes @ (rotation[0, k].T @ (middle - position[0, k]))
                points, triangles = shape.mesh(size=side, around=around)
            else:
                points, triangles = shape.mesh(48)
            points, triangles = split_edges((points - center) @ axes, triangles)
            points_of_worlds = np.stack([_offset_points(shape, points, triangles, offset) for offset in offsets[:, k]])
            self.all.append(Obstacle(collider.name, type(shape).__name__, points_of_worlds, triangles, collider.moves))

    def limit_plane_size(self, width: float) -> None:
        """Limit the side of squares, m."""
        for k, obstacle in enumerate(self.all):
            if obstacle.is_plane:
                middle = obstacle.points.mean(axis=1, keepdims=True)
                fraction = min(1.0, width / np.linalg.norm(obstacle.points[0, 1] - obstacle.points[0, 0]))
                self.all[k] = replace(obstacle, points=middle + fraction * (obstacle.points - middle))

    def __len__(self) -> int:
        return len(self.all)

    def poses(self) -> tuple[Floats, Floats]:
        """Current positions (B, K, 3), m, and rotations (B, K, 3, 3)."""
        assert self._sim is not None
        position, rotation, offsets = self._sim.collider_poses()
        plane_squares = np.array([obstacle.is_plane for obstacle in self.all])
        return position + np.where(plane_squares, offsets, 0.0)[:, :, None] * rotation[:, :, :, 2], rotation

    def points(self) -> list[Floats]:
        """(B, n, 3) current points of each, m."""
        if not self.all:
            return []
        position, rotation = self.poses()
        return [
            position[:, k, None] + np.einsum("bnj,bij->bni", obstacle.points, rotation[:, k])
            for k, obstacle in enumerate(self.all)
        ]


def clip_to_box(points: Array, low: Array, high: Array, fraction: float) -> Array:
    """Points (..., 3) clamped to the box from low to high, enlarged each way by a fraction of its diagonal."""
    margin = fraction * float(np.linalg.norm(high - low))
    return np.clip(points, low - margin, high + margin)


def split_edges(points: Floats, triangles: npt.NDArray[np.integer[Any]]) -> tuple[Floats, npt.NDArray[np.int32]]:
    """The same triangles with separate points for each smooth face at an edge."""
    group, count = smooth_corners(points, triangles)
    corner = np.empty(count, dtype=np.int64)
    corner[group] = triangles.ravel()
    return points[corner], group.reshape(-1, 3).astype(np.int32)


def _offset_points(shape: Any, points: Floats, triangles: npt.NDArray[np.int32], offset: float) -> Floats:
    """Local points of a shape with an outward offset of the surface; half-spaces are translated instead."""
    if offset == 0.0 or shape.kind == HALF_SPACE:
        return points
    if shape.kind == MESH:
        return points + offset * vertex_normals(points, triangles)
    size, half = (np.array(values) for values in SCALED[shape.kind](*shape.sizes))
    ends = np.zeros_like(points)
    ends[:, 2] = half * np.sign(points[:, 2])
    return ends + (points - ends) * (size + offset) / size


def unique_names(taken: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """Names made unique among each other and the given ones."""
    out: list[str] = []
    for name in wanted:
        while name in taken or name in out:
            name += "_"
        out.append(name)
    return out
