"""Connected components of a model, components with free translations, and residual groups within components: connected
slots of similar stiffness, each with its own convergence norm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..kernels.solvers.pcg import free_groups_struct
from . import assembly
from .assembly import connected_components

__all__ = ["Components"]

STIFFNESS_RATIO = 30.0
"""Largest ratio of successive stiffnesses in one class."""


class Components:
    """Connected components of the slots, and what the solvers measure or correct for each of them.

    Attributes:
        mesh_of_slot, of_slot: (slots,) component, by elements alone and also by constraints.
        count: number of components of `of_slot`; `of_slot_array`: on the device, with several.
        residual_groups: groups of slots whose residuals are measured together by the solver: of one component and
            similar stiffness; `error_estimate_groups`: those of the error estimate, of one mesh component.
        free_groups, free_group_count: components with an unconstrained translation: device struct and number.
    """

    def __init__(self, model: Any) -> None:
        self.mesh_of_slot = self.of_slot = assembly.connected_components(assembly.slot_graph(model.blocks, model.slots))
        ties = model.terms.tied_slots()
        if ties:
            part = self.mesh_of_slot
            links = sp.lil_matrix((part.max() + 1, part.max() + 1))
            for slots in ties:
                parts = np.unique(part[slots])
                links[parts[0], parts] = 1.0
            self.of_slot = assembly.connected_components(links.tocsr())[part]
        self.count = int(self.of_slot.max()) + 1

    def upload(self, model: Any) -> None:
        """Upload the groups, once the terms are built."""
        self.residual_groups = slot_groups(model, self.of_slot)
        self.error_estimate_groups = slot_groups(model, self.mesh_of_slot)
        if self.count > 1:
            self.of_slot_array = model.array("components", self.of_slot, wp.int32)
        self.free_groups, self.free_group_count = self._make_free_groups(model)

    def _make_free_groups(self, model: Any) -> tuple[Any, int]:
        """Components with an unconstrained translation, on the device, and their number.

        Only the mass resists their translations: each solve is corrected for them, so that momentum is conserved.
        """
        free, table = np.ones((self.count, 3)), model.slot_table
        for c in range(3):
            free[np.unique(self.of_slot[table.free[:, c] == 0.0]), c] = 0.0
        model.terms.mark_constrained(free)
        keep = np.flatnonzero(free.any(axis=1))
        groups = free_groups_struct(model.dtype)()
        if not len(keep):
            return groups, 0
        number = np.full(self.count, -1)
        number[keep] = np.arange(len(keep))
        of_slot = number[self.of_slot]
        slots = np.flatnonzero((of_slot >= 0) & (table.kind == 0))
        slots = slots[np.argsort(of_slot[slots], kind="stable")]
        start = np.concatenate([[0], np.cumsum(np.bincount(of_slot[slots], minlength=len(keep)))])
        groups.is_position, groups.lumped_mass = table.is_position_array, model.masses.lumped_values
        model.cache["free groups"] = of_slot, slots, len(keep)
        mass = model.masses.group_masses(*model.cache["free groups"])
        model.memory.fill(
            groups, "groups", start=start, slot=slots, group_of_slot=of_slot, mass=mass, free_directions=free[keep]
        )
        return groups, len(keep)


def stiffness_classes(stiffness: np.ndarray, label: np.ndarray) -> np.ndarray:
    """(n,) class number, from 0 for the softest, of similar `stiffness` (n,) within each `label`."""
    out = np.zeros(len(stiffness), dtype=np.int64)
    for one in np.unique(label):
        values, which = np.unique(stiffness[label == one], return_inverse=True)
        out[label == one] = np.append(0, np.cumsum(values[1:] > STIFFNESS_RATIO * values[:-1]))[which.ravel()]
    return out


def slenderness(model: Any) -> np.ndarray:
    """(parts,) squared ratio of the least to the largest radius of gyration of each part: softening by bending.

    With x = sum_i s_i E_i the second moments of a part are E^T M E.
    """
    E, M = model.slot_table.reference, model.masses.matrix
    count = int(model.components.mesh_of_slot.max()) + 1
    rows = np.column_stack([np.ones(model.slots) * model.slot_table.is_position, E])
    moments = np.zeros((count, 4, 4))
    np.add.at(moments, model.components.mesh_of_slot, rows[:, :, None] * (M @ rows)[:, None, :])
    mass, centre = moments[:, 0, 0], moments[:, 0, 1:] / moments[:, :1, 0]
    second = moments[:, 1:, 1:] / mass[:, None, None] - centre[:, :, None] * centre[:, None, :]
    least, _, largest = np.linalg.eigvalsh(second).T
    return np.maximum(least / largest, 1e-12)


def stiffness_pieces(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Piece of similar stiffness, softest first, of each slot, and of each element in block order.

    A piece is connected by elements of one stiffness class and by constraints: stiff bodies on both sides of a soft
    one are two pieces, since a small residual relative to the loaded one's forces displaces the other far. A slot
    between materials belongs to the stiffest, which dominates its forces; an element to its softest slot. Moduli are
    those of the model as built.
    """
    parts = [host for block in model.blocks for host in block.host_blocks]
    first = np.concatenate([host.conn[:, 0] + host.body.slot_offset for host in parts])
    mu = np.concatenate([np.full(len(host.conn), host.body.materials[host.material][1].lame[1]) for host in parts])
    parts_of = model.components
    of_element = stiffness_classes(mu * slenderness(model)[parts_of.mesh_of_slot[first]], parts_of.of_slot[first])
    of_slot = np.zeros(model.slots, dtype=np.int64)
    connectivity = [block.connectivity for block in model.blocks]
    ends = np.cumsum([len(conn) for conn in connectivity])[:-1]
    of_block = np.split(of_element, ends)
    for conn, classes in zip(connectivity, of_block):
        np.maximum.at(of_slot, conn, classes[:, None])
    sets = [np.where(of_slot[conn] == own[:, None], conn, -1) for conn, own in zip(connectivity, of_block)]
    for tie in model.terms.tied_slots():
        sets += [tie[of_slot[tie] == one][None] for one in np.unique(of_slot[tie])]
    piece = np.unique(of_slot * model.slots + connected_slots(sets, model.slots), return_inverse=True)[1].ravel()
    softest = [conn[np.arange(len(conn)), of_slot[conn].argmin(axis=1)] for conn in connectivity]
    return piece, piece[np.concatenate(softest)]


