"""Constraint rows c = scale (h(a, b, a2) - f) by a formula h of their vectors, beside those of constraints.py."""

import functools
from typing import Any, NamedTuple

import warp as wp

from ..common.modules import KernelSet, definition_name, kernel_module, kernel_set
from ..common.types import double_1d, f64, int_1d, mat33d, precision, vec3d_2d
from .constraints import constraint_functions, constraint_struct, multiplier_struct

__all__ = ["Formula", "formula_kernels"]


class Formula(NamedTuple):
    """Scalar function h of three vectors, each linear in the slots (kernels/terms/constraints.py), in float64.

    Attributes:
        name: unique, part of names of modules.
        value: device function (a, b, a2) -> h.
        gradients: (a, b, a2) -> dh/da, dh/db, dh/da2, the rows of a wp.mat33d.
        gradient_change: (a, b, a2, da, db, da2) -> derivative of `gradients` along (da, db, da2).
    """

    name: str
    value: Any
    gradients: Any
    gradient_change: Any

    def __str__(self) -> str:
        return self.name


@functools.cache
def formula_kernels(dtype: str, midpoint: bool, formula: Formula) -> KernelSet:
    """Kernels of the rows of one formula, for one precision of the slots.

    `midpoint`: forces act along the gradients at the middle of a step. The work of a step is lambda times the change of
    c where h is at most quadratic, else up to a third-order term.
    """
    p = precision(dtype)
    mat33d_2d = wp.array2d(dtype=mat33d)
    Constraints, Multipliers = constraint_struct(), multiplier_struct()
    functions = constraint_functions(dtype)
    name = f"constraint_formula_{definition_name(formula.name, formula)}"
    module = kernel_module(f"{name}_{dtype}{'_midpoint' if midpoint else ''}")

    @wp.func
    def row_vectors(con: Constraints, x: p.vec3_2d, world: int, row: int) -> mat33d:
        """Vectors a, b, a2 of a row, as rows."""
        out = mat33d()
        for side in range(3):
            out[side] = con.reference[3 * row + side] + functions.term_vector(con, 3 * row + side, x, world)
        return out

    @wp.func
    def derivative_along(v: mat33d, side: int, axis: int) -> mat33d:
        """Derivative of the gradients along a component of one vector."""
        d = mat33d()
        d[side, axis] = f64(1.0)
        return formula.gradient_change(v[0], v[1], v[2], d[0], d[1], d[2])

    @wp.func
    def store_derivatives(gradient: vec3d_2d, curvature: mat33d_2d, world: int, row: int, scale: f64, v: mat33d):
        """Store first and second derivatives of c at the vectors v of a row."""
        functions.store_gradients(gradient, world, row, scale * formula.gradients(v[0], v[1], v[2]))
        for side in range(3):
            x = scale * derivative_along(v, side, 0)
            y = scale * derivative_along(v, side, 1)
            z = scale * derivative_along(v, side, 2)
            for other in range(3):
                curvature[world, 9 * row + 3 * other + side] = wp.matrix_from_cols(x[other], y[other], z[other])

    @wp.kernel(module=module)
    def evaluate(
        kind: int, con: Constraints, u: p.vec3_2d, u_stage: p.vec3_2d, law_value: vec3d_2d, alpha: double_1d,
        active: int_1d, mul: Multipliers,
    ):  # fmt: skip
        """c at u, its derivatives at u_stage, as `evaluate` of constraints.py."""
        world, row = wp.tid()
        if active[world] == 0 or con.kind[row] != kind:
            return
        scale = con.scale[row]
        f = functions.right_side(con, law_value, world, row)
        v = row_vectors(con, u, world, row)
        c = scale * (formula.value(v[0], v[1], v[2]) - f)
        size, g = wp.abs(c), scale * formula.gradients(v[0], v[1], v[2])
        for side in range(3):
            size += wp.length(g[side]) * wp.length(v[side])  # c cancels on whole vectors
        if wp.static(midpoint):
            functions.store_gradients(mul.end_gradient, world, row, g)
            v = row_vectors(con, u_stage, world, row)
        store_derivatives(mul.gradient, mul.curvature, world, row, scale, v)
        functions.store_value(con, mul, u, alpha[world], world, row, scale, f, c, size)

    @wp.kernel(module=module)
    def derivatives(
        kind: int, kinds: int_1d, scale: double_1d, vectors: vec3d_2d, gradient: vec3d_2d, curvature: mat33d_2d
    ):
        """Derivatives of c at given vectors [world, 3 row + side]."""
        world, row = wp.tid()
        if kinds[row] == kind:
            v = wp.matrix_from_rows(vectors[world, 3 * row], vectors[world, 3 * row + 1], vectors[world, 3 * row + 2])
            store_derivatives(gradient, curvature, world, row, scale[row], v)

    return kernel_set(locals())
