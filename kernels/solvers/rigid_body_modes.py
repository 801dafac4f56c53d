"""Rigid-body modes of bodies that terms couple: the matrix R^T H R, and restriction and prolongation of its solutions.

A preconditioner made of the bodies' own blocks treats contacts with other bodies as springs to ground. Chains of bodies
that move together are then far too stiff, increasingly with their length; their rigid-body modes at the linearisation
point correct that: z += R (R^T H R)^-1 R^T r, with the coupling between bodies in R^T H R.

An unknown of a body is a translation along or a rotation about an axis through its centre, over its size; a slot moves
by t + w x a with a = (x - c)/size, a gradient by w x g/size. Modes that a support resists are omitted.
"""

import functools

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.rigid import RIGID_MODES, bodies_struct, rigid_mode_functions
from ..common.structs import pattern_struct
from ..common.types import f64, int_1d, mat33d, precision, vec3d

__all__ = ["rigid_mode_kernels"]


@functools.cache
def rigid_mode_kernels(dtype: str) -> KernelSet:
    """Kernels in one precision of the slots."""
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    Bodies, Pattern = bodies_struct(dtype), pattern_struct()
    rigid = rigid_mode_functions(dtype)
    UNIT_ROUNDOFF = {"float64": 2.0**-53, "float32": 2.0**-24}[dtype]
    module = kernel_module(f"motions_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.kernel(module=module)
    def update_arms(
        bodies: Bodies, u: p.vec3_2d, active: int_1d
    ):  # fmt: skip
        """a of each slot at displacements u."""
        world, slot = wp.tid()
        body = bodies.body_of_slot[slot]
        if active[world] == 0 or body < 0:
            return
        c = vec3d()
        count = bodies.centre_slots.shape[0]
        for k in range(count):
            at = bodies.centre_slots[k, body]
            c += bodies.slot_reference[at] + vec3d(u[world, at])
        x = bodies.slot_reference[slot] + vec3d(u[world, slot]) - (f64(bodies.is_position[slot]) / f64(count)) * c
        bodies.lever_arm[world, slot] = x / bodies.body_size[body]

    @masked_kernel(module, "active")
    def body_matrix_partials(
        bodies: Bodies, pattern: Pattern, free: p.vec3_1d, value: p.mat33_2d,
        active: int_1d, lanes: int, parts: wp.array4d(dtype=mat33d),
    ):  # fmt: skip
        """R^T H R of each body, H its own blocks `value`: partial sums of a lane over slots, [world, body, lane].

        Blocks translation-translation, rotation-translation, rotation-rotation. A bound of the round-off of H is added
        to the diagonal.
        """
        world, body, lane = wp.tid()
        mm = mat33d()
        tm = mat33d()
        tt = mat33d()
        slot = bodies.first_slot[body] + lane
        while slot < bodies.end_slot[body]:
            move = mat33d()
            turn = mat33d()
            own_move = rigid.translation_columns(bodies, body, slot)
            own_turn = rigid.rotation_columns(bodies, world, body, slot)
            own_free = wp.diag(vec3d(free[slot]))
            for k in range(pattern.start[slot], pattern.start[slot + 1]):
                other = pattern.column[k]
                A = own_free @ mat33d(value[world, k]) @ wp.diag(vec3d(free[other]))
                move += A @ rigid.translation_columns(bodies, body, other)
                turn += A @ rigid.rotation_columns(bodies, world, body, other)
                if other == slot:
                    move += f64(UNIT_ROUNDOFF) * wp.diag(wp.get_diag(A)) @ own_move
                    turn += f64(UNIT_ROUNDOFF) * wp.diag(wp.get_diag(A)) @ own_turn
            mm += wp.transpose(own_move) @ move
            tm += wp.transpose(own_turn) @ move
            tt += wp.transpose(own_turn) @ turn
            slot += lanes
        parts[world, body, lane, 0] = mm
        parts[world, body, lane, 1] = tm
        parts[world, body, lane, 2] = tt

    @masked_kernel(module, "active")
    def fill_matrix(
        active: int_1d, parts: wp.array4d(dtype=mat33d), scale: p.scalar_2d,
        matrix: p.scalar_3d,
    ):  # fmt: skip
        """Block-diagonal part of the matrix, and its diagonal; rows beyond the bodies are zero."""
        world, row = wp.tid()
        for j in range(matrix.shape[2]):
            matrix[world, row, j] = T(0.0)
        scale[world, row] = T(0.0)
        body = row / RIGID_MODES
        if body >= parts.shape[1]:
            return
        a = row % 3
        turn = (row / 3) % 2
        low = vec3d()
        high = vec3d()
        for lane in range(parts.shape[2]):
            tm = parts[world, body, lane, 1]
            if turn == 0:
                low += parts[world, body, lane, 0][a]
                high += wp.transpose(tm)[a]
            else:
                low += tm[a]
                high += parts[world, body, lane, 2][a]
        for j in range(3):
            matrix[world, row, RIGID_MODES * body + j] = T(low[j])
            matrix[world, row, RIGID_MODES * body + 3 + j] = T(high[j])
        scale[world, row] = T(wp.where(turn == 0, low[a], high[a]))

    @masked_kernel(module, "active")
    def restrict(
        bodies: Bodies, r: p.vec3_2d, active: int_1d, out: p.scalar_2d
    ):  # fmt: skip
        """R^T r; a block of threads per body. r is zero at prescribed components."""
        world, body, thread = wp.tid()
        move = vec3d()
        turn = vec3d()
        slot = bodies.first_slot[body] + thread
        while slot < bodies.end_slot[body]:
            x = vec3d(r[world, slot])
            move += f64(bodies.is_position[slot]) * x
            turn += wp.cross(bodies.lever_arm[world, slot], x)
            slot += wp.block_dim()
        for k in range(3):
            s = wp.tile_extract(wp.tile_sum(wp.tile(move[k])), 0)
            w = wp.tile_extract(wp.tile_sum(wp.tile(turn[k])), 0)
            if thread == 0:
                out[world, RIGID_MODES * body + k] = T(s * bodies.free_translations[body][k])
                out[world, RIGID_MODES * body + 3 + k] = T(w * bodies.free_rotations[body][k])

    @wp.kernel(module=module)
    def prolong(
        bodies: Bodies, x: p.scalar_2d, free: p.vec3_1d, active: int_1d,
        z: p.vec3_2d,
    ):  # fmt: skip
        """z += R x on free components."""
        world, slot = wp.tid()
        body = bodies.body_of_slot[slot]
        if active[world] == 0 or body < 0:
            return
        move = vec3d()
        turn = vec3d()
        for k in range(3):
            move[k] = f64(x[world, RIGID_MODES * body + k]) * bodies.free_translations[body][k]
            turn[k] = f64(x[world, RIGID_MODES * body + 3 + k]) * bodies.free_rotations[body][k]
        s = f64(bodies.is_position[slot]) * move + wp.cross(turn, bodies.lever_arm[world, slot])
        z[world, slot] = z[world, slot] + wp.cw_mul(vec3(s), free[slot])

    return kernel_set(locals())
