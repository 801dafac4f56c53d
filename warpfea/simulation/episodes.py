"""Episode bookkeeping for reinforcement learning: ends, statistics, stepped worlds; resets of worlds to a state, on the
host or on the device."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.names import listing
from ..base.worlds import worlds_mask
from ..kernels.step.episodes import RUN_STATISTICS, episode_kernels
from ..model.state import State
from .checks import check_mask, check_state
from .failures import check_initial_constraints

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..terms.workspace import Workspace

__all__ = ["Episodes", "Resets"]


class Episodes:
    """Arrays and launches of episodes; unused ones are None and launch nothing.

    Attributes:
        ends: [world] end times, s, at which worlds are frozen.
        statistics: [world, RUN_STATISTICS] statistics since the last read.
        stepped_flags: [world] flags of worlds stepped since their state was set.
        in_use: a step launches kernels of episodes.
    """

    def __init__(self, model: Model, work: Workspace, launch: Launcher, *, asynchronous: bool, ends: bool) -> None:
        self.worlds, self.work, self.launch = model.worlds, work, launch
        self.ends: wp.array | None = work.array("t_end", (model.worlds,), wp.float64) if ends else None
        self.statistics: wp.array | None = None
        self.stepped_flags: wp.array | None = None
        self._flags: wp.array | None = None
        self.in_use = ends or asynchronous
        self.set_run_end()
        if ends:
            work.step.world_end = self.ends
        if asynchronous:
            self.statistics = work.array("tally", (model.worlds, len(RUN_STATISTICS)), wp.float64)
            self.stepped_flags = work.array("stepped", (model.worlds,), wp.int32)
            self._clear()

    def modules(self) -> set[wp.Module]:
        """Modules launched."""
        return {episode_kernels().module} if self.in_use else set()

    def set_run_end(self, end: float = math.inf, steps: int = 0) -> None:
        """Set the end, s, and the number of steps of a run; inf: no run."""
        # summed steps reach the end up to round-off
        self.work.step.run_end.assign(np.array([end, steps * math.ulp(end) if steps else 0.0]))

    def freeze_finished(self) -> None:
        """Freeze worlds that have reached their end time, at the start of a step or after its report."""
        step = self.work.step
        if self.ends is not None:
            self.launch(episode_kernels().end_episodes, self.worlds, [step.time, self.ends, step.dt, step.status])

    def end_step(self) -> None:
        """Accumulate the statistics of a reported step."""
        if self.statistics is not None:
            self.launch(
                episode_kernels().add_statistics, self.worlds, [self.work.report, self.statistics, self.stepped_flags]
            )
        self.freeze_finished()

    def read_totals(self) -> tuple[np.ndarray, np.ndarray]:
        """Read and reset the statistics (worlds, RUN_STATISTICS); also the stepped worlds (worlds,)."""
        assert self.statistics is not None
        assert self.stepped_flags is not None
        sums = self.statistics.numpy().copy()
        self._clear()
        return sums, self.stepped_flags.numpy() != 0

    def _clear(self) -> None:
        assert self.statistics is not None
        self.launch(episode_kernels().clear_statistics, self.statistics.shape, [self.statistics])

    def copy_mask_to_flags(self, mask: wp.array) -> wp.array:
        """Copy a mask of int32 or bool to a persistent int32 array: the mask itself may be reset."""
        if self._flags is None:
            self._flags = wp.zeros(self.worlds, dtype=wp.int32, device=mask.device)
        if mask.dtype == wp.int32:
            wp.copy(self._flags, mask)
        else:
            wp.utils.array_cast(mask, self._flags)
        return self._flags

    def clear_stepped(self, worlds: np.ndarray | wp.array) -> None:
        """Mark the chosen worlds (host mask or device flags) as not stepped since their state was set."""
        if self.stepped_flags is None:
            return
        if isinstance(worlds, wp.array):
            self.launch(episode_kernels().clear_flagged, self.worlds, [worlds, self.stepped_flags])
        else:
            self.stepped_flags.assign(np.where(worlds, 0, self.stepped_flags.numpy()))

    def copy_flagged(self, flags: wp.array, source: Any, target: wp.array) -> None:
        """Copy one value of the flagged worlds on the device."""
        self.launch(episode_kernels().copy_flagged, self.worlds, [flags, source, target])


class Resets:
    """Resets of the worlds of a simulation.

    Attributes:
        initial_state: initial state of the model, for resets on the device; None before the first.
    """

    def __init__(self, sim: Any) -> None:
        self.sim, self.model, self.state = sim, sim.model, sim.state
        self.stepper, self.statistics = sim.stepper, sim.statistics
        self.initial_state: State | None = None
        self._writes = -1

    def reset(self, mask: Any = None, state: State | None = None) -> None:
        """Reset worlds to a state, by default the model's initial one.

        Args:
            mask: [world] of True and False, or indices of worlds, by default all; or a Warp array of int32 or bool
                [world] on the model's device: nothing is read back then, joints and overlaps are not checked, and
                worlds end bitwise equal to a run from that state.
            state: target state. With a Warp array as the mask it must come from a simulation of this model, such as a
                copy by `sim.state.copy()`.

        Raises:
            ModelError: another shape or device, or a state that lacks arrays of the simulation.
            ConstraintError: violated joints in that state.
        """
        if isinstance(mask, wp.array):
            self._reset_on_device(mask, state)
            return
        mask = worlds_mask("reset", mask, self.model.worlds)
        source = self.model.state() if state is None else state
        check_state(self.model, source)
        self.statistics.times_differ |= bool(mask.any() and not mask.all())
        fresh = source.numpy()
        values = self.state.numpy()
        for name, array in values.items():
            spec = self.state.specs[name]
            array[mask] = fresh[name][mask] if name in fresh else np.asarray(spec.initial)
        self.state.load(values)
        self.stepper.invalidate(mask)
        self.statistics.clear_stepped(mask)
        self.stepper.start_terms(mask)
        if self.model.constraints:
            check_initial_constraints(self.sim, mask)
        if self.stepper.ledger:
            self.stepper.restart_ledger(mask)

    def _reset_on_device(self, mask: wp.array, state: State | None) -> None:
        check_mask(mask, self.model)
        if state is None:
            written = self.model.terms.parameter_updates
            if self.initial_state is None or self._writes != written:
                self.initial_state, self._writes = self._make_initial_state(), written
            state = self.initial_state
        check_state(self.model, state)
        if lacks := [name for name in self.state.names if name not in state.names]:
            raise ModelError(f"reset: state lacks {listing(lacks)}: pass a copy of sim.state")
        self.statistics.times_differ = True
        flags = self.stepper.episodes.copy_mask_to_flags(mask)
        self.state.copy_rows(self.stepper.launch, flags, state)
        self.stepper.finish_device_reset(flags)
        if self.statistics.asynchronous:
            self.stepper.episodes.clear_stepped(flags)
            self.statistics.unsynced = True
        else:
            self.statistics.stepped_worlds[flags.numpy() != 0] = False

    def _make_initial_state(self) -> State:
        """Initial state of a simulation from the model's initial state, without changing the present one."""
        self.stepper.update_parameters()
        now, stepped = self.state.copy(), self.statistics.stepped_worlds.copy()
        everyone = wp.ones(self.model.worlds, dtype=wp.int32, device=self.model.device)
        try:
            self.reset()
            return self.state.copy()
        finally:
            self.state.copy_rows(self.stepper.launch, everyone, now)
            self.stepper.finish_device_reset(everyone, restart=False)
            self.statistics.stepped_worlds = stepped
            if self.stepper.episodes.stepped_flags is not None:
                self.stepper.episodes.stepped_flags.assign(stepped.astype(np.int32))
