"""ANCF families: functions, continuity, rigid modes, mass, tangent, patch tests, free fall."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import warp as wp

import warpfea as wf
from warpfea import elements
from warpfea.elements import ancf, ancf_beam, ancf_shell
from warpfea.elements.quadrature import box_rule, conical_tet
from warpfea.model import assembly
from warpfea.model.discretisation import element_functions

RHO, E_MODULUS = 7.0, 1e6
SVK = wf.SVK(E=E_MODULUS, nu=0.3, density=RHO)
GRAVITY = np.array([1.0, -2.0, -9.81])


def rotation(angle, axis=(1.0, -2.0, 0.5)):
    """Rotation matrix (Rodrigues), angle in degrees."""
    a, (x, y, z) = math.radians(angle), np.array(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(a) * K + (1 - math.cos(a)) * K @ K


TURN = rotation(50.0, (1.0, 2.0, -0.7))
SHIFT = np.array([2.0, -1.0, 0.5])


# geometries: builder, number of cells -> body


def lifted(mesh, amount=0.2, plane=False, seed=0):
    """The mesh with its inner nodes moved at random, by a part of an element's size."""
    rng = np.random.default_rng(seed)
    points = mesh.points.copy()
    outer = mesh.cells[mesh.boundary()[:, 0, None], mesh.kind.faces[mesh.boundary()[:, 1]]]
    inner = np.setdiff1d(mesh.used_nodes, outer)
    size = np.prod(np.ptp(points, axis=0)[: 2 if plane else 3]) / len(mesh.cells)
    moves = amount * size ** (1 / 2 if plane else 1 / 3) * rng.uniform(-1, 1, (len(inner), 3))
    points[inner] += moves * ([1, 1, 0] if plane else [1, 1, 1])
    return replace(mesh, points=points)


def beam(curve, normal=(0.2, -0.3, 1.0)):
    def make(b, n, t=0.1, **options):
        section = wf.Rectangle(1.5 * t, t)
        return b.add_beam(curve, elements=n, section=section, normal=normal, material=SVK, **options)

    return make


def arc(s):
    return np.array([math.cos(1.5 * s), math.sin(1.5 * s), 0.3 * s]) @ TURN.T + SHIFT


def uneven(s):
    """A straight line whose parameter runs unevenly: elements start and end with different dX/dxi."""
    return SHIFT + (s + 0.25 * s**2) / 1.25 * TURN[:, 0]


def turning(s):
    return np.array([0.0, math.cos(s), math.sin(s)])


def shell(map=None, distort=False, normals=None):
    def make(b, n, t=0.1, **options):
        cells = (n, n) if n != 2 else (2, 1)
        mesh = wf.mesh.grid((1, 1), cells=cells, map=None if distort else map)
        if distort:
            mesh = lifted(mesh, plane=True)
            mesh = replace(mesh, points=map(mesh.points))
        return b.add_shell(mesh, thickness=t, material=SVK, normals=normals, **options)

    return make


def placed(X):
    return X @ TURN.T + SHIFT


def skew(X):
    return X @ np.array([[1.3, 0.2, 0.0], [0.5, 0.8, 0.0], [0.0, 0.0, 1.0]])


def rolled(X):
    return np.column_stack([np.sin(X[:, 0]), X[:, 1], np.cos(X[:, 0])])


def corner_moved(X):
    """One corner of the unit square or cube drawn out: a single element is no parallelogram."""
    return X * (1 + 0.25 * np.prod(X[:, :2], axis=1, keepdims=True)) @ TURN.T + SHIFT


def solid(element, map=None, source=None):
    def make(b, n, **options):
        cells = {1: (1, 1, 1), 2: (2, 1, 1)}.get(n, (n, n, n - 1))
        if source:
            mesh = source()
        else:
            mesh = wf.mesh.box((1.0, 0.8, 0.6), cells=cells, element="T4" if element != "H3843" else element)
            mesh = lifted(mesh)
            mesh = replace(mesh, points=map(mesh.points)) if map else mesh
        if n == 1 and mesh.cell_type == "tetra":
            mesh = wf.mesh.Mesh(mesh.points[mesh.cells[2]], np.arange(4)[None], "tetra")
        return b.add_solid(mesh, material=SVK, element=element, **options)

    return make


