"""Interface of residual contributions, Eq. (17): elements, damping, loads, constraints, contact.

A term is constructed once per model and holds constants; variables are in the workspace and the state of a simulation,
passed as a `StepContext`. A step calls the methods that each term overrides. Models: `Form` of PolyFEM,
`BaseForceField` of SOFA, the items of felupe.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
import warp as wp

from ..base.renamed import check_members
from ..kernels.common.traits import Traits
from ..kernels.step.energy_ledger import EXPLICIT_VISCOUS, LOSS, NUMERICAL, STORED, WORK

if TYPE_CHECKING:
    from ..base.errors import ConvergenceError
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
    "CachedInputs",
    "Column",
    "FieldSpec",
    "StepContext",
    "Term",
    "part",
]

F = TypeVar("F", bound=Callable[..., Any])


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
    """Scalar nodal field available to users.

    Attributes:
        title, units: for legends.
        join: combines the samples of two terms with this field; None: one term only.
        node_reduction: reduces the samples of a node; None: `samples` gives one value per node.
    """

    title: str
    units: str
    join: np.ufunc | None = None
    node_reduction: np.ufunc | None = None


@dataclass(eq=False)
class CachedInputs:
    """Inputs of a term's blocks besides displacements, arrays [world, ...].

    Attributes:
        live: as the term evaluates them; cached: copies at the linearisation of the preconditioner; state: copies saved
            with the state, from which a resumed run rebuilds the preconditioner.
    """

    live: list[wp.array]
    cached: list[wp.array]
    state: list[wp.array]


def part(name: str = "") -> Callable[[F], F]:
    """Decorator: attribute a method's launches to profile part `name`, by default that of the term's name."""

    def decorate(method: F) -> F:
        @functools.wraps(method)
        def wrapper(self: Any, ctx: StepContext, *args: Any, **options: Any) -> Any:
            with ctx.launch.part(name or self.name):
                return method(self, ctx, *args, **options)

        return wrapper  # type: ignore[return-value]

    return decorate


class Term:
    """One contribution to the residual. Forces in N, per slot; flags `active` are int32 arrays [world].

    Pools: a potential term with `connectivity` writes at `offset + local * items + item` of work.pool_force (derivative
    of its potential, added to the residual), work.pool_product (directional derivative of that along p) and
    work.pool_block (3x3 diagonal blocks, Voigt order). A non-potential term writes the force on the body to
    work.nonpotential_contribution, and work.nonpotential_tangent. Slots gather from the pools in a fixed order.

    Attributes:
        name: unique.
        potential: True for potential forces; else its force is frozen during a line search, and work not in its own
            columns counts as field work.
        traits: kernel features that it requires. `limited` is declared by a term; `tied_slots` and `has_constraints`
            belong to constraints; the others follow from connectivity, rows and an overridden `product`.
        connectivity: arrays (items, slots of an item) of model slots that it contributes to.
        columns: ledger rows, see Column; energies() has one key per column.
        fields: nodal scalars by name.
        parts: profile parts named by its launches, each with a description.
        report_columns: columns of the step report.
        rows: rows [TERM_ROWS, world, row] of its potential in work.term_rows, see `Workspace.rows_of`.
        increment_rows: length of the rows of `energy_increments`, if larger than the numbers of slots, elements and
            `rows`.
        penalty: its blocks are added to the matrix after D is taken from it.
        offset, row_offset, report_offset: offsets in the pools, rows and report, set by the TermSet.
    """

    name: ClassVar[str]
    potential: ClassVar[bool] = True
    columns: ClassVar[tuple[Column, ...]] = ()
    fields: ClassVar[Mapping[str, FieldSpec]] = {}
    parts: ClassVar[Mapping[str, str]] = {}
    penalty: ClassVar[bool] = False

    def __init_subclass__(cls, **options: Any) -> None:
        """Refuse members by former names, see base/renamed.py."""
        super().__init_subclass__(**options)
        check_members(cls, Term)

    def __init__(self, model: Model) -> None:
        self.model = model
        self.traits = Traits()
        self.offset = self.row_offset = self.report_offset = 0
        self.rows = self.report_columns = self.increment_rows = 0
        self.connectivity: list[np.ndarray] = []

    @classmethod
    def of(cls, model: Model) -> Term | None:
        """Construct the term of a model, or None if the model does not use it (no cost then)."""
        raise NotImplementedError

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        """Optional features for `info`: used (True) or left out."""
        return {}

    # before components are known

    def tied_slots(self) -> list[np.ndarray]:
        """Sets of model slots tied to each other: each becomes one component."""
        return []

    def build(self, laws: TimeLawTable) -> None:
        """Build tables that need the components and add time laws; sets `connectivity`, `rows`, `report_columns`."""

    def mark_constrained(self, free: np.ndarray) -> None:
        """Clear directions (components, 3) in which it constrains a component to the ground or another component.

        Translations of a free component involve elements and mass only. A solve can't be corrected along translations
        that a term resists: by default all those of components in this term's tangent. A term with self-equilibrated
        forces on each component under translation clears nothing.
        """
        if self.potential or type(self).product is not Term.product:
            for conn in self.connectivity:
                free[np.unique(self.model.component[conn])] = 0.0

    def restraints(self, state: State, component: int) -> Any:
        """Rows (n, 3 slots), CSR, of directions in which it resists motion of a component, for statics; None: none."""
        return None

    def incidence(self) -> tuple[np.ndarray, np.ndarray, int] | None:
        """Entries (item, slot, number of items) outside the elements' pattern: the slots of an item couple."""
        return None

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

    def configure(self, ctx: StepContext) -> None:
        """Configure for the solver and state, both known here."""

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

    def scale(self, ctx: StepContext, active: wp.array) -> None:
        """Scale by D of the first iterate; penalties are known."""

    def force(self, ctx: StepContext, active: wp.array) -> None:
        """Forces and potential rows at work.u, work.v; in statics work.v is the load step increment, m."""

    def process_direction(self, ctx: StepContext, active: wp.array) -> None:
        """Process the Newton direction work.direction. To limit the step, lower work.newton.search.limit.

        A limit <= 0 allows no step: the attempt fails and is halved.
        """

    def accept_trial(self, ctx: StepContext, flags: wp.array) -> None:
        """Accept a trial in the flagged worlds: freeze its multipliers, friction limits, ... for the next search."""

    def update_frozen(self, ctx: StepContext, flags: wp.array) -> None:
        """Update lagged quantities in the flagged worlds (trait "unilateral").

        Forces and residual are re-evaluated and checked with the updated values.
        """

    def prepare_solve(self, ctx: StepContext, active: wp.array) -> None:
        """Prepare a linear solve at a new iterate."""

    def update_multipliers(self, ctx: StepContext, flags: wp.array) -> None:
        """Update multipliers after the inner solve of a classical multiplier method in the flagged worlds."""

    def energy_increments(self, ctx: StepContext, accepted: wp.array) -> wp.array | None:
        """Energy rows [column, world, item], J, float64, to be summed; the state is still that before the substep.

        None: the sums of the last substep remain valid.
        """
        return None

    def commit(self, ctx: StepContext, accepted: wp.array) -> None:
        """Store history of an accepted attempt."""

    def report(self, ctx: StepContext) -> None:
        """Write columns of work.report from report_offset on."""

    def stored_energy(self, ctx: StepContext) -> dict[str, np.ndarray]:
        """STORED columns at the state, (worlds,), J, from which the ledger restarts."""
        return {}

    def reset_scratch(self, ctx: StepContext, flags: wp.array) -> None:
        """Reset persistent scratch of the flagged worlds after a device-side reset."""

    # in a linear solve

    def product(self, ctx: StepContext, p: wp.array, active: wp.array) -> None:
        """Derivative of the force along p, a change of the positions, m; velocities change by p/(dq/dv)."""

    def diagonal(self, ctx: StepContext, active: wp.array) -> None:
        """Positive semi-definite 3x3 diagonal blocks, into the pool.

        For solvers that use the blocks of every iterate; the others take them from `blocks`.
        """

    def cached_inputs(self, ctx: StepContext) -> list[tuple[str, wp.array]]:
        """Names and arrays [world, ...] that `blocks(projected=True)` depends on besides the displacements.

        A preconditioner stores copies, so that a resumed run rebuilds the same one.
        """
        return []

    def copy_cached(self, ctx: StepContext, kept: CachedInputs, reuse: Any, accepted: wp.array) -> bool:
        """Copy the cached inputs with a kernel of its own; False: the caller copies array by array."""
        return False

    def blocks(
        self, ctx: StepContext, matrix: Any, kept: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
        *, projected: bool,
    ) -> None:  # fmt: skip
        """out += (dq/dv) K, with the pattern of `matrix` (see solvers.matrix_assembly.MatrixAssembler), from the
        arrays of `cached_inputs`.

        `projected`: the positive semi-definite part only. Omitted stiffness costs iterations: both D and the
        preconditioner lack it then.
        """

    def allocate_blocks(self, ctx: StepContext, matrix: Any, *, projected: bool) -> None:
        """Allocate for `blocks` before launches are captured; `projected`: no other blocks are needed."""

    def block_modules(self) -> Iterable[wp.Module]:
        """Modules launched by `blocks`."""
        return ()

    def coupled_bodies(self) -> list[tuple[int, int]]:
        """Body pairs coupled by the tangent but not by `blocks`: the rest is added by `add_mode_coupling`."""
        return []

    def allocate_mode_coupling(self, ctx: StepContext, motions: Any) -> Iterable[wp.Module]:
        """Allocate for `add_mode_coupling` before launches are captured; returns its modules."""
        return ()

    def add_mode_coupling(self, ctx: StepContext, kept: list[wp.array], dq_dv: wp.array, active: wp.array) -> None:
        """Add the coupling of bodies to the rigid body mode matrix (solvers/rigid_body_modes.py)."""

    def preconditions(self, ctx: StepContext) -> bool:
        """True if `precondition` adds a correction."""
        return False

    def precondition(
        self, ctx: StepContext, r: wp.array, z: wp.array, active: wp.array, into: wp.array | None = None
    ) -> None:  # fmt: skip
        """Correct z = D^-1 r on the slots that it couples; with `into` add the result there instead."""

    # results

    def failure_reason(self, ctx: StepContext, world: int) -> tuple[type[ConvergenceError], str] | None:
        """Error class and reason of the last rejected attempt of a world, or None if unknown to the term."""
        return None

    def failure_note(self, ctx: StepContext, world: int) -> str:
        """Additional note on the last rejected attempt of a world; "" for none."""
        return ""

    def parameter_arrays(self) -> Mapping[str, wp.array]:
        """Arrays written by `parameters`, by the term's own names: saved in checkpoints and restored."""
        return {}

    def parameters_restored(self) -> None:
        """Update after `parameter_arrays` were restored from a checkpoint."""

    def update_materials(self, mask: np.ndarray) -> None:
        """Update in place after material constants (see `model.parameters`) were set in the chosen worlds (worlds,);
        before the first simulation arrays may be replaced by longer ones."""

    def parameters(self) -> Mapping[str, Callable[[Any, np.ndarray], None]]:
        """Setters of `Model.set_parameter` by name: each validates the user's value and sets it in the worlds of the
        mask (worlds,)."""
        return {}

    def samples(self, field: str, body: Any, state: State) -> np.ndarray:
        """Values (worlds, nodes x samples of a node) of one of `fields`, on sections and faces; of one without
        `node_reduction` (worlds, nodes of the body's mesh)."""
        raise NotImplementedError
