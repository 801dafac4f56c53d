"""Connected components of a model, groups of slots within them, components with free translations."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..kernels.solvers.pcg import free_groups_struct
from . import assembly
from .residual_groups import slot_groups

__all__ = ["Components"]


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
        groups.start = model.array("groups", start, wp.int32)
        groups.slot = model.array("groups", slots, wp.int32)
        groups.group_of_slot = model.array("groups", of_slot, wp.int32)
        groups.is_position, groups.lumped_mass = table.is_position_array, model.masses.lumped_values
        model.cache["free groups"] = of_slot, slots, len(keep)
        groups.mass = model.array("groups", model.masses.group_masses(*model.cache["free groups"]), model.types.T)
        groups.free_directions = model.array("groups", free[keep], model.types.vec3)
        return groups, len(keep)
