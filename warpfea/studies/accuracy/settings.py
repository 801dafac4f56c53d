"""Settings of a run, the swept axes, and their product."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
import shlex
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from ...base.checks import finite_number
from ...base.console import to_json
from ...base.errors import ModelError
from ...base.names import check_known, did_you_mean
from ...builder.scene import Scene
from ...simulation.integrators import Integrator, find_integrator
from ...solvers import SOLVERS

__all__ = [
    "SWEEP_OPTIONS", "Setting", "SweepAxes", "check_steps", "method_text", "parse_over",
    "setting_product", "sweep_axes",
]  # fmt: skip

SWEEP_OPTIONS = ("method", "dt", "error", "solver", "tol", "dtype", "device")
"""Sweepable options besides the parameters of the scene."""
SYNONYMS = {"methods": "method", "integrator": "method"}
"""Synonyms of options."""
MESH_PARAMETERS = ("cells", "elements", "across")
"""Whole-number parameters of scenes that refine the mesh."""
DTYPES = ("float64", "float32")


@dataclass(frozen=True)
class Setting:
    """Options of a run.

    Attributes:
        method: integrator, as text. dt: step, s, None if adapted to `error`, the requested error.
        solver: name. tol: relative residual; None: the solver's own. dtype, device: of the model.
        t_end: s. values: all parameters of the scene.
    """

    method: str
    dt: float | None
    error: float | None
    solver: str
    tol: float | None
    dtype: str
    device: str
    t_end: float
    values: dict[str, Any]

    def get(self, name: str) -> Any:
        """Value of an option or a parameter."""
        return getattr(self, name) if name in SWEEP_OPTIONS else self.values[name]

    def with_changes(self, changes: Mapping[str, Any]) -> Setting:
        """Copy with other options or parameters; dt replaces an `error`, and vice versa."""
        own = {name: value for name, value in changes.items() if name in SWEEP_OPTIONS}
        if own.get("dt") is not None:
            own.setdefault("error", None)
        if own.get("error") is not None:
            own.setdefault("dt", None)
        values = self.values | {name: value for name, value in changes.items() if name not in SWEEP_OPTIONS}
        return replace(self, **own, values=values)

    def hash_key(self, code: str) -> str:
        """Hash of the settings and the code version, the name of the run in a store."""
        return hashlib.sha256(json.dumps([to_json(asdict(self)), code], sort_keys=True).encode()).hexdigest()[:20]

    def command(self, what: str, scene: Scene[Any]) -> str:
        """Command line of the run."""
        words = ["warpfea", "run", what, "--integrator", self.method]
        words += ["--dt", "auto" if self.error is not None else cli_text(self.dt)]
        words += ["--error", cli_text(self.error)] if self.error is not None else []
        for name, default in (("t_end", scene.t_end), ("solver", "newton-pcg"), ("tol", scene.tol)):
            if (value := getattr(self, name)) not in (None, default):
                words += [f"--{name.replace('_', '-')}", cli_text(value)]
        words += ["--dtype", self.dtype, "--device", self.device]
        for name, value in self.values.items():
            if value != scene.parameters[name].default:
                words += ["--set", f"{name}={cli_text(value)}"]
        return shlex.join(words)


@dataclass(frozen=True)
class SweepAxes:
    """Swept axes.

    Attributes:
        over: values by name, in the order given.
        mesh: parameters of the scene that refine the mesh, swept or not.
        choices: swept parameters of the discretisation: names and switches.
        physical: swept parameters that change the problem; each of their values has its own reference.
    """

    over: dict[str, list[Any]]
    mesh: tuple[str, ...]
    choices: tuple[str, ...]
    physical: tuple[str, ...]

    @property
    def sizes(self) -> list[str]:
        """Swept sizes for observed orders: steps and meshes."""
        return [name for name in self.over if name in ("dt", "error", *self.mesh)]

    @property
    def curve_axis(self) -> str | None:
        """Axis along a curve; None if only names vary."""
        for name in ("dt", "error", *self.mesh, "tol"):
            if name in self.over:
                return "step" if name in ("dt", "error") else name
        return None


def cli_text(value: Any) -> str:
    """A value as on the command line."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.12g}"
    if isinstance(value, (tuple, list)):
        return ",".join(map(cli_text, value))
    return "none" if value is None else str(value)


def split_methods(text: str) -> list[str]:
    """Words of a comma-separated list; commas in brackets belong to a word."""
    return [part.strip() for part in re.split(r",(?![^(]*\))", text)]


def method_text(given: str | Integrator) -> str:
    """An integrator as text; names are unchanged. ModelError for an unknown one."""
    found = find_integrator(given)
    return given if isinstance(given, str) else found.label


