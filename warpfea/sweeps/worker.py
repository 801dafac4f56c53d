"""Work of a sweep's worker: designs that share a model, as worlds of one simulation."""

from __future__ import annotations

import dataclasses
import functools
import gc
import math
import os
import socket
import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

import warpfea as wf

from ..base.errors import CapacityError, Error, ModelError
from ..base.names import did_you_mean
from ..builder.scene import Scene, locate, split_name
from .measures import Measure, load_function, read_source

__all__ = ["FAILED_WORLD", "Group", "Outcome", "Row", "Study", "check_names", "find_scene", "solve", "solver_of"]

FAILURES = (Error, MemoryError, NotImplementedError)
"""Errors of a design, also those of the user's functions; others are of the machine, and end the worker."""
FAILED_WORLD = 1
"""Status of a world whose step was refused."""
STATIC_OPTIONS = ("load_steps", "tol", "stabilise", "inversion", "unstable", "constraint_tol")
MOTION_OPTIONS = (
    "dt", "error", "interval", "horizon", "integrator", "tol", "solver", "ledger", "inversion", "energy_growth",
    "constraint_tol",
)  # fmt: skip


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


class Row(NamedTuple):
    """Result of one design: its measures, or the reason why it has none.

    Attributes:
        design: its index. status: "done", "unconverged steps", "no value", "failed" or "killed".
        values: by measure. reason: of a failure.
        series: (steps,) by name, and "time".
        seconds: of its batch over the number of worlds. worlds: of that batch.
        alone: "" unless it failed among others and was run again: then "failed" or "done".
    """

    design: int
    status: str
    values: Mapping[str, float | None] = {}
    reason: str = ""
    series: Mapping[str, np.ndarray] = {}
    seconds: float = 0.0
    worlds: int = 1
    alone: str = ""


@dataclass(frozen=True)
class Outcome:
    """Result of a task.

    Attributes:
        rows: one of each design. plan: of the solver; None without a simulation.
        device: kind of device. worker: host and process. seconds: of the task.
    """

    rows: list[Row]
    plan: dict[str, Any] | None
    device: str
    worker: str
    seconds: float


def check_names(study: Study, arguments: dict[str, Any], designs: Sequence[tuple[int, dict[str, Any]]]) -> None:
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
            measure.check(f"{where}.{name}", group.builder)
    for last, (_, values) in enumerate(designs, 1 - len(designs)):
        try:
            set_values(model, {name: [value] for name, value in values.items()})
            return
        except ModelError as error:
            if last == 0:
                raise ModelError(f"design.over: {error}") from error


def solve(study: Study, arguments: dict[str, Any], designs: Sequence[tuple[int, dict[str, Any]]]) -> Outcome:
    """Run designs that share a model.

    Args:
        arguments: of the scene, the same for all.
        designs: index and values per world of each.
    """
    began = clock.perf_counter()
    if study.place["device"] != "cpu":
        gc.collect()  # memory of the task before
    rows, plan, device = _rows(study, arguments, list(designs))
    worker = f"{socket.gethostname()}:{os.getpid()}"
    return Outcome(rows, plan, device, worker, clock.perf_counter() - began)


