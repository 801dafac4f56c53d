"""Measures of a sweep: one number per world from a simulation at its end."""

from __future__ import annotations

import functools
import hashlib
import inspect
import pathlib
import sys
import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.errors import CheckpointError, ModelError
from ..base.names import check_choice, check_known
from ..base.usercode import convert_user_errors

__all__ = [
    "Measure", "file_of", "load_function", "parse_measure", "parse_measures", "read_source", "reference_of",
    "source_of",
]  # fmt: skip

REDUCTIONS: dict[str, Callable[..., np.ndarray]] = {
    "last": lambda values, axis: values[:, -1],
    "max": np.fmax.reduce,
    "min": np.fmin.reduce,
    "mean": np.mean,
}
RECORDS = {
    "probe": ("position", "displacement", "velocity"),
    "contact": (
        "force",
        "moment",
        "normal_force",
        "penetration",
        "slip",
        "area",
        "stick",
        "stored",
        "loss",
        "friction",
    ),
    "joint": ("force", "moment"),
}
"""Quantities over time, by kind."""
VECTORS = ("position", "displacement", "velocity", "force", "moment")
COMPONENTS = ("x", "y", "z", "norm")
KINDS = (*RECORDS, "field", "energy")


@dataclass(frozen=True)
class Measure:
    """A measure by its text: "max probe.tip.displacement.z", "field.von_mises.bar", "energy.strain" or
    "file.py:function".

    Attributes:
        text: as given. reduction: over time, of a field over nodes.
        kind: of KINDS, or "function". name: of the probe, contact, joint, field or energy; "file.py:function".
        quantity: of RECORDS; of a field the body, "" for all. component: of COMPONENTS, or "".
        source: hash of the function's file.
    """

    text: str
    reduction: str
    kind: str
    name: str
    quantity: str = ""
    component: str = ""
    source: str = ""

    @property
    def over_time(self) -> bool:
        """True if every step counts."""
        return self.kind in RECORDS and self.reduction != "last"

    def record(self, sim: Any) -> Any:
        """The record over time of a simulation."""
        return {"probe": sim.probe, "contact": sim.contact_record, "joint": sim.joint_record}[self.kind](self.name)

    def times(self, sim: Any) -> np.ndarray:
        """Times (worlds, steps), s."""
        time = self.record(sim).time
        return np.broadcast_to(time, (sim.model.worlds, time.shape[-1]))

    def series(self, sim: Any) -> np.ndarray:
        """Values (worlds, steps)."""
        values = np.asarray(getattr(self.record(sim), self.quantity), dtype=float)
        if self.component == "norm":
            return np.linalg.norm(values, axis=2)
        return values[:, :, COMPONENTS.index(self.component)] if self.component else values

    def __call__(self, sim: Any) -> np.ndarray:
        """Values (worlds,) of a simulation. ModelError."""
        if self.kind in RECORDS:
            return REDUCTIONS[self.reduction](self.series(sim), axis=1)
        if self.kind == "field":
            bodies = [body for body in sim.model.bodies if self.quantity in ("", body.name)]
            values = np.concatenate([sim.field(self.name, body) for body in bodies], axis=1).astype(float)
            return REDUCTIONS[self.reduction](values, axis=1)
        if self.kind == "energy":
            if sim.load is not None and self.name == "strain":
                return np.asarray(sim.model.strain_energy(sim.state))
            energies = sim.energies()
            check_known("energy", self.name, energies)
            return energies[self.name]
        with convert_user_errors(f"measure {self.name.rpartition(':')[2]!r}"):
            values = np.asarray(load_function(self.name, self.source)(sim), dtype=float)
        if values.shape not in ((), (sim.model.worlds,)):
            raise ModelError(f"measure {self.text}: expected ({sim.model.worlds},) values, got {values.shape}")
        return np.broadcast_to(values, sim.model.worlds)

    def check(self, where: str, model: Any) -> None:
        """ModelError with the key's path for a name that a model does not have."""
        d, terms = model.description, model.terms
        known = {"probe": d.probes, "contact": d.contacts, "joint": d.joints}.get(self.kind)
        if known is not None:
            check_known(f"{where}: {self.kind}", self.name, [each.name for each in known])
        if self.kind == "field":
            check_known(f"{where}: field", self.name, terms.scalar_fields)
            check_known(f"{where}: body", self.quantity or model.bodies[0].name, [body.name for body in model.bodies])
        if self.kind == "energy":
            check_known(f"{where}: energy", self.name, terms.energies(np.zeros((1, len(terms.ledger)))))


