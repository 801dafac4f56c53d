"""Contact between bodies, with a potential per slave surface point, see kernels/terms/pairs.py."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import PenetrationError
from ..kernels.common.traits import Traits
from ..kernels.solvers.newton_control import FAIL_ROUNDOFF, FAIL_WORK
from ..kernels.terms.contact import AITKEN_LANES
from ..kernels.terms.contact_ledger import ENERGY_COLUMNS, RECORD_LANES, contact_ledger_kernels
from ..kernels.terms.contact_structs import RECORD_NAMES, clock_struct, contact_scratch_struct, history_struct
from ..kernels.terms.facet_point_lists import FACETS_PER_CHUNK, point_list_kernels
from ..kernels.terms.facet_search import facet_search_kernels
from ..kernels.terms.pair_ledger import pair_ledger_kernels
from ..kernels.terms.pair_structs import pair_history_struct, pair_scratch_struct
from ..model.state import State
from .contact_fields import CONTACT_FIELDS, contact_field
from .contact_parameters import contact_parameters
from .double_displacements import DoubleDisplacements
from .facet_tables import POINT_SUM_LANES
from .initial_overlaps import reference_position_text, refuse_deep_overlaps, store_overlaps, touching_depth
from .pair_evaluation import evaluate_pairs
from .pair_solves import PairSolves
from .term import LOSS, NUMERICAL, STORED, WORK, Column, StepContext, part

if TYPE_CHECKING:
    from ..model.model import Model
    from .time_law_table import TimeLawTable
    from .workspace import Workspace

__all__ = ["Pairs"]

UNUSED_HISTORY = ("angle", "previous_margin", "previous_depth", "position", "rotation")
"""History of colliders and of single-point contacts."""


class Pairs(PairSolves):
    """Contacts of a model between its bodies.

    Attributes:
        tables: points and facets on the device.
    """

    name = "pairs"
    columns = (
        Column("contact_pairs", STORED),
        Column("contact_loss", LOSS),
        Column("friction", LOSS),
        Column("collider_work", WORK),
        Column("", NUMERICAL),
    )
    fields = CONTACT_FIELDS
    parts = {"pairs": "contact between bodies: search, forces, products, history"}

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.traits = Traits(unilateral=True)
        self.ledger_kernels = contact_ledger_kernels(model.dtype, False)
        self.search_kernels = facet_search_kernels(model.dtype)
        self.point_list_kernels = point_list_kernels(model.dtype)
        self.pair_ledger_kernels = pair_ledger_kernels(model.dtype)
        self.report_columns = len(RECORD_NAMES) * len(self.tables.contacts)

    @classmethod
    def of(cls, model: Model) -> Pairs | None:
        return cls(model) if model.description.pairs else None

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        return {"contact between bodies": bool(model.description.pairs)}

    def tied_slots(self) -> list[np.ndarray]:
        """Bodies in contact form one component."""
        return self.tables.slots

    def mark_constrained(self, free: np.ndarray) -> None:
        """No-op: the forces of a pair are self-equilibrated under translations."""

    def build(self, laws: TimeLawTable) -> None:
        self.tables.build(self.offset)
        self.connectivity = [group.conn for group in self.tables.groups] + [self.tables.master_conn]
        self.double_displacements = (
            DoubleDisplacements(self.model, self.connectivity) if self.model.dtype == "float32" else None
        )
        self.rows = self.increment_rows = self.tables.rows

    def hash(self, h: Any) -> None:
        self.tables.hash(h)

    # simulation setup

    def _make_scratch(self, work: Workspace) -> Any:
        t, B = self.tables, self.model.worlds
        C, P = len(t.contacts), t.points
        point = (B, P)
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(
            (
                "start_displacement",
                "activation_gap",
                "start_depth",
                "approach_speed",
                "frozen_friction",
                "updated_friction",
                "frozen_normal",
                "updated_normal",
                "aitken_residual",
                "activity",
                "force",
                "energy",
                "stiffness",
                "point_product",
            ),
            point,
        )
        shapes |= dict.fromkeys(("explicit_force", "explicit_elastic_slip"), point if t.explicit else (1, 1))
        shapes |= dict.fromkeys(("passed_point", "elapsed_time", "relaxation", "limit_updates", "aitken_norm2"), (B,))
        shapes |= {
            "aitken_sums": (B, AITKEN_LANES),
            "record_totals": (B, C, len(RECORD_NAMES)),
            "facet_activity": (B, t.rows),
        }
        shapes |= {"record_rows": (len(RECORD_NAMES), B, t.rows), "shape_values": (1, 1, 1)}
        out = contact_scratch_struct(self.model.dtype)()
        for name, shape in shapes.items():
            dtype = contact_scratch_struct(self.model.dtype).vars[name].type.dtype
            setattr(out, name, work.array(f"pairs {name}", shape, dtype))
        out.relaxation.fill_(1.0)
        return out

    def _make_pair_scratch(self, work: Workspace) -> Any:
        t, B = self.tables, self.model.worlds
        most = t.master_data(wp.uint64(0)).max_monomials
        F, P, R = t.facets, t.points, t.rows
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(
            ("u_coefs", "director_u_coefs", "start_u_coefs", "start_director_u_coefs", "start_v_coefs"), (B, F * most)
        )
        shapes |= dict.fromkeys(("box_lower", "box_upper", "refit_lower", "refit_upper", "list_count"), (B * F,))
        shapes |= dict.fromkeys(("refit_needed", "refit_count", "lists_changed"), (1,))
        shapes |= dict.fromkeys(("in_reach", "empty_box_lower", "empty_box_upper", "empty_box_refit"), (B, R))
        shapes |= dict.fromkeys(("list_size", "list_start", "facet_centre", "start_facet_centre", "bulge"), (B, F))
        shapes |= {"chunk_offset": (B, -(-F // FACETS_PER_CHUNK))}
        shapes |= dict.fromkeys(("shape_values", "friction_shape", "shape_gradient"), (B, P, t.master_conn.shape[1]))
        shapes |= {"geometric_tangent": (B, P, 2), "deepest_contact": (B, len(t.bodies))}
        out = pair_scratch_struct(self.model.dtype)()
        for name, var in pair_scratch_struct(self.model.dtype).vars.items():
            setattr(out, name, work.array(f"pairs {name}", shapes.get(name, (B, P)), var.type.dtype))
        out.refit_count.fill_(1)
        return out

    def allocate(self, work: Workspace, ctx: StepContext) -> None:
        t, m = self.tables, self.model
        C, R, B = len(t.contacts), t.rows, m.worlds
        attempt, pair = self._make_scratch(work), self._make_pair_scratch(work)
        clock = clock_struct()()
        for name in ("time", "new_time", "h", "substep_index"):
            setattr(clock, name, getattr(work.step, name))
        clock.time, clock.is_static = ctx.state.time, int(not ctx.inertia)
        tree = self._build_tree(pair)
        scratch = {
            "attempt": attempt,
            "pair": pair,
            "tree": tree,
            "masters": t.master_data(tree.id),
            "clock": clock,
            "contact_active": work.newton.contact_active,
            "energies": work.array("pairs energies", (ENERGY_COLUMNS, B, R), wp.float64),
            "parts": work.array("pairs parts", (B, C, len(RECORD_NAMES), RECORD_LANES), wp.float64),
            "row_start": m.array("contact", t.row_start, wp.int32),
            "u": self.double_displacements.allocate(work, self.name) if self.double_displacements else work.u,
        }
        ctx.scratch[self.name] = scratch | ctx.scratch.get(self.name, {})

    def _build_tree(self, pair: Any) -> wp.Bvh:
        """Bounding volume hierarchy of the facets in the reference; one group per world and surface."""
        low, high = self.tables.reference_boxes()
        pair.box_lower.assign(np.tile(low, (self.model.worlds, 1)))
        pair.box_upper.assign(np.tile(high, (self.model.worlds, 1)))
        return wp.Bvh(pair.box_lower, pair.box_upper, constructor="sah", groups=self.tables.box_groups)

    def make_history(self, make: Callable[[str, Any, tuple[int, ...]], wp.array]) -> tuple[Any, Any]:
        """Structs of history and facet assignment, with arrays from make(name, dtype, shape per world)."""
        history, pair_history = history_struct()(), pair_history_struct()()
        points = (self.tables.points,)
        for name, var in history_struct().vars.items():
            if name not in UNUSED_HISTORY:
                shape = () if name in ("overlap_time", "pose_time") else points
                setattr(history, name, make(f"pairs_{name}", var.type.dtype, shape))
        for name, var in pair_history_struct().vars.items():
            setattr(pair_history, name, make(f"pairs_{name}", var.type.dtype, points))
        return history, pair_history

    def register(self, ctx: StepContext) -> None:
        history, pair_history = self.make_history(ctx.state.register)
        ctx.scratch[self.name] = {"history": history, "pair_history": pair_history}

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        double_displacements = [self.double_displacements.kernels.module] if self.double_displacements else []
        return [self.obstacle_kernels.module, self.search_kernels.module, self.kernels.module, *double_displacements]

    def start(self, ctx: StepContext, active: wp.array) -> None:
        """Initial overlaps at the state.

        Raises:
            ModelError: a new contact overlaps, and `overlap` is "refuse".
        """
        s, t = ctx.scratch[self.name], self.tables
        history = s["history"]
        new = (active.numpy() != 0) & ~(history.speed.numpy() > 0.0).any(axis=1)
        if not new.any():
            return
        flags: wp.array = wp.array(new.astype(np.int32), dtype=wp.int32, device=self.model.device)
        overlap, born = history.overlap.numpy(), history.overlap_time.numpy()
        overlap[new] = 0.0
        born[new] = ctx.state.time.numpy()[new]
        history.overlap.assign(overlap)
        history.overlap_time.assign(born)
        self._begin_points(ctx, flags)
        u = ctx.state.displacement
        if self.double_displacements:
            u = s["u"]
            self.double_displacements.widen(ctx.launch, ctx.state.displacement, flags, u)
        self._search_facets(ctx, u, flags, overlap_limit=t.max_overlap_depth)
        facet = s["pair"].facet.numpy()
        depth = np.where((facet != -1) & new[:, None], s["pair"].depth.numpy(), 0.0)
        touching = touching_depth(self.model.size, ctx.state.displacement.numpy())
        store_overlaps(t, depth, touching, overlap)
        refuse_deep_overlaps(t, ctx.state.displacement.numpy(), s["pair"].start_position.numpy(), facet, new)
        history.overlap.assign(overlap)

    def shift_time(self, state: State) -> None:
        """Shift the start times of stored overlaps."""
        if "pairs_overlap_time" in state.specs:
            state.pairs_overlap_time.assign(state.pairs_overlap_time.numpy() - state.time.numpy())  # type: ignore[attr-defined]

    # in a step

    @part("pairs")
    def begin(self, ctx: StepContext, active: wp.array) -> None:
        """Update facets and points at the start of the attempt."""
        ctx.scratch[self.name]["finished"] = False
        self._begin_points(ctx, active)

    def _begin_points(self, ctx: StepContext, active: wp.array) -> None:
        s, m, t = ctx.scratch[self.name], self.model, self.tables
        pair, masters = s["pair"], s["masters"]
        u, v = ctx.state.displacement, ctx.state.velocity
        dim = (m.worlds, t.facets, masters.max_monomials)
        ctx.launch(self.search_kernels.initial_coefficients, dim, [masters, u, v, active, pair])
        for group in t.groups:
            args = [t.data, masters, group.data, s["history"], s["pair_history"], s["clock"]]
            dim = (m.worlds, group.count, group.data.point_count)
            ctx.launch(self.search_kernels.begin_points, dim, [*args, u, v, active, s["attempt"], pair])
            if t.explicit:
                ctx.launch(self.kernels.explicit_forces, dim, [*args, v, active, s["attempt"], pair])

    def _refit_tree(self, ctx: StepContext) -> None:
        s = ctx.scratch[self.name]
        ctx.launch(self.search_kernels.accept_boxes, self.model.worlds * self.tables.facets, [s["pair"]])
        s["tree"].refit()

    def _search_facets(self, ctx: StepContext, u: wp.array, active: wp.array, *, overlap_limit: float) -> None:
        """Assign all points to facets at u."""
        s, m, t, k = ctx.scratch[self.name], self.model, self.tables, self.search_kernels
        pair, masters = s["pair"], s["masters"]
        dim = (m.worlds, t.facets, masters.max_monomials)
        ctx.launch(k.update_coefficients, dim, [masters, u, active, pair.u_coefs, pair.director_u_coefs])
        ctx.launch(k.check_boxes, (m.worlds, t.facets), [masters, active, pair])
        ctx.launch(k.update_centres, (m.worlds, t.facets), [masters, active, pair])
        wp.capture_if(pair.refit_needed, self._refit_tree, ctx=ctx)
        for group, corners in zip(t.groups, t.corners):
            args = [t.data, masters, group.data, s["history"]]
            ctx.launch(
                k.query_boxes, (m.worlds, group.count), [*args, u, active, t.reach_distance + overlap_limit, pair]
            )
            args += [s["clock"], u, ctx.state.velocity, active, overlap_limit, s["attempt"], pair, corners]
            ctx.launch(k.find_facets, (m.worlds, group.count, group.data.point_count), args)

    def prepare(self, ctx: StepContext, active: wp.array) -> None:
        """Compute the first friction limits and the stiffness of the blocks."""
        self._evaluate_forces(ctx, active, fresh=1)

    def force(self, ctx: StepContext, active: wp.array) -> None:
        self._evaluate_forces(ctx, active, fresh=0)

    @part("pairs")
    def _evaluate_forces(self, ctx: StepContext, active: wp.array, *, fresh: int) -> None:
        s, m, w, t = ctx.scratch[self.name], self.model, ctx.work, self.tables
        pair, masters = s["pair"], s["masters"]
        if ctx.positions_changed:
            if self.double_displacements:
                self.double_displacements.update(ctx, s["u"], active)
            self._search_facets(ctx, s["u"], active, overlap_limit=0.0)
        for group in t.groups:
            args = [t.data, masters, group.data, s["history"], s["pair_history"], s["clock"], s["u"], active, fresh]
            dim = (m.worlds, group.count, group.data.point_count)
            ctx.launch(self.kernels.forces, dim, [*args, s["attempt"], pair])
        wp.capture_if(pair.lists_changed, self._build_point_lists, ctx=ctx)
        for group in t.groups:
            sides, lanes = group.sum_threads(ctx.launch, m.worlds)
            args = [group.data, active, lanes, s["attempt"], w.pool_force, w.rows_of(self), s["contact_active"]]
            ctx.launch(self.obstacle_kernels.gather_point_forces, sides, args)
        lanes = ctx.launch.lanes(POINT_SUM_LANES)
        args = [masters, active, lanes, s["attempt"], pair, w.pool_force]
        ctx.launch(self.kernels.gather_master_forces, (m.worlds, ctx.launch.padded(lanes * t.master_conn.size)), args)

    def _build_point_lists(self, ctx: StepContext) -> None:
        """Build the point lists of the master facets."""
        s, m, t, k = ctx.scratch[self.name], self.model, self.tables, self.point_list_kernels
        pair, masters = s["pair"], s["masters"]
        ctx.launch(k.clear_lists, m.worlds * t.facets, [pair])
        ctx.launch(k.count_points, (m.worlds, t.points), [masters, pair])
        ctx.launch(k.sum_chunks, pair.chunk_offset.shape, [masters, pair])
        ctx.launch(k.scan_chunks, m.worlds, [pair])
        ctx.launch(k.set_list_starts, (m.worlds, t.facets), [masters, pair])
        ctx.launch(k.fill_lists, (m.worlds, t.points), [masters, pair])
        ctx.launch(k.sort_lists, (m.worlds, t.facets), [pair])

    @part("pairs")
    def update_frozen(self, ctx: StepContext, flags: wp.array) -> None:
        k, m, attempt = self.obstacle_kernels, self.model, ctx.scratch[self.name]["attempt"]
        ctx.launch(k.aitken_partial_sums, (m.worlds, AITKEN_LANES), [flags, attempt])
        ctx.launch(k.aitken_relaxation, m.worlds, [flags, ctx.work.newton.tol, attempt, ctx.work.newton.partly_updated])
        ctx.launch(k.update_frozen, (m.worlds, self.tables.points), [flags, attempt])
        s = ctx.scratch[self.name]
        for group in self.tables.groups:
            args = [s["masters"], group.data, s["u"], flags, attempt, s["pair"]]
            ctx.launch(self.kernels.update_friction_shapes, (m.worlds, group.count, group.data.point_count), args)

    def energy_increments(self, ctx: StepContext, accepted: wp.array) -> wp.array:
        self._record_substep(ctx, accepted)
        ctx.scratch[self.name]["finished"] = True
        return ctx.scratch[self.name]["energies"]

    @part("pairs")
    def _record_substep(self, ctx: StepContext, accepted: wp.array) -> None:
        """Update history, ledger rows and records of an accepted substep."""
        s, m, t = ctx.scratch[self.name], self.model, self.tables
        C = len(t.contacts)
        self._search_facets(ctx, s["u"], accepted, overlap_limit=0.0)
        for group in t.groups:
            args = [t.data, s["masters"], group.data, s["history"], s["pair_history"], s["clock"], accepted]
            args += [s["attempt"], s["pair"], s["energies"]]
            ctx.launch(self.pair_ledger_kernels.record_substep, (m.worlds, group.count), args)
        args = [t.data, s["row_start"], accepted, s["attempt"], s["parts"]]
        ctx.launch(self.ledger_kernels.partial_records, (m.worlds, C, len(RECORD_NAMES), RECORD_LANES), args)
        args = [s["clock"], accepted, s["parts"], s["attempt"]]
        ctx.launch(self.ledger_kernels.total_records, (m.worlds, C, len(RECORD_NAMES)), args)

    @part("pairs")
    def commit(self, ctx: StepContext, accepted: wp.array) -> None:
        s, w = ctx.scratch[self.name], ctx.work
        if not s["finished"]:  # no ledger, `energy_increments` not called
            self._record_substep(ctx, accepted)
        args = [s["clock"], w.newton.strain_energy, w.newton.term_sums, accepted, s["history"], s["attempt"]]
        ctx.launch(self.pair_ledger_kernels.add_energy_bound, self.model.worlds, args)

    def report(self, ctx: StepContext) -> None:
        args = [ctx.scratch[self.name]["attempt"], self.report_offset, ctx.work.report]
        ctx.launch(self.ledger_kernels.write_records, (self.model.worlds, len(self.tables.contacts)), args)

    def stored_energy(self, ctx: StepContext) -> dict[str, np.ndarray]:
        """Stored energy according to the history, by points."""
        weights = np.concatenate([share.ravel() for share in self.tables.area_fractions])
        return {"contact_pairs": ctx.scratch[self.name]["history"].stored.numpy() @ weights}

    # results

    def failure_reason(self, ctx: StepContext, world: int) -> tuple[type[PenetrationError], str] | None:
        found = int(ctx.scratch[self.name]["attempt"].passed_point.numpy()[world])
        if found == 0 or int(ctx.work.newton.failed.numpy()[world]) in (FAIL_ROUNDOFF, FAIL_WORK):
            return None
        t = self.tables
        k = int(np.searchsorted(t.first, found - 1, side="right")) - 1
        contact, where = t.contacts[k], reference_position_text(t, k, found - 1 - int(t.first[k]))
        return PenetrationError, (
            f"contact {contact.name!r}: a point of body {contact.slave.body.name!r} (reference place "
            f"{where}) went through body {contact.master.body.name!r}; take a larger "
            "stiffness= of the contact or a thicker body, or a smaller dt where it moves that far in a step"
        )

    def failure_note(self, ctx: StepContext, world: int) -> str:
        touched = ctx.scratch[self.name]["attempt"].facet_activity.numpy()[world] > 0
        t = self.tables
        names = [repr(c.name) for k, c in enumerate(t.contacts) if touched[t.row_start[k] : t.row_start[k + 1]].any()]
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        return f"; in touch: contact {', '.join(names[:3])}{more}" if names else ""

    def parameter_arrays(self) -> dict[str, wp.array]:
        return self.tables.parameter_arrays

    def update_materials(self, mask: np.ndarray) -> None:
        self.tables.update_materials(mask)

    def parameters(self) -> dict[str, Callable[[Any, np.ndarray], None]]:
        return contact_parameters(self.tables)

    def info(self) -> list[dict[str, Any]]:
        """Entries of `Model.info` per contact, in the order of addition."""
        t, out = self.tables, []
        for contact in self.model.description.pairs:
            k = t.number[contact.index]
            names = {"name": contact.name, "body": contact.first.body.name, "with": contact.second.body.name}
            numbers = {
                "points": int((t.area_fractions[k] > 0.0).sum()),
                "facets": len(t.masters[t.master_of[k]].conn),
                "left_out": 0,
            }
            out.append(names | {"law": contact.law, "model": contact.model} | numbers)
        return out

    # at a state

    def nodal_force(self, state: State) -> np.ndarray:
        """Elastic nodal forces of all contacts at a state, both bodies, (worlds, slots, 3), N."""
        return evaluate_pairs(self, state).nodal_force()

    def samples(self, field: str, body: Any, state: State) -> np.ndarray:
        bodies = [side.body for contact in self.tables.contacts for side in (contact.slave, contact.master)]
        contact_points = evaluate_pairs(self, state).contact_points(body) if body in bodies else []
        return contact_field(field, body, state.worlds, contact_points)
