"""Derivatives of internal forces by the reference values of the slots, contracted with a vector w.

At a point all geometry follows from J0 = sum X_i ds_i^T: with L = grad(dX) the gradients h of the functions change by
-L^T h, the volume by its trace. At fixed displacements a gradient G = sum u_i h_i^T changes by -G L. Axes that Gram and
Schmidt make of the columns of J0 turn by R Omega, where Omega is skew and has the lower part of B = R^T L R: in these
axes dG = -G B + G Omega - Omega G.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_1d, int_1d, precision
from .assumed_strain_block import assumed_shear_functions, assumed_strain_struct, coupling_entry_function
from .element_slots import iterate_struct, slot_access_functions
from .matrix import scheme_suffix
from .points import point_functions

__all__ = ["shape_gradient_kernels", "tied_shape_gradient_kernel", "tied_shape_struct"]


@functools.cache
def turn_functions(dtype: str, framed: bool):
    """Device functions of matrices M that give derivatives M : B."""
    mat33 = precision(dtype).mat33

    @wp.func
    def turn_part(K: mat33) -> mat33:
        """M of K : Omega; zero unless framed."""
        M = mat33()
        if wp.static(framed):
            for i in range(3):
                for j in range(i):
                    M[i, j] = K[i, j] - K[j, i]
        return M

    @wp.func
    def gradient_part(G: mat33, D: mat33) -> mat33:
        """M of D : dG."""
        return turn_part(wp.transpose(G) * D - D * wp.transpose(G)) - wp.transpose(G) * D

    return kernel_set(locals())


@functools.cache
def shape_gradient_kernels(
    dtype: str, law: str, slots: int, affine: bool, damping: str | None, framed: bool, midpoint: bool = False
) -> KernelSet:  # fmt: skip
    """Kernels of one kind of element block; arguments as those of `element_kernels`. `midpoint`: of stresses linear in
    the strain."""
    fn, turn = point_functions(dtype, law, slots, affine, damping, framed, midpoint), turn_functions(dtype, framed)
    p, t, m, Block, Local = fn.types, fn.tensors, fn.law, fn.Block, fn.Local
    T, mat33, Iterate, coef = p.T, p.mat33, iterate_struct(dtype), fn.coef
    ETA_INDEX, LAMBDA_V_INDEX, viscous = fn.ETA_INDEX, fn.LAMBDA_V_INDEX, fn.viscous
    form = "affine" if affine else "framed" if framed else "table"
    scheme = scheme_suffix(midpoint, dissipative=False)
    module = kernel_module(f"element_{dtype}_{law}_{slots}_{form}_{damping}{scheme}_shape_gradient")

    @wp.func
    def viscous_part(S: mat33, G: mat33, Fdot: mat33, D: mat33, c: coef, dq: T) -> mat33:
        """M of D : (F S) with the viscous stress S, whose past strains are fixed."""
        F = t.identity() + G
        dS = t.isotropic_stress(t.sym(wp.transpose(F) * D), c[LAMBDA_V_INDEX], c[ETA_INDEX])
        if wp.static(midpoint):
            dS = (T(1.0) / dq) * dS
        P = F * S
        M = wp.ddot(P, D) * t.identity() + turn.gradient_part(D, P)
        if wp.static(damping == "rate"):
            return M + turn.gradient_part(G, D * S + Fdot * dS) + turn.gradient_part(Fdot, F * dS)
        return M + turn.gradient_part(G, D * S + (T(1.0) / dq) * F * dS)

    @masked_kernel(module, "active")
    def shape_gradient(block: Block, iterate: Iterate, w: p.vec3_2d, active: int_1d, contribution: p.vec3_2d):
        """-w.df/dX, with the past strains of incremental damping fixed."""
        world, elem = wp.tid()
        c = fn.coefficients(block, world, elem)
        dq = T(iterate.dq_dv[world])
        U = fn.load_slots(block, iterate.u, world, elem)
        V = fn.load_velocities(block, iterate.v, world, elem)
        W = fn.load_slots(block, w, world, elem)
        f = Local()
        for point in range(block.shape_gradient.shape[0]):
            G = fn.material_gradient(block, U, point, elem)
            D = fn.material_gradient(block, W, point, elem)
            Fdot = fn.velocity_gradient(block, V, point, elem)
            M = mat33()
            if wp.static(midpoint):
                F = t.identity() + G
                mean = fn.midpoint_stress(block, G, Fdot, c)
                dS = m.pk2_stress(t.sym(wp.transpose(F) * D), c)
                M = wp.ddot(F * mean, D) * t.identity() + turn.gradient_part(D, F * mean)
                M += turn.gradient_part(G, D * mean + F * dS) + turn.gradient_part(Fdot, Fdot * dS)
            else:
                P = m.stress(G, c)
                M = wp.ddot(P, D) * t.identity() + turn.gradient_part(D, P)
                M += turn.gradient_part(G, m.increment(G, D, c))
            if wp.static(viscous):
                S = fn.viscous_stress(block, G, Fdot, iterate.history, c, dq, world, point, elem)
                M += viscous_part(S, G, Fdot, D, c, dq)
            f = fn.add_point_forces(block, f, fn.to_body_axes(block, -M, point, elem), point, elem)
        fn.store_forces(block, f, world, elem, contribution)

    @masked_kernel(module, "active")
    def history_shape(
        block: Block, u: p.vec3_2d, y: p.vec3_2d, x: p.vec3_2d, scale: double_1d, w: p.vec3_2d, dq_dv: double_1d,
        active: int_1d, contribution: p.vec3_2d,
    ):  # fmt: skip
        """-w.df/dX through a past strain whose change is sym((scale I + grad x)^T grad dy)."""
        world, elem = wp.tid()
        c = fn.coefficients(block, world, elem)
        rate = T(1.0) / T(dq_dv[world])
        U = fn.load_slots(block, u, world, elem)
        W = fn.load_slots(block, w, world, elem)
        Y = fn.load_slots(block, y, world, elem)
        X = fn.load_slots(block, x, world, elem)
        f = Local()
        for point in range(block.shape_gradient.shape[0]):
            F = t.identity() + fn.material_gradient(block, U, point, elem)
            change = t.sym(wp.transpose(F) * fn.material_gradient(block, W, point, elem))
            dS = t.isotropic_stress(change, rate * c[LAMBDA_V_INDEX], rate * c[ETA_INDEX])
            A = T(scale[world]) * t.identity() + fn.material_gradient(block, X, point, elem)
            M = turn.gradient_part(fn.material_gradient(block, Y, point, elem), A * dS)
            f = fn.add_point_forces(block, f, fn.to_body_axes(block, M, point, elem), point, elem)
        fn.store_forces(block, f, world, elem, contribution)

    return kernel_set(locals())


@functools.cache
def tied_shape_struct(dtype: str):
    """Geometry of assumed strains besides their block."""
    vec3, mat33 = precision(dtype).vec3, precision(dtype).mat33

    @wp.struct
    class TiedShape:
        pair: wp.array2d(dtype=wp.int32)  # [tie, 2] the axes a and b
        axes: wp.array2d(dtype=mat33)  # [tie, elem] of framed parts
        shape_gradient: wp.array3d(dtype=vec3)  # [tie, local, elem] h_i of framed parts
        coupling_gradient: wp.array3d(dtype=vec3)  # [width tie + k, local, elem] dA/dX

    return TiedShape


@functools.cache
def tied_shape_gradient_kernel(
    dtype: str, slots: int, ties: int, width: int, framed: bool, midpoint: bool = False
) -> wp.Kernel:  # fmt: skip
    """Kernel `tied_shape_gradient` of elements with assumed strains; arguments as those of `assumed_strain_kernels`."""
    p, Block, Shape = precision(dtype), assumed_strain_struct(dtype, False), tied_shape_struct(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    shears, turn = assumed_shear_functions(dtype, slots, ties, False), turn_functions(dtype, framed)
    coupling_entry = coupling_entry_function(dtype, False, False)
    load_slots, _, store_forces = slot_access_functions(dtype, slots, Block)
    Local, Ties, derivative = shears.Local, shears.Ties, shears.directional_derivative
    NS, NT, W = slots, ties, width
    scheme = scheme_suffix(midpoint, dissipative=False)
    module = kernel_module(f"tied_{dtype}_{slots}_{ties}_{width}{scheme}_{'framed_' * framed}shape_gradient")

    @wp.func
    def axis(A: mat33, k: int) -> vec3:
        """Column k."""
        return vec3(A[0, k], A[1, k], A[2, k])

    @wp.func
    def side_part(A: mat33, Y: mat33, Z: mat33, k: int, u: vec3, w: vec3, x: vec3) -> mat33:
        """M of u.du_k + w.dw_k + x.dA_k, with the gradients Y of the displacements and Z of w along the axes A."""
        M, K = mat33(), mat33()
        for c in range(3):
            M[c, k] = -wp.dot(axis(Y, c), u) - wp.dot(axis(Z, c), w)
            K[c, k] = wp.dot(axis(A, c), x) - M[c, k]
        return M + turn.turn_part(K)

    @masked_kernel(module, "active")
    def tied_shape_gradient(
        block: Block, shape: Shape, u: p.vec3_2d, v: p.vec3_2d, w: p.vec3_2d, active: int_1d, contribution: p.vec3_2d
    ):
        """-w.df/dX of w.f = mu e.A de, de = x_a.w_b + x_b.w_a."""
        world, elem = wp.tid()
        mu = block.coefficients[world % block.coefficients.shape[0], block.material[elem], 0]
        U = load_slots(block, u, world, elem)
        D = load_slots(block, w, world, elem)
        x1, x2, e = shears.kinematics(block, U, elem)
        V = Local()
        if wp.static(midpoint):
            V = load_slots(block, v, world, elem)
            e = shears.step_shears(block, x1, x2, V, e, elem)
        de = Ties()
        for t in range(NT):
            de[t] = wp.dot(x1[t], derivative(block.derivative_b, D, t, elem)) + wp.dot(
                x2[t], derivative(block.derivative_a, D, t, elem)
            )
        f = Local()
        for t in range(NT):
            s, ds = T(0.0), T(0.0)
            first = (t / W) * W
            for k in range(W):
                s += mu * coupling_entry(block, t, k, world, elem) * e[first + k]
                ds += mu * coupling_entry(block, t, k, world, elem) * de[first + k]
                for i in range(NS):
                    f[i] = f[i] - (mu * de[t] * e[first + k]) * shape.coupling_gradient[W * t + k, i, elem]
            w_a, w_b = derivative(block.derivative_a, D, t, elem), derivative(block.derivative_b, D, t, elem)
            bar_a = ds * (x2[t] - block.X_b[t, elem]) + s * w_b  # of X_a
            bar_b = ds * (x1[t] - block.X_a[t, elem]) + s * w_a
            if wp.static(framed):
                A = shape.axes[t, elem]
                Y, Z = mat33(), mat33()
                for i in range(NS):
                    h = wp.transpose(A) * shape.shape_gradient[t, i, elem]
                    Y += wp.outer(U[i], h)
                    Z += wp.outer(D[i], h)
                M = side_part(A, Y, Z, shape.pair[t, 0], ds * x2[t] + s * w_b, s * x2[t], bar_a)
                M += side_part(A, Y, Z, shape.pair[t, 1], ds * x1[t] + s * w_a, s * x1[t], bar_b)
                if wp.static(midpoint):
                    Y = mat33()
                    for i in range(NS):
                        Y += wp.outer(V[i], wp.transpose(A) * shape.shape_gradient[t, i, elem])
                    v_a, v_b = derivative(block.derivative_a, V, t, elem), derivative(block.derivative_b, V, t, elem)
                    M += side_part(A, Y, mat33(), shape.pair[t, 0], ds * v_b, vec3(), vec3())
                    M += side_part(A, Y, mat33(), shape.pair[t, 1], ds * v_a, vec3(), vec3())
                M = A * M * wp.transpose(A)
                for i in range(NS):
                    f[i] = f[i] - M * shape.shape_gradient[t, i, elem]
            else:
                for i in range(NS):
                    f[i] = f[i] - block.derivative_a[t, i, elem] * bar_a - block.derivative_b[t, i, elem] * bar_b
        store_forces(block, f, world, elem, contribution)

    return tied_shape_gradient
