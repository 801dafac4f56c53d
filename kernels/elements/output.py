"""Kernels of table elements for particular scenes or outputs, one module each: history, viscous force, stress,
deformation gradient."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_1d, double_2d, int_1d, precision
from . import materials
from .points import point_functions

__all__ = ["gradient_kernel", "output_kernels"]


def output_kernels(fn: KernelSet, name: str) -> KernelSet:
    """Kernels of one kind of element block.

    Args:
        fn: the functions of points.py for this kind.
        name: beginning of the names of the modules.
    """
    history_module = kernel_module(f"{name}_history")
    moving_module = kernel_module(f"{name}_history_moving")
    viscous_module = kernel_module(f"{name}_viscous")
    stress_module = kernel_module(f"{name}_stress")
    p = fn.types
    T, vec3, sym6 = p.T, p.vec3, p.sym
    t, m, Block, Local = fn.tensors, fn.law, fn.Block, fn.Local
    ETA_INDEX, LAMBDA_V_INDEX = materials.ETA_INDEX, materials.LAMBDA_V_INDEX

    @masked_kernel(history_module, "active")
    def strain_history(
        block: Block, u0: p.vec3_2d, u1: p.vec3_2d, a0: double_1d, a1: double_1d, active: int_1d, history: p.sym_2d
    ):
        """a0 E(u0) - a1 E(u1) per point in the law's axes: reference of incremental strain rates."""
        world, elem = wp.tid()
        U0 = fn.load_slots(block, u0, world, elem)
        for point in range(block.shape_gradient.shape[0]):
            E = T(a0[world]) * t.green_lagrange(fn.material_gradient(block, U0, point, elem))
            if a1[world] != wp.float64(0.0):
                U1 = fn.load_slots(block, u1, world, elem)
                E = E - T(a1[world]) * t.green_lagrange(fn.material_gradient(block, U1, point, elem))
            history[world, fn.history_index(block, point, elem)] = fn.to_voigt(E)

    @masked_kernel(moving_module, "active")
    def strain_history_with_velocity(
        block: Block,
        u: p.vec3_2d,
        v: p.vec3_2d,
        a: p.vec3_2d,
        b: double_1d,
        q_a: double_1d,
        active: int_1d,
        history: p.sym_2d,
    ):
        """E + b dE/dt + q_a d2E/dt2 per point in the law's axes: reference of strain rates for schemes with velocity
        and a."""
        world, elem = wp.tid()
        U = fn.load_slots(block, u, world, elem)
        V = fn.load_slots(block, v, world, elem)
        A = fn.load_slots(block, a, world, elem)
        for point in range(block.shape_gradient.shape[0]):
            G = fn.material_gradient(block, U, point, elem)
            D = fn.material_gradient(block, V, point, elem)
            F = wp.transpose(t.identity() + G)
            bend = wp.transpose(D) * D + F * fn.material_gradient(block, A, point, elem)
            E = t.green_lagrange(G) + T(b[world]) * t.sym(F * D) + T(q_a[world]) * t.sym(bend)
            history[world, fn.history_index(block, point, elem)] = fn.to_voigt(E)

    @masked_kernel(viscous_module, "active")
    def viscous_force(
        block: Block, u: p.vec3_2d, v: p.vec3_2d, active: int_1d, contribution: p.vec3_2d, power: double_2d
    ):
        """Kelvin-Voigt force (N), Eqs. (58)-(70), at a given state, and the power S_vis : Edot (W) lost."""
        world, elem = wp.tid()
        c = fn.coefficients(block, world, elem)
        U = fn.load_slots(block, u, world, elem)
        V = fn.load_slots(block, v, world, elem)
        f = Local()
        rate_of_work = T(0.0)
        for point in range(block.shape_gradient.shape[0]):
            G = fn.field_gradient(block, U, point, elem)
            F = t.identity() + G
            rate = t.sym(wp.transpose(F) * fn.field_gradient(block, V, point, elem))
            S = t.isotropic_stress(rate, c[LAMBDA_V_INDEX], c[ETA_INDEX])
            rate_of_work += fn.point_weight(block, point, elem) * wp.ddot(S, rate)
            f = fn.add_point_forces(block, f, F * S, point, elem)
        fn.store_forces(block, f, world, elem, contribution)
        power[world, block.element_offset + elem] = wp.float64(rate_of_work)

    @wp.kernel(module=stress_module)
    def point_stress(block: Block, u: p.vec3_2d, stress: wp.array3d(dtype=sym6), jacobian: p.scalar_3d):
        """Cauchy stress P F^T / J (Pa, elastic part, Voigt order) and J at the points, [world, point, elem]."""
        world, elem = wp.tid()
        c = fn.coefficients(block, world, elem)
        U = fn.load_slots(block, u, world, elem)
        for point in range(block.shape_gradient.shape[0]):
            G = fn.field_gradient(block, U, point, elem)
            J = T(1.0) + t.volume_change(G)
            P = fn.to_body_axes(block, m.stress(fn.to_material_axes(block, G, point, elem), c), point, elem)
            stress[world, point, elem] = fn.to_voigt((T(1.0) / J) * (P + P * wp.transpose(G)))
            jacobian[world, point, elem] = J

    return kernel_set(locals())


@functools.cache
def gradient_kernel(dtype: str, slots: int, affine: bool):
    """Kernel of F of elements with so many slots, of any law."""
    p = precision(dtype)
    fn = point_functions(dtype, "svk", slots, affine, None, False)
    Block, t, mat33 = fn.Block, fn.tensors, p.mat33

    @wp.kernel(module=kernel_module(f"gradient_{dtype}_{slots}{'_affine' if affine else ''}"))
    def point_gradient(block: Block, u: p.vec3_2d, gradient: wp.array3d(dtype=mat33)):
        """F at the points, Eq. (1), [world, point, elem]."""
        world, elem = wp.tid()
        U = fn.load_slots(block, u, world, elem)
        for point in range(block.shape_gradient.shape[0]):
            gradient[world, point, elem] = t.identity() + fn.field_gradient(block, U, point, elem)

    return point_gradient
