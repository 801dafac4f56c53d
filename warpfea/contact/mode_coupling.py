"""Couplings of the bodies by their contacts, in the matrices of small models and in coarse matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..kernels.contact.coarse_terms import coarse_groups_struct, coarse_term_kernels
from ..kernels.contact.rigid_modes import pair_rigid_mode_kernels
from ..model.assembly import grouped_items
from ..terms.term import StepContext
from .facet_tables import PairTables

__all__ = ["PairCoarseTerms", "PairRigidModes", "coupling_entries"]


def coupling_entries(tables: PairTables, group: Any, pattern: Any) -> tuple[wp.array, wp.array, int]:
    """Entries of a pattern that couple the points of a facet group with their other side: start of the items of each,
    the items (facet, its local slot, slot of the other side, entry), and the number of entries."""
    m, found = tables.model, [np.zeros((0, 3), dtype=np.int64)]
    for k in (k for k in group.contacts if not tables.contacts[k].grounded):
        first = (tables.first[k : k + 2] - group.data.first_point) // group.data.point_count
        local, other = np.arange(group.conn.shape[1]), tables.slots_by_side[k][1]
        found.append(np.stack(np.meshgrid(np.arange(*first), local, other, indexing="ij"), axis=-1).reshape(-1, 3))
    source = np.concatenate(found)
    a, b = group.conn[source[:, 0], source[:, 1]], source[:, 2]
    upper = pattern.find_upper(np.minimum(a, b), np.maximum(a, b))
    chosen, entry, start = grouped_items(upper)
    items = np.column_stack([source, upper])[chosen]
    return m.array("contact", start, wp.int32), m.array("contact", items, wp.vec4i), len(entry)


class PairRigidModes:
    """Couplings by contacts between the bodies in the matrix of their rigid body modes, with sums over their points.

    Args:
        rigid_modes: rigid body modes of the preconditioner (solvers/rigid_body_modes.py).

    Attributes:
        body_pairs: coupled bodies.
        pair_start, pair_contacts: contacts of each pair of bodies, with 1 where the slave comes second.
        first_point: first point of each contact. groups: (facet group, its coupled contacts, their number).
        partial_sums: [world, contact, lane, 4].
    """

    def __init__(self, ctx: StepContext, tables: PairTables, masters: Any, rigid_modes: Any) -> None:
        m, t = ctx.model, tables
        self.ctx, self.tables, self.masters, self.rigid_modes = ctx, tables, masters, rigid_modes
        self.kernels = pair_rigid_mode_kernels(m.dtype)
        number = {id(body): rigid_modes.mode_index.get(k, -1) for k, body in enumerate(m.bodies)}
        sides = [(number[id(c.body)], number[id(c.facets.body)]) for c in t.contacts]
        coupled = [k for k, (a, b) in enumerate(sides) if min(a, b) >= 0 and a != b]
        pairs = sorted({(min(sides[k]), max(sides[k])) for k in coupled})
        found = [[(k, int(sides[k] != pair)) for k in coupled if tuple(sorted(sides[k])) == pair] for pair in pairs]
        start = np.concatenate([[0], np.cumsum([len(rows) for rows in found])])
        self.body_pairs, self.count = m.array("motions", np.array(pairs), wp.vec2i), len(pairs)
        self.pair_start = m.array("motions", start, wp.int32)
        self.pair_contacts = m.array("motions", np.concatenate(found), wp.vec2i)
        self.first_point = m.array("motions", t.first, wp.int32)
        self.groups = []
        for group in t.groups:
            low, high = group.data.first_point, group.data.first_point + group.data.facet_count * group.data.point_count
            own = [k for k in coupled if low <= t.first[k] < high]
            if own:
                self.groups.append((group, m.array("motions", np.array(own), wp.int32), len(own)))
        most = int(np.diff(t.first)[coupled].max())
        self.partial_sums = ctx.work.array(
            "pairs motions", (m.worlds, len(t.contacts), rigid_modes.lanes(most), 4), wp.mat33d
        )

    def add(self, cached: list[wp.array], dq_dv: wp.array, active: wp.array) -> None:
        """Add the coupling blocks, from the arrays of `cached_inputs`."""
        stiffness, _, _, _, weight, listed = cached
        B, lanes, launch = self.ctx.model.worlds, self.partial_sums.shape[2], self.ctx.launch
        for group, contact, count in self.groups:
            args = [self.rigid_modes.bodies, self.masters, group.data, contact, self.first_point]
            args += [stiffness, weight, listed, active, lanes, self.partial_sums]
            launch(self.kernels.cross_term_sums, (B, count, lanes), args)
        args = [self.body_pairs, self.pair_start, self.pair_contacts, self.partial_sums, dq_dv, active]
        launch(self.kernels.add_cross_terms, (B, self.count, 4), [*args, self.rigid_modes.dense_inverse.matrix])


class PairCoarseTerms:
    """Couplings by contacts between the bodies in a coarse matrix of the preconditioner.

    Args:
        coarse: coarse functions of the slots (solvers/levels.py).

    Attributes:
        groups: facet groups with couplings, and their device structs of groups of slots.
    """

    def __init__(self, ctx: StepContext, tables: PairTables, masters: Any, coarse: Any) -> None:
        m, of_slot = ctx.model, coarse.group_of_slot.numpy()
        self.ctx, self.masters, self.coarse = ctx, masters, coarse
        self.kernels = coarse_term_kernels(m.dtype)
        self.groups = []
        for group in tables.groups:
            pairs, facets = set(), sorted({(g, f) for f, conn in enumerate(of_slot[group.conn]) for g in conn})
            for k in (k for k in group.contacts if not tables.contacts[k].grounded):
                own = np.unique(of_slot[tables.host[k].conn + tables.contacts[k].body.slot_offset])
                master, body = tables.masters[tables.master_of[k]], tables.contacts[k].facets.body
                other = np.unique(of_slot[np.maximum(master.conn, 0) + body.slot_offset])
                pairs |= {(min(a, b), max(a, b)) for a in own for b in other if a != b}
            if pairs:
                of_facet, facet = np.array(facets).T
                start = np.searchsorted(of_facet, np.arange(of_slot.max() + 2))
                data = coarse_groups_struct(m.dtype)()
                data.group_of_slot, data.affine_values = coarse.group_of_slot, coarse.affine_values
                data.free = m.topology.free
                data.pairs = m.array("coarse coupling", np.array(sorted(pairs)), wp.vec2i)
                data.facet_start = m.array("coarse coupling", start, wp.int32)
                data.facet = m.array("coarse coupling", facet, wp.int32)
                self.groups.append((group, data))

    def add(self, cached: list[wp.array], dq_dv: wp.array, active: wp.array) -> None:
        """Add the blocks, from the arrays of `cached_inputs`."""
        stiffness, _, _, _, weight, listed = cached
        launch = self.ctx.launch
        for group, data in self.groups:
            lanes = launch.lanes(len(data.facet) // len(data.facet_start))
            args = [data, self.masters, group.data, stiffness, weight, listed, dq_dv, active, lanes, self.coarse.matrix]
            dim = (self.ctx.model.worlds, launch.padded(16 * lanes * len(data.pairs)))
            launch(self.kernels.add_coarse_terms, dim, args)
