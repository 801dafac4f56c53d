"""Supports, joints, loads and probes in a USD stage: points for pictures and pages, hidden as guides elsewhere."""

from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.lazy import pxr
from .markers import MARKED_WORLDS, Markers

__all__ = ["MarkPrims", "read_kinds", "stage_marks"]

Array = npt.NDArray[Any]
NAME = "marks"
KINDS_KEY = "warpfea:kinds"


class MarkPrims:
    """The points prims of the marks of a simulation, one for each world; none of many worlds."""

    def __init__(self, sim: Any, stage: Any, surface: Any) -> None:
        self.stage, self.markers = stage, Markers(sim, surface.bodies)
        self.worlds = surface.worlds if surface.worlds <= MARKED_WORLDS and self.markers.kinds(1) else 0
        self._prims: list[Any] = []

    def define(self) -> None:
        """Author the prims."""
        for world in range(self.worlds):
            prim = pxr.UsdGeom.Points.Define(self.stage, f"/World/world_{world:04d}/{NAME}")
            prim.CreatePurposeAttr(pxr.UsdGeom.Tokens.guide)
            prim.GetPrim().SetCustomDataByKey(KINDS_KEY, pxr.Vt.StringArray(self.markers.kinds(1)))
            self._prims.append(prim)

    def resume(self) -> None:
        """Find the prims in an extended stage; without them marks are left out."""
        found = [self.stage.GetPrimAtPath(f"/World/world_{world:04d}/{NAME}") for world in range(self.worlds)]
        self._prims = [pxr.UsdGeom.Points(prim) for prim in found] if all(found) else []

    def points(self, sim: Any, drawn: list[Array]) -> Array | None:
        """Points (B, n, 3) of the marks of a frame; `drawn`: points (B, P, 3) of the bodies. None without prims."""
        return self.markers.world_points(drawn, self.markers.points(sim)).astype(np.float32) if self._prims else None

    def write(self, code: float, points: Array | None) -> None:
        """One frame of the points."""
        for prim, rows in zip(self._prims, () if points is None else points):
            prim.GetPointsAttr().Set(pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(rows)), code)
            extent = np.stack([rows.min(axis=0), rows.max(axis=0)])
            prim.CreateExtentAttr().Set(pxr.Vt.Vec3fArray.FromNumpy(extent), code)


def stage_marks(stage: Any) -> list[Any]:
    """Points prims of marks of an open stage, by world."""
    prims = [prim for prim in stage.Traverse() if prim.IsA(pxr.UsdGeom.Points)]
    return [pxr.UsdGeom.Points(prim) for prim in prims if prim.GetCustomDataByKey(KINDS_KEY)]


def read_kinds(marks: list[Any]) -> list[str]:
    """Kinds of the points of prims of marks."""
    return [str(kind) for mark in marks for kind in mark.GetPrim().GetCustomDataByKey(KINDS_KEY)]
