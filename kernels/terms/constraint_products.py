"""Products of constraints with the exact tangent of a mid-point step, or its transpose."""

import functools

import warp as wp

from ..common.modules import kernel_module, masked_kernel
from ..common.types import double_1d, f64, int_1d, precision, vec3d
from .constraints import DISTANCE, constraint_functions, constraint_kernels, constraint_struct, multiplier_struct

__all__ = ["exact_product_kernel"]


@functools.cache
def exact_product_kernel(dtype: str) -> wp.Kernel:
    """Kernel `exact_product_terms` in one precision."""
    p = precision(dtype)
    Constraints, Multipliers = constraint_struct(), multiplier_struct()
    functions, constraint_gradients = constraint_functions(dtype), constraint_kernels(dtype, True).constraint_gradients
    module = kernel_module(f"constraints_{dtype}_midpoint_exact")

    @masked_kernel(module, "active")
    def exact_product_terms(
        con: Constraints, mul: Multipliers, u: p.vec3_2d, u_stage: p.vec3_2d, p_in: p.vec3_2d, dq_dv: double_1d,
        start: int, transposed: int, active: int_1d,
    ):  # fmt: skip
        """(dq/dv) (J_m^T rho J + lambda dJ_m/dq) p or its transpose, one vector per term; `start`: lambda dJ_m/dq_n p.

        J is that of the end and J_m that of the middle, of a distance along (a0 + a1)/(|a0| + |a1|).
        """
        world, row = wp.tid()
        kind = con.kind[row]
        first = 3 * row
        a = functions.term_vector(con, first, p_in, world)
        b = functions.term_vector(con, first + 1, p_in, world)
        a2 = functions.term_vector(con, first + 2, p_in, world)
        scale = f64(mul.signed_scale[world, row])
        f = f64(mul.target[world, row])  # the angle at which forces act
        if wp.isfinite(mul.last_target[world, row]):
            f = f64(0.5) * (mul.last_target[world, row] + f)
        if kind == DISTANCE:
            there = con.reference[first] + functions.term_vector(con, first, u, world)
            twice = f64(2.0) * (con.reference[first] + functions.term_vector(con, first, u_stage, world))
            size = wp.length(there) + wp.length(twice - there)
            n = twice / size
            along = wp.normalize(there)
            if start != 0:
                along = wp.normalize(twice - there)
            if transposed != 0:
                a = a - wp.dot(n, a) * along
            else:
                a = a - wp.dot(along, a) * n
            a = (f64(2.0) / size) * a
        G = constraint_gradients(kind, scale, f, a, b, a2)
        force = f64(0.5) * dq_dv[world] * mul.trial_multiplier[world, row]
        change = f64(0.0)
        if start == 0:
            change = dq_dv[world] * mul.penalty[world, row]
            if transposed != 0:
                change *= functions.directional_derivative(con, mul.gradient, p_in, world, row)
            else:
                change *= functions.directional_derivative(con, mul.end_gradient, p_in, world, row)
        for side in range(3):
            J = vec3d()
            if transposed != 0:
                J = mul.end_gradient[world, first + side]
            else:
                J = mul.gradient[world, first + side]
            mul.product[world, first + side] = change * J + force * G[side]

    return exact_product_terms
