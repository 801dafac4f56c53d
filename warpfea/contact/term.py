"""Contact of surface points with another side, a potential per point, in the order of its stages, written once.

A subclass is one geometry: it has the other side's tables and arrays, and finds the other side of each point
(`_begin_other`, `_find_other`). Law, friction, history, ledger, records, parameters and fields are those of every
geometry.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import PenetrationError
from ..kernels.contact.assembly import AITKEN_LANES, block_kernels, contact_kernels
from ..kernels.contact.ledger import ENERGY_COLUMNS, RECORD_LANES, contact_ledger_kernels
from ..kernels.contact.structs import (
    PENETRATION_ROW,
    RECORD_NAMES,
    clock_struct,
    contact_scratch_struct,
    history_struct,
)
from ..kernels.solvers.newton_control import Failure
from ..model.contact_points import element_edge_and_depth
from ..model.state import State
from ..terms.protocols import Diagnosed, Parametrised, Preconditioned, Touching, Updated
from ..terms.term import LOSS, NUMERICAL, STORED, WORK, Column, StepContext, part
from .collider_tables import facet_pattern_entries
from .double_displacements import DoubleDisplacements
from .evaluation import CONTACT_FIELDS, reference_position_text
from .tables import POINT_SUM_LANES, speed_damping

if TYPE_CHECKING:
    from ..model.model import Model
    from ..terms.time_law_table import TimeLawTable
    from ..terms.workspace import Workspace
    from .tables import FacetTables

__all__ = ["ContactTerm", "contact_columns"]

MAX_NAMED_CONTACTS = 3
"""Maximum number of contacts named in a message."""
OF_FACETS = ("facet_deepest_point", "facet_deepest_xi", "facet_max_depth")
OF_CONTACTS = ("contact_point", "chosen_facet", "point_reference", "choice_count")
"""Arrays of single-point contacts, by facets and by contacts."""


def contact_columns(stored: str) -> tuple[Column, ...]:
    """Ledger columns of a contact term that stores its energy in column `stored`."""
    shared = (Column("contact_loss", LOSS), Column("friction", LOSS), Column("collider_work", WORK))
    return (Column(stored, STORED), *shared, Column("", NUMERICAL))


class ContactTerm(Updated, Preconditioned, Parametrised, Diagnosed, Touching):
    """Contacts of a model with one geometry of the other side.

    Members of a geometry; those down to `nodal_force` are needed (`_turn_text` with TURNED), the others do nothing
    here, or what any geometry needs:

    =============================  ==================================================================================
    `name`, `columns`, `parts`     name; ledger columns, of `contact_columns`; parts of a profile
    `features`                     features that the model uses: without any there is no term
    `make_other`                   struct `Other` of the device functions, with its arrays in the state
    `_allocate_other`              arrays of an attempt of that struct
    `_begin_other`                 the other side at the start of an attempt, such as poses
    `_contact_info`                numbers of `Model.info`
    `_turn_text`                   reason where `evaluate` returns TURNED
    `samples`, `nodal_force`       fields and forces at a state
    `_find_other`                  search at an iterate
    `_find_accepted`               search at the accepted iterate
    `_list_points`                 points of each slot of the other side, before the forces are gathered
    `_gather_other_forces`         forces on the slots of the other side
    `start`                        other side and overlaps at a state that a run begins from
    `update_frozen`, `diagonal`    more than that of the points, for the other side
    `cached_inputs`, `blocks`      stiffness in an assembled matrix; `_add_facet_blocks` adds that of the points
    `poses`                        of obstacles at a state
    =============================  ==================================================================================

    Attributes:
        tables: contacts, points and facets on the device.
        point_kernels, ledger_kernels: kernels of the points, and of their energies and records.
        shared_arrays: arrays of an attempt, by name, that are arrays of the other side.
    """

    fields = CONTACT_FIELDS
    shared_arrays: dict[str, str] = {}

    def __init__(self, model: Model, tables: FacetTables[Any], geometry: str) -> None:
        super().__init__(model)
        self.tables: Any = tables
        self.point_kernels = contact_kernels(model.dtype, geometry, tables.own_laws)
        self.ledger_kernels = contact_ledger_kernels(model.dtype, geometry, tables.own_laws)
        self.report_columns = len(RECORD_NAMES) * len(tables.contacts)

    def build(self, laws: TimeLawTable) -> None:
        self.tables.build(laws, self.offset)
        self.connectivity = self.tables.connectivity
        single = self.model.dtype == "float32"
        self.double_displacements = DoubleDisplacements(self.model, self.connectivity) if single else None
        self.rows = self.increment_rows = self.tables.rows

    def hash(self, h: Any) -> None:
        self.tables.hash(h)

    # simulation setup

    def scratch_shapes(self, worlds: int) -> dict[str, tuple[int, ...]]:
        """Shapes of the arrays of an attempt that are not (worlds, points)."""
        t, B = self.tables, worlds
        shapes: dict[str, tuple[int, ...]] = {
            "aitken_sums": (B, AITKEN_LANES), "record_totals": (B, len(t.contacts), len(RECORD_NAMES)),
            "record_rows": (len(RECORD_NAMES), B, t.rows), "facet_activity": (B, t.rows), "shape_values": (1, 1, 1),
        }  # fmt: skip
        of_worlds = "passed_point", "elapsed_time", "relaxation", "limit_updates", "most_part_change", "aitken_norm2"
        shapes |= dict.fromkeys(of_worlds, (B,))
        shapes |= dict.fromkeys(OF_FACETS, (B, t.rows)) | dict.fromkeys(OF_CONTACTS, (B, len(t.contacts)))
        if t.has_single_point:
            shapes["shape_values"] = (B, len(t.contacts), max(group.conn.shape[1] for group in t.groups))
        return shapes | ({} if t.explicit else dict.fromkeys(("explicit_force", "explicit_elastic_slip"), (1, 1)))

    def make_scratch(self, worlds: int, make: Callable[[str, tuple[int, ...], Any], wp.array]) -> Any:
        """Attempt struct with arrays from make(name, shape, dtype)."""
        struct, shapes = contact_scratch_struct(self.model.dtype), self.scratch_shapes(worlds)
        unused = () if self.tables.has_single_point else (*OF_FACETS, *OF_CONTACTS, "point_depth")
        out, unused = struct(), (*unused, *self.shared_arrays, "penalty_factor")
        for name, var in struct.vars.items():
            if name not in unused:
                setattr(out, name, make(name, shapes.get(name, (worlds, self.tables.points)), var.type.dtype))
        return out

    def make_history(self, make: Callable[[str, Any, tuple[int, ...]], wp.array]) -> Any:
        """History struct with arrays from make(name, dtype, shape per world)."""
        out = history_struct()()
        for name, var in history_struct().vars.items():
            if name != "previous_depth" or self.tables.tracks_deepest or self.tables.rolls:
                shape = () if name in ("overlap_time", "pose_time") else (self.tables.points,)
                setattr(out, name, make(f"{self.name}_{name}", var.type.dtype, shape))
        return out

    def make_other(self, make: Callable[[str, Any, tuple[int, ...]], wp.array]) -> Any:
        """Struct of the other side, with its history arrays as of `make_history`."""
        raise NotImplementedError

    def _allocate_other(self, work: Workspace, other: Any) -> None:
        """Add the arrays of an attempt to the struct of the other side."""
        raise NotImplementedError

    def allocate(self, work: Workspace, ctx: StepContext) -> None:
        t, B, contacts = self.tables, self.model.worlds, len(self.tables.contacts)
        attempt = self.make_scratch(B, lambda name, shape, dtype: work.array(f"{self.name} {name}", shape, dtype))
        attempt.relaxation.fill_(1.0)
        attempt.penalty_factor = work.newton.frozen.penalty_factor
        clock, step = clock_struct()(), work.step
        clock.new_time, clock.h, clock.substep_index = step.new_time, step.h, step.substep_index
        clock.time, clock.is_static = ctx.state.time, int(not ctx.inertia)
        # only contact slots are used
        u = work.array(f"{self.name} displacements", work.u.shape, wp.vec3d) if self.double_displacements else work.u
        scratch = {
            "attempt": attempt, "clock": clock, "rows": work.rows_of(self), "u": u,
            "contact_active": work.newton.frozen.contact_active,  # unused by Jacobi's iteration
            "energies": work.array(f"{self.name} energies", (ENERGY_COLUMNS, B, t.rows), wp.float64),
            "parts": work.array(f"{self.name} parts", (B, contacts, len(RECORD_NAMES), RECORD_LANES), wp.float64),
            "row_start": self.model.array("contact", t.row_start, wp.int32),
        }  # fmt: skip
        ctx.scratch[self.name] = scratch | ctx.scratch.get(self.name, {})
        self._allocate_other(work, ctx.scratch[self.name]["other"])

    def register(self, ctx: StepContext) -> None:
        make = ctx.state.register
        ctx.scratch[self.name] = {"history": self.make_history(make), "other": self.make_other(make)}

    def forget_overlaps(self, ctx: StepContext, new: np.ndarray) -> np.ndarray:
        """Clear the stored overlaps of the `new` worlds, which begin now; returns a host copy of all."""
        history = ctx.scratch[self.name]["history"]
        overlap, begins = history.overlap.numpy(), history.overlap_time.numpy()
        overlap[new] = 0.0
        begins[new] = ctx.state.time.numpy()[new]
        history.overlap.assign(overlap)
        history.overlap_time.assign(begins)
        return overlap

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        double_displacements = [self.double_displacements.kernels.module] if self.double_displacements else []
        return [self.point_kernels.module, *double_displacements]

    def shift_time(self, state: State) -> None:
        """Shift the start times of stored overlaps."""
        if f"{self.name}_overlap_time" in state.specs:
            begins = getattr(state, f"{self.name}_overlap_time")
            begins.assign(begins.numpy() - state.time.numpy())

    # in a step

    def prepare(self, ctx: StepContext, active: wp.array) -> None:
        """Compute the first friction limits and the stiffness of the blocks."""
        self._evaluate_forces(ctx, active, fresh=1)

    def force(self, ctx: StepContext, active: wp.array) -> None:
        self._evaluate_forces(ctx, active, fresh=0)

    @part()
    def _evaluate_forces(self, ctx: StepContext, active: wp.array, *, fresh: int) -> None:
        """Forces of the points on the slots of both sides, and rows of the potential."""
        s, t, w, k = ctx.scratch[self.name], self.tables, ctx.work, self.point_kernels
        if self.double_displacements and ctx.positions_changed:
            self.double_displacements.update(ctx, s["u"], active)
        self._find_other(ctx, active, fresh=fresh)
        for group in t.groups:
            args = [t.data, s["other"], group.data, s["history"], s["clock"], s["u"], active, fresh, s["attempt"]]
            ctx.launch(k.forces, group.point_threads(self.model.worlds), args)
        self._list_points(ctx)
        lanes = ctx.launch.lanes(POINT_SUM_LANES)
        for group in t.groups:
            args = [group.data, active, lanes, s["attempt"], w.pool_force, s["rows"], s["contact_active"]]
            ctx.launch(k.gather_point_forces, (self.model.worlds, ctx.launch.padded(lanes * group.conn.size)), args)
        self._gather_other_forces(ctx, active)

    def _find_other(self, ctx: StepContext, active: wp.array, *, fresh: int) -> None:
        """Find the other side of each point at the iterate; `fresh`: an attempt begins."""

    def _list_points(self, ctx: StepContext) -> None:
        """List the points for each slot of the other side, if it has slots."""

    def _gather_other_forces(self, ctx: StepContext, active: wp.array) -> None:
        """Forces on the slots of the other side, if it has slots."""

    @part()
    def product(self, ctx: StepContext, p: wp.array, active: wp.array) -> None:
        s, k, B = ctx.scratch[self.name], self.point_kernels, self.model.worlds
        other, attempt, lanes = s["other"], s["attempt"], ctx.launch.lanes(POINT_SUM_LANES)
        for group in self.tables.groups:
            ctx.launch(k.point_products, group.point_threads(B), [other, group.data, active, p, attempt])
        for group in self.tables.groups:  # the last group includes the other side
            entries = group.conn.size + (self.tables.other_entries if group is self.tables.groups[-1] else 0)
            args = [other, group.data, active, lanes, entries - 1, attempt, ctx.work.pool_product]
            ctx.launch(k.gather_products, (B, ctx.launch.padded(lanes * entries)), args)

    @part()
    def predict_frozen(self, ctx: StepContext, active: wp.array) -> None:
        s, t, w = ctx.scratch[self.name], self.tables, ctx.work
        for group in t.groups:
            args = [t.data, s["other"], group.data, active, w.step.dq_dv, w.direction, s["attempt"]]
            ctx.launch(self.point_kernels.predict_friction, group.point_threads(self.model.worlds), args)

    @part()
    def update_frozen(self, ctx: StepContext, flags: wp.array) -> None:
        k, m, newton, attempt = self.point_kernels, self.model, ctx.work.newton, ctx.scratch[self.name]["attempt"]
        ctx.launch(k.aitken_partial_sums, (m.worlds, AITKEN_LANES), [flags, attempt])
        ctx.launch(k.aitken_relaxation, m.worlds, [flags, newton.norms.tol, attempt, newton.frozen.partly_updated])
        ctx.launch(k.update_frozen, (m.worlds, self.tables.points), [flags, attempt])

    @part()
    def diagonal(self, ctx: StepContext, active: wp.array) -> None:
        for group in self.tables.groups:
            args = [group.data, active, ctx.scratch[self.name]["attempt"], ctx.work.pool_block]
            dim = (self.model.worlds, group.count, group.conn.shape[1])
            ctx.launch(self.point_kernels.diagonal, dim, args)

    def _find_accepted(self, ctx: StepContext, active: wp.array) -> None:
        """Find the other side of each point at the accepted iterate, where that is another one."""

    @part()
    def _record_substep(self, ctx: StepContext, accepted: wp.array) -> None:
        """Update history, ledger rows and records of an accepted substep."""
        self._find_accepted(ctx, accepted)
        s, k, t = ctx.scratch[self.name], self.ledger_kernels, self.tables
        for group in t.groups:
            args = [t.data, s["other"], group.data, s["history"], s["clock"], s["u"], accepted, s["attempt"]]
            ctx.launch(k.record_substep, (self.model.worlds, group.count), [*args, s["energies"]])
        sums = (self.model.worlds, len(self.tables.contacts), len(RECORD_NAMES))
        args = [s["row_start"], accepted, s["attempt"], s["parts"]]
        ctx.launch(k.partial_records, (*sums, RECORD_LANES), args)
        ctx.launch(k.total_records, sums, [s["clock"], accepted, s["parts"], s["attempt"]])

    @part()
    def begin(self, ctx: StepContext, active: wp.array) -> None:
        ctx.scratch[self.name]["finished"] = False
        self._begin_points(ctx, active)

    def _begin_points(self, ctx: StepContext, active: wp.array) -> None:
        """Update the other side and the points at the start of the attempt."""
        s, k, t, state = ctx.scratch[self.name], self.point_kernels, self.tables, ctx.state
        self._begin_other(ctx, active)
        for group in t.groups:
            dim = group.point_threads(self.model.worlds)
            args = [t.data, s["other"], group.data, s["history"], s["clock"]]
            more = [state.velocity, active, s["attempt"]]
            ctx.launch(k.begin_points, dim, [*args, state.displacement, *more])
            if t.explicit:
                ctx.launch(k.explicit_forces, dim, [*args, *more])

    def _begin_other(self, ctx: StepContext, active: wp.array) -> None:
        """Update the other side at the start of the attempt."""
        raise NotImplementedError

    def energy_increments(self, ctx: StepContext, accepted: wp.array) -> wp.array:
        self._record_substep(ctx, accepted)
        ctx.scratch[self.name]["finished"] = True
        return ctx.scratch[self.name]["energies"]

    @property
    def plastic(self) -> bool:  # type: ignore[override]
        """Rigid parts may be stopped by restitution 0."""
        return any(speed_damping(contact, 0.0) < -1.0 for contact in self.tables.contacts)

    @part("commit")
    def find_impacts(self, ctx: StepContext) -> None:
        s, t, w, B = ctx.scratch[self.name], self.tables, ctx.work, self.model.worlds
        for group in t.groups:
            args = [t.data, s["other"], group.data, s["history"], s["clock"], s["u"], w.step.running, w.newton.failed]
            args += [s["attempt"], int(ctx.midpoint), w.step.impact]
            ctx.launch(self.ledger_kernels.find_impacts, (B, group.count), args)

    @part()
    def commit(self, ctx: StepContext, accepted: wp.array) -> None:
        if not ctx.scratch[self.name]["finished"]:  # no ledger, `energy_increments` not called
            self._record_substep(ctx, accepted)
        s, newton = ctx.scratch[self.name], ctx.work.newton
        args = [s["other"], s["clock"], newton.strain_energy, newton.term_sums, accepted, s["history"], s["attempt"]]
        ctx.launch(self.ledger_kernels.store_state, (self.model.worlds, self.tables.stored_sides), args)

    def report(self, ctx: StepContext) -> None:
        args = [ctx.scratch[self.name]["attempt"], self.report_offset, ctx.work.report]
        ctx.launch(self.ledger_kernels.write_records, (self.model.worlds, len(self.tables.contacts)), args)

    def contact_column(self, contact: Any) -> int:
        return self.report_offset + len(RECORD_NAMES) * self.tables.number[contact.index]

    @cached_property
    def element_sizes(self) -> np.ndarray:
        """Smallest edge of a face and depth of an element behind it, (contacts in device order, 2), m."""
        of_contact = [[(side.body.index, side.faces.tobytes()) for side in c.surfaces] for c in self.tables.contacts]
        sides = {key: side for keys, c in zip(of_contact, self.tables.contacts) for key, side in zip(keys, c.surfaces)}
        least = {key: np.min(element_edge_and_depth(side), axis=1) for key, side in sides.items()}
        return np.array([np.min([least[key] for key in keys], axis=0) for keys in of_contact])

    def element_size(self, contact: Any) -> float:
        return float(self.element_sizes[self.tables.number[contact.index]].min())

    def penetration_columns(self) -> tuple[slice, np.ndarray]:
        first = self.report_offset + PENETRATION_ROW
        return slice(first, first + self.report_columns, len(RECORD_NAMES)), self.element_sizes.min(axis=1)

    def stored_energy(self, ctx: StepContext) -> dict[str, np.ndarray]:
        """Stored energy according to the history, by points."""
        return {self.columns[0].name: ctx.scratch[self.name]["history"].stored.numpy() @ self.weights}

    @property
    def weights(self) -> np.ndarray:
        """Fraction (points,) of the contact area represented by each point."""
        return np.concatenate([fraction.ravel() for fraction in self.tables.area_fractions])

    # in a linear solve

    def allocate_blocks(self, ctx: StepContext, matrix: Any, *, projected: bool) -> None:
        if f"{self.name} blocks" not in self.model.cache:
            entries = [facet_pattern_entries(self.model, conn, matrix.pattern) for conn in self.connectivity]
            self.model.cache[f"{self.name} blocks"] = entries

    def _add_facet_blocks(
        self, ctx: StepContext, matrix: Any, stiffness: wp.array, weight: wp.array, *target: wp.array
    ) -> None:
        """Positive semi-definite stiffness of the points on their own facets."""
        m = self.model
        for group, (entry, start, source, count) in zip(self.tables.groups, m.cache[f"{self.name} blocks"]):
            args = [m.topology, matrix.pattern.data, group.data, entry, start, source, stiffness, weight]
            ctx.launch(block_kernels(m.dtype, False).add_blocks, (m.worlds, count), [*args, *target])

    def block_modules(self) -> set[wp.Module]:
        return {block_kernels(self.model.dtype, False).module}

    # failures

    def failure_reason(self, ctx: StepContext, world: int) -> tuple[type[PenetrationError], str] | None:
        found = int(ctx.scratch[self.name]["attempt"].passed_point.numpy()[world])
        if found == 0 or int(ctx.work.newton.failed.numpy()[world]) in (Failure.ROUNDOFF, Failure.WORK):
            return None
        t, point = self.tables, abs(found) - 1
        k = int(np.searchsorted(t.first, point, side="right")) - 1
        contact = t.contacts[k]
        if found < 0:
            return PenetrationError, f"contact {contact.name!r}: {self._turn_text(contact)}"
        (of, touched), thicker = contact.texts, "body" if contact.sign < 0.0 or not contact.grounded else "shape"
        return PenetrationError, (
            f"contact {contact.name!r}: a point of {of} (reference place "
            f"{reference_position_text(t, k, point - int(t.first[k]))}) went through {touched}; take a larger "
            f"stiffness= of the contact or a thicker {thicker}, or a smaller dt where it moves that far in a step"
        )

    def _turn_text(self, contact: Any) -> str:
        """Reason of a refused rotation of the other side."""
        raise NotImplementedError

    def failure_note(self, ctx: StepContext, world: int) -> str:
        touched = ctx.scratch[self.name]["attempt"].facet_activity.numpy()[world] > 0
        t, most = self.tables, MAX_NAMED_CONTACTS
        names = [f"{c.name!r}{f' with collider {c.sides[1].name!r}' * c.grounded}" for k, c in enumerate(t.contacts)
                 if touched[t.row_start[k] : t.row_start[k + 1]].any()]  # fmt: skip
        more = f" and {len(names) - most} more" if len(names) > most else ""
        return f"; in touch: contact {', '.join(names[:most])}{more}" if names else ""

    # parameters and info

    def parameter_arrays(self) -> dict[str, wp.array]:
        return self.tables.parameter_arrays

    def update_materials(self, mask: np.ndarray) -> None:
        self.tables.update_materials(mask)

    def parameters(self) -> dict[str, Callable[[Any, np.ndarray], None]]:
        return self.tables.parameters()

    def contacts_info(self) -> list[dict[str, Any]]:
        t, out = self.tables, []
        for contact in sorted(t.contacts, key=lambda c: c.index):
            k = t.number[contact.index]
            names = zip(("body", "collider" if contact.grounded else "with"), (side.name for side in contact.sides))
            points = {"points": int((t.area_fractions[k] > 0.0).sum())} | self._contact_info(contact, k)
            out.append({"name": contact.name} | dict(names) | {"law": contact.law, "model": contact.model} | points)
        return out

    def _contact_info(self, contact: Any, k: int) -> dict[str, Any]:
        """Further numbers."""
        raise NotImplementedError
