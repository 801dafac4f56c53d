"""Cross terms of pair contact in the matrix of rigid-body modes, see kernels/solvers/rigid_body_modes.py."""

import functools

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.rigid import RIGID_MODES, bodies_struct, rigid_mode_functions
from ..common.types import f64, mat33d, precision
from .facet_structs import master_struct
from .kinematics import kinematics_functions
from .structs import facet_struct

__all__ = ["pair_rigid_mode_kernels"]


@functools.cache
def pair_rigid_mode_kernels(dtype: str) -> KernelSet:
    """Kernels in one precision of the displacements."""
    p = precision(dtype)
    T, sym = p.T, p.sym
    Bodies, Masters, Facets = bodies_struct(dtype), master_struct(dtype), facet_struct(dtype)
    rigid, is_edge = rigid_mode_functions(dtype), kinematics_functions(dtype).is_edge
    module = kernel_module(f"pair_rigid_modes_{dtype}", max_unroll=SHORT_UNROLL)

    @masked_kernel(module, "active")
    def cross_term_sums(
        bodies: Bodies, mas: Masters, facets: Facets, contact: wp.array(dtype=wp.int32),
        first: wp.array(dtype=wp.int32),
        stiffness: wp.array2d(dtype=sym), weight: wp.array3d(dtype=T), listed: wp.array2d(dtype=wp.int32),
        active: wp.array(dtype=wp.int32), lanes: int, parts: wp.array4d(dtype=mat33d),
    ):  # fmt: skip
        """R_s^T K R_m of the points of a contact, partial sum of a lane, as blocks: translation-translation,
        translation-rotation, rotation-translation, rotation-rotation of slave and master."""
        world, index, lane = wp.tid()
        c = contact[index]
        a = bodies.body_of_slot[facets.conn[0, (first[c] - facets.first_point) / facets.point_count]]
        mm = mat33d()
        mt = mat33d()
        tm = mat33d()
        tt = mat33d()
        point = first[c] + lane
        while point < first[c + 1]:
            f = listed[world, point] - 1
            k = stiffness[world, point]
            item = (point - facets.first_point) / facets.point_count
            if f >= 0 and wp.length_sq(k) > T(0.0) and not is_edge(facets, item):
                q = (point - facets.first_point) % facets.point_count
                b = bodies.body_of_slot[mas.conn[0, f]]
                sm = mat33d()
                st = mat33d()
                for i in range(facets.conn.shape[0]):
                    s = f64(facets.shape[q, i, item])
                    sm += s * rigid.translation_columns(bodies, a, facets.conn[i, item])
                    st += s * rigid.rotation_columns(bodies, world, a, facets.conn[i, item])
                om = mat33d()
                ot = mat33d()
                for i in range(mas.conn.shape[0]):
                    s = f64(weight[world, point, i])
                    om += s * rigid.translation_columns(bodies, b, mas.conn[i, f])
                    ot += s * rigid.rotation_columns(bodies, world, b, mas.conn[i, f])
                K = mat33d(f64(k[0]), f64(k[5]), f64(k[4]), f64(k[5]), f64(k[1]), f64(k[3]), f64(k[4]), f64(k[3]),
                           f64(k[2]))  # fmt: skip
                mm += wp.transpose(sm) @ K @ om
                mt += wp.transpose(sm) @ K @ ot
                tm += wp.transpose(st) @ K @ om
                tt += wp.transpose(st) @ K @ ot
            point += lanes
        parts[world, c, lane, 0] = mm
        parts[world, c, lane, 1] = mt
        parts[world, c, lane, 2] = tm
        parts[world, c, lane, 3] = tt

    @masked_kernel(module, "active")
    def add_cross_terms(
        pair: wp.array(dtype=wp.vec2i), start: wp.array(dtype=wp.int32), source: wp.array(dtype=wp.vec2i),
        parts: wp.array4d(dtype=mat33d), dq_dv: wp.array(dtype=f64), active: wp.array(dtype=wp.int32),
        matrix: wp.array3d(dtype=T),
    ):  # fmt: skip
        """matrix -= (dq/dv) sums of each pair of bodies; `source`: contact, and 1 if its slave is the second body."""
        world, index, block = wp.tid()
        at = pair[index]
        turn_a = block / 2
        turn_b = block % 2
        total = mat33d()
        for e in range(start[index], start[index + 1]):
            c = source[e][0]
            s = mat33d()
            for lane in range(parts.shape[2]):
                if source[e][1] == 0:
                    s += parts[world, c, lane, block]
                else:
                    s += wp.transpose(parts[world, c, lane, 2 * turn_b + turn_a])
            total += dq_dv[world] * s
        for i in range(3):
            for j in range(3):
                row = RIGID_MODES * at[0] + 3 * turn_a + i
                column = RIGID_MODES * at[1] + 3 * turn_b + j
                matrix[world, row, column] = T(-total[i, j])
                matrix[world, column, row] = T(-total[i, j])

    return kernel_set(locals())
