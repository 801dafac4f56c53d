"""Sweep: designs as worlds and tasks, done by an engine, recorded as they end, derived as one table."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import hashlib
import itertools
import json
import os
import pathlib
import tempfile
import time as clock
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.checks import check_positive, is_count, is_number
from ..base.console import progress_bar
from ..base.devices import find_device
from ..base.errors import CheckpointError, Error, ModelError, OutputError
from ..base.names import check_choice
from ..base.provenance import versions
from ..base.writer import make_folder, write_atomically
from ..builder.scene import Scene, split_name
from ..model.model import MANY_WORLDS
from ..simulation.integrators import find_integrator
from .design import Design, check_keys
from .engines import Engine, WorkerLost, make_engine
from .measures import RECORDS, file_of, parse_measures, source_of
from .record import Record
from .result import SweepResult, write_tables
from .worker import (
    MOTION_OPTIONS,
    STATIC_OPTIONS,
    Outcome,
    Study,
    check_names,
    describe,
    failed_rows,
    find_scene,
    solve,
    solver_of,
)  # fmt: skip

__all__ = ["RUN_OPTIONS", "sweep"]

RUN_OPTIONS = tuple(dict.fromkeys(["device", "dtype", "static", "t_end", *MOTION_OPTIONS, *STATIC_OPTIONS]))
"""Keys of `run`."""
MAX_DEATHS = 3
"""Deaths of its worker after which a design is listed and left."""
TIMES = ("design", "seconds", "worlds", "alone")
"""Columns of times.csv beside the task's worker and seconds."""
BATCH = {False: 1024, True: 65536}
"""Largest number of worlds of a task, on the CPU and on CUDA."""


@dataclass(frozen=True)
class Task:
    """Designs that share a model. arguments: of the scene. indices: of the designs."""

    arguments: dict[str, Any]
    indices: list[int]


def sweep(
    scene: str | Scene[Any],
    design: Any,
    *,
    measures: Mapping[str, Any],
    series: Mapping[str, str] | None = None,
    parameters: Mapping[str, Any] | None = None,
    run: Mapping[str, Any] | None = None,
    out: str | pathlib.Path | None = None,
    resume: bool = False,
    worlds: int | None = None,
    engine: Engine | int | str | Callable[[str], Engine] | None = None,
    progress: bool | None = None,
) -> SweepResult:
    """Run a scene for each design, over worlds, processes, GPUs or machines.

    Designs that differ only in values per world share a model, as its worlds. The bits of a design's results depend
    neither on batch, worker nor engine, on one kind of device.

    Args:
        scene: name, file.py:NAME, or a Scene of a file.
        design: a Design, a list of {name: value}, or a table as in TOML. Names are parameters of the scene, each value
            of which is another model, or values per world: those of `Model.set_parameter` ("bar.E"), "gravity",
            "velocity.BODY" (the initial one), both also ".x", ".y", ".z", and "control.NAME".
        measures: by name, "[last|max|min|mean] KIND.NAME...": "probe.tip.displacement.z", "contact.pad.normal_force",
            "joint.elbow.force.norm", "field.von_mises[.BODY]" (max over nodes, at the end), "energy.strain"; or a
            function of the simulation that returns (worlds,), of a file, or its text "file.py:function".
        series: such texts of probes, contacts and joints, whose values of every step are kept.
        parameters: of the scene, for all designs.
        run: "t_end" and options of Simulation ("dt", "integrator", "tol", ...), by default the scene's; or static=True
            and those of `solve_static`; "device", "dtype".
        out: folder of its files; None: a temporary one, for the life of the result.
        resume: go on with the record in the folder, if there is one.
        worlds: largest number of worlds of a task.
        engine: number of processes, address of a dask scheduler ("tcp://host:8786"), an engine, or a function that
            makes one for a device ("cpu", "cuda", "cuda:1"), closed at the end; None: a process per GPU, or per core.
        progress: show a bar; None: if stderr is a terminal.

    Raises:
        ModelError: an unknown name or option, or a function that workers can't import.
        CheckpointError: a record that is damaged or of another sweep.
        OutputError: a file that can't be written.
    """
    points = Design.of(design)
    study = _make_study(scene, points, measures, series or {}, dict(parameters or {}), dict(run or {}))
    if worlds is not None and not (is_count(worlds) and worlds > 0):
        raise ModelError(f"worlds = {worlds!r} must be a positive whole number")
    keep = tempfile.TemporaryDirectory(prefix="warpfea_sweep_") if out is None else None
    folder = make_folder(out or keep.name)  # type: ignore[union-attr]
    record = Record(folder / "record.jsonl", _settings(study, points), resume=resume)
    began, seconds = clock.perf_counter(), {"start": 0.0, "run": 0.0}
    try:
        if not record.done.all():
            device = str(study.run["device"])
            used = engine(device) if callable(engine) else make_engine(engine, device)
            if device.startswith("cuda") and getattr(used, "gpus", True) == ():
                raise ModelError("engine has no GPU: give PoolEngine(gpus=[0, ...]), or run={'device': 'cpu'}")
            seconds["start"] = clock.perf_counter() - began
            try:
                tasks = _tasks(study, points, record, worlds or BATCH["cuda" in study.run["device"]], used.workers)
                driver = _Driver(study, points, record, folder, used, tasks)
                driver.check()
                driver.run(progress)
            except BaseException:
                if used is engine and hasattr(used, "reset"):
                    used.reset()
                raise
            finally:
                if used is not engine:
                    used.close()
        result = SweepResult(folder, points, study, record, keep)
        write_tables(result)
    finally:
        record.close()
    seconds["run"] = clock.perf_counter() - began - seconds["start"]
    result.seconds = seconds
    return result


