"""Application of the two-level preconditioner: tile inverses, a coarse space of affine motions, a dense inverse.

A level has slots of 3-vectors, in tiles of up to TILE_SLOTS slots and in groups. The four affine functions 1, x, y, z
of each group are the slots of the next, coarser level; P interpolates from them (prolongation) and P^T sums onto them
(restriction). levels_build.py computes the inverses.
"""

import functools

import warp as wp

from ..common.lanes import lane_functions
from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import pattern_struct
from ..common.types import double_3d, int_1d, precision

__all__ = ["TILE_LANES", "TILE_SLOTS", "TILE_UNKNOWNS", "level_kernels", "level_struct"]

TILE_SLOTS = 16
TILE_UNKNOWNS = 3 * TILE_SLOTS
"""Unknowns of a tile."""
TILE_LANES = 64
"""Threads that invert a tile on CUDA."""


@functools.cache
def level_struct(dtype: str):
    """Constant data of a level: its tiles, groups and their affine functions."""
    T = precision(dtype).T
    vec4 = wp.types.vector(length=4, dtype=T)

    @wp.struct
    class Level:
        tile_slot: wp.array2d(dtype=wp.int32)  # [tile, position] slot or -1
        tile_of_slot: wp.array(dtype=wp.int32)  # [slot]
        position_in_tile: wp.array(dtype=wp.int32)  # [slot]
        group_start: wp.array(dtype=wp.int32)  # [group + 1]
        group_slot: wp.array(dtype=wp.int32)  # slots, group by group
        group_of_slot: wp.array(dtype=wp.int32)  # [slot]
        affine_values: wp.array(dtype=vec4)  # [slot] values of the group's affine functions 1, x, y, z
        tile_count: wp.int32
        group_count: wp.int32

    return Level


