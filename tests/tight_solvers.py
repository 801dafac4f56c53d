"""Solvers of every kind with a tight tolerance, whose results must agree."""

import warpfea as wf

SOLVERS = {
    "matrix": wf.NewtonPCG(operator="matrix", tol=1e-12),
    "elements": wf.NewtonPCG(operator="elements", tol=1e-12),
    "banded": wf.NewtonPCG(preconditioner="banded", tol=1e-12),
    "two-level": wf.NewtonPCG(preconditioner="two-level", tol=1e-12),
    "block-jacobi": wf.NewtonPCG(preconditioner="block-jacobi", tol=1e-12),
    "direct": wf.NewtonPCG(linear="direct", tol=1e-12),
}
