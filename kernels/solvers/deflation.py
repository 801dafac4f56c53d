"""Deflation of the directions of constraints: the preconditioner (D + (dq/dv) J^T rho J)^-1 by Woodbury's identity.

z = D^-1 r - D^-1 J^T (1/((dq/dv) rho) + J D^-1 J^T)^-1 J D^-1 r

D are the 3x3 diagonal blocks of H. The rows of J are grouped into clusters, whose matrices are inverted densely;
coupled clusters are swept by symmetric Gauss-Seidel, colour by colour.
"""

import functools

import warp as wp

from ..common.lanes import lane_functions
from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_1d, double_3d, f64, int_1d, precision, vec3d
from ..terms.constraints import constraint_functions, constraint_struct, multiplier_struct

__all__ = ["deflation_kernels"]


@functools.cache
def deflation_kernels(dtype: str) -> KernelSet:
    """Kernels of the deflation for one precision of the slots, and of the penalty rho derived from the same
    matrices."""
    p = precision(dtype)
    vec3, mat33 = p.vec3, p.mat33
    Constraints, Multipliers = constraint_struct(), multiplier_struct()
    directional_derivative = constraint_functions(dtype).directional_derivative
    store_sum = lane_functions(dtype).store_sum
    module = kernel_module(f"deflation_{dtype}")

    @masked_kernel(module, "active")
    def assemble_pair_blocks(con: Constraints, inverse: p.mat33_2d, active: int_1d, mul: Multipliers):
        """Sum of w w' D^-1 over the common slots of two constraint vectors, with their weights w and w' there."""
        world, block = wp.tid()
        s = wp.mat33d()
        for k in range(con.block_start[block], con.block_start[block + 1]):
            s += con.block_weight[k] * wp.mat33d(inverse[world, con.block_slot[k]])
        mul.compliance_block[world, block] = s

    @wp.func
    def delassus_entry(
        con: Constraints, mul: Multipliers, world: int, row: int, column: int, first: int, last: int
    ) -> f64:
        """Entry of the Delassus matrix J D^-1 J^T of two rows: sum over pairs of their vectors with common slots."""
        s = f64(0.0)
        for k in range(first, last):
            side = con.pair_side[k]
            left = mul.gradient[world, 3 * row + side[0]]
            right = mul.gradient[world, 3 * column + side[1]]
            s += wp.dot(left, mul.compliance_block[world, con.pair_block[k]] * right)
        return s

    @wp.func
    def cluster_rows(con: Constraints, cluster: int):
        """First row and number of rows of a cluster."""
        first = con.cluster_start[cluster]
        return first, con.cluster_start[cluster + 1] - first

    @masked_kernel(module, "active")
    def assemble_cluster_couplings(con: Constraints, active: int_1d, mul: Multipliers):
        """J D^-1 J^T between rows of different clusters, one thread per coupling."""
        world, k = wp.tid()
        first, last = con.coupling_pair_start[k], con.coupling_pair_start[k + 1]
        mul.coupling[world, k] = delassus_entry(
            con, mul, world, con.coupling_row[k], con.coupling_column[k], first, last
        )

    @masked_kernel(module, "active")
    def assemble_cluster_matrices(con: Constraints, active: int_1d, mul: Multipliers):
        """J D^-1 J^T within each cluster, one thread per row."""
        world, row = wp.tid()
        first, n = cluster_rows(con, con.cluster[row])
        base = con.matrix_start[con.cluster[row]] + (row - first) * n
        for column in range(n):
            start, end = con.pair_start[base + column], con.pair_start[base + column + 1]
            value = delassus_entry(con, mul, world, row, first + column, start, end)
            mul.inverse_matrix[world, base + column] = value
            if first + column == row and value > f64(0.0) and mul.chain_ratio > f64(0.0):
                wp.atomic_max(mul.stiffest, world, con.connected_component[row], f64(1.0) / value)

    @masked_kernel(module, "active")
    def compute_penalty(con: Constraints, dq_dv: double_1d, active: int_1d, mul: Multipliers):
        """rho = kappa / ((dq/dv) (J D^-1 J^T)_ii), N/m, constant during a step.

        kappa is the ratio of rho to the stiffness of the constrained slots: independent of units, of the mesh and of E.
        With rigid parts it is at least `chain_ratio` times the stiffness of the stiffest row: a light part that carries
        a heavy one bears that one's forces.
        """
        world, row = wp.tid()
        first, n = cluster_rows(con, con.cluster[row])
        own = mul.inverse_matrix[world, con.matrix_start[con.cluster[row]] + (row - first) * (n + 1)]
        rho = f64(0.0)
        if own > f64(0.0):
            rho = mul.penalty_ratio / (dq_dv[world] * own)
            if mul.chain_ratio > f64(0.0):
                rho = wp.max(rho, mul.chain_ratio * mul.stiffest[world, con.connected_component[row]] / dq_dv[world])
        mul.penalty[world, row] = rho

    @wp.func
    def add_penalty_compliance(con: Constraints, mul: Multipliers, dq: f64, world: int, cluster: int):
        """Add 1 / ((dq/dv) rho) to the diagonal of a cluster's matrix; 1 for rows without a free slot (rho = 0)."""
        first, n = cluster_rows(con, cluster)
        base = con.matrix_start[cluster]
        for i in range(n):
            rho = mul.penalty[world, first + i]
            more = f64(1.0)
            if rho > f64(0.0):
                more = f64(1.0) / (dq * rho)
            k = base + i * (n + 1)
            mul.inverse_matrix[world, k] = mul.inverse_matrix[world, k] + more

    @masked_kernel(module, "active")
    def invert_clusters(con: Constraints, dq_dv: double_1d, limit: int, active: int_1d, mul: Multipliers):
        """Inverse of the matrix of each cluster up to `limit` rows, in place (Gauss-Jordan; positive definite)."""
        world, cluster = wp.tid()
        add_penalty_compliance(con, mul, dq_dv[world], world, cluster)
        n = con.cluster_start[cluster + 1] - con.cluster_start[cluster]
        if n > limit:
            return
        base = con.matrix_start[cluster]
        for k in range(n):
            d = f64(1.0) / mul.inverse_matrix[world, base + k * (n + 1)]
            mul.inverse_matrix[world, base + k * (n + 1)] = f64(1.0)
            for j in range(n):
                mul.inverse_matrix[world, base + k * n + j] = d * mul.inverse_matrix[world, base + k * n + j]
            for i in range(n):
                if i != k:
                    x = mul.inverse_matrix[world, base + i * n + k]
                    mul.inverse_matrix[world, base + i * n + k] = f64(0.0)
                    for j in range(n):
                        y = (
                            mul.inverse_matrix[world, base + i * n + j]
                            - x * mul.inverse_matrix[world, base + k * n + j]
                        )
                        mul.inverse_matrix[world, base + i * n + j] = y

    @wp.kernel(module=module)
    def eliminate_pivot(con: Constraints, large: int_1d, pivot: int, active: int_1d, mul: Multipliers):
        """One pivot of Gauss-Jordan in every large cluster, a thread per row; `scale_pivot_row` handles the row of the
        pivot."""
        world, k, i = wp.tid()
        cluster = large[k]
        n = con.cluster_start[cluster + 1] - con.cluster_start[cluster]
        if active[world] == 0 or pivot >= n or i >= n or i == pivot:
            return
        base = con.matrix_start[cluster]
        d = mul.inverse_matrix[world, base + pivot * (n + 1)]
        x = mul.inverse_matrix[world, base + i * n + pivot] / d
        for j in range(n):
            if j == pivot:
                mul.inverse_matrix[world, base + i * n + j] = -x
            else:
                y = mul.inverse_matrix[world, base + i * n + j] - x * mul.inverse_matrix[world, base + pivot * n + j]
                mul.inverse_matrix[world, base + i * n + j] = y

    @wp.kernel(module=module)
    def scale_pivot_row(con: Constraints, large: int_1d, pivot: int, active: int_1d, mul: Multipliers):
        """The row of the pivot in a step of Gauss-Jordan, after `eliminate_pivot`."""
        world, k = wp.tid()
        cluster = large[k]
        n = con.cluster_start[cluster + 1] - con.cluster_start[cluster]
        if active[world] == 0 or pivot >= n:
            return
        base = con.matrix_start[cluster] + pivot * n
        d = f64(1.0) / mul.inverse_matrix[world, base + pivot]
        mul.inverse_matrix[world, base + pivot] = f64(1.0)
        for j in range(n):
            mul.inverse_matrix[world, base + j] = d * mul.inverse_matrix[world, base + j]

    @masked_kernel(module, "active")
    def restrict_to_constraints(con: Constraints, mul: Multipliers, z: p.vec3_2d, active: int_1d):
        """restricted = J z, one thread per row."""
        world, row = wp.tid()
        mul.deflation_rhs[world, row] = directional_derivative(con, mul.gradient, z, world, row)

    @masked_kernel(module, "active")
    def apply_cluster_inverses(con: Constraints, mul: Multipliers, active: int_1d):
        """s, `solved` = the inverse of each cluster's matrix times J z, one thread per row."""
        world, row = wp.tid()
        first, n = cluster_rows(con, con.cluster[row])
        base = con.matrix_start[con.cluster[row]] + (row - first) * n
        s = f64(0.0)
        for j in range(n):
            s += mul.inverse_matrix[world, base + j] * mul.deflation_rhs[world, first + j]
        mul.deflation_solution[world, row] = s

    @masked_kernel(module, "active")
    def gauss_seidel_sweep(con: Constraints, mul: Multipliers, first_cluster: int, forward: int, active: int_1d):
        """One colour of a symmetric block Gauss-Seidel sweep over coupled clusters.

        Both sweeps together invert (G + L) G^-1 (G + L^T), with G the clusters' own matrices and L the couplings to
        preceding colours, an upper bound of J D^-1 J^T + 1/((dq/dv) rho): the preconditioner stays positive definite.
        """
        world, k = wp.tid()
        cluster = con.colour_cluster[first_cluster + k]
        colour = con.colour[cluster]
        first, n = cluster_rows(con, cluster)
        for row in range(first, first + n):
            s = f64(0.0)
            if forward == 1:
                s = mul.deflation_rhs[world, row]
            for c in range(con.coupling_start[row], con.coupling_start[row + 1]):
                other = con.coupling_column[c]
                rank = con.colour[con.cluster[other]]
                if (forward == 1 and rank < colour) or (forward == 0 and rank > colour):
                    s -= mul.coupling[world, c] * mul.deflation_solution[world, other]
            mul.sweep_rhs[world, row] = s
        base = con.matrix_start[cluster]
        for i in range(n):
            s = f64(0.0)
            for j in range(n):
                s += mul.inverse_matrix[world, base + i * n + j] * mul.sweep_rhs[world, first + j]
            if forward == 0:
                s += mul.deflation_solution[world, first + i]
            mul.deflation_solution[world, first + i] = s

    @masked_kernel(module, "active")
    def subtract_constraint_part(
        con: Constraints, mul: Multipliers, inverse: p.mat33_2d, r: p.vec3_2d, y: p.vec3_2d, add: int, active: int_1d,
        warp: int, z: p.vec3_2d, rows: double_3d,
    ):  # fmt: skip
        """z = y - D^-1 J^T s on slots with constraints, y = D^-1 r; with `add` added to z. Rows: r.z per warp."""
        world, slot = wp.tid()
        rz = f64(0.0)
        if slot < z.shape[1]:
            out = z[world, slot]
            first = con.slot_start[slot]
            last = con.slot_start[slot + 1]
            if last > first:
                s = vec3d()
                for k in range(first, last):
                    term = con.slot_term[k]
                    s += (con.slot_weight[k] * mul.deflation_solution[world, term / 3]) * mul.gradient[world, term]
                change = y[world, slot] - inverse[world, slot] * vec3(s)
                if add != 0:
                    change += out
                out = change
                z[world, slot] = out
            rz = f64(wp.dot(r[world, slot], out))
        store_sum(0, rz, slot, warp, world, rows)

    return kernel_set(locals())
