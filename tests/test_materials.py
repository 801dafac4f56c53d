"""Constitutive laws at one point: derivatives, closed forms, objectivity, accuracy in float32."""

import functools

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.common.modules import kernel_module
from warpfea.kernels.common.types import precision
from warpfea.kernels.elements import materials

import warpfea as wf

LAWS = {
    "svk": wf.SVK(E=1e6, nu=0.3),
    "mooney_rivlin": wf.MooneyRivlin(mu10=3e5, mu01=1e5, k=1e6),
    "neo_hookean": wf.NeoHookean(mu=4e5, k=1e6),
}
SCALE = 1e6
pytestmark = pytest.mark.parametrize("name", LAWS)


@functools.cache
def kernel(name, dtype):
    """A kernel that evaluates the four functions of a law at one point per thread."""
    law, p = materials.law_functions(name, dtype), precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    coef = wp.types.vector(length=materials.NCOEF, dtype=T)

    @wp.kernel(module=kernel_module(f"test_materials_{name}_{dtype}"))
    def evaluate(
        c: wp.array(dtype=coef),
        G: wp.array(dtype=mat33),
        dG: wp.array(dtype=mat33),
        a: wp.array(dtype=vec3),
        energy: wp.array(dtype=T),
        stress: wp.array(dtype=mat33),
        increment: wp.array(dtype=mat33),
        block: wp.array(dtype=mat33),
    ):
        k = wp.tid()
        energy[k] = law.energy(G[k], c[0])
        stress[k] = law.stress(G[k], c[0])
        increment[k] = law.increment(G[k], dG[k], c[0])
        block[k] = law.block(G[k], a[k], c[0])

    return evaluate


def evaluate(name, G, dG=None, a=None, *, law=None, dtype="float64"):
    """Energy (n,), P (n, 3, 3), dP (n, 3, 3), block (n, 3, 3) at displacement gradients G (n, 3, 3)."""
    p, n = precision(dtype), len(G)
    T = {"float64": np.float64, "float32": np.float32}[dtype]
    coef = wp.types.vector(length=materials.NCOEF, dtype=p.T)
    c = np.zeros((1, materials.NCOEF), T)
    c[0, :3] = (law or LAWS[name]).coefficients()
    dG = np.zeros((n, 3, 3)) if dG is None else dG
    a = np.zeros((n, 3)) if a is None else a
    ins = [
        wp.array(np.asarray(x, T), dtype=kind, device="cpu")
        for x, kind in ((c, coef), (G, p.mat33), (dG, p.mat33), (a, p.vec3))
    ]
    outs = [wp.zeros(n, dtype=kind, device="cpu") for kind in (p.T, p.mat33, p.mat33, p.mat33)]
    wp.launch(kernel(name, dtype), dim=n, inputs=ins + outs, device="cpu")
    return [x.numpy().astype(float) for x in outs]


def gradients(count=200, size=0.45, seed=1):
    """Random displacement gradients, det F between 0.15 and 4, and directions of length 1."""
    rng = np.random.default_rng(seed)
    G = rng.uniform(-size, size, (20 * count, 3, 3))
    J = np.linalg.det(np.eye(3) + G)
    G = G[(J > 0.15) & (J < 4.0)][:count]
    dG = rng.normal(size=G.shape)
    return G, dG / np.linalg.norm(dG, axis=(1, 2), keepdims=True)


def rotations(count, seed=2):
    rng = np.random.default_rng(seed)
    Q, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    return Q * np.sign(np.linalg.det(Q))[:, None, None]


def slope(f, h):
    """Derivative at 0 of f by central differences with an error of O(h^6)."""
    one, two, three = ((f(k * h) - f(-k * h)) / (60 * h) for k in (1, 2, 3))
    return 45 * one - 9 * two + three


