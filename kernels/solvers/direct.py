"""Additions to the elements' matrix that complete H for direct solvers, and the vector operations of a solve."""

import functools

import warp as wp

from ..common.block_entries import add_block_function
from ..common.lanes import lane_functions
from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import pattern_struct, topology_struct
from ..common.types import double_1d, double_3d, int_1d, int_2d, precision

__all__ = ["direct_kernels", "follower_pattern_struct"]


@functools.cache
def follower_pattern_struct():
    """Positions of the matrices of follower loads in the pattern: an entry k gathers start[k] .. start[k + 1] - 1."""

    @wp.struct
    class FollowerPattern:
        entry: wp.array(dtype=wp.int32)  # [k] index into Pattern.upper of the block
        start: wp.array(dtype=wp.int32)  # [k + 1]
        row: wp.array(dtype=wp.int32)  # row of a contribution, as local slot of a load: local * count + load
        column: wp.array(dtype=wp.int32)  # its column, as local slot

    return FollowerPattern


@functools.cache
def direct_kernels(dtype: str) -> KernelSet:
    """Kernels of the direct solver in one precision."""
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    Topology, Pattern, FollowerPattern = topology_struct(dtype), pattern_struct(), follower_pattern_struct()
    add_block = add_block_function(dtype)
    residual_products, store_products = lane_functions(dtype).residual_products, lane_functions(dtype).store_products
    module = kernel_module(f"direct_{dtype}")

    @masked_kernel(module, "active")
    def gather_local(conn: int_2d, u: p.vec3_2d, active: int_1d, out: p.vec3_2d):
        """Gather values at the slots of each item, local * count + item."""
        world, local, item = wp.tid()
        out[world, local * conn.shape[1] + item] = u[world, conn[local, item]]

    @wp.kernel(module=module)
    def set_unit_direction(local: int, component: int, count: int, out: p.vec3_2d):
        """A unit component at one local slot of every item, else 0."""
        world, k = wp.tid()
        e = vec3()
        if k / count == local:
            e[component] = T(1.0)
        out[world, k] = e

    @masked_kernel(module, "active")
    def add_follower_matrices(
        topo: Topology, pattern: Pattern, places: FollowerPattern, columns: p.vec3_3d, dq_dv: double_1d, active: int_1d,
        value: p.mat33_2d,
    ):  # fmt: skip
        """value -= (dq/dv) K, K from its products with unit vectors."""
        world, item = wp.tid()
        A = mat33()
        for k in range(places.start[item], places.start[item + 1]):
            for c in range(3):
                f = columns[3 * places.column[k] + c, world, places.row[k]]
                for i in range(3):
                    A[i, c] = A[i, c] + f[i]
        add_block(topo, pattern.upper[places.entry[item]], -T(dq_dv[world]) * A, world, value)

    @masked_kernel(module, "active")
    def dot_partials(r: p.vec3_2d, z: p.vec3_2d, diagonal: p.vec3_2d, active: int_1d, warp: int, rows: double_3d):
        """r.z and r.D^-1 r per warp of slots."""
        world, slot = wp.tid()
        products = wp.vec2d()
        if slot < z.shape[1]:
            products = residual_products(r[world, slot], z[world, slot], diagonal[world, slot])
        store_products(products, slot, warp, world, rows)

    return kernel_set(locals())
