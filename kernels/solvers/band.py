"""Cholesky factors of a banded matrix in 4 x 4 blocks, one thread per world: for the CPU.

Block row I of L holds the blocks J = I - width .. I contiguously, each stored by columns, and the inverse of L_II. One
core processes the rows in turn; its vector units process a column of a block at once.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import pattern_struct
from ..common.types import int_1d, precision

__all__ = ["BLOCK", "band_kernels", "block_column_type"]

BLOCK = 4
"""Rows and columns of a block."""
SHIFT_GROWTH = 100.0
"""Growth factor of the diagonal shift after each failed factorisation."""


def block_column_type(dtype: str):
    """Type of a column of a block."""
    return wp.types.vector(length=BLOCK, dtype=precision(dtype).T)


@functools.cache
def band_kernels(dtype: str) -> KernelSet:
    """Kernels in one precision."""
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    Pattern = pattern_struct()
    Column = block_column_type(dtype)
    Block = wp.types.matrix(shape=(BLOCK, BLOCK), dtype=T)
    # a pivot below this fraction of its diagonal entry is round-off, or the matrix is indefinite there
    NEGLIGIBLE_PIVOT = {"float64": 1.0e-14, "float32": 3.0e-7}[dtype]
    # first shift after such a pivot, as a fraction of the diagonal
    FIRST_SHIFT = {"float64": 1.0e-4, "float32": 1.0e-6}[dtype]
    module = kernel_module(f"band_{dtype}", max_unroll=BLOCK)

    @masked_kernel(module, "active")
    def clear_band(slots: int, width: int, active: int_1d, band: wp.array3d(dtype=Column)):
        """Set the band to zero, with ones on the diagonal beyond the slots; one thread per block row."""
        world, row = wp.tid()
        for k in range(band.shape[2]):
            band[world, row, k] = Column()
        for r in range(BLOCK):
            if BLOCK * row + r >= 3 * slots:
                band[world, row, BLOCK * width + r][r] = T(1.0)

    @masked_kernel(module, "active")
    def fill_band(
        pattern: Pattern, value: p.mat33_2d, position_of: int_1d, width: int, shift: p.scalar_1d, active: int_1d,
        band: wp.array3d(dtype=Column),
    ):  # fmt: skip
        """Lower half of A + shift |D|, D = diag A, with slots in the order of `position_of`; one thread per slot.

        Negative diagonal entries, as under strong compression, are made positive.
        """
        world, slot = wp.tid()
        position = position_of[slot]
        for k in range(pattern.start[slot], pattern.start[slot + 1]):
            other = position_of[pattern.column[k]]
            if other <= position:
                A = value[world, k]
                if other == position:
                    for a in range(3):
                        A[a, a] = (T(1.0) + shift[world]) * wp.abs(A[a, a])
                for a in range(3):
                    i = 3 * position + a
                    for b in range(3):
                        j = 3 * other + b
                        if j <= i:
                            at = BLOCK * (j / BLOCK - i / BLOCK + width) + j % BLOCK
                            band[world, i / BLOCK, at][i % BLOCK] = A[a, b]

    @wp.func
    def inverse_factor(A: Block, diagonal: Column) -> Block:
        """Columns of L^-1, with A = L L^T.

        A pivot that is not safely positive against the given `diagonal` is replaced by that diagonal and the rest of
        the column of L is zero, so that L L^T is positive definite for any A. The diagonal entry of L^-1 is then
        negative, as a flag for the blocks below.
        """
        S = Block()
        for c in range(BLOCK):
            S[c] = A[c]
        rows = Block()
        for j in range(BLOCK):
            pivot = S[j][j]
            size = wp.abs(diagonal[j])
            own = Column()
            if pivot > T(NEGLIGIBLE_PIVOT) * size and size > T(0.0):
                scale = T(1.0) / wp.sqrt(pivot)
                column = scale * S[j]
                # row j of L^-1: remainder of e_j after the rows above, over the root of the pivot
                own = scale * rows[j]
                own[j] = scale
                for c in range(j + 1, BLOCK):
                    S[c] = S[c] - column[c] * column
                    rows[c] = rows[c] - column[c] * own
            else:
                own[j] = -T(1.0) / wp.sqrt(wp.max(size, T(1.0e-30)))
            rows[j] = own
        return wp.transpose(rows)

    @masked_kernel(module, "active")
    def factor_band(width: int, active: int_1d, replaced_pivots: int_1d, band: wp.array3d(dtype=Column)):
        """Factor A into L, in place; `replaced_pivots`: number of unknowns whose pivot was replaced."""
        world = wp.tid()
        count = wp.int32(0)
        for row in range(band.shape[1]):
            first = wp.max(row - width, 0)
            for other in range(first, row + 1):
                at = BLOCK * (other - row + width)
                S = Block()
                diagonal = Column()
                for c in range(BLOCK):
                    S[c] = band[world, row, at + c]
                    diagonal[c] = S[c][c]
                for m in range(first, other):
                    left = BLOCK * (m - row + width)
                    right = BLOCK * (m - other + width)
                    for k in range(BLOCK):
                        a = band[world, row, left + k]
                        b = band[world, other, right + k]
                        for c in range(BLOCK):
                            S[c] = S[c] - b[c] * a
                R = Block()
                if other < row:
                    for k in range(BLOCK):
                        d = band[world, other, BLOCK * width + k]
                        for c in range(BLOCK):
                            R[c] = R[c] + d[c] * S[k]
                    for c in range(BLOCK):
                        if band[world, other, BLOCK * width + c][c] < T(0.0):
                            R[c] = Column()
                else:
                    R = inverse_factor(S, diagonal)
                    for c in range(BLOCK):
                        if R[c][c] < T(0.0):
                            count += 1
                for c in range(BLOCK):
                    band[world, row, at + c] = R[c]
        replaced_pivots[world] = count

    @wp.kernel(module=module)
    def begin_factorisation(flags: int_1d, factoring: int_1d, shift: p.scalar_1d):
        """Initialise the flagged worlds without shift."""
        world = wp.tid()
        factoring[world] = flags[world]
        if flags[world] != 0:
            shift[world] = T(0.0)

    @masked_kernel(module, "factoring")
    def raise_shift(replaced_pivots: int_1d, factoring: int_1d, shift: p.scalar_1d, refactor: int_1d, exact: int_1d):
        """If A was not positive definite, raise the shift, up to 1, and request another factorisation.

        `exact`: the factors are those of A.
        """
        world = wp.tid()
        exact[world] = wp.where(replaced_pivots[world] == 0 and shift[world] == T(0.0), 1, 0)
        if replaced_pivots[world] != 0 and shift[world] < T(1.0):
            shift[world] = wp.min(wp.max(T(SHIFT_GROWTH) * shift[world], T(FIRST_SHIFT)), T(1.0))
            wp.atomic_max(refactor, 0, 1)
        else:
            factoring[world] = 0

    @masked_kernel(module, "active")
    def solve(
        width: int, band: wp.array3d(dtype=Column), slot_at: int_1d, r: p.vec3_2d, active: int_1d,
        y: wp.array2d(dtype=Column), z: p.vec3_2d,
    ):  # fmt: skip
        """z = A^-1 r by forward and backward substitution; y holds the forward solution."""
        world = wp.tid()
        slots = slot_at.shape[0]
        rows = band.shape[1]
        for row in range(rows):
            s = Column()
            for k in range(BLOCK):
                i = BLOCK * row + k
                if i / 3 < slots:
                    s[k] = r[world, slot_at[i / 3]][i % 3]
            for other in range(wp.max(row - width, 0), row):
                x = y[world, other]
                at = BLOCK * (other - row + width)
                for k in range(BLOCK):
                    s = s - x[k] * band[world, row, at + k]
            x = Column()
            for k in range(BLOCK):
                x = x + s[k] * band[world, row, BLOCK * width + k]
            y[world, row] = x
        for back in range(rows):
            row = rows - 1 - back
            s = y[world, row]
            x = Column()
            for k in range(BLOCK):
                x[k] = wp.dot(band[world, row, BLOCK * width + k], s)
            for k in range(BLOCK):
                i = BLOCK * row + k
                if i / 3 < slots:
                    z[world, slot_at[i / 3]][i % 3] = x[k]
            for other in range(wp.max(row - width, 0), row):
                at = BLOCK * (other - row + width)
                t = y[world, other]
                for k in range(BLOCK):
                    t[k] = t[k] - wp.dot(band[world, row, at + k], x)
                y[world, other] = t

    return kernel_set(locals())
