"""K p with the stress of the linear prediction in its geometric part, without a matrix; see `predicted_stress`."""

import functools
import types as _types

import warp as wp

from ..common.types import kernel_module
from .points import point_functions

__all__ = ["predicted_stress_product"]


@functools.cache
def predicted_stress_product(dtype: str, law: str, slots: int, affine: bool, framed: bool) -> wp.Kernel:
    """Kernel for one kind of element block, without viscosity; arguments as those of `element_kernels`."""
    fn: _types.SimpleNamespace = point_functions(dtype, law, slots, affine, None, framed)
    T, vec3, mat33, sym6 = fn.types.T, fn.types.vec3, fn.types.mat33, fn.types.sym
    Block, t = fn.Block, fn.tensors
    form = "affine" if affine else "framed" if framed else "table"
    module = kernel_module(f"element_{dtype}_{law}_{slots}_{form}_mixed")

    @wp.kernel(module=module)
    def product(
        block: Block,
        u: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        base: wp.array2d(dtype=vec3),
        use_prediction: wp.array(dtype=wp.int32),
        history: wp.array2d(dtype=sym6),
        dq_dv: wp.array(dtype=wp.float64),
        active: wp.array(dtype=wp.int32),
        direction: wp.array2d(dtype=vec3),
        contribution: wp.array2d(dtype=vec3),
    ):
        """K p (N); `base`: v at the previous iterate, for worlds with `use_prediction` 1; `use_prediction` 2: positive
        semi-definite form."""
        world, elem = wp.tid()
        if active[world] == 0:
            return
        c = fn.coefficients(block, world, elem)
        dq = T(dq_dv[world])
        U = fn.load(block, u, world, elem)
        P = fn.load(block, direction, world, elem)
        step = fn.Local()
        if use_prediction[world] == 1:
            step = dq * (fn.load(block, v, world, elem) - fn.load(block, base, world, elem))
        f = fn.Local()
        for point in range(block.gradient.shape[0]):
            G = fn.gradient_of(block, U, point, elem)
            dG = fn.gradient_of(block, P, point, elem)
            dP = fn.point_increment(block, G, dG, mat33(), history, c, dq, 0, world, point, elem)
            local = fn.to_material_axes(block, G, point, elem)
            if use_prediction[world] == 1:
                ahead = fn.to_material_axes(block, fn.gradient_of(block, step, point, elem), point, elem)
                dP += dG * fn.to_body_axes(block, fn.predicted_stress(local, ahead, c, dq), point, elem)
            elif use_prediction[world] == 2:
                if wp.static(fn.needs_J):
                    change = fn.to_material_axes(block, dG, point, elem)
                    dP = fn.to_body_axes(block, fn.spd_tangent(t.identity() + local, change, c), point, elem)
                else:
                    dP += fn.max_compression(fn.law.pk2_stress(t.green(local), c)) * dG
            f = fn.scatter(block, f, dP, point, elem)
        fn.store(block, f, world, elem, contribution)

    return product
