"""Solvers of a step."""

from .newton import NewtonPCG

__all__ = ["NewtonPCG"]
