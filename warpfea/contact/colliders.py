"""Contact with rigid obstacles, with a potential per contact point, see kernels/contact/assembly.py."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.contact.assembly import MAX_COLLIDER_ROTATION
from ..model.state import State
from ..model.triangle_mesh import TriMesh
from ..terms.term import StepContext, part
from .collider_sheets import check_sheet_sides
from .collider_tables import ContactTables
from .deepest_point import DeepestPoints, at_points
from .fields import contact_field, nodal_force, obstacle_contact_points
from .initial_overlaps import store_overlaps, touching_depth
from .parameters import collider_parameters
from .term import ContactTerm, contact_columns

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["ColliderContact"]


class ColliderContact(ContactTerm):
    """Contacts of a model with its colliders.

    Attributes:
        tables: contacts, colliders and facets on the device.
    """

    name = "contact"
    columns = contact_columns("contact")
    parts = {"contact": "contact with obstacles: forces, products, history"}

    def __init__(self, model: Model) -> None:
        tables = ContactTables(model)
        super().__init__(model, tables, meshes=tables.has_meshes)
        self.deepest_points = DeepestPoints(self.tables) if self.tables.has_single_point else None

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        contacts = model.description.contacts
        return {"contact": bool(contacts), "friction": any(c.mu_static > 0.0 for c in contacts)}

    def scratch_shapes(self, worlds: int) -> dict[str, tuple[int, ...]]:
        t, B = self.tables, worlds
        K, C, R = len(t.colliders), len(t.contacts), t.rows
        poses = ("position", "rotation", "translation", "rotation_change", "angle")
        of_facets = ("facet_deepest_point", "facet_deepest_xi", "facet_max_depth")
        out = super().scratch_shapes(B) | {f"collider_{name}": (B, K) for name in poses}
        out |= dict.fromkeys(("contact_point", "choice_count"), (B, C))
        if not t.has_single_point:
            return out | dict.fromkeys(("point_depth", *of_facets, "chosen_facet", "point_reference"), (1, 1))
        out |= dict.fromkeys(of_facets, (B, R)) | dict.fromkeys(("chosen_facet", "point_reference"), (B, C))
        return out | {"shape_values": (B, C, max(group.conn.shape[1] for group in t.groups))}

    def history_shapes(self) -> dict[str, tuple[int, ...]]:
        poses = ("position", "rotation", "angle", "previous_margin")
        return super().history_shapes() | dict.fromkeys(poses, (len(self.tables.colliders),))

    @property
    def unused_history(self) -> tuple[str, ...]:  # type: ignore[override]
        """Arrays of contacts at moving positions, without such."""
        return () if self.tables.tracks_deepest else ("previous_depth",)

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        others = (user.kernels.module for user in (self.deepest_points, self.double_displacements) if user)
        return [self.point_kernels.module, *others]

    def start(self, ctx: StepContext, active: wp.array) -> None:
        """Collider poses at the state's time, and initial overlaps.

        Raises:
            ModelError: a new contact point overlaps an obstacle, and `overlap` is "refuse".
        """
        s, state = ctx.scratch[self.name], ctx.state
        history = s["history"]
        time = state.time.numpy()
        # with a history at this time colliders continue from it: a control may have changed since
        known = history.rotation.numpy().any(axis=(1, 2, 3)) & (history.pose_time.numpy() == time)
        fresh = (active.numpy() != 0) & ~known
        self._update_poses(ctx, active)
        for name in ("position", "rotation", "angle", "previous_margin"):
            source = self.tables.data.margin if name == "previous_margin" else getattr(s["attempt"], f"collider_{name}")
            values = getattr(history, name).numpy()
            values[fresh] = source.numpy()[fresh]
            getattr(history, name).assign(values)
        new = fresh & ~(history.speed.numpy() > 0.0).any(axis=1)
        overlap = self.forget_overlaps(ctx, new)
        posed = history.pose_time.numpy()
        posed[fresh] = time[fresh]
        history.pose_time.assign(posed)
        gap, _ = self.at_points(state, history, places=False)
        touching = touching_depth(self.model.size, state.displacement.numpy())
        if self.tables.has_sheets and new.any():
            check_sheet_sides(self, s["attempt"], state.displacement, touching, new, ctx.launch)
        store_overlaps(self.tables, np.where(new[:, None], -gap, 0.0), touching, overlap)
        history.overlap.assign(overlap)

    def _update_poses(self, ctx: StepContext, active: wp.array) -> None:
        s = ctx.scratch[self.name]
        args = [self.tables.data, s["history"], ctx.work.time_law_values, active, s["attempt"]]
        ctx.launch(self.point_kernels.update_poses, (self.model.worlds, len(self.tables.colliders)), args)

    # in a step

    def _begin_points(self, ctx: StepContext, active: wp.array) -> None:
        """Poses of the colliders at the end of the attempt, points at its start."""
        s, m = ctx.scratch[self.name], self.model
        self._update_poses(ctx, active)
        for group in self.tables.groups:
            dim = (m.worlds, group.count, group.data.point_count)
            args = [self.tables.data, group.data, s["history"], s["clock"]]
            more = [ctx.state.displacement, ctx.state.velocity, active, s["attempt"]]
            ctx.launch(self.point_kernels.begin_points, dim, [*args, *more])
            if self.tables.explicit:
                ctx.launch(self.point_kernels.explicit_forces, dim, [*args, *more[1:]])

    @part()
    def _evaluate_forces(self, ctx: StepContext, active: wp.array, *, fresh: int) -> None:
        s, m = ctx.scratch[self.name], self.model
        if self.double_displacements and ctx.positions_changed:
            self.double_displacements.update(ctx, s["u"], active)
        if fresh:
            self._choose_deepest(ctx, active, fresh=1)
        for group in self.tables.groups:
            args = [self.tables.data, group.data, s["history"], s["clock"], s["u"], active, fresh]
            dim = (m.worlds, group.count, group.data.point_count)
            ctx.launch(self.point_kernels.forces, dim, [*args, s["attempt"]])
            self._gather_point_forces(ctx, group, active)

    def _choose_deepest(self, ctx: StepContext, active: wp.array, *, fresh: int) -> None:
        """Select the point of each single-point contact at work.u."""
        if not self.deepest_points:
            return
        s, w = ctx.scratch[self.name], ctx.work
        state = (ctx.state.displacement, ctx.state.velocity)
        place = self.deepest_points.choose
        place(ctx.launch, s, w.step.new_time, s["u"], state, active, w.newton.frozen.unilateral_changed, fresh=fresh)

    @part()
    def update_frozen(self, ctx: StepContext, flags: wp.array) -> None:
        super().update_frozen(ctx, flags)
        self._choose_deepest(ctx, flags, fresh=0)

    @part()
    def product(self, ctx: StepContext, p: wp.array, active: wp.array) -> None:
        m, k, attempt = self.model, self.point_kernels, ctx.scratch[self.name]["attempt"]
        for group in self.tables.groups:
            dim = (m.worlds, group.count, group.data.point_count)
            ctx.launch(k.point_products, dim, [group.data, active, p, attempt])
            sides, lanes = group.sum_threads(ctx.launch, m.worlds)
            args = [group.data, active, lanes, attempt, ctx.work.pool_product]
            ctx.launch(k.gather_facet_products, sides, args)

    def _record_points(self, ctx: StepContext, accepted: wp.array) -> None:
        s = ctx.scratch[self.name]
        for group in self.tables.groups:
            args = [self.tables.data, group.data, s["history"], s["clock"], s["u"], accepted, s["attempt"]]
            dim = (self.model.worlds, group.count)
            ctx.launch(self.ledger_kernels.record_substep, dim, [*args, s["energies"]])

    def _store_state(self, ctx: StepContext, accepted: wp.array) -> None:
        s, newton = ctx.scratch[self.name], ctx.work.newton
        args = [self.tables.data, s["clock"], newton.strain_energy, newton.term_sums, accepted, s["history"]]
        dim = (self.model.worlds, len(self.tables.colliders))
        ctx.launch(self.ledger_kernels.store_poses, dim, [*args, s["attempt"]])

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
        self, ctx: StepContext, matrix: Any, kept: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
        *, projected: bool,
    ) -> None:  # fmt: skip
        """Positive semi-definite stiffness of the points."""
        weight = kept[1] if self.tables.tracks_deepest else ctx.scratch[self.name]["attempt"].shape_values
        self._add_facet_blocks(ctx, matrix, kept[0], weight, dq_dv, active, out)

    def _sides_text(self, contact: Any) -> tuple[str, str, str]:
        return contact.body.name, f"collider {contact.collider.name!r}", "shape"

    def _turn_text(self, contact: Any) -> str:
        return (
            f"collider {contact.collider.name!r} turns by more than {MAX_COLLIDER_ROTATION:g} rad in the step, in "
            "which it is touched; take a smaller dt"
        )

    def _contact_text(self, contact: Any) -> str:
        return f"{contact.name!r} with collider {contact.collider.name!r}"

    def parameters(self) -> dict[str, Callable[[Any, np.ndarray], None]]:
        return super().parameters() | collider_parameters(self.tables)

    def _contact_info(self, contact: Any, k: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """`left_out`: points that don't act because their slots are clamped."""
        numbers = {"left_out": self.tables.clamped_point_counts[k]}
        if isinstance(contact.collider.shape, TriMesh):
            numbers["triangles"] = len(contact.collider.shape.triangles)
        return {"body": contact.body.name, "collider": contact.collider.name}, numbers

    # at a state

    def nodal_force(self, state: State) -> np.ndarray:
        """Elastic nodal forces of all contacts at a state, (worlds, slots, 3), N."""
        return nodal_force(self.tables, self.at_points(state)[1])

    def poses(self, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Positions (worlds, colliders, 3), m, rotations (..., 3, 3) and surface offsets (worlds, colliders), m, of the
        colliders at a state; None without history."""
        if "contact_position" not in state.specs:
            return None
        return state.contact_position.numpy(), state.contact_rotation.numpy(), self.tables.data.margin.numpy()  # type: ignore[attr-defined]

    def samples(self, field: str, body: Any, state: State) -> np.ndarray:
        mine = any(contact.body is body for contact in self.tables.contacts)
        contact_points = obstacle_contact_points(self.tables, body, *self.at_points(state)) if mine else []
        return contact_field(field, body, state.worlds, contact_points)

    def at_points(self, state: State, history: Any = None, *, places: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Gap (worlds, points), m, and elastic force on each point (worlds, points, 3), N, at a state; with `places`
        the gap at the deepest position of a single-point contact is assigned to the nearest point."""
        return at_points(self, state, history, places)
