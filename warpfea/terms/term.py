"""Interface of residual contributions, Eq. (17): elements, damping, loads, constraints, contact.

A term is constructed once per model and holds constants; variables are in the workspace and the state of a simulation,
passed as a `StepContext`. What few terms need is in the protocols of `protocols.py`. Models: `Form` of PolyFEM,
`BaseForceField` of SOFA, the items of felupe.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..base.launch import part
from ..base.renamed import check_members
from ..kernels.common.traits import Traits
from ..kernels.step.energy_ledger import EXPLICIT_VISCOUS, LOSS, NUMERICAL, STORED, WORK

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..model.state import State
    from .time_law_table import TimeLawTable
    from .workspace import Workspace

__all__ = [
    "EXPLICIT_VISCOUS",
    "LOSS",
    "NUMERICAL",
    "STORED",
    "WORK",
    "Column",
    "FieldSpec",
    "StepContext",
    "Term",
    "part",
]


@dataclass(eq=False)
class StepContext:
    """Simulation context passed to terms.

    Attributes:
        model, work, launch, state: of the simulation.
        u_before: [world, slot] displacements of the step before the last, for multistep schemes; algorithmic
            accelerations for acceleration-level schemes.
        inertia: dynamics; no rates in statics.
        midpoint: forces are evaluated at the middle of a step, at work.u_stage and work.stage_time.
        dissipation: chi of its dissipative form, see kernels/elements/energy_momentum.py.
        accelerated: the scheme has accelerations as state variables.
        positions_changed: positions changed since the last evaluation; if not, only lagged term data did.
        options: solver options for terms.
        scratch: arrays allocated by terms, by term name.
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
    positions_changed: bool = True
    options: Any = None
    scratch: dict[str, Any] = field(default_factory=dict)

    @property
    def traits(self) -> Traits:
        """Traits of terms and integrator that the solvers' kernels are specialised for."""
        return self.model.terms.traits._replace(midpoint=self.midpoint)

    @property
    def midpoint_factor(self) -> float:
        """Ratio of stage to end-of-step increment: 1/2 for mid-point schemes, else 1."""
        return 0.5 if self.midpoint else 1.0


@dataclass(frozen=True)
class Column:
    """Energy row of a term per substep.

    Attributes:
        name: column of the energy ledger; "" for none.
        kind: STORED, energy stored at present; WORK, done on the model; LOSS; NUMERICAL, part of the integrator's;
            EXPLICIT_VISCOUS, viscous loss of a force among the dead loads.
    """

    name: str
    kind: int


@dataclass(frozen=True)
class FieldSpec:
    """Field available to users.

    Attributes:
        title, units: for legends.
        join: combines the samples of two terms with this field; None: one term only.
        node_reduction: reduces the samples of a node; None: `samples` gives one value per node.
        of_slots: `samples` gives values (worlds, slots of the body), interpolated by the shape functions.
        function: values from samples with components (worlds, n, k), after interpolation; None: the samples.
        components: names of the components; () for a scalar. Components of samples of a node are averaged.
        quantities: of a field of the elements, what is sampled, see terms.samples.
        scalars: fields to take in its place where a scalar is needed.
        cell_type: of the bodies that have it, beams "line", shells "quad"; "" for all.
    """

    title: str
    units: str
    join: np.ufunc | None = None
    node_reduction: np.ufunc | None = None
    of_slots: bool = False
    function: Callable[[np.ndarray], Any] | None = None
    components: tuple[str, ...] = ()
    quantities: tuple[str, ...] = ()
    scalars: tuple[str, ...] = ()
    cell_type: str = ""


@dataclass(frozen=True, eq=False)
class Congruence:
    """W^T H W, not multiplied out: round-off of the product hides it where weights W, (n, 3 slots), of points far from
    a small rigid part are large. H: (n, n). A `diagonal` W of 1 and 0 leaves out what constraints hold."""

    W: sp.csr_matrix
    H: sp.csr_matrix
    diagonal: bool = False

    @classmethod
    def parts_of(cls, matrix: Any) -> list[Congruence]:
        """A matrix, of one part, or none."""
        if matrix is None:
            return []
        if isinstance(matrix, cls):
            return [matrix]
        return [cls(sp.identity(len(matrix.indptr) - 1, format="csr"), matrix, diagonal=True)]

    def restrict(self, index: np.ndarray) -> Congruence:
        """On some components."""
        W = self.W[:, index]
        return Congruence(W[index], self.H[index][:, index], True) if self.diagonal else Congruence(W, self.H)

    def project(self, Z: np.ndarray) -> np.ndarray:
        """Z^T W^T H W Z."""
        Y = self.W @ Z
        return np.asarray(Y.T @ (self.H @ Y))

    def product(self) -> sp.csr_matrix:
        """W^T H W, of a diagonal W H."""
        return self.H if self.diagonal else self.W.T @ self.H @ self.W

    def size(self) -> np.ndarray:
        """Its diagonal, of weights of at most 1."""
        return np.asarray(self.W.minimum(1.0).maximum(-1.0).power(2).T @ np.abs(self.H.diagonal()))


