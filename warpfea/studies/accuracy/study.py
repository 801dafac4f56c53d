"""Error against run time of a scene: sweep, reference, rows."""

import math
import pathlib
import statistics
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ...base.checks import check_positive
from ...base.console import progress_bar, quiet_warp
from ...base.devices import find_device
from ...base.errors import ModelError
from ...base.names import did_you_mean, listing
from ...base.writer import make_folder
from ...builder.builder import ModelBuilder
from ...builder.reference import Reference, make_reference, read_reference
from ...builder.scene import Scene, locate
from ...builder.scene import scene as as_scene
from .finer import finer_motion, finer_setting
from .measure import DONE, REFUSED, Outcome
from .measure import measure as run_once
from .motion import RESOLVED_RATIO, ROUND_OFF_ERROR, Motion, known_motion, motion_errors
from .options import StudyOptions, refuse_moved_keywords
from .report import Row, Study, with_orders, with_pareto
from .settings import SWEEP_OPTIONS, Setting, SweepAxes, method_text, setting_product, sweep_axes
from .split import split_error
from .store import OutcomeStore, code_version

__all__ = ["study"]

CHECK_FACTORS = (0.9, 1.1)
"""Factors on the step of the answer for its reruns."""
FINER_RUN = "run"
"""As `reference`: a finer run, even for a scene with a known motion."""


@refuse_moved_keywords
def study(
    scene: Scene[Any] | Callable[..., ModelBuilder] | str,
    *,
    over: Mapping[str, Sequence[Any]] | None = None,
    methods: Sequence[str] | None = None,
    error: Sequence[float] | None = None,
    parameters: Mapping[str, Any] | None = None,
    dt: float | None = None,
    t_end: float | None = None,
    solver: str = "newton-pcg",
    tol: float | None = None,
    dtype: str = "float64",
    device: str | None = None,
    probes: Sequence[str] | None = None,
    options: StudyOptions | None = None,
) -> Study:
    """Run a scene with every combination of settings; error and run time of each.

    Args:
        scene: a scene, the name of one or file.py[:NAME], or a function returning a ModelBuilder (with dt and
        t_end).
        over: lists of values by name: "dt", "tol", "solver" ("newton-pcg", "jacobi", "direct"), "dtype", "device",
            "method", "error", or a parameter of the scene.
        methods: as over["method"]: integrators or their names, "generalized_alpha(rho_inf=0.8)" with options.
        error: as over["error"]: runs with dt="auto" for each of these tolerances, besides those of fixed steps.
        parameters: of the scene, for all runs.
        dt, t_end, solver, tol, dtype, device: of runs, if not swept; by default the scene's.
        probes: used for the error; by default all, or those of the reference.
        options: reference, target, repeat, files and others, see StudyOptions.

    Returns:
        A Study: a sequence of rows, with `table()`, `answer` and `write(folder)`.

    Raises:
        ModelError: a bad setting, a scene without probes, an incompatible reference.
        ConvergenceError: the reference run failed.
        OutputError: a folder that is not writable.
        KeyboardInterrupt: after Ctrl-C; finished runs are kept in `out`.
    """
    options = options or StudyOptions()
    named, found = _resolve_scene(scene, dt, t_end)
    options = replace(options, what=options.what or named, name=options.name or found.name)
    sweep = dict(over or {})
    for option, many in (("methods", methods), ("error", error)):
        if many is not None:
            if option in sweep:
                raise ModelError(f"study: {option} is given twice")
            sweep[option] = many
    given = {"dt": dt, "t_end": t_end, "tol": tol}
    check_positive("study", **{name: value for name, value in given.items() if value is not None})
    axes = sweep_axes(found, sweep, options.mesh)
    values = dict(parameters or {})
    _check_names("parameter", values, found.parameters)
    _check_names("finer", options.finer or {}, [*SWEEP_OPTIONS, *found.parameters])
    swept = {axis: many[0] for axis, many in axes.over.items() if axis not in SWEEP_OPTIONS}
    base = Setting(
        method=method_text(found.integrator), dt=float(dt or found.dt), error=None, solver=solver,
        tol=tol if tol is not None else found.tol, dtype=dtype, device=str(find_device(device)),
        t_end=float(t_end or found.t_end), values=found.resolve(swept | values),
    )  # fmt: skip
    sweep_axes(found, {option: [base.get(option)] for option in ("solver", "dtype")}, None)
    settings = setting_product(base, axes)
    if options.measure == "field" and found.field is None:
        raise ModelError(f"study: scene {found.name!r} has no field whose error could count: @wf.scene(field=...)")
    known = _reference_function(options.reference, found, base, probes)
    with quiet_warp():
        _check_probes(found, settings[0], probes)
        folder = None if options.out is None else make_folder(options.out)
        store = OutcomeStore(folder and folder / f"{options.name}.points.jsonl", lambda dev: code_version(found, dev))
        return _StudyRunner(found, axes, store, options, known, probes, base).result(settings, folder)


