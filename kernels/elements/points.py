"""Device functions of a table element at its quadrature points: gradients, axes, strain rates, increments of stress.

An element family enters the device code only by its number of slots and its tables. Straight ("affine") elements share
one table of parent gradients and have one J0^-1 each; others have h_i per element and point. Displacements are taken
relative to the first slot of the element, which is a position: a rigid translation then has exactly zero strain.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import precision
from . import materials
from .element_slots import slot_access_functions, slot_values_type
from .energy_momentum import energy_momentum_law

__all__ = ["block_struct", "point_functions"]


@functools.cache
def block_struct(dtype: str, dissipative: bool = False):
    """Constant data of one element block, in one precision; `dissipative`: see `point_functions`."""
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33

    @wp.struct
    class ElementBlock:
        conn: wp.array2d(dtype=wp.int32)  # [local, elem] slot
        is_position: wp.array(dtype=T)  # [local] 1 for a position slot, 0 for a gradient slot
        shape_gradient: wp.array3d(dtype=vec3)  # [point, local, elem] h_i; affine: [point, local, 0] parent gradient
        vertex_shape_gradient: wp.array3d(dtype=vec3)  # h_i at the vertices, where J is tested for laws that need J > 0
        shape: wp.array3d(dtype=T)  # [point, local, elem or 0] s_i at the points of the mass rule (field loads)
        mass_weight: wp.array2d(dtype=T)  # [point, elem] rho w at those points, kg
        J0_inv: wp.array2d(dtype=T)  # [3 row + column, elem], affine only
        quadrature_weight: wp.array2d(dtype=T)  # [point, elem] W det J0; affine: [point, 0] W
        det_J0: wp.array(dtype=T)  # [elem], affine only
        parent_mass: wp.array2d(dtype=T)  # [local, local] int s_i s_j over the parent; affine only
        # [world or 0, elem] rho det J0, kg; affine only, with a density constant in each element
        density_det_J0: wp.array2d(dtype=T)
        material: wp.array(dtype=wp.int32)  # [elem] row of `coefficients`
        coefficients: wp.array3d(dtype=T)  # [world or 0, material, NCOEF]
        material_axes: wp.array2d(dtype=mat33)  # [point, elem] axes of the law, framed blocks only
        contribution_offset: (
            wp.int32
        )  # first entry of the block among the contributions, elements, histories of all blocks
        element_offset: wp.int32
        history_offset: wp.int32
        count: wp.int32  # elements
        if dissipative:
            dissipation: T  # chi of kernels/elements/energy_momentum.py

    return ElementBlock


@functools.cache
def point_functions(
    dtype: str,
    law: str,
    slots: int,
    affine: bool,
    damping: str | None,
    framed: bool,
    midpoint: bool = False,
    dissipative: bool = False,
) -> KernelSet:
    """Device functions for one kind of element block; the arguments are those of `element_kernels`.

    With `midpoint` the slots' values are those at the midpoint of a step, and velocities are replaced by half of the
    slots' change. Products K p are those of the derivative by the values at the end, for stresses linear in E to the
    last digit: forces act along the strains' gradients at the midpoint, strains change along those at the end. Matrices
    use the former for both, and are symmetric.
    """
    p = precision(dtype)
    T, vec3, mat33, sym6 = p.T, p.vec3, p.mat33, p.sym
    t = materials.tensor_functions(dtype)
    m = materials.law_functions(law, dtype)
    mean = energy_momentum_law(law, dtype)
    viscous, uses_v = damping is not None, midpoint or damping == "rate"
    Block = block_struct(dtype, dissipative)
    NCOEF = materials.NCOEF
    coef = t.coef
    Local = slot_values_type(dtype, slots)
    load_slots, load_last_change, store_forces = slot_access_functions(dtype, slots, Block)
    NS, needs_J = slots, law not in materials.DEFINED_FOR_ANY_J
    ETA_INDEX, LAMBDA_V_INDEX = materials.ETA_INDEX, materials.LAMBDA_V_INDEX

    @wp.func
    def coefficients(block: Block, world: int, elem: int) -> coef:
        """Coefficients of an element's law, then eta and lambda_v of its damping (Pa s)."""
        c = coef()
        row = world % block.coefficients.shape[0]
        mat = block.material[elem]
        for k in range(NCOEF):
            c[k] = block.coefficients[row, mat, k]
        return c

    @wp.func
    def damping_coefficients(c: coef, scale: T) -> coef:
        """scale (lambda_v, eta) as the coefficients (lambda, mu) of `materials.svk`, whose form Eq. (62) has."""
        d = coef()
        d[0] = c[LAMBDA_V_INDEX] * scale
        d[1] = c[ETA_INDEX] * scale
        return d

    @wp.func
    def inverse_jacobian(block: Block, elem: int) -> mat33:
        """J0^-1 of a straight element."""
        return mat33(
            block.J0_inv[0, elem], block.J0_inv[1, elem], block.J0_inv[2, elem],
            block.J0_inv[3, elem], block.J0_inv[4, elem], block.J0_inv[5, elem],
            block.J0_inv[6, elem], block.J0_inv[7, elem], block.J0_inv[8, elem],
        )  # fmt: skip

    @wp.func
    def tabulated_gradient(block: Block, table: p.vec3_3d, U: Local, point: int, elem: int) -> mat33:
        """`field_gradient` with the gradients of the shape functions in `table`."""
        D = mat33()
        for i in range(NS):
            if wp.static(affine):
                D += wp.outer(U[i], table[point, i, 0])
            else:
                D += wp.outer(U[i], table[point, i, elem])
        if wp.static(affine):
            D = D * inverse_jacobian(block, elem)
        return D

    @wp.func
    def field_gradient(block: Block, U: Local, point: int, elem: int) -> mat33:
        """sum_i u_i h_i^T at a point, Eq. (1): F - I of displacements, Fdot of velocities."""
        return tabulated_gradient(block, block.shape_gradient, U, point, elem)

    @wp.func
    def slot_gradient(block: Block, point: int, slot: int, elem: int) -> vec3:
        """h of a slot at a point, 1/m."""
        if wp.static(affine):
            return wp.transpose(inverse_jacobian(block, elem)) * block.shape_gradient[point, slot, 0]
        else:
            return block.shape_gradient[point, slot, elem]

    @wp.func
    def point_weight(block: Block, point: int, elem: int) -> T:
        """w = W_q det J0 of a quadrature point, Eq. (11): its volume, m^3."""
        if wp.static(affine):
            return block.quadrature_weight[point, 0] * block.det_J0[elem]
        else:
            return block.quadrature_weight[point, elem]

    @wp.func
    def tangent_weight(block: Block, point: int, elem: int) -> T:
        """w of a point in K; `midpoint`: half of it, as midpoint values move by half of the end's change."""
        if wp.static(midpoint):
            return T(0.5) * point_weight(block, point, elem)
        else:
            return point_weight(block, point, elem)

    @wp.func
    def add_point_forces(block: Block, f: Local, P: mat33, point: int, elem: int) -> Local:
        """f_i += w P h_i: contribution of a point to the forces of Eq. (32)."""
        Q = point_weight(block, point, elem) * P
        if wp.static(affine):
            Q = Q * wp.transpose(inverse_jacobian(block, elem))
        out = f
        for i in range(NS):
            if wp.static(affine):
                out[i] = out[i] + Q * block.shape_gradient[point, i, 0]
            else:
                out[i] = out[i] + Q * block.shape_gradient[point, i, elem]
        return out

    @wp.func
    def to_voigt(A: mat33) -> sym6:
        """A symmetric tensor in Voigt order (xx, yy, zz, yz, xz, xy)."""
        return sym6(A[0, 0], A[1, 1], A[2, 2], A[1, 2], A[0, 2], A[0, 1])

    @wp.func
    def from_voigt(a: sym6) -> mat33:
        """Tensor with the components a in Voigt order."""
        return mat33(a[0], a[5], a[4], a[5], a[1], a[3], a[4], a[3], a[2])

    @wp.func
    def to_material_axes(block: Block, A: mat33, point: int, elem: int) -> mat33:
        """R^T A R: from the body's axes into those of the law, if framed."""
        if wp.static(framed):
            R = block.material_axes[point, elem]
            return wp.transpose(R) * A * R
        else:
            return A

    @wp.func
    def to_body_axes(block: Block, A: mat33, point: int, elem: int) -> mat33:
        """R A R^T: from the law's axes into those of the body, if framed."""
        if wp.static(framed):
            R = block.material_axes[point, elem]
            return R * A * wp.transpose(R)
        else:
            return A

    @wp.func
    def history_index(block: Block, point: int, elem: int) -> int:
        """Index of a quadrature point in the `history` array of all blocks."""
        return block.history_offset + point * block.count + elem

    @wp.func
    def material_gradient(block: Block, U: Local, point: int, elem: int) -> mat33:
        """`field_gradient` in the law's axes."""
        return to_material_axes(block, field_gradient(block, U, point, elem), point, elem)

    @wp.func
    def load_velocities(block: Block, v: p.vec3_2d, world: int, elem: int) -> Local:
        """Velocities of an element's slots if needed by damping (form "rate") or `midpoint`, else zeros."""
        if wp.static(uses_v):
            return load_slots(block, v, world, elem)
        else:
            return Local()

    @wp.func
    def velocity_gradient(block: Block, V: Local, point: int, elem: int) -> mat33:
        """Fdot in the law's axes (1/s) for damping of the form "rate", Eq. (60); `midpoint`: half of dF; else zero."""
        if wp.static(uses_v):
            return material_gradient(block, V, point, elem)
        else:
            return mat33()

    @wp.func
    def strain_rate(
        block: Block, G: mat33, Fdot: mat33, history: p.sym_2d, dq: T, world: int, point: int, elem: int
    ) -> mat33:
        """Edot at a point in the law's axes, 1/s.

        Damping of the form "incremental": (E - history)/dq. "rate": Eq. (58) with F and Fdot at the new state.
        `midpoint`: (E1 - E0)/h, h = 2 dq, which is Eq. (58) with the mean Fdot.
        """
        if wp.static(damping == "incremental"):
            past = from_voigt(history[world, history_index(block, point, elem)])
            return (T(1.0) / dq) * (t.green_lagrange(G) - past)
        elif wp.static(midpoint):
            return (T(1.0) / dq) * t.sym(Fdot + wp.transpose(G) * Fdot)
        else:
            return t.sym(wp.transpose(t.identity() + G) * Fdot)

    @wp.func
    def viscous_stress(
        block: Block, G: mat33, Fdot: mat33, history: p.sym_2d, c: coef, dq: T, world: int, point: int, elem: int
    ) -> mat33:
        """S_vis, Eq. (62), with `strain_rate`, Pa."""
        rate = strain_rate(block, G, Fdot, history, dq, world, point, elem)
        return t.isotropic_stress(rate, c[LAMBDA_V_INDEX], c[ETA_INDEX])

    @wp.func
    def vertex_jacobian(block: Block, U: Local, elem: int) -> T:
        """Smallest J at the vertices of an element, which lie outside the hull of its quadrature points."""
        J = T(1.0e30)
        for vertex in range(block.vertex_shape_gradient.shape[0]):
            D = tabulated_gradient(block, block.vertex_shape_gradient, U, vertex, elem)
            J = wp.min(J, T(1.0) + t.volume_change(D))
        return J

    @wp.func
    def midpoint_stress(block: Block, G: mat33, D: mat33, c: coef) -> mat33:
        """S of a midpoint step, Pa: that of kernels/elements/energy_momentum.py with its dissipation."""
        S = mean.mean_stress(G, D, c)
        if wp.static(dissipative):
            S += block.dissipation * mean.rest_moduli_increment(t.sym(D + wp.transpose(G) * D), c)
        return S

    @wp.func
    def midpoint_stress_increment(block: Block, G: mat33, dE: mat33, c: coef) -> mat33:
        """Twice the change of S of a midpoint step, Pa, by a change dE of the strain at its end."""
        dS = mean.mean_increment(G, dE, c)
        if wp.static(dissipative):
            dS += block.dissipation * mean.rest_moduli_increment(dE, c)
        return dS

    @wp.func
    def step_start_stress(G: mat33, c: coef) -> mat33:
        """S at the start of a midpoint step, Pa; G is the displacement gradient there."""
        if wp.static(needs_J):
            return t.sym(wp.inverse(t.identity() + G) * m.stress(G, c))
        else:
            return m.pk2_stress(t.green_lagrange(G), c)

    @wp.func
    def dissipation_factor(block: Block) -> T:
        """Factor of the dissipation of a midpoint step on moduli in a matrix."""
        if wp.static(dissipative):
            return T(1.0) + block.dissipation
        else:
            return T(1.0)

    @wp.func
    def predicted_stress_change(G: mat33, dG: mat33, c: coef, dq: T) -> mat33:
        """Linear prediction of S from the previous iterate, G - dG, minus S at G, Pa; both in the law's axes.

        For stresses linear in E it is -C : (dG^T dG)/2, the neglected second-order strain; for other laws S + dS - S(G)
        with dS = F^-1 (dP - dF S) at G - dG.
        """
        if wp.static(needs_J):
            past = G - dG
            Fi = wp.inverse(t.identity() + past)
            S = Fi * m.stress(past, c)
            ahead = S + Fi * (m.increment(past, dG, c) - dG * S)
            change = t.sym(ahead - wp.inverse(t.identity() + G) * m.stress(G, c))
        else:
            change = -m.pk2_stress(T(0.5) * wp.transpose(dG) * dG, c)
        if wp.static(damping == "incremental"):
            change = change - t.isotropic_stress(
                T(0.5) * wp.transpose(dG) * dG, c[LAMBDA_V_INDEX] / dq, c[ETA_INDEX] / dq
            )
        return change

    @wp.func
    def max_compression(S: mat33) -> T:
        """Upper bound (Gershgorin) of the largest compressive principal value of S, Pa; 0 in tension."""
        low = T(0.0)
        for i in range(3):
            low = wp.max(low, wp.abs(S[i, 0]) + wp.abs(S[i, 1]) + wp.abs(S[i, 2]) - wp.abs(S[i, i]) - S[i, i])
        return low

    @wp.func
    def spd_increment(F: mat33, dF: mat33, c: coef) -> mat33:
        """Positive definite dP for laws with an indefinite tangent far from rest: A C0 : sym(A^T dF).

        C0 is the stiffness at rest, with c = (mu10, k, mu01), mu = 2 (mu10 + mu01) and lambda = k - 2 mu / 3; A is F
        scaled to A : A = 3, so that the stiffness turns and stretches with the material.
        """
        A = wp.sqrt(T(3.0) / wp.ddot(F, F)) * F
        mu = T(2.0) * (c[0] + c[2])
        return A * t.isotropic_stress(t.sym(wp.transpose(A) * dF), wp.max(c[1] - mu * T(2.0) / T(3.0), T(0.0)), mu)

    @wp.func
    def point_increment(
        block: Block, G: mat33, dG: mat33, Fdot: mat33, history: p.sym_2d, c: coef, dq: T, form: int, world: int,
        point: int, elem: int,
    ) -> mat33:  # fmt: skip
        """dP by a change dG at a point in the body's axes, damping included: the integrand of the tangent product.

        `form` 2, for midpoint schemes: with the stress at the start of the step in the geometric part.
        """
        local = to_material_axes(block, G, point, elem)
        change = to_material_axes(block, dG, point, elem)
        dP = mat33()
        along = t.identity() + local
        if wp.static(midpoint):
            along = along + Fdot
            F = t.identity() + local
            S = mat33()
            if form == 2:
                S = step_start_stress(local - Fdot, c)
            else:
                S = midpoint_stress(block, local, Fdot, c)
            dP = change * S + F * midpoint_stress_increment(block, local, t.sym(wp.transpose(along) * change), c)
        else:
            dP = m.increment(local, change, c)
        if wp.static(viscous):
            F = t.identity() + local
            S = viscous_stress(block, local, Fdot, history, c, dq, world, point, elem)
            dS = t.isotropic_stress(t.sym(wp.transpose(along) * change), c[LAMBDA_V_INDEX] / dq, c[ETA_INDEX] / dq)
            if wp.static(midpoint):
                if form == 2:
                    S = mat33()
            dP = dP + change * S + F * dS
        if wp.static(midpoint):
            dP = T(0.5) * dP
        return to_body_axes(block, dP, point, elem)

    @wp.func
    def tangent_force(
        block: Block, U: Local, dU: Local, V: Local, history: p.sym_2d, dq: T, form: int, world: int, elem: int
    ) -> Local:
        """K dU of an element: its forces for a change dU of its slots, Eqs. (35) and (54) applied to a vector.

        `form`: see `point_increment`.
        """
        c = coefficients(block, world, elem)
        f = Local()
        for point in range(block.shape_gradient.shape[0]):
            Fdot = velocity_gradient(block, V, point, elem)
            G = field_gradient(block, U, point, elem)
            dG = field_gradient(block, dU, point, elem)
            dP = point_increment(block, G, dG, Fdot, history, c, dq, form, world, point, elem)
            f = add_point_forces(block, f, dP, point, elem)
        return f

    @wp.func
    def predicted_force(
        block: Block, U: Local, dU: Local, step: Local, history: p.sym_2d, dq: T, form: int, world: int, elem: int
    ) -> Local:
        """K dU without viscosity, with the stress of the linear prediction in the geometric part.

        `step`: the last change of the slots, m; `form`: `use_prediction` of the kernel.
        """
        c = coefficients(block, world, elem)
        f = Local()
        for point in range(block.shape_gradient.shape[0]):
            G = field_gradient(block, U, point, elem)
            dG = field_gradient(block, dU, point, elem)
            dP = point_increment(block, G, dG, mat33(), history, c, dq, 0, world, point, elem)
            local = to_material_axes(block, G, point, elem)
            if form == 1:
                ahead = material_gradient(block, step, point, elem)
                dP += dG * to_body_axes(block, predicted_stress_change(local, ahead, c, dq), point, elem)
            elif form == 2:
                if wp.static(needs_J):
                    change = to_material_axes(block, dG, point, elem)
                    dP = to_body_axes(block, spd_increment(t.identity() + local, change, c), point, elem)
                else:
                    dP += max_compression(m.pk2_stress(t.green_lagrange(local), c)) * dG
            f = add_point_forces(block, f, dP, point, elem)
        return f

    return kernel_set(locals() | {"types": p, "tensors": t, "law": m})
