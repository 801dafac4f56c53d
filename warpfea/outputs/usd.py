"""USD output: one stage per run, with time-sampled surfaces and fields, checked by USD's own validators.

Layout of a stage (metres, kilograms):

    /World                          Xform, default prim; customData["warpfea"]: contents
    /World/world_0000               Xform; its translate lays the worlds out on a grid
    /World/world_0000/<body>        Xform; a double-precision translate per frame, the centre of the body
    /World/world_0000/<body>/skin   Mesh; points, normals, extent and fields per frame, about that centre;
                                    warpfea:edges, pairs of points along edges of elements
    /World/world_0000/<collider>        Xform; translate and orient, per frame of one that moves
    /World/world_0000/<collider>/shape  Mesh in the shape's own axes; customData["warpfea:collider"]: its kind;
    of a half-space a square
    /World/world_0000/marks         Points, guides: supports, joints, loads, probes; customData["warpfea:kinds"]
    /World/Camera /World/Sky /World/Sun

Points are float32 relative to the body's centre, accurate far from the origin. The time code of a sample is its time
times `fps`, fractional if no step ended at the frame's time. In statics the time is the load factor, 0 to 1.
"""

import os
import pathlib
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.background import Background
from ..base.errors import OutputError
from ..base.lazy import pxr
from ..base.provenance import versions
from ..base.writer import Output, check_target, temporary_path
from .colormap import map_colors
from .frames import (
    DrawnSurface,
    FrameClock,
    check_colors,
    check_fields,
    field_label,
    field_names,
    frame_time,
    is_static,
)
from .normals import smooth_corners
from .obstacles import unique_names
from .usd_check import error_text, validate_usd
from .usd_extend import read_existing
from .usd_marks import MarkPrims
from .usd_material import bind_material
from .usd_normals import MeshNormals
from .usd_obstacles import EDGES, ObstaclePrims, define_mesh

__all__ = ["SCHEMA", "USDWriter", "validate_usd"]

SCHEMA = 1
SUFFIXES = (".usdc", ".usda", ".usd")
_SAVE_BYTES = 32 << 20  # unsaved data (bytes) above which a binary layer is flushed to disk
_BODY_COLOR = (0.55, 0.57, 0.60)