def ball():
    return wf.mesh.sphere(0.7, cells=2, center=(3, -2, 1))


SHAPES = {
    "beam straight": beam([SHIFT, SHIFT + TURN[:, 0]]),
    "beam uneven": beam(uneven),
    "beam arc": beam(arc),
    "beam twisted": beam([(0, 0, 0), (1, 0, 0)], turning),
    "shell square": shell(placed),
    "shell skew": shell(lambda X: placed(skew(X))),
    "shell distorted": shell(corner_moved, distort=True),
    "shell rolled": shell(lambda X: placed(rolled(X))),
    "ENMC": solid("ENMC", placed),
    "ENMC curved": solid("ENMC", source=ball),
    "FN": solid("FN", placed),
    "FN18": solid("FN18", placed),
    "FN18 curved": solid("FN18", source=ball),
    "H3843 skew": solid("H3843", lambda X: placed(skew(X))),
    "H3843 distorted": solid("H3843", corner_moved),
}
INTEGRATIONS = {"beam": (*elements.get("3243").schemes, "full"), "shell": (*elements.get("3443").schemes, "full")}
SPLIT = [(name, i) for name in SHAPES for i in INTEGRATIONS.get(name.split()[0], ())]
WITH_RULES = SPLIT + [(name, None) for name in SHAPES if (name, "split") not in SPLIT]
ONE_EACH = [c for c in SPLIT if c[0] in ("beam arc", "shell distorted")]
ONE_EACH += [("ENMC curved", None), ("FN", None), ("FN18", None), ("H3843 distorted", None)]


@functools.cache
def build(name, integration=None, n=3, dtype="float64", t=None):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    options = {"integration": integration} if integration else {}
    body = SHAPES[name](b, n, **options, **({"t": t} if t else {}))
    return body, b.finalize(device="cpu", dtype=dtype)


def state_of(model, u):
    state = model.state()
    state.displacement.assign(np.asarray(u)[None])
    return state


def affine(body, A, shift=(0, 0, 0)):
    """Slot displacements of x = A X + shift, X from the body's origin."""
    return body.reference @ (A - np.eye(3)).T + (body.slot_kind == 0)[:, None] * shift


def parent_points(family, count=20, seed=0):
    rng = np.random.default_rng(seed)
    if family.parent.low is None:
        return rng.dirichlet(np.ones(4), count)[:, 1:]
    return rng.uniform(family.parent.low, family.parent.high, (count, 3))


def tables(body, xi):
    """s (E, Q, S), h (E, Q, S, 3), J0 (E, Q, 3, 3) at parent points."""
    s, ds, J0, _ = assembly.geometry(body, np.arange(len(body.mesh.cells)), xi)
    return s, assembly.gradients(ds, J0), J0


def difference(f, h):
    """Derivative at 0 by central differences with an error of O(h^6)."""
    one, two, three = ((f(k * h) - f(-k * h)) / (60 * h) for k in (1, 2, 3))
    return 45 * one - 9 * two + three


# functions


@pytest.mark.parametrize("name", SHAPES)
def test_functions(name):
    """Partition of unity, derivatives, and slot values that are position and gradient at the node."""
    body, _ = build(name)
    family = body.family
    xi = parent_points(family)
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
    s, h, _ = tables(body, parent_points(body.family))
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
    s, _ = ancf.nodal_functions(ancf_shell.POWERS, ancf.nodal_basis(ancf_shell.POWERS, square), xi)
    u, w, v = xi.T
    expected = [eval(f, {"u": u, "v": v, "w": w}) for f in ref["nodes_u-w_plane"]["shape_functions"]]  # r, u, v, w
    order = (np.arange(16).reshape(4, 4)[:, [0, 1, 3, 2]]).ravel()
    assert np.abs(s - np.array(expected).T[:, order]).max() < 1e-13
    for plane in ([0, 2, 1], [2, 1, 0]):  # u-v, v-w
        with pytest.raises(wf.ModelError, match=r"rank 10 at these 4 nodes; .* u-w plane"):
            ancf.nodal_basis(ancf_shell.POWERS, square[:, plane])


def polynomials(degree, dimension=3):
    powers = [p for p in itertools.product(range(degree + 1), repeat=3) if sum(p) <= degree]
    return [p for p in powers if not any(p[dimension:])]