def parse_measures(where: str, given: Any) -> dict[str, Measure]:
    """Measures by name from texts or functions. ModelError with the key's path."""
    if not isinstance(given, Mapping) or not given:
        raise ModelError(f'{where}: give at least one measure, such as {{"tip": "probe.tip.displacement.z"}}')
    for name in given:
        if not isinstance(name, str) or not name.strip() or not name.isprintable():
            raise ModelError(f"{where}: the name {name!r} must be a text that can be printed")
    return {name: parse_measure(f"{where}.{name}", item) for name, item in given.items()}


def parse_measure(where: str, given: Any) -> Measure:
    """A measure from its text or a function of the simulation. ModelError with the key's path."""
    if callable(given):
        given = reference_of(where, given)
    if not isinstance(given, str) or not given.strip():
        raise ModelError(f"{where} = {given!r} must be a text such as 'probe.tip.displacement.z', or a function")
    if ".py:" in given:
        source = source_of(given)
        load_function.__wrapped__(given, source)  # before a worker does, which reads the file anew
        return Measure(given, "last", "function", given, source=source)
    *words, path = given.split()
    kind, *parts = path.split(".")
    check_choice(f"{where}: the kind", kind, KINDS)
    reduction = words[0] if words else "max" if kind == "field" else "last"
    allowed = {"field": ("max", "min", "mean"), "energy": ("last",)}.get(kind, tuple(REDUCTIONS))
    check_choice(f"{where}: the reduction", reduction, allowed)
    parts += [""] * (3 - len(parts))
    name, quantity, component = ".".join(parts[:-2]) if len(parts) > 3 else parts[0], *parts[-2:]
    if kind in RECORDS:
        check_choice(f"{where}: the quantity", quantity, RECORDS[kind])
        check_choice(f"{where}: the component", component, COMPONENTS if quantity in VECTORS else ("",))
    elif component or (kind == "energy" and quantity):
        raise ModelError(f"{where} = {given!r}: expected {kind}.NAME" + ".BODY" * (kind == "field"))
    if not name or len(words) > 1:
        raise ModelError(f"{where} = {given!r}: expected [{'|'.join(allowed)}] {kind}.NAME...")
    return Measure(given, reduction, kind, name, quantity, component)


# functions in other processes


def file_of(what: str, function: Any, name: str) -> str:
    """Absolute path of the file whose module defines a function by name.

    Raises:
        ModelError: a function of a notebook, a prompt or another function.
    """
    module = sys.modules.get(getattr(function, "__module__", ""), None)
    file = getattr(module, "__file__", None)
    if file is None or not pathlib.Path(file).is_file():
        raise ModelError(
            f"{what}: {name!r} is defined in a notebook or at a prompt, which workers can't import: write it to a file"
        )
    if "<locals>" in name or "<lambda>" in name or not hasattr(module, name):
        raise ModelError(f"{what}: {name!r} is not at the top of the file {file}, where workers look for it")
    return str(pathlib.Path(file).resolve())


def reference_of(what: str, function: Any) -> str:
    """The text "file.py:function" by which other processes find a function. ModelError."""
    name = getattr(inspect.unwrap(function), "__qualname__", repr(function))
    return f"{file_of(what, inspect.unwrap(function), name)}:{name}"


def source_of(reference: str) -> str:
    """Hash of the file of "file.py:NAME". ModelError."""
    file = pathlib.Path(reference.rpartition(":")[0])
    if not file.is_file():
        raise ModelError(f"{file}: no such file")
    return hashlib.sha256(file.read_bytes()).hexdigest()


def read_source(reference: str, source: str) -> bytes:
    """Content of the file of "file.py:NAME" with that hash. CheckpointError if it is another one by now."""
    file = reference.rpartition(":")[0]
    try:
        content = pathlib.Path(file).read_bytes()
    except OSError as error:
        raise CheckpointError(f"{file}: can't be read ({error})") from error
    if hashlib.sha256(content).hexdigest() != source:
        raise CheckpointError(f"{file}: has changed since the sweep began")
    return content


@functools.lru_cache(maxsize=64)
def load_function(reference: str, source: str) -> Callable[[Any], Any]:
    """The function "file.py:function" of the file with that hash. ModelError, CheckpointError."""
    file, _, name = reference.rpartition(":")
    content, module = read_source(reference, source), types.ModuleType(f"_warpfea_measures_{source}")
    module.__file__ = file
    sys.modules[module.__name__] = module
    sys.path.insert(0, str(pathlib.Path(file).parent))
    try:
        with convert_user_errors(file):
            exec(compile(content, file, "exec", dont_inherit=True), module.__dict__)
    finally:
        sys.path.pop(0)
    functions = {key: value for key, value in vars(module).items() if callable(value)}
    check_known(f"{file}: function", name, functions)
    return functions[name]