def _resolve_scene(given: Any, dt: float | None, t_end: float | None) -> tuple[str, Scene[Any]]:
    """Scene, and its name on the command line."""
    if isinstance(given, str):
        return given, locate(given)
    if isinstance(given, Scene):
        return given.name, given
    if callable(given):
        if dt is None or t_end is None:
            raise ModelError(f"study of the function {given.__name__!r}: give dt and t_end, or decorate it as a scene")
        return given.__name__, as_scene(dt=dt, t_end=t_end)(given)
    raise ModelError(f"study: expected a scene, a function or a name, got {given!r}")


def _check_names(what: str, given: Iterable[str], known: Collection[str]) -> None:
    for name in given:
        if name not in known:
            raise ModelError(
                f"study: {what} {name!r} is unknown; there are {listing(known)}{did_you_mean(name, known)}"
            )


def _check_probes(scene: Scene[Any], setting: Setting, chosen: Sequence[str] | None) -> None:
    """ModelError for a scene without probes, and for unknown probes."""
    names = [p.name for p in scene.build(setting.values).description.probes]
    if not names:
        raise ModelError(
            f"scene {scene.name!r} has no probe, whose error a study needs: b.add_probe('tip', body.surface('x+'))"
        )
    if chosen is not None and not chosen:
        raise ModelError(f"study: probes = {chosen!r} are none; there are {listing(names)}")
    _check_names("probe", chosen or (), names)


def _reference_function(
    given: Any, scene: Scene[Any], base: Setting, probes: Sequence[str] | None
) -> Callable[[Setting], Reference | None]:
    """Function giving the known motion for the parameters of a setting; None if a finer run is needed."""
    if given == FINER_RUN:
        return lambda setting: None
    if given is None:
        return lambda setting: make_reference(scene.reference, setting.values)
    if isinstance(given, (str, pathlib.Path)):
        if not str(given).lower().endswith((".csv", ".json")):
            raise ModelError(f"study: reference {str(given)!r} is neither a file .csv or .json nor {FINER_RUN!r}")
        names = list(probes or [p.name for p in scene.build(base.values).description.probes][:1])
        read = read_reference(given, names[0] if names else "")
        return lambda setting: read
    fixed = make_reference(given, base.values)
    return lambda setting: fixed


def _cheapest_row(rows: Sequence[Row], target: float | None) -> Row | None:
    """Row with the smallest median time whose error, plus those of reference and mesh, is within the target."""
    good = [r for r in rows if target is not None and r.status == DONE and r.total_error <= target]
    return min(good, key=lambda r: r.seconds or 0.0) if good else None