def reproduced(body, degree, dimension, turn):
    """Error of interpolating monomials of X in turned axes, largest at random points per monomial."""
    family = body.family
    s, _, _ = tables(body, parent_points(family) * np.repeat([1.0, 0.0], [dimension, 3 - dimension]))
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
    xi = parent_points(body.family)
    s, _, _ = tables(body, xi)
    X = np.einsum("eqs,esk->eqk", s, body.reference[body.connectivity]) + body.origin
    if "curved" in name:
        T10 = elements.get("T10")
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
    """Of D^-1/2 K D^-1/2, D the diagonal: slots of any unit count alike, and round-off is near 1e-15."""
    d = 1 / np.sqrt(np.diag(K))
    return np.linalg.eigvalsh(d[:, None] * (0.5 * (K + K.T)) * d)


def lowest_elastic_eigenvalue(model):
    """Smallest omega^2 of K x = omega^2 M x beside the rigid motions, which are lifted away first."""
    K, M = (A.toarray() for A in (model.tangent_matrix(model.state()), model.mass_matrix()))
    Z = assembly.rigid_modes(model.reference, model.slot_kind).reshape(6, -1).T
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
    _, ds, J0, det = assembly.geometry(body, np.arange(len(body.mesh.cells)), rule.points)
    w = det * rule.weights
    size = np.einsum("eq,eqs->es", w, np.linalg.norm(assembly.gradients(ds, J0), axis=3))
    scale = E_MODULUS * np.bincount(body.connectivity.ravel(), weights=size.ravel())
    state = state_of(model, affine(body, rotation(angle), (30.0, -40.0, 50.0)))
    assert np.abs(model.internal_force(state)[0] / scale[:, None]).max() < 1e-12
    assert model.strain_energy(state)[0] < 1e-24 * E_MODULUS * w.sum()
    assert model.minimum_jacobian(state)[0] == pytest.approx(1.0, abs=1e-11)


# mass


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
    s, _, _, det = assembly.geometry(body, np.arange(len(body.mesh.cells)), rule.points)
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


# tangent and energy


def strained(body, seed=0):
    """Displacements of a large strain and rotation, with J well above 0."""
    A = TURN @ (np.eye(3) + np.array([[0.1, 0.3, -0.1], [0.05, -0.2, 0.1], [-0.1, 0.2, 0.25]]))
    noise = np.random.default_rng(seed).uniform(-1, 1, body.reference.shape)
    return affine(body, A) + np.where(body.slot_kind == 0, 0.004, 0.05)[:, None] * noise


@pytest.mark.parametrize(("name", "integration"), ONE_EACH)
def test_tangent_and_force_are_derivatives(name, integration, data):
    body, model = build(name, integration, n=2)
    u, d = strained(body), np.random.default_rng(5).uniform(-1, 1, body.reference.shape)
    d[body.slot_kind == 0] *= 0.1
    state = state_of(model, u)
    assert 0.3 < model.minimum_jacobian(state)[0] < 2.0
    force = model.internal_force(state)[0]
    K = model.tangent_matrix(state)
    assert abs(K - K.T).max() < 1e-14 * abs(K).max()
    numeric = difference(lambda t: model.internal_force(state_of(model, u + t * d))[0], 1e-3)
    assert data.error((K @ d.ravel()).reshape(-1, 3), numeric) < 1e-9
    numeric = difference(lambda t: model.strain_energy(state_of(model, u + t * d))[0], 1e-3)
    assert data.error(np.sum(force * d), numeric) < 1e-9
    _, single = build(name, integration, n=2, dtype="float32")
    state = state_of(single, u)
    assert data.error(single.internal_force(state)[0], force) < 2e-5
    assert data.error(single.tangent_matrix(state).toarray(), K.toarray()) < 2e-5


# patch tests


def stretch_of(E):
    """Symmetric A with A^T A = I + 2 E."""
    values, vectors = np.linalg.eigh(np.eye(3) + 2 * np.array(E))
    return vectors * np.sqrt(values) @ vectors.T


def symmetric(xx, yy, zz, yz, xz, xy):
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


