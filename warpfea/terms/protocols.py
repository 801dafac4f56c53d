"""Protocols of terms: methods that few terms need, each group a base class with methods that do nothing, but for
those of `Touching` that raise.

A solver iterates over `TermSet.having(protocol)`: the terms that lack it cost nothing. A term that defines a method of
a protocol without deriving from it is refused by name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from .term import StepContext, Term

if TYPE_CHECKING:
    from ..base.errors import ConvergenceError
    from ..model.state import State
    from .gradients import Gradient, StepAdjoint

__all__ = [
    "PROTOCOLS",
    "CachedInputs",
    "Constrained",
    "Coupled",
    "Diagnosed",
    "Differentiable",
    "Impacting",
    "Parametrised",
    "Preconditioned",
    "Tied",
    "Touching",
    "Updated",
]


class Tied(Term):
    """Term that ties slots to each other or to the ground."""

    def tied_slots(self) -> list[np.ndarray]:
        """Sets of model slots tied to each other: each becomes one component. Called before `build`."""
        return []

    def mark_constrained(self, free: np.ndarray) -> None:
        """Clear directions (components, 3) in which it constrains a component to the ground or another component,
        besides those that follow from its connectivity."""

    def restraints(self, state: State, component: int) -> Any:
        """Rows (n, 3 slots), CSR, of directions in which it resists motion of a component, for statics; None: none."""
        return None


class Updated(Term):
    """Term with quantities that are frozen inside Newton's method, or that limits its steps."""

    def process_direction(self, ctx: StepContext, active: wp.array) -> None:
        """Process the Newton direction work.direction. To limit the step, lower work.newton.search.limit.

        A limit <= 0 allows no step: the attempt fails and is halved.
        """

    def predict_frozen(self, ctx: StepContext, active: wp.array) -> None:
        """Predict quantities after the full step along work.direction, for the tangent at the next iterates."""

    def accept_trial(self, ctx: StepContext, flags: wp.array) -> None:
        """Accept a trial in the flagged worlds: freeze its multipliers, ... for the next search."""

    def update_frozen(self, ctx: StepContext, flags: wp.array) -> None:
        """Update frozen quantities, such as friction limits, in the flagged worlds, to those of the iterate.

        The flags are of worlds whose relative residual is at most `FROZEN_UPDATE_RESIDUAL` or within round-off, or that
        have no iteration left. Forces and residual are then re-evaluated and checked with the updated values.
        """


class Constrained(Term):
    """Term of constraint rows with multipliers and penalties; its blocks are added to a matrix after D is taken
    from it. The slots gather from its rows in work.multipliers: a model has at most one such term.

    Attributes:
        tables: its rows; `data`: on the device, as of kernels/terms/constraints.py, with the `law` of each.
    """

    tables: Any

    def configure(self, ctx: StepContext) -> None:
        """Configure for the solver and state, both known here."""

    def scale(self, ctx: StepContext, active: wp.array) -> None:
        """Scale by D of the first iterate; penalties are known."""

    def prepare_solve(self, ctx: StepContext, active: wp.array) -> None:
        """Prepare a linear solve at a new iterate."""

    def precondition(
        self, ctx: StepContext, r: wp.array, z: wp.array, active: wp.array, into: wp.array | None = None
    ) -> None:  # fmt: skip
        """Correct z = D^-1 r on the slots that it couples; with `into` add the result there instead.

        Called if constraint directions are deflated (ctx.options.deflate_constraints).
        """

    def predict_multipliers(self, ctx: StepContext, active: wp.array) -> None:
        """Multiplier part of the Newton step in work.direction."""

    def update_multipliers(self, ctx: StepContext, flags: wp.array) -> None:
        """Update multipliers after the inner solve of a classical multiplier method in the flagged worlds."""


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


