"""Preconditioned conjugate gradients on H p = -g, per world, with the translations of free groups deflated.

Vector kernels run over [world, slot]; scalar logic runs with one thread per world.
"""

import functools

import warp as wp

from ..common.lanes import lane_functions
from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_1d, double_3d, f64, int_1d, precision
from .newton_control import control_struct

__all__ = ["FREE_GROUP_LANES", "forcing_functions", "free_groups_struct", "pcg_kernels", "pcg_struct"]

CONSTRAINT_FORCING = 0.4
"""Factor on the tolerance of solves with constraints. Of 0.03, 0.18, 0.4 and 1 it avoids the third Newton iteration at
the least cost: with 0.18, 0.4 and 1 a chain of 100 joints takes 64, 54 and 52 PCG iterations per step, and 2.0, 2.0
and 2.55 Newton iterations."""
UNCHECKED_ITERATIONS = 3
"""Newton iterations whose linear solves rely on factors of the operator's own matrix. Later solves are checked and
refined by conjugate gradients."""
ENERGY_CHECK_INTERVAL, MIN_ENERGY_GAIN = 10, 0.01
"""An error-estimating solve ends when its energy grows by less than this fraction in this number of iterations."""
VANISHED_RESIDUAL = 1.0e-12  # residual over the first one of a solve that has nothing left but underflow
FREE_GROUP_LANES = 128
"""Partial sums per group of bodies; fixed, so that results are independent of the number of worlds."""


@functools.cache
def pcg_struct():
    """Scalars of the conjugate gradients, per world."""

    @wp.struct
    class PCGControl:
        active: wp.array(dtype=wp.int32)
        iterations: wp.array(dtype=wp.int32)  # of this solve
        step_iterations: wp.array(dtype=wp.int32)  # of this step
        rz: wp.array(dtype=wp.float64)  # r.z of the previous iteration
        target_norm: wp.array(dtype=wp.float64)  # norm at which the solve ends
        norm: wp.array(dtype=wp.float64)  # |r| in the D^-1 norm of Newton's convergence test
        first_norm: wp.array(dtype=wp.float64)  # at the start of the solve
        sums: wp.array2d(dtype=wp.float64)  # [2, world] r.z and r.D^-1 r
        curvature: wp.array2d(dtype=wp.float64)  # [1, world] p.Hp
        any_active: wp.array(dtype=wp.int32)  # [1]
        # 1: the solve continues until its energy converges, for an error estimate
        estimate_error: wp.array(dtype=wp.int32)
        energy: wp.array(dtype=wp.float64)  # that energy, sum of alpha r.z
        checked_energy: wp.array(dtype=wp.float64)  # its value at the last check
        negative_curvature: wp.array(dtype=wp.int32)  # the solve met a direction without positive curvature
        pcg_unconverged: wp.array(dtype=wp.int32)  # the last solve ended at max_iterations
        # 1: the preconditioner is the inverse of the operator, up to rounding
        preconditioner_is_exact: wp.array(dtype=wp.int32)
        solved_directly: wp.array(dtype=wp.int32)  # 1: then its z is taken as the solution
        # 1: directions of negative curvature are followed, by the step of its absolute value
        follow_negative_curvature: wp.array(dtype=wp.int32)
        max_iterations: wp.int32  # of a solve
        max_work: wp.int32  # of a step
        leaves_saddles: wp.int32  # negative curvature is followed with laws of linear stress too

    return PCGControl


