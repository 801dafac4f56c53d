"""Base class of preconditioners, and block Jacobi."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from ..base.launch import launch_part
from ..kernels.solvers.pcg import pcg_kernels
from ..terms.protocols import Constrained
from .residual import Residual

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..model.state import State
    from ..terms.workspace import Workspace

__all__ = ["BlockJacobi", "Preconditioner"]


class Preconditioner:
    """A preconditioner B ~ H^-1; by default without a history and without data beside D and its inverses.

    Attributes:
        follows_iterates: `start` is called at every iterate, not at the first of an attempt alone.
    """

    follows_iterates = False

    def register(self, state: State) -> None:
        """Register the data kept between steps in the state."""

    def invalidate(self, flags: wp.array) -> None:
        """Invalidate history of worlds whose state was set externally."""

    def modules(self) -> set[wp.Module]:
        """Modules launched."""
        raise NotImplementedError

    def start(self, active: wp.array, *, rebuild: bool = False) -> None:
        """Compute work.diagonal and work.inverse at an iterate; `rebuild`: without reuse."""
        raise NotImplementedError

    def store_history(self, accepted: wp.array) -> None:
        """Store history after acceptance of the attempt."""

    def prepare(self, active: wp.array) -> None:
        """Compute the data of `apply` before a linear solve."""

    def record_cost(self) -> None:
        """After a linear solve: record its iteration count for the reuse rule."""

    def apply(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z = B r; per slot r.z in rows[0] and r.D^-1 r in rows[1]."""
        raise NotImplementedError


class BlockJacobi(Preconditioner):
    """3x3 diagonal blocks of H, made positive at each quadrature point."""

    follows_iterates = True

    def __init__(self, model: Model, work: Workspace, launch: Launcher, residual: Residual) -> None:
        self.work, self.launch, self.residual = work, launch, residual
        work.allocate_diagonal_blocks()
        self.kernels = pcg_kernels(model.dtype, model.terms.traits.has_constraints)
        self.dim = (model.worlds, launch.padded(model.slots))

    def modules(self) -> set[wp.Module]:
        """Module of the PCG kernel launched here."""
        return {self.kernels.module}

    @launch_part("build")
    def start(self, active: wp.array, *, rebuild: bool = False) -> None:
        """Assemble and invert the blocks."""
        self.residual.diagonal_blocks(active)

    @launch_part("preconditioner")
    def apply(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z = D^-1 r, with constraints (D + (dq/dv) J^T rho J)^-1 r."""
        w, ctx = self.work, self.residual.ctx
        args = [w.inverse, r, w.diagonal, active, w.warp_size, z, w.warp_rows]
        self.launch(self.kernels.apply_block_jacobi, self.dim, args)
        for term in self.residual.terms.having(Constrained) if ctx.options.deflate_constraints else ():
            term.precondition(ctx, r, z, active)
