"""Contact evaluation at a state: the deepest positions of single-point contacts, gaps and forces of all points."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..base.launch import Launcher
from ..kernels.contact.deepest_point import deepest_point_kernels
from ..kernels.contact.structs import clock_struct
from ..model.state import State
from .collider_tables import ContactTables

__all__ = ["DeepestPoints", "at_points"]


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
            s: history, attempt, clock and row_start of the term's scratch.
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
            args = [t.data, group.data, s["history"], time, u, active, s["attempt"]]
            launch(k.point_depths, (B, group.count, group.data.point_count), args)
            launch(k.find_deepest, (B, group.count), args)
        args = [t.data, s["row_start"], active, fresh, s["attempt"], changed]
        launch(k.choose_deepest, (B, len(t.contacts)), args)
        for group in groups:
            if group.data.tracks_deepest:
                args = [t.data, group.data, s["history"], s["clock"], *state, active, settled, s["attempt"]]
                launch(k.set_contact_point, (B, group.count), args)


def at_points(term: Any, state: State, history: Any = None, places: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Implementation of `Contact.at_points` for `term`."""
    m, t, B = term.model, term.tables, state.worlds
    launch, laws = Launcher(m.device), m.terms.time_laws
    K, P = len(t.colliders), t.points

    def zeros(shape: tuple[int, ...], dtype: Any) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=m.device)

    all_worlds = wp.ones(B, dtype=wp.int32, device=m.device)
    value = zeros((B, max(laws.count, 1)), wp.vec3d)
    laws.evaluate(launch, state, state.time, wp.ones(B, dtype=wp.float64, device=m.device), all_worlds, value)
    if history is None:

        def state_or_zeros(name: str, dtype: Any, shape: tuple[int, ...]) -> wp.array:
            return getattr(state, name) if name in state.specs else zeros((B, *shape), dtype)

        history = term.make_history(state_or_zeros)
    attempt = term.make_scratch(B, lambda _, shape, dtype: zeros(shape, dtype))
    attempt.approach_speed.fill_(1.0)
    if "contact_position" in state.specs:  # statics resets its time to 0
        attempt.collider_position, attempt.collider_rotation = history.position, history.rotation
    else:
        launch(term.point_kernels.update_poses, (B, K), [t.data, history, value, all_worlds, attempt])
        attempt.collider_translation.zero_()
        attempt.collider_rotation_change.zero_()
    gap, force = zeros((B, P), wp.float64), zeros((B, P), wp.vec3d)
    u = state.displacement
    if term.double_displacements:
        u = zeros(u.shape, wp.vec3d)
        term.double_displacements.widen(launch, state.displacement, all_worlds, u)
    for group in t.groups:
        dim = (B, group.count, group.data.point_count)
        launch(
            term.point_kernels.points_at_state,
            dim,
            [t.data, group.data, history, state.time, state.displacement, attempt],
        )
    if term.deepest_points:
        clock = clock_struct()()
        clock.time, clock.is_static = state.time, 1
        row_start = m.array("contact", t.row_start, wp.int32)
        s = {"history": history, "attempt": attempt, "clock": clock, "row_start": row_start}
        before, changed = (state.displacement,) * 2, zeros((B,), wp.int32)
        term.deepest_points.choose(launch, s, state.time, u, before, all_worlds, changed, fresh=1, settled=1)
    for group in t.groups:
        dim = (B, group.count, group.data.point_count)
        args = [t.data, group.data, history, u, state.time, attempt, int(places), gap, force]
        launch(term.ledger_kernels.evaluate_at_points, dim, args)
    return gap.numpy(), force.numpy()
