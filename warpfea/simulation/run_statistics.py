"""Run statistics and last step report, read lazily in asynchronous runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from ..base.errors import ConstraintError, ConvergenceError
from ..kernels.step.episodes import RUN_STATISTICS
from ..kernels.step.step_control import REPORT_COLUMNS, STATUS
from .failures import step_error
from .reports import StepReport

__all__ = ["RunStatistics"]

COUNTED_TOTALS = ("newton", "pcg", "rough", "floored")
"""Keys of `totals`: Newton and PCG iterations, steps accepted above the tolerance, and at the round-off limit."""
COUNT_COLUMNS = ("newton", "pcg", "halvings", "status", "failure", "outer")
"""Columns of a report that are whole numbers."""
LARGEST = ("residual", "floor", "violation")
"""Columns whose largest values are kept."""


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
        self.sim.energy_growth.warn_once(self.sim, sums[:, RUN_STATISTICS.index("energy_growth")], stacklevel=5)
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
        self.sim.energy_growth.warn_once(self.sim, last.energy_growth)
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
        status = self.sim.state.status.numpy()
        status[status == STATUS["failed"]] = STATUS["running"]
        self.sim.state.status.assign(status)
        self._failed_worlds[:] = False
        return error
