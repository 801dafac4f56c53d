"""Candidates of a fit with derivatives of their residuals, by `wf.Adjoint`: one model, one candidate at a time."""

from __future__ import annotations

import math

import numpy as np

import warpfea as wf

from ..base.console import quiet_warp
from ..base.errors import ConvergenceError, ModelError
from .candidates import Candidates
from .measures import COMPONENTS
from .worker import Group

__all__ = ["DifferentiableCandidate"]

TIGHT = {"ftol": 1e-15, "gtol": 1e-10}
"""Ends of L-BFGS-B, over the misfit of the start: errors of parameters are those of the steps' tolerance."""


class DifferentiableCandidate:
    """Residuals of a point of the ranges and their derivatives.

    Attributes:
        backward_runs: gradients or Jacobians of a motion.

    Raises:
        ModelError: parameters of the scene, records other than components of probes, statics, steps of variable
            length, or what `wf.Adjoint` refuses.
    """

    def __init__(self, candidates: Candidates, point: np.ndarray) -> None:
        self.candidates, study = candidates, candidates.study
        self.backward_runs = 0
        own = [name for name in candidates.ranges if name in candidates.scene.parameters]
        if own:
            raise ModelError(f"fit: {own[0]!r} is a parameter of the scene, without derivatives")
        for text, curve in candidates.curves.items():
            if curve.kind != "probe" or curve.component not in ("x", "y", "z"):
                raise ModelError(f"fit: record.{text} has no derivatives; components x, y and z of probes have")
        if study.run.get("static") or study.run.get("dt") == "auto":
            raise ModelError("fit: derivatives are of motions in steps of a fixed dt")
        group = Group(study, candidates.scene, {})
        with quiet_warp():
            self.model = group.model(1)
            self.sim = group.start(self.model, self._columns(point))
            self.tape = wf.Adjoint(self.sim, list(candidates.ranges))
        self.steps = round(study.run.get("t_end", candidates.scene.t_end) / self.sim.dt)
        self.times = self.sim.dt * np.arange(1, self.steps + 1)
        self.point, self._residuals, self.refused = np.full(len(point), math.nan), np.zeros(0), False

    def _columns(self, point: np.ndarray) -> dict[str, list[float]]:
        return {name: [float(v) for v in column] for name, column in self.candidates.values(point[:, None]).items()}

    def residuals(self, point: np.ndarray) -> np.ndarray:
        """(samples,) simulation less record, over sigma; large where the run is refused."""
        if np.array_equal(point, self.point):
            return self._residuals
        for name, values in self._columns(point).items():
            self.model.set_parameter(name, values)
        self.sim.reset()
        self.tape.clear()
        self.point = point.copy()
        size = sum(values.size for _, values, *_ in self.candidates.samples.values())
        try:
            with quiet_warp():
                self.tape.run(self.steps)
        except ConvergenceError:
            self.refused, self._residuals = True, np.full(size, self.candidates.refused_residual)
            self.candidates.count(self._residuals[None])
            return self._residuals
        self.refused, parts = False, []
        for text, curve in self.candidates.curves.items():
            values = getattr(self.tape.probe(curve.name), curve.quantity).numpy()
            series = values[:, :, COMPONENTS.index(curve.component)]
            parts.append(self.candidates.difference(text, self.times, series)[0])
        self._residuals = np.concatenate(parts)
        self.candidates.count(self._residuals[None])
        return self._residuals

    def gradient(self, point: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(parameters,) derivatives of weights (samples,) times the residuals by the point."""
        self.residuals(point)
        if self.refused:
            return np.zeros(len(point))
        grads: dict[tuple[str, str], np.ndarray] = {}
        first = 0
        for text, curve in self.candidates.curves.items():
            at, sigma = self.candidates.place(text, self.times)
            bar = grads.setdefault((curve.name, curve.quantity), np.zeros((1, self.steps, 3)))
            part = weights[first : first + len(at)] / sigma
            np.add.at(bar[0, :, COMPONENTS.index(curve.component)], at, part)
            first += len(at)
        for (name, quantity), bar in grads.items():
            getattr(self.tape.probe(name), quantity).grad.assign(bar)
        self.backward_runs += 1
        g = self.tape.backward()
        return np.array([g[name].numpy()[0] for name in self.candidates.ranges]) * self._slopes(point)

    def jacobian(self, point: np.ndarray) -> np.ndarray:
        """(samples, parameters) derivatives of the residuals by the point, by forward sensitivities."""
        rows = np.zeros((len(point), len(self.residuals(point))))
        if self.refused:
            return rows.T
        self.backward_runs += 1
        for k, (name, slope) in enumerate(zip(self.candidates.ranges, self._slopes(point))):
            change = self.tape.forward({name: slope})
            parts = []
            for text, curve in self.candidates.curves.items():
                at, sigma = self.candidates.place(text, self.times)
                values = getattr(change[curve.name], curve.quantity).numpy()[0]
                parts.append(values[at, COMPONENTS.index(curve.component)] / sigma)
            rows[k] = np.concatenate(parts)
        return rows.T

    def _slopes(self, point: np.ndarray) -> np.ndarray:
        """Derivatives of the values of the parameters by the point."""
        out = []
        for axis, (value,) in zip(self.candidates.ranges.values(), self._columns(point).values()):
            low, high = axis["low"], axis["high"]
            out.append(value * math.log(high / low) if axis["log"] else high - low)
        return np.array(out)

    def search(self, first: np.ndarray, method: str) -> np.ndarray:
        """Best point from a first one, by "least_squares", or L-BFGS-B on the mean square of the residuals."""
        from scipy.optimize import least_squares, minimize

        start = self.residuals(first)
        self.candidates.refused = np.array([self.refused])
        self.candidates.require("the start", first)
        if method == "least_squares":
            return np.asarray(least_squares(self.residuals, first, jac=self.jacobian, bounds=(0, 1), gtol=None).x)
        scale = np.mean(start**2) or 1.0

        def misfit(x: np.ndarray) -> tuple[float, np.ndarray]:
            r = self.residuals(x)
            return float(np.mean(r**2) / scale), self.gradient(x, 2.0 * r / (r.size * scale))

        bounds = [(0.0, 1.0)] * len(first)
        return np.asarray(minimize(misfit, first, jac=True, method="L-BFGS-B", bounds=bounds, options=TIGHT).x)
