"""Prescribed motion: driven slots, with a time law per component or a rotation.

Prescribed components are no unknowns: no force is applied.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..kernels.terms.loads import load_kernels
from ..kernels.terms.shape_gradients import shape_kernels
from ..model.description import Support
from ..time_laws import TimeLaw
from .gradients import Gradient, StepAdjoint, law_weights
from .term import StepContext, part
from .time_law_table import TimeLawTable

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["Supports"]


@dataclass(eq=False)
class DrivenSlots:
    """Driven slots on the device.

    Attributes:
        slot: (count,) model slots.
        law: indices of time laws: three per slot for displacements (-1: free component), one for rotations.
        components: flags of the driven components; arm: reference value relative to the anchor, m; axis: unit vector;
            (count, 3), for rotations only.
    """

    slot: Any
    law: Any
    count: int
    components: Any = None
    arm: Any = None
    axis: Any = None


class Supports:
    """Driven slots of a model, by displacement laws and by rotations, None if unused; `in_use`: one of them is."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.kernels = load_kernels(model.dtype)
        self.displacement_drives: DrivenSlots | None = None
        self.rotation_drives: DrivenSlots | None = None
        self.in_use = False

    def build(self, laws: TimeLawTable) -> None:
        """Build one row per driven slot with a law for each component; contradictory laws are rejected.

        Raises:
            ModelError: two supports prescribe a component differently.
        """
        taken: dict[tuple[int, int], Any] = {}
        displacement_rows: dict[int, list[int]] = {}
        rotation_rows: list[tuple[int, int, np.ndarray, np.ndarray, np.ndarray]] = []
        for support in self.model.description.supports:
            slots = support.body.slot_offset + support.slots
            arms = _lever_arms(support, support.rotation.anchor) if support.rotation else None
            index = laws.add(support.law) if support.law is not None else -1
            for k, slot in enumerate(slots):
                node_law = support.node_laws[k] if support.node_laws else None
                own = index if node_law is None else laws.add(node_law)
                turn = support if arms is not None else None
                _check_conflict(taken, support, int(slot), (node_law or support.law, turn))
                if arms is not None:
                    assert support.rotation is not None
                    rotation_rows.append((slot, own, support.components, arms[k], support.rotation.axis))
                elif own >= 0:
                    row = displacement_rows.setdefault(int(slot), [-1, -1, -1])
                    for c in np.flatnonzero(support.components):
                        row[c] = own
        m = self.model
        self.in_use = bool(displacement_rows or rotation_rows)
        if displacement_rows:
            rows = np.array([[slot, *numbers] for slot, numbers in displacement_rows.items()])
            self.displacement_drives = DrivenSlots(
                m.array("drives", rows[:, 0], wp.int32), m.array("drives", rows[:, 1:], wp.vec3i), len(rows)
            )
        if rotation_rows:
            slot, law, components, arm, axis = (np.array(column) for column in zip(*rotation_rows))
            self.rotation_drives = DrivenSlots(
                m.array("drives", slot, wp.int32),
                m.array("drives", law, wp.int32),
                len(rotation_rows),
                components=m.array("drives", components, wp.vec3d),
                arm=m.array("drives", arm, wp.vec3d),
                axis=m.array("drives", axis, wp.vec3d),
            )

    @part("loads")
    def drive(self, ctx: StepContext, active: wp.array) -> None:
        """Write the velocities of the driven components to work.v."""
        w, launch, k, B = ctx.work, ctx.launch, self.kernels, self.model.worlds
        if self.displacement_drives:
            d = self.displacement_drives
            args = [d.slot, d.law, w.time_law_values, w.q_tilde, w.step.dq_dv, active, w.v]
            launch(k.drive_displacement, (B, d.count), args)
        if self.rotation_drives:
            d = self.rotation_drives
            args = [d.slot, d.law, d.components, d.arm, d.axis, w.time_law_values, w.q_tilde, w.step.dq_dv, active, w.v]
            launch(k.drive_rotation, (B, d.count), args)

    def driven(self) -> np.ndarray:
        """(slots, 3) 1 on driven components."""
        out = np.zeros((self.model.slots, 3))
        if d := self.displacement_drives:
            out[d.slot.numpy()] += d.law.numpy() >= 0
        if d := self.rotation_drives:
            out[d.slot.numpy()] += d.components.numpy() != 0.0
        return (out > 0.0).astype(float)

    def law_gradients(self, law: int) -> list[Gradient]:
        """Functions that add the derivative of the loss by the value of a time law."""
        out = list[Gradient]()
        d, turn = self.displacement_drives, self.rotation_drives
        if d and (d.law.numpy() == law).any():
            out.append(law_weights(self.model, d.slot.numpy(), d.law.numpy() == law, prescribed=True))

        def add(at: StepAdjoint, into: wp.array) -> None:
            assert turn is not None
            w = at.ctx.work
            w.rows.zero_()
            args = [turn.slot, turn.law, law, turn.components, turn.arm, turn.axis, w.time_law_values]
            at.ctx.launch(at.kernels.rotation_rows, (self.model.worlds, turn.count), [*args, at.drive_bar, at.active,
                                                                                     w.rows])  # fmt: skip
            at.add(into)

        return [*out, add] if turn and (turn.law.numpy() == law).any() else out

    def shape_gradients(self) -> list[Callable[[], Gradient]]:
        """Makers of the function that adds the derivative by the arms of rotations."""
        turn = self.rotation_drives

        def make() -> Gradient:
            kernel = shape_kernels(self.model.dtype).rotation_shape

            def add(at: StepAdjoint, out: wp.array) -> None:
                assert turn is not None
                args = [turn.slot, turn.law, turn.components, turn.axis, at.ctx.work.time_law_values, at.drive_bar]
                at.ctx.launch(kernel, (self.model.worlds, turn.count), [*args, at.active, out])

            return add

        return [make] if turn else []

    def modules(self) -> set[wp.Module]:
        """Modules launched by `drive`."""
        k = self.kernels
        kernels = [k.drive_displacement] * bool(self.displacement_drives) + [k.drive_rotation] * bool(
            self.rotation_drives
        )
        return {kernel.module for kernel in kernels}

    def hash(self, h: Any) -> None:
        """Hash the drives."""
        for drive in (self.displacement_drives, self.rotation_drives):
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


def _lever_arms(support: Support, anchor: np.ndarray) -> np.ndarray:
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
