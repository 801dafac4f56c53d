"""Reports of a step, records of probes, joints and contacts over time, and run statistics, read lazily in asynchronous
runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..base.errors import ConstraintError, ConvergenceError, ModelError
from ..base.short_repr import use_short_repr
from ..base.worlds import set_rows
from ..kernels.step.episodes import RUN_STATISTICS
from ..kernels.step.step_control import REPORT_COLUMNS, STATUS
from .failures import step_error

__all__ = [
    "ContactRecord",
    "JointRecord",
    "PendingReport",
    "ProbeRecord",
    "RunStatistics",
    "StepReport",
    "idle_report",
    "simulation_table",
    "simulation_text",
    "step_text",
]

COUNTED_TOTALS = ("newton", "pcg", "rough", "floored")
"""Keys of `totals`: Newton and PCG iterations, steps accepted above the tolerance, and at the round-off limit."""
COUNT_COLUMNS = ("newton", "pcg", "halvings", "status", "failure", "outer")
"""Columns of a report that are whole numbers."""
LARGEST = ("residual", "floor", "violation")
"""Columns whose largest values are kept."""


@dataclass(frozen=True, eq=False)
class StepReport:
    """Report of a step, each an array [world].

    Attributes:
        converged: the step was accepted with its residual within the solver's tolerance, or above it at the round-off
            limit with the error `floor`. With wf.Jacobi a world may continue unconverged: False with status 0.
        floor: estimated error of the step's increment if round-off stopped the residual, relative to the solution, in
            the energy norm and in float32 also of displacements; the true one is at most three times it. 0 if the
            tolerance was reached.
        newton, pcg: iterations, rejected attempts included; Jacobi's count as newton.
        residual: |g| over the largest force, of the last attempt.
        halvings: rejected attempts.
        status: 0 running, 1 failed and frozen in the state before the failed step, 2 frozen by the user.
        min_J: smallest det F at quadrature points, for laws that need J > 0 also at the vertices. A value <= 0 at a
            quadrature point is an inverted element, see `inversion` of Simulation.
        time: s.
        residual_force: |g| over the free components, N, of the last attempt.
        violation: largest constraint violation, m.
        energy_growth: net energy gain of the integrator since the start, over the largest kinetic + strain + contact
            energy plus the sum of |work|; 0 if not monitored.
        penetration: largest depth of a contact point in the step, over the size of the smallest element of its contact
            (edge of a face, or depth of the element behind it, on both bodies); 0 without contact.
        outer: multiplier updates; with multipliers="newton" one per Newton iteration.
        stable: statics at full load: objects True, False, or None if unknown (reason: `StaticResult.stability`). None
            in place of the array without a stability analysis.
        substeps, rejected: dt="auto": accepted substeps, and those rejected for their estimated error, which count
            among the halvings; least_h, largest_h: their sizes, s. None with a fixed dt.
    """

    converged: np.ndarray
    newton: np.ndarray
    pcg: np.ndarray
    residual: np.ndarray
    halvings: np.ndarray
    status: np.ndarray
    min_J: np.ndarray
    time: np.ndarray
    failure: np.ndarray
    violation: np.ndarray
    outer: np.ndarray
    residual_force: np.ndarray
    floor: np.ndarray
    energy_growth: np.ndarray
    penetration: np.ndarray
    substeps: np.ndarray | None = None
    rejected: np.ndarray | None = None
    least_h: np.ndarray | None = None
    largest_h: np.ndarray | None = None
    stable: np.ndarray | None = None

    __repr__ = use_short_repr


class PendingReport(StepReport):
    """Report read from the device on first access to one of its arrays.

    Raises:
        ModelError: the simulation has stepped since without a read.
    """

    def __init__(self, sim: Any, number: int) -> None:
        object.__setattr__(self, "_source", (sim, number))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        sim, number = self._source
        if sim.steps != number:
            raise ModelError(
                f"report of step {number} is no longer available (simulation at step {sim.steps}): read it "
                "before the next step"
            )
        report = sim.last
        for entry in fields(StepReport):
            object.__setattr__(self, entry.name, getattr(report, entry.name))
        return object.__getattribute__(self, name)

    def __repr__(self) -> str:
        return f"PendingReport(step {self._source[1]})"


@dataclass(frozen=True, eq=False)
class JointRecord:
    """Joint over time: time (steps,), or (worlds, steps) with times per world; force (worlds, steps, 3), N, and moment
    about its anchor, N m, on the child in world axes; violation (worlds, steps), m, the largest of its rows."""

    time: np.ndarray
    force: np.ndarray
    moment: np.ndarray
    violation: np.ndarray

    __repr__ = use_short_repr


@dataclass(frozen=True, eq=False)
class ContactRecord:
    """Contact over time, arrays (worlds, steps); time (steps,), or (worlds, steps) with times per world.

    Attributes:
        time: s.
        force, moment: on the body in world axes, moment about the world's origin; (worlds, steps, 3), N and N m.
        normal_force: sum of normal force magnitudes, N. In a halved step this, force and moment are means over the
            step, which conserves the impulse.
        penetration: largest depth in the step, m.
        slip: slip length in the step, m, and stick: sticking fraction at its end; means over the area in contact.
        area: reference area in contact at the end of the step, m^2; at an edge it includes points of adjacent faces.
        stored: elastic energy of the contact at the end of the step, J.
        loss, friction: energy dissipated in the step by restitution and by friction, J.
        collider_work: work of the moving collider on the body in the step, J.
    """

    time: np.ndarray
    force: np.ndarray
    moment: np.ndarray
    normal_force: np.ndarray
    penetration: np.ndarray
    slip: np.ndarray
    area: np.ndarray
    stick: np.ndarray
    stored: np.ndarray
    loss: np.ndarray
    friction: np.ndarray
    collider_work: np.ndarray

    __repr__ = use_short_repr


@dataclass(frozen=True, eq=False)
class ProbeRecord:
    """Probe over time: time (steps,), or (worlds, steps) with times per world, s; position, displacement and velocity
    (worlds, steps, 3), in m and m/s."""

    time: np.ndarray
    position: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray

    __repr__ = use_short_repr


def idle_report(sim: Any) -> StepReport:
    """Report of a simulation without a step since construction or resumption."""
    count = sim.model.worlds
    zero, none = np.zeros(count, int), np.zeros(count)
    counts = (zero, zero, none, zero, sim.status, none, sim.time, zero, none, zero)
    return StepReport(sim.status == 0, *counts, none, none, none, none)


def step_text(dt: Any) -> str:
    """Step of all worlds, s, or their range, as text."""
    low, high = float(np.min(dt)), float(np.max(dt))
    return f"{low:g} s" if low == high else f"{low:g} to {high:g} s"


def simulation_text(sim: Any) -> str:
    """One-line description of a simulation."""
    m, steps = sim.model, sim.steps
    dt = step_text(sim.dt) if sim.error is None else f"auto, error = {sim.error:g}"
    at = f"t = {float(sim.time.max()):.6g} s, {steps} steps, dt = {dt}, {sim.integrator.name}"
    if sim.load is not None:
        at = f"static, load {100.0 * float(sim.load.max()):.4g} %, {steps} load step{'s' * (steps != 1)}"
    worlds = f", {m.worlds} worlds" if m.worlds > 1 else ""
    return f"Simulation({at}, {sim.methods['solver']}, {m.slots} slots, {m.device}, {m.dtype}{worlds})"


def simulation_table(sim: Any) -> dict[str, str]:
    """Readable state of a simulation by name."""
    totals = {name: int(sim.totals[name].sum()) for name in ("newton", "pcg", "floored", "rough")}
    static = sim.load is not None
    rows = {"load" if static else "time": f"{100.0 * sim.load.max():.4g} %" if static else f"{sim.time.max():.6g} s"}
    rows |= {"steps": str(sim.steps), "step": "" if static else step_text(sim.dt) if sim.error is None else "auto"}
    rows |= {"integrator": sim.integrator.label, "solver": sim.methods["solver"]}
    rows |= {"Newton iterations": str(totals["newton"]), "PCG iterations": str(totals["pcg"])}
    rows |= {"largest residual": f"{sim.max_residual:.3g}", "steps at round-off": str(totals["floored"] or "")}
    running = int((np.asarray(sim.status) == STATUS["running"]).sum())
    rows["worlds running"] = f"{running} of {sim.model.worlds}"
    if not static and sim.stepper.ledger:
        energies = {name: float(values[0]) for name, values in sim.energies().items()}
        rows |= {f"{name} energy": f"{energies[name]:.4g} J" for name in ("kinetic", "strain", "potential")}
    return rows


class SyncedAttribute:
    """Descriptor that synchronises device statistics before reading."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.key = f"_kept_{name}"

    def __get__(self, statistics: Any, owner: type) -> Any:
        if statistics is None:
            return self
        statistics.sync_from_device()
        return getattr(statistics, self.key)

    def __set__(self, statistics: Any, value: Any) -> None:
        setattr(statistics, self.key, value)


