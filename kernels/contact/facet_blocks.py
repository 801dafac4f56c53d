"""Matrix blocks of contact between bodies: the diagonal blocks of each side."""

import functools
import types as _types

import warp as wp

from ..common.block_entries import add_symmetric_function
from ..common.structs import pattern_struct, topology_struct
from ..common.types import SHORT_UNROLL, kernel_module, kernel_set, precision
from .facet_structs import point_list_struct

__all__ = ["pair_block_kernels"]


@functools.cache
def pair_block_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernel for master facets; slave facets use that of contact with obstacles."""
    p = precision(dtype)
    T, mat33, sym = p.T, p.mat33, p.sym
    f64 = wp.float64
    Topology, Pattern, PointLists = topology_struct(dtype), pattern_struct(), point_list_struct()
    add_symmetric = add_symmetric_function(dtype)
    module = kernel_module(f"pair_blocks_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.kernel(module=module)
    def add_master_blocks(
        topo: Topology, pattern: Pattern, entry: wp.array(dtype=wp.int32), start: wp.array(dtype=wp.int32),
        source: wp.array(dtype=wp.vec3i), stiffness: wp.array2d(dtype=sym), weight: wp.array3d(dtype=T),
        lists: PointLists, dq_dv: wp.array(dtype=f64), active: wp.array(dtype=wp.int32), value: wp.array2d(dtype=mat33),
    ):  # fmt: skip
        """value += (dq/dv) sum over the points of a facet of w_a w_b K; `source`: facet and two of its slots."""
        world, index = wp.tid()
        if active[world] == 0:
            return
        k6 = sym()
        for e in range(start[index], start[index + 1]):
            at = source[e]
            begin = lists.list_start[world, at[0]]
            for k in range(lists.list_size[world, at[0]]):
                point = lists.list_point[world, begin + k]
                k6 += (weight[world, point, at[1]] * weight[world, point, at[2]]) * stiffness[world, point]
        add_symmetric(topo, pattern.upper[entry[index]], T(dq_dv[world]) * k6, world, value)

    return kernel_set(locals())
