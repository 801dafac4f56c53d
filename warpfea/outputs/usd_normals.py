"""Normals of a mesh in a USD stage: of vertices, or of the corners of faces where edges are sharp."""

from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.lazy import pxr
from .normals import scatter_rows, unit_rows, vertex_normals

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
        self.triangles = np.asarray(triangles, dtype=np.int64)
        self.attribute, self.primvar = None, pxr.UsdGeom.PrimvarsAPI(mesh).GetPrimvar(NAME)
        if self.primvar and self.primvar.IsIndexed():
            self.group = np.asarray(self.primvar.GetIndices(), dtype=np.int64)
        elif mesh.GetNormalsAttr().HasAuthoredValue():
            self.group, self.attribute = np.zeros(0, dtype=np.int64), mesh.GetNormalsAttr()
        else:
            self.group = groups[0]
            if groups[1] == count:
                self.attribute = mesh.CreateNormalsAttr()
            else:
                kind = pxr.Sdf.ValueTypeNames.Normal3fArray
                api = pxr.UsdGeom.PrimvarsAPI(mesh)
                self.primvar = api.CreatePrimvar(NAME, kind, pxr.UsdGeom.Tokens.faceVarying)
                self.primvar.SetIndices(pxr.Vt.IntArray.FromNumpy(self.group.astype(np.int32)))

    def write(self, points: Array, code: float) -> None:
        """One frame of points (P, 3), float64."""
        if self.attribute is not None:
            self.attribute.Set(pxr.Vt.Vec3fArray.FromNumpy(vertex_normals(points, self.triangles)), code)
            return
        corner = points[self.triangles]
        area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        rows = scatter_rows(self.group, np.repeat(area, 3, axis=0), int(self.group.max()) + 1)
        self.primvar.Set(pxr.Vt.Vec3fArray.FromNumpy(unit_rows(rows)), code)
