"""Shared by the cases: bars and beams, static solutions with their counts, differences."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse.linalg

import warpfea as wf
from warpfea.base.writer import Output
from warpfea.simulation.statics import StaticResult

from .case import Answer, Setting

__all__ = [
    "CLAMPED_SLOTS", "GRAVITY_VECTOR", "MIN_POSITIVE_J", "REFERENCE_TOL", "STEEL", "StaticSolution", "StepStats", "X",
    "Y", "Z", "add_along_x", "bar", "beam", "covering_array", "finalize", "linear_steps", "relative_error", "solve",
    "step",
]  # fmt: skip

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
AXES = np.array([X, Y, Z])
GRAVITY_VECTOR = (0.0, 0.0, -9.81)
STEEL = wf.SVK(E=2e11, nu=0.3, density=7800.0)
MIN_POSITIVE_J = 1e-12
"""Smallest accepted J of a deformation without inversion."""
REFERENCE_TOL = 1e-10
"""Solver tolerance of float64 references."""
CLAMPED_SLOTS = {
    **dict.fromkeys(("T4", "T10"), "all"), **dict.fromkeys(("FN18", "H3843"), "position+gradient-y+gradient-z"),
    "3243": "position+section", "3443": "position+director",
}  # fmt: skip
"""Slots that a clamped wall x = const fixes, by element."""


def add_along_x(
    b: wf.ModelBuilder, element: str, cells: Sequence[int], size: Sequence[float], law: Any, *, name: str | None = None,
    turn: np.ndarray = AXES, shift: Any = (0.0, 0.0, 0.0),
) -> tuple[wf.Body, Any, Any]:  # fmt: skip
    """Add a 3243 beam, a 3443 shell or solids along x from the origin, turned and moved: the body, its start and end.

    `size` in m: the shell's last is its thickness.
    """
    if element == "3243":
        ends, section = [shift, shift + size[0] * turn[:, 0]], wf.Rectangle(size[1], size[2])
        body = b.add_beam(ends, elements=cells[0], section=section, normal=turn[:, 2], material=law, name=name)
        return body, body.start, body.end
    if element == "3443":
        grid = wf.mesh.grid(size[:2], cells=cells[:2])
        body = b.add_shell(grid, thickness=size[2], material=law, transform=(turn, shift), name=name)
        return body, body.edge("x-"), body.edge("x+")
    mesh = wf.mesh.box(size, cells=cells, element=element)
    body = b.add_solid(mesh, material=law, element=element, transform=(turn, shift), name=name)
    return body, body.nodes("x-"), body.nodes("x+")


def bar(
    element: str, cells: Sequence[int], size: Sequence[float], law: Any, gravity: Sequence[float] = (0.0, 0.0, 0.0)
) -> tuple[wf.ModelBuilder, wf.Body]:
    """A bar of solids or a 3443 strip from x = 0 on, built in at x-, with the probe "tip" at x+; `size` in m."""
    b = wf.ModelBuilder(gravity=tuple(gravity))
    body, start, _ = add_along_x(b, element, cells, size, law, name="bar")
    b.clamp(start, slots=CLAMPED_SLOTS[element])
    b.add_probe("tip", body.surface("x+"))
    return b, body


def beam(
    elements: int, side: float, law: Any, length: float = 1.0, gravity: Sequence[float] = (0.0, 0.0, 0.0)
) -> tuple[wf.ModelBuilder, wf.Body]:
    """A 3243 beam along x with a square section, built in at its start, with the probe "tip" at its end; m."""
    b = wf.ModelBuilder(gravity=tuple(gravity))
    body, start, end = add_along_x(b, "3243", (elements,), (length, side, side), law, name="beam")
    b.clamp(start, slots=CLAMPED_SLOTS["3243"])
    b.add_probe("tip", end)
    return b, body


@dataclass
class StepStats(Output):
    """Iterations, smallest J and round-off of all steps so far: an output of `run` and `solve_static`, or by `step`.

    Attributes:
        newton, pcg, halvings: sums, of the worst world; worst_newton: of a step.
        min_J: the smallest, of worlds that have not failed.
        floor: the largest round-off estimate of the reports; last_floor, sum_of_floors: of the last step, of all.
        violation: the largest of constraints over the model's size; None without constraints.
        last_report: of the last step added.
    """

    newton: int = 0
    pcg: int = 0
    halvings: int = 0
    worst_newton: int = 0
    min_J: float = np.inf
    floor: float = 0.0
    last_floor: float = 0.0
    sum_of_floors: float = 0.0
    violation: float | None = None
    last_report: Any = field(default=None, repr=False)

    def add(self, sim: Any) -> None:
        """Add the last step of a simulation."""
        report = self.last_report = sim.last
        self.newton += int(report.newton.max())
        self.pcg += int(report.pcg.max())
        self.worst_newton = max(self.worst_newton, int(report.newton.max()))
        self.halvings += int(report.halvings.max())
        self.min_J = min(self.min_J, float(report.min_J[report.status == 0].min(initial=np.inf)))
        self.last_floor = float(np.max(report.floor))
        self.floor = max(self.floor, self.last_floor)
        self.sum_of_floors += self.last_floor
        if sim.model.constraints is not None:
            self.violation = max(self.violation or 0.0, float(report.violation.max()) / sim.model.size)

    def step(self, sim: wf.Simulation, steps: int = 1) -> wf.StepReport:
        """Step a simulation and add each step; returns the last report."""
        for _ in range(steps):
            report = sim.step()
            self.add(sim)
        return report

    @property
    def answer_fields(self) -> dict[str, Any]:
        """These numbers as fields of an Answer."""
        return {
            "newton": self.newton, "pcg": self.pcg, "halvings": self.halvings, "floor": self.floor,
            "min_J": None if self.min_J == np.inf else float(self.min_J), "violation": self.violation,
        }  # fmt: skip

    def answer(
        self,
        error: float,
        bound: float,
        reference: str,
        *,
        lowest_J: float | None = MIN_POSITIVE_J,
        reported_error: float = 0.0,
        **more: Any,
    ) -> Answer:
        """An answer with these counts.

        Args:
            lowest_J: no step may have been accepted with J below it at a point; None: whatever J.
            reported_error: round-off estimate of the reports, which the error may exceed threefold; 0: none.
                Only if the reference has the same mesh: `last_floor` of a static solution, `sum_of_floors` of a
                motion.
        """
        limits = dict(more.pop("limits", {}))
        if lowest_J is not None:
            limits["J short of its least"] = (lowest_J - self.min_J, 0.0)
        if reported_error > 0.0:
            limits["error over the floor told"] = (error, 3.0 * reported_error)
        return Answer(float(error), bound, reference, limits=limits, **self.answer_fields, **more)

    def write(self, sim: Any) -> None:
        """Add the step done since the last call."""
        if sim.last is not None and sim.last is not self.last_report:
            self.add(sim)


@dataclass
class StaticSolution:
    """Static solution, and statistics of its load steps."""

    result: StaticResult
    stats: StepStats

    @property
    def tip(self) -> np.ndarray:
        """Displacement of the probe "tip" at full load (3,), m."""
        return np.asarray(self.result.probe("tip").displacement[0, -1], dtype=float)


def finalize(b: wf.ModelBuilder, setting: Setting, worlds: int = 1) -> wf.Model:
    """The model on the setting's device, in its precision."""
    return b.finalize(device=setting.device, dtype=setting.dtype, worlds=worlds)


