"""ANCF families: functions, continuity, rigid motions."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.linalg
from ancf_bodies import E_MODULUS, RHO, TURN, ball, parent_points, rotation, state_of
from ancf_shapes import SHAPES, SPLIT, affine, build, difference

import warpfea as wf
from warpfea import elements
from warpfea.elements import ancf, ancf_beam, ancf_shell
from warpfea.model import assembly
from warpfea.model.discretisation import element_functions

WITH_RULES = SPLIT + [(name, None) for name in SHAPES if (name, "split") not in SPLIT]


def tables(body, xi):
    """s (E, Q, S), h (E, Q, S, 3), J0 (E, Q, 3, 3) at parent points."""
    s, ds, J0, _ = assembly.shape_and_jacobian(body, np.arange(len(body.mesh.cells)), xi)
    return s, assembly.shape_gradients(ds, J0), J0


# functions


@pytest.mark.parametrize("name", SHAPES)
def test_functions(name):
    """Partition of unity, derivatives, and slot values that are position and gradient at the node."""
    body, _ = build(name)
    family = body.family
    xi = parent_points(family, 20)
    every = np.arange(len(body.mesh.cells))
    s, ds = element_functions(body, every, xi)
    position = family.slot_kind == 0
    assert np.abs(s[..., position].sum(axis=2) - 1).max() < 1e-13
    assert np.abs(ds[..., position, :].sum(axis=2)).max() < 1e-12
    for k in range(3):  # exact for the polynomials at hand
        numeric = difference(lambda t: element_functions(body, every, xi + t * np.eye(3)[k])[0], 0.1)  # noqa: B023
        assert np.abs(ds[..., k] - numeric).max() < 1e-12 * np.abs(ds).max()
    s, h, J0 = tables(body, family.node_points)
    assert np.linalg.det(J0).min() > 0
    for n, kinds in enumerate(family.node_slots):
        own = family.slot_node == n
        assert np.abs(s[:, n] - (own & position)).max() < 1e-13
        if len(kinds) == 4:
            axes = np.eye(3) if body.node_axes is None else body.node_axes[body.mesh.cells[:, n]]
            along = h[:, n] @ axes  # (E, S, 3)
            expected = np.array([own & (family.slot_kind == k + 1) for k in range(3)]).T
            assert np.abs(along - expected).max() < 1e-11 * np.abs(h[:, n]).max()


@pytest.mark.parametrize("name", SHAPES)
def test_linear_fields(name):
    """e = A E + b gives r = A X + b and F = A everywhere."""
    body, _ = build(name)
    A, b = np.random.default_rng(1).uniform(-1, 1, (3, 3)), np.array([1.0, 2.0, 3.0])
    s, h, _ = tables(body, parent_points(body.family, 20))
    e = (body.reference + affine(body, A, b))[body.connectivity]
    X = np.einsum("eqs,esk->eqk", s, body.reference[body.connectivity])
    assert np.abs(np.einsum("eqs,esk->eqk", s, e) - X @ A.T - b).max() < 1e-13
    assert np.abs(np.einsum("esk,eqsl->eqkl", e, h) - A).max() < 1e-11


def test_paper_bases(data):
    """Paper I's monomials: 3243 of Eq. (2), and 3443 of Eq. (3), which needs its nodes in the u-w plane."""
    xi = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    powers = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (2, 0, 0), (3, 0, 0)])
    inverse = ancf.nodal_basis(powers, np.array([(0.0, 0, 0), (1.0, 0, 0)]))
    for mine, expected in zip(ancf_beam.parent_functions(xi), ancf.nodal_functions(powers, inverse, xi)):
        assert np.abs(mine - expected).max() < 1e-13
    ref = data.json("S6_i_iii_shell_basis_tet_rules")["i_shell3443"]
    square = np.array([(-1.0, -1, 0), (1.0, -1, 0), (1.0, 1, 0), (-1.0, 1, 0)])
    s, _ = ancf.nodal_functions(ancf_shell.SHELL_EXPONENTS, ancf.nodal_basis(ancf_shell.SHELL_EXPONENTS, square), xi)
    u, w, v = xi.T
    expected = [eval(f, {"u": u, "v": v, "w": w}) for f in ref["nodes_u-w_plane"]["shape_functions"]]  # r, u, v, w
    order = (np.arange(16).reshape(4, 4)[:, [0, 1, 3, 2]]).ravel()
    assert np.abs(s - np.array(expected).T[:, order]).max() < 1e-13
    for plane in ([0, 2, 1], [2, 1, 0]):  # u-v, v-w
        with pytest.raises(wf.ModelError, match=r"rank 10 at these 4 nodes; .* u-w plane"):
            ancf.nodal_basis(ancf_shell.SHELL_EXPONENTS, square[:, plane])


