"""K p with the stress of the linear prediction in its geometric part, without a matrix: `predicted_stress_change`."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, masked_kernel
from ..common.types import double_1d, int_1d
from .points import point_functions

__all__ = ["predicted_stress_product"]


@functools.cache
def predicted_stress_product(dtype: str, law: str, slots: int, affine: bool, framed: bool) -> wp.Kernel:
    """Kernel for one kind of element block, without viscosity; arguments as those of `element_kernels`."""
    fn: KernelSet = point_functions(dtype, law, slots, affine, None, framed)
    p = fn.types
    T, mat33 = p.T, p.mat33
    Block, t = fn.Block, fn.tensors
    form = "affine" if affine else "framed" if framed else "table"
    module = kernel_module(f"element_{dtype}_{law}_{slots}_{form}_mixed")

    @masked_kernel(module, "active")
    def product(
        block: Block,
        u: p.vec3_2d,
        v: p.vec3_2d,
        base: p.vec3_2d,
        use_prediction: int_1d,
        history: p.sym_2d,
        dq_dv: double_1d,
        active: int_1d,
        direction: p.vec3_2d,
        contribution: p.vec3_2d,
    ):
        """K p (N); `base`: v at the previous iterate, for worlds with `use_prediction` 1; `use_prediction` 2: positive
        semi-definite form."""
        world, elem = wp.tid()
        c = fn.coefficients(block, world, elem)
        dq = T(dq_dv[world])
        U = fn.load_slots(block, u, world, elem)
        P = fn.load_slots(block, direction, world, elem)
        step = fn.Local()
        if use_prediction[world] == 1:
            step = dq * (fn.load_slots(block, v, world, elem) - fn.load_slots(block, base, world, elem))
        f = fn.Local()
        for point in range(block.shape_gradient.shape[0]):
            G = fn.field_gradient(block, U, point, elem)
            dG = fn.field_gradient(block, P, point, elem)
            dP = fn.point_increment(block, G, dG, mat33(), history, c, dq, 0, world, point, elem)
            local = fn.to_material_axes(block, G, point, elem)
            if use_prediction[world] == 1:
                ahead = fn.to_material_axes(block, fn.field_gradient(block, step, point, elem), point, elem)
                dP += dG * fn.to_body_axes(block, fn.predicted_stress_change(local, ahead, c, dq), point, elem)
            elif use_prediction[world] == 2:
                if wp.static(fn.needs_J):
                    change = fn.to_material_axes(block, dG, point, elem)
                    dP = fn.to_body_axes(block, fn.spd_increment(t.identity() + local, change, c), point, elem)
                else:
                    dP += fn.max_compression(fn.law.pk2_stress(t.green_lagrange(local), c)) * dG
            f = fn.add_point_forces(block, f, dP, point, elem)
        fn.store_forces(block, f, world, elem, contribution)

    return product
