"""Errors of runs against a known motion.

    l2   sqrt(sum w_i |x(t_i) - x_ref(t_i)|^2 / sum w_i) / L,  w_i = t_i - t_{i-1}
    end  |x(t_n) - x_ref(t_n)| / L

with L the largest travel of a chosen probe in the reference. t_i are the ends of the run's own steps, or the sample
times of the reference: between steps a run is interpolated by cubics through its positions and velocities (fourth
order in the step, exact at the ends of steps).
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.errors import ModelError
from ...base.names import did_you_mean, listing
from ...base.usercode import convert_user_errors
from ...builder.reference import Reference
from .measure import Outcome

__all__ = ["Motion", "known_motion", "motion_errors", "observed_order", "run_motion"]

TRAVEL_SAMPLES = 1001
"""Number of times at which the travel of a reference function is evaluated."""
END_TIME_TOL = 1e-9
"""Tolerance, relative to the end time, for samples at the end of the run."""
RESOLVED_RATIO = 10.0
"""Minimum ratio of an error to that of the reference."""
ROUND_OFF_ERROR = 1e-13
"""Round-off level: smaller errors have no order."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Reference motion of the errors.

    Attributes:
        about: description.
        probes: by name: a function of times (n,) returning positions (n, 3).
        times: the only known times (n,), s; None: all.
        travel: L, m.
        own_error: its own error by measure, over L (field: over the field's norm).
        field: expected value of the scene's `field`; None: unknown.
        runs: observed orders and differences behind own_error, for the file.
    """

    about: str
    probes: dict[str, Callable[[np.ndarray], np.ndarray]]
    times: np.ndarray | None
    travel: float
    own_error: dict[str, float]
    field: np.ndarray | None = None
    runs: dict[str, Any] = dataclasses.field(default_factory=dict)


def interpolant(times: np.ndarray, x: np.ndarray, v: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Cubics through positions and velocities (n, 3)."""
    from scipy.interpolate import CubicHermiteSpline

    return CubicHermiteSpline(times, x, v) if len(times) > 1 else lambda t: np.repeat(x, len(t), axis=0)


def known_motion(reference: Reference, chosen: Sequence[str] | None, run: Outcome, t_end: float) -> Motion:
    """Reference as a Motion; `run`: any finished run, for the probes and their initial positions.

    Raises:
        ModelError: a chosen probe is not in the reference, it has none of the scene, ends early, or its positions are
            not (n, 3) and finite.
    """
    names = list(chosen) if chosen is not None else [name for name in reference.probes if name in run.probes]
    for name in names or reference.probes:
        known = reference.probes if name in run.probes else run.probes
        if name not in known:
            what = "reference" if name in run.probes else "scene"
            hint = f"it has {listing(known)}{did_you_mean(name, known)}"
            raise ModelError(f"reference {reference.about!r}: the {what} has no probe {name!r}; {hint}")
    probes, times = {}, None
    for name in names:
        given = reference.probes[name]
        if callable(given):
            probes[name] = _validated_function(given, f"reference {reference.about!r}, probe {name!r}")
            continue
        sample_times, x = (np.asarray(part, dtype=float) for part in given)
        inside = (sample_times > END_TIME_TOL * t_end) & (sample_times <= (1.0 + END_TIME_TOL) * t_end)
        if not inside.any() or sample_times[inside][-1] < (1.0 - END_TIME_TOL) * t_end:
            raise ModelError(
                f"reference {reference.about!r}: its samples of {name!r} end at t = {sample_times[-1]:g} s without one "
                f"at the end time {t_end:g} s; take another end time"
            )
        if times is not None and not np.array_equal(times, sample_times[inside]):
            raise ModelError(f"reference {reference.about!r}: its probes must have the same times")
        times = sample_times[inside]
        probes[name] = functools.partial(_sample_at, times, x[inside])
    curve = np.linspace(0.0, t_end, TRAVEL_SAMPLES)[1:] if times is None else times
    travel = _largest_travel(probes, run.start_positions, curve)
    own_error = reference.error / travel
    fields = None if reference.field is None else np.asarray(reference.field, dtype=float)
    return Motion(reference.about, probes, times, travel, {"l2": own_error, "end": own_error}, fields)


def _validated_function(function: Callable[[np.ndarray], Any], what: str) -> Callable[[np.ndarray], np.ndarray]:
    def call(times: np.ndarray) -> np.ndarray:
        with convert_user_errors(what):
            out = np.asarray(function(times), dtype=float)
        if out.shape != (len(times), 3) or not np.isfinite(out).all():
            raise ModelError(f"{what}: must give finite positions {(len(times), 3)} of times, it gave {out.shape}")
        return out

    return call


def _sample_at(times: np.ndarray, x: np.ndarray, at: np.ndarray) -> np.ndarray:
    return x[np.searchsorted(times, at)]


def _largest_travel(
    probes: Mapping[str, Callable], start_positions: Mapping[str, np.ndarray], times: np.ndarray
) -> float:
    travel = max(float(np.linalg.norm(at(times) - start_positions[name], axis=1).max()) for name, at in probes.items())
    if not travel > 0.0:
        raise ModelError("study: the probes do not move in the reference, so that errors have no scale")
    return travel


def run_motion(run: Outcome, chosen: Sequence[str], about: str) -> Motion:
    """Finished run as a Motion of unknown error."""
    probes = {name: interpolant(run.times, *run.probes[name]) for name in chosen}
    return Motion(about, probes, None, _largest_travel(probes, run.start_positions, run.times), {}, run.field)


def motion_errors(run: Outcome, motion: Motion) -> dict[str, Any]:
    """Errors of a run: end and l2, the largest of the probes, those of each probe under "probes", and field.

    field is the relative norm of the difference from the reference; None if one is unknown.
    """
    times = run.times if motion.times is None else motion.times
    weights = np.diff(times, prepend=0.0)
    probes = {}
    for name, at in motion.probes.items():
        x, v = run.probes[name]
        positions = x if motion.times is None else interpolant(run.times, x, v)(times)
        distance = np.linalg.norm(positions - at(times), axis=1) / motion.travel
        probes[name] = {"end": float(distance[-1]), "l2": float(np.sqrt(weights @ distance**2 / weights.sum()))}
    out: dict[str, Any] = {what: max(p[what] for p in probes.values()) for what in ("end", "l2")}
    out["field"] = None
    if run.field is not None and motion.field is not None:
        if run.field.shape != motion.field.shape:
            raise ModelError(
                f"study: the scene's field gave shapes {run.field.shape} and {motion.field.shape}; it must give the "
                "same for every mesh"
            )
        norm = float(np.linalg.norm(motion.field))
        out["field"] = float(np.linalg.norm(run.field - motion.field)) / norm if norm > 0.0 else None
    return out | {"probes": probes}


def observed_order(coarse: float, fine: float, ratio: float, low: float, high: float) -> float:
    """Order p of the differences of three runs, each `ratio` times finer, within bounds."""
    if not (coarse > 0.0 and fine > 0.0):
        return low if coarse <= fine else high
    return float(np.clip(np.log(coarse / fine) / np.log(ratio), low, high))
