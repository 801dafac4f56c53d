"""Work of a sweep's worker: designs that share a model, as worlds of one simulation."""

from __future__ import annotations

import dataclasses
import functools
import gc
import os
import socket
import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import warpfea as wf

from ..base.errors import CapacityError, Error, ModelError
from ..base.names import did_you_mean
from ..builder.scene import Scene, locate, split_name
from .measures import Measure, load_function, read_source

__all__ = [
    "FAILED_WORLD", "Group", "Outcome", "Rows", "Study", "check_names", "failed_rows", "find_scene", "solve",
    "solver_of",
]  # fmt: skip

FAILURES = (Error, MemoryError, NotImplementedError)
"""Errors of a design, also those of the user's functions; others are of the machine, and end the worker."""
FAILED_WORLD = 1
"""Status of a world whose step was refused."""
STATIC_OPTIONS = ("load_steps", "tol", "stabilise", "inversion", "unstable", "constraint_tol")
MOTION_OPTIONS = (
    "dt", "error", "interval", "horizon", "integrator", "tol", "solver", "ledger", "inversion", "energy_growth",
    "constraint_tol",
)  # fmt: skip


Columns = dict[str, list[Any]]
"""Values of designs by name."""


@dataclass(frozen=True)
class Study:
    """Settings of a sweep that its workers need.

    Attributes:
        scene: name or file.py:NAME. fixed: its parameters that are the same in all designs.
        measures: by name. series: quantities over time that are kept.
        run: options of the run, see `sweep`. many: of `ModelBuilder.finalize`.
        source: hash of the scene's file.
    """

    scene: str
    fixed: dict[str, Any]
    measures: dict[str, Measure]
    series: dict[str, Measure]
    run: dict[str, Any]
    many: bool
    source: str = ""

    @property
    def place(self) -> dict[str, Any]:
        """Device and precision of the models; a worker sees one GPU alone."""
        kind = str(self.run["device"]).partition(":")[0]
        return {"device": "cuda:0" if kind == "cuda" else kind, "dtype": self.run.get("dtype", "float64")}


@functools.lru_cache(maxsize=16)
def find_scene(name: str, source: str) -> Scene[Any]:
    """The scene NAME, or file.py:NAME of the file with that hash. ModelError, CheckpointError."""
    return locate(name, None if split_name(name)[0] is None else read_source(name, source))


def load(study: Study) -> Scene[Any]:
    """The scene of a study, and functions of its measures, into the cache. ModelError, CheckpointError."""
    for measure in study.measures.values():
        if measure.kind == "function":
            load_function(measure.name, measure.source)
    return find_scene(study.scene, study.source)


class Rows:
    """Results of designs in columns, as an object for each would take longer than to send it.

    Args:
        design: indices. values: by measure, None where there is none.
        seconds: of their batch over the number of worlds. worlds: of that batch.
        status: "done", "unconverged steps", "no value", "failed" or "killed". reason: of a failure.

    Attributes:
        columns: "design", "status", "reason", "seconds", "worlds", "alone": "" unless the design failed among others
            and was run again: then "failed" or "done"; "series": (steps,) by name, and "time".
        values: by measure.
    """

    def __init__(
        self, design: list[int], values: dict[str, list[float | None]], *, seconds: float = 0.0, worlds: int = 1,
        status: str = "done", reason: str = "",
    ) -> None:  # fmt: skip
        each = {"status": status, "reason": reason, "seconds": seconds, "worlds": worlds, "alone": "", "series": {}}
        self.columns: dict[str, list[Any]] = {"design": design}
        self.columns |= {name: [value] * len(design) for name, value in each.items()}
        self.values = values

    def update(self, row: int, columns: Mapping[str, Any], values: Mapping[str, float | None]) -> None:
        """Change one row."""
        for table, given in ((self.columns, columns), (self.values, values)):
            for name, value in given.items():
                table[name][row] = value

    def extend(self, other: Rows) -> None:
        """Add rows at the end."""
        for table, more in ((self.columns, other.columns), (self.values, other.values)):
            for name, column in table.items():
                column += more[name]


@dataclass(frozen=True)
class Outcome:
    """Result of a task.

    Attributes:
        rows: of the designs. plan: of the solver; None without a simulation.
        device: kind of device. worker: host and process. seconds: of the task.
    """

    rows: Rows
    plan: dict[str, Any] | None
    device: str
    worker: str
    seconds: float


def check_names(study: Study, arguments: dict[str, Any], indices: list[int], columns: Columns) -> None:
    """Raise ModelError for measures that the model of some designs lacks, and values that none of them can set.

    A model that can't be built is left for `solve` to tell. CheckpointError for files that have changed.
    """
    scene = load(study)
    try:
        group = Group(study, scene, arguments)
        model = group.model(1)
    except FAILURES:
        return
    for where, chosen in (("measures", study.measures), ("series", study.series)):
        for name, measure in chosen.items():
            measure.check(f"{where}.{name}", model)
    for last in range(1 - len(indices), 1):
        try:
            set_values(model, {name: [values[last - 1]] for name, values in columns.items()})
            return
        except ModelError as error:
            if last == 0:
                raise ModelError(f"design.over: {error}") from error


