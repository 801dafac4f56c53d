"""Scene of a mesh file with materials, supports and loads from the command line."""

import argparse
import inspect
import math
import pathlib
import re
import sys
from collections.abc import Callable
from typing import Any

from .. import materials
from .. import mesh as meshes
from ..base.checks import finite_number, number_hint
from ..base.errors import Error, UsageError
from ..base.names import did_you_mean
from ..builder.builder import ModelBuilder
from ..builder.scene import Scene, scene
from .arguments import existing_file, number_tuple
from .parser import MATERIAL_HINT

__all__ = ["MESH_OPTIONS", "SURFACE_FORMATS", "mesh_facts", "mesh_scene", "parse_material", "read_mesh"]

MESH_OPTIONS = ("material", "clamp", "traction", "pressure", "gravity", "scale", "size", "up_axis", "quadrature")
SURFACE_FORMATS = (".stl", ".obj", ".ply")
"""Files of surfaces whose inside is meshed."""
LAW_CLASSES: dict[str, type[materials.Material]] = {
    "svk": materials.SVK,
    "mooney_rivlin": materials.MooneyRivlin,
    "neo_hookean": materials.NeoHookean,
}
DAMPING_PARAMETERS = ("eta", "lambda_v", "form")


def mesh_scene(options: argparse.Namespace) -> tuple[Scene[Any], dict[str, Any]]:
    """Scene of a mesh file, and the parameters of its summary. UsageError, ModelError, MeshError."""
    path = existing_file(options.what)
    if options.set:
        raise UsageError(f"--set {options.set[0]}: a mesh file has no parameters; --set is for scenes")
    laws = [parse_material(text) for text in options.material]
    tractions = [_parse_load(text, "--traction", 3) for text in options.traction]
    pressures = [_parse_load(text, "--pressure", 1) for text in options.pressure]
    up = options.up_axis or "Z"
    gravity = options.gravity or ((0.0, 0.0, -9.81) if up == "Z" else (0.0, -9.81, 0.0))

    def build() -> ModelBuilder:
        mesh = read_mesh(path, options)
        b = ModelBuilder(gravity=gravity, up_axis=up)
        body = b.add_solid(mesh, material=_materials(path, mesh, laws), quadrature=options.quadrature)
        for group in options.clamp:
            b.clamp(body.nodes(group))
        if not options.clamp and any(gravity) and not getattr(options, "static", False):
            print(f"warpfea: warning: no --clamp: body {body.name!r} falls freely", file=sys.stderr)
        for group, value in tractions:
            b.add_traction(body.surface(group), value)
        for group, value in pressures:
            b.add_pressure(body.surface(group), value[0])
        for group in dict.fromkeys(group for group, _ in tractions + pressures):
            b.add_probe(group, body.surface(group))
        if not tractions + pressures:
            b.add_probe("all", body.nodes(body.mesh.used_nodes))
        return b

    build.__name__ = path.stem
    build.__doc__ = f"The mesh {path.name}."
    parameters = {
        name: getattr(options, name) for name in MESH_OPTIONS if name not in ("gravity", "up_axis", "scale", "size")
    }
    parameters |= {"gravity": list(gravity), "up_axis": up, "scale": options.scale or 1.0}
    parameters |= {"size": options.size} if options.size else {}
    return scene(dt=1e-3, t_end=0.5, speed=0.2)(build), parameters


def read_mesh(path: pathlib.Path, options: argparse.Namespace) -> meshes.Mesh:
    """The mesh of a file, of the inside of a surface, or of a shape. MeshError."""
    scale = options.scale or 1.0
    if path.suffix.lower() in SURFACE_FORMATS:
        return meshes.from_surface(path, size=options.size, scale=scale)
    if path.suffix.lower() in meshes.CAD_FORMATS:
        return meshes.from_cad(path, size=options.size, scale=scale)
    if options.size:
        raise UsageError(f"--size {options.size:g}: {path} is a mesh already; --size is for surfaces and shapes")
    return meshes.read(path, scale=scale)


def mesh_facts(mesh: meshes.Mesh) -> dict[str, Any]:
    """Contents of a mesh: counts, box (m), volume (m^3; area of quads, m^2), and the size of each group."""
    low, high = mesh.bounding_box()
    return {
        "cells": mesh.cell_type,
        "elements": len(mesh.cells),
        "nodes": len(mesh.used_nodes),
        "bounding_box": [low.tolist(), high.tolist()],
        "volume": mesh.volume(),
        "element_groups": {name: len(ids) for name, ids in sorted(mesh.element_sets.items())},
        "surface_groups": {name: len(rows) for name, rows in sorted(mesh.surface_sets.items())},
        "node_groups": {name: len(ids) for name, ids in sorted(mesh.node_sets.items())},
    }


