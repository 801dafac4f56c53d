"""Solvers of a step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from ..base.errors import ModelError
from ..base.names import did_you_mean
from ..terms.term import StepContext
from .choice import check_plan, choose_solver
from .jacobi import Jacobi, JacobiLoop
from .newton import NewtonLoop, NewtonPCG
from .plan import SolverPlan

__all__ = ["SOLVERS", "Jacobi", "NewtonPCG", "SolverPlan", "choose_solver", "make_solver_loop", "solver_options"]

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


def make_solver_loop(ctx: StepContext, options: NewtonPCG | Jacobi, plan: SolverPlan | None, **more: Any) -> NewtonLoop:
    """The solver loop of the given options, with the methods of a plan or those chosen.

    Raises:
        ModelError: a plan that does not fit, or a matrix-based solver for a term that couples bodies with a changing
            pattern.
    """
    scheme = "statics" if not ctx.inertia else "midpoint" if ctx.midpoint else "dynamics"
    if plan is None:
        plan = choose_solver(ctx.model, ctx.model.device, ctx.model.many, options=options, scheme=scheme)
    else:
        check_plan(plan, ctx.model, options, scheme)
    if isinstance(options, Jacobi):
        return JacobiLoop(ctx, options, plan, **more)
    return NewtonLoop(ctx, options, plan, **more)