# preparation


def _make_study(
    scene: Any, points: Design, measures: Any, series: Mapping[str, Any], fixed: dict[str, Any], run: dict[str, Any]
) -> Study:
    """Settings for workers. ModelError for names that don't fit."""
    if isinstance(scene, Scene):
        module = scene.function.__module__
        own = not module.startswith("warpfea.scenes.")
        scene = f"{file_of('scene', scene.function, scene.function.__qualname__)}:{scene.name}" if own else scene.name
    file, name = split_name(scene)
    where = scene if file is None else f"{pathlib.Path(file).resolve()}:{name}"
    source = "" if file is None else source_of(where)
    found = find_scene(where, source)
    label = scene if file is None else f"{pathlib.Path(file).resolve()}:{found.name}"
    check_keys("run", run, RUN_OPTIONS)
    check_keys("parameters", fixed, list(found.parameters))
    chosen = parse_measures("measures", measures)
    curves = parse_measures("series", series) if series else {}
    for name, curve in curves.items():
        check_choice(f"series.{name}: the kind", curve.kind, tuple(RECORDS))
        if name in ("time", "file"):
            raise ModelError(f"series.{name}: the name {name!r} is taken, choose another")
    for name in chosen:
        if name in points.columns or name in ("design", "status", "reason"):
            raise ModelError(f"measures.{name}: the table has a column {name!r} already")
    device = find_device(run.get("device"))
    given = str(run.get("device") or "")
    run = run | {"device": (given or "cuda") if device.is_cuda else "cpu"}
    study = Study(label, fixed, chosen, curves, run, len(points) >= MANY_WORLDS, source)
    for name in points.columns.keys() & fixed.keys():
        raise ModelError(f"parameters.{name} is a parameter of the design, too")
    _check_run(study)
    for name in points.columns:
        if "." not in name and name != "gravity":
            check_keys("design.over", {name: None}, [*found.parameters, "gravity"])
        parameter = found.parameters.get(name)
        if parameter is None or parameter.kind not in (int, float):
            continue
        column = points.columns[name]
        for _, value in dict.fromkeys(zip(map(type, column), column)):
            if not is_number(value) or (parameter.kind is int and value != int(value)):
                hint = ": samples take whole = true" if is_number(value) else ""
                raise ModelError(f"design.over.{name}: {value!r} is not of type {parameter.kind_name}{hint}")
    return study


def _check_run(study: Study) -> None:
    """ModelError for options that no design could run with."""
    static = bool(study.run.get("static"))
    known = ("device", "dtype", "static", *(STATIC_OPTIONS if static else ("t_end", *MOTION_OPTIONS)))
    check_keys("run", study.run, known)
    check_choice("run.dtype", study.run.get("dtype", "float64"), ("float64", "float32"))
    check_positive("run", **{k: v for k, v in study.run.items() if k in ("dt", "t_end", "tol") and v != "auto"})
    if not static:
        find_integrator(study.run.get("integrator", "backward_euler"))
        solver_of(study.run.get("solver", "newton-pcg"), study.run.get("tol"))


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _settings(study: Study, points: Design) -> dict[str, Any]:
    """Settings by which a record knows its sweep; files by name and content, not by place."""
    file, name = split_name(study.scene)
    texts = {name: (m.text, m.kind == "function") for name, m in study.measures.items()}
    return {
        "scene": name if file is None else f"{pathlib.Path(file).name}:{name}",
        "sources": {"scene": study.source} | {f"measures.{k}": m.source for k, m in study.measures.items() if m.source},
        "parameters": study.fixed,
        "names": list(points.columns),
        "designs": len(points),
        "design_hash": _hash(json.dumps(points.columns).encode()),
        "measures": {name: pathlib.Path(text).name if own else text for name, (text, own) in texts.items()},
        "series": {name: measure.text for name, measure in study.series.items()},
        "run": study.run | {"device": study.run["device"].partition(":")[0]},
        "many": study.many,
        "versions": {name: versions()[name] for name in ("warpfea", "warp")},
    }


