"""Ray caster: pictures of triangle surfaces on Warp's CPU device, without OpenGL or a display."""

from __future__ import annotations

import concurrent.futures
import functools
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.checks import number_pair
from ..base.console import quiet_warp
from ..base.errors import ModelError, OutputError
from .colormap import to_linear, to_srgb
from .normals import CornerNormals, smooth_corners, unit_rows

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
        return self._axes

    @functools.cached_property
    def _axes(self) -> tuple[Floats, Floats, Floats]:
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
        opacity: (T,) of triangles, 0 to 1; None: all opaque. Transparent ones cast no shadow.
        gridded: (T,) mask of triangles drawn with a grid that is fixed to the reference.

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
        opacity: Floats | None = None,
        gridded: npt.NDArray[np.bool_] | None = None,
    ) -> None:
        self.triangles = np.ascontiguousarray(triangles, dtype=np.int32)
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3 or not len(self.triangles):
            raise OutputError(f"triangles must have the shape (T, 3), T > 0, got {self.triangles.shape}")
        self.up_axis = up_axis
        self.ground = ground
        self._reference = None if reference is None else np.asarray(reference, dtype=np.float64)
        self._normals: tuple[npt.NDArray[np.int64], CornerNormals] | None = None
        self._mesh: Any = None
        self._seen: tuple[float, ...] = ()
        self._backdrop: Image | None = None
        self._shadow_corners = np.zeros((0, 3))
        self._sides = np.zeros(0, dtype=np.int32) if edges is None else side_bits(self.triangles, edges)
        if gridded is not None:
            bits = np.where(gridded, 8, 0).astype(np.int32)
            self._sides = bits | self._sides if len(self._sides) else bits
        self._opacity = np.zeros(0) if opacity is None else np.asarray(opacity)
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
        if self._normals is None:
            base = points if self._reference is None else to_z_up(self._reference, self.up_axis)
            group, count = smooth_corners(base, self.triangles)
            self._normals = group, CornerNormals(self.triangles, group, count)
        unit = (points - camera.target) / camera.size
        with quiet_warp(), wp.ScopedDevice("cpu"):
            scene = self._make_scene(wp, raycast, unit, np.asarray(colors), camera, size)
            self._cast_shadow(wp, raycast, scene, unit)
            if scene.has_ground:
                low = np.array(scene.shadow_map_corner)
                high = low + scene.shadow_cell_size * np.array(scene.shadow_map.shape)
                corners = [(x, y, scene.ground_height) for x in (low[0], high[0]) for y in (low[1], high[1])]
                self._shadow_corners = camera.target + camera.size * np.array(corners)
            every = slice(0, height), slice(0, width)
            seen = (*camera.eye, *camera.target, *camera.center, camera.fov, *size)
            if seen != self._seen:
                self._seen, self._backdrop = seen, None
                return self._picture(wp, raycast, scene, size, every)
            # the camera stands still: what is far from surfaces and their shadow is drawn once
            if self._backdrop is None:
                mesh, shadow = scene.mesh, scene.shadow_map
                nothing: Any = wp.array(np.full((3, 3), 1e6), dtype=wp.vec3)
                empty = wp.Mesh(nothing, wp.array([0, 1, 2], dtype=wp.int32))
                scene.mesh, scene.shadow_map = empty.id, wp.ones((1, 1), dtype=float)
                self._backdrop = self._picture(wp, raycast, scene, size, every)
                scene.mesh, scene.shadow_map = mesh, shadow
            shown = self._backdrop.copy()
            rows, columns = self._near(points, camera, size)
            within = self._picture(wp, raycast, scene, size, (rows, columns))
            inner = [
                slice(s.start + (s.start > 0), s.stop - (s.stop < n)) for s, n in zip((rows, columns), (height, width))
            ]
            shown[inner[0], inner[1]] = within[
                inner[0].start - rows.start : inner[0].stop - rows.start,
                inner[1].start - columns.start : inner[1].stop - columns.start,
            ]
            return shown

    @staticmethod
    def _picture(wp: Any, raycast: Any, scene: Any, size: tuple[int, int], part: tuple[slice, slice]) -> Image:
        """Rows and columns of a picture, with more rays where neighbours differ."""
        centers = pixel_centers(size).reshape(size[1], size[0], 2)[part]
        shown = to_bytes(cast_samples(wp, raycast, scene, centers.reshape(-1, 2))).reshape(*centers.shape[:2], 3)
        edges = edge_pixels(shown)
        fine = cast_samples(wp, raycast, scene, (centers[edges][:, None] - np.float32(0.5) + _SUBPIXELS).reshape(-1, 2))
        shown[edges] = to_bytes(fine.reshape(-1, len(_SUBPIXELS), 3).mean(axis=1))
        return shown

    def _near(self, points: Floats, camera: Camera, size: tuple[int, int]) -> tuple[slice, slice]:
        """Rows and columns of the pixels in which surfaces and their shadow may be, and their neighbours."""
        forward, right, up = camera.axes()
        local = (np.concatenate([points, self._shadow_corners]) - camera.eye) @ np.stack([right, up, forward], axis=1)
        if self._ghost is not None or local[:, 2].min() <= 0.0:
            return slice(0, size[1]), slice(0, size[0])
        tangent = np.tan(np.radians(0.5 * camera.fov)) * np.array([size[0] / size[1], -1.0])
        place = (0.5 + 0.5 * (local[:, :2] / local[:, 2:] / tangent + np.array(camera.center) * (1.0, -1.0))) * size
        low, high = np.clip([place.min(axis=0) - 3.0, place.max(axis=0) + 4.0], 0.0, size).astype(int)
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    def _make_scene(
        self, wp: Any, raycast: Any, unit: Floats, colors: Floats, camera: Camera, size: tuple[int, int]
    ) -> Any:
        assert self._normals is not None
        points = np.ascontiguousarray(unit, dtype=np.float32)
        if self._mesh is None or len(self._mesh.points) != len(points):
            self._mesh = wp.Mesh(wp.array(points, dtype=wp.vec3), wp.array(self.triangles.ravel(), dtype=wp.int32))
        else:
            self._mesh.points.assign(points)
            self._mesh.refit()
        group, rows = self._normals
        normals = rows.at(unit)[group]
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
        scene.grid_spacing = nice_number(0.2 * camera.size) / camera.size
        self._set_extras(wp, scene, camera)
        scene.has_ground = 0
        if self.ground is not None and camera.eye[2] > self.ground:
            scene.has_ground = 1
            scene.ground_height = float((self.ground - camera.target[2]) / camera.size) - 2e-3
            scene.fade_radius = 2.2
        return scene

    def _set_extras(self, wp: Any, scene: Any, camera: Camera) -> None:
        """Edges of elements, the surface seen through and the section, in the scene's scale."""
        scene.sides = wp.array(self._sides, dtype=wp.int32)
        scene.opacity, scene.blocker = wp.array(self._opacity, dtype=float), self._mesh.id
        if len(self._opacity):
            opaque = self.triangles[self._opacity == 1.0]
            if not len(opaque):
                opaque = self.triangles[:1, [0, 0, 0]]
            self._blocker = wp.Mesh(self._mesh.points, wp.array(opaque.ravel(), dtype=wp.int32))
            scene.blocker = self._blocker.id
        if self._reference is not None:
            points = to_z_up(self._reference, self.up_axis) / camera.size
            scene.reference = wp.array(np.ascontiguousarray(points, dtype=np.float32), dtype=wp.vec3)
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

    def _cast_shadow(self, wp: Any, raycast: Any, scene: Any, unit: Floats, cells: int = 112) -> None:
        """Fill the light map of the ground, over the area of possible shadow."""
        scene.shadow_map = wp.ones((1, 1), dtype=float)
        scene.shadow_cell_size = 1.0
        if not scene.has_ground:
            return
        lights = cone_directions(self._light, 0.14, 24)
        lights = lights[lights[:, 2] > 0.05]
        fall = np.maximum(unit[:, 2] - scene.ground_height, 0.0)[:, None, None]
        spots = unit[:, None, :2] - fall * (lights[:, :2] / lights[:, 2:])[None, ::4]
        low, high = spots.min(axis=(0, 1)), spots.max(axis=(0, 1))
        cell = float(max((high - low).max(), 1e-6)) / (cells - 4)
        shape = np.ceil((high - low) / cell).astype(int) + 4
        scene.shadow_map_corner, scene.shadow_cell_size = wp.vec2(*(low - 2 * cell)), cell
        parts = [(wp.array(part, dtype=wp.vec3), wp.empty(tuple(map(int, shape)), dtype=float))
                 for part in np.array_split(lights, min(os.cpu_count() or 1, 8))]  # fmt: skip

        def launch(part: Any, shadow: Any) -> None:
            wp.launch(raycast.cast_shadow, shadow.shape, [scene, part, shadow], device="cpu")

        launch(parts[0][0][:0], parts[0][1])  # loads the kernel, see `cast_samples`
        with concurrent.futures.ThreadPoolExecutor(len(parts)) as pool:
            list(pool.map(launch, *zip(*parts)))
        mean = sum(len(part) * shadow.numpy() for part, shadow in parts) / len(lights)
        scene.shadow_map = wp.array(mean, dtype=float)


