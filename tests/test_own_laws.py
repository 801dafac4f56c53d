"""An element and a material of one's own, each in this file alone."""

import functools
import types
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.common.types import precision
from warpfea.kernels.elements import materials as laws

import warpfea as wf
from warpfea import elements
from warpfea.elements.quadrature import box_rule

# an element of one's own: the trilinear brick


def _trilinear(xi, nodes):
    corner = elements.get_family("H3843").node_samples[:, 0]
    factor = np.where(corner > 0.5, xi[:, None, :], 1.0 - xi[:, None, :])
    slope = np.where(corner > 0.5, 1.0, -1.0)
    s = factor.prod(axis=2)
    ds = np.stack([slope[:, k] * np.delete(factor, k, axis=2).prod(axis=2) for k in range(3)], axis=2)
    return s[None], ds[None]


@functools.cache
def brick():
    """H8 is H3843 without gradients: other slots, functions and rules."""
    unit, old = ((0.0, 1.0),) * 3, elements.get_family("H3843")
    rule = box_rule((2, 2, 2), unit)
    return elements.register(
        replace(
            old, name="H8", node_slots=((0,),) * 8, shape=_trilinear, rules={"2x2x2": rule}, curved_rule=rule,
            mass_rule=box_rule((3, 3, 3), unit), curved_mass_rule=box_rule((3, 3, 3), unit), slot_sets={},
        )
    )  # fmt: skip


def test_an_element():
    """Mass, the patch test on a distorted mesh, and the tangent against differences."""
    brick()
    mesh = wf.mesh.box((1, 1, 1), cells=(2, 2, 2), element="H3843")
    inner = np.all((mesh.points > 0.1) & (mesh.points < 0.9), axis=1)
    points = mesh.points + 0.08 * inner[:, None] * np.array([1.0, -0.5, 0.7])
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(replace_points(mesh, points), element="H8", material=wf.SVK(E=1e5, nu=0.3, density=700.0))
    model = b.finalize(device="cpu")
    assert model.masses.matrix.sum() == pytest.approx(700.0, rel=1e-12)
    F = np.array([[0.1, 0.02, 0.0], [0.0, -0.05, 0.03], [0.01, 0.0, 0.04]])
    state = model.state()
    state.displacement.assign((body.reference @ F.T)[None])
    f = model.internal_force(state)[0]
    assert np.abs(f[inner]).max() < 1e-12 * np.abs(f).max()
    rng = np.random.default_rng(0)
    d = rng.normal(size=f.shape)
    u = state.displacement.numpy().copy()
    K = model.tangent_matrix(state)
    sides = []
    for s in (1e-6, -1e-6):
        state.displacement.assign(u + s * d[None])
        sides.append(model.internal_force(state)[0])
    expected = (sides[0] - sides[1]) / 2e-6
    assert np.abs((K @ d.ravel()).reshape(-1, 3) - expected).max() < 1e-7 * np.abs(expected).max()


def replace_points(mesh, points):
    out = replace(mesh, points=points)
    wf.mesh.check(out)
    return out


# a material of one's own: Psi = mu/2 E:E + q/4 (E:E)^2


@functools.cache
def quartic(dtype):
    """Device functions of the law; c = (mu/2, 0, 0, q): the first three are those of its stand-in at rest."""
    p, t, base = precision(dtype), laws.tensor_functions(dtype), laws.svk(dtype)
    T, mat33, vec3 = p.T, p.mat33, p.vec3
    coef = wp.types.vector(length=laws.NCOEF, dtype=T)

    @wp.func
    def energy(G: mat33, c: coef) -> T:
        """Psi."""
        E = t.green_lagrange(G)
        e = wp.ddot(E, E)
        return c[0] * e + T(0.25) * c[3] * e * e

    @wp.func
    def stress(G: mat33, c: coef) -> mat33:
        """P = F S, S = (mu + q E:E) E."""
        E = t.green_lagrange(G)
        S = (T(2.0) * c[0] + c[3] * wp.ddot(E, E)) * E
        return S + G * S

    @wp.func
    def increment(G: mat33, dG: mat33, c: coef) -> mat33:
        """dP = dF S + F dS."""
        F = t.identity() + G
        E = t.green_lagrange(G)
        dE = t.sym(wp.transpose(F) * dG)
        a = T(2.0) * c[0] + c[3] * wp.ddot(E, E)
        return dG * (a * E) + F * (a * dE + (T(2.0) * c[3] * wp.ddot(E, dE)) * E)

    @wp.func
    def block(G: mat33, a: vec3, c: coef) -> mat33:
        """That of its linear part, which is positive."""
        linear = coef()
        linear[1] = c[0]
        return base.block(G, a, linear)

    return types.SimpleNamespace(energy=energy, stress=stress, increment=increment, block=block)


@dataclass(frozen=True, eq=False)
class Quartic(wf.SVK):
    """S = (mu + q E:E) E, Pa."""

    q: float = 0.0
    law: ClassVar[str] = "test_quartic"

    def coefficients(self):
        return (self.E / 2.0, 0.0, 0.0, self.q)


def test_a_material(monkeypatch):
    """Force and tangent against differences of the energy, and a step."""
    monkeypatch.setitem(laws.LAWS, "test_quartic", quartic)
    b = wf.ModelBuilder()
    law = Quartic(E=1e5, nu=0.0, q=1e7, density=1000.0)
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(3, 1, 1)), material=law)
    b.clamp(body.nodes("x-"))
    model = b.finalize(device="cpu")
    rng = np.random.default_rng(0)
    u, d = 0.03 * rng.normal(size=(model.slots, 3)), rng.normal(size=(model.slots, 3))

    def at(x):
        state = model.state()
        state.displacement.assign(x[None])
        return state

    psi = [model.strain_energy(at(u + s * 1e-6 * d))[0] for s in (1, -1)]
    f = [model.internal_force(at(u + s * 1e-6 * d))[0] for s in (1, -1)]
    assert (model.internal_force(at(u))[0] * d).sum() == pytest.approx((psi[0] - psi[1]) / 2e-6, rel=1e-7)
    expected = (f[0] - f[1]) / 2e-6
    K = model.tangent_matrix(at(u))
    assert np.abs((K @ d.ravel()).reshape(-1, 3) - expected).max() < 1e-7 * np.abs(expected).max()
    sim = wf.Simulation(model, dt=1e-2)
    sim.step(3)
    assert sim.last.converged.all()
    assert sim.totals["newton"][0] <= 15
