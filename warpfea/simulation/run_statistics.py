"""Run statistics and last step report, read lazily in asynchronous runs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..base.errors import ConstraintError, ConvergenceError
from ..kernels.step.episodes import RUN_STATISTICS
from ..kernels.step.step_control import REPORT_COLUMNS, STATUS
from ..solvers import SolverPlan
from .energy_growth import EnergyGrowth
from .failures import step_error
from .records import Records
from .reports import StepReport

__all__ = ["RunStatistics"]

COUNTED_TOTALS = ("newton", "pcg", "rough", "floored")
"""Keys of `totals`: Newton and PCG iterations, steps accepted above the tolerance, and at the round-off limit."""


class SyncedAttribute:
    """Descriptor that synchronises device statistics before reading."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.key = f"_kept_{name.lstrip('_')}"

    def __get__(self, sim: Any, owner: type) -> Any:
        if sim is None:
            return self
        sim._sync_from_device()
        return getattr(sim, self.key)

    def __set__(self, sim: Any, value: Any) -> None:
        setattr(sim, self.key, value)


class RunStatistics(Records):
    """Totals over steps, the last report, and records.

    Attributes:
        steps: number of steps taken.
        last: report of the last step, None before the first.
        totals: iterations by world; "rough" and "floored" count steps.
        max_residual, max_floor, max_violation, min_J: extremes over all steps and worlds.
        asynchronous: steps without device reads: `record` is False, failed worlds are frozen, and neither step
            sizes nor initial accelerations are computed on the host.
    """

    last: Any = SyncedAttribute()
    totals: Any = SyncedAttribute()
    max_residual: Any = SyncedAttribute()
    max_floor: Any = SyncedAttribute()
    max_violation: Any = SyncedAttribute()
    min_J: Any = SyncedAttribute()
    _stepped_worlds: Any = SyncedAttribute()
    _failed_worlds: np.ndarray
    _history: Any = SyncedAttribute()
    on_failure: str | None
    record: bool
    energy_growth: EnergyGrowth

    @property
    def methods(self) -> dict[str, str]:
        """Methods chosen for "auto": "solver", and for NewtonPCG "linear", "operator" and "preconditioner"."""
        return self.plan.methods

    @property
    def plan(self) -> SolverPlan:
        """Methods of the linear systems, chosen or given; `plan=` of another simulation takes them."""
        return self.stepper.newton.plan

    def _reset_statistics(self, asynchronous: bool) -> None:
        B = self.model.worlds
        self.asynchronous, self._unsynced, self._times_differ = asynchronous, False, False
        self.steps = 0
        self.last = None
        self.totals = {name: np.zeros(B, int) for name in COUNTED_TOTALS}
        if self.stepper.step_size_control:
            self.totals |= {name: np.zeros(B, int) for name in ("substeps", "rejected")}
        self.max_residual = self.max_floor = self.max_violation = 0.0
        self.min_J = math.inf
        self._stepped_worlds, self._failed_worlds = (np.zeros(B, dtype=bool) for _ in range(2))
        self._history = []

    def _sync_from_device(self) -> None:
        """Read the device statistics of the steps since the last reading."""
        if not self._unsynced:
            return
        self._unsynced = False
        sums, stepped = self.stepper.episodes.read_totals()
        rows = self.stepper.work.report.numpy()
        self.last = self._make_report(rows)
        for name in COUNTED_TOTALS:
            self.totals[name] += sums[:, RUN_STATISTICS.index(name)].astype(int)
        for name in ("residual", "floor", "violation"):
            key = f"max_{name}"
            setattr(self, key, max(getattr(self, key), float(sums[:, RUN_STATISTICS.index(name)].max())))
        self.min_J = min(self.min_J, float(sums[:, RUN_STATISTICS.index("min_J")].min()))
        self.energy_growth.warn_once(self, sums[:, RUN_STATISTICS.index("energy_growth")])
        self._stepped_worlds = stepped
        if self._records_columns:
            self._history = [self._history_row(rows)]

    def _clear_stepped(self, mask: np.ndarray) -> None:
        """Mark worlds as not stepped since their state was set."""
        self._stepped_worlds[mask] = False
        self.stepper.episodes.clear_stepped(mask)

    def _make_report(self, rows: np.ndarray) -> StepReport:
        """Report of a step from its columns (worlds, columns)."""
        column = {name: rows[:, k].copy() for k, name in enumerate(REPORT_COLUMNS)}
        status = column["status"].astype(int)
        return StepReport(
            converged=(status == STATUS["running"]) & (column["rough"] == 0.0),
            newton=column["newton"].astype(int),
            pcg=column["pcg"].astype(int),
            residual=column["residual"],
            halvings=column["halvings"].astype(int),
            status=status,
            min_J=column["min_J"],
            time=column["time"],
            failure=column["failure"].astype(int),
            violation=column["violation"],
            outer=column["outer"].astype(int),
            residual_force=column["residual_force"],
            floor=column["floor"],
            energy_growth=column["energy_growth"],
            **(self.stepper.step_size_control.step_statistics() if self.stepper.step_size_control else {}),
        )

    def _record_step(self, rows: np.ndarray) -> None:
        """Accumulate the statistics of a step (worlds, columns); raise for failed worlds if requested."""
        last = self.last = self._make_report(rows)
        failed = last.status == STATUS["failed"]
        fresh, self._failed_worlds = failed & ~self._failed_worlds, failed
        self.steps += 1
        good = last.status == STATUS["running"]
        self._stepped_worlds |= good
        self._stepped_worlds &= last.status != STATUS["failed"]
        totals = self.totals
        if self.stepper.step_size_control:
            totals["substeps"] += last.substeps
            totals["rejected"] += last.rejected
        totals["newton"] += last.newton
        totals["pcg"] += last.pcg
        totals["rough"] += good & ~last.converged
        totals["floored"] += good & (last.floor > 0.0)
        if good.any():
            self.max_residual = max(self.max_residual, float(last.residual[good].max()))
            self.max_floor = max(self.max_floor, float(last.floor[good].max()))
            self.max_violation = max(self.max_violation, float(last.violation[good].max()))
            self.min_J = min(self.min_J, float(last.min_J[good].min()))
        if self._records_columns:
            if not self.record:
                self._history.clear()
            self._history.append(self._history_row(rows))
        self.energy_growth.warn_once(self, last.energy_growth)
        if fresh.any():
            fatal = self.on_failure == "raise" or (self.on_failure is None and not good.any())
            if fatal:
                if not good.any():  # no world advanced
                    self.steps -= 1
                    if self._records_columns:
                        self._history.pop()
                raise self._failure_error(int(np.flatnonzero(fresh)[0]))

    def _history_row(self, rows: np.ndarray) -> np.ndarray:
        """Recorded columns of a report: time, probes, and term columns, NaN for worlds that did not step."""
        row = rows[:, [REPORT_COLUMNS.index("time"), *range(len(REPORT_COLUMNS), rows.shape[1])]].copy()
        row[~self._stepped_worlds, 1 + 6 * len(self.model.description.probes) :] = np.nan
        return row

    @property
    def _records_columns(self) -> bool:
        """True if any quantity is recorded per step."""
        return self.model.terms.report_width > len(REPORT_COLUMNS)

    def _failure_error(self, world: int) -> ConvergenceError | ConstraintError:
        """Error of a failed world; its status is cleared so that a caller may retry with another dt."""
        error = step_error(self, world)
        status = self.state.status.numpy()
        status[status == STATUS["failed"]] = STATUS["running"]
        self.state.status.assign(status)
        self._failed_worlds[:] = False
        return error
