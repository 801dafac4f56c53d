"""Accelerated descent with a fixed preconditioner B: v += p, with p a combination of B r and of the last moves.

Pairs (s, y) of the last moves are stored: s = v' - v and the change y = r - r' of the residual r = -g, equal to H s for
constant H. One thread per slot, or one per world for the small systems. See warpfea/solvers/jacobi.py.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.traits import Traits
from ..common.types import double_1d, double_3d, f64, int_1d, precision
from .convergence import convergence_functions
from .newton_control import Failure, control_struct
from .pcg import pcg_struct

__all__ = ["MAX_PAIRS", "jacobi_kernels", "jacobi_struct"]

MAX_PAIRS = 4
"""Number of stored moves: 1 and 3 to 5 were tried, and beyond 3 the number hardly matters."""
DEPENDENT_PIVOT_RATIO = 1.0e-10
"""Pivot of the Gram matrix over its diagonal below which a move depends linearly on the others."""


@functools.cache
def jacobi_struct():
    """Scalars of the acceleration, per world."""

    @wp.struct
    class JacobiControl:
        gram_matrix: wp.array3d(dtype=wp.float64)  # [world, pair, pair] s_i . y_j
        gram_factor: wp.array3d(dtype=wp.float64)  # [world, pair, pair] its Cholesky factor, newest pair first
        right_side: wp.array2d(dtype=wp.float64)  # [world, pair] of the Gram system, newest first
        gamma: wp.array2d(dtype=wp.float64)  # [world, pair] coefficient of each pair in the move
        sums: wp.array2d(dtype=wp.float64)  # [2 MAX_PAIRS, world] of the rows of `store_pair`: s_j.y, then s_j.r
        first_norm: wp.array(dtype=wp.float64)  # |g| at the start of the attempt
        chebyshev_rho: wp.array(dtype=wp.float64)  # of the Chebyshev recursion
        max_growth: wp.float64  # largest |g| over that of the start; beyond it a step is rejected
        max_violation: wp.float64  # m, largest constraint violation; beyond it a step is rejected
        step_length: wp.float64  # factor of B r
        eigenvalue_centre: wp.float64  # of the interval of eigenvalues of B H in the Chebyshev recursion
        eigenvalue_half_width: wp.float64  # of the same interval

    return JacobiControl


@functools.cache
def jacobi_kernels(dtype: str, traits: Traits, acceleration: str) -> KernelSet:
    """Kernels for one precision, the traits of a model's terms, and one acceleration."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    Newton, PCG, Jacobi = control_struct(), pcg_struct(), jacobi_struct()
    convergence = convergence_functions(traits)
    paired = acceleration in ("secants", "anderson")
    module = kernel_module(f"jacobi_{dtype}_{acceleration}{traits.suffix('stored', 'has_constraints', 'limited')}")

    @wp.func
    def check_convergence(ctl: Newton, jac: Jacobi, world: int):
        """End a world's iterations on convergence, failure or at the iteration limit."""
        convergence.record_residual(ctl, world)
        finite = wp.isfinite(ctl.norms.residual_norm[world]) and wp.isfinite(ctl.elem_sums[0, world])
        if wp.static(traits.stored):
            finite = finite and wp.isfinite(ctl.term_sums[0, world])
        barred = False
        if wp.static(traits.limited):
            barred = ctl.iterations[world] > 0 and not ctl.search.limit[world] > f64(0.0)
        if ctl.domain_J[world] <= f64(0.0):
            ctl.active[world] = 0
            ctl.failed[world] = Failure.JACOBIAN
        elif not finite:
            ctl.active[world] = 0
            ctl.failed[world] = Failure.NAN
        elif barred:
            ctl.active[world] = 0
            ctl.failed[world] = Failure.STEP_LIMIT
        elif ctl.norms.ratio[world] <= f64(1.0):
            convergence.accept_iterate(ctl, world)
        elif ctl.iterations[world] >= ctl.max_iterations:
            ctl.active[world] = 0
            if ctl.norms.residual_norm[world] > jac.max_growth * jac.first_norm[world]:
                ctl.failed[world] = Failure.RESIDUAL_GROWTH
            if wp.static(traits.has_constraints):
                if (
                    ctl.norms.violation_ratio[world]
                    * convergence.allowed_violation(ctl, world, ctl.norms.constraint_tol)
                    > jac.max_violation
                ):
                    ctl.failed[world] = Failure.CONSTRAINT
            if ctl.failed[world] == 0:
                ctl.floor.accepted_unconverged[world] = 1
                convergence.accept_iterate(ctl, world)

    @masked_kernel(module, "ctl.active")
    def begin_iteration(ctl: Newton, jac: Jacobi):
        """Evaluate the norms of the first iterate and test convergence."""
        world = wp.tid()
        convergence.evaluate_norms(ctl, world)
        jac.first_norm[world] = ctl.norms.residual_norm[world]
        ctl.search.alpha[world] = f64(1.0)
        check_convergence(ctl, jac, world)

    @masked_kernel(module, "ctl.active")
    def check_iterate(ctl: Newton, jac: Jacobi):
        """Evaluate the norms of an iterate, count it, and test convergence."""
        world = wp.tid()
        convergence.evaluate_norms(ctl, world)
        ctl.iterations[world] = ctl.iterations[world] + 1
        ctl.step_iterations[world] = ctl.step_iterations[world] + 1
        check_convergence(ctl, jac, world)

    @wp.func
    def history_index(k: int, age: int) -> int:
        """Index of the pair of `age` moves ago at iteration k, in a ring buffer."""
        return (k - 1 - age) % MAX_PAIRS

    @masked_kernel(module, "ctl.active")
    def store_pair(
        ctl: Newton, gradient: p.vec3_2d, free: p.vec3_1d, move: p.vec3_2d, before: p.vec3_2d, r: p.vec3_2d,
        s: p.vec3_3d, y: p.vec3_3d, rows: double_3d,
    ):  # fmt: skip
        """r = -g on the free components; store the newest pair; rows: s_j.y and s_j.r of all pairs."""
        world, slot = wp.tid()
        new = -wp.cw_mul(gradient[world, slot], free[slot])
        r[world, slot] = new
        if wp.static(not paired):
            return
        k = ctl.iterations[world]
        change = vec3()
        if k > 0:
            at = history_index(k, 0)
            change = before[world, slot] - new
            s[at, world, slot] = move[world, slot]
            y[at, world, slot] = change
        before[world, slot] = new
        for j in range(MAX_PAIRS):
            w = vec3()
            if j < k:
                w = s[j, world, slot]
            rows[j, world, slot] = f64(wp.dot(w, change))
            rows[MAX_PAIRS + j, world, slot] = f64(wp.dot(w, new))

    @wp.func
    def substitute(jac: Jacobi, world: int, k: int, count: int, add: f64):
        """gamma = add gamma + G^-1 right with the Cholesky factor of G; dependent pairs, of pivot 0, are omitted."""
        for i in range(count):
            v = jac.right_side[world, i]
            for j in range(i):
                v -= jac.gram_factor[world, i, j] * jac.right_side[world, j]
            if jac.gram_factor[world, i, i] > f64(0.0):
                jac.right_side[world, i] = v / jac.gram_factor[world, i, i]
            else:
                jac.right_side[world, i] = f64(0.0)
        for m in range(count):
            i = count - 1 - m
            v = jac.right_side[world, i]
            for j in range(i + 1, count):
                v -= jac.gram_factor[world, j, i] * jac.right_side[world, j]
            if jac.gram_factor[world, i, i] > f64(0.0):
                v = v / jac.gram_factor[world, i, i]
            else:
                v = f64(0.0)
            jac.right_side[world, i] = v
            at = history_index(k, i)
            jac.gamma[world, at] = add * jac.gamma[world, at] + v

    @masked_kernel(module, "ctl.active")
    def chebyshev_coefficients(ctl: Newton, jac: Jacobi):
        """Factors gamma of the last move and of z in the Chebyshev iteration for eigenvalues in centre -+ half."""
        world = wp.tid()
        ratio = jac.eigenvalue_centre / jac.eigenvalue_half_width
        if ctl.iterations[world] == 0:
            jac.chebyshev_rho[world] = f64(1.0) / ratio
            jac.gamma[world, 0] = f64(0.0)
            jac.gamma[world, 1] = f64(1.0) / jac.eigenvalue_centre
        else:
            new = f64(1.0) / (f64(2.0) * ratio - jac.chebyshev_rho[world])
            jac.gamma[world, 0] = new * jac.chebyshev_rho[world]
            jac.gamma[world, 1] = f64(2.0) * new / jac.eigenvalue_half_width
            jac.chebyshev_rho[world] = new

    @masked_kernel(module, "ctl.active")
    def solve_gram(ctl: Newton, jac: Jacobi):
        """Coefficient gamma of each pair in the move: G gamma = S^T r, G = S^T Y, by Cholesky with the newest pair
        first."""
        world = wp.tid()
        k = ctl.iterations[world]
        for j in range(MAX_PAIRS):
            jac.gamma[world, j] = f64(0.0)
        count = wp.min(k, MAX_PAIRS)
        if count == 0:
            return
        at = history_index(k, 0)
        for j in range(MAX_PAIRS):
            jac.gram_matrix[world, at, j] = jac.sums[j, world]
            jac.gram_matrix[world, j, at] = jac.sums[j, world]
        for i in range(count):
            a = history_index(k, i)
            jac.right_side[world, i] = jac.sums[MAX_PAIRS + a, world]
            for j in range(i + 1):
                v = jac.gram_matrix[world, a, history_index(k, j)]
                for m in range(j):
                    v -= jac.gram_factor[world, i, m] * jac.gram_factor[world, j, m]
                if j == i:
                    if v > f64(DEPENDENT_PIVOT_RATIO) * wp.abs(jac.gram_matrix[world, a, a]):
                        jac.gram_factor[world, i, i] = wp.sqrt(v)
                    else:
                        jac.gram_factor[world, i, i] = f64(0.0)
                elif jac.gram_factor[world, j, j] > f64(0.0):
                    jac.gram_factor[world, i, j] = v / jac.gram_factor[world, j, j]
                else:
                    jac.gram_factor[world, i, j] = f64(0.0)
        substitute(jac, world, k, count, f64(0.0))

    @masked_kernel(module, "ctl.active")
    def project_residual(ctl: Newton, jac: Jacobi, y: p.vec3_3d, r: p.vec3_2d):
        """Residual after the projection on the pairs, r -= Y gamma."""
        world, slot = wp.tid()
        a = r[world, slot]
        for j in range(wp.min(ctl.iterations[world], MAX_PAIRS)):
            a -= T(jac.gamma[world, j]) * y[j, world, slot]
        r[world, slot] = a

    @masked_kernel(module, "ctl.active")
    def conjugation_dot_terms(ctl: Newton, y: p.vec3_3d, z: p.vec3_2d, rows: double_3d):
        """Rows: y_j.z of all pairs, per slot."""
        world, slot = wp.tid()
        for j in range(MAX_PAIRS):
            rows[j, world, slot] = f64(0.0)
            if j < ctl.iterations[world]:
                rows[j, world, slot] = f64(wp.dot(y[j, world, slot], z[world, slot]))

    @masked_kernel(module, "ctl.active")
    def conjugate_move(ctl: Newton, jac: Jacobi):
        """gamma -= step G^-1 Y^T z: makes the move conjugate to the pairs."""
        world = wp.tid()
        k = ctl.iterations[world]
        count = wp.min(k, MAX_PAIRS)
        for i in range(count):
            jac.right_side[world, i] = -jac.step_length * jac.sums[history_index(k, i), world]
        substitute(jac, world, k, count, f64(1.0))

    @masked_kernel(module, "ctl.active")
    def combine_move(ctl: Newton, jac: Jacobi, s: p.vec3_3d, z: p.vec3_2d, move: p.vec3_2d):
        """Move p = S gamma + step z; in the Chebyshev iteration gamma_0 times the last move + gamma_1 z."""
        world, slot = wp.tid()
        if wp.static(acceleration == "chebyshev"):
            a = T(jac.gamma[world, 1]) * z[world, slot]
            if ctl.iterations[world] > 0:
                a += T(jac.gamma[world, 0]) * move[world, slot]
            move[world, slot] = a
        else:
            a = T(jac.step_length) * z[world, slot]
            if wp.static(paired):
                for j in range(wp.min(ctl.iterations[world], MAX_PAIRS)):
                    a += T(jac.gamma[world, j]) * s[j, world, slot]
            move[world, slot] = a

    @masked_kernel(module, "ctl.active")
    def residual_after_move(
        ctl: Newton, mass_factor: double_1d, lumped: p.scalar_2d, gradient: p.vec3_2d, free: p.vec3_1d, move: p.vec3_2d,
        r: p.vec3_2d,
    ):  # fmt: skip
        """r = -g - c_M M p with the lumped mass, exact for the sum over a body: the remaining force on its
        translation."""
        world, slot = wp.tid()
        m = T(mass_factor[world]) * lumped[world % lumped.shape[0], slot]
        r[world, slot] = -wp.cw_mul(gradient[world, slot] + m * move[world, slot], free[slot])

    @masked_kernel(module, "ctl.active")
    def apply_move(ctl: Newton, move: p.vec3_2d, v: p.vec3_2d):
        """v += p, shortened by step limits of terms."""
        world, slot = wp.tid()
        if wp.static(traits.limited):
            share = wp.clamp(ctl.search.limit[world], f64(0.0), f64(1.0))
            move[world, slot] = T(share) * move[world, slot]
        v[world, slot] = v[world, slot] + move[world, slot]

    @wp.kernel(module=module)
    def report_cost(ctl: Newton, jac: Jacobi, pcg: PCG, running: int_1d):
        """Report cost and gain of the attempt to the rule of kernels/solvers/reuse.py; flag the worlds that
        iterated."""
        world = wp.tid()
        ctl.active[world] = 0
        if running[world] != 0 and ctl.failed[world] == 0 and ctl.iterations[world] > 0:
            ctl.active[world] = 1
            pcg.iterations[world] = ctl.iterations[world]
            pcg.first_norm[world] = jac.first_norm[world]
            pcg.norm[world] = ctl.norms.residual_norm[world]

    return kernel_set(locals())
