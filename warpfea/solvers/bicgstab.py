"""BiCGStab on an unsymmetric operator H, per world, on the device."""

from __future__ import annotations

from typing import Any

import warp as wp

from ..kernels.solvers.bicgstab import BICGSTAB_ROWS, bicgstab_kernels, bicgstab_struct
from .pcg import PCG

__all__ = ["BiCGStab"]


class BiCGStab(PCG):
    """Solve H p = -g in the active worlds for unsymmetric H, preconditioned by its symmetric part.

    One iteration takes two products and two preconditioner applications. Translations of free groups are deflated as in
    `PCG`: this operator has no stiffness along them either.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        m, w = self.model, self.work
        self.bicgstab_kernels = bicgstab_kernels(m.dtype, m.terms.traits.has_constraints)
        self.control = w.struct(bicgstab_struct(), m.worlds, sums=(BICGSTAB_ROWS, m.worlds), any_restart_requested=(1,))
        field = (m.worlds, m.slots), m.types.vec3
        self.shadow_residual, self.y, self.t = (w.array(f"bicgstab {name}", *field) for name in ("shadow", "y", "t"))
        self.best_iterate = [w.array(f"bicgstab best {name}", *field) for name in ("x", "r")]

    def modules(self) -> set[wp.Module]:
        return super().modules() | {self.bicgstab_kernels.module}

    def _run(self) -> None:
        w, k, launch, bi = self.work, self.bicgstab_kernels, self.launch, self.control
        launch(k.begin_solve, self.model.worlds, [w.newton, w.pcg, bi])
        self._run_recurrence()
        bi.any_restart_requested.zero_()
        launch(k.request_restarts, self.model.worlds, [w.newton, w.pcg, bi, 1])
        with launch.rare():
            wp.capture_if(bi.any_restart_requested, self._restart)

    def _restart(self) -> None:
        """Restart a stalled solve from its best iterate."""
        w, k, launch, bi = self.work, self.bicgstab_kernels, self.launch, self.control
        self._precondition(w.r, w.z, bi.restart_requested)
        w.pcg.any_active.zero_()
        launch(k.restart, self.model.worlds, [w.newton, w.pcg, bi])
        self._run_recurrence()
        launch(k.request_restarts, self.model.worlds, [w.newton, w.pcg, bi, 0])

    def _run_recurrence(self) -> None:
        """Iterate from r and z = B r; keep the best iterate."""
        w, k, launch = self.work, self.bicgstab_kernels, self.launch
        launch(
            k.first_direction, self.dim, [w.pcg, w.z, w.r, w.direction, self.shadow_residual, w.p, *self.best_iterate]
        )
        wp.capture_while(w.pcg.any_active, self._iterate)
        launch(k.restore_best_iterate, self.dim, [w.newton, w.pcg, self.control, *self.best_iterate, w.direction, w.r])

    def _iterate(self) -> None:
        w, k, launch, bi = self.work, self.bicgstab_kernels, self.launch, self.control
        m, active, reduce = self.model, w.pcg.active, self.residual.reduce
        self._precondition(w.p, self.y, active)
        self.residual.product(self.y, w.Hp, active)
        launch(self.residual.vector_kernels.dot_terms, self.dim, [self.shadow_residual, w.Hp, active, w.rows])
        reduce(w.rows, 1, active, bi.sums)
        launch(k.compute_alpha, m.worlds, [w.pcg, bi])
        launch(k.half_step, self.dim, [w.pcg, bi, self.y, w.Hp, w.direction, w.r])
        self._precondition(w.r, w.z, active)
        launch(k.check_half_step, m.worlds, [w.pcg, bi])
        self.residual.product(w.z, self.t, active)
        launch(k.second_dot_terms, self.dim, [w.pcg, w.diagonal, w.r, self.t, self.shadow_residual, w.rows])
        reduce(w.rows, BICGSTAB_ROWS, active, bi.sums)
        launch(k.compute_omega, m.worlds, [w.pcg, bi])
        launch(k.full_step, self.dim, [w.pcg, bi, w.z, self.t, w.Hp, w.direction, w.r, w.p, *self.best_iterate])
        launch(k.deactivate_finished, m.worlds, [w.pcg, bi])
