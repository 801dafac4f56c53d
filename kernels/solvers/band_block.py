"""Cholesky factors of narrow banded matrices by a block of threads per world: for GPUs, and many small worlds.

A = D U U^T D^T with D the lower triangular 4 x 4 blocks on the diagonal of the Cholesky factor and U of unit diagonal.
Block row I of the factors holds U_IJ, J = I - width .. I - 1, each by columns, and the inverse of D_II. In a solution
only products with U depend on previous rows. The factorisation is right-looking: the (width + 1)^2 blocks that a column
still changes are in the shared memory of the block of threads, and rows enter as this window moves. Solutions load rows
of the factors in chunks, many numbers at a time. On the CPU one thread does the same.

Measured on an H200, world-steps per second of 4096 worlds and of one, and bytes per world, versus the dense inverses of
"two-level": a pendulum of 201 unknowns 414 000 for 281 000, 841 for 1111, 0.35 MB for 0.97; a slider-crank of 225
unknowns 45 600 for 18 500, 119 for 166, 0.44 MB for 0.98. A single world is limited by the sequence of its rows.
"""

import functools

import warp as wp

from ..common.lanes import WARP_SIZE, block_memory, lane_functions
from ..common.modules import KernelSet, kernel_module, kernel_set
from ..common.structs import pattern_struct
from ..common.types import int_1d, precision
from .band import BLOCK, band_kernels, block_column_type

__all__ = ["band_block_kernels", "solution_memory_size", "window_size"]

BLOCK_ENTRIES = BLOCK * BLOCK
"""Numbers of a block."""
BLOCK_STRIDE = BLOCK_ENTRIES + 1
"""Stride of the window's blocks: odd, to avoid bank conflicts."""
MAX_ONE_WARP_WIDTH = 7
"""Largest number of off-diagonal blocks of a row factored by one warp; wider bands use four."""
CHUNK_ENTRIES = 3072
"""Approximate number of entries of the factors that a solution loads at once, as a chunk of rows."""


def window_size(width: int) -> int:
    """Numbers in the memory of a factorisation: the window, and the original diagonals of its rows."""
    return (width + 1) * (_window_row_stride(width) + BLOCK)


def _window_row_stride(width: int) -> int:
    """Stride of the window's rows: odd, so that threads of a warp read the blocks of a column from different banks."""
    return (width + 1) * BLOCK_STRIDE | 1


