"""Sweeps in TOML: the file, its keys and its paths."""

from __future__ import annotations

import pathlib
import tomllib
from collections.abc import Mapping
from typing import Any

from ..base.errors import Error, ModelError
from ..base.lazy import require_matplotlib
from ..base.names import check_choice
from ..base.writer import make_folder
from ..builder.scene import locate, split_name
from .design import AXIS_KEYS, Design, check_keys
from .engines import make_engine
from .pictures import SHEET_SUFFIXES, TABLE_SUFFIXES, check_designs
from .result import SweepResult
from .sweep import RUN_OPTIONS, sweep

__all__ = ["read_study", "run_study"]

KEYS: dict[str, Any] = {
    "scene": str,
    "out": str,
    "parameters": (),
    "design": ("kind", "over", "count", "seed", "file", "rows"),
    "measures": (),
    "series": (),
    "run": RUN_OPTIONS,
    "engine": ("workers", "worlds", "memory", "scheduler"),
    "pictures": ("table", "pareto", "sheet", "designs", "field"),
}
"""Keys of a file: a type, or the keys of a table, any if there are none."""
KINDS: dict[str, type | tuple[type, ...]] = {
    "engine.workers": int, "engine.worlds": int, "engine.memory": (int, float), "engine.scheduler": str,
    "pictures.table": str, "pictures.pareto": list, "pictures.sheet": str, "pictures.designs": list,
    "pictures.field": str, "run.static": bool, "run.integrator": str, "run.device": str,
}  # fmt: skip
"""Types of entries of tables that `sweep` does not check."""
NAMES = {str: "a text", int: "a whole number", (int, float): "a number", list: "a list", bool: "true or false"}


def read_study(path: str | pathlib.Path) -> dict[str, Any]:
    """The tables of a file, with paths from its folder, designs and values checked.

    Raises:
        ModelError: no such file, no TOML, or a key with its path.
    """
    file = pathlib.Path(path)
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ModelError(f"{file}: can't be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ModelError(f"{file}: {error}") from error
    try:
        return _checked(content, file.parent)
    except ModelError as error:
        raise ModelError(f"{file}: {error}") from error


def _checked(content: dict[str, Any], folder: pathlib.Path) -> dict[str, Any]:
    check_keys("", content, list(KEYS))
    for key in ("scene", "design", "measures"):
        if key not in content:
            raise ModelError(f"{key} is missing")
    for key, kind in KEYS.items():
        value = content.setdefault(key, {} if isinstance(kind, tuple) else "")
        if not isinstance(value, dict if isinstance(kind, tuple) else kind):
            raise ModelError(f"{key} = {value!r} must be {'a table' if isinstance(kind, tuple) else 'a text'}")
        if isinstance(kind, tuple) and kind:
            check_keys(key, value, kind)
    for path, wanted in KINDS.items():
        table, _, key = path.partition(".")
        found = content[table].get(key)
        if found is not None and (not isinstance(found, wanted) or (isinstance(found, bool) and wanted is not bool)):
            raise ModelError(f"{path} = {found!r} must be {NAMES[wanted]}")
    design = content["design"]
    if isinstance(design.get("over"), dict):
        design["over"] = _flat(design["over"])
    if "file" in design:
        design["file"] = str(folder / str(design["file"]))
    content["design"] = Design.of(design)
    content["parameters"] = _flat(content["parameters"])
    content["scene"] = _from_folder(content["scene"], folder)
    content["out"] = folder / (content["out"] or "sweep")
    content["measures"] = {name: _from_folder(text, folder) for name, text in content["measures"].items()}
    _check_pictures(content)
    return content


def _check_pictures(content: Mapping[str, Any]) -> None:
    """ModelError, OutputError for pictures that could not be drawn after the sweep."""
    pictures, design = content["pictures"], content["design"]
    for key, suffixes in (("table", TABLE_SUFFIXES), ("sheet", SHEET_SUFFIXES)):
        if key in pictures:
            check_choice(f"pictures.{key}: the type", pathlib.Path(pictures[key]).suffix.lower(), suffixes)
    if "table" in pictures:
        require_matplotlib()
    if "pareto" in pictures:
        if len(pictures["pareto"]) != 2:
            raise ModelError(f"pictures.pareto = {pictures['pareto']!r} must be the names of two measures")
        for name in pictures["pareto"]:
            check_choice("pictures.pareto: the column", name, [*content["measures"], *design.columns])
    if "designs" in pictures:
        check_designs("pictures.designs", pictures["designs"], len(design))
    if "field" in pictures:
        scene = locate(content["scene"])
        own = {name: value for name, value in design[0].items() if name in scene.parameters}
        try:
            fields = scene(**content["parameters"] | own).finalize(device="cpu").terms.scalar_fields
        except (Error, MemoryError, NotImplementedError):  # the sweep tells
            return
        check_choice("pictures.field", pictures["field"], fields)


def _flat(table: Mapping[str, Any]) -> dict[str, Any]:
    """Names with dots for tables in tables: TOML reads bar.E = 1 as {bar = {E = 1}}."""
    out: dict[str, Any] = {}
    for name, value in table.items():
        if isinstance(value, dict) and not set(value) & set(AXIS_KEYS):
            out |= {f"{name}.{key}": inner for key, inner in _flat(value).items()}
        else:
            out[name] = value
    return out


def _from_folder(text: Any, folder: pathlib.Path) -> Any:
    """A text "file.py:name" with the file from a folder; others as they are."""
    file, name = split_name(text) if isinstance(text, str) else (None, "")
    return text if file is None else str((folder / file).resolve()) + (f":{name}" if name else "")


def run_study(path: str | pathlib.Path, **given: Any) -> SweepResult:
    """Sweep as a file says, with its pictures.

    Args:
        given: scheduler, workers, device, out, resume and progress take the place of the file's.

    Raises:
        ModelError, CheckpointError, OutputError: as `sweep`, of the file with its name.
    """
    study = read_study(path)
    run, how = study["run"], study["engine"]
    if given.get("device"):
        run["device"] = given["device"]
    chosen = given.get("scheduler") or given.get("workers") or how.get("scheduler") or how.get("workers")
    if isinstance(chosen, str) and "memory" in how:
        raise ModelError(f"{path}: engine.memory limits processes of this machine, not those of a scheduler")
    pictures = study["pictures"]
    try:
        result = sweep(
            study["scene"], study["design"], measures=study["measures"], series=study["series"],
            parameters=study["parameters"], run=run, out=given.get("out") or study["out"],
            resume=bool(given.get("resume")), worlds=how.get("worlds"), progress=given.get("progress"),
            engine=(lambda device: make_engine(chosen, device, how.get("memory"))),
        )  # fmt: skip
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error
    if "table" in pictures:
        result.plot(_target(result, pictures["table"]), pareto=pictures.get("pareto", ()))
    if "sheet" in pictures:
        result.sheet(_target(result, pictures["sheet"]), pictures.get("designs"), field=pictures.get("field"))
    return result


def _target(result: SweepResult, name: str) -> pathlib.Path:
    """Path of a picture, whose folder is made. OutputError."""
    target = result.folder / name
    make_folder(target.parent)
    return target