def polynomials(degree, dimension=3):
    powers = [p for p in itertools.product(range(degree + 1), repeat=3) if sum(p) <= degree]
    return [p for p in powers if not any(p[dimension:])]


def reproduced(body, degree, dimension, turn):
    """Error of interpolating monomials of X in turned axes, largest at random points per monomial."""
    family = body.family
    s, _, _ = tables(body, parent_points(family, 20) * np.repeat([1.0, 0.0], [dimension, 3 - dimension]))
    Y = body.reference @ turn
    X = np.einsum("eqs,esk->eqk", s, Y[body.connectivity])
    node = Y[np.flatnonzero(body.slot_kind == 0)][np.cumsum(body.slot_kind == 0) - 1]  # position of each slot's node
    errors = []
    for p in np.array(polynomials(degree, dimension)):
        grad = np.stack(
            [p[k] * np.prod(node ** np.maximum(p - np.eye(3, dtype=int)[k], 0), axis=1) for k in range(3)], 1
        )
        value = np.where(body.slot_kind == 0, np.prod(node**p, axis=1), np.sum(grad * Y, axis=1))
        got = np.einsum("eqs,es->eq", s, value[body.connectivity])
        errors.append(np.abs(got - np.prod(X**p, axis=2)).max())
    return np.array(errors)


@pytest.mark.parametrize(
    ("name", "degree", "dimension"),
    [
        ("ENMC", 3, 3),
        ("FN18", 2, 3),
        ("FN", 1, 3),
        ("H3843 skew", 3, 3),
        ("shell square", 3, 2),
        ("shell skew", 3, 2),
        ("beam straight", 3, 1),
    ],
)
def test_polynomials(name, degree, dimension):
    """Complete polynomials of X along the solid, the mid-surface or the axis; the next degree is not held."""
    body, _ = build(name, n=1 if "H3843" in name else 3)
    assert reproduced(body, degree, dimension, TURN).max() < 1e-13
    assert reproduced(body, degree + 1, dimension, TURN).max() > 1e-4


@pytest.mark.parametrize("name", ["ENMC curved", "FN18 curved", "H3843 distorted", "shell distorted", "beam straight"])
def test_reference_geometry_is_the_mesh(name):
    """Curved T10, trilinear hexahedra, bilinear quads: the interpolated reference is the mesh's own."""
    body, _ = build(name)
    xi = parent_points(body.family, 20)
    s, _, _ = tables(body, xi)
    X = np.einsum("eqs,esk->eqk", s, body.reference[body.connectivity]) + body.origin
    if "curved" in name:
        T10 = elements.get_family("T10")
        mesh = ball()
        expected = np.einsum("qs,esk->eqk", T10.shape(xi, mesh.points[:1])[0][0], mesh.points[mesh.cells])
    elif "beam" in name:
        axes = body.node_axes[0] * [1.0, 0.15, 0.1]
        start = body.mesh.points[body.mesh.cells[:, 0]]
        expected = start[:, None] + (xi * [1 / 3, 1, 1]) @ axes.T
    else:
        corner = body.family.node_points
        x = np.where(corner > 0, xi[:, None], 1 - xi[:, None])
        x = np.prod(x[..., :2] if "shell" in name else x, axis=2)
        expected = np.einsum("qs,esk->eqk", x, body.mesh.points[body.mesh.cells])
        if "shell" in name:
            expected = expected + 0.1 * xi[:, 2, None] * TURN[:, 2]
    assert np.abs(X - expected).max() < 1e-13


def shared_faces(body):
    """Parent points of both sides of each face (end section, strip over an edge) that two elements share."""
    family = body.family
    seen, pairs = {}, []
    weights = {3: np.random.default_rng(0).dirichlet(np.ones(3), 8)}
    a, b = np.random.default_rng(1).uniform(0, 1, (2, 8))
    weights[4] = np.stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b], axis=1)
    corners_of = [n for n, kinds in enumerate(family.node_slots) if len(kinds) == 4]
    for e, cell in enumerate(body.mesh.cells):
        for corners in family.faces:
            gap = np.abs(corners[:, None] - family.node_points[corners_of]).sum(axis=2)
            near = gap.argmin(axis=1)
            offset = np.round(2 * (corners - family.node_points[corners_of][near])).astype(int)
            labels = [(cell[corners_of[n]], *o) for n, o in zip(near, offset)]
            free = {"line": np.ptp(corners[:, 0]) > 0, "quad": np.ptp(corners[:, 2]) == 0}
            if free.get(family.cell_type, False):
                continue
            other = seen.setdefault(frozenset(labels), (e, labels, corners))
            if other[0] != e:
                w = weights[len(corners)]
                mine = w @ corners[[labels.index(k) for k in other[1]]]
                pairs.append((other[0], w @ other[2], e, mine))
    return pairs


