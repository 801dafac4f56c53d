"""The terms of a model, and what is made of all of them: pools, ledger, fields, features, report."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.launch import PARTS
from ..base.names import did_you_mean, listing
from ..base.worlds import chosen_worlds
from ..kernels.common.traits import Traits
from ..kernels.step.control import REPORT
from ..kernels.step.ledger import LEDGER, booked_struct
from ..model import assembly
from ..model.state import MEMORY
from .body_forces import BodyForces
from .checks import check_columns, check_made, check_names, check_rows, check_stored, check_tables, derived_traits
from .constraints import Constraints
from .contact import Contact
from .damping import Damping
from .dead_loads import DeadLoads
from .elements import Elements
from .followers import Followers
from .pairs import Pairs
from .supports import Supports
from .term import At, FieldSpec, Term
from .time_laws import TimeLaws, control_array

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State
    from .workspace import Workspace

__all__ = ["KINDS", "TermSet", "all_parts"]

KINDS: tuple[type[Term], ...] = (Elements, DeadLoads, Damping, Followers, BodyForces, Contact, Pairs, Constraints)
"""The kinds of terms there are, in the order of their launches: what the forces of an attempt are made of first."""
STATE = ("displacement", "velocity", "time", "status", "ledger", "ledger_time", "previous_displacement",
         "previous_velocity", "previous_step", "previous_end", "summed_time",
         "energy_growth")  # fmt: skip
"""Arrays of the state that are no term's."""
FIELDS = ("von_mises", "displacement")
"""Fields of every model, see simulation.results."""


def all_parts() -> dict[str, str]:
    """Parts of a profile, of every step and of all kinds of terms, with a line about each."""
    return PARTS | {name: text for kind in KINDS for name, text in kind.parts.items()}


