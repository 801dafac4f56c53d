"""Constitutive laws on the device: energy, first Piola-Kirchhoff stress and its increment per point.

Every law is a function of the displacement gradient G = F - I, not of F: strains are then formed without
subtracting nearly equal numbers, which float32 needs. All tensors are in the reference frame, stresses in Pa. A law is
four functions

    energy(G, c)            Psi (J/m^3)
    stress(G, c)            P = dPsi/dF (Pa)
    increment(G, dG, c)     dP = d2Psi/dF2 : dF (Pa)
    block(G, a, c)          symmetric 3x3 matrix B with d.B d = d2Psi along the rank-one dF = d a^T, projected to be
                            positive semi-definite where the exact one need not be (for preconditioners)

of the law's coefficients c. Laws whose S is linear in E have two more: pk2_stress(E, c) is S, and moduli(c) its numbers
(D11, D22, D33, D23, D13, D12, G23, G13, G12), with S_ii = sum_j D_ij E_jj and S_ij = 2 G_ij E_ij. Kelvin-Voigt damping
can be added to any law; Eq. (62) has the form of St. Venant-Kirchhoff's Eq. (26) and uses the same functions.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import precision

__all__ = ["LAWS", "law_functions"]

NCOEF = 11
"""Coefficients per material: up to nine of the law, then eta and lambda_v of Kelvin-Voigt damping."""
ETA_INDEX, LAMBDA_V_INDEX = NCOEF - 2, NCOEF - 1
"""Indices of eta and lambda_v (Pa s) among the coefficients."""


@functools.cache
def tensor_functions(dtype: str) -> KernelSet:
    """Small tensor functions shared by the laws."""
    p = precision(dtype)
    T, mat33 = p.T, p.mat33
    moduli9, coef = wp.types.vector(length=9, dtype=T), wp.types.vector(length=NCOEF, dtype=T)
    third = T(1.0 / 3.0)

    @wp.func
    def identity() -> mat33:
        """I."""
        return wp.identity(n=3, dtype=T)

    @wp.func
    def green_lagrange(G: mat33) -> mat33:
        """Green-Lagrange strain E = (G + G^T + G^T G)/2, Eq. (56)."""
        Gt = wp.transpose(G)
        return T(0.5) * (G + Gt + Gt * G)

    @wp.func
    def sym(A: mat33) -> mat33:
        """(A + A^T)/2."""
        return T(0.5) * (A + wp.transpose(A))

    @wp.func
    def dev(A: mat33) -> mat33:
        """Deviator A - tr(A)/3 I."""
        return A - third * wp.trace(A) * identity()

    @wp.func
    def volume_change(G: mat33) -> T:
        """J - 1 = tr G + (tr^2 G - tr G^2)/2 + det G, without cancellation."""
        tr = wp.trace(G)
        return tr + T(0.5) * (tr * tr - wp.trace(G * G)) + wp.determinant(G)

    @wp.func
    def isotropic_stress(E: mat33, lam: T, mu: T) -> mat33:
        """lambda tr(E) I + 2 mu E: S of Eq. (26), and S_vis of Eq. (62) with lambda_v, eta and Edot."""
        return lam * wp.trace(E) * identity() + T(2.0) * mu * E

    @wp.func
    def isotropic_moduli(lam: T, mu: T) -> moduli9:
        """`isotropic_stress` as the nine numbers that the function `moduli` of a law returns."""
        d = lam + T(2.0) * mu
        return moduli9(d, d, d, lam, lam, lam, mu, mu, mu)

    return kernel_set(locals())


def linear_law(dtype: str, pk2_stress: wp.Function) -> KernelSet:
    """`stress` and `increment` of a law whose S is linear in E, `pk2_stress`."""
    p, t = precision(dtype), tensor_functions(dtype)
    mat33, coef = p.mat33, t.coef

    @wp.func
    def stress(G: mat33, c: coef) -> mat33:
        """P = F S, Eq. (27)."""
        S = pk2_stress(t.green_lagrange(G), c)
        return S + G * S

    @wp.func
    def increment(G: mat33, dG: mat33, c: coef) -> mat33:
        """Tangent dP = dF S + F dS. With dF = d h_j^T, dP h_i is the integrand of Eq. (35) times d."""
        F = t.identity() + G
        return dG * pk2_stress(t.green_lagrange(G), c) + F * pk2_stress(t.sym(wp.transpose(F) * dG), c)

    return kernel_set(locals())


@functools.cache
def svk(dtype: str) -> KernelSet:
    """St. Venant-Kirchhoff, Eqs. (25)-(28) and (35); c = (lambda, mu), Pa."""
    p, t = precision(dtype), tensor_functions(dtype)
    T, mat33, vec3 = p.T, p.mat33, p.vec3
    moduli9, coef = t.moduli9, t.coef

    @wp.func
    def pk2_stress(E: mat33, c: coef) -> mat33:
        """S = lambda tr(E) I + 2 mu E, Eq. (26)."""
        return t.isotropic_stress(E, c[0], c[1])

    @wp.func
    def moduli(c: coef) -> moduli9:
        """lambda and mu as the nine moduli of an orthotropic law."""
        return t.isotropic_moduli(c[0], c[1])

    @wp.func
    def energy(G: mat33, c: coef) -> T:
        """Psi = lambda/2 tr(E)^2 + mu tr(E^2), Eq. (25)."""
        E = t.green_lagrange(G)
        tr = wp.trace(E)
        return T(0.5) * c[0] * tr * tr + c[1] * wp.ddot(E, E)

    @wp.func
    def block(G: mat33, a: vec3, c: coef) -> mat33:
        """The integrand of Eq. (35) for i = j and h_i = a, with a negative geometric part a.S a set to zero."""
        F = t.identity() + G
        Fa = F * a
        S = t.isotropic_stress(t.green_lagrange(G), c[0], c[1])
        geometric = wp.max(T(0.0), wp.dot(a, S * a))
        return (c[0] + c[1]) * wp.outer(Fa, Fa) + c[1] * wp.dot(a, a) * (F * wp.transpose(F)) + geometric * t.identity()

    return kernel_set(locals() | vars(linear_law(dtype, pk2_stress)))


@functools.cache
def isochoric_functions(dtype: str, second_invariant: bool) -> KernelSet:
    """Functions of a strain A, b of the Kirchhoff stress or E of C S; arguments: see `mooney_rivlin`.

    `form(A, j1, Jm, c)` is tau as in the docstring of `mooney_rivlin` with A in place of b, j1 = J - 1, Jm = J^-2/3;
    `form_change(A, dA, j1, Jm, tr, c)` its change by dA with dJ = tr J; `second_invariant_part(A)` that of mu01.
    """
    p, t = precision(dtype), tensor_functions(dtype)
    T, mat33, coef, dev = p.T, p.mat33, t.coef, t.dev
    two_thirds, four_thirds = T(2.0 / 3.0), T(4.0 / 3.0)

    @wp.func
    def second_invariant_part(A: mat33) -> mat33:
        """dev((2 + 4 t) A - 4 A^2), of the second invariant."""
        return dev((T(2.0) + T(4.0) * wp.trace(A)) * A - T(4.0) * (A * A))

    @wp.func
    def form(A: mat33, j1: T, Jm: T, c: coef) -> mat33:
        """tau or C S, Pa."""
        J = T(1.0) + j1
        out = c[1] * j1 * J * t.identity() + T(4.0) * c[0] * Jm * dev(A)
        if wp.static(second_invariant):
            out = out + T(2.0) * c[2] * Jm * Jm * second_invariant_part(A)
        return out

    @wp.func
    def form_change(A: mat33, dA: mat33, j1: T, Jm: T, tr: T, c: coef) -> mat33:
        """Change of `form`, Pa."""
        J = T(1.0) + j1
        c1 = T(4.0) * c[0] * Jm
        out = c[1] * (T(2.0) * J - T(1.0)) * J * tr * t.identity() + c1 * (dev(dA) - two_thirds * tr * dev(A))
        if wp.static(second_invariant):
            c2 = T(2.0) * c[2] * Jm * Jm
            s = T(2.0) + T(4.0) * wp.trace(A)
            change = dev(T(4.0) * wp.trace(dA) * A + s * dA - T(4.0) * (dA * A + A * dA))
            out = out + c2 * (change - four_thirds * tr * second_invariant_part(A))
        return out

    return kernel_set(locals())


@functools.cache
def mooney_rivlin(dtype: str, second_invariant: bool = True) -> KernelSet:
    """Mooney-Rivlin, Eqs. (36)-(54), or with `second_invariant=False` neo-Hookean; c = (mu10, k, mu01), Pa.

    Written with the Kirchhoff stress tau, P = tau F^-T. With b = (F F^T - I)/2 and t = tr b,
    tau = 2 mu10 J^-2/3 dev(2 b) + 2 mu01 J^-4/3 dev((2 + 4 t) b - 4 b^2) + k (J - 1) J I,
    where no term is a difference of nearly equal ones at small strain.
    """
    p, t = precision(dtype), tensor_functions(dtype)
    T, mat33, vec3 = p.T, p.mat33, p.vec3
    coef, isochoric = t.coef, isochoric_functions(dtype, second_invariant)
    # constants of this precision: Warp would evaluate an expression of literals in float32
    two_thirds = T(2.0 / 3.0)
    four_thirds = T(4.0 / 3.0)
    eight_thirds = T(8.0 / 3.0)
    ten_ninths = T(10.0 / 9.0)
    rank_one_2 = T(28.0 / 9.0)

    @wp.func
    def jacobian_power_change(j1: T) -> T:
        """J^(-2/3) - 1 from J - 1, to relative accuracy: one Newton step on (1+d)^3 (1+j)^2 = 1."""
        J = T(1.0) + j1
        d = wp.pow(J, -two_thirds) - T(1.0)
        e = T(1.0) + d
        f = d * (T(3.0) + d * (T(3.0) + d)) + j1 * (T(2.0) + j1) * e * e * e
        return d - f / (T(3.0) * e * e * J * J)

    @wp.func
    def left_cauchy_green_strain(G: mat33) -> mat33:
        """b = (F F^T - I)/2 = (G + G^T + G G^T)/2, half of the left Cauchy-Green tensor less I."""
        Gt = wp.transpose(G)
        return T(0.5) * (G + Gt + G * Gt)

    @wp.func
    def kirchhoff_stress(G: mat33, c: coef) -> mat33:
        """Kirchhoff stress tau = P F^T, in the form of the law's docstring."""
        j1 = t.volume_change(G)
        return isochoric.form(left_cauchy_green_strain(G), j1, wp.pow(T(1.0) + j1, -two_thirds), c)

    @wp.func
    def energy(G: mat33, c: coef) -> T:
        """Psi, Eq. (36)."""
        # det(I + A) = 1 for A = J^(-2/3) C - I: its trace x = I1bar - 3 follows from second-order terms, without
        # cancellation; then I2bar - 3 = x - det A
        j1 = t.volume_change(G)
        d = jacobian_power_change(j1)
        A = T(2.0) * (T(1.0) + d) * t.green_lagrange(G) + d * t.identity()
        q = T(0.5) * wp.ddot(A, A) - wp.determinant(A)
        x = T(2.0) * q / (T(1.0) + wp.sqrt(wp.max(T(0.0), T(1.0) + T(2.0) * q)))
        psi = T(0.5) * c[1] * j1 * j1 + c[0] * x
        if wp.static(second_invariant):
            psi = psi + c[2] * (x - wp.determinant(A))
        return psi

    @wp.func
    def stress(G: mat33, c: coef) -> mat33:
        """P = tau F^-T, equal to Eq. (52)."""
        F = t.identity() + G
        return kirchhoff_stress(G, c) * wp.transpose(wp.inverse(F))

    @wp.func
    def increment(G: mat33, dG: mat33, c: coef) -> mat33:
        """dP = (dtau - tau L^T) F^-T, L = dF F^-1. With dF = d h_j^T, dP h_i is the integrand of Eq. (54) times d."""
        F = t.identity() + G
        Fi = wp.inverse(F)
        b = left_cauchy_green_strain(G)
        j1 = t.volume_change(G)
        Jm = wp.pow(T(1.0) + j1, -two_thirds)
        L = dG * Fi
        tau = isochoric.form(b, j1, Jm, c)
        dtau = isochoric.form_change(b, t.sym(dG * wp.transpose(F)), j1, Jm, wp.trace(L), c)
        return (dtau - tau * wp.transpose(L)) * wp.transpose(Fi)

    @wp.func
    def block(G: mat33, a: vec3, c: coef) -> mat33:
        """The integrand of Eq. (54) for i = j and h_i = a: d2Psi along dF = d a^T, J > 0."""
        # the determinant and the cofactors of F are affine along a rank-one change, so the second derivative is short
        F = t.identity() + G
        B = F * wp.transpose(F)
        J = wp.determinant(F)
        f = wp.transpose(wp.inverse(F)) * a
        Fa = F * a
        aa = wp.dot(a, a)
        I1 = wp.trace(B)
        Jm = wp.pow(wp.abs(J), -two_thirds)
        H = (
            c[1] * J * J * wp.outer(f, f)
            + T(2.0) * c[0] * Jm * aa * t.identity()
            + c[0] * Jm * ten_ninths * I1 * wp.outer(f, f)
            - c[0] * Jm * four_thirds * (wp.outer(Fa, f) + wp.outer(f, Fa))
        )
        if wp.static(second_invariant):
            I2 = T(0.5) * (I1 * I1 - wp.ddot(B, B))
            Q = wp.outer(Fa, Fa) + (I1 * aa - wp.dot(Fa, Fa)) * t.identity() - aa * B
            d = I1 * Fa - B * Fa
            H = H + c[2] * Jm * Jm * (
                T(2.0) * Q - eight_thirds * (wp.outer(d, f) + wp.outer(f, d)) + rank_one_2 * I2 * wp.outer(f, f)
            )
        return H

    return kernel_set(locals())


