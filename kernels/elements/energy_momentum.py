"""Stresses of the conserving midpoint scheme: S with exactly the work S : (E1 - E0) = W(E1) - W(E0).

Arguments are G, the displacement gradient at the midpoint of a step, and D, half of its change; the ends are G - D and
G + D. The mean of their strains is E(G) + D^T D / 2, their difference 2 sym(F^T D), without cancellation. For laws with
S linear in E, S at the mean strain has this work (Simo and Tarnow 1992); for the others Gonzalez' discrete gradient
(2000),

    S = S(E_m) + (W(E1) - W(E0) - S(E_m) : dE) dE / |dE|^2.

The dissipative scheme adds (chi/2) C0 : dE (Armero and Romero 2001), which dissipates (chi/2) dE : C0 : dE >= 0 in a
step, nothing in a rigid motion, and conserves both momenta, as any S does.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import precision
from . import materials

__all__ = ["energy_momentum_law"]

TINY_SQUARED_CHANGE = {"float64": 1.0e-60, "float32": 1.0e-30}
"""|dE|^2 far below round-off: a step without a change of strain uses the stress at the mean strain."""


@functools.cache
def energy_momentum_law(name: str, dtype: str) -> KernelSet:
    """Device functions of the law `name`.

    mean_stress(G, D, c) is S, Pa; mean_increment(G, dE, c) approximates twice dS/dE1 : dE by the moduli at G, Pa;
    rest_moduli_increment(dE, c) is C0 : dE, with moduli C0 that are positive, Pa.
    """
    p, t, m = precision(dtype), materials.tensor_functions(dtype), materials.law_functions(name, dtype)
    T, mat33, coef = p.T, p.mat33, t.coef

    if name not in materials.DEFINED_FOR_ANY_J:
        return _discrete_gradient(dtype, name == "mooney_rivlin")

    @wp.func
    def mean_stress(G: mat33, D: mat33, c: coef) -> mat33:
        """S at the mean of the strains at both ends."""
        return m.pk2_stress(t.green_lagrange(G) + T(0.5) * wp.transpose(D) * D, c)

    @wp.func
    def mean_increment(G: mat33, dE: mat33, c: coef) -> mat33:
        """Twice dS/dE1 : dE, exact for S linear in E, Pa."""
        return m.pk2_stress(dE, c)

    return KernelSet(mean_stress=mean_stress, mean_increment=mean_increment, rest_moduli_increment=m.pk2_stress)


def _discrete_gradient(dtype: str, second_invariant: bool) -> KernelSet:
    """Discrete gradient of Mooney-Rivlin or neo-Hookean; c = (mu10, k, mu01), Pa.

    S = C^-1 (2 mu10 J^-2/3 dev(2 E) + 2 mu01 J^-4/3 dev((2 + 4 t) E - 4 E^2) + k (J - 1) J I) with t = tr E: the
    Kirchhoff form of `materials.mooney_rivlin` with E instead of b.
    """
    p, t = precision(dtype), materials.tensor_functions(dtype)
    T, mat33, coef, dev = p.T, p.mat33, t.coef, t.dev
    isochoric = materials.isochoric_functions(dtype, second_invariant)
    second_invariant_part = isochoric.second_invariant_part
    third, two_thirds = T(1.0 / 3.0), T(2.0 / 3.0)
    tiny = T(TINY_SQUARED_CHANGE[dtype])

    @wp.func
    def jacobian_minus_one(E: mat33) -> T:
        """J - 1 of a strain, without cancellation."""
        y = t.volume_change(T(2.0) * E)
        return y / (T(1.0) + wp.sqrt(T(1.0) + y))

    @wp.func
    def cauchy_green_times_stress(E: mat33, c: coef) -> mat33:
        """C S of a strain, in the form of the docstring above."""
        j1 = jacobian_minus_one(E)
        return isochoric.form(E, j1, wp.pow(T(1.0) + j1, -two_thirds), c)

    @wp.func
    def inverse_cauchy_green(E: mat33) -> mat33:
        """C^-1 = (I + 2 E)^-1."""
        return wp.inverse(t.identity() + T(2.0) * E)

    @wp.func
    def cube_root_change(y: T) -> T:
        """(1 + y)^(1/3) - 1 to relative accuracy: one Newton step on (1 + r)^3 = 1 + y."""
        r = wp.pow(T(1.0) + y, third) - T(1.0)
        e = T(1.0) + r
        return r - (r * (T(3.0) + r * (T(3.0) + r)) - y) / (T(3.0) * e * e)

    @wp.func
    def energy_change(E0: mat33, X: mat33, c: coef) -> T:
        """W(E0 + X/2) - W(E0) with X the change of C, J/m^3; round-off of order eps W'' |E| |X|.

        With A = C0^-1 X and its invariants i1, i2, i3, J1^2/J0^2 = 1 + y, y = i1 + i2 + i3, and
            d = (J1/J0)^(-2/3) - 1 = -i1/3 + rho.
        The first-order part in X is S(E0) : X/2; the rest follows without cancellation.
        """
        Ci = inverse_cauchy_green(E0)
        A = Ci * X
        i1 = wp.trace(A)
        i23 = T(0.5) * (i1 * i1 - wp.trace(A * A)) + wp.determinant(A)
        y = i1 + i23
        r = cube_root_change(y)
        J0 = T(1.0) + jacobian_minus_one(E0)
        # (1 + y)^(-1/3) - 1 + y/3 = r^2 (1/(1 + r) + 1 + r/3)
        rho = r * r * (T(1.0) / (T(1.0) + r) + T(1.0) + third * r) - third * i23
        d = rho - third * i1
        I1 = T(3.0) + T(2.0) * wp.trace(E0)
        tr = wp.trace(X)
        p0 = wp.pow(J0, -two_thirds)
        j = y / (T(1.0) + wp.sqrt(T(1.0) + y))
        first = T(2.0) * wp.ddot(Ci * dev(E0), X)
        change = c[0] * p0 * (first + I1 * rho + d * tr)
        change += T(0.5) * c[1] * J0 * j * (T(2.0) * jacobian_minus_one(E0) + J0 * j)
        if wp.static(second_invariant):
            I2 = T(3.0) + T(4.0) * wp.trace(E0) + T(2.0) * (wp.trace(E0) * wp.trace(E0) - wp.ddot(E0, E0))
            second = T(0.5) * (tr * tr - wp.ddot(X, X))
            # I1 I - C at the start
            cofactor = (T(2.0) + T(2.0) * wp.trace(E0)) * t.identity() - T(2.0) * E0
            change_I2 = wp.ddot(cofactor, X) + second
            d2 = d * (T(2.0) + d)
            change += (
                c[2]
                * p0
                * p0
                * (wp.ddot(Ci * second_invariant_part(E0), X) + I2 * (T(2.0) * rho + d * d) + second + d2 * change_I2)
            )
        return change

    @wp.func
    def stress_of(E: mat33, c: coef) -> mat33:
        """S of a strain, Pa."""
        return t.sym(inverse_cauchy_green(E) * cauchy_green_times_stress(E, c))

    @wp.func
    def stress_increment(E: mat33, dE: mat33, c: coef) -> mat33:
        """dS of S(E) along dE, Pa."""
        Ci = inverse_cauchy_green(E)
        j1 = jacobian_minus_one(E)
        Jm = wp.pow(T(1.0) + j1, -two_thirds)
        change = isochoric.form_change(E, dE, j1, Jm, wp.ddot(Ci, dE), c)
        return t.sym(Ci * (change - T(2.0) * dE * (Ci * cauchy_green_times_stress(E, c))))

    @wp.func
    def mean_stress(G: mat33, D: mat33, c: coef) -> mat33:
        """The discrete gradient, Pa."""
        E = t.green_lagrange(G) + T(0.5) * wp.transpose(D) * D
        dE = T(2.0) * t.sym(D + wp.transpose(G) * D)
        S = stress_of(E, c)
        rest = energy_change(E - T(0.5) * dE, T(2.0) * dE, c) - wp.ddot(S, dE)
        return S + (rest / (wp.ddot(dE, dE) + tiny)) * dE

    @wp.func
    def mean_increment(G: mat33, dE: mat33, c: coef) -> mat33:
        """dS of S(E) along dE at the strain of G, Pa."""
        return stress_increment(t.green_lagrange(G), dE, c)

    @wp.func
    def rest_moduli_increment(dE: mat33, c: coef) -> mat33:
        """C0 : dE with the moduli at rest, Pa."""
        mu = T(2.0) * (c[0] + c[2])
        return t.isotropic_stress(dE, c[1] - two_thirds * mu, mu)

    return kernel_set(locals())
