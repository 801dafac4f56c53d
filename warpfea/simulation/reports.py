"""Report and record data classes: a step; probes, joints and contacts over time."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..base.short_repr import use_short_repr

__all__ = [
    "ContactRecord",
    "JointRecord",
    "PendingReport",
    "ProbeRecord",
    "StepReport",
    "idle_report",
    "simulation_text",
    "step_text",
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class StepReport:
    """Report of a step, each an array [world].

    Attributes:
        converged: the step was accepted with its residual within the solver's tolerance, or above it at the round-off
            limit with the error `floor`. With wf.Jacobi a world may continue unconverged: False with status 0.
        floor: estimated error of the step's increment if round-off stopped the residual, relative to the solution, in
            the energy norm and in float32 also of displacements; the true one is at most three times it. 0 if the
            tolerance was reached.
        newton, pcg: iterations, rejected attempts included; Jacobi's count as newton.
        residual: |g| over the largest force, of the last attempt.
        halvings: rejected attempts.
        status: 0 running, 1 failed and frozen in the state before the failed step, 2 frozen by the user.
        min_J: smallest det F at quadrature points, for laws that need J > 0 also at the vertices. A value <= 0 at a
            quadrature point is an inverted element, see `inversion` of Simulation.
        time: s.
        residual_force: |g| over the free components, N, of the last attempt.
        violation: largest constraint violation, m.
        energy_growth: net energy gain of the integrator since the start, over the largest kinetic + strain + contact
            energy plus the sum of |work|; 0 if not monitored.
        outer: multiplier updates; with multipliers="newton" one per Newton iteration.
        stable: statics at full load: objects True, False, or None if unknown (reason: `StaticResult.stability`). None
            in place of the array without a stability analysis.
        substeps, rejected: dt="auto": accepted substeps, and those rejected for their estimated error, which count
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

    __repr__ = use_short_repr


class PendingReport(StepReport):
    """Report read from the device on first access to one of its arrays.

    Raises:
        ModelError: the simulation has stepped since without a read.
    """

    def __init__(self, sim: Any, number: int) -> None:
        object.__setattr__(self, "_source", (sim, number))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        sim, number = self._source
        if sim.steps != number:
            raise ModelError(
                f"report of step {number} is no longer available (simulation at step {sim.steps}): read it "
                "before the next step"
            )
        report = sim.last
        for entry in fields(StepReport):
            object.__setattr__(self, entry.name, getattr(report, entry.name))
        return object.__getattribute__(self, name)

    def __repr__(self) -> str:
        return f"PendingReport(step {self._source[1]})"


@dataclass(frozen=True, eq=False)
class JointRecord:
    """Joint over time: time (steps,), or (worlds, steps) with times per world; force (worlds, steps, 3), N, and moment
    about its anchor, N m, on the child in world axes; violation (worlds, steps), m, the largest of its rows."""

    time: np.ndarray
    force: np.ndarray
    moment: np.ndarray
    violation: np.ndarray

    __repr__ = use_short_repr


@dataclass(frozen=True, eq=False)
class ContactRecord:
    """Contact over time, arrays (worlds, steps); time (steps,), or (worlds, steps) with times per world.

    Attributes:
        time: s.
        force, moment: on the body in world axes, moment about the world's origin; (worlds, steps, 3), N and N m.
        normal_force: sum of normal force magnitudes, N. In a halved step this, force and moment are means over the
            step, which conserves the impulse.
        penetration: largest depth in the step, m.
        slip: slip length in the step, m, and stick: sticking fraction at its end; means over the area in contact.
        area: reference area in contact at the end of the step, m^2; at an edge it includes points of adjacent faces.
        stored: elastic energy of the contact at the end of the step, J.
        loss, friction: energy dissipated in the step by restitution and by friction, J.
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

    __repr__ = use_short_repr


@dataclass(frozen=True, eq=False)
class ProbeRecord:
    """Probe over time: time (steps,), or (worlds, steps) with times per world, s; position, displacement and velocity
    (worlds, steps, 3), in m and m/s."""

    time: np.ndarray
    position: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray

    __repr__ = use_short_repr


def idle_report(sim: Any) -> StepReport:
    """Report of a simulation without a step since construction or resumption."""
    count = sim.model.worlds
    zero, none = np.zeros(count, int), np.zeros(count)
    counts = (zero, zero, none, zero, sim.status, none, sim.time, zero, none, zero)
    return StepReport(sim.status == 0, *counts, none, none, none)


def step_text(dt: Any) -> str:
    """Step of all worlds, s, or their range, as text."""
    low, high = float(np.min(dt)), float(np.max(dt))
    return f"{low:g} s" if low == high else f"{low:g} to {high:g} s"


def simulation_text(sim: Any) -> str:
    """One-line description of a simulation."""
    m, steps = sim.model, sim.steps
    dt = step_text(sim.dt) if sim.error is None else f"auto, error = {sim.error:g}"
    at = f"t = {float(sim.time.max()):.6g} s, {steps} steps, dt = {dt}, {sim.integrator.name}"
    if sim.load is not None:
        at = f"static, load {100.0 * float(sim.load.max()):.4g} %, {steps} load step{'s' * (steps != 1)}"
    worlds = f", {m.worlds} worlds" if m.worlds > 1 else ""
    return f"Simulation({at}, {sim.methods['solver']}, {m.slots} slots, {m.device}, {m.dtype}{worlds})"
