"""`warpfea scenes`, `info` and `render`."""

import argparse
import pathlib
import sys
from typing import Any

from ..base.console import format_bytes, format_number, format_table, quiet_warp, to_json, write_json
from ..base.errors import UsageError
from ..builder.scene import Scene, find, names
from . import DONE
from .arguments import existing_file
from .mesh_scene import mesh_facts, read_mesh
from .parser import MATERIAL_HINT
from .run import check_targets
from .source import find_scene, is_mesh, load_scenes, resolve, show_progress
from .summary import MAX_ROWS, box_text, mass_text, model_box

__all__ = ["info", "render", "scenes"]


def scenes(options: argparse.Namespace) -> int:
    """Run `warpfea scenes [SCENE]`."""
    what = options.what
    if what is None:
        found = [find(name) for name in names()]
    elif what.endswith(".py"):
        found = list(load_scenes(what).values())
    else:
        print(_scene_text(find_scene(what)))
        return DONE
    rows = [["scene", "dt", "t_end", ""]]
    rows += [[s.name, f"{format_number(s.dt, 3)} s", f"{format_number(s.t_end, 3)} s", s.description] for s in found]
    print(format_table(rows))
    if not options.quiet:
        where = f"{what}:NAME" if what else "NAME"
        print(f"\nwarpfea scenes {where} shows its parameters, warpfea run {where} runs it.")
    return DONE


def _scene_text(found: Scene[Any]) -> str:
    """Description and parameters of a scene."""
    parts = [found.description]
    if found.details:
        parts.append(found.details)
    tol = f", tol = {format_number(found.tol)}" if found.tol else ""
    parts.append(f"dt = {format_number(found.dt)} s, t_end = {format_number(found.t_end)} s, {found.integrator}{tol}")
    rows = []
    for p in found.parameters.values():
        default = "(required)" if p.required else f"= {p.default}"
        rows.append([f"--set {p.name}", default, p.kind_name, p.doc])
    parts.append(format_table(rows) if rows else "It has no parameters.")
    return "\n\n".join(parts)


def info(options: argparse.Namespace) -> int:
    """Run `warpfea info SCENE`."""
    check_targets(options)
    if is_mesh(options) and not options.material:
        return _mesh_info(options)
    source = resolve(options)
    with quiet_warp():
        model = source.model()
        sim = source.simulation(model, show_progress(options))
        launcher = sim.stepper.launch
        content = {"scene": source.label, "parameters": source.parameters} | sim.info()
        content |= {"bounding_box": model_box(model)}
        if is_mesh(options):
            content["mesh"] = mesh_facts(model.bodies[0].mesh)
        content["bytes"] = sim.bytes()
        content["bytes_per_unknown"] = sum(sim.bytes().values()) / max(content["unknowns"], 1)
        content["kernels"] = sorted(launcher.kernels)
        content["modules"] = sorted(launcher.modules)
        content["launches"] = launcher.launches
    if options.json:
        write_json(options.json, to_json(content))
    if options.json != "-":
        print(_info_table(content))
    return DONE


def _mesh_info(options: argparse.Namespace) -> int:
    """Contents of a mesh file, without a material."""
    facts = mesh_facts(read_mesh(existing_file(options.what), options))
    if options.json:
        write_json(options.json, to_json({"scene": options.what, "mesh": facts}))
    if options.json != "-":
        print(format_table([["mesh", options.what], *_mesh_rows(facts)]))
        if not options.quiet:
            more = f"with --material {MATERIAL_HINT.removeprefix('e.g. ')} also what a simulation of it costs"
            if facts["cells"] == "quad":
                more = "a mesh of a surface is one of a shell; it is simulated from Python, with add_shell"
            print(f"\n{more}")
    return DONE


def _mesh_rows(facts: dict[str, Any]) -> list[list[str]]:
    """Rows for a mesh: counts, size, and its groups."""
    what, unit = ("area", "m^2") if facts["cells"] == "quad" else ("volume", "m^3")
    rows = [
        ["cells", f"{facts['elements']} {facts['cells']}, {facts['nodes']} nodes"],
        ["size", f"{box_text(facts['bounding_box'])}, {what} {format_number(facts['volume'])} {unit}"],
    ]
    items = {"element": "elements", "surface": "faces", "node": "nodes"}
    for kind, counted in items.items():
        groups = [f"{name} ({count} {counted})" for name, count in facts[f"{kind}_groups"].items()]
        lines = [groups[k : k + 6] for k in range(0, len(groups), 6)] or [["none"]]
        rows += [[f"{kind} groups" if k == 0 else "", ", ".join(line)] for k, line in enumerate(lines)]
    return rows


