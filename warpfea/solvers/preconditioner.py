"""Preconditioners behind one seam: `build` at an iterate, `apply` z = B r with r.z per slot."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import warp as wp

from ..errors import ModelError
from ..kernels.pcg import pcg_kernels
from ..launch import labelled
from .residual import Residual

if TYPE_CHECKING:
    from ..launch import Launcher
    from ..model import Model
    from ..workspace import Workspace

__all__ = ["BlockJacobi", "Preconditioner", "make"]


class Preconditioner(Protocol):
    """What PCG asks of a preconditioner."""

    def build(self, active: wp.array) -> None:
        """Follow the iterate."""

    def apply(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z = B r, and r.z per slot in rows[0]."""


class BlockJacobi:
    """The 3x3 diagonal blocks of H, made positive at each quadrature point."""

    def __init__(self, model: Model, work: Workspace, launch: Launcher, residual: Residual) -> None:
        self.work, self.launch, self.residual = work, launch, residual
        self.kernels = pcg_kernels(model.dtype, model.constraints is not None)
        self.dim = (model.worlds, model.slots)

    @labelled("build")
    def build(self, active: wp.array) -> None:
        """Assemble and invert the blocks."""
        self.residual.blocks(active)

    @labelled("preconditioner")
    def apply(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z = D^-1 r, with constraints (D + (dq/dv) J^T rho J)^-1 r."""
        self.launch(self.kernels.block_jacobi, self.dim, [self.work.inverse, r, active, z, self.work.rows])
        constraints = self.residual.constraints
        if constraints is not None and constraints.deflate:
            constraints.precondition(r, z, active)


def make(name: str, model: Model, work: Workspace, launch: Launcher, residual: Residual) -> Preconditioner:
    """The preconditioner `name`; "auto" is the best there is. Raises ModelError listing the names."""
    if name in ("auto", "block-jacobi"):
        return BlockJacobi(model, work, launch, residual)
    raise ModelError(f"preconditioner {name!r} is unknown; there are auto, block-jacobi")