@pytest.mark.parametrize("name", SHAPES)
def test_elements_join(name):
    """Random slot values: the position is the same from both sides of every shared face."""
    body, _ = build(name)
    e = np.random.default_rng(3).uniform(-1, 1, body.reference.shape)
    pairs = shared_faces(body)
    assert len(pairs) >= {"beam": 2, "shell": 12}.get(name.split()[0], 20)
    worst = 0.0
    for first, xi, second, other in pairs:
        x = [
            element_functions(body, np.array([k]), p)[0][0] @ e[body.connectivity[k]]
            for k, p in ((first, xi), (second, other))
        ]
        worst = max(worst, np.abs(x[0] - x[1]).max())
    assert worst < 1e-13


# rigid motion


def scaled_eigenvalues(K):
    """Of D^-1/2 K D^-1/2, D the diagonal: slots of any unit count alike; as Rayleigh quotients, to 1e-16."""
    d = 1 / np.sqrt(np.diag(K))
    A = d[:, None] * (0.5 * (K + K.T)) * d
    _, modes = np.linalg.eigh(A)
    return np.sum(modes * (A @ modes), axis=0)


def lowest_elastic_eigenvalue(model):
    """Smallest omega^2 of K x = omega^2 M x beside the rigid motions, which are lifted away first."""
    K, M = (A.toarray() for A in (model.tangent_matrix(model.state()), model.mass_matrix()))
    Z = assembly.rigid_modes(model.slot_table.reference, model.slot_table.kind).reshape(6, -1).T
    lift = M @ Z @ np.linalg.cholesky(np.linalg.inv(Z.T @ M @ Z))
    d = 1 / np.sqrt(np.diag(K))
    high = K + E_MODULUS / RHO * lift @ lift.T
    # as the largest eigenvalue of its inverse: that one is resolved whatever the thinness
    return 1 / scipy.linalg.eigh(d[:, None] * M * d, d[:, None] * high * d, eigvals_only=True)[-1]


@pytest.mark.parametrize(
    ("name", "integration", "n"), [(*c, n) for c in WITH_RULES for n in (1, 2, 3) if n == 3 or "curved" not in c[0]]
)
def test_six_rigid_modes_and_no_more(name, integration, n):
    """One element, two, a patch; thick and thin. A zero-energy mode would make a seventh zero.

    With every slot scaled to a unit diagonal, round-off is some 1e-16 and bending some 0.1 to 1000 (t/L)^2.
    """
    for t in (None,) if integration is None else (0.1, 1e-3):
        _, model = build(name, integration, n=n, t=t)
        values = scaled_eigenvalues(model.tangent_matrix(model.state()).toarray())
        assert np.abs(values[:6]).max() < 1e-14
        assert values[6] > (0.05 * t**2 if t else 1e-3)


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize(("name", "integration"), [c for c in SPLIT if c[0] in ("beam straight", "shell square")])
def test_no_mode_below_bending(name, integration, n):
    """Thin (t/L = 1e-3) free bodies: the lowest elastic mode is that of Euler's beam or Kirchhoff's square plate.

    A mode with little energy, which a count of zeros does not see, would lie below. omega^2 = 4.73^4 EI/(rho A L^4) of
    the beam; 13.468^2 D/(rho t L^4) of the plate (nu = 0.3, twisting), with D = E t^3/12/(1 - nu^2).
    """
    t = 1e-3
    _, model = build(name, integration, n=n, t=t)
    thin = E_MODULUS / RHO * t**2 / 12
    theory = thin * 4.730041**4 if name == "beam straight" else thin / (1 - 0.3**2) * 13.468**2
    ratio = lowest_elastic_eigenvalue(model) / theory
    assert 0.99 < ratio < (2.0 if integration == "full" else 1.45)  # one cubic bends 1.44 times too stiff


@pytest.mark.parametrize("angle", [1.0, 77.0, 180.0])
@pytest.mark.parametrize(("name", "integration"), WITH_RULES)
def test_rigid_motion_costs_nothing(name, integration, angle):
    """Any rotation and a far translation: no force on the scale of E w |h|, no energy on that of E V."""
    body, model = build(name, integration)
    rule = body.family.rule(None) if integration is None else body.family.rules["full"]
    _, ds, J0, det = assembly.shape_and_jacobian(body, np.arange(len(body.mesh.cells)), rule.points)
    w = det * rule.weights
    size = np.einsum("eq,eqs->es", w, np.linalg.norm(assembly.shape_gradients(ds, J0), axis=3))
    scale = E_MODULUS * np.bincount(body.connectivity.ravel(), weights=size.ravel())
    state = state_of(model, affine(body, rotation(angle), (30.0, -40.0, 50.0)))
    assert np.abs(model.internal_force(state)[0] / scale[:, None]).max() < 1e-12
    assert model.strain_energy(state)[0] < 1e-24 * E_MODULUS * w.sum()
    assert model.evaluation.minimum_jacobian(state)[0] == pytest.approx(1.0, abs=1e-11)
