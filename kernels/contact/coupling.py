"""Coupling of both sides of a contact in an assembled matrix; that of each side with itself is in assembly.py."""

import functools

import warp as wp

from ..common.block_entries import add_symmetric_function
from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import pattern_struct, topology_struct
from ..common.types import f64, int_1d, precision
from .facet_structs import master_struct
from .kinematics import kinematics_functions
from .structs import facet_struct

__all__ = ["coupling_kernels"]


@functools.cache
def coupling_kernels(dtype: str) -> KernelSet:
    """Kernels in one precision of the displacements."""
    p = precision(dtype)
    T, sym = p.T, p.sym
    Topology, Pattern = topology_struct(dtype), pattern_struct()
    Masters, Facets = master_struct(dtype), facet_struct(dtype)
    add_symmetric, is_edge = add_symmetric_function(dtype), kinematics_functions(dtype).is_edge
    module = kernel_module(f"pair_coupling_{dtype}", max_unroll=SHORT_UNROLL)

    @masked_kernel(module, "active")
    def add_couplings(
        topo: Topology, pattern: Pattern, facets: Facets, mas: Masters, start: int_1d,
        source: wp.array(dtype=wp.vec4i), stiffness: wp.array2d(dtype=sym), weight: wp.array3d(dtype=T),
        listed: wp.array2d(dtype=wp.int32), dq_dv: wp.array(dtype=f64), active: int_1d, value: p.mat33_2d,
    ):  # fmt: skip
        """value -= (dq/dv) sum over points of s_a w_b K of an entry; `source`: facet, local slot, other slot, entry."""
        world, index = wp.tid()
        k6 = sym()
        for e in range(start[index], start[index + 1]):
            at = source[e]
            if is_edge(facets, at[0]):
                continue
            for q in range(facets.point_count):
                point = facets.first_point + at[0] * facets.point_count + q
                f = listed[world, point] - 1
                if f >= 0:
                    w = T(0.0)
                    for i in range(mas.conn.shape[0]):
                        if mas.conn[i, f] == at[2]:
                            w += weight[world, point, i]
                    k6 -= (facets.shape[q, at[1], at[0]] * w) * stiffness[world, point]
        add_symmetric(topo, pattern.upper[source[start[index]][3]], T(dq_dv[world]) * k6, world, value)

    return kernel_set(locals())
