"""Methods of a simulation's linear systems, as `choice.py` chooses them."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["BLOCK_PRECONDITIONERS", "PRECONDITIONERS", "SolverPlan"]

BLOCK_PRECONDITIONERS = ("deflated", "block-jacobi")
"""Preconditioners of 3x3 blocks, which need no assembled matrix."""
PRECONDITIONERS = ("two-level", "tiles", "banded", *BLOCK_PRECONDITIONERS)


@dataclass(frozen=True)
class SolverPlan:
    """Methods of a simulation. The bits of a world depend on the plan, never on the number of worlds.

    Attributes:
        solver: "newton-pcg" or "jacobi".
        linear: "pcg" or "direct".
        krylov: "pcg", or "bicgstab" for the unsymmetric operator of mid-point schemes.
        preconditioner: a name of PRECONDITIONERS; "factors" of a direct solver.
        storage: precision of the preconditioner's inverses.
        half_bandwidth: of banded factors, blocks of 4 unknowns; else 0.
        body_modes: a coarse space of rigid body modes of bodies coupled by terms.
        rebuild_cost: setup cost of the preconditioner in PCG iterations, of the reuse rule.
        operator: H p from the "matrix", from "elements", from "clusters" of elements with their mass, or from elements
            with the "predicted stress".
        matrix_reuse_level: of the operator's matrix: 0 none, 1 over the iterates of a step, 2 also over steps.
        matrix_rebuild_cost: assembly cost of that matrix in Newton iterations.
        factors_operator: every matrix of the operator is factored.
        exact: the solution of exact factors is taken without a product.
        first_forcing: relative residual of the first solve.
        scheme: "dynamics", "statics" or "midpoint".
        dtype: precision of the model.
        on_cuda: a GPU.
    """

    solver: str
    linear: str
    krylov: str
    preconditioner: str
    storage: str
    half_bandwidth: int
    body_modes: bool
    rebuild_cost: float
    operator: str
    matrix_reuse_level: int
    matrix_rebuild_cost: float
    factors_operator: bool
    exact: bool
    first_forcing: float
    scheme: str
    dtype: str
    on_cuda: bool

    @property
    def uses_matrix(self) -> bool:
        """True if H p is a product with the assembled matrix."""
        return self.operator == "matrix"

    @property
    def uses_predicted_stress(self) -> bool:
        """True if H p comes from the elements with the predicted stress in its geometric part."""
        return self.operator == "predicted stress"

    @property
    def reuses_across_steps(self) -> bool:
        """True if a matrix of the operator may serve several steps."""
        return self.matrix_reuse_level == 2

    @property
    def assembles(self) -> bool:
        """True if operator or preconditioner need the assembled matrix."""
        return self.uses_matrix or self.preconditioner not in BLOCK_PRECONDITIONERS

    @property
    def deflates_constraints(self) -> bool:
        """True if the preconditioner lacks the penalties of constraints, which terms then correct."""
        return self.preconditioner not in ("block-jacobi", "banded", "factors")

    @property
    def methods(self) -> dict[str, str]:
        """Names of the methods, as `Simulation.methods`."""
        if self.solver == "jacobi":
            return {"solver": self.solver}
        out = {"solver": self.solver, "linear": self.linear, "operator": "matrix" if self.uses_matrix else "elements"}
        return out if self.linear == "direct" else out | {"preconditioner": self.preconditioner}