THIN = -0.3 / 0.7 * (0.06 + 0.14)  # no stress across a shell
STATES = {
    "shell": {  # x, y along the surface
        "plane stress": symmetric(0.06, 0.14, THIN, 0, 0, 0.08),
        "transverse shear": symmetric(0.06, 0.14, THIN, 0.03, -0.05, 0.08),
        "pressed": symmetric(0.06, 0.14, -0.05, 0, 0, 0.08),
    },
    "beam": {  # x along the axis
        "tension": symmetric(0.1, -0.03, -0.03, 0, 0, 0),
        "transverse shear": symmetric(0.1, -0.03, -0.03, 0, 0.02, -0.03),
        "pressed": symmetric(0.1, -0.05, 0.02, 0.03, 0, 0),
    },
}


def plate_mesh(kind):
    if kind == "parallelograms":
        return wf.mesh.grid((1, 1), cells=(3, 3), map=lambda X: placed(skew(X)))
    mesh = lifted(wf.mesh.grid((1, 1), cells=(3, 3)), amount=0.25, plane=True)
    return replace(mesh, points=placed(mesh.points))


def solid_mesh(element):
    if element == "H3843":
        return lifted(wf.mesh.box((1, 0.8, 0.8), cells=(3, 2, 2), element=element), amount=0.25)
    return lifted(wf.mesh.box((1, 0.8, 0.8), cells=(3, 2, 2), element="T4"), amount=0.25)


def patch(b, body, E, outer, sides=()):
    """Outer nodes held at e = A E, inner ones started elsewhere: error of the solution over the largest displacement.

    E in the axes of the first node. Sides that no node holds get the traction P N of the constant stress; "tied" has
    5/6 of the transverse shear.
    """
    Q = np.eye(3) if body.node_axes is None else body.node_axes[0]
    A = rotation(40.0) @ Q @ stretch_of(E) @ Q.T
    b.clamp(body.nodes(outer))
    lam, mu = SVK.lame
    S = lam * np.trace(E) * np.eye(3) + 2 * mu * E
    if body.rule == "tied":
        normal = {"3243": [1.0, 0.0, 0.0], "3443": [0.0, 0.0, 1.0]}[body.family.name]  # of the section, of the surface
        S = np.where(np.subtract.outer(normal, normal) != 0, 5 / 6 * S, S)
    for name, normal in sides:
        b.add_traction(body.surface(name), A @ Q @ S @ normal)
    model = b.finalize(device="cpu")
    exact = affine(body, A)
    free = model.free_slots[:, 0]
    assert free.sum() >= 8
    noise = np.random.default_rng(2).uniform(-1, 1, exact.shape)
    state = state_of(model, exact + free[:, None] * np.where(body.slot_kind == 0, 0.0005, 0.005)[:, None] * noise)
    result = wf.solve_static(model, load_steps=1, tol=1e-13, state=state)
    return np.abs(result.state.displacement.numpy()[0] - exact).max() / np.abs(exact).max()


def outer_nodes(mesh):
    rows = mesh.boundary()
    return np.unique(mesh.cells[rows[:, 0, None], mesh.kind.faces[rows[:, 1]]])


@pytest.mark.parametrize("integration", INTEGRATIONS["shell"])
@pytest.mark.parametrize("state", STATES["shell"])
@pytest.mark.parametrize("kind", ["parallelograms", "quads"])
def test_patch_of_shells(kind, state, integration):
    """Exact with no stress across, with a pressure of 0.1 E on both faces, and with transverse shear on parallelograms.

    "tied" interpolates covariant shears: transverse shear on other quads comes out with errors in the gradients of the
    size of the strain, measured here.
    """
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_shell(plate_mesh(kind), thickness=0.1, material=SVK, integration=integration)
    ez = np.array([0.0, 0.0, 1.0])
    error = patch(b, body, STATES["shell"][state], outer_nodes(body.mesh), [("top", ez), ("bottom", -ez)])
    measured = {"quads transverse shear": 0.045}
    assert error < (measured.get(f"{kind} {state}", 1e-9) if integration == "tied" else 1e-9)


