"""The page of a USD file written by `USDWriter`: its bodies, colliders and fields; it holds no records, and of
marks their places."""

from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.lazy import pxr
from .html import MAX_WORLDS
from .markers import group_marks
from .page import Page, PageSurface
from .usd_marks import read_kinds
from .usd_obstacles import EDGES

__all__ = ["usd_page"]

Array = npt.NDArray[Any]


def usd_page(
    source: Any, field: str | None, view: tuple[float, float], color_range: tuple[float, float] | None, max_frames: int
) -> Page:
    """Page of an open stage (`render._StageReader`). ModelError for a field that it lacks."""
    name, told = source.field_name(field), source.metadata
    codes = sorted({code for mesh in source.meshes for code in mesh.GetPointsAttr().GetTimeSamples()})
    codes = [
        codes[k] for k in np.unique(np.linspace(0, len(codes) - 1, min(len(codes), max_frames)).round().astype(int))
    ]
    prims = sorted({str(m.GetPath()).split("/")[2] for m in source.meshes})[:MAX_WORLDS]
    cache = pxr.UsdGeom.XformCache(codes[0])
    places = [cache.GetLocalToWorldTransform(source.stage.GetPrimAtPath(f"/World/{prim}")) for prim in prims]
    offsets = np.array([place.ExtractTranslation() for place in places])
    fields = {key: (entry["title"], entry["units"]) for key, entry in told["fields"].items()}
    if name is not None and color_range is None:
        pair = told["colorRange"] if name == told["color"] else told["fields"][name]["range"]
        color_range = (pair[0], pair[1]) if pair[0] < pair[1] else None
    first = [mesh for mesh in source.meshes if str(mesh.GetPath()).split("/")[2] == prims[0]]
    start = np.concatenate([_points(mesh, cache, codes[0]) for mesh in first]) - offsets[0]
    page = Page(
        source.path.stem, source.path.name, str(pxr.UsdGeom.GetStageUpAxis(source.stage)),
        bool(told.get("static", False)), 0.5 * (start.min(axis=0) + start.max(axis=0)), offsets,
        [int(prim.partition("_")[2]) for prim in prims], fields, name, color_range, view,
        times=[code / source.rate for code in codes],
    )  # fmt: skip
    groups: dict[str, list[Any]] = {}
    for mesh in source.meshes + source.obstacles:
        _, _, world, key, _ = str(mesh.GetPath()).split("/")
        if world in prims:
            groups.setdefault(key, []).append(mesh)
    for meshes in groups.values():
        page.surfaces.append(_surface(meshes, offsets, page.origin, codes, list(fields)))
    marks = source.marks[: len(prims)]
    if marks:
        kinds = read_kinds(marks[:1])
        page.markers = [
            {"kind": kind, "name": "", "surface": len(page.surfaces), "points": points}
            for kind, points in group_marks(kinds)
        ]
        first_points, all_points = _moving(marks, offsets, page.origin, codes)
        page.surfaces.append(PageSurface("marks", "points", first_points, points=all_points))
    page.facts = [("frames", str(len(codes))), ("file", source.path.name)]
    return page


def _surface(meshes: list[Any], offsets: Array, origin: Array, codes: list[float], fields: list[str]) -> PageSurface:
    """One body or collider in all worlds."""
    prim = meshes[0].GetPrim()
    kind = {None: "body", "HalfSpace": "plane"}.get(prim.GetCustomDataByKey("warpfea:collider"), "collider")
    start, frames = _moving(meshes, offsets, origin, codes)
    triangles = np.asarray(meshes[0].GetFaceVertexIndicesAttr().Get(), dtype=np.int32).reshape(-1, 3)
    edges = np.asarray(prim.GetAttribute(EDGES).Get() if prim.HasAttribute(EDGES) else [])
    name = prim.GetParent().GetDisplayName() or prim.GetParent().GetName()
    surface = PageSurface(name, kind, start, triangles, edges if len(edges) else None, points=frames)
    for field in fields if kind == "body" else ():
        key = pxr.Tf.MakeValidIdentifier(field)
        primvars = [pxr.UsdGeom.PrimvarsAPI(mesh).GetPrimvar(key) for mesh in meshes]
        surface.values[field] = [
            np.stack([np.asarray(p.Get(code), dtype=np.float32) for p in primvars]) for code in codes
        ]
    return surface


def _moving(prims: list[Any], offsets: Array, origin: Array, codes: list[float]) -> tuple[Array, list[Array]]:
    """Points (W, P, 3) of the first frame, and of all; one frame if they do not move."""
    frames = []
    for code in codes:
        cache = pxr.UsdGeom.XformCache(code)
        frames.append(np.stack([_points(m, cache, code) - offset - origin for m, offset in zip(prims, offsets)]))
    still = all((points == frames[0]).all() for points in frames)
    return frames[0], frames[:1] if still else frames


def _points(mesh: Any, cache: Any, code: float) -> Array:
    """(P, 3) points of a mesh in the world, m."""
    matrix = np.array(cache.GetLocalToWorldTransform(mesh.GetPrim()))
    return np.asarray(mesh.GetPointsAttr().Get(code), dtype=np.float64) @ matrix[:3, :3] + matrix[3, :3]
