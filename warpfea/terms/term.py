"""The seam of all that adds to the residual of a step, Eq. (17): elements, damping, loads, constraints, contact.

A term is made once per model and holds constants; what varies is in the workspace and the state of a simulation, which
reach it as an `At`. A term overrides the methods that it has something to do in: a step loops over the terms there are.
Models: `Form` of PolyFEM, `BaseForceField` of SOFA, the items of felupe.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
import warp as wp

from ..kernels.common.traits import Traits
from ..kernels.step.ledger import HELD_VISCOUS, LOSS, NUMERICAL, STORED, WORK

if TYPE_CHECKING:
    from ..base.errors import ConvergenceError
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..model.state import State
    from .time_laws import TimeLaws
    from .workspace import Workspace

__all__ = [
    "HELD_VISCOUS",
    "LOSS",
    "NUMERICAL",
    "STORED",
    "WORK",
    "At",
    "Column",
    "FieldSpec",
    "Kept",
    "Term",
    "part",
]

F = TypeVar("F", bound=Callable[..., Any])


@dataclass(eq=False)
class At:
    """A simulation as terms see it.

    Attributes:
        model, work, launch, state: of the simulation.
        u_before: [world, slot] displacements of the step before the last, of multistep schemes; the algorithmic
            accelerations of schemes that keep them.
        inertia: the step is dynamic; in statics there are no rates.
        midpoint: forces are those of the middle of a step, at work.u_stage and work.stage_time.
        dissipation: chi of the dissipative form of that, see kernels/elements/conserving.py.
        accelerated: the scheme keeps accelerations.
        moved: forces are taken at another place than those before; where not, only what terms hold has changed.
        options: of the solver.
        scratch: what terms allocated, by their names.
    """

    model: Model
    work: Workspace
    launch: Launcher
    state: State
    u_before: wp.array
    inertia: bool
    midpoint: bool = False
    dissipation: float = 0.0
    accelerated: bool = False
    moved: bool = True
    options: Any = None
    scratch: dict[str, Any] = field(default_factory=dict)

    @property
    def traits(self) -> Traits:
        """What the kernels of the solvers are specialised for, of the terms and of the integrator."""
        return self.model.terms.traits._replace(midpoint=self.midpoint)

    @property
    def share(self) -> float:
        """How much of a change at the end of a step there is where forces are taken."""
        return 0.5 if self.midpoint else 1.0


@dataclass(frozen=True)
class Column:
    """A row that a term books per substep.

    Attributes:
        name: column of the energy ledger; "" for none.
        kind: STORED, what the term stores now; WORK, done on the model; LOSS; NUMERICAL, a part of the integrator's;
            HELD_VISCOUS, viscous loss of a force that counts among the dead loads.
    """

    name: str
    kind: int


@dataclass(frozen=True)
class FieldSpec:
    """A scalar field at nodes that users may ask for.

    Attributes:
        title, units: of legends.
        join: what becomes of the samples of two terms that have this very field; None: it is one term's alone.
        at_node: value of a node from those of its samples; None: `samples` gives one value per node.
    """

    title: str
    units: str
    join: np.ufunc | None = None
    at_node: np.ufunc | None = None


@dataclass(eq=False)
class Kept:
    """Arrays that a term's blocks are made from, beside the displacements: live ones, those that a kept preconditioner
    is made with, and the state's, [world, ...]."""

    live: list[wp.array]
    place: list[wp.array]
    state: list[wp.array]


def part(name: str) -> Callable[[F], F]:
    """Marks a method of a term: its launches belong to part `name` of a profile."""

    def mark(method: F) -> F:
        @functools.wraps(method)
        def marked(self: Any, at: At, *args: Any, **options: Any) -> Any:
            with at.launch.part(name):
                return method(self, at, *args, **options)

        return marked  # type: ignore[return-value]

    return mark


