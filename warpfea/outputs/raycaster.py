"""Ray caster: pictures of triangle surfaces on Warp's CPU device, without OpenGL or a display."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.checks import number_pair
from ..base.console import quiet_warp
from ..base.errors import ModelError, OutputError
from .colormap import to_linear, to_srgb
from .normals import scatter_rows, smooth_corners, unit_rows

__all__ = ["DEFAULT_VIEW", "Camera", "Renderer", "check_view", "nice_number", "to_z_up"]

Floats = npt.NDArray[np.floating[Any]]
Image = npt.NDArray[np.uint8]
DEFAULT_VIEW = (-65.0, 20.0)  # default azimuth, elevation (degrees)


@dataclass(frozen=True)
class Camera:
    """A perspective camera in a frame with z up.

    eye, target: (3,) float64, m. fov: vertical opening (degrees). center: position of the target in the picture,
    from (-1, -1) lower left to (1, 1) upper right. size: radius (m) of the scene, the scale of ground and shadows.
    """

    eye: Floats
    target: Floats
    fov: float = 24.0
    center: tuple[float, float] = (0.0, 0.0)
    size: float = 1.0

    def axes(self) -> tuple[Floats, Floats, Floats]:
        """Unit vectors forward, right, up."""
        forward = (self.target - self.eye) / np.linalg.norm(self.target - self.eye)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        if np.linalg.norm(right) < 1e-6:
            right = np.array([1.0, 0.0, 0.0])
        right = right / np.linalg.norm(right)
        return forward, right, np.cross(right, forward)

    def project(self, point: Floats, size: tuple[int, int]) -> tuple[float, float]:
        """Pixel (x, y), y down, of a point (3,) m in a picture of a size."""
        forward, right, up = self.axes()
        local = point - self.eye
        tangent = np.tan(np.radians(0.5 * self.fov)) * max(float(local @ forward), 1e-9 * self.size)
        x = float(local @ right) / (tangent * size[0] / size[1]) + self.center[0]
        y = float(local @ up) / tangent + self.center[1]
        return 0.5 * (x + 1.0) * size[0], 0.5 * (1.0 - y) * size[1]

    @classmethod
    def framing(
        cls,
        points: Floats,
        *,
        view: tuple[float, float] = DEFAULT_VIEW,
        aspect: float = 16 / 9,
        fov: float = 24.0,
        margins: tuple[float, float, float, float] = (0.06, 0.06, 0.08, 0.08),
    ) -> Camera:
        """The camera at (azimuth, elevation) degrees that shows all `points` (P, 3).

        `margins` (left, right, bottom, top) are free fractions of the picture. ModelError for a `view` that is
        not two finite numbers, or an elevation beyond +-90.
        """
        view = check_view(view)
        low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
        size = max(0.5 * float(np.linalg.norm(high - low)), 1e-9)
        # straight up or down the picture's right side is undefined: tilt slightly, keeping the azimuth
        azimuth, elevation = np.radians((view[0], np.clip(view[1], -89.999, 89.999)))
        back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        left, right_, bottom, top = margins
        share = np.array([1.0 - left - right_, 1.0 - bottom - top])
        tangent = np.tan(np.radians(0.5 * fov)) * np.array([aspect, 1.0])
        center = (left - right_, bottom - top)
        middle = 0.5 * (low + high)
        forward, right, up = cls(middle + back, middle).axes()
        local = (points - middle) @ np.stack([right, up, forward], axis=1)
        distance = 1.02 * size
        for side, slope in zip(local[:, :2].T, tangent * share):  # all |side - eye| <= slope (depth + distance)
            reach = (side - slope * local[:, 2]).max() - (side + slope * local[:, 2]).min()
            distance = max(distance, 0.5 * float(reach) / slope)
        offset = [_centred_eye(side, local[:, 2] + distance) for side in local[:, :2].T]
        target = middle + right * offset[0] + up * offset[1]
        return cls(target + distance * back, target, fov, center, size)


def check_view(view: Any) -> tuple[float, float]:
    """(azimuth, elevation) degrees. ModelError unless it is two finite numbers, the elevation within +-90."""
    azimuth, elevation = number_pair(view)
    if not (np.isfinite(azimuth) and abs(elevation) <= 90.0):
        raise ModelError(f"view must be (azimuth, elevation) in degrees, the elevation within +-90, got {view!r}")
    return azimuth, elevation


def _centred_eye(side: Floats, depth: Floats) -> float:
    """Eye position along one axis that centres the points (P,) in the picture."""
    low, high = float(side.min()), float(side.max())
    for _ in range(60):  # monotonic in the eye position: bisection
        eye = 0.5 * (low + high)
        projected = (side - eye) / depth
        low, high = (eye, high) if projected.max() + projected.min() > 0.0 else (low, eye)
    return 0.5 * (low + high)


def to_z_up(points: Floats, up_axis: str) -> npt.NDArray[np.float64]:
    """Points (P, 3) as float64 in the frame with z up that cameras use."""
    p = np.asarray(points, dtype=np.float64)
    return p if up_axis == "Z" else np.stack([p[:, 0], -p[:, 2], p[:, 1]], axis=1)


class Renderer:
    """Draws triangles with smooth normals, soft light and a shadow on the ground.

    Args:
        triangles: (T, 3) point indices, counter-clockwise seen from outside.
        reference: (P, 3) points whose dihedral angles define edges (sharper than 40 degrees); default: those of the
            first picture.
        up_axis: "Z" or "Y"; points are rotated so that this axis is up.
        ground: height (m) of the ground along the up axis, None for no ground.
        edges: (E, 2) points along edges of elements, drawn as lines; None: not drawn.
        ghost: points (Q, 3) and triangles of a surface that is drawn seen through.
        cut: (4,) in the frame with z up: nothing with direction . x > place is drawn.

    The mesh is built once and refitted when points move. Not usable inside a graph capture.
    """

    def __init__(
        self,
        triangles: npt.NDArray[np.integer[Any]],
        *,
        reference: Floats | None = None,
        up_axis: str = "Z",
        ground: float | None = None,
        edges: npt.NDArray[np.integer[Any]] | None = None,
        ghost: tuple[Floats, npt.NDArray[np.integer[Any]]] | None = None,
        cut: Floats | None = None,
    ) -> None:
        self.triangles = np.ascontiguousarray(triangles, dtype=np.int32)
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3 or not len(self.triangles):
            raise OutputError(f"triangles must have the shape (T, 3), T > 0, got {self.triangles.shape}")
        self.up_axis = up_axis
        self.ground = ground
        self._reference = None if reference is None else np.asarray(reference, dtype=np.float64)
        self._normal_groups: tuple[npt.NDArray[np.int64], int] | None = None
        self._mesh: Any = None
        self._sides = np.zeros(0, dtype=np.int32) if edges is None else side_bits(self.triangles, edges)
        self._ghost_mesh: Any = None
        self._ghost, self._cut = ghost, cut

    def render(
        self, points: Floats, colors: Floats, camera: Camera | None = None, size: tuple[int, int] = (960, 540)
    ) -> Image:
        """A picture (height, width, 3) of points (P, 3) in metres with sRGB colours (P, 3) in [0, 1].

        Without a camera, one that frames the points. OutputError if points are not finite or counts differ.
        """
        import warp as wp

        from ..kernels.outputs import raycast

        points = to_z_up(points, self.up_axis)
        if not np.isfinite(points).all() or self.triangles.max() >= len(points) or len(colors) != len(points):
            raise OutputError("points must be finite, as many as colours, and as many as triangles refer to")
        width, height = size
        camera = camera or Camera.framing(points, aspect=width / height)
        if self._normal_groups is None:
            base = points if self._reference is None else to_z_up(self._reference, self.up_axis)
            self._normal_groups = smooth_corners(base, self.triangles)
        unit = (points - camera.target) / camera.size
        with quiet_warp(), wp.ScopedDevice("cpu"):
            scene = self._make_scene(wp, raycast, unit, np.asarray(colors), camera, size)
            self._cast_shadow(wp, raycast, scene, unit)
            centers = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
            image = self._cast(wp, raycast, scene, centers.reshape(-1, 2).astype(np.float32)).reshape(height, width, 3)
            shown = to_srgb(image)
            edges = edge_pixels(shown)
            rows, columns = np.nonzero(edges)
            corners = np.stack([columns, rows], axis=1).astype(np.float32)
            fine = (corners[:, None, :] + _SUBPIXELS).reshape(-1, 2)
            shown[edges] = to_srgb(self._cast(wp, raycast, scene, fine).reshape(-1, len(_SUBPIXELS), 3).mean(axis=1))
        return np.asarray(np.round(shown * 255.0), dtype=np.uint8)

    def _make_scene(
        self, wp: Any, raycast: Any, unit: Floats, colors: Floats, camera: Camera, size: tuple[int, int]
    ) -> Any:
        assert self._normal_groups is not None
        points = np.ascontiguousarray(unit, dtype=np.float32)
        if self._mesh is None or len(self._mesh.points) != len(points):
            self._mesh = wp.Mesh(wp.array(points, dtype=wp.vec3), wp.array(self.triangles.ravel(), dtype=wp.int32))
        else:
            self._mesh.points.assign(points)
            self._mesh.refit()
        corner = unit[self.triangles]
        area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        group, count = self._normal_groups
        normals = unit_rows(scatter_rows(group, np.repeat(area, 3, axis=0), count))[group]
        forward, right, up = camera.axes()
        tangent = np.tan(np.radians(0.5 * camera.fov))
        scene = raycast.Scene()
        scene.mesh = self._mesh.id
        scene.corner_normals = wp.array(normals, dtype=wp.vec3)
        scene.colors = wp.array(to_linear(colors).astype(np.float32), dtype=wp.vec3)
        scene.eye = wp.vec3(*((camera.eye - camera.target) / camera.size))
        scene.forward = wp.vec3(*forward)
        scene.right = wp.vec3(*(right * tangent * size[0] / size[1]))
        scene.up = wp.vec3(*(up * tangent))
        scene.principal_point = wp.vec2(*camera.center)
        scene.width_pixels, scene.height_pixels = float(size[0]), float(size[1])
        side = 0.55 * up - 0.55 * right - 0.45 * forward + np.array([0.0, 0.0, 0.75])
        self._light = side / np.linalg.norm(side)
        scene.light_direction = wp.vec3(*self._light)
        self._set_extras(wp, scene, camera)
        scene.has_ground = 0
        if self.ground is not None and camera.eye[2] > self.ground:
            scene.has_ground = 1
            scene.ground_height = float((self.ground - camera.target[2]) / camera.size) - 2e-3
            scene.grid_spacing = nice_number(0.2 * camera.size) / camera.size
            scene.fade_radius = 2.2
        return scene

    def _set_extras(self, wp: Any, scene: Any, camera: Camera) -> None:
        """Edges of elements, the surface seen through and the section, in the scene's scale."""
        scene.sides = wp.array(self._sides, dtype=wp.int32)
        scene.ghost, scene.has_ghost, scene.has_cut = self._mesh.id, 0, 0
        if self._ghost is not None:
            points = (to_z_up(self._ghost[0], self.up_axis) - camera.target) / camera.size
            triangles = np.ascontiguousarray(self._ghost[1], dtype=np.int32).ravel()
            corners = wp.array(np.ascontiguousarray(points, dtype=np.float32), dtype=wp.vec3)
            self._ghost_mesh = wp.Mesh(corners, wp.array(triangles, dtype=wp.int32))
            scene.ghost, scene.has_ghost = self._ghost_mesh.id, 1
        if self._cut is not None:
            place = float(self._cut[3] - self._cut[:3] @ camera.target) / camera.size
            scene.cut, scene.has_cut = wp.vec4(*map(float, self._cut[:3]), place), 1

    def _cast_shadow(self, wp: Any, raycast: Any, scene: Any, unit: Floats, cells: int = 160) -> None:
        """Fill the light map of the ground, over the area of possible shadow."""
        scene.shadow_map = wp.ones((1, 1), dtype=float)
        scene.shadow_cell_size = 1.0
        if not scene.has_ground:
            return
        lights = cone_directions(self._light, 0.14, 40)
        lights = lights[lights[:, 2] > 0.05]
        fall = np.maximum(unit[:, 2] - scene.ground_height, 0.0)[:, None, None]
        spots = unit[:, None, :2] - fall * (lights[:, :2] / lights[:, 2:])[None, ::4]
        low, high = spots.min(axis=(0, 1)), spots.max(axis=(0, 1))
        cell = float(max((high - low).max(), 1e-6)) / (cells - 4)
        shape = np.ceil((high - low) / cell).astype(int) + 4
        scene.shadow_map_corner, scene.shadow_cell_size = wp.vec2(*(low - 2 * cell)), cell
        shadow = wp.empty(tuple(map(int, shape)), dtype=float)
        wp.launch(raycast.cast_shadow, shadow.shape, [scene, wp.array(lights, dtype=wp.vec3), shadow])
        scene.shadow_map = shadow

    @staticmethod
    def _cast(wp: Any, raycast: Any, scene: Any, samples: Floats) -> npt.NDArray[np.float32]:
        out = wp.empty(len(samples), dtype=wp.vec3)
        if len(samples):
            wp.launch(raycast.cast_rays, len(samples), [scene, wp.array(samples, dtype=wp.vec2), out])
        return out.numpy()


