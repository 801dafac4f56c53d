"""Matrices of 3x3 blocks: H assembled from element matrices, its product, and Galerkin products with affine functions.

A pattern is symmetric and full; values are [world, entry]. One thread computes an entry and its mirror.
"""

import functools

import warp as wp

from ..common.inverse import inverse_function
from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import pattern_struct, topology_struct
from ..common.types import double_1d, int_1d, int_2d, precision
from ..elements.matrix import panel_layout, panel_row

__all__ = ["assembly_kernels", "block_kernels"]


@functools.cache
def assembly_kernels(dtype: str, slots: int, rows: bool) -> KernelSet:
    """Assembly from the matrices of elements with a given number of slots, in the layout of `element_matrix` or,
    `rows`, of `element_matrix_panels`."""
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    Topology = topology_struct(dtype)
    Pattern = pattern_struct()
    NS = slots
    _, P, ROWS = panel_layout(slots)
    BLOCKS_PER_ELEMENT = P * ROWS if rows else NS * (NS + 1) // 2
    Number = T if rows else vec3
    module = kernel_module(f"assembly_{dtype}_{slots}{'_rows' if rows else ''}", max_unroll=SHORT_UNROLL)

    @wp.func
    def block_index(low: int, high: int) -> int:
        """Index of the block of two slots in an element's matrix."""
        if wp.static(rows):
            return P * panel_row(high / P, P, low) + high % P
        else:
            return low * NS - (low * (low - 1)) / 2 + high - low

    @wp.func
    def load_block(matrix: wp.array3d(dtype=Number), world: int, elem: int, where: int) -> mat33:
        """3x3 block at an index of an element's matrix."""
        if wp.static(rows):
            first = 9 * P * (where / P) + where % P
            A = mat33()
            for i in range(3):
                for j in range(3):
                    A[i, j] = matrix[world, elem, first + P * (3 * i + j)]
            return A
        else:
            k = 3 * where
            return wp.matrix_from_cols(matrix[world, k, elem], matrix[world, k + 1, elem], matrix[world, k + 2, elem])

    @wp.kernel(module=module)
    def list_contributions(
        topo: Topology, pattern: Pattern, conn: int_2d, offset: int, count: int, listing: int, start: int_1d,
        source: int_1d,
    ):  # fmt: skip
        """Contributions of elements to an entry of Pattern.upper: start[index + 1] = their number, or with `listing`
        the `source`s from start[index] on, 2 (BLOCKS_PER_ELEMENT elem + block index) + 1 for a transposed block."""
        index = wp.tid()
        at = pattern.upper[index]
        found = wp.int32(0)
        for k in range(topo.contribution_start[at[2]], topo.contribution_start[at[2] + 1]):
            inside = topo.contribution_entry[k] - offset
            if inside >= 0 and inside < NS * count:
                a = inside / count
                elem = inside % count
                for b in range(NS):
                    if conn[b, elem] == at[3]:
                        if listing != 0:
                            where = BLOCKS_PER_ELEMENT * elem + block_index(wp.min(a, b), wp.max(a, b))
                            source[start[index] + found] = 2 * where + wp.where(a <= b, 0, 1)
                        found += 1
        if listing == 0:
            start[index + 1] = found

    @masked_kernel(module, "active")
    def add_element_matrices(
        topo: Topology, pattern: Pattern, start: int_1d, source: int_1d, matrix: wp.array3d(dtype=Number),
        mass: p.scalar_2d, first: int, mass_factor: double_1d, dq_dv: double_1d, active: int_1d, value: p.mat33_2d,
    ):  # fmt: skip
        """value += (dq/dv) K of an element block; `first`: = c_M M + (dq/dv) K.

        Prescribed components keep their diagonal only.
        """
        world, index = wp.tid()
        at = pattern.upper[index]
        row = at[2]
        column = at[3]
        A = mat33()
        for k in range(start[index], start[index + 1]):
            code = source[k]
            K = load_block(matrix, world, (code / 2) / BLOCKS_PER_ELEMENT, (code / 2) % BLOCKS_PER_ELEMENT)
            if code % 2 == 0:
                A += K
            else:
                A += wp.transpose(K)
        A = T(dq_dv[world]) * A
        if first != 0:
            A += T(mass_factor[world]) * mass[world % mass.shape[0], index] * wp.identity(n=3, dtype=T)
        row_free = topo.free[row]
        column_free = topo.free[column]
        for i in range(3):
            for j in range(3):
                if row != column or i != j:
                    A[i, j] = row_free[i] * column_free[j] * A[i, j]
        if first == 0:
            A += value[world, at[0]]
        value[world, at[0]] = A
        if at[1] != at[0]:
            value[world, at[1]] = wp.transpose(A)

    return KernelSet(
        module=module,
        add_element_matrices=add_element_matrices,
        list_contributions=list_contributions,
        blocks_per_element=BLOCKS_PER_ELEMENT,
    )


@functools.cache
def block_kernels(dtype: str) -> KernelSet:
    """Kernels on matrices of 3x3 blocks of any origin."""
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    vec4 = wp.types.vector(length=4, dtype=T)
    Topology = topology_struct(dtype)
    Pattern = pattern_struct()
    free_inverse = inverse_function(dtype)
    module = kernel_module(f"blocks_{dtype}", max_unroll=SHORT_UNROLL)

    @masked_kernel(module, "active")
    def invert_diagonal_blocks(
        topo: Topology, pattern: Pattern, value: p.mat33_2d, active: int_1d, diagonal: p.vec3_2d, inverse: p.mat33_2d
    ):
        """Diagonal D and inverses of the diagonal blocks on the free components."""
        world, slot = wp.tid()
        for k in range(pattern.start[slot], pattern.start[slot + 1]):
            if pattern.column[k] == slot:
                A = value[world, k]
                D = vec3()
                for i in range(3):
                    D[i] = wp.max(wp.abs(A[i, i]), T(1.0e-30))
                diagonal[world, slot] = D
                inverse[world, slot] = free_inverse(A, T(0.0), topo.free[slot])

    @masked_kernel(module, "active")
    def galerkin_product(
        pair: wp.array(dtype=wp.vec3i), pair_start: int_1d, fine_entry: wp.array(dtype=wp.vec3i),
        weight: wp.array(dtype=vec4), free: p.vec3_1d, fine: p.mat33_2d, active: int_1d, coarse: p.mat33_2d,
    ):  # fmt: skip
        """P^T A P: for two groups and two of their functions the sum of w w' A over the entries between them.

        `pair`: first coarse entry of the group's rows, width of its rows, index of the other in them;
        `fine_entry`: an entry, its row, its column.
        """
        world, index = wp.tid()
        group = index / 16
        k = (index / 4) % 4
        l = index % 4
        A = mat33()
        for e in range(pair_start[group], pair_start[group + 1]):
            f = fine_entry[e]
            w = weight[f[1]][k] * weight[f[2]][l]
            if w != T(0.0):
                B = fine[world, f[0]]
                row_free = free[f[1]]
                column_free = free[f[2]]
                for i in range(3):
                    for j in range(3):
                        A[i, j] = A[i, j] + w * row_free[i] * column_free[j] * B[i, j]
        at = pair[group]
        coarse[world, at[0] + k * at[1] + at[2] + l] = A

    @wp.kernel(module=module)
    def select_worlds(flags: int_1d, first: int, last: int, out: int_1d):
        """Flags of the worlds first .. last - 1, zero of others."""
        world = wp.tid()
        out[world] = wp.where(world >= first and world < last, flags[world], 0)

    return kernel_set(locals())