class TermSet:
    """The terms there are, in order; iterate over it.

    Attributes:
        laws: the table of time laws.
        supports: prescribed motion.
        dead: dead loads and gravity.
        traits: what the terms ask of the kernels of a step.
        side_entries: entries of the pool of forces without a potential; pool_entries: of that of potential ones.
        side_topology: who contributes to a slot there, None without.
        rows: rows of potentials.
        written: how often parameters were set.
        ledger: columns of the energy ledger. report: columns of the report of a step.
    """

    def __init__(self, model: Model, more: list[Callable[[Model], Term | None]] | None = None) -> None:
        self.model = model
        self.laws, self.supports = TimeLaws(model), Supports(model)
        makers = [kind.of for kind in KINDS] + list(more or ())
        self.all: list[Term] = []
        for make in makers:
            term = make(model)
            if term is not None:
                check_made(term, make, model)
                self.all.append(term)
        self.dead = self.find(DeadLoads)
        self.side_topology: Any = None
        self.written = 0
        self.writes: np.ndarray = np.zeros(1, dtype=np.int64)  # (worlds,) once a parameter was set
        self._check()

    def _check(self) -> None:
        """ModelError where terms that were added claim a name that is taken, or what is not theirs."""
        first = [f"name {term.name!r}" for term in self.all]
        for name in first:
            if first.count(name) > 1:
                raise ModelError(f"two terms have the {name}; give each its own")
        added = self.added
        for term in self.all:
            check_columns(term, own=term not in added)
        for term in added:
            for trait in ("ties", "gated"):
                if getattr(term.traits, trait):
                    raise ModelError(f"term {term.name!r} declares the trait {trait!r}, which belongs to constraints")
        check_stored(self.all)
        check_names(self.all, FIELDS, "a field", lambda term: term.fields)
        check_names(self.all, tuple(PARTS), "a part of profiles", lambda term: term.parts)

    @property
    def added(self) -> list[Term]:
        """Terms that do not come with warpfea."""
        return [term for term in self.all if type(term) not in KINDS]

    def __iter__(self) -> Iterator[Term]:
        return iter(self.all)

    def find(self, kind: type[Any]) -> Any:
        """The term of a kind, or None."""
        return next((term for term in self.all if isinstance(term, kind)), None)

    @property
    def constraints(self) -> Constraints | None:
        """The constraints' term, or None."""
        return self.find(Constraints)

    @property
    def products(self) -> bool:
        """Whether terms beside the elements add to H."""
        return self.traits.tangent or self.traits.pooled or self.traits.ties

    # for the model

    def ties(self) -> list[np.ndarray]:
        """Sets of slots that terms tie."""
        return [slots for term in self.all for slots in term.ties()]

    def build(self) -> None:
        """Make the terms' tables, once the model knows its components, and their places in the pools."""
        for term in self.all:
            term.offset = self._entries(self.all, term.potential)
            term.build(self.laws)
            check_tables(term, self.model)
            if term is self.dead:  # in this order time laws are numbered
                self.supports.build(self.laws)
        self.laws.upload()
        self.traits = Traits(*map(any, zip(*(derived_traits(term) for term in self.all))))
        self.side_entries, self.pool_entries = self._entries(self.all, False), self._entries(self.all, True)
        self.rows = 0
        column = len(REPORT) + 6 * len(self.model.description.probes)
        for term in self.all:
            term.row_offset, term.report_offset = self.rows, column
            self.rows += term.rows
            column += term.report_columns
        self.report_width = column
        if self.side_entries:
            self.side_topology = self._topology([c for t in self.all if not t.potential for c in t.connectivity])
        named = [column.name for term in self.all for column in term.columns if column.name]
        self.ledger = (*LEDGER, *dict.fromkeys(name for name in named if name not in LEDGER))

    @staticmethod
    def _entries(terms: list[Term], potential: bool) -> int:
        """Entries of a pool that are taken so far."""
        return sum(conn.size for term in terms if term.potential == potential for conn in term.connectivity)

    def _topology(self, conns: list[np.ndarray]) -> Any:
        from ..kernels.common.structs import topology_struct

        m = self.model
        start, order = assembly.gather_table(conns, m.slots)
        out = topology_struct(m.dtype)()
        out.start, out.entry = m.array("loads", start, wp.int32), m.array("loads", order, wp.int32)
        return out

    def join(self, topology: Any) -> None:
        """Put the table of the pool of potential terms into the model's topology."""
        if self.pool_entries:
            conns = [conn for term in self.all if term.potential for conn in term.connectivity]
            pool = self._topology(conns)
            topology.pool_start, topology.pool_entry = pool.start, pool.entry

    def hold(self, free: np.ndarray) -> None:
        """Clear the directions (components, 3) in which terms tie components to the ground."""
        for term in self.all:
            term.hold(free)

    @property
    def features(self) -> dict[str, bool]:
        """Which optional features of all kinds of terms the model uses."""
        kinds = [*KINDS, *(type(term) for term in self.all if type(term) not in KINDS)]
        out: dict[str, bool] = {}
        for kind in kinds:
            out |= kind.features(self.model)
        out |= {term.name: True for term in self.all if type(term) not in KINDS}
        return out | {"controls": bool(self.laws.controls)}

    def rewind(self, state: State) -> None:
        """Put the time of a state to 0, and what terms have stored of times with it."""
        for term in self.all:
            term.rewind(state)
        state.time.zero_()

    def hash(self, h: Any) -> None:
        """Feed what defines the terms into a hash."""
        self.laws.hash(h)
        self.supports.hash(h)
        for term in self.all:
            if term in self.added:
                columns = [(column.name, column.kind) for column in term.columns]
                h.update(f"term {term.name} {type(term).__qualname__} {columns} {term.rows}".encode())
                for conn in term.connectivity:
                    h.update(np.ascontiguousarray(conn).tobytes())
            term.hash(h)

    @property
    def parts(self) -> dict[str, str]:
        """Parts of a profile that the terms add, with a line about each."""
        return {name: text for term in self.all for name, text in term.parts.items()}

    @property
    def fields(self) -> dict[str, FieldSpec]:
        """Fields that users may ask for beside those of the elements."""
        return {name: spec for term in self.all for name, spec in term.fields.items()}

    def samples(self, name: str, body: Any, state: State) -> np.ndarray:
        """(worlds, nodes x samples) values of a field, at every sample those of its node where a term has no others.

        Raises:
            ModelError: a term gives another shape.
        """
        spec, count = self.fields[name], body.family.node_samples.shape[1]
        found = []
        for term in (term for term in self.all if name in term.fields):
            values = np.asarray(term.samples(name, body, state))
            expected = (self.model.worlds, len(body.mesh.points) * (count if spec.at_node else 1))
            if values.shape != expected:
                raise ModelError(f"term {term.name!r}: samples({name!r}) gave {values.shape}; expected {expected}")
            found.append(values if spec.at_node else np.repeat(values, count, axis=1))
        return functools.reduce(spec.join, found) if spec.join else found[0]

    def at_nodes(self, name: str, body: Any, state: State) -> np.ndarray:
        """(worlds, nodes) values of a field."""
        values = self.samples(name, body, state)
        values = values.reshape(len(values), len(body.mesh.points), -1)
        reduce = self.fields[name].at_node
        return np.asarray(reduce.reduce(values, axis=2) if reduce else values[:, :, 0])

    # what users set and ask for

    @property
    def contact(self) -> Contact | None:
        """The term of contact with obstacles, or None."""
        return self.find(Contact)

    @property
    def pairs(self) -> Pairs | None:
        """The term of contact between bodies, or None."""
        return self.find(Pairs)

    def set_parameter(self, name: Any, values: Any, mask: Any) -> None:
        """See Model.set_parameter."""
        materials = self.model.parameters
        owners = [term.parameters() for term in self.all] + [materials.setters(), {"gravity": self.dead.set_gravity}]
        found = [known[name] for known in owners if name in known]
        if len(found) == 1:
            chosen = chosen_worlds("set_parameter", mask, self.model.worlds)
            found[0](values, chosen)
            self.written += 1
            self.writes = self.writes + chosen
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
        """What is set by `set_parameter` of terms, by "term name"."""
        return {f"{term.name}.{name}": a for term in self.all for name, a in term.parameter_arrays().items()}

    # for one simulation

    def allocate(self, work: Workspace, at: At) -> None:
        """Let the terms register history and make scratch."""
        owner: dict[str, str] = {}
        controls = [control_array(name) for name in self.laws.controls]
        for term in self.all:
            before = len(at.state.asked)
            term.register(at)
            for name in at.state.asked[before:]:
                if name in owner or name in STATE or name in controls or name.startswith(MEMORY):
                    taken = f"term {owner[name]!r}" if name in owner else "the state itself"
                    raise ModelError(f"term {term.name!r}: the state's array {name!r} is that of {taken}; rename it")
                owner[name] = term.name
            term.allocate(work, at)

    @property
    def booking(self) -> list[Term]:
        """Terms that book rows of the ledger."""
        return [term for term in self.all if term.columns]

    def booked(self, work: Any) -> Any:
        """Device table of what terms book; the sums are those of `book`."""
        columns = [column for term in self.booking for column in term.columns]
        out = booked_struct()()
        device = self.model.device
        out.kind = wp.array([c.kind for c in columns], dtype=wp.int32, device=device)
        held = [int(not term.potential) for term in self.booking for _ in term.columns]
        out.nonpotential = wp.array(held, dtype=wp.int32, device=device)
        numbers = [self.ledger.index(c.name) if c.name else -1 for c in columns]
        out.column = wp.array(numbers, dtype=wp.int32, device=device)
        out.sums = work.booked
        return out

    def book(self, at: At, reduce: Any, accepted: wp.array) -> None:
        """Let the terms book an accepted substep."""
        first = 0
        for term in self.booking:
            rows, count = term.book(at, accepted), len(term.columns)
            if rows is not None:
                check_rows(term, rows, self.model.worlds, at.work.longest)
                reduce(rows, count, accepted, at.work.booked[first : first + count])
            first += count

    def modules(self, at: At) -> set[wp.Module]:
        """Modules that terms launch in a step."""
        out = self.laws.modules() | self.supports.modules()
        for term in self.all:
            out |= set(term.modules(at))
        return out

    def energies(self, ledger: np.ndarray) -> dict[str, np.ndarray]:
        """Columns of the ledger (worlds, columns) by name; of kinds of terms that are not there zeros."""
        out = {name: ledger[:, k].copy() for k, name in enumerate(self.ledger)}
        known = [column.name for kind in KINDS for column in kind.columns if column.name]
        for name in known:
            out.setdefault(name, np.zeros(len(ledger)))
        out["work"] = np.sum([values for name, values in out.items() if name.startswith("work_")], axis=0)
        return out
