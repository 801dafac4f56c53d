"""Common parts of the cases: bars and beams, static solutions with their counts, differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import warpfea as wf
from warpfea.base.writer import Output
from warpfea.simulation.statics import StaticResult

from .case import Answer, Setting

__all__ = [
    "BUILT_IN",
    "DOWN",
    "REFINED",
    "SOUND",
    "STEEL",
    "Count",
    "Solved",
    "bar",
    "beam",
    "off",
    "solve",
    "step",
]

DOWN = (0.0, 0.0, -9.81)
STEEL = wf.SVK(E=2e11, nu=0.3, density=7800.0)
SOUND = 1e-12
"""Smallest J that counts as positive."""
REFINED = 1e-10
"""Relative residual of float64 references."""
BUILT_IN = {
    "T4": "all",
    "T10": "all",
    "FN18": "position+gradient-y+gradient-z",
    "H3843": "position+gradient-y+gradient-z",
    "3243": "position+section",
    "3443": "position+director",
}
"""Slots constrained by a wall x = const."""


def bar(
    element: str, cells: Sequence[int], size: Sequence[float], law: Any, gravity: Sequence[float] = (0.0, 0.0, 0.0)
) -> tuple[wf.ModelBuilder, wf.Body]:
    """A solid bar from x = 0 on, clamped at its side x-, with the probe "tip" at x+; `size` in m."""
    b = wf.ModelBuilder(gravity=tuple(gravity))
    mesh = wf.mesh.box(tuple(size), cells=tuple(cells), element=element)
    body = b.add_solid(mesh, material=law, element=element, name="bar")
    b.clamp(body.nodes("x-"), slots=BUILT_IN[element])
    b.add_probe("tip", body.surface("x+"))
    return b, body


def beam(
    elements: int, side: float, law: Any, length: float = 1.0, gravity: Sequence[float] = (0.0, 0.0, 0.0)
) -> tuple[wf.ModelBuilder, wf.Body]:
    """A 3243 beam along x with a square section, clamped at its start, with the probe "tip" at its end; m."""
    b = wf.ModelBuilder(gravity=tuple(gravity))
    section = wf.Rectangle(side, side)
    line = [(0, 0, 0), (length, 0, 0)]
    body = b.add_beam(line, elements=elements, section=section, normal=(0, 0, 1), material=law, name="beam")
    b.clamp(body.start, slots=BUILT_IN["3243"])
    b.add_probe("tip", body.end)
    return b, body


@dataclass
class Count(Output):
    """Iterations and other numbers of all steps so far, the worst world's; an output, or fed by `add`."""

    newton: int = 0
    pcg: int = 0
    halvings: int = 0
    worst_newton: int = 0
    violation: float = 0.0
    min_J: float = np.inf
    floor: float = 0.0
    last_floor: float = 0.0
    sum_of_floors: float = 0.0
    steps: int = 0
    seen: Any = field(default=None, repr=False)

    def add(self, report: Any, size: float) -> None:
        """Add a step's report; `size` of the model, m."""
        self.steps += 1
        self.newton += int(report.newton.max())
        self.pcg += int(report.pcg.max())
        self.worst_newton = max(self.worst_newton, int(report.newton.max()))
        self.halvings += int(report.halvings.max())
        self.violation = max(self.violation, float(report.violation.max()) / size)
        self.min_J = min(self.min_J, float(report.min_J.min()))
        floor = getattr(report, "floor", None)
        self.last_floor = 0.0 if floor is None else float(np.max(floor))
        self.floor = max(self.floor, self.last_floor)
        self.sum_of_floors += self.last_floor

    def answer(
        self, error: float, bound: float, reference: str, *, low: float | None = SOUND, told: float = 0.0, **more: Any
    ) -> Answer:
        """An answer with these counts.

        Args:
            low: minimum J at a point of accepted steps; None: any J.
            told: reported estimate of the relative error, which the error may exceed threefold; 0: none. Only for a
                reference on the same mesh: `last_floor` of a static solution, `sum_of_floors` of a
                motion.
        """
        limits = dict(more.pop("limits", {}))
        if low is not None:
            limits["J short of its least"] = (low - self.min_J, 0.0)
        if told > 0.0:
            limits["error over the floor told"] = (error, 3.0 * told)
        return Answer(
            float(error), bound, reference, newton=self.newton, pcg=self.pcg, halvings=self.halvings, limits=limits,
            violation=self.violation or None, min_J=float(self.min_J), floor=self.floor, **more,
        )  # fmt: skip

    def open(self, sim: Any) -> None:
        """No preparation."""

    def write(self, sim: Any) -> None:
        """Add the step done since the last call."""
        if sim.last is not None and sim.last is not self.seen:
            self.seen = sim.last
            self.add(sim.last, sim.model.size)

    def close(self, sim: Any) -> None:
        """No action."""

    def abort(self) -> None:
        """No action."""


@dataclass
class Solved:
    """A static solution with its counts."""

    result: StaticResult
    count: Count

    @property
    def tip(self) -> np.ndarray:
        """Displacement of the probe "tip" at full load (3,), m."""
        return np.asarray(self.result.probe("tip").displacement[0, -1], dtype=float)


def solve(b: wf.ModelBuilder, setting: Setting, dtype: str | None = None, **options: Any) -> Solved:
    """`solve_static` with these options, in the setting's or another precision."""
    count = Count()
    model = b.finalize(device=setting.device, dtype=dtype or setting.dtype)
    result = wf.solve_static(model, outputs=[count], **options)
    return Solved(result, count)


def step(sim: wf.Simulation, steps: int, count: Count | None = None) -> Count:
    """Do steps one by one, counted."""
    count = count or Count()
    for _ in range(steps):
        count.add(sim.step(), sim.model.size)
    return count


def off(value: Any, reference: Any, scale: float | None = None) -> float:
    """Largest difference over `scale`, by default the largest value of the reference."""
    value, reference = np.asarray(value, dtype=float), np.asarray(reference, dtype=float)
    return float(np.abs(value - reference).max() / (np.abs(reference).max() if scale is None else scale))
