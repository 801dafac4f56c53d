"""Products with the exact derivative of the force, or its transpose, where `tangent_product` takes a symmetric part:
of mid-point schemes, and of damping in the rate form.

A mid-point force F S acts along F at the middle, and S is a function of the strains E0 and E1 at both ends, whose
changes are along F0 and F1, the end values of F: K = (1/2) G S + F dS/dE1 : F1^T, and dS/dE0 : F0^T by the start.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, masked_kernel
from ..common.types import int_1d, precision
from . import materials
from .assumed_strain import assumed_strain_kernels
from .element_slots import iterate_struct
from .energy_momentum import energy_momentum_law
from .matrix import scheme_suffix
from .points import point_functions

__all__ = ["exact_product_kernel", "tied_exact_product_kernel"]

UNRESOLVED_CHANGE = 1.0e-17
"""|E1 - E0|^2 below which the second order of a discrete gradient is round-off; it is of the size of the change."""


@functools.cache
def midpoint_moduli(law: str, dtype: str, dissipative: bool, viscous: bool) -> wp.Function:
    """Device function: change of the stress of a mid-point step by the strain at one end, or its transpose."""
    p, t = precision(dtype), materials.tensor_functions(dtype)
    T, mat33, coef = p.T, p.mat33, t.coef
    mean, linear = energy_momentum_law(law, dtype), law in materials.DEFINED_FOR_ANY_J
    ETA_INDEX, LAMBDA_V_INDEX = materials.ETA_INDEX, materials.LAMBDA_V_INDEX
    discrete_gradient_change = None if linear else discrete_gradient_moduli(law, dtype)

    @wp.func
    def stress_change(G: mat33, D: mat33, X: mat33, c: coef, dissipation: T, dq: T, end: T, transposed: int) -> mat33:
        """dS by a change X of the strain at the end (`end` 1) or the start (-1) of the step, Pa."""
        dS = mat33()
        if wp.static(linear):
            dS = T(0.5) * mean.mean_increment(G, X, c)
        else:
            dS = discrete_gradient_change(G, D, X, c, end, transposed)
        if wp.static(dissipative):
            dS += (T(0.5) * end * dissipation) * mean.rest_moduli_increment(X, c)
        if wp.static(viscous):
            rate = T(0.5) * end / dq
            dS += t.isotropic_stress(X, rate * c[LAMBDA_V_INDEX], rate * c[ETA_INDEX])
        return dS

    return stress_change


@functools.cache
def discrete_gradient_moduli(law: str, dtype: str) -> wp.Function:
    """Device function: `stress_change` of a law with Gonzalez' discrete gradient, see energy_momentum.py."""
    p, t, mean = precision(dtype), materials.tensor_functions(dtype), energy_momentum_law(law, dtype)
    T, mat33, coef = p.T, p.mat33, t.coef

    @wp.func
    def discrete_gradient_change(G: mat33, D: mat33, X: mat33, c: coef, end: T, transposed: int) -> mat33:
        """With q = (W1 - W0 - S:dE)/|dE|^2 and dq = B:X, dS = C:X/2 + end q X + dE (B:X)."""
        E = t.green_lagrange(G) + T(0.5) * wp.transpose(D) * D
        dE = T(2.0) * t.sym(D + wp.transpose(G) * D)
        S = mean.stress_of(E, c)
        dS = T(0.5) * mean.stress_increment(E, X, c)
        size = wp.ddot(dE, dE)
        if size > T(UNRESOLVED_CHANGE):
            q = (mean.energy_change(E - T(0.5) * dE, T(2.0) * dE, c) - wp.ddot(S, dE)) / size
            there = mean.stress_of(E + (T(0.5) * end) * dE, c)
            B = (T(1.0) / size) * (
                end * (there - S) - T(0.5) * mean.stress_increment(E, dE, c) - (T(2.0) * q * end) * dE
            )
            dS += (end * q) * X
            if transposed != 0:
                dS += wp.ddot(dE, X) * B
            else:
                dS += wp.ddot(B, X) * dE
        return dS

    return discrete_gradient_change


@functools.cache
def exact_product_kernel(
    dtype: str, law: str, slots: int, affine: bool, damping: str | None, framed: bool, midpoint: bool, dissipative: bool
) -> wp.Kernel:
    """Kernel `exact_product` of one kind of element block; arguments as those of `element_kernels`."""
    form = "affine" if affine else "framed" if framed else "table"
    module = kernel_module(
        f"element_{dtype}_{law}_{slots}_{form}_{damping}{scheme_suffix(midpoint, dissipative)}_exact"
    )
    fn = point_functions(dtype, law, slots, affine, damping, framed, midpoint, dissipative)
    p, t, Block, coef = fn.types, fn.tensors, fn.Block, fn.coef
    T, mat33, viscous = p.T, p.mat33, damping is not None
    ETA_INDEX, LAMBDA_V_INDEX = materials.ETA_INDEX, materials.LAMBDA_V_INDEX
    stress_change = midpoint_moduli(law, dtype, dissipative, viscous)

    @wp.func
    def point_change(
        block: Block, G: mat33, D: mat33, change: mat33, history: p.sym_2d, c: coef, dq: T, end: T, transposed: int,
        world: int, point: int, elem: int,
    ) -> mat33:  # fmt: skip
        """dP in the law's axes by a change of the displacement gradient."""
        F = t.identity() + G
        if wp.static(midpoint):
            S = fn.midpoint_stress(block, G, D, c)
            if wp.static(viscous):
                S += fn.viscous_stress(block, G, D, history, c, dq, world, point, elem)
            chi = T(0.0)
            if wp.static(dissipative):
                chi = block.dissipation
            left, right = F, F + end * D
            if transposed != 0:
                left, right = F + end * D, F
            X = t.sym(wp.transpose(right) * change)
            return T(0.5) * change * S + left * stress_change(G, D, X, c, chi, dq, end, transposed)
        else:
            dP = fn.law.increment(G, change, c)
            if wp.static(viscous):
                eta, volume = c[ETA_INDEX], c[LAMBDA_V_INDEX]
                dP += change * fn.viscous_stress(block, G, D, history, c, dq, world, point, elem)
                R = t.isotropic_stress(t.sym(wp.transpose(F) * change), volume, eta)
                dP += (T(1.0) / dq) * (F * R)
                if transposed != 0:
                    dP += D * R
                else:
                    dP += F * t.isotropic_stress(t.sym(wp.transpose(change) * D), volume, eta)
            return dP

    return _exact_kernel(fn, module, _element_force(fn, point_change))


