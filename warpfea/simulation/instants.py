"""Common instants of adaptive worlds: multiples of an interval, frames, kinks of time laws, the end of the run."""

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
"""Intervals of a run, if none is given."""
FRAME = 1.0 / 60.0
"""Interval of steps without a run, s: a frame of animations."""
SLACK = 1e-9
"""Part of an interval within which two times are one; at least `ROUNDED` roundings of the time."""
ROUNDED = 64.0


class Instants:
    """When worlds meet. What is not given is settled by the first run or step, and by each run that is longer than the
    horizon; it is part of checkpoints.

    Attributes:
        interval: s between common instants, at most.
        horizon: s, over which the error may build up.
        origin: s; instants are whole numbers of intervals from it.
        end: s, of the run; an instant.
        fixed: (n,) s: kinks of time laws, and single times of outputs.
        rates: 1/s, of outputs with frames at whole numbers over it.
    """

    def __init__(self, laws: Iterable[TimeLaw], interval: float | None, horizon: float | None) -> None:
        self.given = interval, horizon
        self.interval = self.horizon = math.nan
        self.origin, self.end = 0.0, math.inf
        found = [kinks(law, 0.0) for law in laws]  # both ends of what is a jump to a step
        self.kinks = self.fixed = np.unique(np.concatenate([*found, np.zeros(0)]))
        self.rates: list[float] = []

    @property
    def settled(self) -> bool:
        """Whether interval and horizon are known."""
        return math.isfinite(self.interval)

    def begin_run(self, now: float, end: float) -> None:
        """Before a run from `now` to `end`, both s: settle what is not given where the run is the longest yet."""
        if not self.settled or end - now > (1.0 + SLACK) * self.horizon:
            self.settle(now, end)

    def settle(self, now: float, end: float | None = None) -> None:
        """Take interval and horizon from a run from `now` to `end`, both s, or from steps without one.

        The interval is a whole part of that of the frames, which then need no instants of their own.
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
        """Take the times of a run's outputs."""
        rates = [getattr(out, "rate", None) for out in outputs]
        self.rates = [rate for rate in rates if rate]
        moments = [time for out in outputs for time in getattr(out, "moments", ())]
        self.fixed = np.unique(np.concatenate([self.kinks, np.array(moments, dtype=float)]))

    def load(self, interval: float, horizon: float, origin: float) -> None:
        """Take them from a checkpoint."""
        self.interval, self.horizon, self.origin = interval, horizon, origin

    def after(self, time: float) -> float:
        """The first instant after a time, s."""
        soon = time + self._slack(time)
        steps = [(self.origin, self.interval), *((0.0, 1.0 / rate) for rate in self.rates)]
        found = [origin + (math.floor((soon - origin) / step) + 1) * step for origin, step in steps]
        found += self.fixed[self.fixed > soon][:1].tolist()
        if self.end > soon:
            found.append(self.end)
        return float(min(found))

    def spans(self, times: np.ndarray) -> np.ndarray:
        """How far it is to the next instant from times (B,), s; a whole interval has always the same bits."""
        known = {time: self.after(time) - time for time in set(times.tolist())}
        whole = self.interval
        return np.array([whole if 4.0 * abs(known[t] - whole) <= self._slack(t) else known[t] for t in times.tolist()])

    def _slack(self, time: float) -> float:
        """s, within which another time is the same as `time`.

        Raises:
            ModelError: the interval is not above the rounding of the time.
        """
        rounded = ROUNDED * math.ulp(time)
        if 2.0 * rounded > self.interval:
            raise ModelError(
                f"dt = 'auto': an interval of {self.interval:g} s at t = {time:g} s is within its rounding; "
                "take a longer one"
            )
        return max(SLACK * self.interval, rounded)

    def count(self, now: float, end: float) -> int:
        """Instants from `now` to `end`, both s, the end included."""
        self._slack(end)  # refuses before it counts
        self.end = end
        total = 0
        while now < end - self._slack(now):
            now = self.after(now)
            total += 1
        return total
