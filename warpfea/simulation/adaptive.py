"""Adaptive time steps (dt="auto"): launches of kernels/step/adaptive.py, option checks, and synchronisation times:
interval multiples, frames, kinks of time laws, end of run."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.checks import is_number, number_hint
from ..base.errors import ModelError
from ..kernels.step.adaptive import CONTROL_STATE, STEP_STATISTICS, adaptive_kernels, adaptive_struct
from ..solvers.newton import MACHINE_EPSILON, NewtonPCG
from .discontinuities import kink_times
from .integrators import INTEGRATORS, Integrator

if TYPE_CHECKING:
    from ..model.model import Model
    from ..terms.term import StepContext
    from ..time_laws import TimeLaw

__all__ = ["AdaptiveOptions", "StepSizeControl", "SyncTimes", "adaptive_options", "algebraic_tolerance"]

MIN_ERROR = {"float64": 1e-9, "float32": 1e-5}
"""Smallest admissible error over the model's size; below it round-off is significant."""
MAX_ALGEBRAIC_FRACTION = 0.1
"""Largest default tolerance of Newton's method, over the requested error."""
FIRST_STEP_RATIO = 0.125
"""First substep over horizon error^(1/order)."""
DEFAULT_INTERVAL_COUNT = 64
"""Default number of intervals per run."""
FRAME_INTERVAL = 1.0 / 60.0
"""Default interval of steps without a run, s: one animation frame."""
TIME_TOL = 1e-9
"""Relative tolerance of equal times, over an interval; at least `TIME_TOL_ROUNDINGS` roundings of the time."""
TIME_TOL_ROUNDINGS = 64.0
"""Smallest tolerance of equal times, in units in the last place of the time."""


@dataclass(frozen=True)
class AdaptiveOptions:
    """Options of adaptive time stepping.

    Attributes:
        error: tolerance, over the model's size.
        interval: largest time between synchronisation points, s; None: a 64th of the longest run so far, 1/60 s without
            a run.
        horizon: time over which the error accumulates, s; None: the longest run so far, 64 intervals without a run.
    """

    error: float
    interval: float | None = None
    horizon: float | None = None


def adaptive_options(
    dt: Any, error: Any, interval: Any, horizon: Any, *, model: Model, scheme: Integrator, solver: Any
) -> AdaptiveOptions | None:
    """Options of dt = "auto"; None for a number.

    Raises:
        ModelError: a value out of range, one without dt = "auto", or a scheme or solver without adaptive steps.
    """
    given = {"error": error, "interval": interval, "horizon": horizon}
    if not isinstance(dt, str):
        for name, value in given.items():
            if value is not None:
                raise ModelError(f"{name} = {value!r} is for dt = 'auto', and dt is {dt!r}")
        return None
    if dt != "auto":
        raise ModelError(f"dt = {dt!r} must be a positive finite time (s), or 'auto'{number_hint(dt)}")
    if not (is_number(error) and 0.0 < error < 1.0):
        raise ModelError(
            f"dt = 'auto' needs error, over the model's size, between 0 and 1, such as 1e-4; got {error!r}"
        )
    for name in ("interval", "horizon"):
        value = given[name]
        if value is not None and not (is_number(value) and value > 0.0):
            raise ModelError(f"{name} = {value!r} must be a positive finite time (s)")
    if scheme.error_weights is None:
        able = [name for name, known in INTEGRATORS.items() if known.error_weights is not None]
        raise ModelError(
            f"dt = 'auto': integrator {scheme.name!r} has no estimate of its error; there are {', '.join(able)}"
        )
    if not isinstance(solver, NewtonPCG):
        raise ModelError(
            "dt = 'auto' needs solver 'newton-pcg': with Jacobi the algebraic error hides the time discretisation error"
        )
    least = MIN_ERROR[model.dtype]
    if error < least:
        finer = "; use float64" if model.dtype == "float32" else ""
        raise ModelError(f"error = {error!r} is below {model.dtype} round-off ({least:g} of the model size){finer}")
    return AdaptiveOptions(float(error), interval, horizon)


def algebraic_tolerance(solver: Any, options: AdaptiveOptions | None, dtype: str) -> Any:
    """Solver options whose default tolerance is at most a tenth of the error of dt = "auto".

    Otherwise residuals accepted in float32 look like local errors, which shorter steps do not reduce.
    """
    if options is None or solver.tol is not None:
        return solver
    return replace(solver, tol=min(solver.tolerance(dtype), MAX_ALGEBRAIC_FRACTION * options.error))


