"""Derivative of viscous forces by the past strain of the incremental form, or by the velocities of the rate form."""

import functools

import warp as wp

from ..common.modules import kernel_module, masked_kernel
from ..common.types import double_1d, int_1d
from .points import point_functions

__all__ = ["history_gradient_kernel"]


@functools.cache
def history_gradient_kernel(dtype: str, law: str, slots: int, affine: bool, framed: bool) -> wp.Kernel:
    """Kernel `history_gradient` of one kind of element block; arguments as those of `element_kernels`."""
    form = "affine" if affine else "framed" if framed else "table"
    fn = point_functions(dtype, law, slots, affine, "incremental", framed)
    p, t, Block, Local = fn.types, fn.tensors, fn.Block, fn.Local
    T, ETA_INDEX, LAMBDA_V_INDEX = p.T, fn.ETA_INDEX, fn.LAMBDA_V_INDEX
    module = kernel_module(f"element_{dtype}_{law}_{slots}_{form}_history_gradient")

    @masked_kernel(module, "active")
    def history_gradient(
        block: Block, u: p.vec3_2d, x: p.vec3_2d, scale: double_1d, direction: p.vec3_2d, dq_dv: double_1d,
        transposed: int, active: int_1d, contribution: p.vec3_2d,
    ):  # fmt: skip
        """F S_vis(sym(A^T grad direction)/(dq/dv)), A = scale I + grad x; `transposed`: F and A change places."""
        world, elem = wp.tid()
        c = fn.coefficients(block, world, elem)
        rate = T(1.0) / T(dq_dv[world])
        U = fn.load_slots(block, u, world, elem)
        past = fn.load_slots(block, x, world, elem)
        W = fn.load_slots(block, direction, world, elem)
        f = Local()
        for point in range(block.shape_gradient.shape[0]):
            F = t.identity() + fn.material_gradient(block, U, point, elem)
            A = T(scale[world]) * t.identity() + fn.material_gradient(block, past, point, elem)
            if transposed != 0:
                B = F
                F = A
                A = B
            change = t.sym(wp.transpose(A) * fn.material_gradient(block, W, point, elem))
            P = F * t.isotropic_stress(change, rate * c[LAMBDA_V_INDEX], rate * c[ETA_INDEX])
            f = fn.add_point_forces(block, f, fn.to_body_axes(block, P, point, elem), point, elem)
        fn.store_forces(block, f, world, elem, contribution)

    return history_gradient