class Preconditioned(Term):
    """Term with blocks of H in matrices and preconditioners, as stiff terms need."""

    def incidence(self) -> tuple[np.ndarray, np.ndarray, int] | None:
        """Entries (item, slot, number of items) outside the elements' pattern: the slots of an item couple."""
        return None

    def cached_inputs(self, ctx: StepContext) -> list[tuple[str, wp.array]]:
        """Names and arrays [world, ...] that `blocks(projected=True)` depends on besides the displacements.

        A preconditioner stores copies, so that a resumed run rebuilds the same one.
        """
        return []

    def copy_cached(self, ctx: StepContext, kept: CachedInputs, reuse: Any, accepted: wp.array) -> bool:
        """Copy the cached inputs with a kernel of its own; False: the caller copies array by array."""
        return False

    def reset_scratch(self, ctx: StepContext, flags: wp.array) -> None:
        """Reset persistent scratch of the flagged worlds after a device-side reset."""

    def allocate_blocks(self, ctx: StepContext, matrix: Any, *, projected: bool) -> None:
        """Allocate for `blocks` before launches are captured; `projected`: no other blocks are needed."""

    def block_modules(self) -> Iterable[wp.Module]:
        """Modules launched by `blocks`."""
        return ()

    def blocks(
        self, ctx: StepContext, matrix: Any, cached: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
        *, projected: bool,
    ) -> None:  # fmt: skip
        """out += (dq/dv) K, with the pattern of `matrix` (see solvers.matrix_assembly.MatrixAssembler), from the
        arrays of `cached_inputs`.

        `projected`: the positive semi-definite part only. Omitted stiffness costs iterations: both D and the
        preconditioner lack it then.
        """


class Coupled(Term):
    """Term whose tangent couples bodies that share no element."""

    def coupled_bodies(self) -> list[tuple[int, int]]:
        """Body pairs coupled by the tangent; by `blocks` only where the pattern has their `coupled_slot_pairs`, else in
        the coarse space by `add_mode_coupling` or `add_coarse_coupling`."""
        return []

    def coupled_slot_pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of slots, (n,) each, that the tangent may couple: in the pattern of small models."""
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)

    def allocate_mode_coupling(self, ctx: StepContext, rigid_modes: Any) -> Iterable[wp.Module]:
        """Allocate for `add_mode_coupling` before launches are captured; returns its modules."""
        return ()

    def add_mode_coupling(self, ctx: StepContext, cached: list[wp.array], dq_dv: wp.array, active: wp.array) -> None:
        """Add the coupling of bodies to the rigid body mode matrix (solvers/rigid_body_modes.py)."""

    def allocate_coarse_coupling(self, ctx: StepContext, coarse: Any) -> Iterable[wp.Module]:
        """Allocate for `add_coarse_coupling` before launches are captured; returns its modules."""
        return ()

    def add_coarse_coupling(self, ctx: StepContext, cached: list[wp.array], dq_dv: wp.array, active: wp.array) -> None:
        """Add the coupling of bodies to the coarse matrix of the levels (solvers/twolevel.py)."""


class Parametrised(Term):
    """Term with parameters of `Model.set_parameter`, or with constants that follow from materials."""

    def parameters(self) -> Mapping[str, Callable[[Any, np.ndarray], None]]:
        """Setters of `Model.set_parameter` by name: each validates the user's value and sets it in the worlds of the
        mask (worlds,)."""
        return {}

    def parameter_arrays(self) -> Mapping[str, wp.array]:
        """Arrays written by `parameters`, by the term's own names: saved in checkpoints and restored."""
        return {}

    def update_materials(self, mask: np.ndarray) -> None:
        """Update in place after material constants (see `model.parameters`) were set in the chosen worlds (worlds,);
        before the first simulation arrays may be replaced by longer ones."""


class Diagnosed(Term):
    """Term that explains rejected attempts."""

    def failure_reason(self, ctx: StepContext, world: int) -> tuple[type[ConvergenceError], str] | None:
        """Error class and reason of the last rejected attempt of a world, or None if unknown to the term."""
        return None

    def failure_note(self, ctx: StepContext, world: int) -> str:
        """Additional note on the last rejected attempt of a world; "" for none."""
        return ""


class Impacting(Term):
    """Term with forces that may stop a body within a step.

    Attributes:
        impacts: False if those of the model can't.
        plastic: True if impacts may leave no speed: `find_impacts` is called in mid-point schemes, too.
    """

    impacts = True
    plastic = False

    def find_impacts(self, ctx: StepContext) -> None:
        """Set `impact` of the step control to IMPACT_FOUND in worlds whose attempt does not resolve an impact."""


