"""Direct solver: sparse factorisation of H as a PCG preconditioner (one iteration if exact).

The factorised matrix is the full H of PCG: c_M M + (dq/dv) K of the elements, J^T rho J and the curvature sum lambda
d2c/dq2 of the constraints, and the symmetric tangents of follower loads. PCG measures the residual with its own
operator, so an inaccurate factorisation is refined, and PCG's rules for indefinite matrices hold. If H is singular, or
indefinite with r.H^-1 r < 0, the matrix made positive at each quadrature point is factorised instead, and PCG ends at a
direction of negative curvature.

Without constraints and follower loads the factors are reused with the operator's matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..base.launch import launch_part
from ..kernels.solvers.direct import direct_kernels
from ..terms.protocols import Preconditioned
from .factor import SingularMatrix, make_factors
from .preconditioner import Preconditioner

if TYPE_CHECKING:
    from ..terms.term import StepContext
    from .residual import Residual

__all__ = ["DirectSolver"]


class DirectSolver(Preconditioner):
    """Preconditioner by sparse factors, see the module; on the host: a step can't be captured as a graph.

    Attributes:
        unverified_worlds: worlds whose new factors have not been used yet: the first solve checks r.H^-1 r >= 0.
        singular_worlds: worlds whose last factorisation failed.
    """

    def __init__(self, ctx: StepContext, residual: Residual) -> None:
        model = ctx.model
        self.ctx, self.model, self.work, self.launch, self.residual = ctx, model, ctx.work, ctx.launch, residual
        ctx.work.allocate_diagonal_blocks()
        assert residual.assembler is not None
        self.assembler = residual.assembler
        self.kernels = direct_kernels(model.dtype)
        self.dim = (model.worlds, ctx.launch.padded(model.slots))
        self.factors = make_factors(model, self.assembler.pattern.graph)
        for term in model.terms.having(Preconditioned):
            term.allocate_blocks(ctx, self.assembler, projected=False)
        self.matrix_storage: wp.array | None = None
        self.unverified_worlds: set[int] = set()
        self.singular_worlds: set[int] = set()

    def modules(self) -> set[wp.Module]:
        """Modules launched."""
        return {self.kernels.module} | self.assembler.modules()

    @launch_part("build")
    def start(self, active: wp.array, *, rebuild: bool = False) -> None:
        """Compute D and the inverses of its blocks."""
        self.residual.diagonal_blocks(active)

    @property
    def matrix(self) -> wp.array:
        """Array of the matrix H, allocated on first use."""
        if self.matrix_storage is None:
            self.matrix_storage = self.assembler.allocate_values("direct matrix")
        return self.matrix_storage

    @launch_part("build")
    def prepare(self, active: wp.array) -> None:
        """Factorise H in the active worlds."""
        residual = self.residual
        own = residual.plan.factors_operator
        kept = own and residual.plan.matrix_reuse_level
        worlds = np.flatnonzero((residual.matrix_reuse_rule.control.build_now if kept else active).numpy())
        if not len(worlds):
            return
        if own:
            value = residual.operator_matrix
        else:
            value = self.matrix
            self._assemble(active, value, projected=False)
        for world in worlds:
            self._factorise(int(world), value)

    def _assemble(self, flags: wp.array, value: wp.array, *, projected: bool) -> None:
        """Assemble H or, with `projected`, its positive definite approximation."""
        w = self.work
        self.assembler.assemble(w.stage, w.step.mass_factor, flags, value, projected=projected)
        for term in self.model.terms.having(Preconditioned):
            live = [array for _, array in term.cached_inputs(self.ctx)]
            term.blocks(self.ctx, self.assembler, live, w.step.dq_dv, flags, value, projected=projected)

    def _factorise(self, world: int, value: wp.array) -> None:
        self.singular_worlds.discard(world)
        self.unverified_worlds.add(world)
        try:
            self.factors.factorise(value, world)
        except SingularMatrix:
            self._factorise_projected(world)

    def _factorise_projected(self, world: int) -> None:
        """Factorise the positive definite approximation."""
        self.unverified_worlds.discard(world)
        flags = np.zeros(self.model.worlds, dtype=np.int32)
        flags[world] = 1
        self._assemble(wp.array(flags, dtype=wp.int32, device=self.model.device), self.matrix, projected=True)
        try:
            self.factors.factorise(self.matrix, world)
        except SingularMatrix:
            self.singular_worlds.add(world)

    @launch_part("preconditioner")
    def apply(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z = H^-1 r; partial sums of r.z and r.D^-1 r."""
        w = self.work
        for world in map(int, np.flatnonzero(active.numpy())):
            if not self._solve(r, z, world):
                z[world].zero_()
        self.launch(self.kernels.dot_partials, self.dim, [r, z, w.diagonal, active, w.warp_size, w.warp_rows])

    def _solve(self, r: wp.array, z: wp.array, world: int) -> bool:
        """Solve in one world. False if the factorisation failed; the first solve verifies it (r.z >= 0)."""
        if world in self.singular_worlds:
            return False
        r_dot_z = self.factors.solve(r, z, world)
        if world in self.unverified_worlds and not r_dot_z >= 0.0:
            self._factorise_projected(world)
            if world in self.singular_worlds:
                return False
            r_dot_z = self.factors.solve(r, z, world)
        self.unverified_worlds.discard(world)
        if not np.isfinite(r_dot_z):
            self.singular_worlds.add(world)
        return bool(np.isfinite(r_dot_z))
