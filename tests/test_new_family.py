"""A family with four slots per node, known to this file only."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from element_meshes import AFFINE, LAWS, RHO, displaced, gauss_tetrahedron, lift, monomials, rotation

import warpfea as wf
from warpfea import elements
from warpfea.elements import quadrature
from warpfea.model import assembly

EDGES = list(itertools.combinations(range(4), 2))
KINDS = (0, 1, 2, 3)


def hermite_basis(xi):
    """Complete quadratics and a cubic L_i L_j (L_i - L_j) per edge: 16 functions and gradients at xi (Q, 3)."""
    L = np.column_stack([1 - xi.sum(axis=1), xi])
    dL = np.vstack([-np.ones(3), np.eye(3)])
    values, slopes = [*L.T], [np.broadcast_to(d, xi.shape) for d in dL]
    for i, j in EDGES:
        a, b = L[:, i, None], L[:, j, None]
        values += [(a * b)[:, 0], (a * b * (a - b))[:, 0]]
        slopes += [b * dL[i] + a * dL[j], (2 * a * b - b * b) * dL[i] + (a * a - 2 * a * b) * dL[j]]
    return np.stack(values, axis=1), np.stack(slopes, axis=1)


def hermite_shape(xi, nodes, frames=None):
    """Functions of the nodal values and gradients d/dX in the global frame, one row per element."""
    corners = elements.get_family("T4").node_points
    at_nodes, slopes_at_nodes = hermite_basis(corners)
    values, slopes = hermite_basis(xi)
    s, ds = np.empty((len(nodes), len(xi), 16)), np.empty((len(nodes), len(xi), 16, 3))
    for e, x in enumerate(nodes):
        inverse = np.linalg.inv((x[1:] - x[0]).T)
        B = np.empty((16, 16))
        for n in range(4):
            B[4 * n] = at_nodes[n]
            B[4 * n + 1 : 4 * n + 4] = (slopes_at_nodes[n] @ inverse).T
        C = np.linalg.inv(B)
        s[e] = values @ C
        ds[e] = np.einsum("qmk,mi->qik", slopes, C)
    return s, ds


SHARED_WITH_T4 = ("parent", "faces", "face_rule", "face_divisions", "node_samples", "vtk_subdivision")


@pytest.fixture(scope="module")
def hermite():
    family = elements.register(
        elements.Family(
            name="hermite-of-the-test",
            cell_type="tetra",
            node_slots=(KINDS,) * 4,
            shape=hermite_shape,
            rules={"tet14": elements.TET_RULES["tet14"]},
            curved_rule=elements.TET_RULES["tet14"],
            mass_rule=quadrature.conical_tet(4),
            curved_mass_rule=quadrature.conical_tet(4),
            vertices=elements.get_family("T4").vertices,
            affine=False,
            **{key: getattr(elements.get_family("T4"), key) for key in SHARED_WITH_T4},
        )
    )
    yield family.name
    elements.family._families.pop(family.name)


@pytest.fixture(scope="module")
def gradient_body(hermite, device):
    def build(law="svk", gravity=(0, 0, 0), **options):
        b = wf.ModelBuilder(gravity=gravity)
        m = lift(wf.mesh.box((1, 1, 1), cells=(2, 2, 2), element="T4", origin=(2, 0, -1)))
        body = b.add_solid(m, material=LAWS[law], element=hermite)
        return body, wf.Model(b.description, b.term_factory(), device=device, **options)

    return build


def slot_values(body, function, gradient):
    """Slots of a scalar field: values at position slots, derivatives at gradient slots."""
    X = body.mesh.points[body.slot_node]
    out = function(X)
    for k in (1, 2, 3):
        out = np.where(body.slot_kind == k, gradient(X)[:, k - 1], out)
    return out


def test_new_family_assembly(gradient_body, data):
    body, model = gradient_body()
    assert model.slots == 4 * 27
    assert model.blocks[0].slots == 16
    np.testing.assert_array_equal(body.slot_kind, np.tile(KINDS, 27))
    np.testing.assert_array_equal(body.reference[1:4], np.eye(3))
    _, _, J0, det = assembly.shape_and_jacobian(body, np.arange(48), gauss_tetrahedron(3)[0])
    x = body.mesh.points[body.mesh.cells]
    edges = np.moveaxis(x[:, 1:] - x[:, :1], 1, 2)
    assert data.error(J0, np.broadcast_to(edges[:, None], J0.shape)) < 1e-13
    assert data.error(det[:, 0] / 6, body.mesh.volumes()) < 1e-12


def test_new_family_mass(gradient_body, data):
    """Mass products of all quadratic fields, against closed-form integrals over the box."""
    body, model = gradient_body()
    scalar = model.mass_matrix()[::3, ::3]
    low, high = np.array([2, 0, -1.0]), np.array([3, 1, 0.0])
    powers = [e for d in range(3) for e in monomials(3, d)]

    def integral(e):
        return np.prod([(b ** (p + 1) - a ** (p + 1)) / (p + 1) for a, b, p in zip(low, high, e)])

    def field(e):
        e = np.array(e)

        def value(X):
            return np.prod(X**e, axis=1)

        def gradient(X):
            columns = [e[k] * np.prod(X ** np.maximum(e - np.eye(3, dtype=int)[k], 0), axis=1) for k in range(3)]
            return np.column_stack(columns)

        return slot_values(body, value, gradient)

    fields = np.array([field(e) for e in powers])
    exact = RHO * np.array([[integral(np.add(a, b)) for b in powers] for a in powers])
    assert data.error(fields @ (scalar @ fields.T), exact) < 1e-12
    assert np.linalg.eigvalsh(scalar.toarray()).min() > 0
    xi, w = gauss_tetrahedron()
    total = np.zeros(scalar.shape)
    x = body.mesh.points[body.mesh.cells]
    s, _ = hermite_shape(xi, x)
    for conn, table, volume in zip(body.connectivity, s, body.mesh.volumes()):
        total[np.ix_(conn, conn)] += RHO * 6 * volume * np.einsum("q,qi,qj->ij", w, table, table)
    assert data.error(scalar.toarray(), total) < 1e-12


@pytest.mark.parametrize("law", ["svk", "mooney_rivlin"])
def test_new_family_force(gradient_body, data, law):
    body, model = gradient_body(law)
    rng = np.random.default_rng(3)
    u = body.reference @ AFFINE.T + 0.02 * rng.uniform(-1, 1, (model.slots, 3))
    d = rng.uniform(-1, 1, u.shape)
    force = model.internal_force(displaced(model, u))[0]

    def energy(t):
        return model.strain_energy(displaced(model, u + t * d))[0]

    h = 1e-3
    one, two, three = ((energy(k * h) - energy(-k * h)) / (60 * h) for k in (1, 2, 3))
    assert data.error(45 * one - 9 * two + three, np.sum(force * d)) < 1e-9

    stiffness = np.abs(model.tangent_matrix(model.state())).max()
    turned = displaced(model, body.reference @ (rotation(130) - np.eye(3)).T + (body.slot_kind == 0)[:, None])
    assert np.abs(model.internal_force(turned)).max() < 1e-12 * stiffness
    # a constant strain: its energy is the density times the volume, its force vanishes at inner slots
    state = displaced(model, body.reference @ AFFINE.T)
    force = model.internal_force(state)[0]
    inner = np.flatnonzero(~np.isin(body.slot_node, body.mesh.faces(body.mesh.boundary())))
    assert len(inner) == 4
    assert np.abs(force[inner]).max() < 1e-12 * np.abs(force).max()


def test_new_family_falls_freely(gradient_body, data):
    g, h = np.array([1.0, -2.0, -9.81]), 1e-2
    body, model = gradient_body(gravity=g)
    sim = wf.Simulation(model, dt=h)
    sim.step(3)
    fall = 6 * h**2 * g  # backward Euler: h^2 g n (n + 1) / 2
    u = sim.state.displacement.numpy()[0]
    exact = np.where((body.slot_kind == 0)[:, None], fall, 0.0)
    assert data.error(u, exact) < 1e-12
    assert data.error(sim.displacements(body)[0], np.broadcast_to(fall, (27, 3))) < 1e-12