def _element_force(fn: KernelSet, point_change: wp.Function) -> wp.Function:
    p, Block, Local = fn.types, fn.Block, fn.Local
    T = p.T

    @wp.func
    def exact_force(
        block: Block, U: Local, dU: Local, V: Local, history: p.sym_2d, dq: T, end: T, transposed: int, world: int,
        elem: int,
    ) -> Local:  # fmt: skip
        """Forces of an element for a change dU of its slots."""
        c = fn.coefficients(block, world, elem)
        f = Local()
        for point in range(block.shape_gradient.shape[0]):
            G = fn.material_gradient(block, U, point, elem)
            D = fn.velocity_gradient(block, V, point, elem)
            change = fn.material_gradient(block, dU, point, elem)
            dP = point_change(block, G, D, change, history, c, dq, end, transposed, world, point, elem)
            f = fn.add_point_forces(block, f, fn.to_body_axes(block, dP, point, elem), point, elem)
        return f

    return exact_force


@functools.cache
def tied_exact_product_kernel(
    dtype: str, slots: int, ties: int, width: int, midpoint: bool, worlds: bool, dissipative: bool
) -> wp.Kernel:
    """Kernel `exact_product` of elements with assumed strains; arguments as those of `assumed_strain_kernels`."""
    fn = assumed_strain_kernels(dtype, slots, ties, width, midpoint, worlds, dissipative)
    p, Block, Local, Ties = fn.types, fn.Block, fn.Local, fn.Ties
    T, NS, NT = p.T, slots, ties
    kinematics, step_shears, derivative = fn.kinematics, fn.step_shears, fn.directional_derivative
    tying_stresses = fn.tying_stresses

    @wp.func
    def exact_force(
        block: Block, U: Local, P: Local, V: Local, history: p.sym_2d, dq: T, end: T, transposed: int,
        world: int, elem: int,
    ) -> Local:  # fmt: skip
        """Those for a change P of the slots, of mid-point schemes."""
        x1, x2, e = kinematics(block, U, elem)
        s = tying_stresses(block, step_shears(block, x1, x2, V, e, elem), world, elem)
        share = T(0.5)
        if wp.static(dissipative):
            share = T(0.5) + (T(0.5) * end) * block.dissipation
        y1, y2, _ = kinematics(block, U + end * V, elem)
        de = Ties()
        for t in range(NT):
            a, d = y1[t], y2[t]
            if transposed != 0:
                a, d = x1[t], x2[t]
            de[t] = share * (
                wp.dot(a, derivative(block.derivative_b, P, t, elem))
                + wp.dot(d, derivative(block.derivative_a, P, t, elem))
            )
        ds = tying_stresses(block, de, world, elem)
        f = Local()
        for t in range(NT):
            a, d = x1[t], x2[t]
            if transposed != 0:
                a, d = y1[t], y2[t]
            da = ds[t] * a + (T(0.5) * s[t]) * derivative(block.derivative_a, P, t, elem)
            dd = ds[t] * d + (T(0.5) * s[t]) * derivative(block.derivative_b, P, t, elem)
            for i in range(NS):
                f[i] = f[i] + block.derivative_a[t, i, elem] * dd + block.derivative_b[t, i, elem] * da
        return f

    @wp.func
    def symmetric_force(
        block: Block, U: Local, P: Local, V: Local, history: p.sym_2d, dq: T, _end: T, _transposed: int, world: int,
        elem: int,
    ) -> Local:  # fmt: skip
        """Those of other schemes."""
        return fn.tangent_force(block, U, P, V, history, dq, 0, world, elem)

    return _exact_kernel(fn, kernel_module(f"{fn.name}_exact"), exact_force if midpoint else symmetric_force)


def _exact_kernel(fn: KernelSet, module: wp.Module, exact_force: wp.Function) -> wp.Kernel:
    p, Block, Iterate = fn.types, fn.Block, iterate_struct(fn.types.name)

    @masked_kernel(module, "active")
    def exact_product(
        block: Block, iterate: Iterate, start: int, transposed: int, active: int_1d, direction: p.vec3_2d,
        contribution: p.vec3_2d,
    ):  # fmt: skip
        """K p (N) with K the derivative by the end of the step, or of mid-point schemes by its `start`; `transposed`:
        K^T p."""
        world, elem = wp.tid()
        U = fn.load_slots(block, iterate.u, world, elem)
        dU = fn.load_slots(block, direction, world, elem)
        V = fn.load_velocities(block, iterate.v, world, elem)
        end = p.T(1.0)
        if start != 0:
            end = p.T(-1.0)
        dq = p.T(iterate.dq_dv[world])
        f = exact_force(block, U, dU, V, iterate.history, dq, end, transposed, world, elem)
        fn.store_forces(block, f, world, elem, contribution)

    return exact_product