def _info_table(content: dict[str, Any]) -> str:
    c = content
    rows = [["scene", c["scene"]], ["device", f"{c['device']}, {c['dtype']}, {c['integrator']}"]]
    rows += _body_rows(c["bodies"])
    rows += _joint_rows(c["joints"])
    rows += _contact_rows(c["contacts"])
    if "mesh" in c:
        rows += _mesh_rows(c["mesh"])[1:]
    rows.append(["model", f"{c['unknowns']} unknowns, {mass_text(c['mass'])}, {box_text(c['bounding_box'])}"])
    methods = c["methods"]
    details = [f"{name} {value}" for name, value in methods.items() if name != "solver"]
    rows.append(["solver", ", ".join([methods["solver"], *details])])
    plan = {name: value for name, value in c["plan"].items() if name not in {*methods, "dtype", "on_cuda"} and value}
    rows.append(["", ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in plan.items())])
    rows.append(["energy growth", c["energy_growth"]])
    rows.append(["used", ", ".join(c["features"])])
    rows.append(["left out", ", ".join(c["left_out"])])
    groups: dict[str, int] = {}
    for name, count in c["bytes"].items():
        key = name.partition(".")[0]
        groups[key] = groups.get(key, 0) + count
    text = ", ".join(f"{key} {format_bytes(count)}" for key, count in groups.items())
    rows.append(
        ["memory", f"{format_bytes(sum(groups.values()))} ({text}), {c['bytes_per_unknown']:.0f} B per unknown"]
    )
    rows.append(["a step", f"{c['launches']} launches recorded, of {len(c['kernels'])} kernels:"])
    by_module: dict[str, list[str]] = {}
    for name in c["kernels"]:
        module, _, kernel = name.rpartition(".")
        by_module.setdefault(module, []).append(kernel)
    rows += [["", f"{module}: {', '.join(kernels)}"] for module, kernels in by_module.items()]
    return format_table(rows)


def _body_rows(bodies: list[dict[str, Any]]) -> list[list[str]]:
    """A row for each body; one common row for many."""
    texts = {}
    for body in bodies:
        rules, materials = ", ".join(body["quadrature"]), ", ".join(body["materials"])
        what = f"{body['elements']} {body['element']} elements, {rules}, {body['nodes']} nodes, {materials}"
        texts[body["name"]] = what
    if len(bodies) <= MAX_ROWS:
        return [[f"body {name}", what] for name, what in texts.items()]
    names_by_text: dict[str, list[str]] = {}
    for name, what in texts.items():
        names_by_text.setdefault(what, []).append(name)
    return [
        [f"body {names[0]}", what] if len(names) == 1 else [f"{len(names)} bodies", f"{what} each"]
        for what, names in names_by_text.items()
    ]


def _joint_rows(joints: list[dict[str, Any]]) -> list[list[str]]:
    """A row for each joint; many are counted by kind."""
    if len(joints) <= MAX_ROWS:
        return [[f"joint {j['name']}", f"{j['kind']}, {j['rows']} equations, {j['between']}"] for j in joints]
    counts: dict[str, list[int]] = {}
    for j in joints:
        counts.setdefault(j["kind"], []).append(j["rows"])
    return [["joints", ", ".join(f"{len(n)} {kind} ({sum(n)} equations)" for kind, n in counts.items())]]


def _contact_rows(contacts: list[dict[str, Any]]) -> list[list[str]]:
    """A row for each contact; a count for many."""
    if len(contacts) > MAX_ROWS:
        left = sum(c["left_out"] for c in contacts)
        return [["contacts", f"{len(contacts)}, {sum(c['points'] for c in contacts)} points{_left_out_text(left)}"]]
    rows = []
    for c in contacts:
        other = c["collider"] if "collider" in c else f"body {c['with']}"
        other += f" ({c['triangles']} triangles)" if "triangles" in c else ""
        text = f"body {c['body']} on {other}, law {c['law']}, {c['model']}, {c['points']} points"
        rows.append([f"contact {c['name']}", text + _left_out_text(c["left_out"])])
    return rows


def _left_out_text(count: int) -> str:
    """Text of unused points."""
    return f", {count} clamped ones left out" if count else ""


def render(options: argparse.Namespace) -> int:
    """Run `warpfea render`."""
    from ..outputs.render import render_usd

    suffix = pathlib.Path(options.output).suffix.lower()
    if suffix not in (".png", ".gif", ".html"):
        raise UsageError(f"--output {options.output}: the file name must end in .png, .gif or .html")
    for name in ("time", "size", "draw") if suffix == ".html" else ():
        if getattr(options, name) not in (None, []):
            raise UsageError(f"--{name} is for pictures; a page shows all times, in the size of its window")
    source = existing_file(options.file)
    extra: dict[str, Any] = {"color_range": options.range, **dict.fromkeys(options.draw, True)}
    if options.view:
        extra["view"] = options.view
    with quiet_warp():
        render_usd(
            source, options.output, size=options.size, fps=options.fps, speed=options.speed, field=options.field,
            time=options.time, progress=show_progress(options), **extra,
        )  # fmt: skip
    if not options.quiet:
        print(f"wrote {options.output}")
        sys.stdout.flush()
    return DONE