@functools.cache
def level_kernels(dtype: str, storage: str | None = None) -> KernelSet:
    """Kernels that apply the levels in one precision; `storage`: precision of the inverses, see `build_kernels`."""
    storage = storage or dtype
    S = precision(storage).T
    scaled = storage != dtype
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    Level = level_struct(dtype)
    Pattern = pattern_struct()
    lanes_of = lane_functions(dtype)
    module = kernel_module(f"levels_{dtype}{'_' + storage if scaled else ''}", max_unroll=SHORT_UNROLL)

    @masked_kernel(module, "active")
    def smooth_and_restrict(
        level: Level, inverse: wp.array4d(dtype=S), root: p.scalar_3d, by_row: int, share: int, lanes: int,
        first_group: int, r: p.vec3_2d, active: int_1d, z: p.vec3_2d, coarse: p.vec3_2d,
    ):  # fmt: skip
        """z = tile inverse times r, `share` lanes per slot; threads from `first_group` on: P^T r, `lanes` per group.

        The inverse is symmetric: access by columns is coalesced on CUDA, access by rows is contiguous on the CPU.
        """
        world, index = wp.tid()
        if index < first_group:
            part = index % share
            place = (index / share) % TILE_SLOTS
            tile = index / (share * TILE_SLOTS)
            slot = level.tile_slot[wp.min(tile, level.tile_count - 1), place]
            if tile >= level.tile_count:
                slot = -1
            s = vec3()
            if slot >= 0:
                for b in range(part, TILE_SLOTS, share):
                    other = level.tile_slot[tile, b]
                    if other >= 0:
                        x = r[world, other]
                        if wp.static(scaled):
                            for j in range(3):
                                x[j] = x[j] * root[world, tile, 3 * b + j]
                        row = 3 * place
                        column = 3 * b
                        if by_row != 0:
                            for i in range(3):
                                for j in range(3):
                                    s[i] = s[i] + T(inverse[world, tile, row + i, column + j]) * x[j]
                        else:
                            for j in range(3):
                                for i in range(3):
                                    s[i] = s[i] + T(inverse[world, tile, column + j, row + i]) * x[j]
            s = lanes_of.lane_sum(s, share)
            if part == 0 and slot >= 0:
                if wp.static(scaled):
                    for i in range(3):
                        s[i] = s[i] * root[world, tile, 3 * place + i]
                z[world, slot] = s
            return
        index -= first_group
        group = index / lanes
        lane = index % lanes
        s0 = vec3()
        s1 = vec3()
        s2 = vec3()
        s3 = vec3()
        for e in range(level.group_start[group] + lane, level.group_start[group + 1], lanes):
            slot = level.group_slot[e]
            w = level.affine_values[slot]
            x = r[world, slot]
            s0 += w[0] * x
            s1 += w[1] * x
            s2 += w[2] * x
            s3 += w[3] * x
        s0 = lanes_of.lane_sum(s0, lanes)
        s1 = lanes_of.lane_sum(s1, lanes)
        s2 = lanes_of.lane_sum(s2, lanes)
        s3 = lanes_of.lane_sum(s3, lanes)
        if lane == 0:
            coarse[world, 4 * group] = s0
            coarse[world, 4 * group + 1] = s1
            coarse[world, 4 * group + 2] = s2
            coarse[world, 4 * group + 3] = s3

    @wp.func
    def prolong_to_slot(level: Level, x: p.vec3_2d, world: int, slot: int) -> vec3:
        """(P x) at a slot: the affine motion given by its group's coarse unknowns x."""
        first = 4 * level.group_of_slot[slot]
        w = level.affine_values[slot]
        s = vec3()
        for k in range(4):
            s += w[k] * x[world, first + k]
        return s

    @masked_kernel(module, "active")
    def add_coarse_correction(
        level: Level, correct: int, x: p.vec3_2d, free: p.vec3_1d, r: p.vec3_2d, diagonal: p.vec3_2d, active: int_1d,
        warp: int, z: p.vec3_2d, rows: double_3d,
    ):  # fmt: skip
        """z += P x on free components if `correct`; rows: r.z and r.D^-1 r, one sum per warp of slots."""
        world, slot = wp.tid()
        products = wp.vec2d()
        if slot < z.shape[1]:
            s = z[world, slot]
            if correct != 0:
                s += wp.cw_mul(prolong_to_slot(level, x, world, slot), free[slot])
                z[world, slot] = s
            products = lanes_of.residual_products(r[world, slot], s, diagonal[world, slot])
        lanes_of.store_products(products, slot, warp, world, rows)

    @masked_kernel(module, "active")
    def chebyshev_step(
        level: Level, correct: int, coarse: p.vec3_2d, z: p.vec3_2d, keep: T, step: T, active: int_1d, d: p.vec3_2d,
        x: p.vec3_2d,
    ):  # fmt: skip
        """A Chebyshev step: d = keep d + step (z + P coarse), x += d; with keep = 0 both start from zero."""
        world, slot = wp.tid()
        s = z[world, slot]
        if correct != 0:
            s += prolong_to_slot(level, coarse, world, slot)
        s = step * s
        if keep == T(0.0):
            d[world, slot] = s
            x[world, slot] = s
        else:
            s += keep * d[world, slot]
            d[world, slot] = s
            x[world, slot] = x[world, slot] + s

    @masked_kernel(module, "active")
    def subtract_product(pattern: Pattern, value: p.mat33_2d, d: p.vec3_2d, lanes: int, active: int_1d, r: p.vec3_2d):
        """r -= A d, `lanes` threads per row."""
        world, index = wp.tid()
        slot = index / lanes
        lane = index % lanes
        s = vec3()
        if slot < r.shape[1]:
            for k in range(pattern.start[slot] + lane, pattern.start[slot + 1], lanes):
                s += value[world, k] * d[world, pattern.column[k]]
        s = lanes_of.lane_sum(s, lanes)
        if lane == 0 and slot < r.shape[1]:
            r[world, slot] = r[world, slot] - s

    @wp.func
    def scaled_entry(root: p.scalar_2d, r: p.scalar_2d, world: int, k: int) -> T:
        """Entry k of r, scaled by `root` for a scaled inverse."""
        if wp.static(scaled):
            return r[world, k] * root[world, k]
        else:
            return r[world, k]

    @wp.func
    def row_product(
        matrix: wp.array3d(dtype=S), root: p.scalar_2d, r: p.scalar_2d, world: int, row: int,
        first: int, n: int, lanes: int,
    ) -> T:  # fmt: skip
        """Sum of a lane's products in a row times r: columns first, first + lanes, ... below n."""
        # four independent sums keep enough loads in flight
        s0 = T(0.0)
        s1 = T(0.0)
        s2 = T(0.0)
        s3 = T(0.0)
        last = n - 3 * lanes
        k = first
        while k < last:
            s0 += T(matrix[world, row, k]) * scaled_entry(root, r, world, k)
            s1 += T(matrix[world, row, k + lanes]) * scaled_entry(root, r, world, k + lanes)
            s2 += T(matrix[world, row, k + 2 * lanes]) * scaled_entry(root, r, world, k + 2 * lanes)
            s3 += T(matrix[world, row, k + 3 * lanes]) * scaled_entry(root, r, world, k + 3 * lanes)
            k += 4 * lanes
        while k < n:
            s0 += T(matrix[world, row, k]) * scaled_entry(root, r, world, k)
            k += lanes
        return (s0 + s1) + (s2 + s3)

    @wp.func
    def store_row(root: p.scalar_2d, s: T, world: int, row: int, x: p.scalar_2d):
        """x[row] = s, scaled back for a scaled inverse."""
        if wp.static(scaled):
            x[world, row] = s * root[world, row]
        else:
            x[world, row] = s

    @masked_kernel(module, "active")
    def apply_dense_inverse(
        matrix: wp.array3d(dtype=S), root: p.scalar_2d, lanes: int, r: p.scalar_2d, active: int_1d, x: p.scalar_2d
    ):
        """x = A^-1 r with a dense inverse, `lanes` threads per row."""
        world, index = wp.tid()
        lane = index % lanes
        row = wp.min(index / lanes, x.shape[1] - 1)
        s = lanes_of.scalar_sum(row_product(matrix, root, r, world, row, lane, r.shape[1], lanes), lanes)
        if lane == 0:
            store_row(root, s, world, row, x)

    @masked_kernel(module, "active")
    def apply_triangular_inverse(
        matrix: wp.array3d(dtype=S), root: p.scalar_2d, upper: int, lanes: int, r: p.scalar_2d, active: int_1d,
        x: p.scalar_2d,
    ):  # fmt: skip
        """`apply_dense_inverse` with the lower triangle of a matrix or, `upper`, its upper one, diagonal included."""
        world, index = wp.tid()
        lane = index % lanes
        row = wp.min(index / lanes, x.shape[1] - 1)
        first = wp.where(upper != 0, row, 0) + lane
        n = wp.where(upper != 0, r.shape[1], row + 1)
        s = lanes_of.scalar_sum(row_product(matrix, root, r, world, row, first, n, lanes), lanes)
        if lane == 0:
            store_row(root, s, world, row, x)

    return kernel_set(locals())
