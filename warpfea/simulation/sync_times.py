"""Synchronisation times of adaptive worlds: interval multiples, frames, kinks of time laws, end of run."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from .discontinuities import kink_times

if TYPE_CHECKING:
    from ..time_laws import TimeLaw

__all__ = ["SyncTimes"]

DEFAULT_INTERVAL_COUNT = 64
"""Default number of intervals per run."""
FRAME_INTERVAL = 1.0 / 60.0
"""Default interval of steps without a run, s: one animation frame."""
TIME_TOL = 1e-9
"""Relative tolerance of equal times, over an interval; at least `TIME_TOL_ROUNDINGS` roundings of the time."""
TIME_TOL_ROUNDINGS = 64.0
"""Smallest tolerance of equal times, in units in the last place of the time."""


class SyncTimes:
    """Synchronisation schedule; defaults follow from the longest run and are checkpointed.

    Attributes:
        interval: largest time between synchronisation points, s.
        horizon: time over which the error accumulates, s.
        origin: s; synchronisation points are whole numbers of intervals from it.
        end: end of the run, s; a synchronisation point.
        fixed_times: (n,) s: kinks of time laws, and single output times.
        output_rates: 1/s, of outputs with frames at its multiples.
    """

    def __init__(self, laws: Iterable[TimeLaw], interval: float | None, horizon: float | None) -> None:
        self.given_options = interval, horizon
        self.interval = self.horizon = math.nan
        self.origin, self.end = 0.0, math.inf
        found = [kink_times(law, 0.0) for law in laws]  # both ends of a jump
        self.kink_times = self.fixed_times = np.unique(np.concatenate([*found, np.zeros(0)]))
        self.output_rates: list[float] = []

    @property
    def is_set(self) -> bool:
        """True if interval and horizon are known."""
        return math.isfinite(self.interval)

    def begin_run(self, now: float, end: float) -> None:
        """Set the defaults before a run from `now` to `end`, both s, if it is the longest so far."""
        if not self.is_set or end - now > (1.0 + TIME_TOL) * self.horizon:
            self.set_defaults(now, end)

    def set_defaults(self, now: float, end: float | None = None) -> None:
        """Set interval and horizon from a run from `now` to `end`, both s, or for steps without a run.

        The interval divides that of the frames, which then coincide with synchronisation points.
        """
        interval, horizon = self.given_options
        if end is None:
            interval = interval or min(FRAME_INTERVAL, horizon or FRAME_INTERVAL)
        self.horizon = horizon or (DEFAULT_INTERVAL_COUNT * (interval or FRAME_INTERVAL) if end is None else end - now)
        self.origin = now
        if interval is None:
            interval = ((now if end is None else end) - now) / DEFAULT_INTERVAL_COUNT
            if self.output_rates:
                frame = 1.0 / max(self.output_rates)
                interval = frame / math.ceil(frame / interval - TIME_TOL)
                self.origin = 0.0
        self.interval = interval

    def add_outputs(self, outputs: Iterable[Any]) -> None:
        """Add the times of a run's outputs."""
        rates = [getattr(out, "rate", None) for out in outputs]
        self.output_rates = [rate for rate in rates if rate]
        output_times = [time for out in outputs for time in getattr(out, "output_times", ())]
        self.fixed_times = np.unique(np.concatenate([self.kink_times, np.array(output_times, dtype=float)]))

    def load(self, interval: float, horizon: float, origin: float) -> None:
        """Restore the schedule of a checkpoint."""
        self.interval, self.horizon, self.origin = interval, horizon, origin

    def next_after(self, time: float) -> float:
        """Next synchronisation point after a time, s."""
        soon = time + self._time_tolerance(time)
        steps = [(self.origin, self.interval), *((0.0, 1.0 / rate) for rate in self.output_rates)]
        found = [origin + (math.floor((soon - origin) / step) + 1) * step for origin, step in steps]
        found += self.fixed_times[self.fixed_times > soon][:1].tolist()
        if self.end > soon:
            found.append(self.end)
        return float(min(found))

    def time_to_next(self, times: np.ndarray) -> np.ndarray:
        """Time to the next synchronisation point (B,), s; bitwise equal for full intervals."""
        known = {time: self.next_after(time) - time for time in set(times.tolist())}
        whole = self.interval
        return np.array(
            [whole if 4.0 * abs(known[t] - whole) <= self._time_tolerance(t) else known[t] for t in times.tolist()]
        )

    def _time_tolerance(self, time: float) -> float:
        """Tolerance, s, of times equal to `time`.

        Raises:
            ModelError: an interval below the round-off of the time.
        """
        rounded = TIME_TOL_ROUNDINGS * math.ulp(time)
        if 2.0 * rounded > self.interval:
            raise ModelError(
                f"dt = 'auto': interval {self.interval:g} s is below the round-off of t = {time:g} s: use a longer one"
            )
        return max(TIME_TOL * self.interval, rounded)

    def count_between(self, now: float, end: float) -> int:
        """Number of synchronisation points from `now` to `end`, both s, the end included."""
        self._time_tolerance(end)  # checks the interval
        self.end = end
        total = 0
        while now < end - self._time_tolerance(now):
            now = self.next_after(now)
            total += 1
        return total
