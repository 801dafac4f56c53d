"""BiCGStab (van der Vorst 1992) on H p = -g with an unsymmetric H, right-preconditioned, per world.

With r^ = B r_0 its first half is a step of conjugate gradients if H is symmetric; the second minimises the D^-1 norm of
the residual, the norm of Newton's convergence test. Vector kernels run over [world, slot]; scalar logic runs with one
thread per world. The control of the conjugate gradients is shared: sums[0] is r.B r of the vector last preconditioned,
sums[1] r.D^-1 r; `active` is 2 where products use the stress at the start of the step.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_3d, f64, precision
from .newton_control import control_struct
from .pcg import forcing_functions, pcg_struct

__all__ = ["BICGSTAB_ROWS", "bicgstab_kernels", "bicgstab_struct"]

BICGSTAB_ROWS = 4
"""Rows of `second_dot_terms`."""
START_STRESS_RESIDUAL, START_STRESS_TOL = 0.1, 1.0e-8
"""Relative residual above which the stress of an iterate is unreliable: a rotation error delta strains a stiff body by
delta^2, and E delta^2 spoils the geometric stiffness. Products then use the stress at the start of the step, and solves
go to START_STRESS_TOL, as the residual of a rotation is small beside that of strains."""
MAX_STALLED_ITERATIONS = 50
"""Iterations without halving the best residual after which a solve ends with the best: later residuals may grow."""
ESTIMATE_RESIDUAL = 0.1
"""Largest final relative residual of a solve that yields an error estimate."""
ESTIMATE_TOL = 1.0e-6
"""Relative residual of solves for error estimates."""


@functools.cache
def bicgstab_struct():
    """Scalars of the recursion, per world."""

    @wp.struct
    class BiCGStab:
        rho: wp.array(dtype=wp.float64)  # r^.r
        alpha: wp.array(dtype=wp.float64)
        beta: wp.array(dtype=wp.float64)
        omega: wp.array(dtype=wp.float64)
        best_norm: wp.array(dtype=wp.float64)  # smallest D^-1 norm of the residual so far
        halved_norm: wp.array(dtype=wp.float64)  # norm at its last halving, and the iterations since
        stalled_iterations: wp.array(dtype=wp.int32)
        restart_requested: wp.array(dtype=wp.int32)  # 1: the solve stalled and restarts once from its best iterate
        any_restart_requested: wp.array(dtype=wp.int32)  # [1]
        unfinished: wp.array(dtype=wp.int32)  # 1: the solve continues after this iteration
        sums: wp.array2d(dtype=wp.float64)  # [BICGSTAB_ROWS, world]; after the first product r^.v alone

    return BiCGStab


@functools.cache
def bicgstab_kernels(dtype: str, has_constraints: bool = False) -> KernelSet:
    """Kernels in one precision; `has_constraints`: with constraints, see Traits."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    Newton, Control, Recursion = control_struct(), pcg_struct(), bicgstab_struct()
    forcing = forcing_functions(has_constraints)
    module = kernel_module(f"bicgstab_{dtype}{'_gated' if has_constraints else ''}")

    @wp.func
    def has_iterations_left(ctl: Control, world: int) -> bool:
        """True if iterations are left, of the solve and of the step."""
        return ctl.iterations[world] < ctl.max_iterations and ctl.step_iterations[world] < ctl.max_work

    @wp.kernel(module=module)
    def begin_solve(newton: Newton, ctl: Control, bi: Recursion):
        """Set the target norm of the solve: Eisenstat and Walker, but no tighter than Newton's method needs."""
        world = wp.tid()
        ctl.active[world] = 0
        if newton.active[world] == 0:
            return
        norm = wp.sqrt(ctl.sums[1, world])
        ctl.norm[world] = norm
        ctl.first_norm[world] = norm
        ctl.iterations[world] = 0
        ctl.negative_curvature[world] = 0
        bi.rho[world] = ctl.sums[0, world]
        bi.best_norm[world] = norm
        bi.halved_norm[world] = norm
        bi.stalled_iterations[world] = 0
        ctl.target_norm[world] = forcing.forcing_target(newton, world, norm)
        if newton.floor.estimate_error[world] != 0:
            ctl.target_norm[world] = f64(ESTIMATE_TOL) * norm
        elif newton.norms.relative_residual[world] > f64(START_STRESS_RESIDUAL) and newton.solve.fixed_forcing == 0:
            ctl.target_norm[world] = wp.max(f64(START_STRESS_TOL) * norm, forcing.min_target_norm(newton, world))
        if norm > ctl.target_norm[world] and ctl.max_iterations > 0 and wp.isfinite(norm) and bi.rho[world] != f64(0.0):
            ctl.active[world] = wp.where(newton.norms.relative_residual[world] > f64(START_STRESS_RESIDUAL), 2, 1)
            wp.atomic_max(ctl.any_active, 0, 1)
        elif newton.floor.estimate_error[world] != 0:
            ctl.negative_curvature[world] = 1  # no error estimate

    @masked_kernel(module, "ctl.active")
    def first_direction(
        ctl: Control, z: p.vec3_2d, r: p.vec3_2d, x: p.vec3_2d, shadow: p.vec3_2d, p_out: p.vec3_2d, best_x: p.vec3_2d,
        best_r: p.vec3_2d,
    ):  # fmt: skip
        """r^ = B r, p = r; the start is the initial best."""
        world, slot = wp.tid()
        shadow[world, slot] = z[world, slot]
        p_out[world, slot] = r[world, slot]
        best_x[world, slot] = x[world, slot]
        best_r[world, slot] = r[world, slot]

    @wp.kernel(module=module)
    def compute_alpha(ctl: Control, bi: Recursion):
        """alpha = rho / r^.v, v = H y; the solve ends on breakdown."""
        world = wp.tid()
        if world == 0:
            ctl.any_active[0] = 0
        if ctl.active[world] == 0:
            return
        ctl.iterations[world] = ctl.iterations[world] + 1
        ctl.step_iterations[world] = ctl.step_iterations[world] + 1
        alpha = bi.rho[world] / bi.sums[0, world]
        bi.alpha[world] = alpha
        if not wp.isfinite(alpha):
            ctl.active[world] = 0
            if ctl.iterations[world] == 1:
                ctl.negative_curvature[world] = 1

    @masked_kernel(module, "ctl.active")
    def half_step(ctl: Control, bi: Recursion, y: p.vec3_2d, v: p.vec3_2d, x: p.vec3_2d, r: p.vec3_2d):
        """x += alpha y, r -= alpha v."""
        world, slot = wp.tid()
        alpha = T(bi.alpha[world])
        x[world, slot] = x[world, slot] + alpha * y[world, slot]
        r[world, slot] = r[world, slot] - alpha * v[world, slot]

    @masked_kernel(module, "ctl.active")
    def check_half_step(ctl: Control, bi: Recursion):
        """End the solve if the half step has reached the target."""
        world = wp.tid()
        norm = wp.sqrt(ctl.sums[1, world])
        ctl.norm[world] = norm
        if not norm > ctl.target_norm[world]:
            bi.best_norm[world] = norm
            ctl.active[world] = 0

    @masked_kernel(module, "ctl.active")
    def second_dot_terms(
        ctl: Control, diagonal: p.vec3_2d, r: p.vec3_2d, t: p.vec3_2d, shadow: p.vec3_2d, rows: double_3d
    ):
        """t.D^-1 r, t.D^-1 t, r^.r, r^.t per slot."""
        world, slot = wp.tid()
        a = t[world, slot]
        b = wp.cw_div(a, diagonal[world, slot])
        rows[0, world, slot] = f64(wp.dot(b, r[world, slot]))
        rows[1, world, slot] = f64(wp.dot(b, a))
        rows[2, world, slot] = f64(wp.dot(shadow[world, slot], r[world, slot]))
        rows[3, world, slot] = f64(wp.dot(shadow[world, slot], a))

    @masked_kernel(module, "ctl.active")
    def compute_omega(ctl: Control, bi: Recursion):
        """omega = argmin |r - omega t|, beta of the next direction, and the decision to continue."""
        world = wp.tid()
        along = bi.sums[0, world]
        omega = along / bi.sums[1, world]
        if not wp.isfinite(omega):
            omega = f64(0.0)
        rho = bi.sums[2, world] - omega * bi.sums[3, world]
        beta = (rho / bi.rho[world]) * (bi.alpha[world] / omega)
        norm = wp.sqrt(wp.max(ctl.sums[1, world] - omega * along, f64(0.0)))
        ctl.norm[world] = norm
        bi.omega[world] = omega
        bi.beta[world] = beta
        bi.rho[world] = rho
        if norm < bi.best_norm[world]:
            bi.best_norm[world] = norm
        bi.stalled_iterations[world] = bi.stalled_iterations[world] + 1
        if norm <= f64(0.5) * bi.halved_norm[world]:
            bi.halved_norm[world] = norm
            bi.stalled_iterations[world] = 0
        more = norm > ctl.target_norm[world] and has_iterations_left(ctl, world)
        more = more and bi.stalled_iterations[world] < MAX_STALLED_ITERATIONS
        if more and wp.isfinite(beta) and wp.isfinite(norm) and rho != f64(0.0):
            bi.unfinished[world] = 1
            wp.atomic_max(ctl.any_active, 0, 1)
        else:
            bi.unfinished[world] = 0

    @masked_kernel(module, "ctl.active")
    def full_step(
        ctl: Control, bi: Recursion, z: p.vec3_2d, t: p.vec3_2d, v: p.vec3_2d, x: p.vec3_2d, r: p.vec3_2d,
        p_out: p.vec3_2d, best_x: p.vec3_2d, best_r: p.vec3_2d,
    ):  # fmt: skip
        """x += omega z, r -= omega t, p = r + beta (p - omega v) while the solve continues."""
        world, slot = wp.tid()
        omega = T(bi.omega[world])
        place = x[world, slot] + omega * z[world, slot]
        new = r[world, slot] - omega * t[world, slot]
        x[world, slot] = place
        r[world, slot] = new
        if ctl.norm[world] == bi.best_norm[world]:
            best_x[world, slot] = place
            best_r[world, slot] = new
        if bi.unfinished[world] != 0:
            p_out[world, slot] = new + T(bi.beta[world]) * (p_out[world, slot] - omega * v[world, slot])

    @wp.kernel(module=module)
    def deactivate_finished(ctl: Control, bi: Recursion):
        """Deactivate finished worlds."""
        world = wp.tid()
        if bi.unfinished[world] == 0:
            ctl.active[world] = 0

    @wp.kernel(module=module)
    def request_restarts(newton: Newton, ctl: Control, bi: Recursion, first: int):
        """Mark the worlds that restart; `first`: a restart is allowed."""
        world = wp.tid()
        bi.restart_requested[world] = 0
        if newton.active[world] == 0 or ctl.iterations[world] == 0:
            return
        if not ctl.norm[world] <= bi.best_norm[world]:
            ctl.norm[world] = bi.best_norm[world]
        if first != 0 and ctl.norm[world] > ctl.target_norm[world] and has_iterations_left(ctl, world):
            bi.restart_requested[world] = 1
            wp.atomic_max(bi.any_restart_requested, 0, 1)
        elif (
            newton.floor.estimate_error[world] != 0
            and not ctl.norm[world] <= f64(ESTIMATE_RESIDUAL) * ctl.first_norm[world]
        ):
            ctl.negative_curvature[world] = 1

    @wp.kernel(module=module)
    def restart(newton: Newton, ctl: Control, bi: Recursion):
        """Restart: r^ = B r with r of the best iterate."""
        world = wp.tid()
        if bi.restart_requested[world] != 0 and ctl.sums[0, world] != f64(0.0) and wp.isfinite(ctl.sums[0, world]):
            bi.rho[world] = ctl.sums[0, world]
            bi.halved_norm[world] = bi.best_norm[world]
            bi.stalled_iterations[world] = 0
            ctl.active[world] = wp.where(newton.norms.relative_residual[world] > f64(START_STRESS_RESIDUAL), 2, 1)
            wp.atomic_max(ctl.any_active, 0, 1)

    @wp.kernel(module=module)
    def restore_best_iterate(
        newton: Newton, ctl: Control, bi: Recursion, best_x: p.vec3_2d, best_r: p.vec3_2d, x: p.vec3_2d, r: p.vec3_2d
    ):
        """x and r of the smallest residual."""
        world, slot = wp.tid()
        if newton.active[world] == 0 or ctl.iterations[world] == 0:
            return  # no best iterate yet
        if not ctl.norm[world] <= bi.best_norm[world]:
            x[world, slot] = best_x[world, slot]
            r[world, slot] = best_r[world, slot]

    return kernel_set(locals())
