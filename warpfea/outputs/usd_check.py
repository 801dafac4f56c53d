"""Validation of USD files: USD's own validators, and additional checks."""

import os
import re
from typing import Any

import numpy as np

from ..base.lazy import pxr

__all__ = ["error_text", "validate_usd"]


def error_text(error: Exception) -> str:
    """USD error text without source locations."""
    texts = re.findall(r" : '(.*)'\s*$", str(error), re.MULTILINE)
    if texts and texts[0].startswith("Cannot determine file format"):
        return "it is no USD file"
    return texts[0] if texts else "USD gives no reason"


def validate_usd(path: str | os.PathLike[str], max_samples: int = 64) -> list[str]:
    """Problems of a USD file, none for a valid one: all of USD's validators, and additional checks.

    Additional checks: units, up axis, default prim; per mesh face indices in range, and at up to `max_samples`
    of its times (evenly spread, first and last included) finite points, unit normals, extents that hold the
    points, and counts of normals and primvars. No message of a validator is filtered out.
    """
    try:
        stage = pxr.Usd.Stage.Open(str(path))
    except pxr.Tf.ErrorException as error:
        return [f"{path}: can't be opened ({error_text(error)})"]
    validators = pxr.UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    problems = [
        f"{error.GetName()}: {error.GetMessage()}"
        for error in pxr.UsdValidation.ValidationContext(validators).Validate(stage)
    ]
    if not pxr.UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        problems.append("metersPerUnit is missing")
    if not pxr.UsdPhysics.StageHasAuthoredKilogramsPerUnit(stage):
        problems.append("kilogramsPerUnit is missing")
    if not stage.HasAuthoredMetadata(pxr.UsdGeom.Tokens.upAxis):
        problems.append("upAxis is missing")
    if not stage.GetDefaultPrim():
        problems.append("defaultPrim is missing")
    for prim in stage.Traverse():
        if prim.IsA(pxr.UsdGeom.Mesh):
            problems += [f"{prim.GetPath()}: {text}" for text in _mesh_problems(stage, prim, max_samples)]
    return problems


def _mesh_problems(stage: Any, prim: Any, max_samples: int) -> list[str]:
    mesh = pxr.UsdGeom.Mesh(prim)
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get() or (), dtype=np.int64)
    indices = np.asarray(mesh.GetFaceVertexIndicesAttr().Get() or (), dtype=np.int64)
    problems = []
    if counts.sum() != len(indices) or (counts < 3).any():
        problems.append("face counts and indices do not match")
    primvars = {
        p.GetPrimvarName(): p
        for p in pxr.UsdGeom.PrimvarsAPI(mesh).GetPrimvars()
        if p.GetInterpolation() == pxr.UsdGeom.Tokens.vertex and p.HasValue()
    }
    corners = pxr.UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")  # of faces' corners, where edges are sharp
    groups = np.asarray(corners.GetIndices() if corners else (), dtype=np.int64)
    codes = np.asarray(mesh.GetPointsAttr().GetTimeSamples() or (0.0,))
    if len(codes) > 1 and not (stage.GetStartTimeCode() <= codes[0] and codes[-1] <= stage.GetEndTimeCode()):
        problems.append("samples lie outside the stage's time span")
    chosen = np.unique(np.round(np.linspace(0, len(codes) - 1, min(len(codes), max_samples))).astype(int))
    for code in map(float, codes[chosen]):
        points = np.asarray(mesh.GetPointsAttr().Get(code) or (), dtype=np.float64).reshape(-1, 3)
        at = f"at time code {code:g}"
        if not np.isfinite(points).all():
            problems.append(f"points are not finite {at}")
        if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
            problems.append(f"face indices out of range {at}: {len(points)} points")
        source = corners if corners else mesh.GetNormalsAttr()
        normals = np.asarray(source.Get(code) or (), dtype=np.float64).reshape(-1, 3)
        wanted = 1 + int(groups.max(initial=-1)) if corners else len(points)
        if len(normals) != wanted or (corners and len(groups) != len(indices)):
            problems.append(f"{len(normals)} normals for {wanted} {'groups' if corners else 'points'} {at}")
        elif np.abs(np.linalg.norm(normals, axis=1) - 1.0).max(initial=0.0) > 1e-5:
            problems.append(f"normals are not of length one {at}")
        extent = np.asarray(mesh.GetExtentAttr().Get(code) or (), dtype=np.float64)
        inside = extent.shape == (2, 3) and bool(((points >= extent[0]) & (points <= extent[1])).all())
        if not inside:
            problems.append(f"the extent does not hold the points {at}")
        for name, primvar in primvars.items():
            size = len(primvar.Get(code) or ())
            if size != len(points):
                problems.append(f"primvar {name} has {size} values for {len(points)} points {at}")
        if problems:
            break
    return problems