class Term:
    """One contribution to the residual. Forces are in N, on slots; flags `active` are int32 arrays [world].

    Pools: a term with a potential that has `connectivity` writes at `offset + local * items + item` of work.pool_force
    (what it adds to the residual, the derivative of its potential), work.pool_product (the derivative of that along p)
    and work.pool_block (3x3 blocks on the diagonal, Voigt order). A term without a potential does so in
    work.nonpotential_contribution, with the force on the body, and in work.nonpotential_tangent. Slots gather from the
    pools in a fixed order.

    Attributes:
        name: unique.
        potential: it has one; else its force is held dead inside a line search, and its work counts as that of fields
            as far as no column books it.
        traits: what it asks of the kernels of a step. `limited` is a term's to declare; `ties` and `gated` belong to
            constraints; the others follow from connectivity, rows and whether it overrides `product`.
        connectivity: arrays (items, slots of an item) of the model's slots that it contributes to.
        columns: what it books, see Column; energies() has a column by each name.
        fields: scalars at nodes, by name.
        parts: parts of a profile that its launches name, with a line about each.
        report_columns: columns of the report of a step.
        rows: rows [TERM_ROWS, world, row] of its potential in work.term_rows, see `Workspace.rows_of`.
        booked_rows: length of the rows of `book`, where they are longer than there are slots, elements or `rows`.
        penalty: its blocks are added to the matrix after D was taken from it.
        offset, row_offset, report_offset: its places in the pools, the rows and the report, set by the TermSet.
    """

    name: ClassVar[str]
    potential: ClassVar[bool] = True
    columns: ClassVar[tuple[Column, ...]] = ()
    fields: ClassVar[Mapping[str, FieldSpec]] = {}
    parts: ClassVar[Mapping[str, str]] = {}
    penalty: ClassVar[bool] = False

    def __init__(self, model: Model) -> None:
        self.model = model
        self.traits = Traits()
        self.offset = self.row_offset = self.report_offset = 0
        self.rows = self.report_columns = self.booked_rows = 0
        self.connectivity: list[np.ndarray] = []

    @classmethod
    def of(cls, model: Model) -> Term | None:
        """The term of a model, or None where the model has nothing of it: it costs nothing then."""
        raise NotImplementedError

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        """What `info` lists as used or left out."""
        return {}

    # before the model knows its components

    def ties(self) -> list[np.ndarray]:
        """Sets of model slots that it ties to each other: they become one component."""
        return []

    def build(self, laws: TimeLaws) -> None:
        """Make what needs the components, and number time laws; sets `connectivity`, `rows`, `report_columns`."""

    def hold(self, free: np.ndarray) -> None:
        """Clear directions (components, 3) in which it ties a component to the ground, or to another component.

        Translations of a free component pass through the elements and the mass alone. Where a term resists them, a
        solve can't be corrected by them: by default those of all components that a tangent of this term touches. A
        term whose forces on each component are in balance at any translation clears nothing.
        """
        if self.potential or type(self).product is not Term.product:
            for conn in self.connectivity:
                free[np.unique(self.model.component[conn])] = 0.0

    def restraints(self, state: State, component: int) -> Any:
        """Rows (n, 3 slots), CSR: directions in which it resists motion of a component, for statics; None without."""
        return None

    def incidence(self) -> tuple[np.ndarray, np.ndarray, int] | None:
        """(item, slot, number of items) of entries off the elements' pattern: slots of one item couple."""
        return None

    def hash(self, h: Any) -> None:
        """Feed what defines it into a hash, so that a checkpoint of another term is refused.

        By default the attributes that are numbers, texts and numpy arrays; name, columns and connectivity are fed
        already.
        """
        for name, value in sorted(vars(self).items()):
            if isinstance(value, np.ndarray):
                h.update(name.encode() + np.ascontiguousarray(value).tobytes())
            elif isinstance(value, (bool, int, float, complex, str, np.generic)):
                h.update(f"{name} {value!r}".encode())

    # for one simulation

    def allocate(self, work: Workspace, at: At) -> None:
        """Make scratch; keep it in at.scratch[name]."""

    def register(self, at: At) -> None:
        """Register history with at.state: it is then rewound, halved, reset and saved with the state."""

    def configure(self, at: At) -> None:
        """Solver and state are known."""

    def modules(self, at: At) -> Iterable[wp.Module]:
        """Modules that it launches in a step."""
        return ()

    def start(self, at: At, active: wp.array) -> None:
        """The state of active worlds was set: bring up to it what follows it. Time laws and work.u are at the state."""

    def rewind(self, state: State) -> None:
        """The time of a state is about to be put to 0: shift what the term has stored of times."""

    # in a step, in this order

    def begin(self, at: At, active: wp.array) -> None:
        """An attempt begins; time laws are at its end."""

    def prepare(self, at: At, active: wp.array) -> None:
        """work.u is the first iterate: evaluate what blocks and penalties need."""

    def scale(self, at: At, active: wp.array) -> None:
        """D of the first iterate is known, and so are penalties."""

    def force(self, at: At, active: wp.array) -> None:
        """Forces and rows of the potential at work.u, work.v; in statics work.v is the increment of a load step, m."""

    def aim(self, at: At, active: wp.array) -> None:
        """work.direction is the Newton direction. A term that limits the step lowers work.newton.limit.

        0 or less: no step is allowed, and the attempt is given up and halved.
        """

    def adopt(self, at: At, flags: wp.array) -> None:
        """A trial was accepted in the flagged worlds: hold its multipliers, caps, ... in the next search."""

    def refresh(self, at: At, flags: wp.array) -> None:
        """With the trait "walls": take anew, in the flagged worlds, what Newton's method has held so far.

        Forces are evaluated again after it, and judged: the residual is that of what is held now.
        """

    def follow(self, at: At, active: wp.array) -> None:
        """There is a new iterate, and a linear solve to come."""

    def outer(self, at: At, flags: wp.array) -> None:
        """The inner solve of a classical multiplier method is done in the flagged worlds: change multipliers."""

    def book(self, at: At, accepted: wp.array) -> wp.array | None:
        """Rows [column, world, item] in float64 whose sums are booked, J; the state is still that before the substep.

        None: the sums of the last substep stand.
        """
        return None

    def commit(self, at: At, accepted: wp.array) -> None:
        """An attempt was accepted: keep history."""

    def report(self, at: At) -> None:
        """Write columns of work.report, from report_offset on."""

    def measure(self, at: At) -> dict[str, np.ndarray]:
        """What the STORED columns hold at the state, (worlds,), J, where the ledger begins anew."""
        return {}

    def restart(self, at: At, flags: wp.array) -> None:
        """The state of the flagged worlds was set on the device: scratch that lasts is as in a new simulation again."""

    # in a linear solve

    def product(self, at: At, p: wp.array, active: wp.array) -> None:
        """The derivative of the force along p, a change of the positions, m; velocities change by p/(dq/dv)."""

    def diagonal(self, at: At, active: wp.array) -> None:
        """3x3 blocks on the diagonal, positive, into the pool.

        For the solvers that work with blocks of every iterate; the others take them from `blocks`.
        """

    def keep(self, at: At) -> list[tuple[str, wp.array]]:
        """Names and arrays [world, ...] beside the displacements that `blocks(projected=True)` is a function of.

        A preconditioner keeps copies: a resumed run makes the one that the uninterrupted run has.
        """
        return []

    def carry(self, at: At, kept: Kept, reuse: Any, accepted: wp.array) -> bool:
        """Copy what is kept with a kernel of its own; False: the caller does it array by array."""
        return False

    def blocks(
        self, at: At, matrix: Any, kept: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
        *, projected: bool,
    ) -> None:  # fmt: skip
        """out += (dq/dv) K, with the pattern of `matrix` (see solvers.assembled.Assembled), from the arrays of `keep`.

        `projected`: only what is positive for sure. A term that is stiff and leaves this out costs iterations: neither
        D nor the preconditioner knows of it then.
        """

    def reserve(self, at: At, matrix: Any, *, projected: bool) -> None:
        """Make what `blocks` needs, before launches are recorded; `projected`: nothing else will be asked for."""

    def block_modules(self) -> Iterable[wp.Module]:
        """Modules that `blocks` launches."""
        return ()

    def couples(self) -> list[tuple[int, int]]:
        """Numbers of two bodies each that its tangent couples, but `blocks` does not: the rest is for `couple`."""
        return []

    def reserve_motions(self, at: At, motions: Any) -> Iterable[wp.Module]:
        """Make what `couple` needs, before launches are recorded; the modules that it launches."""
        return ()

    def couple(self, at: At, kept: list[wp.array], dq_dv: wp.array, active: wp.array) -> None:
        """Put what couples bodies into the matrix of the rigid motions of `reserve_motions` (solvers/motions.py)."""

    def preconditions(self, at: At) -> bool:
        """Whether `precondition` has something to add."""
        return False

    def precondition(
        self, at: At, r: wp.array, z: wp.array, active: wp.array, into: wp.array | None = None
    ) -> None:  # fmt: skip
        """Correct z = D^-1 r on the slots that it couples; with `into` add the result there instead."""

    # results

    def explain(self, at: At, world: int) -> tuple[type[ConvergenceError], str] | None:
        """Why the last attempt at a step of a world was refused, where the term knows, with the error that says so."""
        return None

    def remark(self, at: At, world: int) -> str:
        """What else is to be told of the last attempt at a refused step of a world; "" for nothing."""
        return ""

    def parameter_arrays(self) -> Mapping[str, wp.array]:
        """What `parameters` write, by names of the term's own: arrays that checkpoints hold and a resumed run gets."""
        return {}

    def parameters_taken(self) -> None:
        """`parameter_arrays` were written from a checkpoint."""

    def take_materials(self, mask: np.ndarray) -> None:
        """Constants of materials (see `model.parameters`) were set in the chosen worlds (worlds,): follow them in
        place; before the first simulation arrays may be replaced by longer ones."""

    def parameters(self) -> Mapping[str, Callable[[Any, np.ndarray], None]]:
        """What `Model.set_parameter` may set, by name, with what sets it: it gets the value as the user gave it, which
        it checks, and the mask (worlds,) of the worlds to set; the others stay."""
        return {}

    def samples(self, field: str, body: Any, state: State) -> np.ndarray:
        """(worlds, nodes x samples of a node) values of one of `fields`, on sections and faces; of one without
        `at_node` (worlds, nodes of the body's mesh)."""
        raise NotImplementedError
