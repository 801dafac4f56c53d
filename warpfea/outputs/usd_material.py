"""One UsdPreviewSurface of a stage that reads the display colour, for renderers that show materials alone."""

from typing import Any

from ..base.lazy import pxr

__all__ = ["bind_material"]

PATH = "/World/Looks/field"
ROUGHNESS = 0.45


def bind_material(stage: Any, meshes: list[Any]) -> None:
    """Author the material and bind it to meshes of bodies."""
    pxr.UsdGeom.Scope.Define(stage, PATH.rpartition("/")[0])
    material = pxr.UsdShade.Material.Define(stage, PATH)
    reader = pxr.UsdShade.Shader.Define(stage, f"{PATH}/color")
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", pxr.Sdf.ValueTypeNames.String).Set("displayColor")
    reader.CreateInput("fallback", pxr.Sdf.ValueTypeNames.Float3).Set(pxr.Gf.Vec3f(0.5, 0.5, 0.5))
    surface = pxr.UsdShade.Shader.Define(stage, f"{PATH}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("diffuseColor", pxr.Sdf.ValueTypeNames.Color3f).ConnectToSource(
        reader.CreateOutput("result", pxr.Sdf.ValueTypeNames.Float3)
    )
    surface.CreateInput("roughness", pxr.Sdf.ValueTypeNames.Float).Set(ROUGHNESS)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", pxr.Sdf.ValueTypeNames.Token))
    for mesh in meshes:
        pxr.UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