class Touching(Impacting):
    """Term of contacts, with their columns in the report.

    Attributes:
        tables: its contacts, points and facets.
    """

    tables: Any

    def poses(self, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Positions (worlds, colliders, 3), m, rotations (..., 3, 3) and surface offsets (worlds, colliders), m, of all
        colliders of the model at a state; None if unknown to the term."""
        return None

    def nodal_force(self, state: State) -> np.ndarray:
        """Elastic nodal forces of all its contacts at a state, (worlds, slots, 3), N."""
        raise NotImplementedError

    def contacts_info(self) -> list[dict[str, Any]]:
        """Entries of `Model.info` per contact, in the order of addition."""
        raise NotImplementedError

    def contact_column(self, contact: Any) -> int:
        """First report column of one of its contacts."""
        raise NotImplementedError

    def element_size(self, contact: Any) -> float:
        """Size of the smallest element of one of its contacts, m."""
        raise NotImplementedError

    def penetration_columns(self) -> tuple[slice, np.ndarray]:
        """Report columns of the largest depths of its contacts, and the sizes of their smallest elements, m."""
        raise NotImplementedError


class Differentiable(Term):
    """Term with the adjoint of its part of a step (solvers/adjoint.py).

    A run of a model with a term that lacks it is not differentiated: the term is refused by name.
    """

    def not_differentiable(self, ctx: StepContext) -> str | None:
        """Feature of it without an adjoint, or None."""
        return None

    def exact_product(
        self, ctx: StepContext, p: wp.array, active: wp.array, *, transposed: bool, start: bool = False
    ) -> None:  # fmt: skip
        """`product` of the exact derivative of the force, or of its transpose, into the same array.

        The default is for terms whose `product` is exact and symmetric. Others override `is_symmetric` too; those
        without a `product` then write it as if they had one.

        Args:
            start: of mid-point schemes, the derivative by the displacements at the start of the step, those at its end
                fixed. The default is for forces of the mid-point alone.
        """
        self.product(ctx, p, active)

    def is_symmetric(self, ctx: StepContext) -> bool:
        """True if `product` is the exact derivative of the force, and symmetric.

        A single False makes the solver take `exact_product` of all terms, and BiCGStab.
        """
        return True

    def gradients(self, ctx: StepContext) -> Mapping[str, Callable[[], Gradient]]:
        """By name of a parameter: makes the function that adds -w . dg/dparameter of a step."""
        return {}

    def law_gradient(self, ctx: StepContext, law: int) -> Gradient | None:
        """The function that adds the derivative of the loss by the value of a time law; None: not its law."""
        return None

    def shape_gradients(self, ctx: StepContext) -> list[Callable[[], Gradient]] | str:
        """Makers of the functions that add -w . dg/dX, X the reference values, to [world, slot]; or why there are
        none."""
        return "its derivative by the reference is not written"

    def prepare_adjoint(self, at: StepAdjoint) -> Iterable[wp.Module]:
        """Allocate for the adjoint, with at.bars of histories by their names in the state; returns the modules."""
        return ()

    def begin_adjoint(self, at: StepAdjoint) -> None:
        """Begin to go back through a run: parameters are known."""

    def linearise_adjoint(self, at: StepAdjoint) -> None:
        """Evaluate exact products at the end of a step, and add to at.q_bar the bars of its histories, before the
        solve."""

    def add_history_gradient(self, at: StepAdjoint) -> None:
        """at.bars[name] -= w . dg/dx of forces that depend on arrays x of the state at the start of the step besides
        q~; called after the solve and before `gradients`, with the bars of the start."""

    def add_history_change(self, at: StepAdjoint) -> None:
        """at.force -= dg/dx along the changes at.bars[name] of the arrays of `add_history_gradient`, forwards."""


PROTOCOLS = (
    Tied, Updated, Constrained, Preconditioned, Coupled, Parametrised, Diagnosed, Impacting, Touching, Differentiable,
)  # fmt: skip