@pytest.mark.parametrize("integration", INTEGRATIONS["beam"])
@pytest.mark.parametrize("state", STATES["beam"])
@pytest.mark.parametrize("curve", ["straight", "uneven"])
def test_patch_of_beams(curve, state, integration):
    """Exact in tension. "tied" takes the section's strains and the shear at the nodes: tractions on the sides, a moment
    or a pressure along the beam, come out with errors in the gradients, measured here."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = SHAPES[f"beam {curve}"](b, 4, integration=integration)
    _, y, z = np.eye(3)
    sides = [("side-", -y), ("side+", y), ("normal-", -z), ("normal+", z)]
    error = patch(b, body, STATES["beam"][state], [0, 4], sides)
    measured = {"transverse shear": 0.25, "pressed": 0.15}
    assert error < (measured.get(state, 1e-9) if integration == "tied" else 1e-9)


@pytest.mark.parametrize(
    ("element", "rule"),
    [("ENMC", None), ("ENMC", "conical4"), ("FN", None), ("FN18", None), ("H3843", "3x3x3"), ("H3843", "4x4x4")],
)
def test_patch_of_solids(element, rule):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(solid_mesh(element), material=SVK, element=element, quadrature=rule)
    assert patch(b, body, symmetric(0.1, -0.15, 0.2, 0.05, -0.1, 0.15), outer_nodes(body.mesh)) < 1e-9


# free fall


@wp.func
def uniform_field(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    return wp.vec3d(wp.float64(1.0) + t, wp.float64(-2.0), wp.float64(3.0) * wp.sin(t))


def fall(load, h, steps):
    u, v = np.zeros(3), np.zeros(3)
    for k in range(1, steps + 1):
        t = k * h
        v = v + h * (GRAVITY if load == "gravity" else np.array([1.0 + t, -2.0, 3.0 * np.sin(t)]))
        u = u + h * v
    return u


def fall_error(sim, bodies, exact):
    u = sim.state.displacement.numpy()[0]
    kind = sim.model.slot_kind[:, None]
    rows = np.concatenate([body.slots for body in bodies])
    return np.abs(u - np.where(kind == 0, exact, 0.0))[rows].max() / np.abs(exact).max()


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize(("name", "integration"), ONE_EACH)
def test_free_fall_is_exact(name, integration, dtype):
    bound = 1e-12 if dtype == "float64" else 1e-5
    for load in ("gravity", "field"):
        b = wf.ModelBuilder(gravity=GRAVITY if load == "gravity" else (0, 0, 0))
        body = SHAPES[name](b, 2, **({"integration": integration} if integration else {}))
        if load == "field":
            b.add_body_force(uniform_field)
        model = b.finalize(device="cpu", dtype=dtype)
        for cap in (1, 50):
            sim = wf.Simulation(model, dt=1.0, solver=wf.NewtonPCG(max_newton=cap, max_pcg=cap, max_halvings=0))
            for h in (1e-5, 1e-3, 0.1):
                sim.reset()
                sim.dt = h
                sim.step(8)
                assert fall_error(sim, [body], fall(load, h, 8)) < bound, (load, cap, h)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_free_fall_of_all_families_beside_held_ones(dtype):
    """All in one model, with a clamped beam and a driven shell, which do not feel the others."""
    b = wf.ModelBuilder(gravity=GRAVITY)
    bodies = []
    for name, integration in ONE_EACH:
        options = {"integration": integration} if integration else {}
        bodies.append(SHAPES[name](b, 2, **options, name=f"{name} {integration}"))
    bodies.append(b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=SVK, name="T10"))
    held = beam([(0, 0, 0), (1, 0, 0)])(b, 2, name="held")
    b.clamp(held.start)
    driven = shell()(b, 2, name="driven")
    b.drive(driven.edge("x-"), rotation=wf.Rotation((0, 0, 0), (0, 1, 0), ([0, 1], [0, 3])), slots="all")
    sim = wf.Simulation(b.finalize(device="cpu", dtype=dtype), dt=1e-3)
    sim.step(10)
    assert fall_error(sim, bodies, fall("gravity", 1e-3, 10)) < (1e-12 if dtype == "float64" else 1e-5)
    edge = sim.displacements(driven)[0, driven.edge("x-").indices]
    assert np.abs(edge).max() < 1e-9
    free = sim.displacements(held)[0, held.end.indices[0]]
    assert 0 < np.abs(free).max() < 2 * np.abs(fall("gravity", 1e-3, 10)).max()