def parse_over(scene: Scene[Any], texts: Iterable[str], option: str = "--over") -> dict[str, list[Any]]:
    """`NAME=V1,V2` as values. ModelError for a text without values, and for a repeated name."""
    out: dict[str, list[Any]] = {}
    for text in texts:
        name, equals, values = text.partition("=")
        name = SYNONYMS.get(name.strip(), name.strip())
        if not equals or not values.strip():
            raise ModelError(f"{option} {text}: expected NAME=V1,V2,...")
        if name in out:
            raise ModelError(f"{option} {name}: given twice")
        out[name] = split_methods(values) if name == "method" else [part.strip() for part in values.split(",")]
        if name in ("dt", "error", "tol"):
            out[name] = [_positive_number(name, value) for value in out[name]]
        elif name not in SWEEP_OPTIONS:
            _check_names(scene, [name])
            parts = out[name]
            if typing.get_origin(scene.parameters[name].kind) is tuple:  # 6x2x1: commas separate values
                parts = [part.replace("x", ",") for part in parts]
            out[name] = [scene.parse_settings([f"{name}={part}"])[name] for part in parts]
    return out


def _positive_number(name: str, text: Any) -> float:
    value = finite_number(text)
    if not value > 0.0:
        raise ModelError(f"{name} = {text!r} must be a positive finite number")
    return value


def _check_names(scene: Scene[Any], names: Iterable[str]) -> None:
    """ModelError for a name that is neither an option nor a parameter of the scene."""
    known = [*SWEEP_OPTIONS, *scene.parameters]
    for name in names:
        if name not in known:
            raise ModelError(
                f"study of {scene.name!r}: can't sweep {name!r}; there are {', '.join(SWEEP_OPTIONS)}, and of the "
                f"scene {', '.join(scene.parameters) or 'no parameters'}{did_you_mean(name, known)}"
            )


def sweep_axes(scene: Scene[Any], over: Mapping[str, Sequence[Any]], mesh: Sequence[str] | None) -> SweepAxes:
    """Swept axes, after a check of their values.

    Args:
        scene: the scene.
        over: values by name.
        mesh: parameters that refine the mesh; None: those of MESH_PARAMETERS that are whole numbers.

    Raises:
        ModelError: an unknown name, no values, a repeated or an invalid value.
    """
    chosen = {SYNONYMS.get(name, name): values for name, values in over.items()}
    if len(chosen) < len(over):
        raise ModelError(f"study: {', '.join(over)} name the same thing twice")
    _check_names(scene, chosen)
    out: dict[str, list[Any]] = {}
    for name, values in chosen.items():
        if isinstance(values, (str, bytes)) or not isinstance(values, Iterable) or not list(values):
            raise ModelError(f"study: over {name} = {values!r} must be a list of values, at least one")
        out[name] = [_positive_number(name, v) if name in ("dt", "error", "tol") else v for v in values]
        if name == "method":
            out[name] = [method_text(value) for value in out[name]]
        if len({repr(value) for value in out[name]}) < len(out[name]):
            raise ModelError(f"study: over {name} = {out[name]} holds a value twice")
        known = {"solver": tuple(SOLVERS), "dtype": DTYPES}.get(name, ())
        for value in out[name] if known else ():
            check_known(f"study: {name}", value, known)
    whole = {name for name, p in scene.parameters.items() if is_integer(p.default) and not isinstance(p.default, bool)}
    for name in mesh or ():
        if name not in whole:
            hint = did_you_mean(name, whole)
            raise ModelError(f"study: mesh {name!r} is no whole number of the scene; it has {sorted(whole)}{hint}")
    refine = tuple(mesh) if mesh is not None else tuple(name for name in MESH_PARAMETERS if name in whole)
    swept = [name for name in out if name not in (*SWEEP_OPTIONS, *refine)]
    choices = tuple(name for name in swept if all(isinstance(v, (str, bool)) for v in out[name]))
    return SweepAxes(out, refine, choices, tuple(name for name in swept if name not in choices))


def is_integer(value: Any) -> bool:
    """True for a whole number or a tuple of them."""
    return isinstance(value, int) or (isinstance(value, tuple) and bool(value) and all(map(is_integer, value)))


def setting_product(base: Setting, axes: SweepAxes) -> list[Setting]:
    """Every combination, with fixed and adaptive steps.

    Raises:
        ModelError: a step that does not divide the duration.
    """
    steps = [{name: value} for name in ("dt", "error") for value in axes.over.get(name, ())] or [{}]
    others = [[{name: v} for v in values] for name, values in axes.over.items() if name not in ("dt", "error")]
    out = []
    for *parts, step in itertools.product(*others, steps):
        setting = base.with_changes({k: v for part in [*parts, step] for k, v in part.items()})
        if setting.dt is not None:
            check_steps(setting.dt, setting.t_end)
        out.append(setting)
    return out


def check_steps(dt: float, t_end: float) -> None:
    """ModelError unless whole steps end at t_end."""
    count = t_end / dt
    if count < 0.5 or abs(count - round(count)) > 1e-6 * max(1.0, count):
        near = ", ".join(f"{t_end / n:.12g}" for n in (math.floor(count), math.ceil(count)) if n > 0)
        raise ModelError(
            f"study: dt = {dt:g} s does not divide the end time {t_end:g} s ({count:.6g} steps): the last one would be "
            f"shorter, and no error of this step; take {near} s or another end time"
        )
