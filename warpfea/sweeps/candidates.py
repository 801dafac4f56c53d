"""Candidates of a fit: points of the ranges of the parameters, as worlds of a run, and their residuals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..base.console import quiet_warp
from ..base.devices import find_device
from ..base.errors import ConvergenceError, ModelError
from ..base.names import check_choice
from ..builder.scene import locate
from .design import as_range, check_keys
from .measures import RECORDS, parse_measures
from .worker import FAILED_WORLD, Group, Study

__all__ = ["Candidates"]

DIFFERENCE = 1e-4
"""Step of the differences of least_squares, over the ranges of the parameters."""
SAME_TIME = 1e-6
"""Largest distance of a time of the record from a step, over dt."""


class Candidates:
    """Candidates of a fit: points between 0 and 1 of the ranges, and their residuals."""

    refused_residual = 1e15
    """Residual of a candidate whose run is refused."""

    def __init__(self, scene: Any, parameters: Any, record: Any, fixed: dict[str, Any], run: dict[str, Any]) -> None:
        self.scene = locate(scene) if isinstance(scene, str) else scene
        self.ranges = {name: as_range(f"parameters.{name}", axis) for name, axis in parameters.items()}
        for name, axis in self.ranges.items():
            if axis["whole"] or "count" in axis:
                raise ModelError(f"parameters.{name}: a fit takes low, high and log; whole and count are of designs")
        self.curves = parse_measures("record", {text: text for text in record})
        for text, curve in self.curves.items():
            check_choice(f"record.{text}: the kind", curve.kind, tuple(RECORDS))
        self.samples = {text: [np.asarray(x, float) for x in given] for text, given in record.items()}
        device = find_device(run.get("device"))
        place = {"device": "cuda" if device.is_cuda else "cpu"}
        self.study = Study("", fixed, {}, self.curves, run | place, many=True)
        self.runs, self.refused, self.least = 0, np.zeros(0, dtype=bool), math.inf
        self.bar: Any = None

    def require(self, what: str, point: np.ndarray) -> None:
        """ConvergenceError if a candidate of the last residuals was refused."""
        if self.refused.any():
            at = ", ".join(f"{name} = {column[0]:.6g}" for name, column in self.values(point[:, None]).items())
            raise ConvergenceError(f"fit: the run of {what} is refused, at {at}; take other ranges or another start")

    def values(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """Values by parameter of points (parameters, candidates)."""
        out = {}
        for (name, axis), row in zip(self.ranges.items(), points):
            low, high = (math.log(axis[k]) if axis["log"] else axis[k] for k in ("low", "high"))
            out[name] = np.exp(low + row * (high - low)) if axis["log"] else low + row * (high - low)
        return out

    def residuals(self, points: np.ndarray) -> np.ndarray:
        """(candidates, samples) of points (parameters, candidates); `refused` flags those without a result."""
        columns = self.values(points)
        groups: dict[tuple[float, ...], list[int]] = {}
        own = [name for name in columns if name in self.scene.parameters]
        for k in range(points.shape[1]):
            groups.setdefault(tuple(float(columns[name][k]) for name in own), []).append(k)
        out = np.empty((points.shape[1], sum(values.size for _, values, *_ in self.samples.values())))
        self.refused = np.zeros(points.shape[1], dtype=bool)
        for arguments, members in groups.items():
            group = Group(self.study, self.scene, dict(zip(own, arguments)))
            per_world = {name: column[members].tolist() for name, column in columns.items() if name not in own}
            with quiet_warp():
                model = group.model(len(members))
                sim = group.simulate(model, per_world, on_failure="freeze")
            self.refused[members] = failed = sim.status == FAILED_WORLD
            if failed.all():  # its records end early
                continue
            curves = [self.difference(text, c.times(sim)[0], c.series(sim)) for text, c in self.curves.items()]
            out[members] = np.hstack(curves)
            self.refused[members] |= ~np.isfinite(out[members]).all(axis=1)
        out[self.refused] = self.refused_residual
        self.count(out)
        return out

    def count(self, residuals: np.ndarray) -> None:
        """Count runs, and show their progress, by residuals (runs, samples)."""
        self.runs += len(residuals)
        self.least = min(self.least, float((residuals**2).mean(axis=1).min()) ** 0.5)
        self.bar.set_postfix_str(f"misfit {self.least:.3g}", refresh=False)
        self.bar.update(len(residuals))

    def place(self, text: str, steps: np.ndarray) -> tuple[np.ndarray, Any]:
        """Indices of the steps of the samples, and sigma. ModelError for times between steps."""
        times, values, *sigma = self.samples[text]
        at = np.abs(steps[:, None] - times).argmin(axis=0)
        if times.shape != values.shape or np.abs(steps[at] - times).max() > SAME_TIME * np.diff(steps).min(initial=1.0):
            raise ModelError(f"record.{text}: needs as many times as values, at ends of steps, up to {steps[-1]:g} s")
        return at, sigma[0] if sigma else 1.0

    def difference(self, text: str, steps: np.ndarray, series: np.ndarray) -> np.ndarray:
        """(worlds, samples) simulation less record, over sigma."""
        at, sigma = self.place(text, steps)
        return (series[:, at] - self.samples[text][1]) / sigma

    def search_globally(self, worlds: int, generations: int, seed: int) -> np.ndarray:
        """Best point of differential evolution."""
        from scipy.optimize import differential_evolution

        def misfits(points: np.ndarray) -> np.ndarray:
            self.bar.total = points.shape[1] * generations
            return (self.residuals(points) ** 2).mean(axis=1)

        found = differential_evolution(
            misfits, [(0.0, 1.0)] * len(self.ranges),
            vectorized=True, updating="deferred", polish=False, popsize=max(worlds // len(self.ranges), 1),
            maxiter=generations - 1, tol=0.0, init="sobol", rng=np.random.default_rng(seed),
        )  # fmt: skip
        return np.asarray(found.x)

    def first_point(self, start: Mapping[str, float]) -> np.ndarray:
        """Point of a start; the middle of the ranges of others."""
        first = np.full(len(self.ranges), 0.5)
        check_keys("start", start, self.ranges)
        for k, (name, axis) in enumerate(self.ranges.items()):
            if name in start:
                if not axis["low"] <= start[name] <= axis["high"]:
                    raise ModelError(
                        f"start.{name} = {start[name]!r} is not in its range, {axis['low']} to {axis['high']}"
                    )
                low, at, high = (math.log(v) if axis["log"] else v for v in (axis["low"], start[name], axis["high"]))
                first[k] = (at - low) / (high - low)
        return first

    def search_locally(self, start: Mapping[str, float]) -> np.ndarray:
        """Best point of least squares."""
        from scipy.optimize import least_squares

        def jacobian(x: np.ndarray) -> np.ndarray:
            step = np.where(x < 0.5, DIFFERENCE, -DIFFERENCE)
            rows = self.residuals(np.column_stack([x, x[:, None] + np.diag(step)]))
            if (bad := np.flatnonzero(self.refused[1:])).size:  # then to the other side
                step[bad] *= -1.0
                rows[1 + bad] = self.residuals(x[:, None] + np.diag(step)[:, bad])
                self.require("both neighbours of a candidate", x)
            return ((rows[1:] - rows[0]) / step[:, None]).T

        first = self.first_point(start)
        self.residuals(first[:, None])
        self.require("the start", first)
        found = least_squares(lambda x: self.residuals(x[:, None])[0], first, jac=jacobian, bounds=(0, 1), gtol=None)
        return np.asarray(found.x)