def _displacement_factors(model: Model) -> np.ndarray:
    """Lever arm (slots,), m, that converts an unknown to displacement: 1 for positions, half the section for gradients
    across beams and shells, 0 for gradients whose motion the adjacent positions represent."""
    out = model.slot_table.is_position.astype(float)
    mass = model.masses.matrix.diagonal()
    for body in model.bodies:
        sets = body.family.slot_sets
        for kind in sets.get("section", sets.get("director", ())):
            slot = body.slots[model.slot_table.kind[body.slots] == kind]
            out[slot] = np.sqrt(3.0 * mass[slot] / mass[slot - kind])  # for a uniform section
    return out


class StepSizeControl:
    """Step size control per world with common synchronisation times set by the host.

    Attributes:
        error: tolerance, over the model's size.
        sync_times: synchronisation times.
    """

    def __init__(
        self, ctx: StepContext, v_before: wp.array, scheme: Integrator, options: AdaptiveOptions, *, max_tries: int
    ) -> None:
        model, work = ctx.model, ctx.work
        self.model, self.work, self.launch = model, work, ctx.launch
        self.velocity, self.v_before, self.error, self.order = ctx.state.velocity, v_before, options.error, scheme.order
        self.sync_times = SyncTimes(model.terms.time_laws.laws, options.interval, options.horizon)
        self.kernels = adaptive_kernels(model.dtype, scheme)
        self.dim = (model.worlds, model.slots)
        self.displacement_factor = model.array("adaptive", _displacement_factors(model), model.types.T)
        shapes = {"statistics": (model.worlds, len(STEP_STATISTICS)), "horizon": (1,), "first_substep": (1,)}
        self.control: Any = work.struct(adaptive_struct(), model.worlds, skip=("control_state",), **shapes)
        self.control.control_state = ctx.state.register("adaptive", wp.float64, (len(CONTROL_STATE),))
        self.mean_rates = ctx.state.register("adaptive_means", model.types.vec3, (model.slots,))
        self.control.tolerance = options.error * float(model.size)
        self.control.eps = MACHINE_EPSILON[model.dtype]
        self.control.max_retries = max_tries

    def set_interval(self, time: np.ndarray) -> None:
        """Set the interval to the next synchronisation point before a step from times (B,), s."""
        sync_times = self.sync_times
        if not sync_times.is_set:
            sync_times.set_defaults(float(time.min()))
        self.control.horizon.fill_(sync_times.horizon)
        self.control.first_substep.fill_(FIRST_STEP_RATIO * sync_times.horizon * self.error ** (1.0 / self.order))
        self.work.step.dt.assign(sync_times.time_to_next(time))

    def count_steps(self, now: float, end: float, outputs: Iterable[Any]) -> int:
        """Number of steps of a run from `now` to `end`, both s, with outputs; -1 for an empty run."""
        if end < now:
            return -1
        self.sync_times.add_outputs(outputs)
        if end > now:
            self.sync_times.begin_run(now, end)
        return self.sync_times.count_between(now, end) if end > now else 0

    def begin_interval(self) -> None:
        """Set the substep size from the state, after the kernel `begin_step`."""
        self.launch(self.kernels.begin_step_control, self.model.worlds, [self.work.step, self.control])

    def check_local_error(self) -> None:
        """Estimate the local error of converged attempts; reject those above tolerance (before the kernel
        `end_attempt`)."""
        m, w, k, ctl, launch = self.model, self.work, self.kernels, self.control, self.launch
        launch(k.begin_estimate, m.worlds, [w.step, w.newton, ctl])
        args = [w.step, ctl, self.displacement_factor, m.topology.free]
        args += [w.u, w.v, self.velocity, self.v_before, self.mean_rates]
        launch(k.max_error_rates, self.dim, args)
        launch(k.control_step_size, m.worlds, [w.step, w.newton, w.pcg, ctl])

    def finish_attempt(self) -> None:
        """Compute mean rates and the size of the next substep, after the kernel `end_attempt` and before acceptance."""
        w, launch = self.work, self.launch
        args = [w.step, self.control, w.v, self.velocity, self.v_before, self.mean_rates]
        launch(self.kernels.update_mean_rates, self.dim, args)
        launch(self.kernels.refine_substeps, self.model.worlds, [w.step, self.control])

    def end_interval(self) -> None:
        """Finish the interval before the report."""
        self.launch(self.kernels.report_pcg_iterations, self.model.worlds, [self.work.pcg, self.control])

    def smallest_resolved_error(self, world: int) -> float:
        """Smallest tolerance, over the model's size, that round-off lets the estimates meet; 0 if they meet theirs."""
        round_off_ratio = float(self.control.round_off_ratio.numpy()[world])
        return round_off_ratio * self.error if round_off_ratio > 1.0 else 0.0

    def step_statistics(self) -> dict[str, np.ndarray]:
        """Counts of the last step, each (B,), see STEP_STATISTICS."""
        rows = self.control.statistics.numpy()
        return {name: rows[:, k].astype(int if k < 2 else float) for k, name in enumerate(STEP_STATISTICS)}


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
