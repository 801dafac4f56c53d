"""Augmented Lagrangian on the device: evaluation of the constraints, their part of H, and their multipliers.

The classical method solves g(v; lambda) = 0 at fixed lambda, then adds rho c, and so on until |c| <= tol. Here lambda
is updated with every Newton step by rho (c + (dq/dv) J p), which is what the constraint linearised at the iterate makes
of the same formula: Newton's method on the pair (v, lambda), with 1/rho on the diagonal that keeps redundant rows
solvable. The outer loop costs nothing then, and the curvature sum lambda d2c/dq2 is free of rho c. The classical update
is `NewtonPCG(multipliers="outer")`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.launch import labelled
from ..kernels.solvers.deflation import deflation_kernels
from ..kernels.terms.constraints import SUM_ROWS, multiplier_struct

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from .workspace import Workspace

__all__ = ["THREAD_LIMIT", "ConstraintSolver", "allocate"]

THREAD_LIMIT = 16
"""Rows of a cluster up to which one thread inverts its matrix; larger ones take a launch per pivot."""


def allocate(model: Model, work: Workspace) -> Any:
    """Scratch of the multipliers; an empty struct without constraints."""
    mul = multiplier_struct()()
    con = model.constraints
    if con is None:
        return mul
    B, M = model.worlds, con.count
    shapes: dict[str, tuple[tuple[int, ...], Any]] = {
        "rows": ((SUM_ROWS, B, M), wp.float64),
        "gradient": ((B, 3 * M), wp.vec3d),
        "product": ((B, 3 * M), wp.vec3d),
        "violation": ((B, model.component_count), wp.float64),
        "block": ((B, max(con.block_count, 1)), wp.mat33d),
        "matrix": ((B, con.matrix_entries), wp.float64),
        "coupling": ((B, max(con.couple_count, 1)), wp.float64),
    }
    for name, var in multiplier_struct().vars.items():
        if isinstance(var.type, wp.array):
            shape, dtype = shapes.get(name, ((B, M), wp.float64))
            setattr(mul, name, work.array(f"Multipliers.{name}", shape, dtype))
    return mul


class ConstraintSolver:
    """Launches of the constraints of a model within the step loop."""

    def __init__(
        self, model: Model, work: Workspace, launch: Launcher, *, classical: bool, kappa: float, deflate: bool
    ) -> None:
        assert model.constraints is not None
        self.model, self.work, self.launch = model, work, launch
        self.constraints = model.constraints
        self.kernels = self.constraints.kernels
        self.deflation = deflation_kernels(model.dtype)
        self.deflate = deflate
        self.dim = (model.worlds, self.constraints.count)
        work.multipliers.classical = int(classical)
        work.multipliers.kappa = kappa
        sizes = self.constraints.cluster_sizes
        large = np.flatnonzero(sizes > THREAD_LIMIT)
        self.largest = int(sizes[large].max()) if len(large) and deflate else 0
        self.large = model.array("constraints", large, wp.int32) if self.largest else None
        self.large_count = len(large)

    @labelled("constraints")
    def start(self, multipliers: wp.array, travel: wp.array, active: wp.array) -> None:
        """Warm start of an attempt from the state's multipliers and right sides; rho is not known yet."""
        args = [multipliers, travel, active, self.work.multipliers]
        self.launch(self.kernels.load_multipliers, self.dim, args)

    @labelled("constraints")
    def evaluate(self, active: wp.array) -> None:
        """c, J and the augmented potential's rows at work.u."""
        m, w, k = self.model, self.work, self.kernels
        mul = w.multipliers
        self.launch(k.reset_violation, (m.worlds, m.component_count), [active, mul])
        args = [self.constraints.data, w.u, w.law_value, w.newton.alpha, active, mul]
        self.launch(k.evaluate, self.dim, args)

    @labelled("build")
    def build(self, active: wp.array, *, penalty: bool = False) -> None:
        """Matrices of the clusters from the inverse diagonal blocks; `penalty`: set rho from them."""
        m, w, k, launch = self.model, self.work, self.deflation, self.launch
        if not (self.deflate or penalty):
            return
        data, mul = self.constraints.data, w.multipliers
        launch(k.pair_blocks, (m.worlds, self.constraints.block_count), [data, w.inverse, active, mul])
        launch(k.assemble_matrix, self.dim, [data, active, mul])
        launch(k.assemble_coupling, (m.worlds, self.constraints.couple_count), [data, active, mul])
        if penalty:
            launch(k.penalty, self.dim, [data, w.step.dq_dv, active, mul])
        if not self.deflate:
            return
        clusters = len(self.constraints.cluster_sizes)
        launch(k.invert_clusters, (m.worlds, clusters), [data, w.step.dq_dv, THREAD_LIMIT, active, mul])
        for pivot in range(self.largest):
            dim = (m.worlds, self.large_count, self.largest)
            launch(k.eliminate, dim, [data, self.large, pivot, active, mul])
            launch(k.scale_row, dim[:2], [data, self.large, pivot, active, mul])

    def product(self, p: wp.array, active: wp.array) -> None:
        """Terms of the constraints' part of H p, for the gather."""
        w = self.work
        args = [self.constraints.data, w.multipliers, p, w.step.dq_dv, active]
        self.launch(self.kernels.product_terms, self.dim, args)

    @labelled("preconditioner")
    def precondition(self, r: wp.array, z: wp.array, active: wp.array, into: wp.array | None = None) -> None:
        """z -= D^-1 J^T (1/((dq/dv) rho) + J D^-1 J^T)^-1 J z on the slots of constraints, z = D^-1 r; and r.z.

        With `into` the result is added there instead.
        """
        m, w, k, launch = self.model, self.work, self.deflation, self.launch
        data, mul = self.constraints.data, w.multipliers
        launch(k.restrict, self.dim, [data, mul, z, active])
        sizes = self.constraints.colour_sizes
        if len(sizes) == 1:
            launch(k.solve_clusters, self.dim, [data, mul, active])
        else:
            first = np.concatenate([[0], np.cumsum(sizes)])
            for c in range(len(sizes)):
                launch(k.sweep, (m.worlds, int(sizes[c])), [data, mul, int(first[c]), 1, active])
            for c in range(len(sizes) - 2, -1, -1):
                launch(k.sweep, (m.worlds, int(sizes[c])), [data, mul, int(first[c]), 0, active])
        args = [data, mul, w.inverse, r, z, int(into is not None), active, w.warp]
        launch(k.project, (m.worlds, launch.padded(m.slots)), [*args, z if into is None else into, w.warp_rows])

    @labelled("constraints")
    def predict(self, active: wp.array) -> None:
        """The multipliers' part of the Newton step in work.direction."""
        w = self.work
        args = [self.constraints.data, w.multipliers, w.direction, w.newton.quiet, w.step.dq_dv, active]
        self.launch(self.kernels.predict_change, self.dim, args)

    @labelled("constraints")
    def adopt(self, flags: wp.array) -> None:
        """Take over the multipliers of the trial."""
        self.launch(self.kernels.adopt, self.dim, [flags, self.work.multipliers])

    @labelled("constraints")
    def work_terms(self, displacement: wp.array, travel: wp.array, accepted: wp.array) -> None:
        """Work of drives and loss of constraints along an accepted substep, as rows 0 and 1."""
        w = self.work
        args = [self.constraints.data, w.multipliers, w.u, displacement, travel, accepted]
        self.launch(self.kernels.work_terms, self.dim, args)

    @labelled("constraints")
    def commit(self, multipliers: wp.array, travel: wp.array, accepted: wp.array) -> None:
        """Keep multipliers and right sides of an accepted substep."""
        args = [accepted, self.work.multipliers, multipliers, travel]
        self.launch(self.kernels.commit_multipliers, self.dim, args)
