"""Normals of a mesh in a USD stage: of vertices, or of the corners of faces where edges are sharp."""

from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.lazy import pxr
from .normals import CornerNormals

__all__ = ["MeshNormals"]

Array = npt.NDArray[Any]
NAME = "normals"


class MeshNormals:
    """Normals of one mesh over time.

    Without sharp edges the attribute `normals` of vertices; with them the primvar `normals`, face-varying, whose
    indices are the groups of corners that share a normal. A mesh of an extended stage keeps its own.

    Args:
        count: number of points. groups: of corners that share a normal at rest, see `smooth_corners`.
    """

    def __init__(self, mesh: Any, triangles: Array, count: int, groups: tuple[Array, int]) -> None:
        self.attribute, self.primvar = None, pxr.UsdGeom.PrimvarsAPI(mesh).GetPrimvar(NAME)
        if self.primvar and self.primvar.IsIndexed():
            self.group = np.asarray(self.primvar.GetIndices(), dtype=np.int64)
        elif mesh.GetNormalsAttr().HasAuthoredValue():
            self.group, self.attribute = np.ravel(triangles), mesh.GetNormalsAttr()
        else:
            self.group = groups[0]
            if groups[1] == count:
                self.group, self.attribute = np.ravel(triangles), mesh.CreateNormalsAttr()
            else:
                kind = pxr.Sdf.ValueTypeNames.Normal3fArray
                api = pxr.UsdGeom.PrimvarsAPI(mesh)
                self.primvar = api.CreatePrimvar(NAME, kind, pxr.UsdGeom.Tokens.faceVarying)
                self.primvar.SetIndices(pxr.Vt.IntArray.FromNumpy(self.group.astype(np.int32)))
        size = count if self.attribute is not None else int(self.group.max()) + 1
        self.normals = CornerNormals(triangles, self.group, size)

    def write(self, points: Array, code: float) -> None:
        """One frame of points (P, 3), float64."""
        target = self.primvar if self.attribute is None else self.attribute
        target.Set(pxr.Vt.Vec3fArray.FromNumpy(self.normals.at(points)), code)
