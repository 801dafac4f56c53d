"""Parts of an error, by differences of runs.

For a run u with the step h, cells of the size H, the tolerance tau and the precision of its dtype, |.| the distance of
`motion.py` (l2, largest of the probes, over the reference's travel):

    time      |u(h) - u(h/2)| 2^p / (2^p - 1), p the order of the method; for steps adapted to a requested error e
              |u(e) - u(e/10)|
    space     |u(H) - u(H/2)| 2^q / (2^q - 1) with q = 1, an upper bound for elements that converge faster
    algebra   |u(tau) - u(tau/100)|
    rounding  |u(float32) - u(float64)| for a float32 run; for float64 times 2^-29, the ratio of both unit round-offs

A part is empty if unavailable: no parameter of the scene refines the mesh, the finer run was not
accepted, or float32 can't hold the case. The parts may have different signs: their sum bounds the error, with that of
the model itself (element, law) left out.
"""

from collections.abc import Callable

from ...simulation.integrators import find_integrator
from .finer import scale_counts
from .measure import DONE, Outcome
from .motion import Motion, motion_errors, run_motion
from .settings import Setting, SweepAxes

__all__ = ["split_error"]

ErrorParts = dict[str, float | None]

ROUND_OFF_RATIO = 2.0**-29
"""Unit round-off of float64 over that of float32."""
TIGHTENING = 100.0
DEFAULT_TOLS = {"float64": 1e-8, "float32": 1e-4}
"""Tolerances of the solvers."""


def split_error(setting: Setting, axes: SweepAxes, motion: Motion, run: Callable[[Setting], Outcome]) -> ErrorParts:
    """time, space, algebra and rounding of the error of a setting, over the travel of the reference; None: unknown."""
    base = run(setting)
    if base.status != DONE:
        return dict.fromkeys(("time", "space", "algebra", "rounding"))
    names = list(motion.probes)

    def distance_to(other: Setting) -> float | None:
        found = run(other)
        if found.status != DONE:
            return None
        reference = run_motion(found, names, "")
        return float(motion_errors(base, reference)["l2"]) * reference.travel / motion.travel

    def multiply(value: float | None, factor: float) -> float | None:
        return None if value is None else factor * value

    if setting.dt is not None:
        growth = 2.0 ** find_integrator(setting.method).order
        time = multiply(distance_to(setting.with_changes({"dt": setting.dt / 2})), growth / (growth - 1.0))
    else:
        assert setting.error is not None
        time = distance_to(setting.with_changes({"error": setting.error / 10}))
    finer = {name: scale_counts(setting.values[name], 2) for name in axes.mesh}
    space = multiply(distance_to(setting.with_changes(finer)), 2.0) if finer else None
    tol = setting.tol if setting.tol is not None else DEFAULT_TOLS[setting.dtype]
    algebra = distance_to(setting.with_changes({"tol": tol / TIGHTENING}))
    single = setting.dtype == "float32"
    other = distance_to(setting.with_changes({"dtype": "float64" if single else "float32"}))
    rounding = other if single else multiply(other, ROUND_OFF_RATIO)
    return {"time": time, "space": space, "algebra": algebra, "rounding": rounding}
