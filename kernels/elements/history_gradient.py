"""Derivative of the incremental viscous force by the displacements at the start of the step, transposed."""

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
        block: Block, u: p.vec3_2d, u_n: p.vec3_2d, w: p.vec3_2d, dq_dv: double_1d, active: int_1d,
        contribution: p.vec3_2d,
    ):  # fmt: skip
        """-w.df/du_n of f = F S_vis(E - E_n)/h: the forces of the stress S_vis(sym(F^T dF))/h, dF = grad w, at u_n."""
        world, elem = wp.tid()
        c = fn.coefficients(block, world, elem)
        scale = T(1.0) / T(dq_dv[world])
        U = fn.load_slots(block, u, world, elem)
        past = fn.load_slots(block, u_n, world, elem)
        W = fn.load_slots(block, w, world, elem)
        f = Local()
        for point in range(block.shape_gradient.shape[0]):
            F = t.identity() + fn.material_gradient(block, U, point, elem)
            rate = t.sym(wp.transpose(F) * fn.material_gradient(block, W, point, elem))
            S = t.isotropic_stress(rate, scale * c[LAMBDA_V_INDEX], scale * c[ETA_INDEX])
            P = S + fn.material_gradient(block, past, point, elem) * S
            f = fn.add_point_forces(block, f, fn.to_body_axes(block, P, point, elem), point, elem)
        fn.store_forces(block, f, world, elem, contribution)

    return history_gradient