def step(
    b: wf.ModelBuilder, setting: Setting, steps: int, stats: StepStats | None = None, **options: Any
) -> tuple[wf.Simulation, StepStats]:
    """A simulation with these options after so many steps, and their statistics; `stats`: those to add to."""
    sim, stats = wf.Simulation(finalize(b, setting), **options), stats or StepStats()
    stats.step(sim, steps)
    return sim, stats


def solve(b: wf.ModelBuilder, setting: Setting, stats: StepStats | None = None, **options: Any) -> StaticSolution:
    """Result of `solve_static` with these options; `stats`: statistics to add to."""
    stats = stats or StepStats()
    return StaticSolution(wf.solve_static(finalize(b, setting), outputs=[stats], **options), stats)


def linear_steps(model: wf.Model, force: np.ndarray, h: float, steps: int) -> np.ndarray:
    """Displacements of the slots (slots, 3), m, after steps of backward Euler from rest with constant matrices.

    `force` (slots, 3) in N; float64, by a factorisation.
    """
    free = np.flatnonzero(model.free_slots.ravel())
    M, K = (A[free][:, free] for A in (model.mass_matrix(), model.tangent_matrix(model.state())))
    factor = scipy.sparse.linalg.splu((M + h * h * K).tocsc())
    u = v = np.zeros(len(free))
    for _ in range(steps):
        v = factor.solve(M @ v + h * (force.ravel()[free] - K @ u))
        u = u + h * v
    out = np.zeros(3 * model.slots)
    out[free] = u
    return out.reshape(-1, 3)


def relative_error(value: Any, reference: Any, scale: float | None = None) -> float:
    """Largest difference over `scale`, by default the largest absolute value of the reference."""
    value, reference = np.asarray(value, dtype=float), np.asarray(reference, dtype=float)
    return float(np.abs(value - reference).max() / (np.abs(reference).max() if scale is None else scale))


def covering_array(*axes: Sequence[Any], strength: int = 2) -> list[tuple[Any, ...]]:
    """Cases of the product of axes that have every combination of values of `strength` axes.

    A greedy choice: each next case is the first of those that bring most new combinations; in the order of the product.
    """
    cases = list(itertools.product(*axes))
    groups = list(itertools.combinations(range(len(axes)), strength))
    covers = [{(g, *(repr(case[k]) for k in g)) for g in groups} for case in cases]
    left, chosen = set().union(*covers), []
    while left:
        chosen.append(max(range(len(cases)), key=lambda k: (len(covers[k] & left), -k)))
        left -= covers[chosen[-1]]
    return [cases[k] for k in sorted(chosen)]