def solve(study: Study, arguments: dict[str, Any], indices: list[int], columns: Columns) -> Outcome:
    """Run designs that share a model.

    Args:
        arguments: of the scene, the same for all.
        indices: of the designs. columns: their values per world by name.
    """
    began = clock.perf_counter()
    if study.place["device"] != "cpu":
        gc.collect()  # memory of the task before
    rows, plan, device = _rows(study, arguments, indices, columns)
    worker = f"{socket.gethostname()}:{os.getpid()}"
    return Outcome(rows, plan, device, worker, clock.perf_counter() - began)


def _rows(
    study: Study, arguments: dict[str, Any], indices: list[int], columns: Columns
) -> tuple[Rows, dict[str, Any] | None, str]:
    """Rows, plan and device; its model and simulation are freed at the end."""
    try:
        scene = load(study)
    except ModelError as error:  # not of a design: the first worker could load it
        raise RuntimeError(str(error)) from error
    try:
        group = Group(study, scene, arguments)
    except FAILURES as error:  # the same for each of them
        return failed_rows(study, indices, "failed", describe(error)), None, ""
    rows = group.solve(indices, columns)
    return rows, group.plan, group.device


class Group:
    """Designs with one set of scene arguments.

    Attributes:
        plan, device: as of Outcome.
    """

    def __init__(self, study: Study, scene: Scene[Any], arguments: dict[str, Any]) -> None:
        self.study, self.scene = study, scene
        self.builder = scene.build(scene.resolve(study.fixed | arguments))
        self.plan: dict[str, Any] | None = None
        self.device = ""

    def model(self, worlds: int) -> Any:
        """A model of so many worlds."""
        return self.builder.finalize(**self.study.place, worlds=worlds, many=self.study.many)

    def solve(self, indices: list[int], columns: Columns) -> Rows:
        """Rows of the designs, in batches that fit; a batch that fails as a whole is halved until one is left."""
        try:
            return self.batch(indices, columns)
        except (CapacityError, MemoryError) as error:
            failure: Exception = error
            size = min(getattr(error, "worlds", 0), len(indices) - 1) or len(indices) // 2
        except FAILURES as error:
            failure, size = error, len(indices) // 2
        if not size:
            return failed_rows(self.study, indices, "failed", describe(failure))
        del failure  # its traceback holds the arrays of the batch
        gc.collect()
        rows = failed_rows(self.study, [], "", "")
        for part in (slice(k, k + size) for k in range(0, len(indices), size)):
            rows.extend(self.solve(indices[part], {name: values[part] for name, values in columns.items()}))
        return rows

    def batch(self, indices: list[int], columns: Columns) -> Rows:
        """Rows of designs as worlds of one simulation; failed worlds are run again alone."""
        began, study, worlds = clock.perf_counter(), self.study, len(indices)
        model = self.model(worlds)
        sim = self.simulate(model, columns, on_failure="freeze" if worlds > 1 else "raise")
        self.plan = dataclasses.asdict(sim.plan)
        self.device = model.device.name if model.device.is_cuda else "cpu"
        measured = {name: np.asarray(measure(sim), dtype=float) for name, measure in study.measures.items()}
        series = {name: measure.series(sim) for name, measure in study.series.items()}
        times = next(iter(study.series.values())).times(sim) if series else np.zeros((worlds, 0))
        seconds, rough = (clock.perf_counter() - began) / worlds, sim.totals["rough"]
        values = {name: column.tolist() for name, column in measured.items()}
        rows = Rows(list(indices), values, seconds=seconds, worlds=worlds)
        for world in np.flatnonzero(rough).tolist():
            why = {"status": "unconverged steps", "reason": f"{rough[world]} steps above the tolerance"}
            rows.update(world, why, {})
        infinite = {name: ~np.isfinite(column) for name, column in measured.items()}
        for world in np.flatnonzero(np.any(list(infinite.values()), axis=0)).tolist():
            missing = [name for name in infinite if infinite[name][world]]
            why = {"status": "no value", "reason": f"{', '.join(missing)}: not finite"}
            rows.update(world, why, dict.fromkeys(missing))
        for world in range(worlds) if series else ():
            curves = {"time": times[world]} | {name: of[world] for name, of in series.items()}
            rows.update(world, {"series": curves}, {})
        for world in np.flatnonzero(sim.status == FAILED_WORLD).tolist():
            again = self.solve([indices[world]], {name: [column[world]] for name, column in columns.items()})
            found, own = ({name: column[0] for name, column in of.items()} for of in (again.columns, again.values))
            rows.update(world, found | {"alone": found["status"]}, own)
        return rows

    def simulate(self, model: Any, columns: Columns, *, on_failure: str = "raise", outputs: Sequence[Any] = ()) -> Any:
        """The finished simulation of worlds with the values of the columns."""
        if self.study.run.get("static"):
            state, controls = set_values(model, columns)
            if controls:
                raise ModelError(f"{next(iter(controls))}: controls have their initial values in statics")
            return wf.solve_static(model, state=state, outputs=outputs, **self._options()).simulation
        sim = self.start(model, columns, on_failure=on_failure)
        sim.run(self.study.run.get("t_end", self.scene.t_end), outputs=outputs, progress=False)
        return sim

    def start(self, model: Any, columns: Columns, *, on_failure: str = "raise") -> Any:
        """The simulation of worlds with the values of the columns, at its start."""
        state, controls = set_values(model, columns)
        scene, run = self.scene, self._options()
        solver, tol = run.pop("solver", "newton-pcg"), run.pop("tol", scene.tol)
        run = {"dt": scene.dt, "integrator": scene.integrator, "solver": solver_of(solver, tol)} | run
        record = bool(self.study.series) or any(measure.over_time for measure in self.study.measures.values())
        sim = wf.Simulation(model, state, record=record, on_failure=on_failure, on_compile=_silent, **run)
        for name, values in controls.items():
            sim.controls[name] = values
        return sim

    def _options(self) -> dict[str, Any]:
        return {k: v for k, v in self.study.run.items() if k not in ("device", "dtype", "static", "t_end")}


