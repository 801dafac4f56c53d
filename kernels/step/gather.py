"""Assembly of element contributions on slots: the residual of a step Eq. (17), the product H p, the diagonal blocks.

Contributions are gathered per slot in a fixed order, not added atomically: reproducible, and faster.
"""

import functools

import warp as wp

from ..common.inverse import inverse_function
from ..common.lanes import lane_functions
from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import (
    balance_struct,
    entry_sum_function,
    mass_functions,
    pattern_struct,
    product_terms_struct,
    topology_struct,
)  # fmt: skip
from ..common.traits import NO_TERMS, Traits
from ..common.types import double_1d, double_3d, f64, int_1d, precision
from ..solvers.newton_control import Row
from ..terms.constraints import constraint_struct, multiplier_struct

__all__ = ["RESIDUAL_ROWS", "gather_kernels"]

RESIDUAL_ROWS = 11
"""Rows summed per world with a residual, `Row` of newton_control.py: the squared D^-1 norms
of g, f_int, loads and inertia; the inertia and load part of Phi and its magnitude; g.p with non-conservative forces
frozen; change of Phi by their update; squared norm of the position round-off; |g|^2; v~.M v~ c_M / 2."""


MIN_RESIDENT_BLOCKS = {"float64": 6, "float32": 8}
"""Minimum resident blocks of 256 threads of `with_mass_sum` (register limit): the kernel is memory-latency bound."""
REACTION_FRACTION = wp.constant(wp.float64(1.0e-6))
"""Fraction of the squared reactions in the squared scale of the residual."""