def connected_slots(sets: list[np.ndarray], slots: int) -> np.ndarray:
    """(slots,) connected component number from the rows of `sets`, (n, m) slots padded with -1."""
    count = np.cumsum([0] + [len(rows) for rows in sets])
    row = np.concatenate([np.repeat(first + np.arange(len(rows)), rows.shape[1]) for first, rows in zip(count, sets)])
    slot = np.concatenate([rows.ravel() for rows in sets])
    row, slot = row[slot >= 0] + slots, slot[slot >= 0]
    n = slots + count[-1]
    return connected_components(sp.coo_matrix((np.ones(len(row)), (row, slot)), shape=(n, n)).tocsr())[:slots]


@dataclass(frozen=True)
class SlotGroups:
    """Slots and elements by group, on the device; with one group the lists are empty (all in order).

    Attributes:
        slot_start, element_start: [group + 1] into slot and element.
        component: [group] connected component of the model.
    """

    count: int
    slot_start: wp.array
    slot: wp.array
    element_start: wp.array
    element: wp.array
    component: wp.array


def slot_groups(model: Any, label: np.ndarray) -> SlotGroups:
    """Groups of one `label` (slots,), constant within each element, and one piece of similar stiffness."""
    of_slot, of_element = stiffness_pieces(model)
    first = np.concatenate([block.connectivity[:, 0] for block in model.blocks])
    keys, of = np.unique(label * (of_slot.max() + 1) + of_slot, return_inverse=True)
    of_element = np.searchsorted(keys, label[first] * (of_slot.max() + 1) + of_element)

    def listed(of: np.ndarray) -> tuple[wp.array, wp.array]:
        edges = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=len(keys)))])
        order = np.argsort(of, kind="stable") if len(keys) > 1 else np.zeros(0)
        return model.array("components", edges, wp.int32), model.array("components", order, wp.int32)

    component = np.zeros(len(keys))
    component[of.ravel()] = model.components.of_slot
    return SlotGroups(
        len(keys), *listed(of.ravel()), *listed(of_element), model.array("components", component, wp.int32)
    )