def cast_samples(wp: Any, raycast: Any, scene: Any, samples: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Colours (n, 3), linear light, of places (n, 2) of the picture, cast in as many threads as there are cores."""
    places, out = wp.array(samples, dtype=wp.vec2), wp.empty(len(samples), dtype=wp.vec3)

    def launch(first: int, last: int) -> None:
        if last > first:
            wp.launch(raycast.cast_rays, last - first, [scene, places[first:last], out[first:last]], device="cpu")

    launch(0, min(1, len(samples)))  # loads the kernel, which threads must not do at once
    ends = np.linspace(1, len(samples), 1 + min(os.cpu_count() or 1, 8, 1 + len(samples) // 4096)).astype(int).tolist()
    with concurrent.futures.ThreadPoolExecutor(len(ends)) as pool:
        list(pool.map(launch, ends[:-1], ends[1:]))
    return np.asarray(out.numpy())


@functools.lru_cache(maxsize=4)
def pixel_centers(size: tuple[int, int]) -> npt.NDArray[np.float32]:
    """(width x height, 2) middles of the pixels of a picture, row by row."""
    return np.stack(np.meshgrid(*(np.arange(n, dtype=np.float32) + 0.5 for n in size)), axis=-1).reshape(-1, 2)


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


def to_bytes(linear: npt.NDArray[np.float32]) -> Image:
    """sRGB components, 0 to 255, of linear light, by a table: the nearest ones, or in shades near black one off."""
    table = _byte_table()
    return table[(np.clip(linear, 0.0, 1.0) * np.float32(len(table) - 1) + np.float32(0.5)).astype(np.uint16)]


@functools.cache
def _byte_table() -> Image:
    return np.round(255.0 * to_srgb(np.arange(1 << 16) / 65535.0)).astype(np.uint8)


def edge_pixels(image: Image, limit: int = 6) -> npt.NDArray[np.bool_]:
    """(height, width) pixels of an sRGB picture that differ from a neighbour by more than a limit, of 255."""
    edges = np.zeros(image.shape[:2], dtype=bool)
    for channel in np.moveaxis(image.astype(np.int16), 2, 0):  # over an axis of length three numpy is slow
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
