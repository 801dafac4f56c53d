"""Set of terms: pools, ledger, fields, features, report."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.launch import LAUNCH_PARTS
from ..base.names import did_you_mean, listing
from ..base.worlds import worlds_mask
from ..kernels.common.traits import Traits
from ..kernels.step.energy_ledger import LEDGER_COLUMNS, term_energies_struct
from ..kernels.step.step_control import REPORT_COLUMNS
from ..model import assembly
from ..model.state import SOLVER_HISTORY_PREFIXES
from .checks import (
    check_constructed,
    check_energy_increments,
    check_ledger_columns,
    check_stored_columns,
    check_tables,
    check_unique_names,
    derived_traits,
    overrides,
)
from .constraints import Constraints
from .elements import Damping, Elements
from .evaluation import Evaluation
from .follower_loads import FollowerLoads
from .loads import BodyForces, DeadLoads
from .protocols import Constrained, Parametrised, Tied, Touching
from .springs import Springs
from .supports import Supports
from .term import FieldSpec, StepContext, Term
from .time_law_table import TimeLawTable, control_array
from .velocity_rows import VelocityRows

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State
    from .workspace import Workspace

__all__ = ["TERM_TYPES", "TermSet", "profile_parts", "register"]

T = TypeVar("T", bound=Term)
TERM_TYPES: list[type[Term]] = [Elements, DeadLoads, Damping, FollowerLoads, BodyForces, Springs, VelocityRows,
              Constraints]  # fmt: skip
"""All kinds of terms in launch order, that in which the forces of an attempt are evaluated."""
STATE_ARRAYS = ("displacement", "velocity", "time", "status", "ledger", "ledger_time", "previous_displacement",
         "previous_velocity", "previous_step", "previous_end", "summed_time",
         "energy_growth")  # fmt: skip
"""State arrays owned by no term."""


def register(*kinds: type[Term]) -> None:
    """Add kinds of terms of a floor above, evaluated before the constraints."""
    TERM_TYPES[-1:-1] = kinds


def profile_parts() -> dict[str, str]:
    """Profile parts of every step and of all kinds of terms, each with a description."""
    return LAUNCH_PARTS | {name: text for kind in TERM_TYPES for name, text in kind.parts.items()}


class TermSet:
    """Terms of a model in order; iterable.

    Attributes:
        time_laws: table of time laws.
        supports: prescribed motion.
        evaluation: quantities of the model at a state.
        dead_loads: dead loads and gravity.
        traits: traits of the terms for the kernels of a step.
        nonpotential_entries: pool entries of non-potential forces; pool_entries: of potential ones.
        nonpotential_topology: gather table of the non-potential pool, or None.
        rows: rows of potentials.
        ledger_terms: terms with ledger rows.
        parameter_updates: number of calls of set_parameter, for all worlds; world_updates: per world.
        ledger: columns of the energy ledger. report: columns of the step report.
    """

    def __init__(self, model: Model, more: Sequence[Callable[[Model], Term | None]] = ()) -> None:
        self.model = model
        self.time_laws, self.supports = TimeLawTable(model), Supports(model)
        makers = [*(kind.of for kind in TERM_TYPES), *more]
        self.all: list[Term] = []
        for make in makers:
            term = make(model)
            if term is not None:
                check_constructed(term, make, model)
                self.all.append(term)
        self._having: dict[Any, list[Any]] = {}  # by protocol, or method
        self.dead_loads = self.find(DeadLoads)
        self.nonpotential_topology: Any = None
        self.parameter_updates = 0
        self.world_updates: np.ndarray = np.zeros(1, dtype=np.int64)  # (worlds,) once a parameter was set
        self.evaluation = Evaluation(model)
        self._check_terms()

    def _check_terms(self) -> None:
        """Raise ModelError for added terms with duplicate names or with multipliers."""
        first = [f"name {term.name!r}" for term in self.all]
        for name in first:
            if first.count(name) > 1:
                raise ModelError(f"two terms have the {name}; give each its own")
        added = self.added_terms
        for term in self.all:
            check_ledger_columns(term, own=term not in added)
        for term in added:
            if isinstance(term, Constrained):
                raise ModelError(f"term {term.name!r} derives from Constrained: register a kind of constraints instead")
        check_stored_columns(self.all)
        check_unique_names(self.all, (), "a field", lambda term: term.fields)
        check_unique_names(self.all, tuple(LAUNCH_PARTS), "a part of profiles", lambda term: term.parts)

    @property
    def added_terms(self) -> list[Term]:
        """Terms added by the user."""
        return [term for term in self.all if type(term) not in TERM_TYPES]

    def __iter__(self) -> Iterator[Term]:
        return iter(self.all)

    def named(self, name: str) -> Any:
        """Term of one name, or None."""
        return next((term for term in self.all if term.name == name), None)

    def having(self, protocol: type[T]) -> list[T]:
        """Terms that derive from a protocol, or are of a kind, in order."""
        if protocol not in self._having:
            self._having[protocol] = [term for term in self.all if isinstance(term, protocol)]
        return self._having[protocol]

    def call(self, ctx: StepContext, protocol: type[Term], method: str, *flags: wp.array) -> None:
        """Call a method of a protocol of all terms that override it, in order; which do is found at the first call."""
        base = getattr(protocol, method)
        if base not in self._having:
            self._having[base] = [term for term in self.having(protocol) if overrides(term, base)]
        for term in self._having[base]:
            getattr(term, method)(ctx, *flags)

    def find(self, kind: type[Any]) -> Any:
        """Term of one kind, or None."""
        return next(iter(self.having(kind)), None)

    @property
    def constraints(self) -> Constraints | None:
        """Constraint term, or None."""
        return self.find(Constraints)

    @property
    def has_tangents(self) -> bool:
        """True if terms besides the elements contribute to H."""
        return self.traits.tangent or self.traits.pooled or self.traits.constraint_rows

    # for the model

    def tied_slots(self) -> list[np.ndarray]:
        """Sets of slots tied by terms."""
        return [slots for term in self.having(Tied) for slots in term.tied_slots()]

    def build(self) -> None:
        """Build the terms' tables, once components are known, and their pool offsets."""
        for term in self.all:
            term.offset = self._pool_size(self.all, term.potential)
            term.build(self.time_laws)
            check_tables(term, self.model)
            if term is self.dead_loads:  # time laws are numbered in this order
                self.supports.build(self.time_laws)
        self.time_laws.upload()
        self.traits = Traits(*map(any, zip(*(derived_traits(term) for term in self.all))))
        self.nonpotential_entries, self.pool_entries = self._pool_size(self.all, False), self._pool_size(self.all, True)
        self.rows = 0
        column = len(REPORT_COLUMNS) + 6 * len(self.model.description.probes)
        for term in self.all:
            term.row_offset, term.report_offset = self.rows, column
            self.rows += term.rows
            column += term.report_columns
        self.report_width = column
        if self.nonpotential_entries:
            self.nonpotential_topology = self._gather_topology(
                [c for t in self.all if not t.potential for c in t.connectivity]
            )
        self.ledger_terms = [term for term in self.all if term.columns]
        named = [column.name for term in self.ledger_terms for column in term.columns if column.name]
        self.ledger = (*LEDGER_COLUMNS, *dict.fromkeys(name for name in named if name not in LEDGER_COLUMNS))

    @staticmethod
    def _pool_size(terms: list[Term], potential: bool) -> int:
        """Number of pool entries used so far."""
        return sum(conn.size for term in terms if term.potential == potential for conn in term.connectivity)

    def _gather_topology(self, conns: list[np.ndarray]) -> Any:
        from ..kernels.common.structs import topology_struct

        m = self.model
        start, order = assembly.gather_table(conns, m.slots)
        out = topology_struct(m.dtype)()
        m.memory.fill(out, "loads", contribution_start=start, contribution_entry=order)
        return out

    def add_pool_topology(self, topology: Any) -> None:
        """Add the gather table of the potential pool to the model's topology."""
        if self.pool_entries:
            conns = [conn for term in self.all if term.potential for conn in term.connectivity]
            pool = self._gather_topology(conns)
            topology.pool_start, topology.pool_entry = pool.contribution_start, pool.contribution_entry

    def item_forces(self, work: Workspace) -> list[tuple[np.ndarray, np.ndarray]]:
        """Model slots (items, k) of facets, elements and points on several slots, and forces on them (worlds, items, k,
        3), N, as terms evaluated them last."""
        out = []
        for term in self.all:
            first, pool = term.offset, work.pool_force if term.potential else work.nonpotential_contribution
            values = (-1.0 if term.potential else 1.0) * pool.numpy().astype(float) if term.connectivity else None
            for conn in term.connectivity:
                if values is not None and conn.shape[1] > 1:
                    own = values[:, first : first + conn.size].reshape(len(values), *conn.T.shape, 3)
                    out.append((conn, np.swapaxes(own, 1, 2)))
                first += conn.size
        return out

    def mark_constrained(self, free: np.ndarray) -> None:
        """Clear the directions (components, 3) in which terms tie components to the ground.

        Translations of a free component involve elements and mass only. A solve can't be corrected along translations
        that a term resists: all those of components in its tangent, unless it is `translation_invariant`.
        """
        for term in self.all:
            if not term.translation_invariant and (term.potential or overrides(term, Term.product)):
                for conn in term.connectivity:
                    free[np.unique(self.model.components.of_slot[conn])] = 0.0
        for term in self.having(Tied):
            term.mark_constrained(free)

    def restraints(self, state: State, component: int) -> list[Any]:
        """Rows (n, 3 slots), CSR, of directions in which terms resist motion of a component.

        Raises:
            ModelError: a term gives another number of columns.
        """
        found = [(term, term.restraints(state, component)) for term in self.having(Tied)]
        for term, rows in found:
            if rows is not None and rows.shape[1:] != (3 * self.model.slots,):
                raise ModelError(
                    f"term {term.name!r}: restraints gave {rows.shape}; expected (rows, {3 * self.model.slots}), CSR"
                )
        return [rows for _, rows in found if rows is not None]

    @property
    def features(self) -> dict[str, bool]:
        """Optional features of all kinds of terms: used by the model or not."""
        kinds = [*TERM_TYPES, *(type(term) for term in self.added_terms)]
        out: dict[str, bool] = {}
        for kind in kinds:
            out |= {name: on or out.get(name, False) for name, on in kind.features(self.model).items()}
        out |= {term.name: True for term in self.added_terms}
        return out | {"controls": bool(self.time_laws.controls)}

    def shift_time(self, state: State) -> None:
        """Reset the time of a state to 0, and shift the times stored by terms."""
        for term in self.all:
            term.shift_time(state)
        state.time.zero_()

    def hash(self, h: Any) -> None:
        """Hash the definitions of the terms."""
        self.time_laws.hash(h)
        self.supports.hash(h)
        for term in self.all:
            if term in self.added_terms:
                columns = [(column.name, column.kind) for column in term.columns]
                h.update(f"term {term.name} {type(term).__qualname__} {columns} {term.rows}".encode())
                for conn in term.connectivity:
                    h.update(np.ascontiguousarray(conn).tobytes())
            term.hash(h)

    @property
    def parts(self) -> dict[str, str]:
        """Profile parts added by the terms, each with a description."""
        return {name: text for term in self.all for name, text in term.parts.items()}

    @property
    def fields(self) -> dict[str, FieldSpec]:
        """Fields of all terms, see terms.fields."""
        return {name: spec for term in self.all for name, spec in term.fields.items()}

    @property
    def scalar_fields(self) -> dict[str, FieldSpec]:
        """Those without components."""
        return {name: spec for name, spec in self.fields.items() if not spec.components}

    # parameters and fields

    @property
    def contacts(self) -> list[Touching]:
        """Terms of contact, one for each geometry of the other side in use."""
        return self.having(Touching)

    def set_parameter(self, name: Any, values: Any, mask: Any) -> None:
        """See Model.set_parameter."""
        materials = self.model.parameters
        owners = [term.parameters() for term in self.having(Parametrised)] + [
            materials.setters(),
            {"gravity": self.dead_loads.set_gravity},
        ]
        found = [known[name] for known in owners if name in known]
        if len(found) == 1:
            chosen = worlds_mask("set_parameter", mask, self.model.worlds)
            found[0](values, chosen)
            self.parameter_updates += 1
            self.world_updates = self.world_updates + chosen
            for contact in self.model.description.contacts:
                if contact.edges is not None and name.startswith(f"{contact.name}."):
                    self.set_parameter(contact.edges.name + name[len(contact.name) :], values, mask)
            return
        if found:
            raise ModelError(f"set_parameter: {name!r} is a parameter of {len(found)} things of that name; rename one")
        known = [key for those in owners for key in those]
        told = materials.explain(name)
        if told:
            raise ModelError(f"set_parameter: {name!r} can't be set: {told}")
        hint = did_you_mean(name, known)
        raise ModelError(f"set_parameter: parameter {name!r} is unknown; there are: {listing(known)}{hint}")

    def parameter_arrays(self) -> dict[str, wp.array]:
        """Arrays of the terms' parameters, by "term name"."""
        owners = self.having(Parametrised)
        return {f"{term.name}.{name}": a for term in owners for name, a in term.parameter_arrays().items()}

    def update_materials(self, mask: np.ndarray) -> None:
        """Update the terms after material constants were set in the chosen worlds (worlds,)."""
        for term in self.having(Parametrised):
            term.update_materials(mask)

    # simulation setup

    def allocate(self, work: Workspace, ctx: StepContext) -> None:
        """Allocate the terms' scratch and register their history."""
        owner: dict[str, str] = {}
        controls = [control_array(name) for name in self.time_laws.controls]
        for term in self.all:
            before = len(ctx.state.requested_names)
            term.register(ctx)
            for name in ctx.state.requested_names[before:]:
                if (
                    name in owner
                    or name in STATE_ARRAYS
                    or name in controls
                    or name.startswith(SOLVER_HISTORY_PREFIXES)
                ):
                    taken = f"term {owner[name]!r}" if name in owner else "the state itself"
                    raise ModelError(f"term {term.name!r}: the state's array {name!r} is that of {taken}; rename it")
                owner[name] = term.name
            term.allocate(work, ctx)

    def increment_table(self, work: Any) -> Any:
        """Device table of the ledger columns of the terms; `energy_increments` fills their sums."""
        columns = [column for term in self.ledger_terms for column in term.columns]
        out = term_energies_struct()()
        device = self.model.device
        out.kind = wp.array([c.kind for c in columns], dtype=wp.int32, device=device)
        held = [int(not term.potential) for term in self.ledger_terms for _ in term.columns]
        out.nonpotential = wp.array(held, dtype=wp.int32, device=device)
        numbers = [self.ledger.index(c.name) if c.name else -1 for c in columns]
        out.ledger_column = wp.array(numbers, dtype=wp.int32, device=device)
        out.sums = work.increment_sums
        return out

    def energy_increments(self, ctx: StepContext, reduce: Any, accepted: wp.array) -> None:
        """Evaluate and sum the terms' ledger rows for an accepted substep."""
        first = 0
        for term in self.ledger_terms:
            rows, count = term.energy_increments(ctx, accepted), len(term.columns)
            if rows is not None:
                check_energy_increments(term, rows, self.model.worlds, ctx.work.max_summed_items)
                reduce(rows, count, accepted, ctx.work.increment_sums[first : first + count])
            first += count

    def modules(self, ctx: StepContext) -> set[wp.Module]:
        """Modules launched by terms in a step."""
        out = self.time_laws.modules() | self.supports.modules()
        for term in self.all:
            out |= set(term.modules(ctx))
        return out

    def energies(self, ledger: np.ndarray) -> dict[str, np.ndarray]:
        """Columns of the ledger (worlds, columns) by name; zeros for unused kinds of terms."""
        out = {name: ledger[:, k].copy() for k, name in enumerate(self.ledger)}
        known = [column.name for kind in TERM_TYPES for column in kind.columns if column.name]
        for name in known:
            out.setdefault(name, np.zeros(len(ledger)))
        work = [values for name, values in out.items() if name.startswith("work_") or name == "actuators"]
        out["work"] = np.sum(work, axis=0)
        return out