@dataclass
class _StudyRunner:
    """Runs and evaluates a study."""

    scene: Scene[Any]
    axes: SweepAxes
    store: OutcomeStore
    options: StudyOptions
    known: Callable[[Setting], Reference | None]
    chosen: Sequence[str] | None
    base: Setting

    def result(self, settings: Sequence[Setting], folder: pathlib.Path | None) -> Study:
        """The study of all settings, written into the folder if there is one."""
        options, base = self.options, self.base
        assert options.name is not None
        assert options.what is not None
        try:
            rows, references, motions = self.rows(settings)
            rows = self.add_error_parts(rows, motions)
            answer = _cheapest_row(rows, options.target)
            checks = [] if answer is None else self.rerun_answer(answer, motions)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(self.store.summary()) from None
        command = None if answer is None else answer.setting.command(options.what, self.scene)
        run_options = {
            "t_end": base.t_end, "repeat": options.repeat, "limit": options.limit, "split": options.split,
            "parameters": base.values, "dt": base.dt, "tol": base.tol, "solver": base.solver, "dtype": base.dtype,
            "integrator": base.method, "probes": self.chosen,
        }  # fmt: skip
        found = Study(options.name, options.what, rows, self.axes, options.measure, options.target, references,
                      run_options, answer, command, checks)  # fmt: skip
        if folder is not None:
            found.write(folder, options.words or ["study", options.what])
        return found

    def run_extra(self, setting: Setting) -> Outcome:
        """Outcome of a setting besides the sweep."""
        self.bar.total = (self.bar.total or 0) + 1
        return self.run_setting(setting, 1, None)

    def run_setting(self, setting: Setting, repeat: int, limit: float | None) -> Outcome:
        """Outcome of a setting, run unless known."""
        found = self.store.get(setting, repeat, limit)
        if found is None:
            self.bar.set_postfix_str(_progress_text(setting, self.axes), refresh=True)
            found = run_once(self.scene, setting, repeat=repeat, limit=limit)
            self.store.put(setting, found)
        self.bar.update()
        return found

    def rows(self, settings: Sequence[Setting]) -> tuple[list[Row], list[dict[str, Any]], dict[str, Motion]]:
        """Rows of all settings; texts of the references; and the references by values of the physical parameters."""
        groups: dict[str, list[Setting]] = {}
        for setting in settings:
            groups.setdefault(self._problem_key(setting), []).append(setting)
        motions: dict[str, Motion] = {}
        references = []
        with progress_bar(self.scene.name, "run", len(settings), self.options.progress) as self.bar:
            outcomes = {}
            for name, group in groups.items():
                known = self.known(group[0])
                if known is None:
                    best = finer_setting(group, self.axes, self.options.finer or {}, self.base.dt or self.scene.dt)
                    motions[name] = finer_motion(best, self.axes, self.chosen, self.run_extra)
                for setting in group:
                    outcomes[id(setting)] = self.run_setting(setting, self.options.repeat, self.options.limit)
                done = [o for s in group if (o := outcomes[id(s)]).status == DONE]
                if known is not None and done:
                    motions[name] = known_motion(known, self.chosen, done[0], self.base.t_end)
                if name in motions:
                    m, values = motions[name], {k: group[0].get(k) for k in self.axes.physical}
                    references.append(
                        {"values": values, "about": m.about, "travel": m.travel, "own_error": m.own_error,
                         "runs": m.runs, "known": known is not None}
                    )  # fmt: skip
        found = [outcomes[id(s)] for s in settings]
        if all(o.status == REFUSED for o in found):
            raise ModelError(found[0].why)
        rows = [self._make_row(s, o, motions.get(self._problem_key(s))) for s, o in zip(settings, found)]
        return with_pareto(with_orders(rows, self.axes)), references, motions

    def _problem_key(self, setting: Setting) -> str:
        return repr([setting.get(name) for name in self.axes.physical])

    def _make_row(self, setting: Setting, outcome: Outcome, motion: Motion | None) -> Row:
        swept = {name: setting.get(name) for name in self.axes.over}
        n = outcome.cost
        row = Row(setting, swept, outcome.status, outcome.why)
        if n:
            names = ("compile_s", "setup_s", "steps", "newton", "pcg", "rough", "bytes", "unknowns", "elements")
            row = replace(
                row, seconds=statistics.median(n["seconds"]), seconds_min=min(n["seconds"]), repeats=len(n["seconds"]),
                **{name: n[name] for name in names},
            )  # fmt: skip
        if outcome.status != DONE or motion is None:
            return row
        errors: dict[str, Any] = motion_errors(outcome, motion)
        errors["energy"] = n["drift"] / n["exchanged"] if n["exchanged"] > 0.0 else None
        if n["exchanged"] > 0.0:
            errors["ledger"] = {name: change / n["exchanged"] for name, change in n["ledger"].items()}
        measure = self.options.measure
        error, own = errors[measure], motion.own_error.get(measure, 0.0)
        if error is None:
            needs = "a field=, and a reference that has one" if measure == "field" else "energy that is exchanged"
            raise ModelError(f"study: no error by {measure!r} of scene {self.scene.name!r}: it needs {needs}")
        digits = -math.log10(error * row.seconds) if error > 0.0 and row.seconds else None
        return replace(
            row, error=error, own_error=own, resolved=error >= max(RESOLVED_RATIO * own, ROUND_OFF_ERROR),
            efficacy=digits, **errors
        )  # fmt: skip

    def add_error_parts(self, rows: list[Row], motions: dict[str, Motion]) -> list[Row]:
        """Rows with the requested parts of the error, and the mesh error if the cheapest one depends on it."""
        while True:
            answer = _cheapest_row(rows, self.options.target)
            rows = self.split_rows(rows, motions, answer)
            answer = _cheapest_row(rows, self.options.target)
            parts = {} if answer is None or answer.mesh_error is not None else answer.split or {}
            space = parts.get("space")
            if answer is None or space is None or not self._in_time_only(answer):
                return rows
            values = answer.setting.values
            rows = [replace(r, mesh_error=space) if r.error is not None and r.setting.values == values else r
                    for r in rows]  # fmt: skip

    def _in_time_only(self, row: Row) -> bool:
        """True if the error of a row excludes that of the mesh, which can be estimated."""
        swept = any(name in self.axes.over for name in self.axes.mesh)
        return self.options.measure in ("l2", "end") and not swept and self.known(row.setting) is None

    def split_rows(self, rows: list[Row], motions: dict[str, Motion], answer: Row | None) -> list[Row]:
        """Rows with the requested parts of the error."""
        done = [r for r in rows if r.status == DONE and r.error is not None]
        which = self.options.split
        if which == "none" or not done or (answer is None and any(r.split is not None for r in rows)):
            return rows
        best = answer or max(done, key=lambda r: -math.inf if r.efficacy is None else r.efficacy)
        out = []
        with progress_bar("parts of the error", "run", show=self.options.progress) as self.bar:
            for row in rows:
                if row.error is not None and row.split is None and (which == "all" or row is best):
                    motion = motions[self._problem_key(row.setting)]
                    row = replace(row, split=split_error(row.setting, self.axes, motion, self.run_extra))
                out.append(row)
        return out

    def rerun_answer(self, answer: Row, motions: dict[str, Motion]) -> list[Row]:
        """Reruns of the answer with about 0.9 and 1.1 times its step or requested error; not repeated.

        Steps are rounded to divide the duration.
        """
        setting, found = answer.setting, []
        with progress_bar("target", "run", show=self.options.progress) as self.bar:
            for factor in CHECK_FACTORS:
                near = setting.with_changes({"error": factor * (setting.error or 0.0)})
                if setting.dt is not None:
                    steps = max(1, round(setting.t_end / (factor * setting.dt)))
                    near = setting.with_changes({"dt": setting.t_end / steps})
                found.append(self._make_row(near, self.run_extra(near), motions[self._problem_key(near)]))
        return found


def _progress_text(setting: Setting, axes: SweepAxes) -> str:
    """Short text of a run, for the bar."""
    step = f"dt={setting.dt:g}" if setting.dt is not None else f"error={setting.error:g}"
    more = [f"{name}={setting.values[name]}" for name in axes.over if name in setting.values]
    return " ".join([setting.method, step, *more])