class RunStatistics:
    """Totals over steps, the last report, and recorded rows of a simulation.

    Attributes:
        steps: number of steps taken.
        last: report of the last step, None before the first.
        totals: iterations by world; "rough" and "floored" count steps.
        max_residual, max_floor, max_violation, min_J: extremes over all steps and worlds.
        asynchronous: steps without device reads: `record` is False, failed worlds are frozen, and neither step
            sizes nor initial accelerations are computed on the host; unsynced: steps since the last reading.
        times_differ: worlds have times of their own.
        stepped_worlds: (worlds,) True for worlds stepped since their state was set.
        history: recorded columns (worlds, columns) of each step.
        step_log: time (s), and largest numbers of Newton and PCG iterations and of halvings in any world, of each step.
    """

    last: Any = SyncedAttribute()
    totals: Any = SyncedAttribute()
    max_residual: Any = SyncedAttribute()
    max_floor: Any = SyncedAttribute()
    max_violation: Any = SyncedAttribute()
    min_J: Any = SyncedAttribute()
    stepped_worlds: Any = SyncedAttribute()
    history: Any = SyncedAttribute()

    def __init__(self, sim: Any, asynchronous: bool) -> None:
        B = sim.model.worlds
        self.sim, self.stepper = sim, sim.stepper
        self._penetration_columns = [term.penetration_columns() for term in sim.model.terms.contacts]
        self.asynchronous, self.unsynced, self.times_differ = asynchronous, False, False
        self.steps = 0
        self.last = None
        self.totals = {name: np.zeros(B, int) for name in COUNTED_TOTALS}
        if self.stepper.step_size_control:
            self.totals |= {name: np.zeros(B, int) for name in ("substeps", "rejected")}
        self.max_residual = self.max_floor = self.max_violation = 0.0
        self.min_J = math.inf
        self.stepped_worlds, self._failed_worlds = (np.zeros(B, dtype=bool) for _ in range(2))
        self.history = []
        self.step_log: list[tuple[float, ...]] = []

    def sync_from_device(self) -> None:
        """Read the device statistics of the steps since the last reading."""
        if not self.unsynced:
            return
        self.unsynced = False
        sums, stepped = self.stepper.episodes.read_totals()
        rows = self.stepper.work.report.numpy()
        self.last = self._make_report(rows)
        for name in COUNTED_TOTALS:
            self.totals[name] += sums[:, RUN_STATISTICS.index(name)].astype(int)
        self._add_extremes({name: sums[:, RUN_STATISTICS.index(name)] for name in (*LARGEST, "min_J")})
        growth = sums[:, RUN_STATISTICS.index("energy_growth")]
        if np.max(growth) > self.sim.energy_growth.warn_threshold:
            self.sim.energy_growth.warn(self.sim, growth, stacklevel=5)
        self.stepped_worlds = stepped
        if self._records_columns:
            self.history = [self._recorded_row(rows)]

    def _add_extremes(self, values: Mapping[str, np.ndarray]) -> None:
        """Include values by column in the extremes."""
        for name in LARGEST:
            setattr(self, f"max_{name}", max(getattr(self, f"max_{name}"), float(values[name].max())))
        self.min_J = min(self.min_J, float(values["min_J"].min()))

    def clear_stepped(self, mask: np.ndarray) -> None:
        """Mark worlds as not stepped since their state was set."""
        self.stepped_worlds[mask] = False
        self.stepper.episodes.clear_stepped(mask)

    def _make_report(self, rows: np.ndarray) -> StepReport:
        """Report of a step from its columns (worlds, columns)."""
        column = {name: rows[:, k].copy() for k, name in enumerate(REPORT_COLUMNS)}
        column |= {name: column[name].astype(int) for name in COUNT_COLUMNS}
        column["converged"] = (column["status"] == STATUS["running"]) & (column["rough"] == 0.0)
        column["penetration"] = np.zeros(len(rows))
        for columns, sizes in self._penetration_columns:
            column["penetration"] = np.maximum(column["penetration"], (rows[:, columns] / sizes).max(axis=1))
        known = {entry.name: column[entry.name] for entry in fields(StepReport) if entry.name in column}
        control = self.stepper.step_size_control
        return StepReport(**known, **(control.step_statistics() if control else {}))

    def add_step(self, rows: np.ndarray) -> None:
        """Accumulate the statistics of a step (worlds, columns); raise for failed worlds if requested."""
        last = self.last = self._make_report(rows)
        failed = last.status == STATUS["failed"]
        fresh, self._failed_worlds = failed & ~self._failed_worlds, failed
        self.steps += 1
        good = last.status == STATUS["running"]
        self.stepped_worlds |= good
        self.stepped_worlds &= last.status != STATUS["failed"]
        totals = self.totals
        if self.stepper.step_size_control:
            totals["substeps"] += last.substeps
            totals["rejected"] += last.rejected
        if self.sim.record:
            counts = (last.newton, last.pcg, last.halvings)
            self.step_log.append((float(last.time.max()), *(float(values.max()) for values in counts)))
        totals["newton"] += last.newton
        totals["pcg"] += last.pcg
        totals["rough"] += good & ~last.converged
        totals["floored"] += good & (last.floor > 0.0)
        if good.any():
            self._add_extremes({name: getattr(last, name)[good] for name in (*LARGEST, "min_J")})
        if self._records_columns:
            if not self.sim.record:
                self.history.clear()
            self.history.append(self._recorded_row(rows))
        if np.max(last.energy_growth) > self.sim.energy_growth.warn_threshold:
            self.sim.energy_growth.warn(self.sim, last.energy_growth)
        if fresh.any():
            fatal = self.sim.on_failure == "raise" or (self.sim.on_failure is None and not good.any())
            if fatal:
                if not good.any():  # no world advanced
                    self.steps -= 1
                    if self._records_columns:
                        self.history.pop()
                raise self._failure_error(int(np.flatnonzero(fresh)[0]))

    def _recorded_row(self, rows: np.ndarray) -> np.ndarray:
        """Recorded columns of a report: time, probes, and term columns, NaN for worlds that did not step."""
        row = rows[:, [REPORT_COLUMNS.index("time"), *range(len(REPORT_COLUMNS), rows.shape[1])]].copy()
        row[~self.stepped_worlds, 1 + 6 * len(self.sim.model.description.probes) :] = np.nan
        return row

    @property
    def _records_columns(self) -> bool:
        """True if any quantity is recorded per step."""
        return self.sim.model.terms.report_width > len(REPORT_COLUMNS)

    def _failure_error(self, world: int) -> ConvergenceError | ConstraintError:
        """Error of a failed world; its status is cleared so that a caller may retry with another dt."""
        error = step_error(self.sim, world)
        status = self.sim.state.status
        set_rows(status, status.numpy() == STATUS["failed"], STATUS["running"])
        self._failed_worlds[:] = False
        return error
