"""Prescribed motion: driven slots, with a time law per component or a rotation.

Prescribed components are no unknowns: no force is applied.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..kernels.terms.loads import load_kernels
from ..model.description import Support
from ..time_laws import TimeLaw
from .term import StepContext, part
from .time_law_table import TimeLawTable

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["Supports"]


@dataclass(eq=False)
class Drives:
    """Driven slots on the device; `arm` and `axis` for rotations."""

    slot: Any
    law: Any
    count: int
    components: Any = None
    arm: Any = None
    axis: Any = None


class Supports:
    """Driven slots of a model: `displaced` by displacement laws, `rotated` by rotations; None if unused."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.kernels = load_kernels(model.dtype)
        self.displaced: Drives | None = None
        self.rotated: Drives | None = None

    def build(self, laws: TimeLawTable) -> None:
        """Build one row per driven slot with a law for each component; contradictory laws are rejected.

        Raises:
            ModelError: two supports prescribe a component differently.
        """
        taken: dict[tuple[int, int], Any] = {}
        moved: dict[int, list[int]] = {}
        turned: list[tuple[int, int, np.ndarray, np.ndarray, np.ndarray]] = []
        for support in self.model.description.supports:
            slots = support.body.slot_offset + support.slots
            arms = _arms(support, support.rotation[0]) if support.rotation else None
            index = laws.add(support.law) if support.law is not None else -1
            for k, slot in enumerate(slots):
                node_law = support.node_laws[k] if support.node_laws else None
                own = index if node_law is None else laws.add(node_law)
                turn = support if arms is not None else None
                _check_conflict(taken, support, int(slot), (node_law or support.law, turn))
                if arms is not None:
                    assert support.rotation is not None
                    turned.append((slot, own, support.components, arms[k], support.rotation[1]))
                elif own >= 0:
                    row = moved.setdefault(int(slot), [-1, -1, -1])
                    for c in np.flatnonzero(support.components):
                        row[c] = own
        m = self.model
        if moved:
            rows = np.array([[slot, *numbers] for slot, numbers in moved.items()])
            self.displaced = Drives(
                m.array("drives", rows[:, 0], wp.int32), m.array("drives", rows[:, 1:], wp.vec3i), len(rows)
            )
        if turned:
            slot, law, components, arm, axis = (np.array(column) for column in zip(*turned))
            self.rotated = Drives(
                m.array("drives", slot, wp.int32),
                m.array("drives", law, wp.int32),
                len(turned),
                components=m.array("drives", components, wp.vec3d),
                arm=m.array("drives", arm, wp.vec3d),
                axis=m.array("drives", axis, wp.vec3d),
            )

    @part("loads")
    def drive(self, ctx: StepContext, active: wp.array) -> None:
        """Write the velocities of the driven components to work.v."""
        w, launch, k, B = ctx.work, ctx.launch, self.kernels, self.model.worlds
        if self.displaced:
            d = self.displaced
            args = [d.slot, d.law, w.time_law_values, w.q_tilde, w.step.dq_dv, active, w.v]
            launch(k.drive_displacement, (B, d.count), args)
        if self.rotated:
            d = self.rotated
            args = [d.slot, d.law, d.components, d.arm, d.axis, w.time_law_values, w.q_tilde, w.step.dq_dv, active, w.v]
            launch(k.drive_rotation, (B, d.count), args)

    def modules(self) -> set[wp.Module]:
        """Modules launched by `drive`."""
        k = self.kernels
        kernels = [k.drive_displacement] * bool(self.displaced) + [k.drive_rotation] * bool(self.rotated)
        return {kernel.module for kernel in kernels}

    def hash(self, h: Any) -> None:
        """Hash the drives."""
        for drive in (self.displaced, self.rotated):
            for values in (drive.slot, drive.law, drive.components, drive.arm, drive.axis) if drive else ():
                if values is not None:
                    h.update(values.numpy().tobytes())


def _check_conflict(taken: dict[tuple[int, int], Any], support: Support, slot: int, kind: tuple[Any, Any]) -> None:
    """Register the prescription of a component; equal ones may overlap, others raise ModelError."""
    body = support.body
    for c in np.flatnonzero(support.components):
        other = taken.setdefault((slot, int(c)), kind)
        if other is kind or (other[1] is kind[1] and _same_law(other[0], kind[0])):
            continue
        node = int(body.slot_node[slot - body.slot_offset])
        raise ModelError(
            f"body {body.name!r}: two supports prescribe component {'xyz'[c]} of node {node} differently; let "
            "one of them leave it out (components=, or a selection without the node)"
        )


def _arms(support: Support, anchor: np.ndarray) -> np.ndarray:
    """Reference values of the slots; positions relative to the anchor."""
    body = support.body
    arms = body.reference[support.slots].copy()
    position = body.slot_kind[support.slots] == 0
    arms[position] += body.origin - anchor
    return arms


def _same_law(a: TimeLaw | None, b: TimeLaw | None) -> bool:
    if a is None or b is None:
        return a is b
    same = a.function is b.function and a.control == b.control
    return same and np.array_equal(a.times, b.times) and np.array_equal(a.values, b.values)
