"""Loads that do not depend on the iterate: gravity Eq. (24), forces and tractions Eq. (72)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.worlds import check_values_per_world, values_per_world
from ..kernels.terms.loads import load_kernels
from ..model.assembly import require_density
from .protocols import Parametrised
from .term import StepContext, part
from .time_law_table import TimeLawTable

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model

__all__ = ["DeadLoads"]


class DeadLoads(Parametrised):
    """Dead loads: assembled once per attempt into work.dead.

    Gravity, [world] on the device, is part of every model; without any load nothing is launched. With a time law of
    gravity `gravity` follows the law, and `constant_gravity`, which the load of a static path scales, is zero.
    """

    name = "dead loads"

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.kernels = load_kernels(model.dtype)
        self.gravity = model.array("loads", np.tile(model.description.gravity, (model.worlds, 1)), wp.vec3d)
        self.gravity_law = model.description.gravity_law
        self.constant_gravity = self.gravity

    @classmethod
    def of(cls, model: Model) -> DeadLoads:
        """Every model has this term, for gravity."""
        return cls(model)

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        return {
            "gravity": model.terms.dead_loads.has_gravity,
            "dead loads": bool(model.description.dead_loads),
        }

    def build(self, laws: TimeLawTable) -> None:
        m = self.model
        slots, numbers, weights = [], [], []
        for load in m.description.dead_loads:
            index = laws.add(load.law)
            slots.append(load.body.slot_offset + load.slots)
            numbers.append(np.full(len(load.slots), index))
            weights.append(load.weights)
        if self.gravity_law is not None:
            self.constant_gravity = m.array("loads", self.gravity.numpy(), wp.vec3d)
            self.gravity_law_index = laws.add(self.gravity_law)
            slots.append(np.arange(m.slots))
            numbers.append(np.full(m.slots, self.gravity_law_index))
            weights.append(m.masses.lumped[0])
        slot = np.concatenate(slots) if slots else np.zeros(0, dtype=np.int64)
        order = np.argsort(slot, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(slot, minlength=m.slots))])
        law = np.concatenate(numbers) if numbers else np.zeros(0)
        weight = np.concatenate(weights) if weights else np.zeros(0)
        explicit = any(b.key.damping == "explicit" for b in m.blocks)  # adds its force to the dead loads
        self.has_loads = bool(len(slots)) or self.has_gravity or explicit
        self.slot_start = m.array("loads", start, wp.int32)
        self.law = m.array("loads", law[order] if len(order) else np.zeros(1), wp.int32)
        table = np.repeat(weight[order][:, None], 3, axis=1) if len(order) else np.zeros((1, 3))
        self.weight = m.array("loads", table, m.types.vec3)
        self._definition = (slot, law, weight)

    @property
    def has_gravity(self) -> bool:
        """True with gravity or a time law of it."""
        return self.gravity_law is not None or bool(np.any(self.gravity.numpy()))

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        law = [self.kernels.copy_gravity.module] * (self.gravity_law is not None)
        return law + [self.kernels.dead_load.module] * self.has_loads

    def take_gravity(self, launch: Launcher, value: wp.array, active: wp.array) -> None:
        """Set gravity at the end of the attempt from the values of the time laws."""
        if self.gravity_law is not None:
            launch(self.kernels.copy_gravity, self.model.worlds, [value, self.gravity_law_index, active, self.gravity])

    @part("loads")
    def begin(self, ctx: StepContext, active: wp.array) -> None:
        """Assemble force and magnitude of all dead loads per slot."""
        if not self.has_loads:
            return
        m, w = self.model, ctx.work
        args = [
            self.slot_start,
            self.law,
            self.weight,
            w.time_law_stage_values,
            m.masses.lumped_values,
            self.constant_gravity,
            w.step.load_factor,
            active,
        ]
        ctx.launch(self.kernels.dead_load, (m.worlds, m.slots), [*args, w.dead, w.dead_magnitude])

    def set_gravity(self, gravity: Any, mask: np.ndarray) -> None:
        """Set gravity in the chosen worlds, (3,) or (worlds, 3), m/s^2.

        Raises:
            ModelError: wrong shape, a non-finite value, a material without density, or a model built without gravity or
                with a time law of it.
        """
        if self.gravity_law is not None:
            raise ModelError("the model was built with a time law of gravity, which set_gravity can't replace")
        values = values_per_world("set_gravity", "gravity", gravity, self.model.worlds, (3,))
        check_values_per_world("set_gravity", "gravity", values, ~mask | np.isfinite(values).all(axis=1), "finite")
        values = np.where(mask[:, None], values, self.gravity.numpy())
        if np.any(values):
            require_density(self.model.bodies, "gravity")
        if not self.has_loads and np.any(values):
            raise ModelError(
                "the model was built without gravity or dead loads, so their kernels were left out: build it with a "
                "gravity that is not zero"
            )
        self.gravity.assign(values)

    def parameter_arrays(self) -> dict[str, wp.array]:
        return {} if self.gravity_law is not None else {"gravity": self.gravity}

    def hash(self, h: Any) -> None:
        for values in self._definition:
            h.update(np.ascontiguousarray(values).tobytes())
