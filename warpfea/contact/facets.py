"""Contact of points with facets of bodies, see kernels/contact/facet_kinematics.py, and its part in their modes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.worlds import device_flags, set_rows
from ..kernels.common.state import state_kernels
from ..kernels.contact.assembly import block_kernels
from ..kernels.contact.carriers import carrier_kernels
from ..kernels.contact.coupling import coupling_kernels
from ..kernels.contact.edge_records import edge_record_kernels
from ..kernels.contact.edges import edge_kernels
from ..kernels.contact.facet_kinematics import master_kernels
from ..kernels.contact.facet_search import facet_search_kernels
from ..kernels.contact.facet_structs import (
    facet_side_struct,
    pair_history_struct,
    pair_scratch_struct,
    point_list_struct,
)
from ..kernels.contact.midpoint import pair_midpoint_kernels
from ..kernels.contact.point_lists import FACETS_PER_CHUNK, point_list_kernels
from ..model.pairs import FacetOptions
from ..model.state import State, view_as_words
from ..terms.protocols import Coupled, Tied
from ..terms.term import StepContext, part
from .body_levels import BodyLevels
from .collider_tables import poses_by_laws
from .colliders import ColliderContact
from .evaluation import contact_field, evaluate_pairs, refuse_deep_overlaps, store_overlaps, touching_depth
from .facet_adjoint import DifferentiableFacets
from .facet_tables import PairTables
from .mode_coupling import PairCoarseTerms, PairRigidModes, coupling_entries
from .tables import POINT_SUM_LANES
from .term import ContactTerm, contact_columns

if TYPE_CHECKING:
    from ..model.model import Model
    from ..terms.workspace import Workspace

__all__ = ["FacetContact"]


class FacetContact(ContactTerm, DifferentiableFacets, Tied, Coupled):
    """Contacts of a model with facets of its bodies: of points of other bodies, and of narrow obstacles.

    Attributes:
        tables: points and facets on the device.
    """

    name = "pairs"
    translation_invariant = True  # forces of pairs are self-equilibrated; obstacles: `mark_constrained`
    columns = contact_columns("contact_pairs")
    parts = {"pairs": "contact with facets of bodies: search, forces, products, history"}

    def __init__(self, model: Model) -> None:
        super().__init__(model, PairTables(model), "facets")
        if model.dtype == "float64" and not self.tables.explicit:  # else types differ, or forces have no product
            self.shared_arrays = {"point_product": "tangential_force", "energy": "facet_rotation"}
        self.search_kernels = facet_search_kernels(model.dtype, bool(self.tables.seams))
        self.master_kernels = master_kernels(model.dtype)
        self.point_list_kernels = point_list_kernels(model.dtype)
        self.midpoint_kernels = pair_midpoint_kernels(model.dtype)
        self.edge_kernels = edge_kernels(model.dtype)

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        contacts = model.description.contacts_of(FacetOptions)
        grounded = {contact.grounded for contact in contacts}
        return {"contact": True in grounded, "contact between bodies": False in grounded} | {
            "friction": any(contact.mu_static > 0.0 for contact in contacts)
        }

    def tied_slots(self) -> list[np.ndarray]:
        """Bodies in contact form one component."""
        return self.tables.slots

    # simulation setup

    def _make_pair_scratch(self, work: Workspace, *, midpoint: bool) -> Any:
        t, B = self.tables, self.model.worlds
        most = t.master_data(wp.uint64(0)).max_monomials
        F, P, R, C = t.facets, t.points, t.rows, len(t.carriers)
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(
            ("displacement", "start_displacement", "middle_displacement", "start_velocity"), (B, F * most)
        )
        shapes |= dict.fromkeys(("box_lower", "box_upper", "refit_lower", "refit_upper", "list_count"), (B * F,))
        shapes |= dict.fromkeys(("refit_needed", "refit_count", "lists_changed"), (1,))
        shapes |= dict.fromkeys(("in_reach", "empty_box_lower", "empty_box_upper", "empty_box_refit"), (B, R))
        shapes |= dict.fromkeys(("list_size", "list_start", "facet_centre", "start_facet_centre", "bulge"), (B, F))
        shapes |= {"chunk_offset": (B, -(-F // FACETS_PER_CHUNK))}
        shapes |= dict.fromkeys(("shape_values", "friction_shape", "shape_gradient"), (B, P, t.master_conn.shape[1]))
        shapes |= {"carried_shift": (2, B, C), "carried_turn": (2, B, C)}
        shapes |= dict.fromkeys(("carried_value", "carried_angle"), (B, C))
        shapes |= {"geometric_tangent": (B, P, 2), "deepest_contact": (B, len(t.bodies))}
        out = pair_scratch_struct(self.model.dtype)()
        for name, var in pair_scratch_struct(self.model.dtype).vars.items():
            shape = shapes.get(name, (B, P))
            if (name in ("middle_displacement", "friction_xi") and not midpoint) or 0 in shape:
                continue
            if name.endswith("displacement") and name != "frozen_displacement":
                for part in ("value", "director"):
                    setattr(getattr(out, name), part, work.array(f"pairs {name} {part}", shape, wp.vec3d))
            else:
                setattr(out, name, work.array(f"pairs {name}", shape, var.type.dtype))
        if not midpoint:
            out.friction_xi = out.xi
        out.refit_count.fill_(1)
        return out

    def allocate(self, work: Workspace, ctx: StepContext) -> None:
        super().allocate(work, ctx)
        s = ctx.scratch[self.name]
        s["pair"] = self._make_pair_scratch(work, midpoint=ctx.midpoint)
        for name, other in self.shared_arrays.items():  # forces and products are gathered before the next are written
            setattr(s["attempt"], name, getattr(s["pair"], other))
        s["tree"] = self._build_tree(s["pair"])
        s["masters"] = self.tables.master_data(s["tree"].id)
        s["other"].masters, s["other"].scratch = s["masters"], s["pair"]
        if self.tables.mixed:
            colliders = self.model.terms.find(ColliderContact)
            s["levels"] = BodyLevels(ctx, s, self.tables, ctx.scratch[colliders.name], colliders.tables)

    def _build_tree(self, pair: Any) -> wp.Bvh:
        """Bounding volume hierarchy of the facets in the reference; one group per world and surface."""
        low, high = self.tables.reference_boxes()
        pair.box_lower.assign(np.tile(low, (self.model.worlds, 1)))
        pair.box_upper.assign(np.tile(high, (self.model.worlds, 1)))
        return wp.Bvh(pair.box_lower, pair.box_upper, constructor="sah", groups=self.tables.box_groups)

    def make_pair_history(self, make: Callable[[str, Any, tuple[int, ...]], wp.array]) -> Any:
        """Struct of the facets of the points, with arrays from make(name, dtype, shape per world)."""
        out = pair_history_struct()()
        for name, var in pair_history_struct().vars.items():
            count = len(self.tables.carriers) if name == "carried" else self.tables.points
            if count:
                setattr(out, name, make(f"{self.name}_{name}", var.type.dtype, (count,)))
        return out

    def _allocate_other(self, work: Workspace, other: Any) -> None:
        """No-op: the arrays of an attempt come with the tree, in `allocate`."""

    def make_other(self, make: Callable[[str, Any, tuple[int, ...]], wp.array]) -> Any:
        out = facet_side_struct(self.model.dtype)()
        out.history = self.make_pair_history(make)
        return out

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        own = [self.search_kernels, self.search_kernels.boxes, self.master_kernels, self.point_list_kernels]
        own += [self.midpoint_kernels] if ctx.midpoint else []
        own += [edge_record_kernels()] if self._edge_columns is not None else []
        own += [self.edge_kernels] if self.tables.edge_groups else []
        own += [carrier_kernels(self.model.dtype)] if self.tables.carriers else []
        own += [ctx.scratch[self.name]["levels"].kernels] if self.tables.mixed else []
        return [*super().modules(ctx), *(kernels.module for kernels in own)]

    def start(self, ctx: StepContext, active: wp.array) -> None:
        """Initial overlaps at the state.

        Raises:
            ModelError: a new contact overlaps, and `overlap` is "refuse".
        """
        s, t = ctx.scratch[self.name], self.tables
        history = s["history"]
        if t.carriers:  # they go on from a history at this time: a control may have changed since
            time, carried = ctx.state.time.numpy(), s["other"].history.carried
            known = (carried.numpy()[:, :, 3] > 0.0).all(axis=1) & (history.pose_time.numpy() == time)
            fresh = (active.numpy() != 0) & ~known
            set_rows(carried, fresh, 0.0)
            self._carry(ctx, active)
            set_rows(carried, fresh, s["pair"].carried_value.numpy()[fresh])
            set_rows(history.pose_time, fresh, time[fresh])
        new = (active.numpy() != 0) & ~(history.speed.numpy() > 0.0).any(axis=1)
        if not new.any():
            return
        flags = device_flags(new, self.model.device)
        overlap = self.forget_overlaps(ctx, new)
        self._begin_points(ctx, flags)
        u = ctx.state.displacement
        if self.double_displacements:
            u = s["u"]
            self.double_displacements.widen(ctx.launch, ctx.state.displacement, flags, u)
        self._search_facets(ctx, u, flags, overlap_limit=t.max_overlap_depth)
        facet = s["pair"].facet.numpy()
        depth = np.where((facet != -1) & new[:, None], s["pair"].depth.numpy(), 0.0)
        touching = touching_depth(self.model.size, ctx.state.displacement.numpy())
        store_overlaps(self, depth, touching, overlap)
        refuse_deep_overlaps(t, ctx.state.displacement.numpy(), s["attempt"].start_position.numpy(), facet, new)
        history.overlap.assign(overlap)

    # in a step

    def _carry(self, ctx: StepContext, active: wp.array) -> None:
        """Places of the obstacles that move."""
        s = ctx.scratch[self.name]
        args = [s["masters"], ctx.work.time_law_values, active, 0, s["other"].history, s["pair"]]
        ctx.launch(carrier_kernels(self.model.dtype).carry, (self.model.worlds, len(self.tables.carriers)), args)

    def _begin_other(self, ctx: StepContext, active: wp.array) -> None:
        s, state = ctx.scratch[self.name], ctx.state
        if self.tables.carriers:
            self._carry(ctx, active)
        dim = (self.model.worlds, self.tables.facets, s["masters"].max_monomials)
        args = [s["masters"], state.displacement, state.velocity, active, s["pair"]]
        ctx.launch(self.search_kernels.initial_coefficients, dim, args)
        if self.tables.mixed:
            s["levels"].find(active)
        for group, edges in self.tables.edge_groups:
            args = [self.tables.data, s["masters"], edges, group.data, s["history"], s["other"].history, s["clock"]]
            args += [state.displacement, active, s["attempt"], s["pair"]]
            ctx.launch(self.edge_kernels.begin_edges, (self.model.worlds, edges.edge_count), args)

    def _refit_tree(self, ctx: StepContext) -> None:
        s = ctx.scratch[self.name]
        ctx.launch(self.search_kernels.accept_boxes, self.model.worlds * self.tables.facets, [s["pair"]])
        s["tree"].refit()

    def _search_facets(self, ctx: StepContext, u: wp.array, active: wp.array, *, overlap_limit: float) -> None:
        """Assign all points to facets at u."""
        s, m, t, k = ctx.scratch[self.name], self.model, self.tables, self.search_kernels
        pair, masters = s["pair"], s["masters"]
        dim = (m.worlds, t.facets, masters.max_monomials)
        ctx.launch(k.update_coefficients, dim, [masters, u, active, pair])
        ctx.launch(k.check_boxes, (m.worlds, t.facets), [masters, active, pair])
        ctx.launch(k.update_centres, (m.worlds, t.facets), [masters, active, pair])
        wp.capture_if(pair.refit_needed, self._refit_tree, ctx=ctx)
        for group in t.groups:
            args = [masters, group.data, s["history"]]
            more = [t.reach_distance + overlap_limit, s["attempt"], pair]
            ctx.launch(k.query_boxes, (m.worlds, group.count), [*args, u, active, *more])
            args = [
                t.data,
                *args,
                s["clock"],
                u,
                ctx.state.velocity,
                active,
                overlap_limit,
                s["attempt"],
                pair,
            ]
            ctx.launch(k.find_facets, group.point_threads(m.worlds), args)
        for group, edges in t.edge_groups if overlap_limit == 0.0 else ():
            args = [t.data, masters, edges, group.data, s["history"], s["clock"], ctx.state.displacement]
            args += [ctx.state.velocity, u, active, s["attempt"], pair]
            ctx.launch(self.edge_kernels.find_edges, (m.worlds, edges.edge_count), args)

    def _find_other(self, ctx: StepContext, active: wp.array, *, fresh: int) -> None:
        if ctx.positions_changed:
            self._find_accepted(ctx, active)

    def _find_accepted(self, ctx: StepContext, accepted: wp.array) -> None:
        s, k = ctx.scratch[self.name], self.midpoint_kernels
        self._search_facets(ctx, s["u"], accepted, overlap_limit=0.0)
        if ctx.midpoint:
            pair, worlds = s["pair"], self.model.worlds
            ctx.launch(k.middle_coefficients, pair.displacement.value.shape, [accepted, pair])
            for group in self.tables.groups:
                args = [s["masters"], group.data, accepted, s["u"], s["attempt"], pair]
                ctx.launch(k.middle_projections, group.point_threads(worlds), args)

    def _list_points(self, ctx: StepContext) -> None:
        pair = ctx.scratch[self.name]["pair"]
        wp.capture_if(pair.lists_changed, self._build_point_lists, ctx=ctx, pair=pair)

    def _gather_other_forces(self, ctx: StepContext, active: wp.array) -> None:
        s, lanes = ctx.scratch[self.name], ctx.launch.lanes(POINT_SUM_LANES)
        dim = (self.model.worlds, ctx.launch.padded(lanes * self.tables.other_entries))
        args = [s["other"], active, lanes, s["attempt"], ctx.work.pool_force]
        ctx.launch(self.master_kernels.gather_master_forces, dim, args)
        for group, edges in self.tables.edge_groups:
            args = [edges, group.data, active, s["attempt"], s["pair"], ctx.work.pool_force]
            threads = (self.model.worlds, edges.edge_count, group.conn.shape[1])
            ctx.launch(self.edge_kernels.move_friction, threads, args)

    def _build_point_lists(self, ctx: StepContext, pair: Any) -> None:
        """Build the lists of the points that each master facet is listed for."""
        s, m, t, k = ctx.scratch[self.name], self.model, self.tables, self.point_list_kernels
        masters = s["masters"]
        ctx.launch(k.clear_lists, m.worlds * t.facets, [pair])
        ctx.launch(k.count_points, (m.worlds, t.points), [masters, pair])
        ctx.launch(k.sum_chunks, pair.chunk_offset.shape, [masters, pair])
        ctx.launch(k.scan_chunks, m.worlds, [pair])
        ctx.launch(k.set_list_starts, (m.worlds, t.facets), [masters, pair])
        ctx.launch(k.fill_lists, (m.worlds, t.points), [pair])
        ctx.launch(k.sort_lists, (m.worlds, t.facets), [pair])

    @part()
    def update_frozen(self, ctx: StepContext, flags: wp.array) -> None:
        super().update_frozen(ctx, flags)
        s = ctx.scratch[self.name]
        for group in self.tables.groups:
            args = [s["other"], group.data, s["u"], flags, s["attempt"]]
            ctx.launch(self.master_kernels.update_friction_shapes, group.point_threads(self.model.worlds), args)

    @cached_property
    def _edge_columns(self) -> wp.array | None:
        """First report columns of each contact with a contact of edges, and of that; None: there is none."""
        terms = self.model.terms.contacts
        found = [contact for contact in self.model.description.contacts if contact.edges is not None]
        both = [(term.contact_column(contact), self.contact_column(contact.edges))
                for contact in found for term in terms if contact in term.tables.contacts]  # fmt: skip
        return self.model.array("contact", np.array(both), wp.vec2i) if both else None

    def report(self, ctx: StepContext) -> None:
        args = [ctx.scratch[self.name]["attempt"], self.report_offset, ctx.work.report]
        ctx.launch(self.ledger_kernels.write_records, (self.model.worlds, len(self.tables.contacts)), args)
        if self._edge_columns is not None:
            dim = (self.model.worlds, len(self._edge_columns))
            ctx.launch(edge_record_kernels().add_edge_records, dim, [self._edge_columns, ctx.work.report])

    # in a linear solve

    @part()
    def diagonal(self, ctx: StepContext, active: wp.array) -> None:
        s, m, t = ctx.scratch[self.name], self.model, self.tables
        super().diagonal(ctx, active)
        args = [s["other"], active, s["attempt"], ctx.work.pool_block]
        ctx.launch(self.master_kernels.master_diagonal, (m.worlds, t.facets, t.master_conn.shape[1]), args)

    def cached_inputs(self, ctx: StepContext) -> list[tuple[str, wp.array]]:
        s = ctx.scratch[self.name]
        t = s["pair"]
        arrays = {
            "list_size": t.list_size,
            "list_start": t.list_start,
            "list_point": t.list_point,
            "shape_values": t.shape_values,
            "listed_facet": t.listed_facet,
        }
        return [("stiffness", s["attempt"].stiffness), *arrays.items()]

    def reset_scratch(self, ctx: StepContext, flags: wp.array) -> None:
        # lists are longer than their contents, and a preconditioner copies all of them
        for _, array in self.cached_inputs(ctx):
            words = view_as_words(array)
            ctx.launch(state_kernels().clear_rows, words.shape, [flags, words])

    def blocks(
        self, ctx: StepContext, matrix: Any, cached: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
        *, projected: bool,
    ) -> None:  # fmt: skip
        """Stiffness of the points on their own facets and on master facets, and the coupling of both where the
        pattern has it."""
        m = self.model
        lists = point_list_struct()()
        stiffness, lists.list_size, lists.list_start, lists.list_point, weight, listed = cached
        self._add_facet_blocks(ctx, matrix, stiffness, weight, dq_dv, active, out)
        index, begin, source, count = m.cache["pairs blocks"][-1]
        args = [m.topology, matrix.pattern.data, lists, index, begin, source, stiffness, weight, dq_dv, active, out]
        ctx.launch(block_kernels(m.dtype, True).add_blocks, (m.worlds, count), args)
        for group, begin, source, count in m.cache["pairs couplings"]:
            args = [m.topology, matrix.pattern.data, group.data, ctx.scratch[self.name]["masters"], begin, source]
            args += [stiffness, weight, listed, dq_dv, active, out]
            ctx.launch(coupling_kernels(m.dtype).add_couplings, (m.worlds, count), args)

    def allocate_blocks(self, ctx: StepContext, matrix: Any, *, projected: bool) -> None:
        super().allocate_blocks(ctx, matrix, projected=projected)
        if "pairs couplings" not in self.model.cache:
            found = [(group, *coupling_entries(self.tables, group, matrix.pattern)) for group in self.tables.groups]
            self.model.cache["pairs couplings"] = [row for row in found if row[-1]]

    def block_modules(self) -> set[wp.Module]:
        out = super().block_modules() | {block_kernels(self.model.dtype, True).module}
        return out | ({coupling_kernels(self.model.dtype).module} if self.model.cache["pairs couplings"] else set())

    def coupled_slot_pairs(self) -> tuple[np.ndarray, np.ndarray]:
        both = [sides for c, sides in zip(self.tables.contacts, self.tables.slots_by_side) if not c.grounded]
        grids = [np.stack(np.meshgrid(*sides)).reshape(2, -1) for sides in both]
        a, b = np.concatenate([np.zeros((2, 0), dtype=np.int64), *grids], axis=1)
        return a, b

    def coupled_bodies(self) -> list[tuple[int, int]]:
        return self._coupled_bodies

    @cached_property
    def _coupled_bodies(self) -> list[tuple[int, int]]:
        number = {id(body): k for k, body in enumerate(self.model.bodies)}
        pairs = [c.sides for c in self.tables.contacts if not c.grounded]
        return [(number[id(first)], number[id(second)]) for first, second in pairs]

    def mark_constrained(self, free: np.ndarray) -> None:
        """Obstacles hold the bodies that they touch."""
        for contact in self.tables.contacts:
            if contact.grounded:
                free[np.unique(self.model.components.of_slot[contact.body.slots])] = 0.0

    def allocate_mode_coupling(self, ctx: StepContext, rigid_modes: Any) -> Iterable[wp.Module]:
        if not self.coupled_bodies():
            return ()
        s = ctx.scratch[self.name]
        s["rigid_modes"] = PairRigidModes(ctx, self.tables, s["masters"], rigid_modes)
        return {s["rigid_modes"].kernels.module}

    def add_mode_coupling(self, ctx: StepContext, cached: list[wp.array], dq_dv: wp.array, active: wp.array) -> None:
        ctx.scratch[self.name]["rigid_modes"].add(cached, dq_dv, active)

    def allocate_coarse_coupling(self, ctx: StepContext, coarse: Any) -> Iterable[wp.Module]:
        if not self.coupled_bodies():
            return ()
        ctx.scratch[self.name]["coarse"] = PairCoarseTerms(ctx, self.tables, ctx.scratch[self.name]["masters"], coarse)
        return {ctx.scratch[self.name]["coarse"].kernels.module}

    def add_coarse_coupling(self, ctx: StepContext, cached: list[wp.array], dq_dv: wp.array, active: wp.array) -> None:
        ctx.scratch[self.name]["coarse"].add(cached, dq_dv, active)

    def _turn_text(self, contact: Any) -> str:
        return (
            f"a facet of {contact.texts[1]} turns by more than a right angle in the step, in which it is touched; take "
            "a smaller dt"
        )

    def _contact_info(self, contact: Any, k: int) -> dict[str, Any]:
        return {"facets": len(self.tables.masters[self.tables.master_of[k]].conn), "left_out": 0}

    # at a state

    def nodal_force(self, state: State) -> np.ndarray:
        """Elastic nodal forces of all contacts at a state, both bodies, (worlds, slots, 3), N."""
        return evaluate_pairs(self, state).nodal_force()

    def poses(self, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """As of `Touching`, by the time laws; None if `ColliderContact` has them, or no contact an obstacle."""
        laws = self.tables.collider_laws
        if not laws:
            return None
        position, rotation = poses_by_laws(self.model, laws, state)
        return position, rotation, np.zeros(position.shape[:2])

    def samples(self, field: str, body: Any, state: State) -> np.ndarray:
        bodies = [side.body for contact in self.tables.contacts for side in contact.surfaces]
        contact_points = evaluate_pairs(self, state).contact_points(body) if body in bodies else []
        return contact_field(field, body, state.worlds, contact_points)
