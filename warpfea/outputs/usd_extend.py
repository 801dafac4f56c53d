"""Consistency check and contents of an existing USD stage to be extended."""

import pathlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OutputError
from ..base.lazy import pxr
from .frames import DrawnSurface, frame_time, is_static

__all__ = ["ExistingStage", "read_existing"]

CONTINUITY_TOL = 1e-4
"""Largest distance of the last frame from the current state, over the size of the drawn surface."""


@dataclass(frozen=True, eq=False)
class ExistingStage:
    """Contents of a stage of :class:`warpfea.USDWriter`.

    Attributes:
        codes: time codes of its frames.
        time: of the last frame, s.
        ranges: extremes of each field, SI units.
        box: lowest and highest corner of all frames, (3,) each, m.
        offsets: (worlds, 3) origins of the worlds on the grid, m.
    """

    codes: list[float]
    time: float
    ranges: dict[str, tuple[float, float]]
    box: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]
    offsets: npt.NDArray[np.float64]


def read_existing(
    target: pathlib.Path, stage: Any, sim: Any, surface: DrawnSurface, paths: list[list[str]], wanted: dict[str, Any]
) -> ExistingStage:
    """Contents of a stage extended by the run of `sim`.

    Args:
        target: its file, for messages.
        surface: drawn surface of the simulation.
        paths: prims of the bodies' meshes, [body][world].
        wanted: "fps", "fields" and "color" of the writer.

    Raises:
        OutputError: another writer, scene or setting, another end time than the simulation's, or another motion.
    """
    root = stage.GetDefaultPrim()
    about = root.GetCustomDataByKey("warpfea") if root else None
    if not about:
        raise _extension_error(target, "it was not written by warpfea")
    has = {
        "number of worlds": (int(about["worlds"]), surface.worlds),
        "frames per second": (float(stage.GetTimeCodesPerSecond()), float(wanted["fps"])),
        "fields": (sorted(about["fields"]), sorted(wanted["fields"])),
        "field in colour": (str(about["color"]), wanted["color"] or ""),
        "up axis": (str(pxr.UsdGeom.GetStageUpAxis(stage)), surface.up_axis),
        "kind": (bool(about.get("static", False)), is_static(sim)),
    }
    for what, (old, new) in has.items():
        if old != new:
            raise _extension_error(target, f"its {what} is {old!r}, of this run {new!r}")
    meshes = [[pxr.UsdGeom.Mesh(stage.GetPrimAtPath(path)) for path in worlds] for worlds in paths]
    _check_faces(target, surface, meshes)
    codes = list(map(float, meshes[0][0].GetPointsAttr().GetTimeSamples()))
    if not codes:
        raise _extension_error(target, "it has no frames")
    time, now = codes[-1] / wanted["fps"], frame_time(sim)
    slack = 1e-6 * max(1.0 / wanted["fps"], abs(now))
    if time > now + slack:
        raise _extension_error(
            target, f"its last frame, t = {time:.6g} s, is later than the checkpoint, t = {now:.6g} s"
        )
    if time < now - slack - 1.001 / wanted["fps"]:
        raise _extension_error(
            target, f"it ends at t = {time:.6g} s, and the run is resumed at t = {now:.6g} s: frames are missing"
        )
    offsets = np.array([_translation(mesh.GetPrim().GetParent().GetParent()) for mesh in meshes[0]])
    box = _bounding_box(meshes, codes, offsets)
    if abs(time - now) <= slack:
        _check_frame(target, sim, surface, meshes, codes[-1], CONTINUITY_TOL * float(np.linalg.norm(box[1] - box[0])))
    ranges = {name: (float(field["range"][0]), float(field["range"][1])) for name, field in about["fields"].items()}
    return ExistingStage(codes, time, ranges, box, offsets)


def _check_faces(target: pathlib.Path, surface: DrawnSurface, meshes: list[list[Any]]) -> None:
    """OutputError for meshes of the stage other than the drawn ones."""
    for body, worlds in zip(surface.bodies, meshes, strict=True):
        for mesh in worlds:
            faces = np.asarray(mesh.GetFaceVertexIndicesAttr().Get() if mesh else ()).reshape(-1)
            if not np.array_equal(faces, np.asarray(body.skin.triangles).ravel()):
                raise _extension_error(target, f"body {body.name!r} is not in it, or has another mesh")


def _check_frame(
    target: pathlib.Path, sim: Any, surface: DrawnSurface, meshes: list[list[Any]], code: float, bound: float
) -> None:
    """OutputError for a point of the frame at a time code farther than `bound`, m, from the simulation's."""
    for body, worlds in zip(surface.bodies, meshes, strict=True):
        points = surface.skin_points(sim, body)
        for world, mesh in enumerate(worlds):
            center = _translation(mesh.GetPrim().GetParent(), code)
            drawn = np.asarray(mesh.GetPointsAttr().Get(code), dtype=float) + center
            if np.abs(drawn - points[world]).max() > bound:
                raise _extension_error(target, f"its last frame shows body {body.name!r} elsewhere than the checkpoint")


def _extension_error(target: pathlib.Path, reason: str) -> OutputError:
    return OutputError(f"{target}: can't go on with this file: {reason}; give another file name")


def _translation(prim: Any, *code: float) -> npt.NDArray[np.float64]:
    """Translation of a prim, (3,) m, at a time code: the parent of a mesh is at the body's centre in its world, that
    of the body at the origin of the world on the grid."""
    (op,) = pxr.UsdGeom.Xformable(prim).GetOrderedXformOps()
    return np.asarray(op.Get(*code), dtype=float)


def _bounding_box(
    meshes: list[list[Any]], codes: list[float], offsets: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Corners of the box of all frames, m."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for worlds in meshes:
        for world, mesh in enumerate(worlds):
            for code in codes:
                center = _translation(mesh.GetPrim().GetParent(), code)
                extent = np.asarray(mesh.GetExtentAttr().Get(code), dtype=float) + center + offsets[world]
                low, high = np.minimum(low, extent[0]), np.maximum(high, extent[1])
    return low, high
