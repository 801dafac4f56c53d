"""Reference solution of a scene for error measurement by `warpfea study`."""

import csv
import inspect
import json
import pathlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..base.usercode import convert_user_errors

__all__ = ["Reference", "make_reference", "read_reference"]

Positions = Callable[[np.ndarray], np.ndarray] | tuple[Any, Any]


@dataclass(frozen=True, eq=False)
class Reference:
    """Reference motion, known independently of the scene's own steps.

    Attributes:
        probes: by name: a function of times (n,), s, returning positions (n, 3), m, or samples (times, positions).
        about: source, for the table.
        error: its own error, m; 0 for a closed form.
        field: expected value of the scene's `field` at the end; None: unknown.
    """

    probes: Mapping[str, Positions] = field(repr=False)
    about: str = "closed form"
    error: float = 0.0
    field: Any = None

    def __post_init__(self) -> None:
        if not self.probes:
            raise ModelError(f"reference {self.about!r}: names no probe")
        if not (np.isfinite(self.error) and self.error >= 0.0):
            raise ModelError(f"reference {self.about!r}: error = {self.error!r} must be a finite length, at least 0")
        for name, motion in self.probes.items():
            if not callable(motion):
                _check_samples(f"reference {self.about!r}, probe {name!r}", *motion)


def _check_samples(what: str, times: Any, positions: Any) -> None:
    """ModelError unless times ascend and each has a position."""
    t, x = np.asarray(times, dtype=float), np.asarray(positions, dtype=float)
    if t.ndim != 1 or x.shape != (len(t), 3) or not (np.isfinite(t).all() and np.isfinite(x).all()):
        raise ModelError(f"{what}: expected times (n,) and positions (n, 3), all finite, got {t.shape} and {x.shape}")
    if len(t) == 0 or np.any(np.diff(t) <= 0.0):
        raise ModelError(f"{what}: times must ascend, at least one")


def make_reference(given: Any, parameters: Mapping[str, Any]) -> Reference | None:
    """Reference of a scene for the given parameter values; None if it has none.

    Args:
        given: a Reference, a dict of its probes, or a function returning one of them, called with those scene
            parameters that it names.
        parameters: all parameters of the scene.

    Raises:
        ModelError: another type, or an unknown parameter name.
    """
    if callable(given):
        wanted = inspect.signature(given).parameters
        missing = [name for name, p in wanted.items() if name not in parameters and p.default is p.empty]
        if missing:
            raise ModelError(f"reference {given.__name__!r}: {missing[0]!r} is no parameter of the scene")
        with convert_user_errors(f"reference {given.__name__!r}"):
            given = given(**{name: parameters[name] for name in wanted if name in parameters})
    if given is None or isinstance(given, Reference):
        return given
    if isinstance(given, Mapping):
        return Reference(given)
    raise ModelError(f"reference: expected a wf.Reference, or a dict of probes and their positions, got {given!r}")


def read_reference(path: str | pathlib.Path, probe: str) -> Reference:
    """Reference from a file of positions over time.

    Args:
        path: .csv with the columns t, x, y, z and, for several probes, probe; or .json with t (n,) and probes, a dict
            of positions (n, 3), and optionally about and error (m). SI units.
        probe: name of the probe of a .csv without the column `probe`.

    Raises:
        ModelError: missing file or another format.
    """
    file = pathlib.Path(path)
    if not file.is_file():
        raise ModelError(f"{file}: no such file")
    try:
        if file.suffix.lower() == ".json":
            content = json.loads(file.read_text())
            probes = {str(name): (content["t"], values) for name, values in content["probes"].items()}
            return Reference(probes, str(content.get("about", file.name)), float(content.get("error", 0.0)))
        with open(file, newline="") as stream:
            rows = [{(k or "").strip(): v for k, v in row.items()} for row in csv.DictReader(stream)]
        series: dict[str, tuple[list[float], list[list[float]]]] = {}
        for row in rows:
            times, positions = series.setdefault(row.get("probe", probe), ([], []))
            times.append(float(row["t"]))
            positions.append([float(row[axis]) for axis in "xyz"])
        return Reference(dict(series), file.name)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        form = "a .csv needs the columns t, x, y, z (and probe), a .json t and probes"
        raise ModelError(f"{file}: is no reference ({type(error).__name__}: {error}); {form}") from None
