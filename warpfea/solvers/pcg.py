"""Preconditioned conjugate gradients on the operator H, per world, on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from ..base.launch import Launcher, launch_part
from ..kernels.solvers.pcg import FREE_GROUP_LANES, pcg_kernels
from .preconditioner import Preconditioner
from .residual import Residual

if TYPE_CHECKING:
    from ..model.model import Model
    from ..terms.workspace import Workspace

__all__ = ["PCG"]


class PCG:
    """Solve H p = -g in the active worlds.

    A solve begins with the Galerkin solution for the translations of free groups of bodies and ends with the same
    correction: linear momentum is conserved for any tolerance. Nonpositive curvature ends a solve early.
    """

    def __init__(
        self, model: Model, work: Workspace, launch: Launcher, residual: Residual, preconditioner: Preconditioner,
        *, max_iterations: int, max_work: int, deflate: bool,
    ) -> None:  # fmt: skip
        self.model, self.work, self.launch = model, work, launch
        self.residual = residual
        self.preconditioner = preconditioner
        self.kernels = pcg_kernels(model.dtype, model.terms.traits.has_constraints)
        self.dim = (model.worlds, model.slots)
        self.deflate_translations = deflate and model.components.free_group_count > 0
        work.pcg.max_iterations = max_iterations
        work.pcg.max_work = max_work

    @launch_part("vectors")
    def solve(self, active: wp.array) -> None:
        """Solve and write p to work.direction."""
        m, w, k, launch = self.model, self.work, self.kernels, self.launch
        launch(k.initialise_residual, self.dim, [w.gradient, m.topology.free, active, w.direction, w.r])
        if m.components.count > 1:
            launch(k.zero_converged, self.dim, [w.newton, m.components.of_slot_array, active, w.r])
        self.correct_translations(active)
        self._precondition(w.r, w.z, active)
        w.pcg.any_active.zero_()
        self._run()
        self.correct_translations(active)

    def modules(self) -> set[wp.Module]:
        """Modules launched, except those of operator and preconditioner."""
        return {self.kernels.module}

    def _run(self) -> None:
        """Iterate from r and z = B r."""
        m, w, k, launch = self.model, self.work, self.kernels, self.launch
        launch(k.begin_solve, m.worlds, [w.newton, w.pcg])
        launch(k.first_direction, self.dim, [w.pcg, w.z, w.p, w.direction])
        wp.capture_while(w.pcg.any_active, self._iterate)

    def _iterate(self) -> None:
        w, k, launch = self.work, self.kernels, self.launch
        active = w.pcg.active
        self.residual.product(w.p, w.Hp, active)
        self.residual.reduce(self.residual.curvature_rows, 1, active, w.pcg.curvature)
        launch(k.update_solution, self.dim, [w.pcg, w.p, w.Hp, w.direction, w.r])
        self._precondition(w.r, w.z, active)
        launch(k.new_direction, self.dim, [w.pcg, w.z, w.p])

    def _precondition(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z = B r; r.z and r.D^-1 r in pcg.sums."""
        w = self.work
        self.preconditioner.apply(r, z, active)
        self.residual.reduce(w.warp_rows, 2, active, w.pcg.sums)

    def correct_translations(self, active: wp.array) -> None:
        """Galerkin correction for the translations Z of free groups: x += Z (Z^T H Z)^-1 Z^T r, r updated."""
        if not self.deflate_translations:
            return
        m, w, k, launch = self.model, self.work, self.kernels, self.launch
        groups, mass, dim = m.components.free_groups, w.step.mass_factor, (m.worlds, m.components.free_group_count)
        launch(k.free_group_partials, (*dim, FREE_GROUP_LANES), [groups, w.r, active, w.group_partial])
        launch(k.group_velocity, dim, [groups, w.group_partial, mass, active, w.group_velocity])
        args = [groups, w.group_velocity, m.topology.free, mass, active, w.direction, w.r]
        launch(k.translate_groups, self.dim, args)
