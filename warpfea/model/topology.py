"""Gather topology, connected components, free bodies, static support check."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..base.errors import ModelError
from ..kernels.common.structs import topology_struct
from ..kernels.solvers.pcg import free_groups_struct
from . import assembly

__all__ = ["check_static_supports", "label_components", "make_free_groups", "make_topology"]


def make_topology(model: Any) -> Any:
    """The Topology struct: contributions of the elements, mass matrix, prescribed components."""
    topo = topology_struct(model.dtype)()
    start, entry = assembly.gather_table([b.connectivity for b in model.blocks], model.slots)
    topo.contribution_start = model.array("topology", start, wp.int32)
    topo.contribution_entry = model.array("topology", entry, wp.int32)
    topo.mass_start = model.array("mass", model.mass_host.indptr, wp.int32)
    topo.mass_column = model.array("mass", model.mass_host.indices, wp.int32)
    topo.mass_value = model.masses.values
    topo.free = model.array("slots", model.free_host, model.types.vec3)
    topo.prescribed_bits = model.array("slots", (model.free_host == 0.0) @ [1, 2, 4], wp.uint8)
    model.terms.add_pool_topology(topo)
    return topo


def label_components(graph: sp.csr_matrix, groups: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Connected component of each slot: by elements alone, and with constraints, given as `groups` of slots."""
    part = assembly.connected_components(graph)
    if not groups:
        return part, part
    ties = sp.lil_matrix((part.max() + 1, part.max() + 1))
    for slots in groups:
        parts = np.unique(part[slots])
        ties[parts[0], parts] = 1.0
    return part, assembly.connected_components(ties.tocsr())[part]


def make_free_groups(model: Any) -> tuple[Any, int]:
    """Components with an unconstrained translation, on the device, and their number (DESIGN 5).

    Only the mass resists their translations: each solve is corrected for them, so that momentum is conserved.
    """
    label, count = model.component, model.component_count
    free = np.ones((count, 3))
    for c in range(3):
        free[np.unique(label[model.free_host[:, c] == 0.0]), c] = 0.0
    model.terms.mark_constrained(free)
    keep = np.flatnonzero(free.any(axis=1))
    groups = free_groups_struct(model.dtype)()
    if not len(keep):
        return groups, 0
    number = np.full(count, -1)
    number[keep] = np.arange(len(keep))
    of_slot = number[label]
    slots = np.flatnonzero((of_slot >= 0) & (model.slot_kind == 0))
    slots = slots[np.argsort(of_slot[slots], kind="stable")]
    start = np.concatenate([[0], np.cumsum(np.bincount(of_slot[slots], minlength=len(keep)))])
    groups.start = model.array("groups", start, wp.int32)
    groups.slot = model.array("groups", slots, wp.int32)
    groups.group_of_slot = model.array("groups", of_slot, wp.int32)
    groups.is_position, groups.lumped_mass = model.is_position, model.masses.lumped_values
    model.cache["free groups"] = of_slot, slots, len(keep)
    groups.mass = model.array("groups", model.masses.group_masses(*model.cache["free groups"]), model.types.T)
    groups.free_directions = model.array("groups", free[keep], model.types.vec3)
    return groups, len(keep)


def check_static_supports(model: Any) -> None:
    """Raise ModelError for an unconstrained rigid-body mode."""
    state = model.state()
    touches = model.description.all_contacts
    held_by = "hold what rests on contact with solve_static(stabilise=True), " if touches else ""
    for label in range(model.component_count):
        slots = np.flatnonzero(model.component == label)
        parts, part = np.unique(model.mesh_component[slots], return_inverse=True)
        motions = np.zeros((len(parts), 6, len(slots), 3))
        for k in range(len(parts)):
            own = np.flatnonzero(part == k)
            motions[k][:, own] = assembly.rigid_modes(model.reference[slots[own]], model.slot_kind[slots[own]])
        modes = motions.reshape(6 * len(parts), -1)
        modes /= np.linalg.norm(modes, axis=1)[:, None]
        held = modes[:, (model.free_host[slots] == 0.0).ravel()]
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