def _silent(done: int, total: int, name: str) -> None:
    """No bar for kernels in workers."""


def solver_of(name: str, tol: float | None) -> Any:
    """Options of a solver by its name and tolerance. ModelError."""
    from ..solvers import SOLVERS, solver_options

    solver_options(name)
    return SOLVERS[name](tol=tol)


def set_values(model: Any, columns: Columns) -> tuple[Any, dict[str, np.ndarray]]:
    """Set values per world by name: parameters of `Model.set_parameter`, "gravity", "velocity.BODY" (with ".x", ".y",
    ".z" for a component), and "control.NAME".

    Returns:
        The initial state; values of controls by name.

    Raises:
        ModelError: an unknown name, or a value out of range.
    """
    state, controls = model.state(), dict[str, np.ndarray]()
    vectors: dict[str, np.ndarray] = {}
    for name, given in columns.items():
        try:
            values = np.array(given, dtype=float)
        except (TypeError, ValueError) as error:
            raise ModelError(f"{name}: expected numbers, got {given[0]!r}") from error
        first, _, rest = name.partition(".")
        if first == "control":
            controls[rest] = values
        elif first in ("gravity", "velocity"):
            whole, _, axis = name.rpartition(".") if name[-2:] in (".x", ".y", ".z") else (name, "", "")
            if values.shape[1:] != (() if axis else (3,)):
                raise ModelError(f"{name}: expected {'a number' if axis else 'three numbers'}, got {given[0]!r}")
            if whole not in vectors:
                vectors[whole] = np.tile(np.asarray(start_vector(model, state, whole), float), (model.worlds, 1))
            vectors[whole][:, list("xyz").index(axis) if axis else slice(None)] = values
        else:
            model.set_parameter(name, values)
    for whole, each in vectors.items():
        if whole == "gravity":
            model.set_gravity(each)
        else:
            rows = position_slots(model, whole)
            velocity = state.velocity.numpy()
            velocity[:, rows] = each[:, None]
            state.velocity.assign(velocity)
    return state, controls


def start_vector(model: Any, state: Any, whole: str) -> Any:
    """Gravity of a model, or the initial velocity of a body's first node. ModelError."""
    if whole == "gravity":
        return model.description.gravity
    return state.velocity.numpy()[0, position_slots(model, whole)[0]]


def position_slots(model: Any, whole: str) -> np.ndarray:
    """Slots of the positions of the body in "velocity.BODY". ModelError."""
    bodies = {body.name: body for body in model.bodies}
    name = whole.partition(".")[2]
    if name not in bodies:
        known = f"bodies are {', '.join(bodies)}{did_you_mean(name, bodies)}"
        raise ModelError(f"{whole}: expected velocity.BODY or velocity.BODY.x; {known}")
    return np.arange(model.slots)[bodies[name].slot_range][bodies[name].slot_kind == 0]


def failed_rows(study: Study, indices: list[int], status: str, reason: str) -> Rows:
    """Rows of designs that have no result."""
    return Rows(list(indices), {name: [None] * len(indices) for name in study.measures}, status=status, reason=reason)


def describe(error: BaseException) -> str:
    """Reason of a failure in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