def _rows(
    study: Study, arguments: dict[str, Any], designs: list[tuple[int, dict[str, Any]]]
) -> tuple[list[Row], dict[str, Any] | None, str]:
    """Rows, plan and device; its model and simulation are freed at the end."""
    try:
        scene = load(study)
    except ModelError as error:  # not of a design: the first worker could load it
        raise RuntimeError(str(error)) from error
    try:
        group = Group(study, scene, arguments)
    except FAILURES as error:  # the same for each of them
        return [Row(index, "failed", reason=describe(error)) for index, _ in designs], None, ""
    rows = group.solve(designs)
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

    def solve(self, designs: list[tuple[int, dict[str, Any]]]) -> list[Row]:
        """Rows of the designs, in batches that fit; a batch that fails as a whole is halved until one is left."""
        try:
            return self.batch(designs)
        except (CapacityError, MemoryError) as error:
            failure: Exception = error
            size = min(getattr(error, "worlds", 0), len(designs) - 1) or len(designs) // 2
        except FAILURES as error:
            failure, size = error, len(designs) // 2
        if not size:
            return [Row(designs[0][0], "failed", reason=describe(failure))]
        del failure  # its traceback holds the arrays of the batch
        gc.collect()
        chunks = [designs[k : k + size] for k in range(0, len(designs), size)]
        return [row for chunk in chunks for row in self.solve(chunk)]

    def batch(self, designs: list[tuple[int, dict[str, Any]]]) -> list[Row]:
        """Rows of designs as worlds of one simulation; failed worlds are run again alone."""
        began, study, worlds = clock.perf_counter(), self.study, len(designs)
        model = self.model(worlds)
        columns = {name: [values[name] for _, values in designs] for name in designs[0][1]}
        sim = self.simulate(model, columns, on_failure="freeze" if worlds > 1 else "raise")
        self.plan = dataclasses.asdict(sim.plan)
        self.device = model.device.name if model.device.is_cuda else "cpu"
        failed = sim.status == FAILED_WORLD
        measured = zip(*(np.asarray(measure(sim), dtype=float).tolist() for measure in study.measures.values()))
        series = {name: measure.series(sim) for name, measure in study.series.items()}
        times = next(iter(study.series.values())).times(sim) if series else np.zeros((worlds, 0))
        seconds, rows = (clock.perf_counter() - began) / worlds, []
        for world, ((index, _), found, rough) in enumerate(zip(designs, measured, sim.totals["rough"].tolist())):
            curves = {"time": times[world]} | {name: of[world] for name, of in series.items()} if series else {}
            rows.append(Row(index, *_quality(dict(zip(study.measures, found)), rough), curves, seconds, worlds))
        for world in np.flatnonzero(failed).tolist():
            (again,) = self.solve([designs[world]])
            rows[world] = again._replace(alone=again.status)
        return rows

    def simulate(
        self, model: Any, columns: dict[str, list[Any]], *, on_failure: str = "raise", outputs: Sequence[Any] = ()
    ) -> Any:
        """The finished simulation of worlds with the values of the columns."""
        run = {k: v for k, v in self.study.run.items() if k not in ("device", "dtype", "static", "t_end")}
        state, controls = set_values(model, columns)
        if self.study.run.get("static"):
            if controls:
                raise ModelError(f"{next(iter(controls))}: controls have their initial values in statics")
            return wf.solve_static(model, state=state, outputs=outputs, **run).simulation
        scene = self.scene
        solver, tol = run.pop("solver", "newton-pcg"), run.pop("tol", scene.tol)
        run = {"dt": scene.dt, "integrator": scene.integrator, "solver": solver_of(solver, tol)} | run
        record = bool(self.study.series) or any(measure.over_time for measure in self.study.measures.values())
        sim = wf.Simulation(model, state, record=record, on_failure=on_failure, on_compile=_silent, **run)
        for name, values in controls.items():
            sim.controls[name] = values
        sim.run(self.study.run.get("t_end", scene.t_end), outputs=outputs, progress=False)
        return sim


def _quality(values: dict[str, float], rough: int) -> tuple[str, Mapping[str, float | None], str]:
    """Status of a finished run, its values, None for those that are not finite, and what it lacks."""
    if not all(map(math.isfinite, values.values())):
        kept = {name: value if math.isfinite(value) else None for name, value in values.items()}
        return "no value", kept, f"{', '.join(name for name in kept if kept[name] is None)}: not finite"
    return ("unconverged steps", values, f"{rough} steps above the tolerance") if rough else ("done", values, "")


def _silent(done: int, total: int, name: str) -> None:
    """No bar for kernels in workers."""


def solver_of(name: str, tol: float | None) -> Any:
    """Options of a solver by its name and tolerance. ModelError."""
    from ..solvers import SOLVERS, solver_options

    solver_options(name)
    return SOLVERS[name](tol=tol)


def set_values(model: Any, columns: dict[str, list[Any]]) -> tuple[Any, dict[str, np.ndarray]]:
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
    return np.arange(model.slots)[bodies[name].slots][bodies[name].slot_kind == 0]


def describe(error: BaseException) -> str:
    """Reason of a failure in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