def _rows_per_chunk(width: int) -> int:
    """Number of rows of a chunk."""
    return max(1, CHUNK_ENTRIES // (BLOCK_ENTRIES * width)) if width else 1


def solution_memory_size(rows: int, width: int) -> int:
    """Numbers in the memory of a solution: the unknowns, padded to blocks, and a chunk of rows of the factors."""
    return BLOCK * rows + _rows_per_chunk(width) * BLOCK_ENTRIES * max(width, 1)


@functools.cache
def band_block_kernels(dtype: str, rows: int, width: int) -> KernelSet:
    """Kernels in one precision for a given number of block rows and off-diagonal blocks."""
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    f = lane_functions(dtype)
    sync, scalar_sum = f.sync, f.scalar_sum
    Pattern, Column = pattern_struct(), block_column_type(dtype)
    Block = wp.types.matrix(shape=(BLOCK, BLOCK), dtype=T)
    inverse_factor = band_kernels(dtype).inverse_factor
    SCALAR_BYTES = wp.types.type_size_in_bytes(T)
    M, CHUNK = width + 1, _rows_per_chunk(width)
    WINDOW_ROW_STRIDE = _window_row_stride(width)
    DIAGONAL_START = M * WINDOW_ROW_STRIDE  # the original diagonals follow the window
    OFF_DIAGONAL_COLUMNS = BLOCK * width  # off-diagonal columns of a block row
    PADDED_UNKNOWNS = BLOCK * rows  # the chunk of rows follows them
    module = kernel_module(f"band_block_{dtype}_{rows}_{width}", max_unroll=BLOCK)
    window, vector = block_memory(dtype, window_size(width)), block_memory(dtype, solution_memory_size(rows, width))

    @wp.func
    def memory_of_world(global_memory: p.scalar_2d, world: int) -> wp.uint64:
        """Address of a world's row of the memory that stands for shared memory on the CPU."""
        stride = wp.uint64(global_memory.shape[1]) * wp.uint64(wp.static(SCALAR_BYTES))
        return global_memory.ptr + wp.uint64(world) * stride

    @wp.func
    def window_index(row: int, other: int) -> int:
        """Index of a block in the window."""
        return (row % M) * WINDOW_ROW_STRIDE + (other % M) * BLOCK_STRIDE

    @wp.func
    def load_window_row(
        at: wp.uint64, pattern: Pattern, value: p.mat33_2d, slot_at: int_1d,
        position_of: int_1d, shift: T, world: int, row: int, lane: int, lanes: int,
    ):  # fmt: skip
        """Load a block row of A + shift |diag A| into the window; ones on the diagonal beyond the unknowns."""
        for k in range(lane, WINDOW_ROW_STRIDE, lanes):
            window.store(at, (row % M) * WINDOW_ROW_STRIDE + k, T(0.0))
        sync()
        across = wp.max(lanes / BLOCK, 1)
        for a in range(lane / across, BLOCK, wp.max(lanes / across, 1)):
            i = BLOCK * row + a
            if i / 3 >= slot_at.shape[0]:
                if lane % across == 0:
                    window.store(at, window_index(row, row) + (BLOCK + 1) * a, T(1.0))
                    window.store(at, DIAGONAL_START + BLOCK * (row % M) + a, T(1.0))
            else:
                slot = slot_at[i / 3]
                for k in range(pattern.start[slot] + lane % across, pattern.start[slot + 1], across):
                    first = 3 * position_of[pattern.column[k]]
                    A = value[world, k]
                    for b in range(3):
                        j = first + b
                        if j <= i:
                            x = A[i % 3, b]
                            if j == i:
                                x = (T(1.0) + shift) * wp.abs(x)
                                window.store(at, DIAGONAL_START + BLOCK * (row % M) + a, x)
                            window.store(at, window_index(row, j / BLOCK) + BLOCK * a + j % BLOCK, x)

    @wp.func
    def scale_row(at: wp.uint64, R: Block, where: int):
        """A row of A_Ik D_kk^-T, in place; columns whose pivot was replaced are zero."""
        a = Column()
        for c in range(BLOCK):
            a[c] = window.load(at, where + c)
        for c in range(BLOCK):
            s = T(0.0)
            for k in range(BLOCK):
                s += R[k][c] * a[k]
            window.store(at, where + c, wp.where(R[c][c] < T(0.0), T(0.0), s))

    @wp.func
    def update_row(at: wp.uint64, left: int, right: int, where: int):
        """A row of A_IJ -= L_Ik L_Jk^T."""
        a = Column()
        for c in range(BLOCK):
            a[c] = window.load(at, left + c)
        for c in range(BLOCK):
            s = window.load(at, where + c)
            for k in range(BLOCK):
                s -= a[k] * window.load(at, right + BLOCK * c + k)
            window.store(at, where + c, s)

    @wp.func
    def eliminate_column(at: wp.uint64, row: int, below: int, lane: int, lanes: int):
        """Right-looking update by column `row`."""
        for task in range(lane, BLOCK * (below * (below + 1) / 2), lanes):
            pair = task / BLOCK
            i = wp.int32((wp.sqrt(wp.float32(8 * pair + 1)) - wp.float32(1.0)) * wp.float32(0.5))
            if (i + 1) * (i + 2) / 2 <= pair:
                i += 1
            if i * (i + 1) / 2 > pair:
                i -= 1
            one = row + 1 + i
            two = row + 1 + pair - i * (i + 1) / 2
            r = BLOCK * (task % BLOCK)
            update_row(at, window_index(one, row) + r, window_index(two, row), window_index(one, two) + r)

    @wp.kernel(module=module)
    def factor(
        lanes: int, global_memory: p.scalar_2d, pattern: Pattern, value: p.mat33_2d,
        slot_at: int_1d, position_of: int_1d, shift: p.scalar_1d,
        active: int_1d, replaced_pivots: int_1d, band: wp.array3d(dtype=Column),
    ):  # fmt: skip
        """Factors of A; `replaced_pivots`: number of unknowns whose pivot was replaced."""
        world, lane = wp.tid()
        if active[world] == 0:
            return
        at = window.open(memory_of_world(global_memory, world))
        count = wp.int32(0)
        for row in range(wp.min(M, rows)):
            load_window_row(at, pattern, value, slot_at, position_of, shift[world], world, row, lane, lanes)
        sync()
        for row in range(rows):
            S = Block()
            diagonal = Column()
            for c in range(BLOCK):
                for r in range(BLOCK):
                    S[c, r] = window.load(at, window_index(row, row) + BLOCK * r + c)
                diagonal[c] = window.load(at, DIAGONAL_START + BLOCK * (row % M) + c)
            R = inverse_factor(S, diagonal)
            below = wp.min(width, rows - 1 - row)
            sync()
            for task in range(lane, BLOCK * below, lanes):
                scale_row(at, R, window_index(row + 1 + task / BLOCK, row) + BLOCK * (task % BLOCK))
            for task in range(BLOCK * wp.max(width - row, 0) + lane, OFF_DIAGONAL_COLUMNS, lanes):  # U = D^-1 L
                other = window_index(row, row - width + task / BLOCK) + task % BLOCK
                column = Column()
                for k in range(BLOCK):
                    column += window.load(at, other + BLOCK * k) * R[k]
                band[world, row, task] = column
            if lane == 0:
                for c in range(BLOCK):
                    band[world, row, OFF_DIAGONAL_COLUMNS + c] = R[c]
                    if R[c][c] < T(0.0):
                        count += 1
            sync()
            eliminate_column(at, row, below, lane, lanes)
            if row + M < rows:  # replaces `row`, which is no longer needed
                load_window_row(at, pattern, value, slot_at, position_of, shift[world], world, row + M, lane, lanes)
            sync()
        if lane == 0:
            replaced_pivots[world] = count

    @wp.func
    def load_factor_rows(at: wp.uint64, band: wp.array3d(dtype=Column), world: int, first: int, lane: int, lanes: int):
        """Copy the off-diagonal blocks of a chunk of block rows, row by row."""
        for task in range(lane, wp.min(CHUNK, rows - first) * OFF_DIAGONAL_COLUMNS, lanes):
            column = band[world, first + task / OFF_DIAGONAL_COLUMNS, task % OFF_DIAGONAL_COLUMNS]
            for r in range(BLOCK):
                vector.store(
                    at,
                    PADDED_UNKNOWNS
                    + OFF_DIAGONAL_COLUMNS * (BLOCK * (task / OFF_DIAGONAL_COLUMNS) + r)
                    + task % OFF_DIAGONAL_COLUMNS,
                    column[r],
                )

    @wp.func
    def forward(at: wp.uint64, row: int, chunk: int, lane: int, lanes: int):
        """y_I -= sum of U_IJ y_J; `across` threads per unknown."""
        across = wp.max(lanes / BLOCK, 1)
        for a in range(lane / across, BLOCK, wp.max(lanes / across, 1)):
            s = T(0.0)
            for j in range(BLOCK * wp.max(width - row, 0) + lane % across, OFF_DIAGONAL_COLUMNS, across):
                s += vector.load(at, chunk + OFF_DIAGONAL_COLUMNS * a + j) * vector.load(at, BLOCK * (row - width) + j)
            s = scalar_sum(s, across)
            if lane % across == 0:
                vector.store(at, BLOCK * row + a, vector.load(at, BLOCK * row + a) - s)

    @wp.func
    def backward(at: wp.uint64, row: int, chunk: int, lane: int, lanes: int):
        """y_J -= U_IJ^T y_I."""
        x = Column()
        for r in range(BLOCK):
            x[r] = vector.load(at, BLOCK * row + r)
        for j in range(BLOCK * wp.max(width - row, 0) + lane, OFF_DIAGONAL_COLUMNS, lanes):
            s = vector.load(at, BLOCK * (row - width) + j)
            for r in range(BLOCK):
                s -= vector.load(at, chunk + OFF_DIAGONAL_COLUMNS * r + j) * x[r]
            vector.store(at, BLOCK * (row - width) + j, s)

    @wp.kernel(module=module)
    def solve(
        lanes: int, global_memory: p.scalar_2d, band: wp.array3d(dtype=Column),
        slot_at: int_1d, r: p.vec3_2d, active: int_1d,
        z: p.vec3_2d,
    ):  # fmt: skip
        """z = A^-1 r: D^-1, forward and backward substitution with U, D^-T."""
        world, lane = wp.tid()
        if active[world] == 0:
            return
        at = vector.open(memory_of_world(global_memory, world))
        unknowns = 3 * slot_at.shape[0]
        for i in range(lane, PADDED_UNKNOWNS, lanes):
            s = T(0.0)
            for k in range(BLOCK):
                j = i - i % BLOCK + k
                if j < unknowns:
                    s += band[world, i / BLOCK, OFF_DIAGONAL_COLUMNS + k][i % BLOCK] * r[world, slot_at[j / 3]][j % 3]
            vector.store(at, i, s)
        chunks = (rows + CHUNK - 1) / CHUNK
        for chunk in range(chunks):
            sync()
            load_factor_rows(at, band, world, CHUNK * chunk, lane, lanes)
            sync()
            for row in range(CHUNK * chunk, wp.min(CHUNK * (chunk + 1), rows)):
                forward(at, row, PADDED_UNKNOWNS + BLOCK_ENTRIES * width * (row - CHUNK * chunk), lane, lanes)
                sync()
        for back in range(chunks):
            chunk = chunks - 1 - back
            if back > 0:  # the last chunk is still loaded
                sync()
                load_factor_rows(at, band, world, CHUNK * chunk, lane, lanes)
            sync()
            last = wp.min(CHUNK * (chunk + 1), rows) - 1
            for k in range(last + 1 - CHUNK * chunk):
                row = last - k
                backward(at, row, PADDED_UNKNOWNS + BLOCK_ENTRIES * width * (row - CHUNK * chunk), lane, lanes)
                sync()
        for i in range(lane, unknowns, lanes):
            column = band[world, i / BLOCK, OFF_DIAGONAL_COLUMNS + i % BLOCK]
            s = T(0.0)
            for k in range(BLOCK):
                s += column[k] * vector.load(at, i - i % BLOCK + k)
            z[world, slot_at[i / 3]][i % 3] = s

    lanes = (4 if width > MAX_ONE_WARP_WIDTH else 1) * WARP_SIZE
    return kernel_set(locals())
