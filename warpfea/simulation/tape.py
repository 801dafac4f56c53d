"""Tape of a run: the states of all accepted parts of its steps, and probes of these.

A step is one part, or the substeps that a halving or dt="auto" makes of it. Worlds that take no part in one keep their
state in it. Such a step is taken again from its start, part by part.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.memory import convert_memory_errors
from ..base.names import did_you_mean, listing
from ..base.worlds import device_flags
from ..kernels.solvers.adjoint import adjoint_kernels
from ..kernels.step.step_control import SAME_TIME_FRACTION, STATUS
from ..model.state import MONITOR_ARRAYS, is_solver_history
from ..terms.time_law_table import control_array
from .kept_states import KeptStates
from .simulation import Simulation

__all__ = ["ProbeArrays", "Tape"]

NOT_KEPT = ("ledger", "ledger_time", "status", "adaptive", "adaptive_means", *MONITOR_ARRAYS)
"""State arrays that no step depends on."""


@dataclass(eq=False)
class ProbeArrays:
    """A probe of a tape: displacement, velocity and position, arrays (worlds, steps, 3) with gradients, m and m/s.

    Attributes:
        slot, weight, offset: its slots, each once, their weights, and its reference position.
    """

    slot: wp.array
    weight: wp.array
    offset: wp.vec3d
    displacement: wp.array
    velocity: wp.array
    position: wp.array

    @property
    def arrays(self) -> tuple[wp.array, wp.array, wp.array]:
        """The three arrays."""
        return self.displacement, self.velocity, self.position


class Tape:
    """States of a run.

    Args:
        sim: a simulation.
        budget: bytes of the states kept on the device, besides one whole state; others are computed again on the way
            back, or with a `folder` are in its files. None: all are kept.

    Attributes:
        steps: number of steps kept.
        kept: arrays of the state at the start and after each part of a step, and for the part that begins there its
            controls, the size "dt" in each world, and the "status", running in worlds that take part.
        ends: index in `kept` of the end of each step.
        restarts: by index in `kept`, flags (worlds,) of worlds whose initial accelerations are those of its state, the
            velocities (worlds, slots, 3) before, and the step, s, that they were found for.
    """

    static = False

    def __init__(
        self, sim: Simulation, budget: int | None = None, folder: str | os.PathLike[str] | None = None
    ) -> None:
        self.sim, self.model, self.budget, self.folder = sim, sim.model, budget, folder
        self.probes: dict[str, ProbeArrays] = {}
        self.clear()
        self.updates = self.model.terms.parameter_updates
        self._graph: wp.Graph | None = None  # of a step back, with the derivatives of the coefficients at hand

    @property
    def steps(self) -> int:
        """Number of steps kept."""
        return len(self.ends)

    @property
    def ended(self) -> np.ndarray:
        """Flags (worlds,) of worlds frozen at their `t_end`."""
        sim = self.sim
        if sim.t_end is None:
            return np.zeros(self.model.worlds, dtype=bool)
        there: np.ndarray = sim.time >= sim.t_end - SAME_TIME_FRACTION * sim.dt
        return there & (sim.status == STATUS["frozen"])

    def parts(self, step: int) -> list[int]:
        """Indices of the parts of a step, backwards."""
        first = self.ends[step - 1] if step else 0
        return list(reversed(range(first, self.ends[step])))

    def run(self, steps: int) -> None:
        """Advance the simulation, and keep its steps, after those kept so far unless it was reset since.

        Raises:
            ModelError: no positive whole number; parameters set since the first step; a static result.
            ConvergenceError: as `Simulation.step`. CapacityError: more bytes than the budget.
        """
        if self.static:
            raise ModelError("Adjoint: an equilibrium has no steps to run")
        if isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 1:
            raise ModelError(f"run({steps!r}): the number of steps must be a whole number, at least 1")
        if self.kept and not np.array_equal(self.kept[-1]["time"].numpy(), self.sim.time):
            self.clear()
        self._check_state()
        self.kept.expect(steps)
        if not self.kept and self.updates != self.model.terms.parameter_updates:
            self.updates, self._graph = self.model.terms.parameter_updates, None
        self._check_parameters()
        with convert_memory_errors(f"a tape of {steps} steps", self.model.device):
            if not self.kept:
                self.kept.append(self._snapshot())
            for _ in range(steps):
                self._prepare()
                controls = self._controls()
                self.kept.begin_step()
                report, stepper = self.sim.step(), self.sim.stepper
                running = (self.sim.status == STATUS["running"]) | self.ended
                running &= self.kept[-1]["time"].numpy() != self.sim.time  # others were at their end
                divided = running & ((report.halvings > 0) | bool(stepper.step_size_control))
                if divided.any():
                    self._record_substeps(divided, running, controls)
                else:
                    self._add_part(running, controls)
                self.ends.append(len(self.kept) - 1)
                self.kept.end_step()
                if self.budget is not None:
                    self._record_probes()
        self.probes.clear()

    def _prepare(self) -> None:
        """Restart accelerations before the step, and keep the state that it begins with."""
        if (initial := self.sim.stepper.initial_conditions) is not None:
            before = self.kept[-1]["velocity"].numpy().copy()
            flags = initial.prepare(self.sim.dt)
            if flags.any():
                self.kept[-1] = self._snapshot()
                self.restarts[len(self.kept) - 1] = flags, before, self.sim.dt

    def _add_part(self, chosen: np.ndarray, controls: dict[str, wp.array]) -> None:
        """Add a part of a step that the chosen worlds have taken."""
        status = np.where(chosen, STATUS["running"], STATUS["frozen"]).astype(np.int32)
        self.kept[-1] |= controls  # for the part
        self.kept[-1]["dt"] = wp.clone(self.sim.stepper.work.step.h)
        if self.sim.stepper.impact_terms:  # those taken again with backward Euler
            self.kept[-1]["impact"] = wp.clone(self.sim.stepper.work.step.impact)
        self.kept[-1]["status"] = wp.array(status, dtype=wp.int32, device=self.model.device)
        self.kept.append(self._snapshot())

    def _record_substeps(self, divided: np.ndarray, running: np.ndarray, controls: dict[str, wp.array]) -> None:
        """Take a step again in worlds that divided it, part by part."""
        s, state, flags = self.sim.stepper, self.sim.state, device_flags(divided, self.model.device)
        assert s.backup is not None
        state.copy_rows(s.launch, flags, s.backup, skip=("status",))
        s.newton.invalidate(flags)
        others = running & ~divided
        if others.any():
            self._add_part(others, controls)
        status = state.status.numpy().copy()
        state.status.assign(np.where(divided, status, STATUS["frozen"]).astype(np.int32))

        def attempt() -> None:
            s.take_attempt()
            accepted = s.work.step.accepted.numpy() != 0
            if accepted.any():
                self._add_part(accepted, controls)

        s.launch_step(attempt)
        state.status.assign(status)

    def clear(self) -> None:
        """Forget the steps kept."""
        self.kept = KeptStates(self.sim, self._kept_names(), self.budget, self.folder)
        self.ends: list[int] = []
        self.restarts: dict[int, tuple[np.ndarray, np.ndarray, float]] = {}
        self._probe_values: dict[str, list[ProbeArrays]] = {}
        self.probes.clear()

    @property
    def recomputed(self) -> int:
        """Number of steps computed again."""
        return self.kept.recomputed

    def _check_parameters(self) -> None:
        if self.model.terms.parameter_updates != self.updates:
            raise ModelError("Adjoint: parameters were set after the first step of the tape; reset the simulation")

    def _check_state(self) -> None:
        """ModelError if the state was set since the last step: its derivatives by that are not known."""
        if not self.kept:
            return
        m, state = self.model, self.sim.state
        kernel = adjoint_kernels(m.dtype, m.terms.traits.constraint_rows).count_changes
        count = wp.zeros(1, dtype=wp.int32, device=m.device)
        active = device_flags(self.sim.status == STATUS["running"], m.device)
        for name in ("displacement", "velocity"):
            args = [self.kept[-1][name], getattr(state, name), active, count]
            self.sim.stepper.launch(kernel, (m.worlds, m.slots), args)
        if count.numpy()[0]:
            raise ModelError("Adjoint: the state was set after the first step of the tape; reset the simulation, or "
                             "clear() the tape")  # fmt: skip

    def _kept_names(self) -> list[str]:
        return [name for name in self.sim.state.names if not is_solver_history(name) and name not in NOT_KEPT]

    def _snapshot(self) -> dict[str, wp.array]:
        return {name: wp.clone(getattr(self.sim.state, name)) for name in self._kept_names()}

    def _controls(self) -> dict[str, wp.array]:
        names = [control_array(name) for name in self.model.terms.time_laws.controls]
        return {name: wp.clone(getattr(self.sim.state, name)) for name in names}

    def probe(self, name: str) -> ProbeArrays:
        """Probe of the steps kept; the derivatives of a loss by its arrays are their `.grad`."""
        known = [p.name for p in self.model.description.probes]
        if name not in known:
            raise ModelError(f"probe {name!r} is unknown; there are: {listing(known)}{did_you_mean(name, known)}")
        if name not in self.probes:
            out = self.probes[name] = self._empty_probe(name, self.steps)
            for k, end in enumerate(self.ends):
                if self.budget is None:
                    self._evaluate_probe(out, k, self.end_of_part(end))
                else:
                    for array, value in zip(out.arrays, self._probe_values[name][k].arrays):
                        wp.copy(array[:, k], value[:, 0])
        return self.probes[name]

    def end_of_part(self, k: int) -> dict[str, wp.array]:
        """The state kept at an index, with the velocities before a restart of accelerations there."""
        if k not in self.restarts:
            return self.kept[k]
        before: wp.array = wp.array(self.restarts[k][1], dtype=self.model.types.vec3, device=self.model.device)
        return self.kept[k] | {"velocity": before}

    def _empty_probe(self, name: str, steps: int) -> ProbeArrays:
        m = self.model
        (given,) = [probe for probe in m.description.probes if probe.name == name]
        slots, index = np.unique(given.body.slot_offset + given.slots, return_inverse=True)
        weights = np.bincount(index, weights=given.weights)
        new = {"dtype": wp.float64, "device": m.device, "requires_grad": True}
        arrays: list[Any] = [wp.zeros((m.worlds, steps, 3), **new) for _ in range(3)]
        slot: wp.array = wp.array(slots, dtype=wp.int32, device=m.device)
        weight: wp.array = wp.array(weights, dtype=m.types.T, device=m.device)
        return ProbeArrays(slot, weight, wp.vec3d(*given.X), *arrays)

    def _evaluate_probe(self, out: ProbeArrays, k: int, end: dict[str, wp.array]) -> None:
        m = self.model
        kernel = adjoint_kernels(m.dtype, m.terms.traits.constraint_rows).probe_values
        args = [out.slot, out.weight, out.offset, end["displacement"], end["velocity"], k, *out.arrays]
        self.sim.stepper.launch(kernel, m.worlds, args)

    def _record_probes(self) -> None:
        """Keep the values of all probes at the last step, whose state may not stay."""
        for probe in self.model.description.probes:
            out = self._empty_probe(probe.name, 1)
            self._evaluate_probe(out, 0, self.kept[-1])
            self._probe_values.setdefault(probe.name, []).append(out)