def relative(value, expected):
    axes = tuple(range(1, np.ndim(expected)))
    norm = lambda x: np.sqrt((np.asarray(x) ** 2).sum(axis=axes))  # noqa: E731
    return float((norm(value - expected) / np.maximum(norm(expected), 1e-3 * SCALE)).max())


def test_stress_is_the_gradient_of_the_energy(name):
    G, dG = gradients()
    P = evaluate(name, G)[1]
    numeric = slope(lambda s: evaluate(name, G + s * dG)[0], 1e-3)
    exact = np.einsum("nij,nij->n", P, dG)
    size = np.linalg.norm(P, axis=(1, 2)) + SCALE
    assert np.abs((numeric - exact) / size).max() < 1e-9


def test_increment_is_the_derivative_of_the_stress(name):
    G, dG = gradients()
    dP = evaluate(name, G, dG)[2]
    numeric = slope(lambda s: evaluate(name, G + s * dG)[1], 1e-3)
    assert relative(numeric, dP) < 1e-8


def test_increment_is_symmetric(name):
    G, A = gradients()
    _, B = gradients(seed=3)
    left = np.einsum("nij,nij->n", B, evaluate(name, G, A)[2])
    right = np.einsum("nij,nij->n", A, evaluate(name, G, B)[2])
    assert np.abs(left - right).max() < 1e-12 * np.abs(left).max()