class Term:
    """One contribution to the residual. Forces in N, per slot; flags `active` are int32 arrays [world].

    Pools: a potential term with `connectivity` writes at `offset + local * items + item` of work.pool_force (derivative
    of its potential, added to the residual), work.pool_product (directional derivative of that along p) and
    work.pool_block (3x3 diagonal blocks, Voigt order). A non-potential term writes the force on the body to
    work.nonpotential_contribution, and work.nonpotential_tangent. Slots gather from the pools in a fixed order.
    The traits of the kernels follow from connectivity, rows, protocols and overridden methods, see `derived_traits`.

    Attributes:
        name: unique.
        potential: True for potential forces; else its force is frozen during a line search, and work not in its own
            columns counts as field work.
        translation_invariant: its forces do not resist the translation of a component, see `TermSet.mark_constrained`.
        connectivity: arrays (items, slots of an item) of model slots that it contributes to.
        columns: ledger rows, see Column; energies() has one key per column.
        fields: nodal scalars by name.
        parts: profile parts named by its launches, each with a description.
        report_columns: columns of the step report.
        rows: rows [TERM_ROWS, world, row] of its potential in work.term_rows, see `Workspace.rows_of`.
        increment_rows: length of the rows of `energy_increments`, if larger than the numbers of slots, elements and
            `rows`.
        offset, row_offset, report_offset: offsets in the pools, rows and report, set by the TermSet.
    """

    name: ClassVar[str]
    potential: ClassVar[bool] = True
    translation_invariant: ClassVar[bool] = False
    columns: ClassVar[tuple[Column, ...]] = ()
    fields: ClassVar[Mapping[str, FieldSpec]] = {}
    parts: ClassVar[Mapping[str, str]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        """Refuse members by former names, see base/renamed.py."""
        super().__init_subclass__(**options)
        check_members(cls, Term)

    def __init__(self, model: Model) -> None:
        self.model = model
        self.offset = self.row_offset = self.report_offset = 0
        self.rows = self.report_columns = self.increment_rows = 0
        self.connectivity: list[np.ndarray] = []

    @classmethod
    def of(cls, model: Model) -> Term | None:
        """Construct the term of a model, or None if the model uses none of its features (no cost then)."""
        return cls(model) if any(cls.features(model).values()) else None

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        """Optional features for `info`: used (True) or left out."""
        return {}

    def build(self, laws: TimeLawTable) -> None:
        """Build tables that need the components and add time laws; sets `connectivity`, `rows`, `report_columns`."""

    def hash(self, h: Any) -> None:
        """Hash its definition, so that a checkpoint of another term is rejected.

        Default: attributes that are numbers, texts or numpy arrays, besides name, columns and connectivity.
        """
        for name, value in sorted(vars(self).items()):
            if isinstance(value, np.ndarray):
                h.update(name.encode() + np.ascontiguousarray(value).tobytes())
            elif isinstance(value, (bool, int, float, complex, str, np.generic)):
                h.update(f"{name} {value!r}".encode())

    # simulation setup

    def allocate(self, work: Workspace, ctx: StepContext) -> None:
        """Allocate scratch in ctx.scratch[name]."""

    def register(self, ctx: StepContext) -> None:
        """Register history with ctx.state: restored, halved, reset and saved with the state."""

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        """Modules launched in a step."""
        return ()

    def start(self, ctx: StepContext, active: wp.array) -> None:
        """Reinitialise after the state was set; time laws and work.u are current."""

    def shift_time(self, state: State) -> None:
        """Shift stored times before the state's time is reset to 0."""

    # in a step, in this order

    def begin(self, ctx: StepContext, active: wp.array) -> None:
        """Begin an attempt; time laws are evaluated at its end."""

    def prepare(self, ctx: StepContext, active: wp.array) -> None:
        """Evaluate the data of blocks and penalties at the first iterate work.u."""

    def force(self, ctx: StepContext, active: wp.array) -> None:
        """Forces at work.u_stage, work.v_stage and work.stage_time, potential rows at work.u.

        These are work.u, work.v and the new time, but with `ctx.midpoint` the middle of the step; there work.v_stage is
        half of the change of u, m, the mean velocity times dq/dv. In statics work.v is the load step increment, m.
        """

    def product(self, ctx: StepContext, p: wp.array, active: wp.array) -> None:
        """Derivative of the force along p, a change of work.u, m; velocities change by p/(dq/dv).

        Stage quantities, u_stage and mean velocity, change by `ctx.midpoint_factor` of that.
        """

    def diagonal(self, ctx: StepContext, active: wp.array) -> None:
        """Positive semi-definite 3x3 diagonal blocks, into the pool.

        For solvers that use the blocks of every iterate; the others take them from `Preconditioned.blocks`.
        """

    def energy_increments(self, ctx: StepContext, accepted: wp.array) -> wp.array | None:
        """Energy rows [column, world, item], J, float64, to be summed; the state is still that before the substep.

        None: the sums of the last substep remain valid.
        """
        return None

    def commit(self, ctx: StepContext, accepted: wp.array) -> None:
        """Store history of an accepted attempt."""

    def report(self, ctx: StepContext) -> None:
        """Write columns of work.report from report_offset on."""

    # at a state

    def stored_energy(self, ctx: StepContext) -> dict[str, np.ndarray]:
        """STORED columns at the state, (worlds,), J, from which the ledger restarts."""
        return {}

    def matrices(self, state: State, world: int) -> tuple[Any, Any]:
        """Stiffness and damping of one world at a state at rest, (3 slots, 3 slots), N/m and N s/m, of motions small
        about it, as CSR or `Congruence`; None: none. Terms that do not override it have no modes."""
        raise NotImplementedError

    def samples(self, field: str, body: Any, state: State) -> np.ndarray:
        """Values (worlds, nodes x samples of a node) of one of `fields`, on sections and faces; of one without
        `node_reduction` (worlds, nodes of the body's mesh)."""
        raise NotImplementedError
