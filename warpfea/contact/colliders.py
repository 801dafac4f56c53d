"""Contact with rigid obstacles, see kernels/contact/collider_kinematics.py."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.worlds import set_rows
from ..kernels.contact.collider_adjoint import collider_adjoint_kernels
from ..kernels.contact.collider_kinematics import MAX_COLLIDER_ROTATION, pose_kernels
from ..kernels.contact.collider_mesh import SIDE_TOLERANCE
from ..kernels.contact.collider_sheets import sheet_kernels
from ..kernels.contact.deepest_point import deepest_point_kernels
from ..kernels.contact.rolling import rolling_kernels
from ..kernels.contact.structs import collider_struct
from ..model.contacts import Contact
from ..model.state import State
from ..model.triangle_mesh import TriMesh
from ..terms.gradients import Gradient
from ..terms.term import StepContext, part
from .adjoint import DifferentiableColliders, sum_of_gradients
from .collider_tables import ContactTables, poses_by_laws
from .evaluation import (
    contact_field,
    evaluate_points,
    nodal_force,
    obstacle_contact_points,
    reference_position_text,
    store_overlaps,
    touching_depth,
)
from .term import ContactTerm, contact_columns

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..terms.workspace import Workspace

__all__ = ["ColliderContact"]

POSES = {"position": "previous_position", "rotation": "previous_rotation", "angle": "previous_angle",
         "previous_margin": "previous_margin"}  # fmt: skip
"""History of the colliders in the state, and its names in `Colliders`."""


class ColliderContact(ContactTerm, DifferentiableColliders):
    """Contacts of a model with its colliders.

    Attributes:
        tables: contacts, colliders and facets on the device.
        deepest_kernels: device code of single-point contacts, see kernels/contact/deepest_point.py; None without.
        rolling_kernels: the same of points that roll, see kernels/contact/rolling.py.
    """

    name = "contact"
    columns = contact_columns("contact")
    parts = {"contact": "contact with obstacles: forces, products, history"}

    def __init__(self, model: Model) -> None:
        tables = ContactTables(model)
        super().__init__(model, tables, tables.geometry)
        self.pose_kernels = pose_kernels(tables.has_meshes)
        self.deepest_kernels: Any = None
        if tables.has_single_point:
            self.deepest_kernels = deepest_point_kernels(model.dtype, tables.has_meshes)
        self.rolling_kernels: Any = None
        if tables.rolls:
            self.rolling_kernels = rolling_kernels(model.dtype, tables.has_meshes, tables.seams is not None)

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        contacts = model.description.contacts_of(Contact)
        return {"contact": bool(contacts), "friction": any(c.mu_static > 0.0 for c in contacts)}

    def make_other(self, make: Callable[[str, Any, tuple[int, ...]], wp.array]) -> Any:
        struct = collider_struct(self.tables.has_meshes)
        out = struct()
        out.assign(self.tables.shapes)
        for name, attribute in POSES.items():
            dtype = struct.vars[attribute].type.dtype
            setattr(out, attribute, make(f"{self.name}_{name}", dtype, (len(self.tables.colliders),)))
        return out

    def _allocate_other(self, work: Workspace, other: Any) -> None:
        self._set_attempt(other, lambda name, shape, dtype: work.array(f"{self.name} collider_{name}", shape, dtype))

    def _set_attempt(self, other: Any, make: Callable[[str, tuple[int, ...], Any], wp.array]) -> None:
        """Add the poses of an attempt, arrays from make(name, shape, dtype)."""
        shape, struct = (self.model.worlds, len(self.tables.colliders)), collider_struct(self.tables.has_meshes)
        for name in ("position", "rotation", "translation", "rotation_change", "angle"):
            setattr(other, name, make(name, shape, struct.vars[name].type.dtype))
        other.deepest = make("deepest", (*shape, 6), wp.float64)
        if self.tables.mixed:
            other.body_level = make("body_level", (self.model.worlds, self.tables.points), wp.vec4d)

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        own = [kernels.module for kernels in (self.deepest_kernels, self.rolling_kernels) if kernels]
        return [*super().modules(ctx), self.pose_kernels.module, *own]

    def start(self, ctx: StepContext, active: wp.array) -> None:
        """Collider poses at the state's time, and initial overlaps.

        Raises:
            ModelError: a new contact point overlaps an obstacle, and `overlap` is "refuse".
        """
        s, state = ctx.scratch[self.name], ctx.state
        history, other = s["history"], s["other"]
        time = state.time.numpy()
        # with a history at this time colliders continue from it: a control may have changed since
        known = other.previous_rotation.numpy().any(axis=(1, 2, 3)) & (history.pose_time.numpy() == time)
        fresh = (active.numpy() != 0) & ~known
        self._begin_other(ctx, active)
        for name, attribute in POSES.items():
            posed = getattr(other, name.removeprefix("previous_")).numpy()
            set_rows(getattr(other, attribute), fresh, posed[fresh])
        new = fresh & ~(history.speed.numpy() > 0.0).any(axis=1)
        overlap = self.forget_overlaps(ctx, new)
        set_rows(history.pose_time, fresh, time[fresh])
        gap = evaluate_points(self, state, history, places=False)[0]
        touching = touching_depth(self.model.size, state.displacement.numpy())
        if self.tables.has_sheets and new.any():
            self._settle_sheet_sides(ctx, touching, new)
        store_overlaps(self, np.where(new[:, None], -gap, 0.0), touching, overlap)
        history.overlap.assign(overlap)

    def _settle_sheet_sides(self, ctx: StepContext, touching: np.ndarray, new: np.ndarray) -> None:
        """Put points that begin on a sheet of triangles, within round-off of it, on the side of their body: in front,
        unless all of it is behind.

        Args:
            touching, new: (worlds,) m, and flags of the worlds to check.

        Raises:
            ModelError: a body that begins on both sides.
        """
        m, t = self.model, self.tables
        found = wp.zeros((m.worlds, t.rows), dtype=wp.int32, device=m.device)  # one point of each facet across, + 1
        sides = wp.zeros((m.worlds, t.points), dtype=wp.int32, device=m.device)
        kernels, other, u = sheet_kernels(m.dtype), ctx.scratch[self.name]["other"], ctx.state.displacement
        for group in t.groups:
            ctx.launch(kernels.point_sides, group.point_threads(m.worlds), [other, group.data, u, sides])
        side, stored = sides.numpy(), ctx.scratch[self.name]["history"].contact_state.numpy()
        for k in np.flatnonzero([c.collider.is_sheet for c in t.contacts]).tolist():
            mine = slice(t.first[k], t.first[k + 1])
            side[:, mine] = side[:, mine].min(axis=1, keepdims=True)
            stored[new, mine] = side[new, mine]
        sides.assign(side)
        ctx.scratch[self.name]["history"].contact_state.assign(stored)
        size = max(float(k.shape.sizes[0]) for k in t.colliders if k.is_sheet)
        limit: Any = wp.array(np.maximum(touching, SIDE_TOLERANCE * size), dtype=wp.float64, device=m.device)
        for group in t.groups:
            args = [other, group.data, u, sides, limit, found]
            ctx.launch(kernels.find_crossed_sheets, (m.worlds, group.count), args)
        of_sheet = np.repeat([c.collider.is_sheet for c in t.contacts], np.diff(t.row_start))
        points = np.where(of_sheet, found.numpy(), 0)
        for world, row in np.argwhere((points > 0) & new[:, None])[:1]:
            k = int(np.searchsorted(t.row_start, row, side="right")) - 1
            contact, where = t.contacts[k], reference_position_text(t, k, int(points[world, row]) - 1 - int(t.first[k]))
            raise ModelError(
                f"contact {contact.name!r}: body {contact.body.name!r} begins on both sides of collider "
                f"{contact.collider.name!r}, or on it and behind (world {world}, reference point {where}); move one of "
                "them: bodies on a sheet of triangles are in front of it"
            )

    def _begin_other(self, ctx: StepContext, active: wp.array) -> None:
        """Poses of the colliders at the end of the attempt."""
        args = [ctx.scratch[self.name]["other"], ctx.work.time_law_values, active]
        ctx.launch(self.pose_kernels.update_poses, (self.model.worlds, len(self.tables.colliders)), args)

    # in a step

    def _find_other(self, ctx: StepContext, active: wp.array, *, fresh: int = 0) -> None:
        if fresh:
            self._choose_deepest(ctx, active, fresh=1)
        if fresh or not ctx.midpoint:
            self._place_rolling(ctx, active)

    _find_accepted = _find_other

    def _place_rolling(self, ctx: StepContext, active: wp.array) -> None:
        """Points that roll, at work.u."""
        if self.rolling_kernels:
            s = ctx.scratch[self.name]
            state = (ctx.state.displacement, ctx.state.velocity)
            self.place_rolling(ctx.launch, s, s["u"], state, active, middle=0.5 * ctx.midpoint)

    def place_rolling(
        self, launch: Launcher, s: dict[str, Any], u: wp.array, state: tuple[wp.array, wp.array], active: wp.array,
        *, middle: float = 0.0, settled: int = 0,
    ) -> None:  # fmt: skip
        """Arguments as of `choose_deepest`; middle: see kernels/contact/rolling.py."""
        for group in self.tables.groups:
            if group.data.edge_rows:
                args = [self.tables.data, s["other"], group.data, s["history"], s["clock"], u, *state, active]
                args += [middle, settled, s["attempt"]]
                launch(self.rolling_kernels.place_points, group.point_threads(self.model.worlds), args)

    def _choose_deepest(self, ctx: StepContext, active: wp.array, *, fresh: int) -> None:
        """Select the point of each single-point contact at work.u."""
        if not self.deepest_kernels:
            return
        s, w = ctx.scratch[self.name], ctx.work
        state = (ctx.state.displacement, ctx.state.velocity)
        args = [s["u"], state, active, w.newton.frozen.unilateral_changed]
        self.choose_deepest(ctx.launch, s, w.step.new_time, *args, fresh=fresh)

    def choose_deepest(
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
        k, t, B = self.deepest_kernels, self.tables, self.model.worlds
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

    @part()
    def update_frozen(self, ctx: StepContext, flags: wp.array) -> None:
        super().update_frozen(ctx, flags)
        self._choose_deepest(ctx, flags, fresh=0)
        if ctx.midpoint:
            self._place_rolling(ctx, flags)

    @property
    def weights(self) -> np.ndarray:
        """As of `ContactTerm`; a single-point contact stores its energy at its first point."""
        out = super().weights
        for k, contact in enumerate(self.tables.contacts):
            if contact.model == "sphere":
                out[self.tables.first[k]] = 1.0
        return out

    # in a linear solve

    def cached_inputs(self, ctx: StepContext) -> list[tuple[str, wp.array]]:
        attempt = ctx.scratch[self.name]["attempt"]
        return [("stiffness", attempt.stiffness)] + (
            [("weight", attempt.shape_values)] if self.tables.tracks_deepest else []
        )

    def blocks(
        self, ctx: StepContext, matrix: Any, cached: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
        *, projected: bool,
    ) -> None:  # fmt: skip
        """Positive semi-definite stiffness of the points."""
        weight = cached[1] if self.tables.tracks_deepest else ctx.scratch[self.name]["attempt"].shape_values
        self._add_facet_blocks(ctx, matrix, cached[0], weight, dq_dv, active, out)

    def _turn_text(self, contact: Any) -> str:
        return (
            f"collider {contact.collider.name!r} turns by more than {MAX_COLLIDER_ROTATION:g} rad in the step, in "
            "which it is touched; take a smaller dt"
        )

    def _contact_info(self, contact: Any, k: int) -> dict[str, Any]:
        """`left_out`: points that don't act because their slots are clamped."""
        numbers = {"left_out": self.tables.clamped_point_counts[k]}
        if isinstance(contact.collider.shape, TriMesh):
            numbers["triangles"] = len(contact.collider.shape.triangles)
        return numbers

    # adjoint

    @cached_property
    def adjoint_kernels(self) -> Any:
        """Kernels of `DifferentiableColliders`."""
        t = self.tables
        return collider_adjoint_kernels(self.model.dtype, t.has_meshes, t.seams is not None, t.own_laws)

    def gradients(self, ctx: StepContext) -> Mapping[str, Callable[[], Gradient]]:
        def offset(mine: np.ndarray) -> Gradient:
            a = self.adjoint(ctx)
            return a.sum_of(mine[None].astype(float), a.data.gap_bar)

        of, known = self.tables.shapes.of_contact.numpy(), self.tables.parameters()
        names = [f"{collider.name}.offset" for collider in self.tables.colliders]
        offsets = {name: partial(offset, of == k) for k, name in enumerate(names) if name in known and (of == k).any()}
        return dict(super().gradients(ctx)) | offsets

    def law_gradient(self, ctx: StepContext, law: int) -> Gradient | None:
        """Paths: the pose at the end of a step is that at the start of the next one."""
        shapes, found = self.tables.shapes, []
        of = shapes.of_contact.numpy()
        for name, values in (("translation_law", "shift_bar"), ("rotation_law", "turn_bar")):
            mine = (getattr(shapes, name).numpy() == law)[of].astype(float)
            if mine.any():
                factor = mine[None, :, None] * np.ones(3) if values == "shift_bar" else mine[None]
                a = self.adjoint(ctx)
                found.append(a.sum_of(factor, getattr(a.data, values), along=False))
        return sum_of_gradients(found) if found else None

    # at a state

    def settled_other(self, stored: Any, zeros: Any, launch: Launcher, state: State) -> Any:
        """Colliders at rest in their poses at a state; without history by their time laws."""
        other = self.make_other(stored)
        self._set_attempt(other, lambda _, shape, dtype: zeros(shape, dtype))
        if "contact_position" not in state.specs:
            value, all_worlds = self.model.terms.time_laws.values_at_state(launch, state)
            launch(
                self.pose_kernels.update_poses, (state.worlds, len(self.tables.colliders)), [other, value, all_worlds]
            )
            other.translation.zero_()
            other.rotation_change.zero_()
            other.previous_position, other.previous_rotation = other.position, other.rotation
        # statics resets its time to 0: the stored poses count
        other.position, other.rotation = other.previous_position, other.previous_rotation
        other.previous_angle, other.previous_margin = other.angle, other.margin
        return other

    def nodal_force(self, state: State) -> np.ndarray:
        """Elastic nodal forces of all contacts at a state, (worlds, slots, 3), N."""
        force, rolling = self.at_points(state)[1], [group for group in self.tables.groups if group.data.edge_rows]
        out = nodal_force(self.tables, force)
        for group in rolling:  # on their circle, not on the axis
            data, rows = group.data, np.flatnonzero(group.data.edge_row.numpy() >= 0)
            arm = data.edge_shape.numpy().reshape(data.point_count, -1, len(out), len(rows))
            arm = arm - data.shape.numpy()[:, :, None, rows]
            last = data.first_point + group.count * data.point_count
            at = force[:, data.first_point : last].reshape(len(out), group.count, -1, 3)[:, rows]
            for world, at_slot in enumerate(np.einsum("plbr,brpk->brlk", arm, at)):
                np.add.at(out[world], group.conn[rows], at_slot)
        return out

    def poses(self, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """As of `Touching`; of a state without history, before a run, by the time laws."""
        margin = self.tables.shapes.margin.numpy()
        if "contact_position" not in state.specs:
            return *poses_by_laws(self.model, self.tables.collider_laws, state), margin
        return state.contact_position.numpy(), state.contact_rotation.numpy(), margin  # type: ignore[attr-defined]

    def samples(self, field: str, body: Any, state: State) -> np.ndarray:
        mine = any(contact.body is body for contact in self.tables.contacts)
        contact_points = obstacle_contact_points(self.tables, body, *evaluate_points(self, state)) if mine else []
        return contact_field(field, body, state.worlds, contact_points)

    def at_points(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Gap (worlds, points), m, and elastic force on each point (worlds, points, 3), N, at a state; the gap at the
        deepest position of a single-point contact is assigned to the nearest point."""
        gap, _, force = evaluate_points(self, state)
        return gap, force
