"""Coupling of bodies in contact in the matrix of their rigid body modes (solvers/rigid_body_modes.py)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.contact.rigid_modes import pair_rigid_mode_kernels

if TYPE_CHECKING:
    from ..terms.term import StepContext
    from .facet_tables import PairTables

__all__ = ["PairRigidModes"]


class PairRigidModes:
    """Couplings by contacts between the bodies with rigid body modes, with sums over their points.

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
        sides = [(number[id(c.slave.body)], number[id(c.master.body)]) for c in t.contacts]
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

    def add(self, kept: list[wp.array], dq_dv: wp.array, active: wp.array) -> None:
        """Add the coupling blocks, from the arrays of `cached_inputs`."""
        stiffness, _, _, _, weight, listed = kept
        B, lanes, launch = self.ctx.model.worlds, self.partial_sums.shape[2], self.ctx.launch
        for group, contact, count in self.groups:
            args = [self.rigid_modes.bodies, self.masters, group.data, contact, self.first_point]
            args += [stiffness, weight, listed, active, lanes, self.partial_sums]
            launch(self.kernels.cross_term_sums, (B, count, lanes), args)
        args = [self.body_pairs, self.pair_start, self.pair_contacts, self.partial_sums, dq_dv, active]
        launch(self.kernels.add_cross_terms, (B, self.count, 4), [*args, self.rigid_modes.dense_inverse.matrix])
