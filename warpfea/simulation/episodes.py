"""Episode bookkeeping for reinforcement learning: ends, statistics, stepped worlds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.step.episodes import RUN_STATISTICS, episode_kernels

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..terms.workspace import Workspace

__all__ = ["Episodes"]


class Episodes:
    """Arrays and launches of episodes; unused ones are None and launch nothing.

    Attributes:
        ends: [world] end times, s, at which worlds are frozen.
        statistics: [world, RUN_STATISTICS] statistics since the last read.
        stepped_flags: [world] flags of worlds stepped since their state was set.
    """

    def __init__(self, model: Model, work: Workspace, launch: Launcher, *, asynchronous: bool, ends: bool) -> None:
        self.worlds, self.work, self.launch = model.worlds, work, launch
        self.ends: wp.array | None = work.array("t_end", (model.worlds,), wp.float64) if ends else None
        self.statistics: wp.array | None = None
        self.stepped_flags: wp.array | None = None
        self._flags: wp.array | None = None
        self.set_run_end()
        if ends:
            work.step.world_end = self.ends
        if asynchronous:
            self.statistics = work.array("tally", (model.worlds, len(RUN_STATISTICS)), wp.float64)
            self.stepped_flags = work.array("stepped", (model.worlds,), wp.int32)
            self._clear()

    def modules(self) -> set[wp.Module]:
        """Modules launched."""
        return set() if self.statistics is None and self.ends is None else {episode_kernels().module}

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
