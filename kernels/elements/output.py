"""Kernels of table elements for particular scenes or outputs, one module each: history, viscous force, stress."""

import types as _types

import warp as wp

from ..common.types import kernel_module
from . import materials

__all__ = ["output_kernels"]


def output_kernels(fn: _types.SimpleNamespace, name: str) -> _types.SimpleNamespace:
    """Kernels of one kind of element block.

    Args:
        fn: the functions of points.py for this kind.
        name: beginning of the names of the modules.
    """
    history_module = kernel_module(f"{name}_history")
    moving_module = kernel_module(f"{name}_history_moving")
    viscous_module = kernel_module(f"{name}_viscous")
    stress_module = kernel_module(f"{name}_stress")
    T, vec3, sym6 = fn.types.T, fn.types.vec3, fn.types.sym
    t, m, Block, Local = fn.tensors, fn.law, fn.Block, fn.Local
    ETA, LAMBDA_V = materials.ETA, materials.LAMBDA_V

    @wp.kernel(module=history_module)
    def strain_history(
        block: Block,
        u0: wp.array2d(dtype=vec3),
        u1: wp.array2d(dtype=vec3),
        a0: wp.array(dtype=wp.float64),
        a1: wp.array(dtype=wp.float64),
        active: wp.array(dtype=wp.int32),
        history: wp.array2d(dtype=sym6),
    ):
        """a0 E(u0) - a1 E(u1) per point in the law's axes: reference of incremental strain rates."""
        world, elem = wp.tid()
        if active[world] == 0:
            return
        U0 = fn.load(block, u0, world, elem)
        for point in range(block.gradient.shape[0]):
            E = T(a0[world]) * t.green(fn.to_material_axes(block, fn.gradient_of(block, U0, point, elem), point, elem))
            if a1[world] != wp.float64(0.0):
                U1 = fn.load(block, u1, world, elem)
                E = E - T(a1[world]) * t.green(
                    fn.to_material_axes(block, fn.gradient_of(block, U1, point, elem), point, elem)
                )
            history[world, fn.history_index(block, point, elem)] = fn.to_voigt(E)

    @wp.kernel(module=moving_module)
    def moving_history(
        block: Block,
        u: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        a: wp.array2d(dtype=vec3),
        b: wp.array(dtype=wp.float64),
        q_a: wp.array(dtype=wp.float64),
        active: wp.array(dtype=wp.int32),
        history: wp.array2d(dtype=sym6),
    ):
        """E + b dE/dt + q_a d2E/dt2 per point in the law's axes: reference of strain rates for schemes with velocity
        and a."""
        world, elem = wp.tid()
        if active[world] == 0:
            return
        U = fn.load(block, u, world, elem)
        V = fn.load(block, v, world, elem)
        A = fn.load(block, a, world, elem)
        for point in range(block.gradient.shape[0]):
            G = fn.to_material_axes(block, fn.gradient_of(block, U, point, elem), point, elem)
            D = fn.to_material_axes(block, fn.gradient_of(block, V, point, elem), point, elem)
            F = wp.transpose(t.identity() + G)
            bend = wp.transpose(D) * D + F * fn.to_material_axes(
                block, fn.gradient_of(block, A, point, elem), point, elem
            )
            E = t.green(G) + T(b[world]) * t.sym(F * D) + T(q_a[world]) * t.sym(bend)
            history[world, fn.history_index(block, point, elem)] = fn.to_voigt(E)

    @wp.kernel(module=viscous_module)
    def viscous_force(
        block: Block,
        u: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        active: wp.array(dtype=wp.int32),
        contribution: wp.array2d(dtype=vec3),
        power: wp.array2d(dtype=wp.float64),
    ):
        """Kelvin-Voigt force (N), Eqs. (58)-(70), at a given state, and the power S_vis : Edot (W) lost."""
        world, elem = wp.tid()
        if active[world] == 0:
            return
        c = fn.coefficients(block, world, elem)
        U = fn.load(block, u, world, elem)
        V = fn.load(block, v, world, elem)
        f = Local()
        rate_of_work = T(0.0)
        for point in range(block.gradient.shape[0]):
            G = fn.gradient_of(block, U, point, elem)
            F = t.identity() + G
            rate = t.sym(wp.transpose(F) * fn.gradient_of(block, V, point, elem))
            S = t.isotropic(rate, c[LAMBDA_V], c[ETA])
            rate_of_work += fn.weight_of(block, point, elem) * wp.ddot(S, rate)
            f = fn.scatter(block, f, F * S, point, elem)
        fn.store(block, f, world, elem, contribution)
        power[world, block.element_offset + elem] = wp.float64(rate_of_work)

    @wp.kernel(module=stress_module)
    def point_stress(
        block: Block,
        u: wp.array2d(dtype=vec3),
        stress: wp.array3d(dtype=sym6),
        jacobian: wp.array3d(dtype=T),
    ):
        """Cauchy stress P F^T / J (Pa, elastic part, Voigt order) and J at the points, [world, point, elem]."""
        world, elem = wp.tid()
        c = fn.coefficients(block, world, elem)
        U = fn.load(block, u, world, elem)
        for point in range(block.gradient.shape[0]):
            G = fn.gradient_of(block, U, point, elem)
            J = T(1.0) + t.volume_change(G)
            P = fn.to_body_axes(block, m.stress(fn.to_material_axes(block, G, point, elem), c), point, elem)
            stress[world, point, elem] = fn.to_voigt((T(1.0) / J) * (P + P * wp.transpose(G)))
            jacobian[world, point, elem] = J

    return _types.SimpleNamespace(
        strain_history=strain_history, moving_history=moving_history, viscous_force=viscous_force,
        point_stress=point_stress,
    )  # fmt: skip
