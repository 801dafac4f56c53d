"""Contributions of constraints to the matrix of H."""

import functools

import warp as wp

from ..common.block_entries import add_block_function
from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import pattern_struct, topology_struct
from ..common.types import double_1d, double_2d, f64, int_1d, precision, vec3d_2d
from .constraints import ANGLE, DISTANCE, FORMULA, constraint_struct, multiplier_struct

__all__ = ["constraint_block_kernels", "coupling_struct"]


@functools.cache
def coupling_struct():
    """Contributions of constraints to matrix entries: rho w grad_a grad_b^T."""

    @wp.struct
    class Couplings:
        entry: wp.array(dtype=wp.int32)  # [item] index into Pattern.upper
        start: wp.array(dtype=wp.int32)  # [item + 1]
        term_a: wp.array(dtype=wp.int32)  # index into Multipliers.gradient
        term_b: wp.array(dtype=wp.int32)
        weight: wp.array(dtype=wp.float64)

    return Couplings


@functools.cache
def constraint_block_kernels(dtype: str) -> KernelSet:
    """Kernels that add the constraints' part to a matrix, in one precision of its blocks."""
    p = precision(dtype)
    mat33 = p.mat33
    Topology, Pattern, Couplings = topology_struct(dtype), pattern_struct(), coupling_struct()
    Constraints, Multipliers = constraint_struct(), multiplier_struct()
    add_block = add_block_function(dtype)
    module = kernel_module(f"couplings_{dtype}", max_unroll=SHORT_UNROLL)

    @masked_kernel(module, "active")
    def add_penalties(
        topo: Topology, pattern: Pattern, pairs: Couplings, gradient: vec3d_2d, stiffness: double_2d, dq_dv: double_1d,
        active: int_1d, value: p.mat33_2d,
    ):  # fmt: skip
        """value += (dq/dv) J^T rho J."""
        world, item = wp.tid()
        A = wp.mat33d()
        for k in range(pairs.start[item], pairs.start[item + 1]):
            factor = pairs.weight[k] * dq_dv[world] * stiffness[world, pairs.term_a[k] / 3]
            A += factor * wp.outer(gradient[world, pairs.term_a[k]], gradient[world, pairs.term_b[k]])
        add_block(topo, pattern.upper[pairs.entry[item]], mat33(A), world, value)

    @wp.func
    def second_derivative(con: Constraints, mul: Multipliers, world: int, row: int, a: int, b: int) -> wp.mat33d:
        """d2c / (d vector a  d vector b) of a row, a and b its sides."""
        kind = con.kind[row]
        f = mul.target[world, row]
        scale = mul.signed_scale[world, row]
        one = wp.identity(n=3, dtype=f64)
        if kind >= FORMULA:
            return mul.curvature[world, 9 * row + 3 * a + b]
        if kind == DISTANCE:
            n = mul.gradient[world, 3 * row] / scale
            size = wp.abs(mul.constraint_value[world, row] / scale + f)
            if a == 0 and b == 0:
                return (scale / size) * (one - wp.outer(n, n))
        elif kind == ANGLE:
            if a + b == 1:
                return -scale * wp.sin(f) * one
            if a + b == 3:
                return scale * wp.cos(f) * one
        elif a + b == 1:
            return scale * one
        return wp.mat33d()

    @masked_kernel(module, "active")
    def add_tangent(
        topo: Topology, pattern: Pattern, pairs: Couplings, con: Constraints, mul: Multipliers, midpoint_factor: f64,
        dq_dv: double_1d, active: int_1d, value: p.mat33_2d,
    ):  # fmt: skip
        """value += (dq/dv) (J^T rho J + midpoint_factor sum lambda d2c/dq2), as gradients move with u."""
        world, item = wp.tid()
        A = wp.mat33d()
        for k in range(pairs.start[item], pairs.start[item + 1]):
            a = pairs.term_a[k]
            b = pairs.term_b[k]
            row = a / 3
            penalty_part = mul.penalty[world, row] * wp.outer(mul.gradient[world, a], mul.gradient[world, b])
            curvature_part = (
                midpoint_factor
                * mul.trial_multiplier[world, row]
                * second_derivative(con, mul, world, row, a - 3 * row, b - 3 * row)
            )
            A += pairs.weight[k] * (penalty_part + curvature_part)
        add_block(topo, pattern.upper[pairs.entry[item]], mat33(dq_dv[world] * A), world, value)

    return kernel_set(locals())
