"""Products K p of element blocks, without a matrix: kernels of any kind, made with its device functions."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, masked_kernel
from ..common.types import int_1d
from .element_slots import iterate_struct
from .points import point_functions

__all__ = ["predicted_stress_kernel", "predicted_stress_product", "tangent_kernel"]


def tangent_kernel(fn: KernelSet, module: wp.Module) -> wp.Kernel:
    """Kernel `tangent_product` of one kind of element block.

    Args:
        fn: functions of the kind: of points.py or assumed_strain.py.
        module: that it is compiled in.
    """
    p, Block, Iterate = fn.types, fn.Block, iterate_struct(fn.types.name)

    @masked_kernel(module, "active")
    def tangent_product(block: Block, iterate: Iterate, active: int_1d, direction: p.vec3_2d, contribution: p.vec3_2d):
        """K p (N) with K = df_int/dq at u, Eqs. (35) and (54); only the symmetric part for damping of the rate form.

        `active` 2: see `point_increment`.
        """
        world, elem = wp.tid()
        U = fn.load_slots(block, iterate.u, world, elem)
        dU = fn.load_slots(block, direction, world, elem)
        V = fn.load_velocities(block, iterate.v, world, elem)
        dq = p.T(iterate.dq_dv[world])
        f = fn.tangent_force(block, U, dU, V, iterate.history, dq, active[world], world, elem)
        fn.store_forces(block, f, world, elem, contribution)

    return tangent_product


def predicted_stress_kernel(fn: KernelSet, module: wp.Module) -> wp.Kernel:
    """Kernel `predicted_stress_product`: K p with the stress of the linear prediction in its geometric part.

    Arguments as those of `tangent_kernel`.
    """
    p, Block, Iterate = fn.types, fn.Block, iterate_struct(fn.types.name)

    @masked_kernel(module, "active")
    def predicted_stress_product(
        block: Block, iterate: Iterate, active: int_1d, direction: p.vec3_2d, contribution: p.vec3_2d
    ):
        """K p (N) by `predicted_stress_change`; `use_prediction` 2: positive semi-definite form."""
        world, elem = wp.tid()
        U = fn.load_slots(block, iterate.u, world, elem)
        dU = fn.load_slots(block, direction, world, elem)
        step = fn.load_last_change(block, iterate, world, elem)
        dq, use = p.T(iterate.dq_dv[world]), iterate.use_prediction[world]
        f = fn.predicted_force(block, U, dU, step, iterate.history, dq, use, world, elem)
        fn.store_forces(block, f, world, elem, contribution)

    return predicted_stress_product


@functools.cache
def predicted_stress_product(dtype: str, law: str, slots: int, affine: bool, framed: bool) -> wp.Kernel:
    """Kernel for one kind of element block, without viscosity; arguments as those of `element_kernels`."""
    form = "affine" if affine else "framed" if framed else "table"
    module = kernel_module(f"element_{dtype}_{law}_{slots}_{form}_mixed")
    return predicted_stress_kernel(point_functions(dtype, law, slots, affine, None, framed), module)
