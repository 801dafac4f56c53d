"""Checkpoints: the arrays and records of a simulation in one .npz file.

A temporary file is renamed to the target, so a checkpoint on disk is always complete. A resumed run is bitwise equal to
an uninterrupted one.
"""

import json
import math
import os
import pathlib
import zipfile
from typing import Any

import numpy as np

from ..base.errors import CheckpointError, OutputError
from ..base.writer import Output, check_target, write_atomically
from .reports import idle_report

__all__ = ["Checkpoint", "load_checkpoint", "read_meta", "save_checkpoint"]

SCHEMA = 3
"""Version of the file format. 1: constraints were registered with the solver, and the ledger had a column of joints in
every model; 2: other names of history arrays and of the attributes of terms, which `Term.hash` reads."""
SUFFIXES = (".npz",)


class Checkpoint(Output):
    """Output that writes the present state to `path` (.npz) during a run, replacing the previous checkpoint.

    Args:
        path: the target.
        every: steps between checkpoints. The state at the end of the run is always written.

    Raises:
        OutputError: a bad suffix, folder or `every`.
    """

    def __init__(self, path: str | os.PathLike[str], *, every: int = 100) -> None:
        if isinstance(every, bool) or int(every) != every or every < 1:
            raise OutputError(f"Checkpoint: every = {every!r} must be a whole number of steps, at least 1")
        self.path = pathlib.Path(path)
        self.every = int(every)
        self._open = False

    def open(self, sim: Any) -> None:
        check_target(self.path, SUFFIXES)
        self._open = True
        self._write_calls = 0
        self._saved_at_step = -1

    def write(self, sim: Any) -> None:
        if self._write_calls and self._write_calls % self.every == 0:
            self._save(sim)
        self._write_calls += 1

    def close(self, sim: Any) -> None:
        if self._open and self._saved_at_step != sim.steps:
            self._save(sim)
        self._open = False

    def abort(self) -> None:
        """No-op: no partial file exists."""
        self._open = False

    def _save(self, sim: Any) -> None:
        save_checkpoint(sim, self.path)
        self._saved_at_step = sim.steps


def save_checkpoint(sim: Any, path: str | os.PathLike[str]) -> None:
    """Write the simulation's state to `path` (.npz). OutputError on failure."""
    target = check_target(path, SUFFIXES)
    sim.stepper.update_parameters()
    meta = {
        "schema": SCHEMA, "fingerprint": sim.model.fingerprint(), "dtype": sim.model.dtype, "worlds": sim.model.worlds,
        "slots": sim.model.slots, "integrator": sim.integrator.label, "gravity": sim.model.description.gravity.tolist(),
        "dt": np.asarray(sim.dt).tolist() if sim.error is None else "auto", "steps": sim.steps,
        "max_residual": sim.max_residual, "max_floor": sim.max_floor, "max_violation": sim.max_violation,
        "min_J": sim.min_J if math.isfinite(sim.min_J) else None,
        "probes": [probe.name for probe in sim.model.description.probes],
    }  # fmt: skip
    if sim.stepper.step_size_control:
        sync_times = sim.stepper.step_size_control.sync_times
        meta["error"] = sim.error
        meta["instants"] = [sync_times.interval, sync_times.horizon, sync_times.origin] if sync_times.is_set else None
    arrays: dict[str, Any] = {f"state.{name}": values for name, values in sim.state.numpy().items()}
    arrays |= {f"parameter.{name}": values for name, values in sim.model.parameters.numpy().items()}
    arrays |= {f"set.{name}": array.numpy() for name, array in sim.model.terms.parameter_arrays().items()}
    arrays |= {f"total.{name}": values for name, values in sim.totals.items()}
    if sim.statistics.history:
        arrays["history"] = np.stack(sim.statistics.history)
    text = np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8)

    def write(temporary: pathlib.Path) -> None:
        with open(temporary, "wb") as file:
            np.savez(file, meta=text, **arrays)
            file.flush()
            os.fsync(file.fileno())

    write_atomically(target, write)


