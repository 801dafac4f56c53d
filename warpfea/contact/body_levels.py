"""Levels of the bodies beside colliders, for the points that slide from one to the other: see facet_seams.py and
collider_seams.py in kernels/contact."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.contact.facet_seams import body_level_kernels
from ..kernels.contact.facet_structs import pair_scratch_struct
from ..terms.gradients import with_fields

if TYPE_CHECKING:
    from ..terms.term import StepContext
    from .collider_tables import ContactTables
    from .facet_tables import PairTables

__all__ = ["BodyLevels"]


class BodyLevels:
    """Search of the levels at the start of an attempt.

    Args:
        pairs: scratch of the contact with facets. colliders: of that with colliders, which takes the levels.
    """

    def __init__(
        self, ctx: StepContext, pairs: dict[str, Any], tables: PairTables, colliders: dict[str, Any], of: ContactTables
    ) -> None:
        m = ctx.model
        self.ctx, self.kernels, self.groups = ctx, body_level_kernels(m.dtype), of.groups
        struct, start = pair_scratch_struct(m.dtype), pairs["pair"].start_displacement
        self.args = [pairs["masters"], with_fields(struct, pairs["pair"], displacement=start)]
        seams = sorted(of.mixed, key=lambda seam: of.number[seam.contact.index])
        contact = [of.number[seam.contact.index] for seam in seams]
        rows: list[tuple[Any, Any]] = [
            (np.searchsorted(contact, np.arange(len(of.contacts) + 1)), wp.int32),
            ([tables.number_of(seam.surface) for seam in seams], wp.int32),
            ([seam.level.normal for seam in seams], wp.vec3d),
            ([seam.reach for seam in seams], wp.vec2d),
        ]
        self.tables = [m.array("contact", np.array(values), dtype) for values, dtype in rows]
        self.out = colliders["other"].body_level

    def find(self, active: wp.array) -> None:
        """Find them at the displacements of the state."""
        ctx = self.ctx
        for group in self.groups:
            args = [*self.args, group.data, ctx.state.displacement, active, *self.tables, self.out]
            ctx.launch(self.kernels.find_levels, group.point_threads(ctx.model.worlds), args)
