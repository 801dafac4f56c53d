"""Contact with rigid obstacles, with a potential per contact point, see kernels/terms/contact.py."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import PenetrationError
from ..kernels.common.traits import Traits
from ..kernels.solvers.newton_control import FAIL_ROUNDOFF, FAIL_WORK
from ..kernels.terms.contact import AITKEN_LANES, MAX_COLLIDER_ROTATION, contact_kernels
from ..kernels.terms.contact_ledger import ENERGY_COLUMNS, RECORD_LANES, contact_block_kernels, contact_ledger_kernels
from ..kernels.terms.contact_structs import RECORD_NAMES, clock_struct, contact_scratch_struct, history_struct
from ..model.state import State
from ..model.triangle_mesh import TriMesh
from .contact_fields import CONTACT_FIELDS, contact_field, nodal_force, obstacle_contact_points
from .contact_parameters import collider_parameters, contact_parameters
from .contact_sheets import check_sheet_sides
from .contact_tables import ContactTables, facet_pattern_entries
from .deepest_point import DeepestPoints, at_points
from .double_displacements import DoubleDisplacements
from .initial_overlaps import reference_position_text, store_overlaps, touching_depth
from .term import LOSS, NUMERICAL, STORED, WORK, Column, StepContext, Term, part
from .time_law_table import TimeLawTable

if TYPE_CHECKING:
    from ..model.model import Model
    from .workspace import Workspace

__all__ = ["Contact"]


class Contact(Term):
    """Contacts of a model with its colliders.

    Attributes:
        tables: contacts, colliders and facets on the device.
    """

    name = "contact"
    columns = (
        Column("contact", STORED),
        Column("contact_loss", LOSS),
        Column("friction", LOSS),
        Column("collider_work", WORK),
        Column("", NUMERICAL),
    )
    fields = CONTACT_FIELDS
    parts = {"contact": "contact with obstacles: forces, products, history"}

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.traits = Traits(unilateral=True)
        self.tables = ContactTables(model)
        has_meshes = self.tables.has_meshes
        self.kernels, self.ledger_kernels = (
            contact_kernels(model.dtype, has_meshes),
            contact_ledger_kernels(model.dtype, has_meshes),
        )
        self.deepest_points = DeepestPoints(self.tables) if self.tables.has_single_point else None
        self.report_columns = len(RECORD_NAMES) * len(self.tables.contacts)

    @classmethod
    def of(cls, model: Model) -> Contact | None:
        return cls(model) if model.description.contacts else None

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        contacts = model.description.contacts
        return {"contact": bool(contacts), "friction": any(c.mu_static > 0.0 for c in contacts)}

    def build(self, laws: TimeLawTable) -> None:
        self.tables.build(laws, self.offset)
        self.connectivity = [group.conn for group in self.tables.groups]
        self.double_displacements = (
            DoubleDisplacements(self.model, self.connectivity) if self.model.dtype == "float32" else None
        )
        self.rows = self.increment_rows = self.tables.rows

    def hash(self, h: Any) -> None:
        self.tables.hash(h)

    # simulation setup

    def make_scratch(self, worlds: int, make: Callable[[str, tuple[int, ...], Any], wp.array]) -> Any:
        """Attempt struct with arrays from make(name, shape, dtype)."""
        t, B = self.tables, worlds
        K, P, C, R = len(t.colliders), t.points, len(t.contacts), t.rows
        shapes: dict[str, tuple[int, ...]] = {
            "passed_point": (B,), "elapsed_time": (B,), "relaxation": (B,), "limit_updates": (B,), "aitken_norm2": (B,),
            "aitken_sums": (B, AITKEN_LANES), "contact_point": (B, C), "choice_count": (B, C),
            "record_totals": (B, C, len(RECORD_NAMES)), "record_rows": (len(RECORD_NAMES), B, R),
            "facet_activity": (B, R), "facet_deepest_point": (B, R), "facet_deepest_xi": (B, R),
            "facet_max_depth": (B, R), "chosen_facet": (B, C), "point_reference": (B, C),
            "shape_values": (B, C, max(group.conn.shape[1] for group in t.groups)),
        }  # fmt: skip
        shapes |= dict.fromkeys(
            (
                "collider_position",
                "collider_rotation",
                "collider_translation",
                "collider_rotation_change",
                "collider_angle",
            ),
            (B, K),
        )
        if not t.has_single_point:
            shapes |= dict.fromkeys(
                (
                    "point_depth",
                    "facet_deepest_point",
                    "facet_deepest_xi",
                    "facet_max_depth",
                    "chosen_facet",
                    "point_reference",
                ),
                (1, 1),
            ) | {"shape_values": (1, 1, 1)}
        shapes |= {} if t.explicit else dict.fromkeys(("explicit_force", "explicit_elastic_slip"), (1, 1))
        out = contact_scratch_struct(self.model.dtype)()
        for name, var in contact_scratch_struct(self.model.dtype).vars.items():
            setattr(out, name, make(name, shapes.get(name, (B, P)), var.type.dtype))
        return out

    def make_history(self, make: Callable[[str, Any, tuple[int, ...]], wp.array]) -> Any:
        """History struct with arrays from make(name, dtype, shape per world)."""
        out = history_struct()()
        shapes: dict[str, tuple[int, ...]] = {"overlap_time": (), "pose_time": ()}
        shapes |= dict.fromkeys(("position", "rotation", "angle", "previous_margin"), (len(self.tables.colliders),))
        for name, var in history_struct().vars.items():
            if name == "previous_depth" and not self.tables.tracks_deepest:
                continue
            shape = shapes.get(name, (self.tables.points,))
            setattr(out, name, make(f"contact_{name}", var.type.dtype, shape))
        return out

    def allocate(self, work: Workspace, ctx: StepContext) -> None:
        t, B = self.tables, self.model.worlds
        C, R = len(t.contacts), t.rows
        attempt = self.make_scratch(B, lambda name, shape, dtype: work.array(f"contact {name}", shape, dtype))
        attempt.relaxation.fill_(1.0)
        clock = clock_struct()()
        for name in ("time", "new_time", "h", "substep_index"):
            setattr(clock, name, getattr(work.step, name))
        clock.time, clock.is_static = ctx.state.time, int(not ctx.inertia)
        scratch = {
            "attempt": attempt,
            "clock": clock,
            # Newton's method only; unused by Jacobi's iteration
            "contact_active": work.newton.contact_active,
            "energies": work.array("contact energies", (ENERGY_COLUMNS, B, R), wp.float64),
            "parts": work.array("contact parts", (B, C, len(RECORD_NAMES), RECORD_LANES), wp.float64),
            "row_start": self.model.array("contact", t.row_start, wp.int32),
            "u": self.double_displacements.allocate(work, self.name) if self.double_displacements else work.u,
        }
        ctx.scratch[self.name] = scratch | ctx.scratch.get(self.name, {})

    def register(self, ctx: StepContext) -> None:
        ctx.scratch[self.name] = {"history": self.make_history(ctx.state.register)}

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        others = (part.kernels.module for part in (self.deepest_points, self.double_displacements) if part)
        return [self.kernels.module, *others]

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
        overlap, born = history.overlap.numpy(), history.overlap_time.numpy()
        new = fresh & ~(history.speed.numpy() > 0.0).any(axis=1)
        overlap[new] = 0.0
        born[new] = time[new]
        posed = history.pose_time.numpy()
        posed[fresh] = time[fresh]
        history.pose_time.assign(posed)
        history.overlap.assign(overlap)
        history.overlap_time.assign(born)
        gap, _ = self.at_points(state, history, places=False)
        touching = touching_depth(self.model.size, state.displacement.numpy())
        if self.tables.has_sheets and new.any():
            check_sheet_sides(self, s["attempt"], state.displacement, touching, new, ctx.launch)
        store_overlaps(self.tables, np.where(new[:, None], -gap, 0.0), touching, overlap)
        history.overlap.assign(overlap)

    def shift_time(self, state: State) -> None:
        """Shift the start times of stored overlaps."""
        if "contact_overlap_time" in state.specs:
            state.contact_overlap_time.assign(state.contact_overlap_time.numpy() - state.time.numpy())  # type: ignore[attr-defined]

    def _update_poses(self, ctx: StepContext, active: wp.array) -> None:
        s = ctx.scratch[self.name]
        args = [self.tables.data, s["history"], ctx.work.time_law_values, active, s["attempt"]]
        ctx.launch(self.kernels.update_poses, (self.model.worlds, len(self.tables.colliders)), args)

    # in a step

    @part("contact")
    def begin(self, ctx: StepContext, active: wp.array) -> None:
        """Poses of the colliders at the end of the attempt, points at its start."""
        s, m = ctx.scratch[self.name], self.model
        s["finished"] = False
        self._update_poses(ctx, active)
        for group in self.tables.groups:
            dim = (m.worlds, group.count, group.data.point_count)
            args = [self.tables.data, group.data, s["history"], s["clock"]]
            more = [ctx.state.displacement, ctx.state.velocity, active, s["attempt"]]
            ctx.launch(self.kernels.begin_points, dim, [*args, *more])
            if self.tables.explicit:
                ctx.launch(self.kernels.explicit_forces, dim, [*args, *more[1:]])

    def prepare(self, ctx: StepContext, active: wp.array) -> None:
        """Compute the first friction limits and the stiffness of the blocks."""
        self._evaluate_forces(ctx, active, fresh=1)

    def force(self, ctx: StepContext, active: wp.array) -> None:
        self._evaluate_forces(ctx, active, fresh=0)

    @part("contact")
    def _evaluate_forces(self, ctx: StepContext, active: wp.array, *, fresh: int) -> None:
        s, m, w, k = ctx.scratch[self.name], self.model, ctx.work, self.kernels
        if self.double_displacements and ctx.positions_changed:
            self.double_displacements.update(ctx, s["u"], active)
        if fresh:
            self._choose_deepest(ctx, active, fresh=1)
        rows = w.rows_of(self)
        for group in self.tables.groups:
            args = [self.tables.data, group.data, s["history"], s["clock"], s["u"], active, fresh]
            ctx.launch(k.forces, (m.worlds, group.count, group.data.point_count), [*args, s["attempt"]])
            dim, lanes = group.sum_threads(ctx.launch, m.worlds)
            args = [group.data, active, lanes, s["attempt"], w.pool_force, rows, s["contact_active"]]
            ctx.launch(k.gather_point_forces, dim, args)

    def _choose_deepest(self, ctx: StepContext, active: wp.array, *, fresh: int) -> None:
        """Select the point of each single-point contact at work.u."""
        if not self.deepest_points:
            return
        s, w = ctx.scratch[self.name], ctx.work
        state = (ctx.state.displacement, ctx.state.velocity)
        place = self.deepest_points.choose
        place(ctx.launch, s, w.step.new_time, s["u"], state, active, w.newton.unilateral_changed, fresh=fresh)

    @part("contact")
    def update_frozen(self, ctx: StepContext, flags: wp.array) -> None:
        k, m, attempt = self.kernels, self.model, ctx.scratch[self.name]["attempt"]
        ctx.launch(k.aitken_partial_sums, (m.worlds, AITKEN_LANES), [flags, attempt])
        ctx.launch(k.aitken_relaxation, m.worlds, [flags, ctx.work.newton.tol, attempt, ctx.work.newton.partly_updated])
        ctx.launch(k.update_frozen, (m.worlds, self.tables.points), [flags, attempt])
        self._choose_deepest(ctx, flags, fresh=0)

    @part("contact")
    def product(self, ctx: StepContext, p: wp.array, active: wp.array) -> None:
        m, k, attempt = self.model, self.kernels, ctx.scratch[self.name]["attempt"]
        for group in self.tables.groups:
            dim = (m.worlds, group.count, group.data.point_count)
            ctx.launch(k.point_products, dim, [group.data, active, p, attempt])
            sides, lanes = group.sum_threads(ctx.launch, m.worlds)
            args = [group.data, active, lanes, attempt, ctx.work.pool_product]
            ctx.launch(k.gather_facet_products, sides, args)

    @part("contact")
    def diagonal(self, ctx: StepContext, active: wp.array) -> None:
        m, w = self.model, ctx.work
        for group in self.tables.groups:
            args = [group.data, active, ctx.scratch[self.name]["attempt"], w.pool_block]
            ctx.launch(self.kernels.diagonal, (m.worlds, group.count, group.conn.shape[1]), args)

    def energy_increments(self, ctx: StepContext, accepted: wp.array) -> wp.array:
        self._record_substep(ctx, accepted)
        ctx.scratch[self.name]["finished"] = True
        return ctx.scratch[self.name]["energies"]

    @part("contact")
    def _record_substep(self, ctx: StepContext, accepted: wp.array) -> None:
        """Update history, ledger rows and records of an accepted substep."""
        s, m, k = ctx.scratch[self.name], self.model, self.ledger_kernels
        C = len(self.tables.contacts)
        for group in self.tables.groups:
            args = [self.tables.data, group.data, s["history"], s["clock"], s["u"], accepted, s["attempt"]]
            ctx.launch(k.record_substep, (m.worlds, group.count), [*args, s["energies"]])
        args = [self.tables.data, s["row_start"], accepted, s["attempt"], s["parts"]]
        ctx.launch(k.partial_records, (m.worlds, C, len(RECORD_NAMES), RECORD_LANES), args)
        ctx.launch(k.total_records, (m.worlds, C, len(RECORD_NAMES)), [s["clock"], accepted, s["parts"], s["attempt"]])

    @part("contact")
    def commit(self, ctx: StepContext, accepted: wp.array) -> None:
        s, m, w = ctx.scratch[self.name], self.model, ctx.work
        if not s["finished"]:  # no ledger, `energy_increments` not called
            self._record_substep(ctx, accepted)
        args = [self.tables.data, s["clock"], w.newton.strain_energy, w.newton.term_sums, accepted, s["history"]]
        ctx.launch(self.ledger_kernels.store_poses, (m.worlds, len(self.tables.colliders)), [*args, s["attempt"]])

    def report(self, ctx: StepContext) -> None:
        args = [ctx.scratch[self.name]["attempt"], self.report_offset, ctx.work.report]
        ctx.launch(self.ledger_kernels.write_records, (self.model.worlds, len(self.tables.contacts)), args)

    def stored_energy(self, ctx: StepContext) -> dict[str, np.ndarray]:
        """Stored energy according to the history, by points; a single-point contact stores it at its first point."""
        stored = ctx.scratch[self.name]["history"].stored.numpy()
        return {"contact": stored @ self.weights}

    @property
    def weights(self) -> np.ndarray:
        """Fraction (points,) of the contact area represented by each point."""
        out = np.concatenate([share.ravel() for share in self.tables.area_fractions])
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

    def allocate_blocks(self, ctx: StepContext, matrix: Any, *, projected: bool) -> None:
        if "contact blocks" not in self.model.cache:
            conns = [group.conn for group in self.tables.groups]
            self.model.cache["contact blocks"] = [
                facet_pattern_entries(self.model, conn, matrix.pattern) for conn in conns
            ]

    def blocks(
        self, ctx: StepContext, matrix: Any, kept: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
        *, projected: bool,
    ) -> None:  # fmt: skip
        """Positive semi-definite stiffness of the points."""
        m, kernel = self.model, contact_block_kernels(self.model.dtype).add_contact_blocks
        for group, (entry, start, source, count) in zip(self.tables.groups, m.cache["contact blocks"]):
            args = [m.topology, matrix.pattern.data, group.data, entry, start, source, kept[0]]
            weight = kept[1] if self.tables.tracks_deepest else ctx.scratch[self.name]["attempt"].shape_values
            ctx.launch(kernel, (m.worlds, count), [*args, weight, dq_dv, active, out])

    def block_modules(self) -> set[wp.Module]:
        return {contact_block_kernels(self.model.dtype).module}

    def failure_reason(self, ctx: StepContext, world: int) -> tuple[type[PenetrationError], str] | None:
        found = int(ctx.scratch[self.name]["attempt"].passed_point.numpy()[world])
        if found == 0 or int(ctx.work.newton.failed.numpy()[world]) in (FAIL_ROUNDOFF, FAIL_WORK):
            return None
        number = abs(found) - 1
        t = self.tables
        k = int(np.searchsorted(t.first, number, side="right")) - 1
        contact = t.contacts[k]
        if found < 0:
            return PenetrationError, (
                f"contact {contact.name!r}: collider {contact.collider.name!r} turns by more than "
                f"{MAX_COLLIDER_ROTATION:g} rad in the step, in which it is touched; take a smaller dt"
            )
        where = reference_position_text(t, k, number - int(t.first[k]))
        return PenetrationError, (
            f"contact {contact.name!r}: a point of body {contact.body.name!r} (reference place "
            f"{where}) went through collider {contact.collider.name!r}; take a larger "
            "stiffness= of the contact or a thicker shape, or a smaller dt where it moves that far in a step"
        )

    def failure_note(self, ctx: StepContext, world: int) -> str:
        touched = ctx.scratch[self.name]["attempt"].facet_activity.numpy()[world] > 0
        t = self.tables
        pairs = [
            f"{contact.name!r} with collider {contact.collider.name!r}"
            for k, contact in enumerate(t.contacts)
            if touched[t.row_start[k] : t.row_start[k + 1]].any()
        ]
        more = f" and {len(pairs) - 3} more" if len(pairs) > 3 else ""
        return f"; in touch: contact {', '.join(pairs[:3])}{more}" if pairs else ""

    def parameter_arrays(self) -> dict[str, wp.array]:
        return self.tables.parameter_arrays

    def update_materials(self, mask: np.ndarray) -> None:
        self.tables.update_materials(mask)

    def parameters(self) -> dict[str, Callable[[Any, np.ndarray], None]]:
        return contact_parameters(self.tables) | collider_parameters(self.tables)

    def info(self) -> list[dict[str, Any]]:
        """Entries of `Model.info` per contact, in the order of addition: active points, and points excluded because
        their slots are clamped."""
        t, out = self.tables, []
        for contact in self.model.description.contacts:
            k = t.number[contact.index]
            facts = {"name": contact.name, "body": contact.body.name, "collider": contact.collider.name}
            numbers = {"points": int((t.area_fractions[k] > 0.0).sum()), "left_out": t.clamped_point_counts[k]}
            if isinstance(contact.collider.shape, TriMesh):
                numbers["triangles"] = len(contact.collider.shape.triangles)
            out.append(facts | {"law": contact.law, "model": contact.model} | numbers)
        return out

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
