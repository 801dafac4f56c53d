"""What a simulation tells: of a step, and of probes, joints and contacts over time."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..base.brief import brief_repr
from ..base.errors import ModelError

__all__ = ["ContactRecord", "JointRecord", "PendingReport", "ProbeRecord", "StepReport", "describe", "idle_report",
           "step_text"]  # fmt: skip


@dataclass(frozen=True, eq=False)
class StepReport:
    """What a step took, each an array [world].

    Attributes:
        converged: the step was accepted, and its residual is within the solver's tolerance, or rounding stops it above
            and `floor` is the error that this leaves. With wf.Jacobi a world may go on without: False with status 0.
        floor: estimated error of the step's increment where rounding stopped the residual, relative to the solution, in
            the norm of energy and in float32 of displacements too; the true one is at most three times it. 0 where the
            tolerance was reached.
        newton, pcg: iterations, refused attempts included; Jacobi's count as newton.
        residual: |g| over the largest force, of the last attempt.
        halvings: refused attempts.
        status: 0 running, 1 failed and frozen as it was before the failed step, 2 frozen by the user.
        min_J: smallest det F at quadrature points, and of laws that need J > 0 at the vertices too. At a point a value
            <= 0 means that an element is inside out, which a step must not bring about, see `inversion` of Simulation.
        time: s.
        residual_force: |g| over the free components, N, of the last attempt.
        violation: largest of the constraints, m.
        energy_growth: net energy that the integrator has added since the start, over the largest kinetic + strain +
            contact energy plus the sum of |work|; 0 where it is not watched.
        outer: updates of the multipliers; with multipliers="newton" one per Newton iteration.
        stable: of statics at full load: objects True, False, or None where it can't be known (`StaticResult.stability`
            has why). None in place of the array where it was not judged.
        substeps, rejected: of dt="auto": accepted substeps, and those refused for their estimated error, which count
            among the halvings; least_h, largest_h: their sizes, s. None with a fixed dt.
    """

    converged: np.ndarray
    newton: np.ndarray
    pcg: np.ndarray
    residual: np.ndarray
    halvings: np.ndarray
    status: np.ndarray
    min_J: np.ndarray
    time: np.ndarray
    failure: np.ndarray
    violation: np.ndarray
    outer: np.ndarray
    residual_force: np.ndarray
    floor: np.ndarray
    energy_growth: np.ndarray
    substeps: np.ndarray | None = None
    rejected: np.ndarray | None = None
    least_h: np.ndarray | None = None
    largest_h: np.ndarray | None = None
    stable: np.ndarray | None = None

    __repr__ = brief_repr


class PendingReport(StepReport):
    """A report that is read from the device when one of its arrays is asked for.

    Raises:
        ModelError: the simulation has gone on since, and the report was not read before.
    """

    def __init__(self, sim: Any, number: int) -> None:
        object.__setattr__(self, "_source", (sim, number))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        sim, number = self._source
        if sim.steps != number:
            raise ModelError(f"the report of step {number} was not read before the simulation went on to {sim.steps}")
        report = sim.last
        for entry in fields(StepReport):
            object.__setattr__(self, entry.name, getattr(report, entry.name))
        return object.__getattribute__(self, name)

    def __repr__(self) -> str:
        return f"PendingReport(step {self._source[1]})"


@dataclass(frozen=True, eq=False)
class JointRecord:
    """A joint over time: time (steps,), or (worlds, steps) where worlds have times of their own; force
    (worlds, steps, 3), N, and moment about its anchor, N m, on the child in
    world axes; violation (worlds, steps), m, the largest of its rows."""

    time: np.ndarray
    force: np.ndarray
    moment: np.ndarray
    violation: np.ndarray

    __repr__ = brief_repr


@dataclass(frozen=True, eq=False)
class ContactRecord:
    """A contact over time, each (worlds, steps) but time (steps,), which is (worlds, steps) too where worlds have
    times of their own.

    Attributes:
        time: s.
        force, moment: on the body in world axes, moment about the world's origin; (worlds, steps, 3), N and N m.
        normal_force: sum of the sizes of normal forces, N. It, force and moment are means over the step where the step
            was halved, so that their impulse is that of the step.
        penetration: largest depth in the step, m.
        slip: length of slip in the step, m, and stick: share that sticks at its end; means over the area in contact.
        area: reference area in contact at the end of the step, m^2; at an edge also points of the faces beside count.
        stored: elastic energy of the contact at the end of the step, J.
        loss, friction: energy lost in the step to restitution and to friction, J.
        collider_work: work of the moving collider on the body in the step, J.
    """

    time: np.ndarray
    force: np.ndarray
    moment: np.ndarray
    normal_force: np.ndarray
    penetration: np.ndarray
    slip: np.ndarray
    area: np.ndarray
    stick: np.ndarray
    stored: np.ndarray
    loss: np.ndarray
    friction: np.ndarray
    collider_work: np.ndarray

    __repr__ = brief_repr


@dataclass(frozen=True, eq=False)
class ProbeRecord:
    """A probe over time: time (steps,), or (worlds, steps) where worlds have times of their own, s; position,
    displacement and velocity (worlds, steps, 3), in m and m/s."""

    time: np.ndarray
    position: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray

    __repr__ = brief_repr


def idle_report(sim: Any) -> StepReport:
    """The report of a simulation that has done no step since it was made or resumed."""
    count = sim.model.worlds
    zero, none = np.zeros(count, int), np.zeros(count)
    counts = (zero, zero, none, zero, sim.status, none, sim.time, zero, none, zero)
    return StepReport(sim.status == 0, *counts, none, none, none)


def step_text(dt: Any) -> str:
    """A step of all worlds, s, or the range of those of each."""
    low, high = float(np.min(dt)), float(np.max(dt))
    return f"{low:g} s" if low == high else f"{low:g} to {high:g} s"


def describe(sim: Any) -> str:
    """A simulation in one line."""
    m, steps = sim.model, sim.steps
    dt = step_text(sim.dt) if sim.error is None else f"auto, error = {sim.error:g}"
    at = f"t = {float(sim.time.max()):.6g} s, {steps} steps, dt = {dt}, {sim.integrator.name}"
    if sim.load is not None:
        at = f"static, load {100.0 * float(sim.load.max()):.4g} %, {steps} load step{'s' * (steps != 1)}"
    worlds = f", {m.worlds} worlds" if m.worlds > 1 else ""
    return f"Simulation({at}, {sim.methods['solver']}, {m.slots} slots, {m.device}, {m.dtype}{worlds})"
