"""Slots of a model: numbering by body, kinds, reference values, free components; gather topology, support check."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..kernels.common.structs import topology_struct
from . import assembly

if TYPE_CHECKING:
    from ..base.memory import Memory
    from .bodies import Body
    from .description import Description

__all__ = ["SlotTable", "check_static_supports", "make_topology", "number_slots"]


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


def make_topology(model: Any) -> Any:
    """The Topology struct: contributions of the elements, mass matrix, prescribed components."""
    topo = topology_struct(model.dtype)()
    start, entry = assembly.gather_table([b.connectivity for b in model.blocks], model.slots)
    matrix, free, fill = model.masses.matrix, model.slot_table.free, model.memory.fill
    fill(topo, "topology", contribution_start=start, contribution_entry=entry)
    fill(topo, "mass", mass_start=matrix.indptr, mass_column=matrix.indices)
    topo.mass_value = model.masses.values
    fill(topo, "slots", free=free, prescribed_bits=(free == 0.0) @ [1, 2, 4])
    model.terms.add_pool_topology(topo)
    return topo


def check_static_supports(model: Any) -> None:
    """Raise ModelError for an unconstrained rigid-body mode."""
    state, table = model.state(), model.slot_table
    touches = model.description.contacts
    held_by = "hold what rests on contact with solve_static(stabilise=True), " if touches else ""
    for label in range(model.components.count):
        slots = np.flatnonzero(model.components.of_slot == label)
        parts, part = np.unique(model.components.mesh_of_slot[slots], return_inverse=True)
        motions = np.zeros((len(parts), 6, len(slots), 3))
        for k in range(len(parts)):
            own = np.flatnonzero(part == k)
            motions[k][:, own] = assembly.rigid_modes(table.reference[slots[own]], table.kind[slots[own]])
        modes = motions.reshape(6 * len(parts), -1)
        modes /= np.linalg.norm(modes, axis=1)[:, None]
        held = modes[:, (table.free[slots] == 0.0).ravel()]
        columns = (3 * slots[:, None] + np.arange(3)).ravel()
        for rows in model.terms.restraints(state, label):
            held = np.hstack([held, (rows[:, columns] @ modes.T).T / model.size])
        turned, values, _ = (
            np.linalg.svd(held, full_matrices=True) if held.size else (np.eye(len(modes)), np.zeros(0), 0)
        )
        rank = int(np.sum(values > 1e-9))
        free = len(modes) - rank
        if free:
            moves = (turned[:, rank:] ** 2).reshape(len(parts), -1).sum(axis=1)  # amplitude of each part
            loose = slots[part == int(np.argmax(moves > 1e-6))]
            first = loose[0]
            body = next(b for b in model.bodies if b.slot_offset <= first < b.slot_offset + b.slot_count)
            raise ModelError(
                f"{_piece_text(body, loose)} has {free} unconstrained rigid-body mode{'s' * (free > 1)}: no unique "
                f"static equilibrium (gravity does not count as a support): clamp or drive more nodes, {held_by}or "
                "let a damped dynamic run come to rest"
            )


def _piece_text(body: Any, slots: np.ndarray) -> str:
    """Text of a body, or of a disconnected piece of it, with these model slots."""
    inside = np.zeros(body.slot_count, dtype=bool)
    inside[slots - body.slot_offset] = True
    if inside.all():
        return f"body {body.name!r}"
    elements = int(inside[body.connectivity[:, 0]].sum())
    position = body.slot_kind == 0
    places = body.reference[inside & position] + body.origin
    center = ", ".join(f"{x + 0.0:.4g}" for x in np.round(0.5 * (places.min(axis=0) + places.max(axis=0)), 12))
    return (
        f"a piece of body {body.name!r} that shares no node with the rest ({elements} of {len(body.connectivity)} "
        f"elements, {len(places)} of {int(position.sum())} nodes, around ({center}) m)"
    )