def _parse_load(text: str, option: str, size: int) -> tuple[str, tuple[float, ...]]:
    """Group and values of `GROUP:values`."""
    group, colon, values = text.rpartition(":")
    if not (colon and group):
        raise UsageError(f"{option} {text}: expected GROUP:{'x,y,z' if size == 3 else 'p'}")
    try:
        return group, number_tuple(values, size)
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"{option} {text}: {error}") from None


def _materials(path: pathlib.Path, mesh: Any, laws: list[tuple[str, materials.Material]]) -> Any:
    """One law, or laws by group; UsageError that lists the groups if there is none."""
    groups = ", ".join(f"{name} ({len(ids)} elements)" for name, ids in mesh.element_sets.items())
    if not groups:
        surfaces = f" (its surface groups: {', '.join(mesh.surface_sets)})" if mesh.surface_sets else ""
        groups = f"none{surfaces}: the whole mesh takes one LAW:..., or name the volume in Gmsh, "
        groups += 'Physical Volume("body") = {1};'
    if not laws:
        raise UsageError(
            f"{path}: no material; give --material LAW:..., {MATERIAL_HINT}, for the whole mesh, or "
            f"GROUP=LAW:... for each group; element groups found: {groups}"
        )
    whole = [law for group, law in laws if not group]
    if whole and len(laws) > 1:
        raise UsageError("--material: give one law for the whole mesh, or GROUP=LAW:... for each group, not both")
    names = [group for group, _ in laws]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise UsageError(f"--material: group {twice[0]!r} is given twice")
    return whole[0] if whole else dict(laws)


def parse_material(text: str) -> tuple[str, materials.Material]:
    """Group ("" for the whole mesh) and law of `[GROUP=]LAW:NAME=VALUE,...`. UsageError names the error."""
    where = f"--material {text}"
    head, colon, tail = text.partition(":")
    group, _, name = head.rpartition("=")
    if not colon or name not in LAW_CLASSES:
        hint = did_you_mean(name, LAW_CLASSES)
        raise UsageError(
            f"{where}: expected [GROUP=]LAW:NAME=VALUE,... with LAW one of {', '.join(LAW_CLASSES)}, such as "
            f"svk:E=2.1e11,nu=0.3,density=7850{hint}"
        )
    values: dict[str, Any] = {}
    for item in tail.split(","):
        match = re.fullmatch(r"\s*(\w+)\s*=\s*(\S+)\s*", item)
        if not match:
            raise UsageError(f"{where}: {item!r} is not NAME=VALUE")
        key, value = match.groups()
        if key in values:
            raise UsageError(f"{where}: {key} is given twice")
        values[key] = value if key == "form" else _parse_number(where, key, value)
    damping = {key: values.pop(key) for key in DAMPING_PARAMETERS if key in values}
    make = _law_constructor(where, LAW_CLASSES[name], values)
    if damping and "eta" not in damping:
        raise UsageError(f"{where}: damping needs eta=")
    try:
        return group, make(**values, damping=materials.KelvinVoigt(**damping) if damping else None)
    except Error as error:
        raise UsageError(f"{where}: {error}") from None


def _parse_number(where: str, key: str, text: str) -> float:
    value = finite_number(text)
    if math.isnan(value):
        hint = "; commas stand between the values" if ";" in text else number_hint(text)
        raise UsageError(f"{where}: {key} = {text!r} is not a finite number{hint}")
    return value


def _law_constructor(where: str, law: Any, values: dict[str, Any]) -> Callable[..., materials.Material]:
    """Constructor for these names: the law's own, or from_E_nu."""
    makers = [law, law.from_E_nu]
    wanted: list[str] = []
    known = [*DAMPING_PARAMETERS]
    for make in makers:
        names = [n for n in inspect.signature(make).parameters if n != "damping"]
        needed = [n for n in names if n not in ("ratio", "density")]  # a missing density is reported by the model
        if set(values) <= set(names) and set(needed) <= set(values):
            return make  # type: ignore[no-any-return]
        wanted.append(", ".join([*needed, "density"]))
        known += names
    odd = [name for name in values if name not in known]
    hint = did_you_mean(odd[0], known) if odd else ""
    raise UsageError(
        f"{where}: the law takes {' or '.join(dict.fromkeys(wanted))}; given are {', '.join(values)}{hint}"
    )
