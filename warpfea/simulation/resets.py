"""Resets of worlds to a state, on the host or on the device."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.names import listing
from ..base.worlds import worlds_mask
from ..model.state import State
from .checks import check_mask, check_state
from .failures import check_initial_constraints

__all__ = ["Resets"]


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
