"""Gather topology, static support check."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..kernels.common.structs import topology_struct
from . import assembly

__all__ = ["check_static_supports", "make_topology"]


def make_topology(model: Any) -> Any:
    """The Topology struct: contributions of the elements, mass matrix, prescribed components."""
    topo = topology_struct(model.dtype)()
    start, entry = assembly.gather_table([b.connectivity for b in model.blocks], model.slots)
    topo.contribution_start = model.array("topology", start, wp.int32)
    topo.contribution_entry = model.array("topology", entry, wp.int32)
    topo.mass_start = model.array("mass", model.masses.matrix.indptr, wp.int32)
    topo.mass_column = model.array("mass", model.masses.matrix.indices, wp.int32)
    topo.mass_value = model.masses.values
    free = model.slot_table.free
    topo.free = model.array("slots", free, model.types.vec3)
    topo.prescribed_bits = model.array("slots", (free == 0.0) @ [1, 2, 4], wp.uint8)
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
