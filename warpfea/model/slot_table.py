"""Slots of a model: numbering by body, kinds, reference values, free components."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..base.errors import ModelError
from . import assembly

if TYPE_CHECKING:
    from .bodies import Body
    from .description import Description
    from .memory import Memory

__all__ = ["SlotTable", "number_slots"]


def number_slots(bodies: list[Body]) -> int:
    """Number the slots and elements of the bodies one after another, and return the number of slots.

    Raises:
        MeshError: an inverted element.
    """
    offset, elements_before = 0, 0
    for body in bodies:
        body.element_offset = elements_before
        elements_before += len(body.mesh.cells)
        for rule in {body.rule, body.curved_rule}:
            for part in body.family.scheme(rule):
                assembly.check_orientation(body, part)
        body.slot_offset = offset
        offset += body.slot_count
    return offset


class SlotTable:
    """Host and device tables with one row per slot.

    Attributes:
        count: number of slots.
        kind: (slots,) 0 for a position, else the number of the gradient.
        reference: (slots, 3) reference values, positions relative to the body origin, m; `reference_array`: on the
            device, with body forces.
        is_position: (slots,) 1.0 for positions, 0.0 for gradients; `is_position_array`: on the device.
        free: (slots, 3) 1.0 for unknown components, 0.0 for prescribed ones.
        clamped: (slots, 3) True for prescribed components that never move.

    Raises:
        ModelError: every component is prescribed.
    """

    def __init__(self, description: Description, memory: Memory) -> None:
        bodies = description.bodies
        self.count = number_slots(bodies)
        self.kind = np.concatenate([body.slot_kind for body in bodies])
        self.reference = np.concatenate([body.reference for body in bodies])
        self.is_position = (self.kind == 0).astype(float)
        self.is_position_array = memory.array("slots", self.is_position, memory.types.T)
        self.reference_array = None
        if description.body_forces:
            self.reference_array = memory.array("reference", self.reference, memory.types.vec3)
        self.free = np.ones((self.count, 3))
        self.clamped = np.zeros((self.count, 3), dtype=bool)
        for support in description.supports:
            rows = support.body.slot_offset + support.slots
            self.free[rows] *= 1.0 - support.components
            if support.law is None and support.node_laws is None:
                self.clamped[rows] |= support.components.astype(bool)
        if not self.free.any() and not description.contacts:
            raise ModelError("every component of every node is prescribed: nothing is left to solve for")