@functools.cache
def neo_hookean(dtype: str) -> KernelSet:
    """Neo-Hookean: Mooney-Rivlin without the second invariant; c = (mu/2, k)."""
    return mooney_rivlin(dtype, second_invariant=False)


@functools.cache
def orthotropic(dtype: str) -> KernelSet:
    """Psi = E : D : E / 2 with D orthotropic in the axes of G: the remainder of an SVK law, integrated separately.

    c = (D11, D22, D33, D23, D13, D12, G23, G13, G12): S_ii = sum_j D_ij E_jj, S_ij = 2 G_ij E_ij.
    """
    p, t = precision(dtype), tensor_functions(dtype)
    T, mat33, vec3 = p.T, p.mat33, p.vec3
    moduli9, coef = t.moduli9, t.coef

    @wp.func
    def pk2_stress(E: mat33, c: coef) -> mat33:
        """S = D : E."""
        s1 = c[0] * E[0, 0] + c[5] * E[1, 1] + c[4] * E[2, 2]
        s2 = c[5] * E[0, 0] + c[1] * E[1, 1] + c[3] * E[2, 2]
        s3 = c[4] * E[0, 0] + c[3] * E[1, 1] + c[2] * E[2, 2]
        t23 = T(2.0) * c[6] * E[1, 2]
        t13 = T(2.0) * c[7] * E[0, 2]
        t12 = T(2.0) * c[8] * E[0, 1]
        return mat33(s1, t12, t13, t12, s2, t23, t13, t23, s3)

    @wp.func
    def moduli(c: coef) -> moduli9:
        """The coefficients c."""
        return moduli9(c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8])

    @wp.func
    def energy(G: mat33, c: coef) -> T:
        """Psi = E : D : E / 2."""
        E = t.green_lagrange(G)
        return T(0.5) * wp.ddot(E, pk2_stress(E, c))

    @wp.func
    def block(G: mat33, a: vec3, c: coef) -> mat33:
        """F M F^T with M d = (D : sym(d a^T)) a, without the possibly indefinite parts of D."""
        # the couplings D_ij alone may be indefinite, and so may the geometric stiffness: both are omitted
        F = t.identity() + G
        x = a[0] * a[0]
        y = a[1] * a[1]
        z = a[2] * a[2]
        M = mat33()
        M[0, 0] = c[0] * x + c[8] * y + c[7] * z
        M[1, 1] = c[1] * y + c[8] * x + c[6] * z
        M[2, 2] = c[2] * z + c[7] * x + c[6] * y
        M[0, 1] = c[8] * a[0] * a[1]
        M[0, 2] = c[7] * a[0] * a[2]
        M[1, 2] = c[6] * a[1] * a[2]
        M[1, 0] = M[0, 1]
        M[2, 0] = M[0, 2]
        M[2, 1] = M[1, 2]
        return F * M * wp.transpose(F)

    return kernel_set(locals() | vars(linear_law(dtype, pk2_stress)))


LAWS = {"orthotropic": orthotropic, "svk": svk, "mooney_rivlin": mooney_rivlin, "neo_hookean": neo_hookean}
"""Device laws by name. A new law is one entry here and one class in warpfea/materials.py."""


DEFINED_FOR_ANY_J = ("svk", "orthotropic", "assumed_strain")
"""Laws defined for any F; the others need J > 0."""


def law_functions(name: str, dtype: str) -> KernelSet:
    """Device functions of the law `name` in one precision."""
    return LAWS[name](dtype)
