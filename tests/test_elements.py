"""Element tables: quadrature, functions, mass, rigid motions, patch tests."""

from __future__ import annotations

import math

import numpy as np
import pytest
from element_meshes import AFFINE, LAWS, RHO, displaced, gauss_tetrahedron, mesh, monomials, rotation

import warpfea as wf
from warpfea import elements
from warpfea.elements import quadrature


def make(mesh, law, rule=None, *, device="cpu", tables=False, dtype="float64", support=None, element=None):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(mesh, material=law, quadrature=rule, element=element)
    if support:
        support(b, body)
    return body, wf.Model(b.description, b.term_factory(), device=device, tables=tables, dtype=dtype)


# quadrature


def exact_integral(exponents):
    """Over the unit triangle or tetrahedron: prod a_k! / (sum a_k + d)!."""
    return math.prod(map(math.factorial, exponents)) / math.factorial(sum(exponents) + len(exponents))


RULES = {
    "tet1": (elements.TET_RULES["tet1"], 1, 1),
    "tet4": (elements.TET_RULES["tet4"], 4, 2),
    "tet5_paper": (elements.TET_RULES["tet5_paper"], 5, 3),
    "tet8": (elements.TET_RULES["tet8"], 8, 3),
    "tet14": (elements.TET_RULES["tet14"], 14, 5),
    "conical2": (quadrature.conical_tet(2), 8, 3),
    "conical3": (quadrature.conical_tet(3), 27, 5),
    "conical4": (quadrature.conical_tet(4), 64, 7),
    "conical_triangle2": (quadrature.conical_triangle(2), 4, 3),
    "conical_triangle3": (quadrature.conical_triangle(3), 9, 5),
    "triangle6": (quadrature.triangle_6(), 6, 4),
}


@pytest.mark.parametrize("name", RULES)
def test_rule_is_exact_up_to_its_degree_and_no_further(name):
    rule, points, degree = RULES[name]
    assert (rule.name, len(rule.weights), rule.degree) == (name, points, degree)
    dimension = rule.points.shape[1]

    def error(exponents):
        value = rule.weights @ np.prod(rule.points ** np.array(exponents), axis=1)
        return abs(value / exact_integral(exponents) - 1.0)

    for d in range(degree + 1):
        assert max(map(error, monomials(dimension, d))) < 2e-14
    assert max(map(error, monomials(dimension, degree + 1))) > 1e-4
    inside = np.column_stack([rule.points, 1 - rule.points.sum(axis=1)])
    assert inside.min() > 0


def test_default_rules_have_positive_weights():
    for name in ("T4", "T10"):
        family = elements.get_family(name)
        for rule in (
            family.rule(None),
            family.curved_rule,
            family.mass_rule,
            family.curved_mass_rule,
            quadrature.triangle_6(),
        ):
            assert rule.weights.min() > 0, (name, rule.name)
    assert [elements.get_family(name).rule(None).name for name in ("T10", "T4")] == ["tet4", "tet1"]
    assert elements.TET_RULES["tet5_paper"].weights.min() == pytest.approx(-0.8 / 6, rel=1e-15)
    assert list(elements.get_family("T10").rules) == ["tet4", "tet5_paper", "tet8", "tet14"]


# shape functions


