"""Common parts of cases: models on a setting's device, effort of steps, error measures."""

from __future__ import annotations

from typing import Any

import numpy as np

import warpfea as wf
from warpfea.simulation.statics import StaticResult

from ..build import off
from ..case import Setting

__all__ = ["Effort", "X", "Y", "Z", "finalize", "off", "put", "solve"]

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


class Effort:
    """Effort of steps; an output of `run` and `solve_static`, or fed by `step`.

    Attributes:
        newton, pcg, halvings: sums, of the worst world.
        min_J, floor: the worst of worlds that have not failed; None if no step reported it.
        violation: the largest of constraints over the model's size; None without constraints.
    """

    def __init__(self) -> None:
        self.newton = self.pcg = self.halvings = 0
        self.min_J: float | None = None
        self.floor: float | None = None
        self.violation: float | None = None

    def add(self, sim: wf.Simulation) -> None:
        """Count the last step of a simulation."""
        report = sim.last
        assert report is not None
        self.newton += int(report.newton.max())
        self.pcg += int(report.pcg.max())
        self.halvings += int(report.halvings.max())
        running = report.status == 0
        if running.any():
            low = float(report.min_J[running].min())
            self.min_J = low if self.min_J is None else min(self.min_J, low)
        floor = getattr(report, "floor", None)
        if floor is not None:
            self.floor = max(self.floor or 0.0, float(np.max(floor)))
        if sim.model.constraints is not None:
            self.violation = max(self.violation or 0.0, float(report.violation.max()) / sim.model.size)

    def step(self, sim: wf.Simulation, count: int = 1) -> wf.StepReport:
        """Do steps one by one and count them; the last report."""
        for _ in range(count):
            report = sim.step()
            self.add(sim)
        return report

    # as an output

    def open(self, sim: Any) -> None:
        """No preparation."""

    def write(self, sim: Any) -> None:
        """Count a step; the call before the first has none."""
        if sim.last is not None:
            self.add(sim)

    def close(self, sim: Any) -> None:
        """No action."""

    def abort(self) -> None:
        """No action."""

    @property
    def told(self) -> dict[str, Any]:
        """Fields of an Answer."""
        return {
            "newton": self.newton, "pcg": self.pcg, "halvings": self.halvings, "min_J": self.min_J,
            "floor": self.floor, "violation": self.violation,
        }  # fmt: skip


def finalize(b: wf.ModelBuilder, setting: Setting, worlds: int = 1) -> wf.Model:
    """The model on the setting's device, in its precision."""
    return b.finalize(device=setting.device, dtype=setting.dtype, worlds=worlds)


def solve(b: wf.ModelBuilder, setting: Setting, effort: Effort, **options: Any) -> StaticResult:
    """The static equilibrium of a builder, counted."""
    return wf.solve_static(finalize(b, setting), outputs=[effort], **options)


def put(state: Any, values: np.ndarray, name: str = "displacement") -> None:
    """Set an array of a state in all worlds, values (slots, 3)."""
    array = getattr(state, name)
    array.assign(np.broadcast_to(values, (*array.shape, 3)).astype(array.numpy().dtype))