def read_meta(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Checkpoint metadata: dtype, worlds, integrator, dt (s), steps, ... CheckpointError if unreadable."""
    return _read_arrays(pathlib.Path(path))[0]


def load_checkpoint(sim: Any, path: str | os.PathLike[str]) -> None:
    """Continue from a checkpoint: state, records and totals. The step dt remains the simulation's own, and so does the
    error of dt = "auto"; interval and horizon are the checkpoint's.

    Raises:
        CheckpointError: unreadable or truncated, or of another model, precision, number of worlds or integrator. The
            simulation is unchanged then.
    """
    file = pathlib.Path(path)
    meta, arrays = _read_arrays(file)
    _check_compatible(file, meta, sim)
    state = {name.removeprefix("state."): a for name, a in arrays.items() if name.startswith("state.")}
    for name in ("rough", "floored"):  # files older than these counts
        arrays.setdefault(f"total.{name}", np.zeros(sim.model.worlds, int))
    totals = {name: arrays.get(f"total.{name}") for name in sim.totals}
    parameters = {name.removeprefix("parameter."): a for name, a in arrays.items() if name.startswith("parameter.")}
    history = arrays.get("history", np.zeros((0, 0, 0)))
    shape = {name: None if a is None else a.shape for name, a in totals.items()}
    if any(s != (sim.model.worlds,) for s in shape.values()) or history.ndim != 3:
        raise CheckpointError(f"{file}: iteration totals or probe records are damaged")
    try:
        sim.model.parameters.check(parameters)
        set_arrays = sim.model.terms.parameter_arrays()
        for name, array in set_arrays.items():
            if f"set.{name}" in arrays and arrays[f"set.{name}"].shape != array.numpy().shape:
                raise CheckpointError(f"the values of {name!r} are damaged")
        sim.state.load(state)
        sim.model.parameters.load(parameters)
        for name, array in set_arrays.items():
            if f"set.{name}" in arrays:  # absent in older files
                array.assign(arrays[f"set.{name}"])
        sim.stepper.invalidate(potential="predictor_potential" not in state)
        sim.stepper.start_terms()
    except CheckpointError as error:
        raise CheckpointError(f"{file}: {error}") from None
    if sim.stepper.step_size_control and meta.get("instants"):
        sim.stepper.step_size_control.sync_times.load(*meta["instants"])
    sim.totals = {name: np.array(a) for name, a in totals.items()}
    sim.steps = int(meta["steps"])
    sim.max_residual = float(meta["max_residual"])
    sim.max_floor = float(meta.get("max_floor", 0.0))
    sim.max_violation = float(meta.get("max_violation", 0.0))
    sim.min_J = math.inf if meta.get("min_J") is None else float(meta["min_J"])
    sim.statistics.history = list(history)
    sim.last = idle_report(sim)


def _check_compatible(file: pathlib.Path, meta: dict[str, Any], sim: Any) -> None:
    """Raise CheckpointError naming the first difference between checkpoint and simulation."""
    expected = {
        "dtype": ("precision", sim.model.dtype),
        "worlds": ("number of worlds", sim.model.worlds),
        "integrator": ("integrator", sim.integrator.label),
        "slots": ("number of slots", sim.model.slots),
        "probes": ("probes", [probe.name for probe in sim.model.description.probes]),
        "fingerprint": ("model", sim.model.fingerprint()),
        "gravity": ("gravity", sim.model.description.gravity.tolist()),
    }
    for key, (what, value) in expected.items():
        if meta.get(key) == value:
            continue
        if key == "fingerprint":
            raise CheckpointError(
                f"{file}: the checkpoint is of another model: "
                "mesh, materials, supports, loads, joints or contacts differ"
            )
        hint = "; the model or its parameters differ" if key == "slots" else ""
        raise CheckpointError(
            f"{file}: {what} of the checkpoint is {meta.get(key)!r}, of the simulation {value!r}{hint}"
        )
    if sim.stepper.step_size_control and meta.get("dt") != "auto":
        raise CheckpointError(f"{file}: dt of the checkpoint is {meta.get('dt')!r}, of the simulation 'auto'")


def _read_arrays(file: pathlib.Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    if not file.is_file():
        raise CheckpointError(f"{file}: no such checkpoint")
    try:
        with np.load(file, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        meta = json.loads(arrays.pop("meta").tobytes())
        schema = meta["schema"]
    except OSError as error:
        raise CheckpointError(f"{file}: not a readable checkpoint ({error.strerror or error})") from error
    except (ValueError, KeyError, TypeError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise CheckpointError(f"{file}: not a readable checkpoint, such as wf.Checkpoint writes") from error
    if schema != SCHEMA:
        older = "was written by an older version of warpfea" if schema in range(1, SCHEMA) else "is unknown"
        raise CheckpointError(f"{file}: the checkpoint {older} (schema {schema!r}; this version reads {SCHEMA})")
    return meta, arrays