@functools.cache
def free_groups_struct(dtype: str):
    """Groups of bodies with free common translation: Z, the indicator of their position slots."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3

    @wp.struct
    class FreeGroups:
        start: wp.array(dtype=wp.int32)  # [group + 1]
        slot: wp.array(dtype=wp.int32)  # position slots, by group
        group_of_slot: wp.array(dtype=wp.int32)  # [slot] group or -1
        is_position: wp.array(dtype=T)  # [slot]
        lumped_mass: wp.array2d(dtype=T)  # [world or 0, slot] (M Z)_slot, kg
        mass: wp.array2d(dtype=T)  # [world or 0, group] kg
        free_directions: wp.array(dtype=vec3)  # [group] directions in which it is free

    return FreeGroups


@functools.cache
def forcing_functions(has_constraints: bool) -> KernelSet:
    """Target norms of linear solves, Eisenstat and Walker (1996); `has_constraints`: with constraints, see Traits."""
    Newton = control_struct()

    @wp.func
    def min_target_norm(newton: Newton, world: int) -> f64:
        """Fraction of the accepted residual norm: a smaller residual of the solve gains nothing."""
        least = f64(0.1) * newton.norms.unconverged_tol[world]
        if wp.static(has_constraints):
            # the solve also yields the constraint forces: the residual across constraints is their error
            least = f64(CONSTRAINT_FORCING) * least
            if newton.classical_multipliers == 0:
                # a loose force tolerance must not leave constraints violated
                least = least / wp.max(f64(10.0) * newton.norms.violation_ratio[world], f64(1.0))
        return least

    @wp.func
    def forcing_target(newton: Newton, world: int, norm: f64) -> f64:
        """Forcing term times the residual, |r| = norm at the start, and at least `min_target_norm`."""
        if newton.solve.fixed_forcing != 0:
            return newton.solve.forcing[world] * norm
        goal = newton.solve.forcing[world] * newton.norms.unconverged_norm[world]
        if wp.static(has_constraints):
            # with balanced forces the remaining constraint violation may still require a step
            goal = newton.solve.forcing[world] * wp.min(newton.norms.unconverged_norm[world], norm)
            if newton.classical_multipliers == 0:
                goal = f64(CONSTRAINT_FORCING) * goal
        return wp.max(goal, min_target_norm(newton, world))

    return kernel_set(locals())


@functools.cache
def pcg_kernels(dtype: str, has_constraints: bool = False) -> KernelSet:
    """Kernels of the linear solver in one precision; `has_constraints`: with constraints, see Traits."""
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    Newton = control_struct()
    Control = pcg_struct()
    Groups = free_groups_struct(dtype)
    residual_products, store_products = lane_functions(dtype).residual_products, lane_functions(dtype).store_products
    forcing_target = forcing_functions(has_constraints).forcing_target
    module = kernel_module(f"pcg_{dtype}{'_gated' if has_constraints else ''}")

    @masked_kernel(module, "active")
    def initialise_residual(g: p.vec3_2d, free: p.vec3_1d, active: int_1d, x: p.vec3_2d, r: p.vec3_2d):
        """x = 0, r = -g on the free components."""
        world, slot = wp.tid()
        x[world, slot] = vec3()
        r[world, slot] = -wp.cw_mul(g[world, slot], free[slot])

    @wp.kernel(module=module)
    def zero_converged(newton: Newton, of_slot: int_1d, active: int_1d, r: p.vec3_2d):
        """r = 0 on converged components of the model: the solve for the others must not move them."""
        world, slot = wp.tid()
        if active[world] != 0 and newton.norms.component_converged[world, of_slot[slot]] != 0:
            r[world, slot] = vec3()

    @masked_kernel(module, "active")
    def apply_block_jacobi(
        inverse: p.mat33_2d, r: p.vec3_2d, diagonal: p.vec3_2d, active: int_1d, warp: int, z: p.vec3_2d, rows: double_3d
    ):
        """z = B r with 3x3 blocks B; rows: r.z and r.D^-1 r, one sum per warp of slots."""
        world, slot = wp.tid()
        products = wp.vec2d()
        if slot < z.shape[1]:
            a = r[world, slot]
            b = inverse[world, slot] * a
            z[world, slot] = b
            products = residual_products(a, b, diagonal[world, slot])
        store_products(products, slot, warp, world, rows)

    @wp.kernel(module=module)
    def begin_solve(newton: Newton, ctl: Control):
        """Set the target norm of the solve: Eisenstat and Walker, but no tighter than Newton's method needs."""
        world = wp.tid()
        ctl.active[world] = 0
        ctl.solved_directly[world] = 0
        if newton.active[world] == 0:
            return
        rz = ctl.sums[0, world]
        norm = wp.sqrt(ctl.sums[1, world])
        ctl.rz[world] = rz
        ctl.norm[world] = norm
        ctl.first_norm[world] = norm
        ctl.iterations[world] = 0
        ctl.negative_curvature[world] = 0
        follow = newton.linear_stress == 0
        if ctl.leaves_saddles != 0:  # a linear prediction is of use to full steps only
            follow = follow or newton.solve.predicted_stress[world] == 0
        ctl.follow_negative_curvature[world] = wp.where(follow, 1, 0)
        estimate_error = newton.floor.estimate_error[world] != 0
        # a linear prediction must also cover the whole step; other laws are not linear that far
        whole = newton.solve.predicted_stress[world] == 1 and newton.linear_stress != 0
        ctl.estimate_error[world] = wp.where(estimate_error or whole, 1, 0)
        if not estimate_error:
            ctl.pcg_unconverged[world] = 0
        ctl.energy[world] = f64(0.0)
        ctl.checked_energy[world] = f64(0.0)
        ctl.target_norm[world] = forcing_target(newton, world, norm)
        if ctl.estimate_error[world] != 0:
            # round-off in the residual hides the smooth error: its norm is no stopping criterion before underflow
            ctl.target_norm[world] = f64(VANISHED_RESIDUAL) * norm
        if ctl.step_iterations[world] >= ctl.max_work:
            return  # the step is given up, see `begin_search`
        if norm > ctl.target_norm[world] and rz > f64(0.0) and ctl.max_iterations > 0:
            checked = (
                newton.iterations[world] >= UNCHECKED_ITERATIONS
                or newton.solve.predicted_stress[world] != 0
                or ctl.estimate_error[world] != 0
            )
            if ctl.preconditioner_is_exact[world] != 0 and not checked:
                ctl.solved_directly[world] = 1
                ctl.norm[world] = f64(0.0)
                ctl.iterations[world] = 1
                ctl.step_iterations[world] = ctl.step_iterations[world] + 1
            else:
                ctl.active[world] = 1
                wp.atomic_max(ctl.any_active, 0, 1)
        elif estimate_error:
            ctl.negative_curvature[world] = 1  # no error estimate with an indefinite preconditioner

    @wp.kernel(module=module)
    def first_direction(ctl: Control, z: p.vec3_2d, p_out: p.vec3_2d, x: p.vec3_2d):
        """p = z, or x += z if z is the solution."""
        world, slot = wp.tid()
        if ctl.active[world] != 0:
            p_out[world, slot] = z[world, slot]
        elif ctl.solved_directly[world] != 0:
            x[world, slot] = x[world, slot] + z[world, slot]

    @wp.kernel(module=module)
    def update_solution(ctl: Control, p_in: p.vec3_2d, Hp: p.vec3_2d, x: p.vec3_2d, r: p.vec3_2d):
        """x += alpha p, r -= alpha H p with alpha = r.z / p.H p.

        A direction without positive curvature ends the solve: followed in full if it is the first, else not at all;
        with `follow_negative_curvature` by the step of its absolute value, which leads away from a saddle.
        """
        world, slot = wp.tid()
        if world == 0 and slot == 0:
            ctl.any_active[0] = 0
        if ctl.active[world] == 0:
            return
        rz = ctl.sums[0, world]
        pHp = ctl.curvature[0, world]
        if slot == 0:
            ctl.rz[world] = rz
        length = f64(0.0)
        if pHp > f64(0.0) and wp.isfinite(pHp):
            length = rz / pHp
        elif ctl.iterations[world] == 0:
            length = f64(1.0)
        elif ctl.follow_negative_curvature[world] != 0 and pHp < f64(0.0) and wp.isfinite(pHp):
            length = -rz / pHp
        if slot == 0:
            ctl.energy[world] = ctl.energy[world] + length * rz
        alpha = T(length)
        x[world, slot] = x[world, slot] + alpha * p_in[world, slot]
        r[world, slot] = r[world, slot] - alpha * Hp[world, slot]

    @masked_kernel(module, "ctl.active")
    def new_direction(ctl: Control, z: p.vec3_2d, p_out: p.vec3_2d):
        """p = z + beta p with beta = (r.z)_new / (r.z)_old; the first thread of a world decides whether to continue."""
        world, slot = wp.tid()
        rz = ctl.sums[0, world]
        p_out[world, slot] = z[world, slot] + T(rz / ctl.rz[world]) * p_out[world, slot]
        if slot == 0:
            norm = wp.sqrt(ctl.sums[1, world])
            pHp = ctl.curvature[0, world]
            count = ctl.iterations[world] + 1
            ctl.norm[world] = norm
            ctl.iterations[world] = count
            ctl.step_iterations[world] = ctl.step_iterations[world] + 1
            more = (
                norm > ctl.target_norm[world]
                and count < ctl.max_iterations
                and ctl.step_iterations[world] < ctl.max_work
            )
            if ctl.estimate_error[world] != 0 and count % ENERGY_CHECK_INTERVAL == 0:
                energy = ctl.energy[world]
                more = more and energy - ctl.checked_energy[world] > f64(MIN_ENERGY_GAIN) * energy
                ctl.checked_energy[world] = energy
            cut = ctl.estimate_error[world] != 0 and count >= ctl.max_iterations
            if count >= ctl.max_iterations and norm > ctl.target_norm[world]:
                ctl.pcg_unconverged[world] = 1
            # signs of what underflow leaves say nothing of H
            vanished = ctl.estimate_error[world] != 0 and norm <= ctl.target_norm[world]
            if cut or not (pHp > f64(0.0) and (rz >= f64(0.0) or vanished)):
                ctl.negative_curvature[world] = 1
            if more and pHp > f64(0.0) and wp.isfinite(pHp) and rz > f64(0.0) and wp.isfinite(rz):
                wp.atomic_max(ctl.any_active, 0, 1)
            else:
                ctl.active[world] = 0  # threads that see this at once leave p unchanged; it is not read again

    @masked_kernel(module, "active")
    def free_group_partials(groups: Groups, r: p.vec3_2d, active: int_1d, partial: p.vec3_3d):
        """Z^T r, in FREE_GROUP_LANES strided partial sums per group."""
        world, group, lane = wp.tid()
        s = vec3()
        for k in range(groups.start[group] + lane, groups.start[group + 1], FREE_GROUP_LANES):
            s += r[world, groups.slot[k]]
        partial[world, group, lane] = s

    @masked_kernel(module, "active")
    def group_velocity(groups: Groups, partial: p.vec3_3d, mass_factor: double_1d, active: int_1d, velocity: p.vec3_2d):
        """c = (Z^T H Z)^-1 Z^T r; a free translation has no stiffness, so Z^T H Z is c_M times the mass of a group."""
        world, group = wp.tid()
        s = vec3()
        for lane in range(FREE_GROUP_LANES):
            s += partial[world, group, lane]
        scale = T(1.0) / (T(mass_factor[world]) * groups.mass[world % groups.mass.shape[0], group])
        velocity[world, group] = scale * wp.cw_mul(s, groups.free_directions[group])

    @masked_kernel(module, "active")
    def translate_groups(
        groups: Groups, velocity: p.vec3_2d, free: p.vec3_1d, mass_factor: double_1d, active: int_1d, x: p.vec3_2d,
        r: p.vec3_2d,
    ):  # fmt: skip
        """x += Z c, r -= H Z c, where H Z = c_M M Z."""
        world, slot = wp.tid()
        group = groups.group_of_slot[slot]
        if group < 0:
            return
        c = velocity[world, group]
        x[world, slot] = x[world, slot] + groups.is_position[slot] * c
        r[world, slot] = r[world, slot] - T(mass_factor[world]) * groups.lumped_mass[
            world % groups.lumped_mass.shape[0], slot
        ] * wp.cw_mul(c, free[slot])

    return kernel_set(locals())
