"""Construction of the two-level preconditioner: tiles and dense matrices are filled, inverted by Gauss-Jordan, stored.

On CUDA the threads (lanes) of a block share the work on a tile; on the CPU one thread does it.
"""

import functools

import warp as wp

from ..common.lanes import block_memory, lane_functions
from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import pattern_struct
from ..common.types import double_2d, double_3d, f64, int_1d, precision
from .levels import TILE_UNKNOWNS, level_struct

__all__ = ["FACTOR_LANES", "build_kernels"]

FACTOR_LANES = 512
"""Threads that factor a dense matrix on CUDA."""
ROW_LANES = 128
"""Threads among these along a row of the matrix."""


@functools.cache
def build_kernels(dtype: str, storage: str | None = None) -> KernelSet:
    """Kernels that build the levels in one precision.

    `storage`: precision of the stored inverses, by default the same. In another one an inverse B of A is stored as
    R B R with R^2 = diag A, with a diagonal shift that keeps it positive definite after rounding.
    """
    storage = storage or dtype
    S = precision(storage).T
    STORAGE_ROUNDOFF = {"float64": 2.0**-53, "float32": 2.0**-24}[storage]
    p = precision(dtype)
    T, mat33 = p.T, p.mat33
    vec4 = wp.types.vector(length=4, dtype=T)
    Level = level_struct(dtype)
    Pattern = pattern_struct()
    sync = lane_functions(dtype).sync
    ROW_BYTES = TILE_UNKNOWNS * wp.types.type_size_in_bytes(T)
    memory, line = block_memory(dtype, TILE_UNKNOWNS * TILE_UNKNOWNS), block_memory(dtype, TILE_UNKNOWNS)
    # a pivot below this fraction of its diagonal entry is round-off: the functions are linearly dependent
    NEGLIGIBLE_PIVOT = {"float64": 1.0e-12, "float32": 1.0e-5}[storage]
    # the fraction for a factorisation, which also accepts near-mechanisms
    MIN_FACTOR_PIVOT = {"float64": 1.0e-14, "float32": 3.0e-7}[dtype]
    module = kernel_module(f"levels_build_{dtype}{'_' + storage if storage != dtype else ''}", max_unroll=SHORT_UNROLL)

    @masked_kernel(module, "active")
    def fill_tiles(
        level: Level, pattern: Pattern, value: p.mat33_2d, active: int_1d, diagonal: p.scalar_3d,
        matrix: wp.array4d(dtype=T),
    ):  # fmt: skip
        """Block of A for each tile, and its diagonal; one thread per slot, rows without an unknown are zero."""
        world, tile, place = wp.tid()
        for a in range(3):
            diagonal[world, tile, 3 * place + a] = T(0.0)
            for j in range(TILE_UNKNOWNS):
                matrix[world, tile, 3 * place + a, j] = T(0.0)
        slot = level.tile_slot[tile, place]
        if slot < 0:
            return
        for k in range(pattern.start[slot], pattern.start[slot + 1]):
            other = pattern.column[k]
            if level.tile_of_slot[other] == tile:
                b = 3 * level.position_in_tile[other]
                A = value[world, k]
                for i in range(3):
                    for j in range(3):
                        matrix[world, tile, 3 * place + i, b + j] = A[i, j]
        for a in range(3):
            diagonal[world, tile, 3 * place + a] = matrix[world, tile, 3 * place + a, 3 * place + a]

    @wp.func
    def eliminate_tile_column(at: wp.uint64, c: wp.uint64, k: int, j: int, scale: T):
        """Column j of a tile after pivot k of Gauss-Jordan, of which c is the column and `scale` the inverse."""
        if j == k:
            for i in range(TILE_UNKNOWNS):
                memory.store(at, TILE_UNKNOWNS * i + k, -scale * line.load(c, i))
            memory.store(at, TILE_UNKNOWNS * k + k, scale)
        else:
            d = scale * memory.load(at, TILE_UNKNOWNS * k + j)
            for i in range(0, TILE_UNKNOWNS, 4):  # four rows load at once
                s = vec4()
                for a in range(4):
                    s[a] = memory.load(at, TILE_UNKNOWNS * (i + a) + j) - d * line.load(c, i + a)
                for a in range(4):
                    memory.store(at, TILE_UNKNOWNS * (i + a) + j, s[a])
            memory.store(at, TILE_UNKNOWNS * k + j, d)

    @wp.kernel(module=module)
    def invert_tiles(
        lanes: int, tiles: int, keep: int, active: int_1d, diagonal: p.scalar_3d, column: p.scalar_3d,
        matrix: wp.array4d(dtype=T),
    ):  # fmt: skip
        """Inverse of each tile in place, by Gauss-Jordan; a block of threads works in its shared memory.

        A row whose pivot is not safely positive against the diagonal of A is dropped: zeros, or with `keep` the inverse
        of that diagonal. The result is therefore always positive semi-definite, with `keep` definite.
        """
        thread = wp.tid()
        lane = thread % lanes
        index = thread / lanes
        tile = index % tiles
        world = index / tiles
        if active[world] == 0:
            return
        place = wp.uint64(world * tiles + tile)
        own = matrix.ptr + place * wp.uint64(wp.static(ROW_BYTES * TILE_UNKNOWNS))
        at = memory.open(own)
        c = line.open(column.ptr + place * wp.uint64(wp.static(ROW_BYTES)))
        if lanes > 1:
            for i in range(lane, TILE_UNKNOWNS * TILE_UNKNOWNS, lanes):
                memory.store(at, i, memory.load(own, i))
        for k in range(TILE_UNKNOWNS):
            sync()
            for i in range(lane, TILE_UNKNOWNS, lanes):
                line.store(c, i, memory.load(at, TILE_UNKNOWNS * i + k))
            sync()
            pivot = line.load(c, k)
            size = diagonal[world, tile, k]
            if pivot > T(NEGLIGIBLE_PIVOT) * size and size > T(0.0):
                scale = T(1.0) / pivot
                for j in range(lane, TILE_UNKNOWNS, lanes):
                    eliminate_tile_column(at, c, k, j, scale)
            else:
                for j in range(lane, TILE_UNKNOWNS, lanes):
                    memory.store(at, TILE_UNKNOWNS * k + j, T(0.0))
                    memory.store(at, TILE_UNKNOWNS * j + k, T(0.0))
                sync()
                if lane == 0 and keep != 0 and wp.abs(size) > T(0.0):
                    # the sign marks the row: it stays zero for later pivots and is filled in at the end
                    diagonal[world, tile, k] = -wp.abs(size)
        sync()
        for j in range(lane, TILE_UNKNOWNS, lanes):
            size = diagonal[world, tile, j]
            if size < T(0.0) and keep != 0:
                memory.store(at, TILE_UNKNOWNS * j + j, -T(1.0) / size)
        sync()
        if lanes > 1:
            for i in range(lane, TILE_UNKNOWNS * TILE_UNKNOWNS, lanes):
                memory.store(own, i, memory.load(at, i))

    @masked_kernel(module, "active")
    def fill_dense(
        pattern: Pattern, value: p.mat33_2d, slots: int, active: int_1d, scale: p.scalar_2d, matrix: p.scalar_3d
    ):
        """A as a dense matrix, and its diagonal; one thread per slot, rows beyond the slots are zero."""
        world, slot = wp.tid()
        for a in range(3):
            scale[world, 3 * slot + a] = T(0.0)
            for j in range(matrix.shape[2]):
                matrix[world, 3 * slot + a, j] = T(0.0)
        if slot >= slots:
            return
        for k in range(pattern.start[slot], pattern.start[slot + 1]):
            b = 3 * pattern.column[k]
            A = value[world, k]
            for i in range(3):
                for j in range(3):
                    matrix[world, 3 * slot + i, b + j] = A[i, j]
                if pattern.column[k] == slot:
                    scale[world, 3 * slot + i] = A[i, i]

    @masked_kernel(module, "active")
    def copy_pivot_block(
        matrix: p.scalar_3d, scale: p.scalar_2d, first: int, active: int_1d, diagonal: p.scalar_3d,
        pivot: wp.array4d(dtype=T),
    ):  # fmt: skip
        """Copy of the pivot block and of the diagonal of A there."""
        world, i, j = wp.tid()
        pivot[world, 0, i, j] = matrix[world, first + i, first + j]
        if i == j:
            diagonal[world, 0, i] = scale[world, first + i]

    @masked_kernel(module, "active")
    def compute_panels(
        matrix: p.scalar_3d, pivot: wp.array4d(dtype=T), first: int, active: int_1d, left: p.scalar_3d, top: p.scalar_3d
    ):
        """left = A_ik P with P the inverse pivot block, top = A_kj: panels of the rank update; a thread computes four
        rows of `left`, which share their loads."""
        world, m4, i = wp.tid()
        m = 4 * m4
        s = vec4()
        for n in range(TILE_UNKNOWNS):
            x = matrix[world, first + n, i]  # A_ki, whose loads coalesce
            for a in range(4):
                s[a] = s[a] + x * pivot[world, 0, n, m + a]
        # A is symmetric beside the pivot except for the sign of eliminated columns
        sign = wp.where(i < first, T(-1.0), T(1.0))
        for a in range(4):
            left[world, m + a, i] = sign * s[a]
            top[world, m + a, i] = matrix[world, first + m + a, i]

    @masked_kernel(module, "active")
    def eliminate_pivot_block(
        pivot: wp.array4d(dtype=T), left: p.scalar_3d, top: p.scalar_3d, first: int, active: int_1d, matrix: p.scalar_3d
    ):
        """One pivot of block Gauss-Jordan; a thread updates four rows of a column, which share their loads."""
        world, i4, j = wp.tid()
        i = 4 * i4
        # a tile's size is a multiple of 4: the four rows are all in the pivot's or all outside
        in_row = i >= first and i < first + TILE_UNKNOWNS
        in_column = j >= first and j < first + TILE_UNKNOWNS
        s = vec4()
        if in_row and in_column:
            for a in range(4):
                s[a] = pivot[world, 0, i - first + a, j - first]
        elif in_column:
            for a in range(4):
                s[a] = -left[world, j - first, i + a]
        elif in_row:
            for m in range(TILE_UNKNOWNS):
                x = top[world, m, j]
                for a in range(4):
                    s[a] = s[a] + pivot[world, 0, i - first + a, m] * x
        else:
            for a in range(4):
                s[a] = matrix[world, i + a, j]
            for m in range(TILE_UNKNOWNS):
                x = top[world, m, j]
                for a in range(4):
                    s[a] = s[a] - left[world, m, i + a] * x
        for a in range(4):
            matrix[world, i + a, j] = s[a]

    @wp.kernel(module=module)
    def factor_dense(
        lanes: int, diagonal: p.scalar_2d, active: int_1d, columns: p.scalar_3d, rows: p.scalar_3d, matrix: p.scalar_3d
    ):
        """L^-1 of A = L L^T in place of A, and L^-T above the diagonal; one block per world.

        The small eigenvalues of an explicit inverse would have errors of its largest times round-off. A pivot
        that is not safely positive against the diagonal of A is replaced by that diagonal and the rest of its column of
        L is zero, so that L L^T is positive definite for any A. Unknowns without a diagonal get zeros.
        """
        thread = wp.tid()
        lane = thread % lanes
        world = thread / lanes
        if active[world] == 0:
            return
        n = matrix.shape[1]
        across = wp.min(lanes, ROW_LANES)  # threads side by side in a row
        for k in range(n):
            for i in range(lane, n, lanes):
                columns[world, 0, i] = matrix[world, i, k]
                rows[world, 0, i] = matrix[world, k, i]
            sync()
            pivot = columns[world, 0, k]
            size = wp.abs(diagonal[world, k])
            safe = pivot > T(MIN_FACTOR_PIVOT) * size and size > T(0.0)
            scale = T(0.0)
            if safe:
                scale = T(1.0) / wp.sqrt(pivot)
            elif size > T(0.0):
                scale = T(1.0) / wp.sqrt(size)
            # left of column k is L^-1, from there on the remainder of A; a thread updates four rows of a column,
            # with simultaneous loads
            if safe:
                i = 4 * ((k + 1) / 4 + lane / across)
                while i < n:
                    l = vec4()
                    for a in range(4):
                        if i + a > k:
                            l[a] = scale * columns[world, 0, i + a]
                    for j in range(lane % across, i + 4, across):
                        d = scale * wp.where(j > k, columns[world, 0, j], rows[world, 0, j])
                        s = vec4()
                        for a in range(4):
                            s[a] = matrix[world, i + a, j] - l[a] * d
                        for a in range(4):
                            matrix[world, i + a, j] = s[a]
                    i += 4 * (lanes / across)
                sync()
            for j in range(lane, n, lanes):
                if j > k:
                    matrix[world, j, k] = wp.where(safe, -scale * scale * columns[world, 0, j], T(0.0))
            for j in range(lane, k + 1, lanes):
                own = wp.where(safe, scale * rows[world, 0, j], T(0.0))
                matrix[world, k, j] = wp.where(j == k, scale, own)
            sync()
        for item in range(lane, n * n, lanes):
            i = item / n
            j = item % n
            if j > i:
                matrix[world, i, j] = matrix[world, j, i]

    @wp.func
    def inverse_sqrt(d: T) -> T:
        """1/sqrt|d| of an entry of diag A; 0 without an unknown."""
        return wp.where(d == T(0.0), T(0.0), T(1.0) / wp.sqrt(wp.abs(d)))

    @wp.func
    def storage_entry(b: T, own: T, other: T, on_diagonal: bool, trace: T) -> S:
        """Entry of R B R in the storage's precision; the diagonal includes the shift for its rounding."""
        x = T(0.0)
        if own > T(0.0) and other > T(0.0):
            x = b / (own * other)
            if on_diagonal:
                x += T(STORAGE_ROUNDOFF) * trace
        return S(x)

    @masked_kernel(module, "active")
    def store_tile_inverses(
        tiles: int, diagonal: p.scalar_3d, matrix: wp.array4d(dtype=T), active: int_1d, root: p.scalar_3d,
        stored: wp.array4d(dtype=S),
    ):  # fmt: skip
        """Store the inverses of tiles, one thread per row."""
        world, tile, i = wp.tid()
        trace = T(0.0)
        for j in range(TILE_UNKNOWNS):
            trace += matrix[world, tile, j, j] * wp.abs(diagonal[world, tile, j])
        own = inverse_sqrt(diagonal[world, tile, i])
        root[world, tile, i] = own
        for j in range(TILE_UNKNOWNS):
            other = inverse_sqrt(diagonal[world, tile, j])
            stored[world, tile, i, j] = storage_entry(matrix[world, tile, i, j], own, other, i == j, trace)

    @masked_kernel(module, "active")
    def store_dense_inverse(
        diagonal: p.scalar_2d, trace: double_2d, matrix: p.scalar_3d, active: int_1d, root: p.scalar_2d,
        stored: wp.array3d(dtype=S),
    ):  # fmt: skip
        """Store the dense inverse, one thread per entry."""
        world, i, j = wp.tid()
        own = inverse_sqrt(diagonal[world, i])
        other = inverse_sqrt(diagonal[world, j])
        stored[world, i, j] = storage_entry(matrix[world, i, j], own, other, i == j, T(trace[0, world]))
        if i == j:
            root[world, i] = own

    @masked_kernel(module, "active")
    def trace_terms(diagonal: p.scalar_2d, matrix: p.scalar_3d, active: int_1d, rows: double_3d):
        """Terms of the trace of R B R."""
        world, i = wp.tid()
        rows[0, world, i] = f64(matrix[world, i, i] * wp.abs(diagonal[world, i]))

    return kernel_set(locals())