# 8 rooks: one per row and column of an 8 x 8 raster
_SUBPIXELS = np.array([[(k + 0.5) / 8, ((5 * k + 2) % 8 + 0.5) / 8] for k in range(8)], dtype=np.float32)


def side_bits(triangles: npt.NDArray[np.integer[Any]], edges: npt.NDArray[np.integer[Any]]) -> npt.NDArray[np.int32]:
    """(T,) bits 1, 2, 4 of triangles: the side opposite that corner is among the edges (E, 2)."""
    count = int(triangles.max()) + 1
    known = np.sort(edges, axis=1) @ np.array([count, 1])
    out = np.zeros(len(triangles), dtype=np.int32)
    for k in range(3):
        side = np.sort(triangles[:, [(k + 1) % 3, (k + 2) % 3]].astype(np.int64), axis=1) @ np.array([count, 1])
        out |= np.isin(side, known).astype(np.int32) << k
    return out


def edge_pixels(image: Floats, limit: float = 0.025) -> npt.NDArray[np.bool_]:
    """(height, width) pixels of an sRGB picture that differ from a neighbour, for supersampling."""
    edges = np.zeros(image.shape[:2], dtype=bool)
    for channel in np.moveaxis(image, 2, 0):  # reductions over an axis of length three are slow in numpy
        down = np.abs(np.diff(channel, axis=0)) > limit
        across = np.abs(np.diff(channel, axis=1)) > limit
        edges[1:] |= down
        edges[:-1] |= down
        edges[:, 1:] |= across
        edges[:, :-1] |= across
    return edges


def cone_directions(axis: Floats, tangent: float, count: int) -> npt.NDArray[np.float32]:
    """(count, 3) unit directions evenly over a disc of radius `tangent` (of the half angle) around a unit axis."""
    side = np.cross(axis, (1.0, 0.0, 0.0) if abs(axis[0]) < 0.7 else (0.0, 1.0, 0.0))
    side /= np.linalg.norm(side)
    k = np.arange(count)
    radius, angle = tangent * np.sqrt((k + 0.5) / count), 2.399963 * k
    around = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(axis, side)
    return unit_rows(axis + radius[:, None] * around)


def nice_number(x: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is at most x > 0."""
    power = 10.0 ** np.floor(np.log10(x))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step <= x / power * (1 + 1e-12)))
