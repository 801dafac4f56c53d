"""Fit: parameters of a scene from a record, with scipy; the candidates are worlds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.console import progress_bar
from ..base.errors import ModelError
from ..base.names import check_choice
from ..builder.scene import Scene
from .candidates import Candidates
from .gradient_fit import DifferentiableCandidate

__all__ = ["Fit", "fit"]

METHODS = ("differential_evolution", "least_squares", "L-BFGS-B")


@dataclass(frozen=True)
class Fit:
    """Result of a fit.

    Attributes:
        values: by parameter. misfit: root of the mean square of the residuals.
        residuals: (samples,) of the record, simulation less record over sigma. runs: of the scene in the search.
        backward_runs: gradients or Jacobians of a run.
    """

    values: dict[str, float]
    misfit: float
    residuals: np.ndarray
    runs: int
    backward_runs: int = 0


def fit(
    scene: str | Scene[Any],
    parameters: Mapping[str, Any],
    record: Mapping[str, Sequence[Any]],
    *,
    method: str = "differential_evolution",
    fixed: Mapping[str, Any] | None = None,
    run: Mapping[str, Any] | None = None,
    worlds: int = 64,
    generations: int = 16,
    start: Mapping[str, float] | None = None,
    seed: int = 1,
    progress: bool | None = None,
) -> Fit:
    """Find the parameters with which a scene gives a record: least squares of all samples.

    Args:
        parameters: range (low, high), or {"low", "high", "log"}, by name as in `sweep`. Values per world are
            candidates of one model; each value of a parameter of the scene is another model.
        record: (times, values) or (times, values, sigma) by text, such as "probe.tip.displacement.z"; times are those
            of steps, s, of statics load fractions.
        method: "differential_evolution", of `worlds` candidates over `generations`; or from `start` (default: the
            middle of the ranges) "least_squares", or "L-BFGS-B", the better one of many parameters. Derivatives of
            components of probes by parameters of the model are those of `wf.Adjoint`; others are differences over
            worlds, which "L-BFGS-B" refuses.
        fixed: parameters of the scene. run: as of `sweep`. seed: of differential_evolution.
        progress: show a bar of the runs; None: if stderr is a terminal.

    Raises:
        ModelError: an unknown name, an empty range, a time between steps, or what has no gradient.
        ConvergenceError: the start, or every candidate, is refused.
    """
    check_choice("method", method, METHODS)
    candidates = Candidates(scene, parameters, record, dict(fixed or {}), dict(run or {}))
    backward_runs = 0
    with progress_bar("fit", "run", None, progress) as candidates.bar:
        one = None if method == "differential_evolution" else _differentiable(candidates, method, start or {})
        if one:
            point = one.search(candidates.first_point(start or {}), method)
            backward_runs = one.backward_runs
        elif method == "least_squares":
            point = candidates.search_locally(start or {})
        else:
            point = candidates.search_globally(worlds, generations, seed)
        runs, residuals = candidates.runs, candidates.residuals(point[:, None])[0]
    candidates.require("the best candidate", point)
    values = {name: float(column[0]) for name, column in candidates.values(point[:, None]).items()}
    return Fit(values, float(np.sqrt(np.mean(residuals**2))), residuals, runs, backward_runs)


def _differentiable(candidates: Candidates, method: str, start: Mapping[str, float]) -> DifferentiableCandidate | None:
    """Candidates with derivatives; None where "least_squares" takes differences instead. ModelError."""
    try:
        return DifferentiableCandidate(candidates, candidates.first_point(start))
    except ModelError:
        if method == "L-BFGS-B":
            raise
    return None
