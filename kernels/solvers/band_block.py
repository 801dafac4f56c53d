"""Cholesky factors of narrow banded matrices by a block of threads per world: for GPUs, and many small worlds.

The storage is that of band.py: block row I of L holds the 4 x 4 blocks J = I - width .. I, each by columns, and of L_II
its inverse. The factorisation looks to the right: the blocks that a column still changes, (width + 1)^2 of them, are in
memory of the block of threads, and rows enter as the window moves on. On the CPU one thread does the same.
"""

import functools
import types as _types

import warp as wp

from ..common.lanes import WARP, block_memory, lane_functions
from ..common.types import kernel_module, precision
from .band import BLOCK, band_kernels, column_type

__all__ = ["band_block_kernels", "window_numbers"]

SIZE = BLOCK * BLOCK


def window_numbers(width: int) -> int:
    """Numbers of the window, and of the diagonals that its rows began with."""
    return (width + 1) * (width + 1) * SIZE + (width + 1) * BLOCK


@functools.cache
def band_block_kernels(dtype: str, rows: int, width: int) -> _types.SimpleNamespace:
    """Kernels in one precision, for so many block rows and blocks beside the diagonal."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    f = lane_functions(dtype)
    sync, scalar_sum = f.sync, f.scalar_sum
    Column = column_type(dtype)
    Block = wp.types.matrix(shape=(BLOCK, BLOCK), dtype=T)
    inverse_factor = band_kernels(dtype).inverse_factor
    NUMBER = wp.types.type_size_in_bytes(T)
    M = width + 1
    GIVEN = M * M * SIZE
    ENTRIES = BLOCK * M  # columns of a block row
    module = kernel_module(f"band_block_{dtype}_{rows}_{width}", max_unroll=BLOCK)
    window, vector = block_memory(dtype, window_numbers(width)), block_memory(dtype, BLOCK * rows + BLOCK)

    @wp.func
    def place(row: int, other: int) -> int:
        """Of a block in the window."""
        return ((row % M) * M + other % M) * SIZE

    @wp.func
    def enter(at: wp.uint64, band: wp.array3d(dtype=Column), world: int, row: int, lane: int, lanes: int):
        """Load a block row into the window."""
        first = wp.max(row - width, 0)
        for task in range(BLOCK * (first - row + width) + lane, ENTRIES, lanes):
            other = row - width + task / BLOCK
            column = band[world, row, task]
            for r in range(BLOCK):
                window.store(at, place(row, other) + BLOCK * r + task % BLOCK, column[r])
            if other == row:
                window.store(at, GIVEN + BLOCK * (row % M) + task % BLOCK, column[task % BLOCK])

    @wp.func
    def scale_row(at: wp.uint64, R: Block, where: int):
        """A row of A_Ik L_kk^-T, in place; columns whose pivot was replaced are zero."""
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

    @wp.kernel(module=module)
    def factor(
        lanes: int, outside: wp.array2d(dtype=T), active: wp.array(dtype=wp.int32), bad: wp.array(dtype=wp.int32),
        band: wp.array3d(dtype=Column),
    ):  # fmt: skip
        """Factor A into L, in place; `bad`: number of unknowns whose pivot had to be replaced."""
        thread = wp.tid()
        world = thread / lanes
        lane = thread % lanes
        if active[world] == 0:
            return
        at = window.open(outside.ptr + wp.uint64(world) * wp.uint64(outside.shape[1]) * wp.uint64(wp.static(NUMBER)))
        count = wp.int32(0)
        for row in range(wp.min(M, rows)):
            enter(at, band, world, row, lane, lanes)
        sync()
        for row in range(rows):
            S = Block()
            given = Column()
            for c in range(BLOCK):
                for r in range(BLOCK):
                    S[c, r] = window.load(at, place(row, row) + BLOCK * r + c)
                given[c] = window.load(at, GIVEN + BLOCK * (row % M) + c)
            R = inverse_factor(S, given)
            below = wp.min(width, rows - 1 - row)
            sync()
            for task in range(lane, BLOCK * below, lanes):
                scale_row(at, R, place(row + 1 + task / BLOCK, row) + BLOCK * (task % BLOCK))
            sync()
            if lane == 0:
                for c in range(BLOCK):
                    band[world, row, BLOCK * width + c] = R[c]
                    if R[c][c] < T(0.0):
                        count += 1
            for task in range(lane, BLOCK * below, lanes):
                other = row + 1 + task / BLOCK
                column = Column()
                for r in range(BLOCK):
                    column[r] = window.load(at, place(other, row) + BLOCK * r + task % BLOCK)
                band[world, other, BLOCK * (row - other + width) + task % BLOCK] = column
            for task in range(lane, BLOCK * (below * (below + 1) / 2), lanes):
                pair = task / BLOCK
                i = wp.int32((wp.sqrt(8.0 * float(pair) + 1.0) - 1.0) * 0.5)
                if (i + 1) * (i + 2) / 2 <= pair:
                    i += 1
                if i * (i + 1) / 2 > pair:
                    i -= 1
                one = row + 1 + i
                two = row + 1 + pair - i * (i + 1) / 2
                r = BLOCK * (task % BLOCK)
                update_row(at, place(one, row) + r, place(two, row), place(one, two) + r)
            sync()
            if row + M < rows:
                enter(at, band, world, row + M, lane, lanes)
            sync()
        if lane == 0:
            bad[world] = count

    @wp.kernel(module=module)
    def solve(
        lanes: int, outside: wp.array2d(dtype=T), band: wp.array3d(dtype=Column), slot_at: wp.array(dtype=wp.int32),
        r: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), z: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """z = A^-1 r by forward and backward substitution."""
        thread = wp.tid()
        world = thread / lanes
        lane = thread % lanes
        if active[world] == 0:
            return
        y = vector.open(outside.ptr + wp.uint64(world) * wp.uint64(outside.shape[1]) * wp.uint64(wp.static(NUMBER)))
        slots = slot_at.shape[0]
        for i in range(lane, BLOCK * rows, lanes):
            given = T(0.0)
            if i / 3 < slots:
                given = r[world, slot_at[i / 3]][i % 3]
            vector.store(y, i, given)
        sync()
        across = wp.max(lanes / BLOCK, 1)
        for row in range(rows):
            first = BLOCK * wp.max(width - row, 0)
            for a in range(lane / across, BLOCK, wp.max(lanes / across, 1)):
                s = T(0.0)
                for j in range(first + lane % across, BLOCK * width, across):
                    s += band[world, row, j][a] * vector.load(y, BLOCK * (row - width) + j)
                s = scalar_sum(s, across)
                if lane % across == 0:
                    vector.store(y, BLOCK * rows + a, vector.load(y, BLOCK * row + a) - s)
            sync()
            for a in range(lane, BLOCK, lanes):
                s = T(0.0)
                for k in range(BLOCK):
                    s += vector.load(y, BLOCK * rows + k) * band[world, row, BLOCK * width + k][a]
                vector.store(y, BLOCK * row + a, s)
            sync()
        for back in range(rows):
            row = rows - 1 - back
            x = Column()
            for k in range(BLOCK):
                column = band[world, row, BLOCK * width + k]
                s = T(0.0)
                for a in range(BLOCK):
                    s += column[a] * vector.load(y, BLOCK * row + a)
                x[k] = s
            sync()
            for j in range(BLOCK * wp.max(width - row, 0) + lane, BLOCK * width, lanes):
                k = BLOCK * (row - width) + j
                vector.store(y, k, vector.load(y, k) - wp.dot(band[world, row, j], x))
            for a in range(lane, BLOCK, lanes):
                i = BLOCK * row + a
                if i / 3 < slots:
                    z[world, slot_at[i / 3]][i % 3] = x[a]
            sync()

    return _types.SimpleNamespace(module=module, lanes=WARP, factor=factor, solve=solve)
