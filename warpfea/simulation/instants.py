"""Synchronisation times of adaptive worlds: interval multiples, frames, kinks of time laws, end of run."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from .kinks import kinks

if TYPE_CHECKING:
    from ..laws import TimeLaw

__all__ = ["Instants"]

PARTS = 64
"""Default number of intervals per run."""
FRAME = 1.0 / 60.0
"""Default interval of steps without a run, s: one animation frame."""
SLACK = 1e-9
"""Relative tolerance of equal times, over an interval; at least `ROUNDED` roundings of the time."""
ROUNDED = 64.0


class Instants:
    """Synchronisation schedule; defaults follow from the longest run and are checkpointed.

    Attributes:
        interval: largest time between synchronisation points, s.
        horizon: time over which the error accumulates, s.
        origin: s; synchronisation points are whole numbers of intervals from it.
        end: end of the run, s; a synchronisation point.
        fixed: (n,) s: kinks of time laws, and single output times.
        rates: 1/s, of outputs with frames at its multiples.
    """

    def __init__(self, laws: Iterable[TimeLaw], interval: float | None, horizon: float | None) -> None:
        self.given = interval, horizon
        self.interval = self.horizon = math.nan
        self.origin, self.end = 0.0, math.inf
        found = [kinks(law, 0.0) for law in laws]  # both ends of a jump
        self.kinks = self.fixed = np.unique(np.concatenate([*found, np.zeros(0)]))
        self.rates: list[float] = []

    @property
    def settled(self) -> bool:
        """True if interval and horizon are known."""
        return math.isfinite(self.interval)

    def begin_run(self, now: float, end: float) -> None:
        """Set the defaults before a run from `now` to `end`, both s, if it is the longest so far."""
        if not self.settled or end - now > (1.0 + SLACK) * self.horizon:
            self.settle(now, end)

    def settle(self, now: float, end: float | None = None) -> None:
        """Set interval and horizon from a run from `now` to `end`, both s, or for steps without a run.

        The interval divides that of the frames, which then coincide with synchronisation points.
        """
        interval, horizon = self.given
        if end is None:
            interval = interval or min(FRAME, horizon or FRAME)
        self.horizon = horizon or (PARTS * (interval or FRAME) if end is None else end - now)
        self.origin = now
        if interval is None:
            interval = ((now if end is None else end) - now) / PARTS
            if self.rates:
                frame = 1.0 / max(self.rates)
                interval = frame / math.ceil(frame / interval - SLACK)
                self.origin = 0.0
        self.interval = interval

    def follow(self, outputs: Iterable[Any]) -> None:
        """Add the times of a run's outputs."""
        rates = [getattr(out, "rate", None) for out in outputs]
        self.rates = [rate for rate in rates if rate]
        moments = [time for out in outputs for time in getattr(out, "moments", ())]
        self.fixed = np.unique(np.concatenate([self.kinks, np.array(moments, dtype=float)]))

    def load(self, interval: float, horizon: float, origin: float) -> None:
        """Restore the schedule of a checkpoint."""
        self.interval, self.horizon, self.origin = interval, horizon, origin

    def after(self, time: float) -> float:
        """Next synchronisation point after a time, s."""
        soon = time + self._slack(time)
        steps = [(self.origin, self.interval), *((0.0, 1.0 / rate) for rate in self.rates)]
        found = [origin + (math.floor((soon - origin) / step) + 1) * step for origin, step in steps]
        found += self.fixed[self.fixed > soon][:1].tolist()
        if self.end > soon:
            found.append(self.end)
        return float(min(found))

    def spans(self, times: np.ndarray) -> np.ndarray:
        """Time to the next synchronisation point (B,), s; bitwise equal for full intervals."""
        known = {time: self.after(time) - time for time in set(times.tolist())}
        whole = self.interval
        return np.array([whole if 4.0 * abs(known[t] - whole) <= self._slack(t) else known[t] for t in times.tolist()])

    def _slack(self, time: float) -> float:
        """Tolerance, s, of times equal to `time`.

        Raises:
            ModelError: an interval below the round-off of the time.
        """
        rounded = ROUNDED * math.ulp(time)
        if 2.0 * rounded > self.interval:
            raise ModelError(
                f"dt = 'auto': interval {self.interval:g} s is below the round-off of t = {time:g} s: use a longer one"
            )
        return max(SLACK * self.interval, rounded)

    def count(self, now: float, end: float) -> int:
        """Number of synchronisation points from `now` to `end`, both s, the end included."""
        self._slack(end)  # checks the interval
        self.end = end
        total = 0
        while now < end - self._slack(now):
            now = self.after(now)
            total += 1
        return total
