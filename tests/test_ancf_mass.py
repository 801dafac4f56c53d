"""ANCF families: mass."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ancf_bodies import RHO, SHIFT, SVK, TURN, ball
from ancf_shapes import SHAPES, build, skew

import warpfea as wf
from warpfea.elements.quadrature import box_rule, conical_tet
from warpfea.model import assembly


def moments(body, model):
    """Mass, centre, and second moments int rho x x^T dV about the centre, from the mass matrix."""
    M = model.mass_matrix()
    assert abs(M - M.T).max() < 1e-15 * abs(M).max()
    scalar = M[::3, ::3]
    one = (body.slot_kind == 0).astype(float)
    mass = one @ scalar @ one
    X = body.reference
    first = one @ scalar @ X
    return mass, first / mass + body.origin, X.T @ scalar @ X - np.outer(first, first) / mass


def check_moments(name, mass, center, second, tolerance=1e-12, **options):
    body, model = build(name, **options)
    found = moments(body, model)
    for value, expected in zip(found, (mass, center, second)):
        assert np.abs(value - expected).max() < tolerance * np.abs(expected).max()
    assert model.info()["mass"] == pytest.approx(mass, rel=tolerance)
    assert np.linalg.eigvalsh(second).min() > 0
    scalar = model.mass_matrix()[::3, ::3].toarray()
    d = 1 / np.sqrt(np.diag(scalar))
    assert np.linalg.eigvalsh(d[:, None] * scalar * d).min() > 1e-7


@pytest.mark.parametrize("name", SHAPES)
def test_mass_matrix(name, data):
    """Every entry against a much richer rule."""
    body, model = build(name, n=2)
    parent = body.family.parent
    rule = conical_tet(7) if parent.low is None else box_rule((10, 8, 6), tuple(zip(parent.low, parent.high)))
    s, _, _, det = assembly.shape_and_jacobian(body, np.arange(len(body.mesh.cells)), rule.points)
    local = np.einsum("eq,eqi,eqj->eij", RHO * det * rule.weights, s, s, optimize=True)
    expected = np.zeros((model.slots, model.slots))
    for conn, m in zip(body.connectivity, local):
        expected[np.ix_(conn, conn)] += m
    d = 1 / np.sqrt(np.diag(expected))
    assert data.error(d[:, None] * model.mass_matrix()[::3, ::3].toarray() * d, d[:, None] * expected * d) < 1e-12


@pytest.mark.parametrize("name", ["beam straight", "beam uneven", "shell square", "shell skew"])
def test_mass_of_parallelepipeds(name):
    """A box J [-1/2, 1/2]^3: rho det J, its centre, and rho det J / 12 J J^T."""
    if "beam" in name:
        body, _ = build(name)
        J, center = body.node_axes[0] * [1.0, 0.15, 0.1], SHIFT + 0.5 * TURN[:, 0]
    else:
        A = TURN if name == "shell square" else TURN @ skew(np.eye(3)).T
        J, center = A * [1.0, 1.0, 0.1], A @ [0.5, 0.5, 0.0] + SHIFT
    volume = np.linalg.det(J)
    check_moments(name, RHO * volume, center, RHO * volume / 12 * J @ J.T)


@pytest.mark.parametrize("element", ["ENMC", "FN", "FN18", "H3843"])
def test_mass_of_an_irregular_mesh(element):
    name = element if element != "H3843" else "H3843 skew"
    A = TURN if element != "H3843" else TURN @ skew(np.eye(3)).T
    J = A * [1.0, 0.8, 0.6]
    volume = np.linalg.det(J)
    check_moments(name, RHO * volume, A @ [0.5, 0.4, 0.3] + SHIFT, RHO * volume / 12 * J @ J.T)


@pytest.mark.parametrize("name", ["ENMC curved", "FN18 curved"])
def test_mass_of_a_curved_mesh_is_that_of_its_t10(name):
    b = wf.ModelBuilder()
    body = b.add_solid(ball(), material=SVK)
    mass, center, second = moments(body, b.finalize(device="cpu"))
    assert mass == pytest.approx(RHO * ball().volume(), rel=1e-12)
    check_moments(name, mass, center, second)


def ring(n, t=0.1):
    """Sector of a ring about z: radius 1, 1.5 rad, section t radially by 1.5 t along z."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    radial = lambda s: np.array([math.cos(1.5 * s), math.sin(1.5 * s), 0.0])  # noqa: E731
    body = b.add_beam(radial, elements=n, section=wf.Rectangle(1.5 * t, t), normal=radial, material=SVK)
    return body, b.finalize(device="cpu")


def test_mass_of_a_ring_sector(data):
    """Against the true ring's closed form, which the linearly interpolated section approaches at second order, and
    against a fine quadrature of the interpolated geometry."""
    a, t, w = 1.5, 0.1, 0.15
    mass = RHO * a * t * w
    center = RHO * w * (t + t**3 / 12) * np.array([math.sin(a), 1 - math.cos(a), 0]) / mass
    third = ((1 + t / 2) ** 4 - (1 - t / 2) ** 4) / 4  # int r^3 dr
    cc, ss, cs = a / 2 + math.sin(2 * a) / 4, a / 2 - math.sin(2 * a) / 4, math.sin(a) ** 2 / 2
    second = RHO * w * third * np.array([[cc, cs, 0], [cs, ss, 0], [0, 0, 0]]) - mass * np.outer(center, center)
    second[2, 2] = mass * w**2 / 12
    errors = []
    for n in (8, 16):
        found = moments(*ring(n))
        errors.append([data.error(x, y) for x, y in zip(found, (mass, center, second))])
    assert np.max(errors[1]) < 1e-3
    assert np.min(np.array(errors[0]) / errors[1]) > 3.9

    x, weight = np.polynomial.legendre.leggauss(20)
    s, eta = (g.ravel() for g in np.meshgrid((1 + x) / 2, x / 2, indexing="ij"))
    dA = np.einsum("i,j->ij", weight / 2, weight / 2).ravel() * RHO * w
    H = np.polynomial.Polynomial
    hermite = [H([1, 0, -3, 2]), H([0, 1, -2, 1]), H([0, 0, 3, -2]), H([0, 0, -1, 1])]
    total, first = 0.0, np.zeros(2)
    for p in (0.0, a / 2):
        out = np.array([[math.cos(k), math.sin(k)] for k in (p, p + a / 2)])
        tangent = out[:, ::-1] * [-1, 1] * a / 2
        ends = np.stack([out[0], tangent[0], out[1], tangent[1]])
        radial = t * (out[0] + s[:, None] * (out[1] - out[0]))
        place = np.stack([h(s) for h in hermite], axis=1) @ ends + eta[:, None] * radial
        along = np.stack([h.deriv()(s) for h in hermite], axis=1) @ ends + eta[:, None] * t * (out[1] - out[0])
        dm = dA * np.abs(along[:, 0] * radial[:, 1] - along[:, 1] * radial[:, 0])
        total, first = total + dm.sum(), first + dm @ place
    mass, center, _ = moments(*ring(2))
    assert data.error(mass, total) < 1e-9  # add_beam takes the curve's derivative by differences
    assert data.error(center[:2], first / total) < 1e-9
