"""Solvers of a step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from ..base.errors import ModelError
from ..base.names import did_you_mean
from ..terms.protocols import Coupled
from ..terms.term import StepContext
from .jacobi import Jacobi, JacobiLoop
from .newton import NewtonLoop, NewtonPCG

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["SOLVERS", "Jacobi", "NewtonPCG", "make_solver_loop", "solver_options"]

SOLVERS: dict[str, Callable[..., NewtonPCG | Jacobi]] = {
    "newton-pcg": NewtonPCG,
    "jacobi": Jacobi,
    "direct": partial(NewtonPCG, linear="direct"),
}
"""Solver option classes by name."""


def solver_options(solver: Any) -> NewtonPCG | Jacobi:
    """Solver options from a name, options, or None for the default. Raises ModelError listing the names."""
    if solver is None:
        return NewtonPCG()
    if isinstance(solver, str) and solver in SOLVERS:
        return SOLVERS[solver]()
    if isinstance(solver, (NewtonPCG, Jacobi)):
        return solver
    names = ", ".join(repr(name) for name in SOLVERS)
    hint = did_you_mean(solver, SOLVERS) if isinstance(solver, str) else ""
    raise ModelError(f"solver = {solver!r} is unknown; there are {names}, or options such as wf.NewtonPCG(...){hint}")


def make_solver_loop(ctx: StepContext, options: NewtonPCG | Jacobi, **more: Any) -> NewtonLoop:
    """The solver loop of the given options.

    Raises:
        ModelError: a matrix-based solver for a term that couples bodies with a changing pattern.
    """
    if isinstance(options, Jacobi) or options.linear == "direct":
        refuse_couplings(ctx.model, "Jacobi" if isinstance(options, Jacobi) else "NewtonPCG(linear='direct')")
    if isinstance(options, Jacobi):
        return JacobiLoop(ctx, options, **more)
    return NewtonLoop(ctx, options, **more)


def refuse_couplings(model: Model, name: str) -> None:
    """Raise ModelError for a term that couples bodies without a shared element: the matrix has a fixed pattern."""
    found = [(term.name, couples) for term in model.terms.having(Coupled) if (couples := term.coupled_bodies())]
    if found:
        kind, couples = found[0]
        a, b = (repr(model.bodies[k].name) for k in couples[0])
        more = f" and {len(couples) - 1} more" if len(couples) > 1 else ""
        raise ModelError(
            f"{name} needs a fixed sparsity pattern, but {kind!r} couple bodies {a} and {b}{more}: use wf.NewtonPCG()"
        )