def test_block_is_the_second_derivative_along_rank_one_directions(name):
    """Exact for the laws of Mooney-Rivlin's kind; for SVK in tension, and at least as large elsewhere."""
    G, _ = gradients()
    rng = np.random.default_rng(4)
    d, a = rng.normal(size=(2, len(G), 3))
    block = evaluate(name, G, a=a)[3]
    rank_one = d[:, :, None] * a[:, None, :]
    dP = evaluate(name, G, rank_one)[2]
    exact = np.einsum("nij,nij->n", dP, rank_one)
    value = np.einsum("ni,nij,nj->n", d, block, d)
    scale = np.abs(exact).max()
    assert np.abs(block - block.transpose(0, 2, 1)).max() < 1e-12 * np.abs(block).max()
    if name == "svk":
        E = 0.5 * (G + G.transpose(0, 2, 1) + G.transpose(0, 2, 1) @ G)
        lam, mu = LAWS[name].lame
        S = lam * np.trace(E, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 2 * mu * E
        tension = np.einsum("ni,nij,nj->n", a, S, a) >= 0
        assert 20 < tension.sum() < len(G) - 20
        assert np.all(value[~tension] > exact[~tension])
        value, exact = value[tension], exact[tension]
        assert np.linalg.eigvalsh(block).min() > 0
    assert np.abs(value - exact).max() < 1e-12 * scale


def test_block_is_positive_for_moderate_strains(name):
    G, _ = gradients(size=0.2)
    a = np.random.default_rng(5).normal(size=(len(G), 3))
    assert np.linalg.eigvalsh(evaluate(name, G, a=a)[3]).min() > 0


def test_rest_is_stress_free_and_linearly_elastic(name):
    _, dG = gradients()
    energy, P, dP, _ = evaluate(name, 0 * dG, dG)
    assert np.all(energy == 0)
    assert np.all(P == 0)
    lam, mu = LAWS[name].lame
    strain = 0.5 * (dG + dG.transpose(0, 2, 1))
    hooke = lam * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 2 * mu * strain
    assert relative(dP, hooke) < 1e-14


def test_frame_indifference(name):
    G, _ = gradients()
    F, Q = np.eye(3) + G, rotations(len(G))
    energy, P, _, _ = evaluate(name, G)
    turned_energy, turned, _, _ = evaluate(name, Q @ F - np.eye(3))
    assert relative(turned_energy, energy) < 1e-13
    assert relative(turned, Q @ P) < 1e-13
    tau = P @ F.transpose(0, 2, 1)
    assert np.abs(tau - tau.transpose(0, 2, 1)).max() < 1e-13 * np.abs(tau).max()


def test_isotropy(name):
    G, _ = gradients()
    Q = rotations(len(G))
    energy, P, _, _ = evaluate(name, G)
    other_energy, other, _, _ = evaluate(name, G @ Q + Q - np.eye(3))
    assert relative(other_energy, energy) < 1e-13
    assert relative(other, P @ Q) < 1e-13


def test_closed_forms_of_uniaxial_stretch_and_shear(name, data):
    """S2; a neo-Hookean or SVK solid has its own closed form of the shear."""
    ref = data.json("S2_closed_form_homogeneous")
    g = ref["simple_shear"]["gamma"]
    G = np.zeros((1, 3, 3))
    G[0, 0, 1] = g
    energy, P, _, _ = evaluate(name, G)
    if name == "svk":
        lam, mu = LAWS[name].lame
        assert data.error(energy[0], lam / 8 * g**4 + mu * (g**2 / 2 + g**4 / 4)) < 1e-14
        S = np.array([[0, mu * g, 0], [mu * g, mu * g**2, 0], [0, 0, 0]]) + lam / 2 * g**2 * np.eye(3)
        assert data.error(P[0], (np.eye(3) + G[0]) @ S) < 1e-14
        return
    if name == "neo_hookean":
        mu = LAWS[name].mu
        assert data.error(energy[0], mu / 2 * g**2) < 1e-14
        F = np.eye(3) + G[0]
        exact = mu * (F - (3 + g**2) / 3 * np.linalg.inv(F).T)
        assert data.error(P[0], exact) < 1e-14
        return
    assert data.error(energy[0], ref["simple_shear"]["Psi"]) < 1e-14
    assert data.error(P[0], ref["simple_shear"]["P"]) < 1e-14
    for case in ref["uniaxial"]:
        law = wf.MooneyRivlin(mu10=ref["mu10"], mu01=ref["mu01"], k=case["k"])
        side = case["lateral_stretch"]
        F = np.diag([case["stretch"], side, side])
        energy, P, _, _ = evaluate(name, (F - np.eye(3))[None], law=law)
        assert data.error(energy[0], case["strain_energy_density"]) < 1e-13
        assert data.error(P[0], np.diag([case["P11_nominal_stress"], 0, 0])) < 1e-12 * case["k"] / ref["mu10"]


def small_strain_errors(name):
    """Worst relative errors in float32 of energy, stress, increment and block at strains of 1e-5."""
    G, dG = gradients()
    a = np.random.default_rng(6).normal(size=(len(G), 3))
    G, dG, a = (x.astype(np.float32).astype(float) for x in (1e-5 * G / 0.45, dG, a))
    single, double = evaluate(name, G, dG, a, dtype="float32"), evaluate(name, G, dG, a)
    rows = [(np.abs(x - y).reshape(len(G), -1), np.abs(y).reshape(len(G), -1)) for x, y in zip(single, double)]
    return [float((error.max(axis=1) / size.max(axis=1)).max()) for error, size in rows]


def test_float32_stress_keeps_its_digits_at_small_strain(name):
    """Strains or J - 1 formed from F would have lost all but two of float32's seven digits."""
    assert max(small_strain_errors(name)[1:]) < 1e-5


def test_float32_energy_keeps_its_digits_at_small_strain(name):
    assert small_strain_errors(name)[0] < 1e-5


def test_float32_agrees_at_large_strain(name):
    G, dG = gradients()
    single, double = evaluate(name, G, dG, dtype="float32"), evaluate(name, G, dG)
    for x, y in zip(single[:3], double[:3]):
        assert np.abs(x - y).max() < 1e-5 * np.abs(y).max()


def test_coefficients_from_E_and_nu(name):
    law = type(LAWS[name]).from_E_nu(E=2e5, nu=0.4)
    lam, mu = law.lame
    assert mu == pytest.approx(2e5 / 2.8, rel=1e-14)
    assert lam == pytest.approx(2e5 * 0.4 / (1.4 * 0.2), rel=1e-13)
