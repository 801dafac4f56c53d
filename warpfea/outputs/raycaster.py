"""Ray caster: pictures of triangle surfaces on Warp's CPU device, without OpenGL or a display."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.checks import number_pair
from ..base.console import quiet_warp
from ..base.errors import ModelError, OutputError
from .colormap import to_linear
from .normals import CornerNormals, smooth_corners, unit_rows
from .pixels import MIDDLE, SUBPIXELS, Image, cast_pixels, edge_pixels, grown, pixels_of, rasterize, to_bytes

__all__ = ["DEFAULT_VIEW", "Camera", "Image", "Renderer", "check_view", "nice_number", "to_z_up"]

Floats = npt.NDArray[np.floating[Any]]
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

    def pixels(self, points: Floats, size: tuple[int, int]) -> tuple[Floats, Floats]:
        """Pixels (n, 2) as of `project`, and depths (n,) in m, of points (n, 3); for positive depths only."""
        forward, right, up = self.axes()
        local = (points - self.eye) @ np.stack([right, up, forward], axis=1)
        depth = np.where(local[:, 2] > 0.0, local[:, 2], 1.0)
        tangent = np.tan(np.radians(0.5 * self.fov)) * np.array([size[0] / size[1], -1.0])
        place = local[:, :2] / depth[:, None] / tangent + np.array(self.center) * (1.0, -1.0)
        return (0.5 + 0.5 * place) * size, local[:, 2]

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
        self._backdrop: tuple[Image, Image] | None = None
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
            seen = (*camera.eye, *camera.target, *camera.center, camera.fov, *size)
            if seen != self._seen:  # what is far from surfaces and their shadow is drawn once for a camera
                self._seen, self._backdrop = seen, self._cast_backdrop(wp, raycast, scene, size)
            self._cast_shadow(wp, raycast, scene, unit)
            return self._picture(wp, raycast, scene, points, camera, size)

    @staticmethod
    def _cast_backdrop(wp: Any, raycast: Any, scene: Any, size: tuple[int, int]) -> tuple[Image, Image]:
        """The picture without surfaces: by one ray for each pixel, and with more where neighbours differ."""
        scene.shadow_map = wp.ones((1, 1), dtype=float)

        def drawn_pixels(cells: npt.NDArray[np.bool_], offsets: Floats) -> Image:
            pixels = pixels_of(cells)
            return to_bytes(cast_pixels(wp, raycast, scene, pixels, offsets, np.full((len(pixels), len(offsets)), -1)))

        raw = drawn_pixels(np.ones(size[::-1], dtype=bool), MIDDLE).reshape(*size[::-1], 3)
        fine, edges = raw.copy(), edge_pixels(raw)
        fine[edges] = drawn_pixels(edges, SUBPIXELS)
        return raw, fine

    def _picture(
        self, wp: Any, raycast: Any, scene: Any, points: Floats, camera: Camera, size: tuple[int, int]
    ) -> Image:
        """The backdrop, with rays for the pixels that surfaces or their shadow cover, more where neighbours differ."""
        assert self._backdrop is not None
        corners = self._shadow_corners
        place, depth = camera.pixels(np.concatenate([points, camera.target + camera.size * corners]), size)
        infront = depth.min() > 0.0
        low, high = np.zeros(2, dtype=int), np.array(size)
        if infront and self._ghost is None:
            low, high = np.clip([place.min(axis=0) - 3.0, place.max(axis=0) + 4.0], 0.0, size).astype(int)
        part = slice(low[1], high[1]), slice(low[0], high[0])
        drawn = np.column_stack([place - low, 1.0 / depth])[: len(points)] if infront else None

        opaque = not (len(self._opacity) or self._ghost or self._cut is not None)

        def drawn_pixels(cells: npt.NDArray[np.bool_], offsets: Floats, faces: Any = None) -> Image:
            if faces is None and drawn is not None and opaque:
                faces = rasterize(wp, raycast, drawn, self.triangles, cells, offsets)
            return to_bytes(cast_pixels(wp, raycast, scene, pixels_of(cells, low), offsets, faces))

        covered, faces = np.ones((high - low)[::-1], dtype=bool), None
        if drawn is not None and self._ghost is None:
            first = rasterize(wp, raycast, drawn, self.triangles, covered, MIDDLE)
            covered = first.reshape(covered.shape) >= 0
            if len(corners):
                begin = np.maximum(place[-4:].min(axis=0) - low - 1.0, 0.0).astype(int)
                end = np.maximum(place[-4:].max(axis=0) - low + 2.0, 0.0).astype(int)
                covered[begin[1] : end[1], begin[0] : end[0]] = True
            faces = first[covered.ravel()] if opaque else None
        raw = self._backdrop[0][part].copy()
        raw[covered] = drawn_pixels(covered, MIDDLE, faces)
        shown = self._backdrop[1].copy()
        shown[part][covered] = raw[covered]
        edges = edge_pixels(raw) & grown(covered)
        shown[part][edges] = drawn_pixels(edges, SUBPIXELS)
        return shown

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
        self._shadow_corners = np.zeros((0, 3))
        if not scene.has_ground:
            return
        lights = cone_directions(self._light, 0.14, 24)
        lights = lights[lights[:, 2] > 0.05]
        slopes = lights[:, :2].astype(np.float64) / lights[:, 2:]
        height = (unit[:, 2] - scene.ground_height)[:, None]
        fall = np.maximum(height, 0.0)
        low = (unit[:, :2] - fall * slopes.max(axis=0)).min(axis=0)
        high = (unit[:, :2] - fall * slopes.min(axis=0)).max(axis=0)
        cell = float(max((high - low).max(), 1e-6)) / (cells - 4)
        low = low - 2 * cell
        columns, rows = np.ceil((high - low) / cell).astype(int) + 2
        # one grid above the other, for each direction; what lies below the ground is behind the viewer
        fallen = [(unit[:, :2] - height * slope - low) / cell + (0, k * rows) for k, slope in enumerate(slopes)]
        corners = np.concatenate([np.column_stack([place, height]) for place in fallen])
        opaque = self.triangles[self._opacity == 1.0] if len(self._opacity) else self.triangles
        triangles = np.concatenate([opaque + k * len(unit) for k in range(len(slopes))])
        faces = rasterize(wp, raycast, corners, triangles, np.ones((len(slopes) * rows, columns), bool), MIDDLE)
        share = (faces < 0).reshape(len(slopes), rows, columns).mean(axis=0)
        scene.shadow_map_corner, scene.shadow_cell_size = wp.vec2(*low), cell
        scene.shadow_map = wp.array(share.T, dtype=float)
        high = low + cell * np.array([columns, rows])
        self._shadow_corners = np.array(
            [(x, y, scene.ground_height) for x in (low[0], high[0]) for y in (low[1], high[1])]
        )


def side_bits(triangles: npt.NDArray[np.integer[Any]], edges: npt.NDArray[np.integer[Any]]) -> npt.NDArray[np.int32]:
    """(T,) bits 1, 2, 4 of triangles: the side opposite that corner is among the edges (E, 2)."""
    count = int(triangles.max()) + 1
    known = np.sort(edges, axis=1) @ np.array([count, 1])
    out = np.zeros(len(triangles), dtype=np.int32)
    for k in range(3):
        side = np.sort(triangles[:, [(k + 1) % 3, (k + 2) % 3]].astype(np.int64), axis=1) @ np.array([count, 1])
        out |= np.isin(side, known).astype(np.int32) << k
    return out


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