@pytest.mark.parametrize("name", ["T4", "T10"])
def test_shape_functions(name):
    family = elements.get_family(name)
    xi = np.random.default_rng(0).uniform(-0.2, 0.8, (50, 3))
    nodes = np.zeros((1, len(family.node_points), 3))
    s, ds = (a[0] for a in family.shape(xi, nodes))
    np.testing.assert_allclose(family.shape(family.node_points, nodes)[0][0], np.eye(family.slots), atol=1e-15)
    np.testing.assert_allclose(s.sum(axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(ds.sum(axis=1), 0.0, atol=1e-14)
    np.testing.assert_allclose(s @ family.node_points, xi, atol=1e-14)
    for k in range(3):  # central differences are exact for quadratics
        step = 0.1 * np.eye(3)[k]
        numeric = (family.shape(xi + step, nodes)[0][0] - family.shape(xi - step, nodes)[0][0]) / 0.2
        np.testing.assert_allclose(ds[:, :, k], numeric, atol=1e-13)


def test_t10_follows_meshio_node_order():
    """Mid-edge nodes 12, 23, 31, 14, 24, 34 of corners 1-4."""
    nodes = elements.get_family("T10").node_points
    pairs = [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]
    np.testing.assert_array_equal(nodes[4:], [(nodes[a] + nodes[b]) / 2 for a, b in pairs])
    np.testing.assert_array_equal(nodes[:4], [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


# volume and mass


def lagrange(xi, nodes):
    """Functions and gradients by inverting the monomials' values at the nodes; linear or quadratic."""
    exponents = np.array([e for d in range(2 if len(nodes) == 4 else 3) for e in monomials(3, d)])

    def basis(x):
        return np.prod(x[:, None, :] ** exponents, axis=2)

    def slopes(x):
        out = np.empty((len(x), len(exponents), 3))
        for k in range(3):
            lower = exponents - np.eye(3, dtype=int)[k] * (exponents[:, k : k + 1] > 0)
            out[:, :, k] = exponents[:, k] * np.prod(x[:, None, :] ** lower, axis=2)
        return out

    inverse = np.linalg.inv(basis(nodes))
    return basis(xi) @ inverse, np.einsum("qmk,mi->qik", slopes(xi), inverse)


def independent_mass(mesh, density):
    """Dense scalar mass matrix (nodes, nodes) and volume."""
    xi, w = gauss_tetrahedron()
    s, ds = lagrange(xi, elements.get_family("T4" if mesh.cells.shape[1] == 4 else "T10").node_points)
    M, volume = np.zeros((len(mesh.points),) * 2), 0.0
    for cell in mesh.cells:
        x = mesh.points[cell]
        dV = w * np.linalg.det(np.einsum("ni,qnk->qik", x, ds))
        M[np.ix_(cell, cell)] += np.einsum("q,qi,qj->ij", dV * density(s @ x), s, s)
        volume += dV.sum()
    return M, volume


@pytest.mark.parametrize("name", ["T4", "T10", "bent", "sphere", "cylinder"])
def test_volume_and_mass(name, data, device):
    m = mesh(name)
    body, model = make(m, LAWS["svk"], device=device)
    M = model.mass_matrix()
    scalar = M[::3, ::3].toarray()[np.ix_(body.node_slot, body.node_slot)]
    expected, volume = independent_mass(m, lambda X: np.full(len(X), RHO))
    assert data.error(m.volume(), volume) < 1e-12
    assert data.error(scalar.sum(), RHO * volume) < 1e-12
    assert data.error(model.info()["mass"], RHO * m.volume()) < 1e-12
    assert data.error(scalar, expected) < 1e-12
    assert abs(M - M.T).max() < 1e-15 * abs(M).max()
    assert M[::3, 1::3].nnz == 0
    assert np.linalg.eigvalsh(scalar).min() > 0
    if name in ("T4", "T10", "bent"):
        assert data.error(volume, 1.0) < 1e-12


@pytest.mark.parametrize("name", ["T4", "T10"])
def test_mass_with_a_density_that_varies(name, data, device):
    def density(X):
        return 2.0 + X[:, 0] + 0.5 * X[:, 1] - 0.25 * X[:, 2]

    m = mesh(name)
    body, model = make(m, wf.SVK(E=1e6, nu=0.3, density=density), device=device)
    scalar = model.mass_matrix()[::3, ::3].toarray()[np.ix_(body.node_slot, body.node_slot)]
    assert data.error(scalar, independent_mass(m, density)[0]) < 1e-13


def test_t10_mass_of_one_tetrahedron(data, device):
    ref = data.json("S6_i_iii_shell_basis_tet_rules")["ii_mass_T10"]
    body, model = make(mesh("tet"), wf.SVK(E=1.0, nu=0.3, density=6.0), device=device)  # density 1 / volume
    scalar = model.mass_matrix()[::3, ::3].toarray()[np.ix_(body.node_slot, body.node_slot)]
    assert data.error(scalar, ref["exact_times_1_over_volume"]) < 1e-14
    assert data.error(np.linalg.eigvalsh(scalar), ref["eig_exact"]) < 1e-14
    rule = elements.TET_RULES["tet5_paper"]  # why it may not integrate the mass
    s = elements.get_family("T10").shape(rule.points, np.zeros((1, 10, 3)))[0][0]
    five = np.einsum("q,qi,qj->ij", 6 * rule.weights, s, s)
    assert data.error(np.linalg.eigvalsh(five), ref["eig_5pt"]) < 1e-14
    assert np.linalg.eigvalsh(five).min() < -0.006


# rigid motions


COMPACT = {
    "T4": (lambda: wf.mesh.box((1, 1, 1), cells=(1, 1, 1), element="T4"), "tet1"),
    "T10": (lambda: wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), "tet4"),
    "sphere": (lambda: mesh("sphere"), None),
    "sphere-tet14": (lambda: mesh("sphere"), "tet14"),
}


def compact(name, law, device):
    build, rule = COMPACT[name]
    body, model = make(build(), LAWS[law], rule, device=device)
    assert model.features["table elements"] == name.startswith("sphere")
    return body, model


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", COMPACT)
def test_six_rigid_modes_and_no_more(name, law, device):
    _, model = compact(name, law, device)
    K = model.tangent_matrix(model.state()).toarray()
    values = np.linalg.eigvalsh(0.5 * (K + K.T))
    assert np.abs(values[:6]).max() < 1e-10 * values[-1]
    assert values[6] > 1e-6 * values[-1]


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", COMPACT)
@pytest.mark.parametrize("angle", [1.0, 77.0, 180.0])
def test_rigid_motion_costs_nothing(name, law, angle, device):
    body, model = compact(name, law, device)
    stiffness_times_size = np.abs(model.tangent_matrix(model.state())).max() * 1.0
    u = body.reference @ (rotation(angle) - np.eye(3)).T + np.array([3.0, -4.0, 5.0])
    state = displaced(model, u)
    assert np.abs(model.internal_force(state)).max() < 1e-12 * stiffness_times_size
    assert np.abs(model.strain_energy(state)).max() < 1e-24 * stiffness_times_size
    assert model.evaluation.minimum_jacobian(state)[0] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("law", LAWS)
def test_translation_is_exactly_free_of_force(law, device):
    """Displacements are taken relative to the element's first node: no round-off, however far."""
    _, model = compact("T10", law, device)
    state = displaced(model, np.tile([1e7, -3e6, 2e5], (model.slots, 1)))
    assert np.all(model.internal_force(state) == 0)
    assert np.all(model.strain_energy(state) == 0)


# patch tests


def drive_outside(b, body):
    """All outer nodes follow an affine field."""
    outer = body.nodes(np.unique(body.mesh.faces(body.mesh.boundary())))
    u = body.mesh.points[outer.indices] @ AFFINE.T
    b.drive(outer, displacement=([0, 1], np.stack([0 * u, u])))


PATCHES = [
    ("T4", "svk", "tet1"),
    ("T4", "mooney_rivlin", "tet1"),
    ("T10", "svk", "tet4"),
    ("T10", "mooney_rivlin", "tet4"),
    ("T10", "neo_hookean", "tet4"),
    ("sphere", "svk", "tet5_paper"),
    ("sphere", "svk", "tet14"),
    ("sphere", "svk", None),
    ("sphere", "mooney_rivlin", None),
    ("sphere", "mooney_rivlin", "tet14"),
    ("bent", "svk", "tet5_paper"),
    ("bent", "mooney_rivlin", "tet14"),
]


@pytest.mark.parametrize(("name", "law", "rule"), PATCHES)
def test_patch(name, law, rule, data, device):
    """A constant strain passes exactly. Curved elements need a rule of degree 3: cof J0 ds is cubic."""
    m = mesh(name)
    body, model = make(m, LAWS[law], rule, support=drive_outside, device=device)
    free = body.node_slot[np.setdiff1d(m.used_nodes, m.faces(m.boundary()))]
    assert len(free) >= 4
    assert model.free_slots[free].all()
    curved = name in ("sphere", "bent")
    assert model.features["table elements"] == curved
    result = wf.solve_static(model, load_steps=1, tol=1e-12)
    assert data.error(result.displacements(body)[0], m.points @ AFFINE.T) < 1e-12
    F = np.eye(3) + AFFINE
    for _, stress in model.evaluation.stresses(result.state):  # uniform
        assert np.ptp(stress, axis=(0, 1, 2)).max() < 1e-11 * np.abs(stress).max()
    assert model.evaluation.minimum_jacobian(result.state)[0] == pytest.approx(np.linalg.det(F), rel=1e-11)


# both paths


@pytest.mark.parametrize("law", ["svk", "mooney_rivlin"])
def test_both_paths_agree_on_straight_elements(law, data, device):
    m = mesh("T10")
    results = []
    u = 0.1 * np.random.default_rng(1).uniform(-1, 1, (len(m.points), 3)) / 3
    for tables in (False, True):
        _, model = make(m, LAWS[law], tables=tables, device=device)
        assert model.features["table elements"] == tables
        assert model.features["straight elements"] != tables
        state = displaced(model, u)
        results.append(
            (
                model.internal_force(state),
                model.strain_energy(state),
                model.evaluation.minimum_jacobian(state),
                model.tangent_matrix(state).toarray(),
            )
        )
    for straight, table in zip(*results):
        assert data.error(table, straight) < 1e-12


def test_a_mesh_with_straight_and_curved_elements_uses_both_paths(device):
    _, model = make(wf.mesh.sphere(1.0, cells=4), LAWS["svk"], device=device)
    counts = {block.key.affine: block.count for block in model.blocks}
    assert set(counts) == {True, False}
    assert sum(counts.values()) == 6 * 4**3
