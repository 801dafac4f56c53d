"""States of a tape: on the device, on disk, or computed again from whole states kept now and then.

A step computed again has the bits of the first time: a whole state holds the solver's history, too.
"""

from __future__ import annotations

import os
import pathlib
import tempfile
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.checks import check_positive
from ..base.console import format_bytes
from ..base.errors import CapacityError, ModelError
from ..model.state import State
from ..terms.time_law_table import control_array
from .capacity import RESERVED_FRACTION, free_bytes

if TYPE_CHECKING:
    from .simulation import Simulation

__all__ = ["KeptStates"]


class KeptStates(list[dict[str, wp.array]]):
    """List of states of a simulation, with what else is known of the part of a step that begins there.

    With a budget the last ones are at hand, and whole ones of every `stride` steps in at most half of it; others are
    computed again where they are read, from the whole one before them, as many at a time as fit. Those within a step of
    several parts stay. With a folder all others are in its files instead.

    Args:
        sim: the simulation. names: arrays of the state.
        budget: bytes; None: the free memory. folder: of files, removed with the list.

    Attributes:
        size, whole: bytes of a state, and of a whole one.
        recomputed: number of steps computed again.
    """

    def __init__(
        self, sim: Simulation, names: Sequence[str], budget: int | None, folder: str | os.PathLike[str] | None
    ) -> None:
        super().__init__()
        self.sim, self.budget = sim, budget
        if budget is not None:
            check_positive("Adjoint", budget=budget)
        if folder is not None and not os.path.isdir(folder):
            raise ModelError(f"Adjoint: folder = {os.fspath(folder)!r} does not exist")
        self.controls = [control_array(name) for name in sim.model.terms.time_laws.controls]
        self.names = [name for name in names if name not in self.controls]
        arrays = sim.state.bytes
        self.size, self.whole = sum(arrays[name] for name in names), sum(arrays.values())
        self.files: Any = None if folder is None else tempfile.TemporaryDirectory(dir=folder)
        self.starts: list[int] = []  # index of the start of each step
        self.dt: list[Any] = []  # of each step
        self.checkpoints: dict[int, State] = {}  # by step
        self.resident: list[int] = []  # single parts of a step whose state is on the device
        self.stride, self.expected, self.recomputed = 1, 0, 0

    def expect(self, steps: int) -> None:
        """Prepare for a number of further steps.

        Raises:
            CapacityError: too many for the memory, or a budget below three states and two whole ones.
            ModelError: a budget without a folder for steps of variable length.
        """
        self.expected = len(self.starts) + steps
        free = free_bytes(self.sim.model.device)
        if self.budget is None:
            need, room = (steps + 1) * self.size, int((1 - RESERVED_FRACTION) * free) if free is not None else None
        else:
            if not self.files and (self.sim.stepper.step_size_control or self.sim.t_end is not None):
                raise ModelError("Adjoint: steps of variable length are not computed again; give folder= with budget=")
            need, room = 3 * self.size + (0 if self.files else 2 * self.whole), self.budget
            need = min(need, (self.expected + 1) * self.size)
        if room is not None and need > room:
            raise CapacityError(
                f"Adjoint: {self.expected} steps of {format_bytes(self.size)} need {format_bytes(need)} of "
                f"{format_bytes(room)}; with budget= bytes steps are computed again on the way back, with folder= they "
                "are on disk",
                bytes=need, per_world=need // self.sim.model.worlds,
            )  # fmt: skip

    def begin_step(self) -> None:
        """Before a step: keep what is needed to take it again."""
        k = len(self.starts)
        self.starts.append(len(self) - 1)
        if self.budget is None:
            return
        dt = self.sim.stepper.dt_of_step
        self.dt.append(dt if isinstance(dt, float) else wp.clone(self.sim.stepper.work.step.dt))
        beyond = k == 0 or (self.expected + 1) * self.size > self.budget
        if self.files is None and beyond and k % self.stride == 0:
            self.checkpoints[k] = self.sim.state.copy()
        while 2 * len(self.checkpoints) * self.whole > self.budget and len(self.checkpoints) > 1:
            self.stride *= 2
            self.checkpoints = {j: state for j, state in self.checkpoints.items() if j % self.stride == 0}

    def end_step(self) -> None:
        """After a step: put away what exceeds the budget."""
        if self.budget is None:
            return
        if self.files or self.starts[-1] == len(self) - 2:
            self.resident += range(self.starts[-1], len(self) - 1)
        while len(self.resident) > self._room - 1:
            self._evict(self.resident.pop(0))

    @property
    def _room(self) -> int:
        """Number of states in the budget, at least two: the ends of a part."""
        assert self.budget is not None
        taken = len(self.checkpoints) * self.whole if len(self.checkpoints) > 1 else 0
        return max((self.budget - taken) // self.size, 2)

    def _evict(self, i: int) -> None:
        item = super().__getitem__(i)
        state = {name: item.pop(name) for name in self.names}
        if self.files and not self._file(i).is_file():
            np.savez(self._file(i), **{name: array.numpy() for name, array in state.items()})

    def _file(self, i: int) -> pathlib.Path:
        return pathlib.Path(self.files.name) / f"{i}.npz"

    def __getitem__(self, i: Any) -> Any:
        item = super().__getitem__(i)
        if isinstance(i, int) and self.names[0] not in item:
            for j in [j for j in self.resident if j != i + 1]:  # the way back reads a state after its follower
                self.resident.remove(j)
                self._evict(j)
            if self.files:
                self._load_file(i)
            else:
                self._recompute(i)
        return item

    def _restore_arrays(self, i: int, state: dict[str, wp.array]) -> None:
        super().__getitem__(i).update(state)
        self.resident.append(i)

    def _load_file(self, i: int) -> None:
        specs, device = self.sim.state.specs, self.sim.model.device
        with np.load(self._file(i)) as data:
            state: dict[str, wp.array] = {
                name: wp.array(data[name], dtype=specs[name].dtype, device=device) for name in self.names
            }
        self._restore_arrays(i, state)

    def _recompute(self, i: int) -> None:
        """Compute the states up to i again, from the whole one before them."""
        sim, stepper, last = self.sim, self.sim.stepper, self.starts.index(i)
        first = max(k for k in self.checkpoints if k <= last)
        sim.statistics.sync_from_device()
        now, report, dt = sim.state.copy(), wp.clone(stepper.work.report), stepper.dt_of_step
        self._restore(self.checkpoints[first])
        for k in range(first, last + 1):
            item = super().__getitem__(self.starts[k])
            if stepper.initial_conditions is not None:
                stepper.initial_conditions.prepare(self.dt[k])
            if k > last - max(self._room - 2, 1) and self.names[0] not in item:
                self._restore_arrays(self.starts[k], {name: wp.clone(getattr(sim.state, name)) for name in self.names})
            if k < last:
                for name in self.controls:
                    wp.copy(getattr(sim.state, name), item[name])
                stepper.set_dt(self.dt[k])
                stepper.run()
                self.recomputed += 1
        self._restore(now)
        stepper.set_dt(dt)
        wp.copy(stepper.work.report, report)
        if sim.statistics.asynchronous:
            stepper.episodes.read_totals()

    def _restore(self, state: State) -> None:
        sim = self.sim
        everyone = wp.ones(sim.model.worlds, dtype=wp.int32, device=sim.model.device)
        sim.state.copy_rows(sim.stepper.launch, everyone, state)
        sim.stepper.finish_device_reset(everyone, restart=False)
