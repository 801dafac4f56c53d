"""Finer reference run for unknown motions, and the estimate of its own error."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...base.checks import is_number
from ...base.errors import ConvergenceError, ModelError
from ...simulation.integrators import find_integrator
from .measure import DONE, REFUSED, Outcome
from .motion import Motion, motion_errors, observed_order, run_motion
from .settings import Setting, SweepAxes, check_steps

__all__ = ["check_finer", "finer_motion", "finer_setting"]

STEP_REFINEMENT, MESH_REFINEMENT, TOL_REFINEMENT = 8.0, 2, 100.0
"""Refinement factors relative to the finest run: step, cells along an edge, tolerance."""
SECOND_ORDER_METHOD = "bdf2"
MIN_TOL = 1e-11
"""Minimum tolerance of the reference; below, round-off dominates."""
DEFAULT_TOL = 1e-8
MIN_TIME_ORDER, MIN_MESH_ORDER, MAX_MESH_ORDER = 0.5, 1.0, 6.0
"""Bounds of the estimated orders of convergence."""
REFERENCE_MEASURES = ("l2", "end", "field")


def scale_counts(value: Any, factor: float) -> Any:
    """Number of cells, or a tuple of numbers, times a factor; None if a result is not whole."""
    if isinstance(value, tuple):
        parts = tuple(scale_counts(part, factor) for part in value)
        return None if None in parts else parts
    out = value * factor
    return int(out) if out == int(out) and out >= 1 else None


def check_finer(given: Mapping[str, Any]) -> None:
    """ModelError for options of the finer run that prevent the estimate of its error."""
    if given.get("error") is not None:
        raise ModelError(
            f"study: finer error = {given['error']!r}: the finer run takes steps of one size, from which its own error "
            "is estimated; give dt"
        )
    for name in ("dt", "tol"):
        value = given.get(name, 1.0)
        if not (is_number(value) and value > 0.0):
            raise ModelError(f"study: finer {name} = {value!r} must be a positive finite number")


def finer_setting(group: Sequence[Setting], axes: SweepAxes, given: Mapping[str, Any], default_dt: float) -> Setting:
    """Reference of settings that share a problem: finer than all of them in every swept direction.

    The step is an eighth of the smallest, with a method of order 2; swept meshes are twice as fine as the finest; of
    swept names (element, integration) the last one is used; float64, and a hundredth of the smallest tolerance.
    `given` options and parameters override these.
    """
    first = group[0]
    methods = [first.method, *(s.method for s in group)]
    steps = [s.dt for s in group if s.dt is not None] or [default_dt]
    tols = [s.tol for s in group if s.tol is not None and s.dtype == "float64"]
    changes: dict[str, Any] = {
        "method": next((m for m in methods if find_integrator(m).order >= 2), SECOND_ORDER_METHOD),
        "dt": min(steps) / STEP_REFINEMENT,
        "tol": max(MIN_TOL, min([*tols, DEFAULT_TOL]) / TOL_REFINEMENT),
        "dtype": "float64",
        "solver": next((s.solver for s in group if s.solver != "jacobi"), "newton-pcg"),
    }
    for name in axes.over:
        if name in axes.mesh:
            finest = max((s.values[name] for s in group), key=np.sum)
            changes[name] = scale_counts(finest, MESH_REFINEMENT)
        elif name in axes.choices:
            changes[name] = axes.over[name][-1]
    return first.with_changes(changes | dict(given))


def finer_motion(
    setting: Setting, axes: SweepAxes, chosen: Sequence[str] | None, run: Callable[[Setting], Outcome]
) -> Motion:
    """Run the reference, and further runs for its own error.

    In time: runs with 2 and 4 times its step and 10 and 100 times its tolerance, compared at order
    p = log2(|u4 - u2| / |u2 - u1|), at most that of the method and at least 0.5: |u2 - u1| / (2^p - 1). In space,
    for a swept mesh: with a half and a quarter of the cells (p from 1 to 6; with a half alone p = 1). The
    estimates are added.

    Raises:
        ConvergenceError: a failed run.
    """
    assert setting.dt is not None
    assert setting.tol is not None
    coarser = [setting.with_changes({"dt": k * setting.dt, "tol": f * setting.tol}) for k, f in ((2, 10.0), (4, 100.0))]
    for one in (setting, *coarser):
        check_steps(one.dt or 0.0, one.t_end)
    best = _finished_run(run, setting)
    names = list(chosen) if chosen is not None else list(best.probes)
    about = f"a run with {setting.method}, dt = {setting.dt or 0.0:.4g} s, tol = {setting.tol or 0.0:.4g}"
    swept = [name for name in axes.mesh if name in axes.over]
    about += "".join(f", {name} = {setting.values[name]}" for name in (*swept, *axes.choices))
    motion = run_motion(best, names, about)
    own_error = dict.fromkeys(REFERENCE_MEASURES, 0.0)
    estimates: dict[str, Any] = {}

    def add_estimate(label: str, settings: list[Setting], min_order: float, max_order: float) -> None:
        """Add the error in one direction, from coarser runs in it, the nearest first."""
        runs = [_finished_run(run, s) for s in settings]
        near = motion_errors(runs[0], motion)
        far = motion_errors(runs[1], run_motion(runs[0], names, "")) if len(runs) > 1 else None
        estimates[label] = {}
        for what in REFERENCE_MEASURES:
            if near[what] is None:
                continue
            p = min_order if far is None else observed_order(far[what], near[what], 2.0, min_order, max_order)
            own_error[what] += near[what] / (2.0**p - 1.0)
            estimates[label][what] = {"order": p, "difference": near[what]}

    add_estimate("time", coarser, MIN_TIME_ORDER, float(find_integrator(setting.method).order))
    if swept:
        meshes = []
        for factor in (0.5, 0.25):
            values = {name: scale_counts(setting.values[name], factor) for name in swept}
            if None in values.values():
                break
            meshes.append(setting.with_changes(values))
        if not meshes:
            raise ModelError(f"study: the reference has {', '.join(swept)} that can't be halved; give an even --finer")
        add_estimate("space", meshes, MIN_MESH_ORDER, MAX_MESH_ORDER)
    if motion.field is None:
        del own_error["field"]
    return replace(motion, own_error=own_error, runs=estimates)


def _finished_run(run: Callable[[Setting], Outcome], setting: Setting) -> Outcome:
    out = run(setting)
    if out.status == DONE:
        return out
    text = f"study: the reference run ({setting.method}, dt = {setting.dt:g} s) {out.status}: {out.why}"
    raise ModelError(text) if out.status == REFUSED else ConvergenceError(text)
