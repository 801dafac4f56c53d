"""What loops of learning keep on the device: where worlds end, what steps add up to, which worlds have stepped."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.step.loops import TALLY, loop_kernels

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..terms.workspace import Workspace

__all__ = ["Loops"]


class Loops:
    """Their arrays and launches; those that a simulation does not ask for are None and launch nothing.

    Attributes:
        ends: [world] s, where worlds are frozen.
        tally: [world, TALLY] of the steps since it was last taken; stepped: [world] since their state was set.
    """

    def __init__(self, model: Model, work: Workspace, launch: Launcher, *, quiet: bool, ends: bool) -> None:
        self.worlds, self.work, self.launch = model.worlds, work, launch
        self.ends: wp.array | None = work.array("t_end", (model.worlds,), wp.float64) if ends else None
        self.tally: wp.array | None = None
        self.stepped: wp.array | None = None
        self._flags: wp.array | None = None
        self.stop_at()
        if ends:
            work.step.ends = self.ends
        if quiet:
            self.tally = work.array("tally", (model.worlds, len(TALLY)), wp.float64)
            self.stepped = work.array("stepped", (model.worlds,), wp.int32)
            self._clear()

    def modules(self) -> set[wp.Module]:
        """Modules that it launches."""
        return set() if self.tally is None and self.ends is None else {loop_kernels().module}

    def stop_at(self, end: float = math.inf, steps: int = 0) -> None:
        """A run of so many steps begins, whose last one is to meet its end, s; inf: it is over."""
        # the steps add up to the end but for their roundings
        self.work.step.stop.assign(np.array([end, steps * math.ulp(end) if steps else 0.0]))

    def end(self) -> None:
        """A step begins, or has been reported: worlds that are at their end take no further part."""
        step = self.work.step
        if self.ends is not None:
            self.launch(loop_kernels().end_episodes, self.worlds, [step.time, self.ends, step.dt, step.status])

    def close(self) -> None:
        """A step has been reported."""
        if self.tally is not None:
            self.launch(loop_kernels().tally, self.worlds, [self.work.report, self.tally, self.stepped])
        self.end()

    def take(self) -> tuple[np.ndarray, np.ndarray]:
        """What steps have added up to (worlds, TALLY), which begins anew, and which worlds have stepped (worlds,)."""
        assert self.tally is not None
        assert self.stepped is not None
        sums = self.tally.numpy().copy()
        self._clear()
        return sums, self.stepped.numpy() != 0

    def _clear(self) -> None:
        assert self.tally is not None
        self.launch(loop_kernels().clear_tally, self.tally.shape, [self.tally])

    def flags(self, mask: wp.array) -> wp.array:
        """A mask of int32 or bool as int32, always in the same array: what is reset may be the mask itself."""
        if self._flags is None:
            self._flags = wp.zeros(self.worlds, dtype=wp.int32, device=mask.device)
        if mask.dtype == wp.int32:
            wp.copy(self._flags, mask)
        else:
            wp.utils.array_cast(mask, self._flags)
        return self._flags

    def unstep(self, worlds: np.ndarray | wp.array) -> None:
        """The chosen worlds, a mask or flags on the device, have not stepped since their state was set."""
        if self.stepped is None:
            return
        if isinstance(worlds, wp.array):
            self.launch(loop_kernels().clear_chosen, self.worlds, [worlds, self.stepped])
        else:
            self.stepped.assign(np.where(worlds, 0, self.stepped.numpy()))

    def take_numbers(self, flags: wp.array, source: Any, target: wp.array) -> None:
        """Copy a number of the flagged worlds, on the device."""
        self.launch(loop_kernels().copy_chosen, self.worlds, [flags, source, target])