@dataclass(eq=False, repr=False)
class USDWriter(Output):
    """Writes `path` (.usdc, .usda or .usd).

    Args:
        path: the target; replaced once the new file is complete and valid.
        fps: frames and time codes per second; :class:`warpfea.outputs.frames.FrameClock` defines the frames.
        fields: scalar fields kept as vertex primvars, SI units.
        color: the field shown as display colour (also a primvar), or None for grey.
        color_range: (low, high) of the colours; without it the extremes over the whole run and all worlds.
        spacing: distance of worlds (m); see :class:`warpfea.outputs.frames.DrawnSurface`.
        material: bind a UsdPreviewSurface that reads the display colour: Blender shows white without it
            (tests/results/blender_material.json).
        layer_data: texts kept as the layer's customLayerData beside versions and units, such as command and seed.
        extend: extend the file of the resumed run, if it exists: same bodies and settings, ending at the current
            time.

    Frames are written to the layer as they occur, binary layers flushed every 32 MB. The state at `close` is always
    the last frame.

    Raises:
        ModelError: a bad `fps`, `fields` or `color`.
        OutputError: bad suffix or folder, or a file that can't be extended (at `open`), non-finite positions (at
            `write`), an invalid file (at `close`; the target is then unchanged).
    """

    path: str | os.PathLike[str]
    _: KW_ONLY
    fps: float = 60.0
    fields: Sequence[str] = ("von_mises", "displacement")
    color: str | None = "von_mises"
    color_range: tuple[float, float] | None = None
    spacing: float | tuple[float, float] | None = None
    material: bool = True
    layer_data: Mapping[str, Any] = field(default_factory=dict)
    extend: bool = False

    def __post_init__(self) -> None:
        self.path = pathlib.Path(self.path)
        self.fps = self.rate = FrameClock(self.fps).fps
        self.fields = field_names(self.fields, self.color)
        self.color_range = check_colors(self.color_range)
        self._stage: Any = None
        self._background = Background()
        self._temporary: pathlib.Path | None = None

    def open(self, sim: Any) -> None:
        self.abort()
        target = self._target = check_target(self.path, SUFFIXES)
        check_fields(sim, self.fields)
        self._surface = DrawnSurface(sim, self.spacing)
        self._clock = FrameClock(self.fps)
        self._time_codes: list[float] = []
        self._field_ranges = {name: (np.inf, -np.inf) for name in self.fields}
        self._bounding_box = (np.full(3, np.inf), np.full(3, -np.inf))
        self._unsaved_bytes = 0
        self._normal_groups: dict[int, tuple[npt.NDArray[Any], int]] = {}
        self._temporary = temporary_path(target)
        extending = self.extend and target.is_file()
        try:
            if extending:
                self._resume(sim, target)
                return
            self._stage = stage = pxr.Usd.Stage.CreateNew(str(self._temporary))
        except (OSError, pxr.Tf.ErrorException) as error:
            self.abort()
            reason = error_text(error) if isinstance(error, pxr.Tf.ErrorException) else error.strerror
            what = "read or continued" if extending else "written"
            raise OutputError(f"{target}: can't be {what} ({reason})") from error
        except OutputError:
            self.abort()
            raise
        pxr.UsdGeom.SetStageUpAxis(stage, self._surface.up_axis)
        pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        pxr.UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(self.fps)
        stage.SetFramesPerSecond(self.fps)
        stage.SetDefaultPrim(pxr.UsdGeom.Xform.Define(stage, "/World").GetPrim())
        self._marks = MarkPrims(sim, stage, self._surface)
        self._define()

    def _names(self) -> list[str]:
        """Names of the bodies' prims."""
        return unique_names((), [pxr.Tf.MakeValidIdentifier(body.name) for body in self._surface.bodies])

    def _normals(self, k: int, mesh: Any) -> MeshNormals:
        """Normals of a mesh of the k-th body; sharp edges are those at rest."""
        triangles, rest = self._surface.bodies[k].skin.triangles, self._surface.rest[k]
        if k not in self._normal_groups:
            self._normal_groups[k] = smooth_corners(rest, triangles)
        return MeshNormals(mesh, triangles, len(rest), self._normal_groups[k])

    def _resume(self, sim: Any, target: pathlib.Path) -> None:
        """Open a copy of the existing file for extension."""
        assert self._temporary is not None
        shutil.copyfile(target, self._temporary)
        self._stage = stage = pxr.Usd.Stage.Open(str(self._temporary))
        worlds = range(self._surface.worlds)
        paths = [[f"/World/world_{world:04d}/{name}/skin" for world in worlds] for name in self._names()]
        wanted = {"fps": self.fps, "fields": self.fields, "color": self.color}
        existing = read_existing(target, stage, sim, self._surface, paths, wanted)
        self._time_codes, self._bounding_box = list(existing.codes), existing.box
        self._surface.offsets = existing.offsets
        self._field_ranges = {name: existing.ranges[name] for name in self.fields}
        self._clock.due(existing.time)
        self._meshes: list[list[_MeshPrim]] = []
        for k, of_body in enumerate(paths):
            meshes = [pxr.UsdGeom.Mesh(stage.GetPrimAtPath(path)) for path in of_body]
            moves = [pxr.UsdGeom.Xformable(m.GetPrim().GetParent()).GetOrderedXformOps()[0] for m in meshes]
            pairs = zip(meshes, moves)
            self._meshes.append([_MeshPrim(mesh, move, self.fields, self._normals(k, mesh)) for mesh, move in pairs])
        self._obstacles = ObstaclePrims(stage, self._surface, self._names())
        if not self._obstacles.resume():
            raise OutputError(f"{target}: can't go on with this file: it has other colliders; give another file name")
        self._marks = MarkPrims(sim, stage, self._surface)
        self._marks.resume()
        for name in ("Camera", "Sky", "Sun"):  # authored for all frames at the end
            stage.RemovePrim(f"/World/{name}")

    def _define(self) -> None:
        """Author constant data: transforms, topology, attributes without samples."""
        names = self._names()
        self._meshes = [[] for _ in names]
        for world in range(self._surface.worlds):
            place = pxr.UsdGeom.Xform.Define(self._stage, f"/World/world_{world:04d}")
            origin = pxr.Gf.Vec3d(*map(float, self._surface.offsets[world]))
            place.AddTranslateOp(pxr.UsdGeom.XformOp.PrecisionDouble).Set(origin)
            for k, (body, name, meshes) in enumerate(zip(self._surface.bodies, names, self._meshes, strict=True)):
                xform = pxr.UsdGeom.Xform.Define(self._stage, place.GetPath().AppendChild(name))
                xform.GetPrim().SetDisplayName(body.name)
                mesh = define_mesh(self._stage, xform.GetPath().AppendChild("skin"), body.skin.triangles)
                edges = np.asarray(getattr(body.skin, "edges", np.zeros((0, 2))), dtype=np.int32)
                attribute = mesh.GetPrim().CreateAttribute(EDGES, pxr.Sdf.ValueTypeNames.Int2Array, True)
                attribute.Set(pxr.Vt.Vec2iArray.FromNumpy(np.ascontiguousarray(edges)))
                translate = xform.AddTranslateOp(pxr.UsdGeom.XformOp.PrecisionDouble)
                meshes.append(_MeshPrim(mesh, translate, self.fields, self._normals(k, mesh)))
        self._obstacles = ObstaclePrims(self._stage, self._surface, names)
        self._obstacles.define()
        self._marks.define()
        if self.material:
            bind_material(self._stage, [prim.mesh for meshes in self._meshes for prim in meshes])

    def write(self, sim: Any) -> None:
        time = frame_time(sim)
        if self._clock.due(time):
            self._write_frame(sim, time)

    def _write_frame(self, sim: Any, time: float) -> None:
        code = self._clock.time_code(time)
        try:
            samples = [
                (self._surface.skin_points(sim, body), {n: self._field_values(sim, n, body) for n in self.fields})
                for body in self._surface.bodies
            ]  # evaluate all first: a failed frame must leave nothing in the stage
            poses, marks = self._obstacles.poses(), self._marks.points(sim, [points for points, _ in samples])
            self._time_codes.append(code)
            self._background.call(self._set_frame, code, samples, poses, marks)
        except pxr.Tf.ErrorException as error:
            raise OutputError(f"{self._target}: can't be written ({error_text(error)})") from error

    def _set_frame(self, code: float, samples: list[Any], poses: Any, marks: Any) -> None:
        """Set the values of a frame, in the thread that writes."""
        for meshes, (points, fields) in zip(self._meshes, samples, strict=True):
            for world, mesh in enumerate(meshes):
                values = {name: field[world] for name, field in fields.items()}
                low, high = mesh.write(code, points[world], values)
                offset = self._surface.offsets[world]
                box = self._bounding_box
                self._bounding_box = np.minimum(box[0], low + offset), np.maximum(box[1], high + offset)
            self._unsaved_bytes += points.shape[0] * points.shape[1] * (24 + 4 * len(fields))
        self._obstacles.write(code, poses)
        self._marks.write(code, marks)
        if self._unsaved_bytes > _SAVE_BYTES and self._target.suffix.lower() != ".usda":
            self._save()

    def _field_values(self, sim: Any, name: str, body: Any) -> npt.NDArray[np.float32]:
        values = np.ascontiguousarray(sim.skin_field(name, body), dtype=np.float32)
        finite = values[np.isfinite(values)]
        if finite.size:
            low, high = self._field_ranges[name]
            self._field_ranges[name] = (min(low, float(finite.min())), max(high, float(finite.max())))
        return values

    def _save(self) -> None:
        if not self._stage.GetRootLayer().Save():
            raise OutputError(f"{self._target}: can't be written")
        self._unsaved_bytes = 0

    def close(self, sim: Any) -> None:
        if self._stage is None or self._temporary is None:
            return
        temporary = self._temporary
        try:
            time = frame_time(sim)
            if time > self._clock.last:
                self._write_frame(sim, time)
            self._background.finish()
            self._write_metadata(sim)
            self._save()
            self._stage, self._meshes = None, []
            problems = validate_usd(temporary)
            if problems:
                raise OutputError(f"{self._target}: the stage is not valid: " + "; ".join(problems[:10]))
            os.replace(temporary, self._target)
        except OSError as error:
            raise OutputError(f"{self._target}: can't be written ({error})") from error
        except pxr.Tf.ErrorException as error:
            raise OutputError(f"{self._target}: can't be written ({error_text(error)})") from error
        finally:
            self.abort()
        stale = pxr.Sdf.Layer.Find(str(self._target))
        if stale is not None:
            stale.Reload(True)

    def abort(self) -> None:
        self._background.stop()
        self._stage, self._meshes = None, []
        if self._temporary is not None:
            self._temporary.unlink(missing_ok=True)
            self._temporary = None

    def _write_metadata(self, sim: Any) -> None:
        """Author data known at the end only: time span, colours, camera, lights and customData."""
        stage = self._stage
        if self._time_codes:
            stage.SetStartTimeCode(min(self._time_codes))
            stage.SetEndTimeCode(max(self._time_codes))
        ranges = {name: pair if pair[0] <= pair[1] else (0.0, 0.0) for name, pair in self._field_ranges.items()}
        shown = self.color_range or (ranges[self.color] if self.color else (0.0, 0.0))
        for meshes in self._meshes:
            for mesh in meshes:
                self._unsaved_bytes += mesh.write_colors(self.color, shown)
                if self._unsaved_bytes > _SAVE_BYTES and self._target.suffix.lower() != ".usda":
                    self._save()
        _define_camera(stage, *self._bounding_box, self._surface.up_axis)
        data: dict[str, Any] = {"schema": SCHEMA, "frames": len(self._time_codes), "worlds": self._surface.worlds}
        dt = np.ravel(np.asarray(getattr(sim, "dt", np.nan), dtype=np.float64))
        data["dt"] = float(dt[0]) if dt.size else float("nan")
        data["color"] = self.color or ""
        data["static"] = is_static(sim)
        data["colorRange"] = _vec2d(shown)
        data["fields"] = {
            name: dict(zip(("title", "units"), field_label(sim, name))) | {"range": _vec2d(ranges[name])}
            for name in self.fields
        }
        stage.GetDefaultPrim().SetCustomDataByKey("warpfea", data)
        texts = {name: str(value) for name, value in self.layer_data.items()}
        told = {"versions": versions(), "units": "SI: m, kg, s, N, Pa, J"} | texts
        stage.GetRootLayer().customLayerData = stage.GetRootLayer().customLayerData | {"warpfea": told}


