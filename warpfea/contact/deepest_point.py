"""Deepest positions of single-point contacts."""

from __future__ import annotations

from typing import Any

import warp as wp

from ..base.launch import Launcher
from ..kernels.contact.deepest_point import deepest_point_kernels
from .collider_tables import ContactTables

__all__ = ["DeepestPoints"]


class DeepestPoints:
    """Single-point contacts of a model; see kernels/contact/deepest_point.py.

    Attributes:
        kernels: device code.
    """

    def __init__(self, tables: ContactTables) -> None:
        self.tables = tables
        self.kernels = deepest_point_kernels(tables.model.dtype, tables.has_meshes)

    def choose(
        self, launch: Launcher, s: dict[str, Any], time: wp.array, u: wp.array, state: tuple[wp.array, wp.array],
        active: wp.array, changed: wp.array, *, fresh: int, settled: int = 0,
    ) -> None:  # fmt: skip
        """Find the deepest position of each single-point contact.

        Args:
            launch: launcher of the device.
            s: history, other, attempt, clock and row_start of the term's scratch.
            time, u: [world] s, and displacements, at which positions are compared.
            state: displacements and velocities at the start of the attempt.
            active: [world] flags.
            changed: [world] set to 1 if another point of a surface becomes the closest one.
            fresh: start of an attempt.
            settled: evaluation at a state, without motion.
        """
        k, t, B = self.kernels, self.tables, self.tables.model.worlds
        groups = [group for group in t.groups if group.lumped]
        for group in groups:
            args = [t.data, s["other"], group.data, s["history"], time, u, active, s["attempt"]]
            launch(k.point_depths, (B, group.count, group.data.point_count), args)
            launch(k.find_deepest, (B, group.count), args)
        args = [t.data, s["row_start"], active, fresh, s["attempt"], changed]
        launch(k.choose_deepest, (B, len(t.contacts)), args)
        for group in groups:
            if group.data.tracks_deepest:
                args = [t.data, s["other"], group.data, s["history"], s["clock"], *state, active, settled, s["attempt"]]
                launch(k.set_contact_point, (B, group.count), args)
