"""Stresses of the conserving mid-point scheme at one point: work, limits, order, moduli."""

import functools

import numpy as np
import pytest
import warp as wp
from validation.conservation import LAWS
from warpfea.kernels.common.modules import kernel_module
from warpfea.kernels.common.types import precision
from warpfea.kernels.elements import materials
from warpfea.kernels.elements.energy_momentum import energy_momentum_law


@functools.cache
def stress_kernel(name, dtype):
    """A kernel that evaluates the functions of a conserving law at one point per thread."""
    law, p = energy_momentum_law(name, dtype), precision(dtype)
    coef = wp.types.vector(length=materials.NCOEF, dtype=p.T)

    @wp.kernel(module=kernel_module(f"test_conserving_{name}_{dtype}"))
    def evaluate(
        c: wp.array(dtype=coef),
        G: wp.array(dtype=p.mat33),
        D: wp.array(dtype=p.mat33),
        dE: wp.array(dtype=p.mat33),
        stress: wp.array(dtype=p.mat33),
        increment: wp.array(dtype=p.mat33),
    ):
        k = wp.tid()
        stress[k] = law.mean_stress(G[k], D[k], c[0])
        increment[k] = law.mean_increment(G[k], dE[k], c[0])

    return evaluate


def evaluate(name, G, D, dE=None, dtype="float64"):
    """S (n, 3, 3) and dS (n, 3, 3) at G, half of whose change is D."""
    p, n = precision(dtype), len(G)
    T = {"float64": np.float64, "float32": np.float32}[dtype]
    coef = wp.types.vector(length=materials.NCOEF, dtype=p.T)
    c = np.zeros((1, materials.NCOEF), T)
    own = LAWS[name].coefficients()
    c[0, : len(own)] = own
    dE = np.zeros((n, 3, 3)) if dE is None else dE
    ins = [
        wp.array(np.asarray(x, T), dtype=kind, device="cpu")
        for x, kind in ((c, coef), (G, p.mat33), (D, p.mat33), (dE, p.mat33))
    ]
    outs = [wp.zeros(n, dtype=p.mat33, device="cpu") for _ in range(2)]
    wp.launch(stress_kernel(name, dtype), dim=n, inputs=ins + outs, device="cpu")
    return [x.numpy().astype(float) for x in outs]


def green(G):
    Gt = np.swapaxes(G, -1, -2)
    return 0.5 * (G + Gt + Gt @ G)


def energy(name, G):
    """W of displacement gradients (n, 3, 3) in long doubles, J/m^3, from the definitions of the laws."""
    G = np.asarray(G, dtype=np.longdouble)
    c = [np.longdouble(x) for x in LAWS[name].coefficients()]
    if name == "svk":
        E = green(G)
        tr = np.trace(E, axis1=1, axis2=2)
        return c[0] / 2 * tr**2 + c[1] * np.einsum("nij,nij->n", E, E)
    F = np.eye(3, dtype=np.longdouble) + G
    C = np.swapaxes(F, 1, 2) @ F
    J = np.einsum("ni,ni->n", F[:, 0], np.cross(F[:, 1], F[:, 2]))
    I1 = np.trace(C, axis1=1, axis2=2)
    I2 = (I1**2 - np.einsum("nij,nji->n", C, C)) / 2
    third = np.longdouble(1) / 3
    W = c[0] * (J ** (-2 * third) * I1 - 3) + c[1] / 2 * (J - 1) ** 2
    return W + (c[2] * (J ** (-4 * third) * I2 - 3) if len(c) > 2 else 0)