class _MeshPrim:
    """The varying attributes of one body in one world."""

    def __init__(self, mesh: Any, translate: Any, fields: Sequence[str], normals: MeshNormals) -> None:
        self.mesh, self.translate, self.points = mesh, translate, mesh.CreatePointsAttr()
        self.normals, self.extent = normals, mesh.CreateExtentAttr()
        self.color = mesh.CreateDisplayColorPrimvar(pxr.UsdGeom.Tokens.vertex)
        api = pxr.UsdGeom.PrimvarsAPI(mesh)
        self.fields = {
            name: api.CreatePrimvar(
                pxr.Tf.MakeValidIdentifier(name), pxr.Sdf.ValueTypeNames.FloatArray, pxr.UsdGeom.Tokens.vertex
            )
            for name in fields
        }

    def write(
        self, code: float, points: npt.NDArray[Any], values: dict[str, Any]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """One frame of points (P, 3) and fields (P,); returns the corners of their box in the world."""
        low, high = points.min(axis=0), points.max(axis=0)
        center = 0.5 * (low + high)
        local = np.ascontiguousarray(points - center, dtype=np.float32)
        self.translate.Set(pxr.Gf.Vec3d(*map(float, center)), code)
        self.points.Set(pxr.Vt.Vec3fArray.FromNumpy(local), code)
        self.normals.write(local.astype(np.float64), code)
        extent = np.stack([local.min(axis=0), local.max(axis=0)])
        self.extent.Set(pxr.Vt.Vec3fArray.FromNumpy(extent), code)
        for name, primvar in self.fields.items():
            primvar.Set(pxr.Vt.FloatArray.FromNumpy(np.ascontiguousarray(values[name])), code)
        return low, high

    def write_colors(self, name: str | None, shown: tuple[float, float]) -> int:
        """Display colours (linear light) of every frame from the field's samples; returns the bytes set."""
        if name is None:
            self.color.SetInterpolation(pxr.UsdGeom.Tokens.constant)
            self.color.Set(pxr.Vt.Vec3fArray([pxr.Gf.Vec3f(*_BODY_COLOR)]))
            return 12
        size = 0
        for code in self.fields[name].GetTimeSamples():
            colors = map_colors(np.asarray(self.fields[name].Get(code)), *shown, linear=True)
            self.color.Set(pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(colors)), code)
            size += colors.nbytes
        return size