def _tasks(study: Study, points: Design, record: Record, batch: int, workers: int) -> deque[Task]:
    """Tasks of the designs that are left: those with equal arguments, dealt over the workers, in batches."""
    scene = find_scene(study.scene, study.source)
    names = [name for name in points.columns if name in scene.parameters]
    groups: dict[tuple[str, ...], list[int]] = {}
    keys = list(zip(*(map(repr, points.columns[name]) for name in names))) or [()] * len(points)
    for index in np.flatnonzero(~record.done).tolist():
        groups.setdefault(keys[index], []).append(index)
    tasks: deque[Task] = deque()
    for indices in groups.values():
        arguments = {name: points.columns[name][indices[0]] for name in names}
        size = min(batch, max(1, -(-len(indices) // workers)))
        tasks.extend(Task(arguments, indices[k : k + size]) for k in range(0, len(indices), size))
    return tasks


# the loop


class _Driver:
    """Loop of a sweep: as many tasks at a time as there are workers."""

    def __init__(
        self, study: Study, points: Design, record: Record, folder: pathlib.Path, engine: Engine, tasks: deque[Task]
    ) -> None:
        self.study, self.points, self.record, self.folder = study, points, record, folder
        self.engine, self.tasks = engine, tasks

    def check(self) -> None:
        """Check names in a worker, as building a model may fail. ModelError."""
        first = self.tasks[0]
        ends = dataclasses.replace(first, indices=[first.indices[0], first.indices[-1]])
        handle = self._submit(check_names, ends)
        while handle not in self.engine.done([handle]):
            pass
        try:
            self.engine.result(handle)
        except Error:
            raise
        except Exception:  # the task itself will tell
            return

    def run(self, progress: bool | None) -> None:
        """Do all tasks."""
        running: dict[Any, Task] = {}
        total, done = len(self.points), int(self.record.done.sum())
        self._write_times([])
        with progress_bar("sweep", "design", total, progress) as bar:
            bar.update(done)
            ended: deque[tuple[Task, Outcome]] = deque()
            try:
                while self.tasks or running or ended:
                    while self.tasks and len(running) < self.engine.workers:
                        task = self.tasks.popleft()
                        running[self._submit(solve, task)] = task
                    while ended:  # while workers go on
                        task, outcome = ended.popleft()
                        self._keep(task, outcome)
                        own = [outcome.rows.columns[name] for name in TIMES]
                        of_task = itertools.repeat(outcome.worker), itertools.repeat(outcome.seconds)
                        self._write_times(zip(*own, *of_task))
                    bar.set_postfix_str(f"{len(self.record.failures)} failed", refresh=False)
                    bar.update(int(self.record.done.sum()) - bar.n)
                    for handle in self.engine.done(list(running)) if running else ():
                        task = running.pop(handle)
                        try:
                            ended.append((task, self.engine.result(handle)))
                        except WorkerLost:
                            self._lose(task, "died")
                        except Error:
                            raise
                        except Exception as error:  # of its machine
                            self._lose(task, "failed", f": {describe(error)}")
            finally:
                for task, outcome in ended:  # left by an error
                    with contextlib.suppress(Error):
                        self._keep(task, outcome)

    def _write_times(self, rows: Iterable[Sequence[Any]]) -> None:
        """Add rows to times.csv. OutputError."""
        target = self.folder / "times.csv"
        try:
            with open(target, "a", encoding="utf-8", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                if file.tell() == 0:
                    writer.writerow([*TIMES, "worker", "task_seconds"])
                writer.writerows(rows)
        except OSError as error:
            raise OutputError(f"{target}: can't be written ({error})") from error

    def _submit(self, call: Callable[..., Any], task: Task) -> Any:
        columns = {
            name: [values[k] for k in task.indices]
            for name, values in self.points.columns.items()
            if name not in task.arguments
        }
        return self.engine.submit(call, self.study, task.arguments, task.indices, columns)

    def _lose(self, task: Task, how: str, why: str = "") -> None:
        """Halve a task whose worker died or failed; a design that kills it thrice alone is listed."""
        index = task.indices[0]
        self.record.append({"lost": index, "worlds": len(task.indices)})
        if len(task.indices) > 1:
            half = len(task.indices) // 2
            self.tasks.extendleft(
                [Task(task.arguments, task.indices[half:]), Task(task.arguments, task.indices[:half])]
            )
            return
        if self.record.deaths[index] < MAX_DEATHS:
            self.tasks.append(task)
            return
        reason = f"its worker {how} {MAX_DEATHS} times{why}"
        self.record.append(rows=failed_rows(self.study, [index], "killed", reason))

    def _keep(self, task: Task, outcome: Outcome) -> None:
        """Write the rows of a task, after their series and plan."""
        lines = []
        if outcome.plan is not None:
            found = {"plan": outcome.plan, "device": outcome.device}
            key = _hash(json.dumps(task.arguments, sort_keys=True).encode())
            known = self.record.plans.get(key)
            if known is None:
                lines.append({"group": key, **found})
            elif known != json.loads(json.dumps(found)):
                raise CheckpointError(f"{self.record.path}: worker {outcome.worker} takes {found}, others took {known}")
        for design, series in zip(outcome.rows.columns["design"], outcome.rows.columns["series"]):
            if series:
                target = make_folder(self.folder / "series") / f"{design:06d}.npz"
                write_atomically(target, _save(series))
        self.record.append(*lines, rows=outcome.rows)


def _save(series: Mapping[str, np.ndarray]) -> Callable[[pathlib.Path], None]:
    def write(path: pathlib.Path) -> None:
        with open(path, "wb") as file:
            np.savez(file, **series)  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())  # before its line in the record

    return write