def ends(size, change, count=200, seed=0):
    """G half-way and half of its change: strains of `size`, turned by up to a radian, changing by about `change`."""
    rng = np.random.default_rng(seed)
    G = size * rng.uniform(-1, 1, (count, 3, 3))
    turn = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    turn *= np.linalg.det(turn)[:, None, None]
    G = turn @ (np.eye(3) + G) - np.eye(3)
    return G, change * rng.uniform(-1, 1, (count, 3, 3))


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("change", [0.1, 1e-2, 1e-4, 1e-8])
def test_the_stress_does_the_work_that_the_energy_changes_by(name, change):
    G, D = ends(0.2, change)
    S, _ = evaluate(name, G, D)
    assert np.allclose(S, np.swapaxes(S, 1, 2), rtol=0, atol=1e-10 * np.abs(S).max())
    dE = np.asarray(green(G.astype(np.longdouble) + D) - green(G.astype(np.longdouble) - D))
    work = np.einsum("nij,nij->n", S.astype(np.longdouble), dE)
    gain = energy(name, G.astype(np.longdouble) + D) - energy(name, G.astype(np.longdouble) - D)
    size = np.linalg.norm(S, axis=(1, 2)) * np.linalg.norm(dE.astype(float), axis=(1, 2))
    assert np.max(np.abs(work - gain) / size) < 2e-14 + 1e-18 / change  # of the difference in long doubles


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("size", [0.2, 1e-4])
@pytest.mark.parametrize("name", LAWS)
def test_the_stress_is_that_of_the_law_where_nothing_changes(name, size, dtype):
    """Also where the change is of the size of rounding: a quotient of roundings would show."""
    G, D = ends(size, 1.0)
    _, P = law_stress(name, G)
    exact = np.linalg.solve(np.eye(3) + G, P)
    eps = {"float64": 2e-16, "float32": 1e-7}[dtype]
    bound = 100 * eps * 4e6  # of the stiffness: displacement gradients of a turned body are rounded like one
    for change in (0.0, 1e-30, eps, 10 * eps):
        S, _ = evaluate(name, G, change * D, dtype=dtype)
        assert np.abs(S - exact).max() < bound + 1e8 * change**1


def law_stress(name, G):
    """Energy and P by the kernels of the law itself."""
    law, p = materials.law_functions(name, "float64"), precision("float64")
    coef = wp.types.vector(length=materials.NCOEF, dtype=p.T)

    @wp.kernel(module=kernel_module(f"test_conserving_plain_{name}"))
    def plain(c: wp.array(dtype=coef), G: wp.array(dtype=p.mat33), W: wp.array(dtype=p.T), P: wp.array(dtype=p.mat33)):
        k = wp.tid()
        W[k] = law.energy(G[k], c[0])
        P[k] = law.stress(G[k], c[0])

    c = np.zeros((1, materials.NCOEF))
    own = LAWS[name].coefficients()
    c[0, : len(own)] = own
    ins = [wp.array(x, dtype=kind, device="cpu") for x, kind in ((c, coef), (G, p.mat33))]
    outs = [wp.zeros(len(G), dtype=kind, device="cpu") for kind in (p.T, p.mat33)]
    wp.launch(plain, dim=len(G), inputs=ins + outs, device="cpu")
    return [x.numpy() for x in outs]


@pytest.mark.parametrize("name", LAWS)
def test_the_stress_is_of_second_order(name):
    """Its distance from S at the mean strain falls with the square of the change."""
    G, D = ends(0.2, 1.0)
    far = []
    for change in (1e-2, 5e-3):
        mean = green(G) + 0.5 * change**2 * np.swapaxes(D, 1, 2) @ D
        w, V = np.linalg.eigh(np.eye(3) + 2 * mean)
        U = V @ (np.sqrt(w)[:, :, None] * np.swapaxes(V, 1, 2))  # any F with that strain
        exact = np.linalg.solve(U, law_stress(name, U - np.eye(3))[1])
        far.append(np.linalg.norm(evaluate(name, G, change * D)[0] - exact))
    if name == "svk":
        assert max(far) < 1e-7  # rounding of 1e6 Pa
    else:
        assert far[0] / far[1] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("name", LAWS)
def test_the_moduli_are_the_derivative_of_the_stress(name):
    """Against differences of S(E) at E of G."""
    G, _ = ends(0.2, 0.0, count=20)
    rng = np.random.default_rng(3)
    H = rng.uniform(-1, 1, G.shape)
    h = 1e-5
    F = np.eye(3) + G
    dE = 0.5 * (np.swapaxes(F, 1, 2) @ H + np.swapaxes(H, 1, 2) @ F)

    def stress(t):
        return np.linalg.solve(F + t * H, law_stress(name, G + t * H)[1])

    numeric = (stress(h) - stress(-h)) / (2 * h)
    _, dS = evaluate(name, G, np.zeros_like(G), dE)
    np.testing.assert_allclose(dS, numeric, atol=1e-8 * np.abs(numeric).max())