def _vec2d(pair: tuple[float, float]) -> Any:
    return pxr.Gf.Vec2d(float(pair[0]), float(pair[1]))


def _define_camera(stage: Any, low: npt.NDArray[np.float64], high: npt.NDArray[np.float64], up_axis: str) -> None:
    """A camera that frames the box (m) from the front right above, a sky and a sun."""
    if not np.isfinite(low).all():
        low, high = -np.ones(3), np.ones(3)
    center, radius = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-6)
    up = pxr.Gf.Vec3d(0, 0, 1) if up_axis == "Z" else pxr.Gf.Vec3d(0, 1, 0)

    def direction(azimuth: float, elevation: float) -> npt.NDArray[np.float64]:
        a, e = np.radians([azimuth, elevation])
        x, y, z = np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)
        return np.array([x, y, z] if up_axis == "Z" else [x, z, -y])

    def look_from(xform: Any, eye: npt.NDArray[np.float64]) -> None:
        view = pxr.Gf.Matrix4d().SetLookAt(pxr.Gf.Vec3d(*map(float, eye)), pxr.Gf.Vec3d(*map(float, center)), up)
        xform.AddTransformOp().Set(view.GetInverse())

    camera = pxr.UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.CreateFocalLengthAttr(50.0)
    camera.CreateHorizontalApertureAttr(36.0)
    camera.CreateVerticalApertureAttr(20.25)
    distance = 1.05 * radius / np.sin(np.arctan(0.5 * 20.25 / 50.0))
    look_from(camera, center + distance * direction(-65.0, 20.0))
    camera.CreateClippingRangeAttr(pxr.Gf.Vec2f(float(1e-3 * distance), float(1e3 * distance)))
    sun = pxr.UsdLux.DistantLight.Define(stage, "/World/Sun")
    look_from(sun, center + radius * direction(-110.0, 50.0))
    sun.CreateIntensityAttr(2.0)
    sun.CreateNormalizeAttr(True)
    sun.CreateAngleAttr(2.0)
    pxr.UsdLux.DomeLight.Define(stage, "/World/Sky").CreateIntensityAttr(0.5)