@functools.cache
def gather_kernels(dtype: str, traits: Traits = NO_TERMS) -> KernelSet:
    """Kernels over slots; traits used: all that suffix the name of their module."""
    p = precision(dtype)
    T, vec3, mat33, sym6 = p.T, p.vec3, p.mat33, p.sym
    Topology = topology_struct(dtype)
    Balance, ProductTerms = balance_struct(dtype), product_terms_struct(dtype)
    Constraints, Multipliers = constraint_struct(), multiplier_struct()
    Pattern = pattern_struct()
    lane_sum, store_sum = lane_functions(dtype).lane_sum, lane_functions(dtype).store_sum
    free_inverse, entry_sum = inverse_function(dtype), entry_sum_function(dtype)
    mass_entry, mass_times = mass_functions(dtype).mass_entry, mass_functions(dtype).mass_times
    name = f"{dtype}{traits.suffix('nonpotential', 'tangent', 'pooled', 'constraint_rows', 'midpoint', 'unilateral')}"
    module = kernel_module(f"gather_{name}", max_unroll=SHORT_UNROLL)
    matrix_module = kernel_module(f"matrix_product_{name}", max_unroll=SHORT_UNROLL)

    @wp.func
    def weighted_square(a: vec3, D: vec3) -> f64:
        """a.D^-1 a, with 0/0 = 0."""
        s = f64(0.0)
        for k in range(3):
            x = f64(a[k])
            if x != f64(0.0):
                s += x * x / f64(D[k])
        return s

    @wp.func
    def position_rounding(balance: Balance, free: vec3, D: vec3, world: int, slot: int, least: f64) -> f64:
        """Squared D norm of the velocity u/(dq/dv): times eps^2, the residual due to round-off of u.

        If u = q~ + (dq/dv) v is a small difference, v sets the round-off. `least`: lower bound of u, of slots in
        contact, as gaps are differences of positions.
        """
        u = balance.u[world, slot]
        v = balance.v[world, slot]
        s = f64(0.0)
        for k in range(3):
            x = wp.max(wp.max(wp.abs(f64(u[k])), least) / balance.dq_dv[world], wp.abs(f64(v[k])))
            s += f64(free[k]) * f64(D[k]) * x * x
        return s

    @wp.func
    def constraint_forces(con: Constraints, mul: Multipliers, world: int, slot: int) -> wp.mat33d:
        """J^T of the trial's lambda, of rho c, and of the frozen lambda + rho c, as rows."""
        constraint_force = wp.vec3d()
        penalty = wp.vec3d()
        merit = wp.vec3d()
        for k in range(con.slot_start[slot], con.slot_start[slot + 1]):
            term = con.slot_term[k]
            row = term / 3
            d = con.slot_weight[k] * mul.gradient[world, term]
            constraint_force += mul.trial_multiplier[world, row] * d
            penalty += mul.penalty_force[world, row] * d
            merit += mul.frozen_force[world, row] * d
        return wp.matrix_from_rows(constraint_force, penalty, merit)

    @wp.func
    def gather_sum(topo: Topology, contribution: p.vec3_2d, world: int, slot: int) -> vec3:
        """Sum of the contributions to a slot, in order."""
        return entry_sum(topo.contribution_start, topo.contribution_entry, contribution, world, slot)

    @wp.func
    def newton_gradient(balance: Balance, world: int, slot: int) -> vec3:
        """Gradient on the right side of the Newton step."""
        if wp.static(traits.constraint_rows):
            return balance.gradient[world, slot]
        else:
            return balance.g[world, slot]

    @wp.func
    def pool_magnitude(topo: Topology, balance: Balance, world: int, slot: int, total: vec3) -> vec3:
        """Scale of pooled forces: opposing contact forces on a body cancel, each sets a scale by itself."""
        largest = vec3(wp.abs(total[0]), wp.abs(total[1]), wp.abs(total[2]))
        if wp.static(not traits.unilateral):  # so do a joint's friction and its constraint force
            for j in range(topo.pool_start[slot], topo.pool_start[slot + 1]):
                one = balance.pool_force[world, topo.pool_entry[j]]
                for k in range(3):
                    largest[k] = wp.max(largest[k], wp.abs(one[k]))
        return largest

    @wp.func
    def squared_length(a: vec3) -> f64:
        """a.a in float64, for forces whose square overflows float32."""
        s = f64(0.0)
        for k in range(3):
            s += f64(a[k]) * f64(a[k])
        return s

    @masked_kernel(module, "active")
    def gather_force(topo: Topology, contribution: p.vec3_2d, active: int_1d, out: p.vec3_2d):
        """out = sum of contributions."""
        world, slot = wp.tid()
        out[world, slot] = gather_sum(topo, contribution, world, slot)

    @masked_kernel(module, "active")
    def residual(
        topo: Topology, contribution: p.vec3_2d, balance: Balance, active: int_1d, con: Constraints, mul: Multipliers
    ):
        """Eq. (17): g = M (v - v~) c_M + f_int - f_dead - f_nonpotential + J^T lambda, and the rows of `RESIDUAL_ROWS`.

        `gradient` is that of the augmented potential, g + J^T rho c, the right side of the next Newton step.
        """
        world, slot = wp.tid()
        f = gather_sum(topo, contribution, world, slot)
        own = f
        if wp.static(traits.pooled):
            of_pool = entry_sum(topo.pool_start, topo.pool_entry, balance.pool_force, world, slot)
            f += of_pool
        a, past = vec3(), vec3()
        for k in range(topo.mass_start[slot], topo.mass_start[slot + 1]):
            j = topo.mass_column[k]
            before = balance.v_tilde[world, j]
            a += mass_entry(topo, world, k) * (balance.v[world, j] - before)
            past += mass_entry(topo, world, k) * before
        a = T(balance.mass_factor[world]) * a
        load = balance.dead[world, slot]
        magnitude = balance.dead_magnitude[world, slot]
        frozen_load = load
        if wp.static(traits.nonpotential):
            new = balance.nonpotential[world, slot]
            frozen_load = load + balance.nonpotential_frozen[world, slot]
            load = load + new
            for k in range(3):
                magnitude[k] = magnitude[k] + wp.abs(new[k])
        residual_force = a + f - load
        descent = a + f - frozen_load
        if wp.static(traits.constraint_rows):
            constraint_force = constraint_forces(con, mul, world, slot)
            residual_force += vec3(constraint_force[0])
            balance.gradient[world, slot] = residual_force + vec3(constraint_force[1])
            descent += vec3(constraint_force[2])
            for k in range(3):
                magnitude[k] = magnitude[k] + T(wp.abs(constraint_force[0][k]))
        if wp.static(traits.pooled):
            magnitude = magnitude + pool_magnitude(topo, balance, world, slot, of_pool)
        balance.inertia[world, slot] = a
        balance.internal[world, slot] = f
        balance.g[world, slot] = residual_force
        free = topo.free[slot]
        D = balance.diagonal[world, slot]
        vs = balance.v[world, slot]
        kinetic = T(0.5) * wp.dot(vs - balance.v_tilde[world, slot], a)
        work = wp.dot(frozen_load, vs)
        balance.rows[Row.RESIDUAL, world, slot] = weighted_square(wp.cw_mul(residual_force, free), D)
        # a prestressed body without loads has only reactions: a small fraction of them is its scale
        reaction = own - wp.cw_mul(own, free)
        balance.rows[Row.INTERNAL, world, slot] = weighted_square(
            wp.cw_mul(own, free), D
        ) + REACTION_FRACTION * weighted_square(reaction, D)
        balance.rows[Row.LOADS, world, slot] = weighted_square(wp.cw_mul(magnitude, free), D)
        balance.rows[Row.INERTIA, world, slot] = weighted_square(wp.cw_mul(a, free), D)
        balance.rows[Row.OBJECTIVE, world, slot] = f64(kinetic - work)
        if wp.static(traits.midpoint):  # Phi does not exist: half of the squared gradient replaces it
            balance.rows[Row.OBJECTIVE, world, slot] = f64(0.5) * weighted_square(
                wp.cw_mul(newton_gradient(balance, world, slot), free), D
            )
        balance.rows[Row.MAGNITUDE, world, slot] = f64(wp.abs(kinetic) + wp.abs(work))
        balance.rows[Row.SLOPE, world, slot] = f64(wp.dot(wp.cw_mul(descent, free), balance.direction[world, slot]))
        balance.rows[Row.FROZEN_CHANGE, world, slot] = f64(0.0)
        if wp.static(traits.nonpotential and not traits.midpoint):
            balance.rows[Row.FROZEN_CHANGE, world, slot] = f64(
                wp.dot(balance.nonpotential_frozen[world, slot] - balance.nonpotential[world, slot], vs)
            )
        least = f64(0.0)
        if wp.static(traits.pooled):
            least = wp.where(wp.length_sq(of_pool) > T(0.0), balance.gap_displacement, least)
        balance.rows[Row.ROUNDOFF, world, slot] = position_rounding(balance, free, D, world, slot, least)
        balance.rows[Row.FORCE, world, slot] = squared_length(wp.cw_mul(residual_force, free))
        motion = T(0.5) * wp.dot(balance.v_tilde[world, slot], past)
        balance.rows[Row.KINETIC, world, slot] = balance.mass_factor[world] * f64(motion)

    @wp.func
    def pool_range(more: ProductTerms, slot: int) -> wp.vec2i:
        """Pool entries of a slot; loaded early to hide the latency."""
        out = wp.vec2i()
        if wp.static(traits.pooled):
            out = wp.vec2i(more.pool_start[slot], more.pool_start[slot + 1])
        return out

    @wp.func
    def add_term_products(
        topo: Topology, h: vec3, more: ProductTerms, pool: wp.vec2i, p: vec3, con: Constraints, mul: Multipliers,
        world: int, slot: int, result: p.vec3_2d,
    ) -> f64:  # fmt: skip
        """H p on the free components: adds the terms' part to the elements' part. Returns p.Hp."""
        out = h
        if wp.static(traits.tangent):
            f = entry_sum(more.contribution_start, more.contribution_entry, more.contribution, world, slot)
            out -= T(more.dq_dv[world]) * f
        if wp.static(traits.pooled):
            stiff = vec3()
            for k in range(pool[0], pool[1]):
                stiff += more.pool[world, more.pool_entry[k]]
            if pool[0] < pool[1]:
                out += T(more.dq_dv[world]) * stiff
        if wp.static(traits.constraint_rows):
            constraint_force = wp.vec3d()
            for k in range(con.slot_start[slot], con.slot_start[slot + 1]):
                constraint_force += con.slot_weight[k] * mul.product[world, con.slot_term[k]]
            out += vec3(constraint_force)
        bits = int(topo.prescribed_bits[slot])
        for k in range(3):
            if bits & (1 << k) != 0:
                out[k] = T(0.0)
        result[world, slot] = out
        return f64(wp.dot(out, p))

    def product_kernel(name: str, mass: bool, **options: tuple[int, int]) -> wp.Kernel:
        """Kernel `name` of H p from the contributions of elements; `mass`: these lack c_M M p and the factor dq/dv."""

        @masked_kernel(module, "active", f"gather_kernels__locals__{name}", **options)
        def slot_product(
            topo: Topology, contribution: p.vec3_2d, more: ProductTerms, p_in: p.vec3_2d, active: int_1d,
            con: Constraints, mul: Multipliers, out: p.vec3_2d, rows: double_3d,
        ):  # fmt: skip
            """H p = c_M M p + (dq/dv) K p on the free components, constraints included, and p.Hp per warp of slots."""
            world, slot = wp.tid()
            share = f64(0.0)
            if slot < out.shape[1]:
                pool = pool_range(more, slot)
                h = gather_sum(topo, contribution, world, slot)
                if wp.static(mass):
                    a = mass_times(topo, p_in, world, slot)
                    h = T(more.mass_factor[world]) * a + T(more.dq_dv[world]) * h
                share = add_term_products(topo, h, more, pool, p_in[world, slot], con, mul, world, slot, out)
            store_sum(0, share, slot, more.warp_lanes, world, rows)

        return slot_product

    operator_product = product_kernel("operator_product", mass=True)
    with_mass_sum = product_kernel("with_mass_sum", mass=False, launch_bounds=(256, MIN_RESIDENT_BLOCKS[dtype]))

    @masked_kernel(matrix_module, "active")
    def matrix_product(
        topo: Topology, pattern: Pattern, value: p.mat33_2d, lanes: int, more: ProductTerms, p_in: p.vec3_2d,
        active: int_1d, con: Constraints, mul: Multipliers, out: p.vec3_2d, rows: double_3d,
    ):  # fmt: skip
        """H p with the elements' part and the mass as one matrix, `lanes` threads per row."""
        world, index = wp.tid()
        slot = index / lanes
        lane = index % lanes
        h = vec3()
        pool = wp.vec2i()
        if slot < out.shape[1]:
            pool = pool_range(more, slot)
            for k in range(pattern.start[slot] + lane, pattern.start[slot + 1], lanes):
                h += value[world, k] * p_in[world, pattern.column[k]]
        h = lane_sum(h, lanes)
        share = f64(0.0)
        if lane == 0 and slot < out.shape[1]:
            share = add_term_products(topo, h, more, pool, p_in[world, slot], con, mul, world, slot, out)
        store_sum(0, share, index, more.warp_lanes, world, rows)

    @masked_kernel(module, "active")
    def gather_diagonal_blocks(
        topo: Topology, contribution: p.sym_2d, pool: p.sym_2d, mass_factor: double_1d, dq_dv: double_1d,
        active: int_1d, diagonal: p.vec3_2d, inverse: p.mat33_2d,
    ):  # fmt: skip
        """Diagonal blocks of H: their diagonal D and their inverse on the free components."""
        world, slot = wp.tid()
        k6 = sym6()
        for k in range(topo.contribution_start[slot], topo.contribution_start[slot + 1]):
            k6 += contribution[world, topo.contribution_entry[k]]
        if wp.static(traits.pooled):
            for k in range(topo.pool_start[slot], topo.pool_start[slot + 1]):
                k6 += pool[world, topo.pool_entry[k]]
        mass = T(0.0)
        for k in range(topo.mass_start[slot], topo.mass_start[slot + 1]):
            if topo.mass_column[k] == slot:
                mass = T(mass_factor[world]) * mass_entry(topo, world, k)
        k6 = T(dq_dv[world]) * k6
        A = mat33(k6[0], k6[5], k6[4], k6[5], k6[1], k6[3], k6[4], k6[3], k6[2])
        free = topo.free[slot]
        D = vec3()
        for i in range(3):
            A[i, i] = A[i, i] + mass
            D[i] = wp.max(wp.abs(A[i, i]), T(1.0e-30))
        diagonal[world, slot] = D
        inverse[world, slot] = free_inverse(A, mass, free)

    @wp.kernel(module=module)
    def kinetic_terms(topo: Topology, a: p.vec3_2d, rows: double_3d):
        """a.M a / 2 per slot, for every world."""
        world, slot = wp.tid()
        s = mass_times(topo, a, world, slot)
        rows[0, world, slot] = f64(0.5) * f64(wp.dot(s, a[world, slot]))

    return kernel_set(locals())
