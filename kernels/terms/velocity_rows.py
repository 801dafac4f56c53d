"""Constraints at the level of velocities, A(q) v = b, as rows c = A(q) (u - u~) - (dq/dv) b, m, of constraints.py.

v = (u - u~)/(dq/dv) is the scheme's velocity, with u~ its q~; in a mid-point scheme the change of the step over h. A is
held during a line search, so that the row is linear, its force A^T lambda, and its work lambda (dq/dv) b; it is updated
between searches to the iterate, in a mid-point scheme to the middle of the step.

    KNIFE        A = b . da                              no motion of a point a along a material direction b
    ROLL         A = s . (da - r (t.b db + t.a2 da2))    nor, in a direction s of the plane, of the lowest point of a
                                                         disc of radius r about a; b, a2 span it, t is off the plane
    ANGLE_RATE   A = d atan2(a2.b, a.b)                  of a joint's angle
    TRAVEL_RATE  A = d(a.b)                              of a joint's travel
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set
from ..common.types import double_1d, f64, int_1d, mat33d, precision, vec3d, vec3d_2d
from .constraint_formulas import Formula
from .constraints import VELOCITY, constraint_functions, constraint_struct, multiplier_struct
from .spring_coordinates import ANGLE, TINY, TRAVEL, coordinate_functions

__all__ = ["ANGLE_RATE", "DISC", "KNIFE", "ROLL", "TRAVEL_RATE", "velocity_kernels"]

KNIFE, ROLL, ANGLE_RATE, TRAVEL_RATE = range(4)
mat33d_1d = wp.array(dtype=mat33d)


@wp.func
def disc_height(a: vec3d, b: vec3d, a2: vec3d) -> f64:
    """Height of the lowest point over the radius: a.n - |n across b|, b the axis and n = a2."""
    along = wp.dot(b, a2)
    return wp.dot(a, a2) - wp.sqrt(wp.max(wp.dot(b, b) - along * along, f64(TINY)))


@wp.func
def disc_gradients(a: vec3d, b: vec3d, a2: vec3d) -> mat33d:
    """Derivatives by a and b; a2 is constant."""
    along = wp.dot(b, a2)
    sideways = wp.sqrt(wp.max(wp.dot(b, b) - along * along, f64(TINY)))
    return wp.matrix_from_rows(a2, -(b - along * a2) / sideways, vec3d())


@wp.func
def disc_gradient_change(a: vec3d, b: vec3d, a2: vec3d, da: vec3d, db: vec3d, da2: vec3d) -> mat33d:
    """Derivative of `disc_gradients` along (da, db)."""
    along = wp.dot(b, a2)
    sideways = wp.sqrt(wp.max(wp.dot(b, b) - along * along, f64(TINY)))
    t = (b - along * a2) / sideways
    dt = db - wp.dot(db, a2) * a2
    return wp.matrix_from_rows(vec3d(), -(dt - wp.dot(t, dt) * t) / sideways, vec3d())


DISC = Formula("disc_height", disc_height, disc_gradients, disc_gradient_change)


@functools.cache
def velocity_kernels(dtype: str) -> KernelSet:
    """Kernels of the rows in one precision of the slots."""
    p = precision(dtype)
    Constraints, Multipliers = constraint_struct(), multiplier_struct()
    functions, of_joint = constraint_functions(dtype), coordinate_functions(False)
    module = kernel_module(f"velocity_rows_{dtype}")

    @wp.func
    def coefficients(parameters: mat33d, v: mat33d) -> mat33d:
        """A on the changes of the vectors, as rows. `parameters`: normal, direction in it, and (r, form, 0)."""
        b, a2 = v[1], v[2]
        form = int(parameters[2, 1])
        if form == KNIFE:
            return wp.matrix_from_rows(b / wp.max(wp.length(b), f64(TINY)), vec3d(), vec3d())
        if form == TRAVEL_RATE:
            return of_joint.derivatives(TRAVEL, v, f64(0.0)).g
        if form == ANGLE_RATE:
            return of_joint.derivatives(ANGLE, v, of_joint.coordinate(ANGLE, v, f64(0.0))).g
        along, sideways = wp.dot(parameters[0], b), wp.dot(parameters[0], a2)
        arm = parameters[2, 0] / wp.max(wp.sqrt(along * along + sideways * sideways), f64(TINY))
        d = parameters[1]
        return wp.matrix_from_rows(d, (-arm * along) * d, (-arm * sideways) * d)

    @wp.kernel(module=module)
    def update(con: Constraints, parameters: mat33d_1d, u_stage: p.vec3_2d, active: int_1d, mul: Multipliers):
        """A of the rows at u_stage."""
        world, row = wp.tid()
        if active[world] == 0 or con.kind[row] != VELOCITY:
            return
        v = mat33d()
        for side in range(3):
            v[side] = con.reference[3 * row + side] + functions.term_vector(con, 3 * row + side, u_stage, world)
        A = con.scale[row] * coefficients(parameters[row], v)
        functions.store_gradients(mul.gradient, world, row, A)
        functions.store_gradients(mul.end_gradient, world, row, A)

    @wp.kernel(module=module)
    def evaluate(
        con: Constraints, u: p.vec3_2d, law_value: vec3d_2d, alpha: double_1d, active: int_1d,
        mul: Multipliers, u_tilde: p.vec3_2d, u_n: p.vec3_2d, span: double_1d, frozen: int_1d,
    ):  # fmt: skip
        """c at u with the A in the multipliers. `span`: dq/dv, of a mid-point scheme h. The target of a drive is its
        motion so far."""
        world, row = wp.tid()
        if active[world] == 0 or con.kind[row] != VELOCITY:
            return
        frozen[world] = 1
        c, moved = f64(0.0), f64(0.0)
        for term in range(3 * row, 3 * row + 3):
            A = mul.gradient[world, term]
            end = functions.term_vector(con, term, u, world)
            c += wp.dot(A, end - functions.term_vector(con, term, u_tilde, world))
            moved += wp.dot(A, end - functions.term_vector(con, term, u_n, world))
        c -= con.scale[row] * span[world] * functions.right_side(con, law_value, world, row)
        target = f64(0.0)
        if con.law[row] >= 0:
            target = moved / con.scale[row]
            if wp.isfinite(mul.last_target[world, row]):
                target += mul.last_target[world, row]
        functions.store_value(con, mul, u, alpha[world], world, row, con.scale[row], target, c, wp.abs(c))

    return kernel_set(locals())
