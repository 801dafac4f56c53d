"""Cross terms of pair contact in the coarse matrix P^T H P of the two-level preconditioner (kernels/solvers/levels.py).

The contact's own-side stiffness is in H, hence in the Galerkin product; the coupling of the two bodies is not. With f_a
the affine functions of a group at a point, sum_i s_i f_a(slot i), the block of two groups is - sum of f_a f_b K.
"""

import functools

import warp as wp

from ..common.lanes import lane_functions
from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import f64, int_1d, precision
from .facet_structs import master_struct
from .kinematics import kinematics_functions
from .structs import facet_struct

__all__ = ["coarse_groups_struct", "coarse_term_kernels"]


@functools.cache
def coarse_groups_struct(dtype: str):
    """Groups of slots and the slave facets of one kind that touch them."""
    p = precision(dtype)
    vec4 = wp.types.vector(length=4, dtype=p.T)

    @wp.struct
    class CoarseGroups:
        group_of_slot: wp.array(dtype=wp.int32)
        affine_values: wp.array(dtype=vec4)  # [slot] values of the group's affine functions 1, x, y, z
        free: wp.array(dtype=p.vec3)  # [slot] 1 for free components
        pairs: wp.array(dtype=wp.vec2i)  # groups that may touch
        facet_start: wp.array(dtype=wp.int32)  # [group + 1]
        facet: wp.array(dtype=wp.int32)  # slave facets, by group

    return CoarseGroups


@functools.cache
def coarse_term_kernels(dtype: str) -> KernelSet:
    """Kernels in one precision of the displacements."""
    p = precision(dtype)
    T, vec3, mat33, sym = p.T, p.vec3, p.mat33, p.sym
    Groups, Masters, Facets = coarse_groups_struct(dtype), master_struct(dtype), facet_struct(dtype)
    lane_sum, is_edge = lane_functions(dtype).lane_sum, kinematics_functions(dtype).is_edge
    module = kernel_module(f"pair_coarse_terms_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.func
    def function_at_slot(groups: Groups, slot: int, group: int, k: int) -> vec3:
        """Affine function k of a group at a slot, by axis: zero in other groups and at prescribed components."""
        if groups.group_of_slot[slot] != group:
            return vec3()
        return groups.affine_values[slot][k] * groups.free[slot]

    @masked_kernel(module, "active")
    def add_coarse_terms(
        groups: Groups, mas: Masters, facets: Facets, stiffness: wp.array2d(dtype=sym), weight: wp.array3d(dtype=T),
        listed: wp.array2d(dtype=wp.int32), dq_dv: wp.array(dtype=f64), active: int_1d, lanes: int,
        matrix: p.scalar_3d,
    ):  # fmt: skip
        """matrix -= (dq/dv) blocks of the pairs of groups, of which either may be the slave."""
        world, index = wp.tid()
        lane = index % lanes
        entry = wp.min(index / lanes, 16 * groups.pairs.shape[0] - 1)
        pair = groups.pairs[entry / 16]
        A = mat33()
        for side in range(2):
            own = pair[side]
            other = pair[1 - side]
            k = wp.where(side == 0, (entry / 4) % 4, entry % 4)
            l = wp.where(side == 0, entry % 4, (entry / 4) % 4)
            for e in range(groups.facet_start[own] + lane, groups.facet_start[own + 1], lanes):
                item = groups.facet[e]
                if is_edge(facets, item):
                    continue
                for q in range(facets.point_count):
                    point = facets.first_point + item * facets.point_count + q
                    f = listed[world, point] - 1
                    if f >= 0:
                        o = vec3()
                        for i in range(mas.conn.shape[0]):
                            o += weight[world, point, i] * function_at_slot(groups, mas.conn[i, f], other, l)
                        if wp.length_sq(o) > T(0.0):
                            s = vec3()
                            for i in range(facets.conn.shape[0]):
                                f_s = function_at_slot(groups, facets.conn[i, item], own, k)
                                s += facets.shape[q, i, item] * f_s
                            c = stiffness[world, point]
                            B = mat33(c[0], c[5], c[4], c[5], c[1], c[3], c[4], c[3], c[2])
                            B = wp.diag(s) @ B @ wp.diag(o)
                            if side == 0:
                                A += B
                            else:
                                A += wp.transpose(B)
        scale = T(dq_dv[world])
        for i in range(3):
            total = scale * lane_sum(A[i], lanes)
            if lane == 0 and index / lanes == entry:
                row = 12 * pair[0] + 3 * ((entry / 4) % 4) + i
                for j in range(3):
                    column = 12 * pair[1] + 3 * (entry % 4) + j
                    matrix[world, row, column] = matrix[world, row, column] - total[j]
                    matrix[world, column, row] = matrix[world, column, row] - total[j]

    return kernel_set(locals())
