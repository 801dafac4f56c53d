"""Run statistics and last step report, read lazily in asynchronous runs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..base.errors import ConstraintError, ConvergenceError
from ..kernels.step.control import REPORT, STATUS
from ..kernels.step.loops import TALLY
from .energy_growth import EnergyGrowth
from .failures import step_error
from .records import Records
from .reports import StepReport

__all__ = ["Digests"]

COUNTS = ("newton", "pcg", "rough", "floored")


class Fresh:
    """Descriptor that synchronises device statistics before reading."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.key = f"_kept_{name.lstrip('_')}"

    def __get__(self, sim: Any, owner: type) -> Any:
        if sim is None:
            return self
        sim._catch_up()
        return getattr(sim, self.key)

    def __set__(self, sim: Any, value: Any) -> None:
        setattr(sim, self.key, value)


class Digests(Records):
    """Totals over steps, the last report, and records.

    Attributes:
        steps: number of steps taken.
        last: report of the last step, None before the first.
        totals: iterations by world; "rough" and "floored" count steps.
        max_residual, max_floor, max_violation, min_J: extremes over all steps and worlds.
        quiet: asynchronous steps without device reads: `record` is False, failed worlds are frozen, and neither step
            sizes nor initial accelerations are computed on the host.
    """

    last: Any = Fresh()
    totals: Any = Fresh()
    max_residual: Any = Fresh()
    max_floor: Any = Fresh()
    max_violation: Any = Fresh()
    min_J: Any = Fresh()
    _stepped: Any = Fresh()
    _failed: np.ndarray
    _history: Any = Fresh()
    on_failure: str | None
    record: bool
    energy_growth: EnergyGrowth

    def _open_digest(self, quiet: bool) -> None:
        B = self.model.worlds
        self.quiet, self._unread, self._own_times = quiet, False, False
        self.steps = 0
        self.last = None
        self.totals = {name: np.zeros(B, int) for name in COUNTS}
        if self.stepper.adaptive:
            self.totals |= {name: np.zeros(B, int) for name in ("substeps", "rejected")}
        self.max_residual = self.max_floor = self.max_violation = 0.0
        self.min_J = math.inf
        self._stepped, self._failed = (np.zeros(B, dtype=bool) for _ in range(2))
        self._history = []

    def _catch_up(self) -> None:
        """Read the device statistics of the steps since the last reading."""
        if not self._unread:
            return
        self._unread = False
        sums, stepped = self.stepper.loops.take()
        rows = self.stepper.work.report.numpy()
        self.last = self._report_of(rows)
        for name in COUNTS:
            self.totals[name] += sums[:, TALLY.index(name)].astype(int)
        for name in ("residual", "floor", "violation"):
            key = f"max_{name}"
            setattr(self, key, max(getattr(self, key), float(sums[:, TALLY.index(name)].max())))
        self.min_J = min(self.min_J, float(sums[:, TALLY.index("min_J")].min()))
        self.energy_growth.tell(self, sums[:, TALLY.index("energy_growth")])
        self._stepped = stepped
        if self._recorded:
            self._history = [self._row(rows)]

    def _unstep(self, mask: np.ndarray) -> None:
        """Mark worlds as not stepped since their state was set."""
        self._stepped[mask] = False
        self.stepper.loops.unstep(mask)

    def _report_of(self, rows: np.ndarray) -> StepReport:
        """Report of a step from its columns (worlds, columns)."""
        column = {name: rows[:, k].copy() for k, name in enumerate(REPORT)}
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
            **(self.stepper.adaptive.counts() if self.stepper.adaptive else {}),
        )

    def _digest(self, rows: np.ndarray) -> None:
        """Accumulate the statistics of a step (worlds, columns); raise for failed worlds if requested."""
        last = self.last = self._report_of(rows)
        failed = last.status == STATUS["failed"]
        fresh, self._failed = failed & ~self._failed, failed
        self.steps += 1
        good = last.status == STATUS["running"]
        self._stepped |= good
        self._stepped &= last.status != STATUS["failed"]
        totals = self.totals
        if self.stepper.adaptive:
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
        if self._recorded:
            if not self.record:
                self._history.clear()
            self._history.append(self._row(rows))
        self.energy_growth.tell(self, last.energy_growth)
        if fresh.any():
            fatal = self.on_failure == "raise" or (self.on_failure is None and not good.any())
            if fatal:
                if not good.any():  # no world advanced
                    self.steps -= 1
                    if self._recorded:
                        self._history.pop()
                raise self._failure(int(np.flatnonzero(fresh)[0]))

    def _row(self, rows: np.ndarray) -> np.ndarray:
        """Recorded columns of a report: time, probes, and term columns, NaN for worlds that did not step."""
        row = rows[:, [REPORT.index("time"), *range(len(REPORT), rows.shape[1])]].copy()
        row[~self._stepped, 1 + 6 * len(self.model.probes) :] = np.nan
        return row

    @property
    def _recorded(self) -> bool:
        """True if any quantity is recorded per step."""
        return self.model.terms.report_width > len(REPORT)

    def _failure(self, world: int) -> ConvergenceError | ConstraintError:
        """Error of a failed world; its status is cleared so that a caller may retry with another dt."""
        error = step_error(self, world)
        status = self.state.status.numpy()
        status[status == STATUS["failed"]] = STATUS["running"]
        self.state.status.assign(status)
        self._failed[:] = False
        return error
