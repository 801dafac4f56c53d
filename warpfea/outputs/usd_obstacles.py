"""Colliders in a USD stage: constant meshes moved by a parent transform."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.lazy import pxr
from .colormap import to_linear
from .normals import vertex_normals
from .obstacles import OBSTACLE_COLOR, unique_names

if TYPE_CHECKING:
    from .frames import DrawnSurface

__all__ = ["EDGES", "ObstaclePrims", "define_mesh"]

COLLIDER_KEY = "warpfea:collider"
EDGES = "warpfea:edges"
"""Attribute of a body's mesh: pairs of points along edges of elements."""


def define_mesh(stage: Any, path: Any, triangles: np.ndarray) -> Any:
    """A mesh of triangles (T, 3) with a normal at each vertex."""
    mesh = pxr.UsdGeom.Mesh.Define(stage, path)
    mesh.CreateFaceVertexCountsAttr(pxr.Vt.IntArray(len(triangles), 3))
    mesh.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles, dtype=np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)
    mesh.CreateOrientationAttr(pxr.UsdGeom.Tokens.rightHanded)
    mesh.SetNormalsInterpolation(pxr.UsdGeom.Tokens.vertex)
    return mesh


class ObstaclePrims:
    """The prims of the obstacles of a simulation.

    Args:
        stage: the written stage.
        surface: drawn surface of the simulation.
        bodies: names of the bodies' prims.
    """

    def __init__(self, stage: Any, surface: DrawnSurface, bodies: Sequence[str]) -> None:
        self.stage, self.surface, self.obstacles = stage, surface, surface.obstacles
        self.names = unique_names(
            bodies, [pxr.Tf.MakeValidIdentifier(obstacle.name) for obstacle in self.obstacles.all]
        )
        self._transform_ops: list[list[tuple[Any, Any]]] = []

    def _prim_path(self, world: int, name: str) -> str:
        return f"/World/world_{world:04d}/{name}"

    def define(self) -> None:
        """Author meshes, and the transforms of fixed obstacles."""
        for obstacle, name in zip(self.obstacles.all, self.names):
            ops = []
            for world in range(self.surface.worlds):
                xform = pxr.UsdGeom.Xform.Define(self.stage, self._prim_path(world, name))
                xform.GetPrim().SetDisplayName(obstacle.name)
                double = pxr.UsdGeom.XformOp.PrecisionDouble
                ops.append((xform.AddTranslateOp(double), xform.AddOrientOp(double)))
                self._define_mesh(obstacle, world, self._prim_path(world, name) + "/shape")
            self._transform_ops.append(ops)
        if self.obstacles.all:
            self._set_transforms(lambda obstacle: not obstacle.moves, self.obstacles.poses())

    def _define_mesh(self, obstacle: Any, world: int, path: str) -> None:
        points = np.asarray(obstacle.points[world], dtype=np.float32)
        mesh = define_mesh(self.stage, path, obstacle.triangles)
        mesh.GetPrim().SetCustomDataByKey(COLLIDER_KEY, obstacle.kind)
        mesh.CreatePointsAttr(pxr.Vt.Vec3fArray.FromNumpy(points))
        mesh.CreateNormalsAttr(pxr.Vt.Vec3fArray.FromNumpy(vertex_normals(points.astype(float), obstacle.triangles)))
        mesh.CreateExtentAttr(pxr.Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
        grey = pxr.Gf.Vec3f(*map(float, to_linear(OBSTACLE_COLOR)))
        mesh.CreateDisplayColorPrimvar(pxr.UsdGeom.Tokens.constant).Set(pxr.Vt.Vec3fArray([grey]))

    def resume(self) -> bool:
        """Find the prims in an extended stage; False if it has others."""
        there = {
            str(prim.GetParent().GetPath()) for prim in self.stage.Traverse() if prim.GetCustomDataByKey(COLLIDER_KEY)
        }
        worlds = range(self.surface.worlds)
        if there != {self._prim_path(world, name) for name in self.names for world in worlds}:
            return False
        for name in self.names:
            prims = [self.stage.GetPrimAtPath(self._prim_path(world, name)) for world in worlds]
            ops = [pxr.UsdGeom.Xformable(prim).GetOrderedXformOps() for prim in prims]
            self._transform_ops.append([(pair[0], pair[1]) for pair in ops])
        return True

    def poses(self) -> Any:
        """Current positions and rotations; None where no obstacle moves."""
        return self.obstacles.poses() if any(obstacle.moves for obstacle in self.obstacles.all) else None

    def write(self, code: float, poses: Any) -> None:
        """Transforms of moving obstacles at their `poses`."""
        if poses is not None:
            self._set_transforms(lambda obstacle: obstacle.moves, poses, code)

    def _set_transforms(self, chosen: Any, poses: Any, *code: float) -> None:
        position, rotation = poses
        for k, obstacle in enumerate(self.obstacles.all):
            for world, (translate, orient) in enumerate(self._transform_ops[k] if chosen(obstacle) else ()):
                translate.Set(pxr.Gf.Vec3d(*map(float, position[world, k])), *code)
                # rows are the images of the axes
                quaternion = pxr.Gf.Matrix3d(*map(float, rotation[world, k].T.ravel())).ExtractRotation().GetQuat()
                orient.Set(pxr.Gf.Quatd(quaternion), *code)
