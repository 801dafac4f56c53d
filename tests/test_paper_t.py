"""Paper T's equations of the ANCF tetrahedra against each other, the library's tables and a symbolic check of them."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import paper_t as T
import pytest

from warpfea.elements.ancf_solid import TET_CORNERS, TET_FACES, tet_functions

FACTORS = (2.0 / 81.0, 1.0 / 18.0)  # FN as printed, FN18
CENTROIDS = np.array([[n in face for n in range(4)] for face in TET_FACES]) / 3.0  # volume coordinates
LAMBDA = np.random.default_rng(1).dirichlet(np.ones(4), 40)
TOLERANCE = 1e-13


@functools.cache
def _tets():
    rng = np.random.default_rng(2)
    out = []
    for k in range(4):
        corners = TET_CORNERS @ (np.eye(3) + 0.4 * rng.uniform(-1, 1, (3, 3))) + rng.uniform(-1, 1, 3)
        out += [corners, corners[np.roll([0, 2, 1, 3], k)]]
    return out


@pytest.fixture(params=range(8))
def corners(request):
    """Random tetrahedra near the unit one, then the same with corners permuted, so that both orientations come."""
    return _tets()[request.param]


@pytest.fixture(scope="module")
def ref(data):
    return data.json("S6_iv_ancf_tets")


def derivative(f, points, direction):
    """Derivative of f along directions: two central differences whose combination is exact up to degree 4."""
    h = 0.5
    near = f(points + h * direction) - f(points - h * direction)
    far = f(points + 2 * h * direction) - f(points - 2 * h * direction)
    return (8.0 * near - far) / (12.0 * h)


def gradient(f, points):
    """(Q, S, 3)"""
    return np.stack([derivative(f, points, e) for e in np.eye(3)], axis=2)


def volume_slots(f):
    """(20, S) nodal coordinates of fields of the volume coordinates, in ENMC's volume slots."""
    rows = []
    for i in range(4):
        corner = np.eye(4)[i : i + 1]
        rows.append(f(corner))
        rows += [derivative(f, corner, np.eye(4)[(i + m) % 4] - corner) for m in (1, 2, 3)]
    return np.vstack([*rows, f(CENTROIDS)])


def cartesian_slots(f, corners):
    """(20, S) nodal coordinates of fields of the position, in ENMC's Cartesian slots."""
    rows = np.concatenate([f(corners)[:, None], np.moveaxis(gradient(f, corners), 2, 1)], axis=1)
    return np.vstack([rows.reshape(16, -1), f(CENTROIDS @ corners)])


def cartesian(kind, corners):
    """Functions (Q, 3) -> (Q, S) of the position: ENMC for kind None, else FN with that factor."""

    def functions(points):
        lam = T.volume_coordinates(points, corners)
        return T.enmc_cartesian(lam, corners) if kind is None else T.fn_cartesian(lam, corners, kind)

    return functions


def monomials(degree):
    """Monomials of exactly this degree, as a function of points."""
    return lambda points: T.power_basis(points)[:, T.POWERS.sum(axis=1) == degree]


def reproduction(kind, corners, degree):
    """Largest error of the interpolated monomials of a degree."""
    f, points = monomials(degree), LAMBDA @ corners
    s = cartesian(kind, corners)(points)
    return np.abs(s @ cartesian_slots(f, corners)[: s.shape[1]] - f(points)).max()


def framed(functions, frame):
    """The library's frames: s_(n,k) = sum_a s_(n,a) T[k, a] with T = dX/dxi, for values or derivatives."""
    out = functions.copy()
    for n, k in itertools.product(range(4), range(3)):
        out[:, 4 * n + 1 + k] = sum(functions[:, 4 * n + 1 + a] * frame[k, a] for a in range(3))
    return out


def rank(*columns):
    return int(np.linalg.matrix_rank(np.hstack(columns)))


def test_volume_coordinates(corners, ref, data):
    edges = corners[1:] - corners[0]
    assert data.error(T.signed_volume(corners), np.linalg.det(edges) / 6.0) < TOLERANCE
    assert ref["A6_A10_A13"]["V1+V2+V3+V4 - signed volume (1/6 det[r2-r1,r3-r1,r4-r1])"] == "0"
    assert data.error(T.volume_coordinates(corners, corners), np.eye(4)) < TOLERANCE
    points = LAMBDA @ corners
    lam = T.volume_coordinates(points, corners)
    assert data.error(lam, LAMBDA) < TOLERANCE
    assert data.error(lam[:, 1:] @ edges, points - corners[0]) < TOLERANCE
    assert data.error(lam.sum(axis=1), 1.0) < TOLERANCE


def test_orientations_and_volumes():
    volumes = [T.signed_volume(c) for c in _tets()]
    assert {v > 0 for v in volumes} == {True, False}
    assert min(map(abs, volumes)) > 0.02
    swapped = [T.signed_volume(c[[1, 0, 2, 3]]) for c in _tets()]
    np.testing.assert_allclose(swapped, np.negative(volumes), rtol=TOLERANCE)


def test_bernstein(data):
    g = T.bernstein(LAMBDA)
    assert data.error(g.sum(axis=1), 1.0) < TOLERANCE
    assert data.error(g @ (T.LATTICE / 3.0), LAMBDA) < TOLERANCE  # linear precision: the order of the control net
    assert data.error(T.bezier_coefficients(T.bernstein), np.eye(20)) < TOLERANCE
    # S = B M interpolates: M inverts the nodal coordinates of the Bernstein polynomials
    assert data.error(volume_slots(T.bernstein) @ T.bezier_map(), np.eye(20)) < TOLERANCE


def test_a1_and_a2_are_the_bezier_map(data):
    g = T.bernstein(LAMBDA)
    assert data.error(T.enmc_volume(LAMBDA), g @ T.bezier_map()) < TOLERANCE
    for c in FACTORS:
        assert data.error(T.fn_volume(LAMBDA, c), g @ T.bezier_map(c)) < TOLERANCE
    assert data.error(T.fn_volume(LAMBDA), g @ T.bezier_map(2.0 / 81.0)) < TOLERANCE


@pytest.mark.parametrize("c", FACTORS)
def test_volume_functions_interpolate(c, data):
    assert data.error(volume_slots(T.enmc_volume), np.eye(20)) < TOLERANCE
    nodal = volume_slots(functools.partial(T.fn_volume, c=c))
    assert data.error(nodal[:16], np.eye(16)) < TOLERANCE
    # the constraint that FN's centroids obey, in numbers: face 1, 2, 3 leaves out corner 4, and so on
    for row, face in zip(nodal[16:], TET_FACES):
        expected = np.zeros(16)
        for i, j in itertools.permutations(face, 2):
            expected[4 * i] = 1.0 / 3.0
            expected[4 * i + (j - i) % 4] = c
        assert data.error(row, expected) < TOLERANCE


def test_cartesian_functions_interpolate(corners, data):
    assert data.error(cartesian_slots(cartesian(None, corners), corners), np.eye(20)) < TOLERANCE
    for c in FACTORS:
        assert data.error(cartesian_slots(cartesian(c, corners), corners)[:16], np.eye(16)) < TOLERANCE


def test_transformation_joins_both_parameterisations(corners, ref, data):
    assert [ref[k] for k in ("A1_vs_A3_nonzero", "A2_vs_A4_nonzero", "A5_vs_A4_nonzero")] == [[], [], []]
    full, four = T.transformation(corners), T.transformation(corners, 16)
    assert data.error(T.enmc_volume(LAMBDA) @ full, T.enmc_cartesian(LAMBDA, corners)) < TOLERANCE
    for kwargs in ({}, *({"c": c} for c in FACTORS)):
        a4 = T.fn_cartesian(LAMBDA, corners, **kwargs)
        assert data.error(T.fn_volume(LAMBDA, **kwargs) @ four, a4) < TOLERANCE
        assert data.error(T.fn_from_enmc_cartesian(LAMBDA, corners, **kwargs), a4) < TOLERANCE
    # e = T e* on a field
    f = monomials(3)
    volume = volume_slots(lambda lam: f(lam @ corners))
    assert data.error(full @ cartesian_slots(f, corners), volume) < TOLERANCE
    assert data.error(np.linalg.det(full), (6.0 * T.signed_volume(corners)) ** 4) < TOLERANCE


@pytest.mark.parametrize("c", [None, *FACTORS])
def test_library_functions(corners, c, data):
    xi = LAMBDA[:, 1:]
    s, ds = tet_functions(xi, c)
    volume = T.enmc_volume(LAMBDA) if c is None else T.fn_volume(LAMBDA, c)
    assert data.error(volume @ T.library_transformation(s.shape[1]), s) < TOLERANCE
    frame = (corners[1:] - corners[0]).T  # dX/dxi
    s, ds = framed(s, frame), framed(ds, frame)
    functions, points = cartesian(c, corners), LAMBDA @ corners
    assert data.error(functions(points), s) < TOLERANCE
    assert data.error(gradient(functions, points) @ frame, ds) < TOLERANCE


def test_incomplete_basis(ref, data):
    h = T.bezier_coefficients(T.incomplete_basis)
    fn, fn18 = (T.bezier_coefficients(functools.partial(T.fn_volume, c=c)) for c in FACTORS)
    assert {"rank_h": rank(h), "rank_FN": rank(fn), "rank_union": rank(h, fn)} == ref["A14"]
    assert rank(fn18) == 16
    assert rank(h, fn18) == 20  # A.14 is the basis of the printed factor only

    R = T.fn_in_incomplete_basis()
    assert data.error(T.incomplete_basis(LAMBDA) @ R, T.fn_volume(LAMBDA)) < TOLERANCE
    closed = np.zeros((16, 16))
    closed[range(4), range(0, 16, 4)] = 1.0
    for k, (i, j) in enumerate(T.PAIRS, start=4):
        closed[k, 4 * i] = 1.0
        closed[k, 4 * i + (j - i) % 4] = 1.0 / 3.0
    assert data.error(R, closed) < TOLERANCE


def test_incomplete_coefficients(corners, data):
    points = LAMBDA @ corners
    b = T.power_basis(points)
    x, y, z = points.T
    assert (
        data.error(b[:, [13, 14, 15, 16, 17, 18]].T, [x * x * y, y * y * x, y * y * z, z * z * y, x * x * z, z * z * x])
        < TOLERANCE
    )
    assert data.error(b[:, [0, 4, 7, 8, 9, 12, 19]].T, [x**0, x * x, x * y, y * z, x * z, z**3, x * y * z]) < TOLERANCE
    assert data.error(b @ T.power_map(corners), T.bernstein(LAMBDA)) < TOLERANCE
    a = T.incomplete_coefficients(corners)
    assert data.error(b @ a.T, T.incomplete_basis(LAMBDA)) < TOLERANCE
    # from there to FN with Cartesian slots
    fn = b @ a.T @ T.fn_in_incomplete_basis() @ T.transformation(corners, 16)
    assert data.error(fn, T.fn_cartesian(LAMBDA, corners)) < TOLERANCE
    # what the paper says of it: 1, x, y, z are there
    assert rank(a.T, np.eye(20)[:, :4]) == 16


@pytest.mark.parametrize(
    ("c", "key"), [(None, "ENMC_space"), (FACTORS[0], "FN_space"), (FACTORS[1], "FN_space_with_1_18_instead_of_2_81")]
)
def test_dimensions_of_the_spaces(c, key, ref):
    functions = T.enmc_volume if c is None else functools.partial(T.fn_volume, c=c)
    space = T.bezier_coefficients(functions)
    assert rank(space) == ref[key]["dim"]
    for degree, dimension in ((1, 4), (2, 10)):
        low = T.bezier_coefficients(lambda lam, n=dimension: T.power_basis(lam[:, 1:])[:, :n])
        expected = ref[key].get(f"dim_intersect_P{degree}", dimension)  # the complete cubic's are not listed
        assert rank(space) + rank(low) - rank(space, low) == expected


@pytest.mark.parametrize(("c", "degree"), [(None, 3), (FACTORS[0], 1), (FACTORS[1], 2)])
def test_reproduction_of_polynomials(corners, c, degree):
    for d in range(degree + 1):
        assert reproduction(c, corners, d) < TOLERANCE
    if degree < 3:
        assert reproduction(c, corners, degree + 1) > 1e-3


def test_quadratics_that_fn_misses(ref, data):
    """FN applied to monomials on the unit tetrahedron, against the symbolic result."""
    x, y, z = LAMBDA[:, 1:].T
    s = T.fn_cartesian(LAMBDA, TET_CORNERS)
    slots = cartesian_slots(T.power_basis, TET_CORNERS)[:16]
    names = ("1", "x", "y", "z", "x**2", "y**2", "z**2", "x*y", "y*z", "x*z")  # A.15's order
    listed = ref["FN_interp_minus_exact_on_reference_tet"]
    assert set(listed) == set(names)
    for k, name in enumerate(names):
        expected = eval(listed[name], {"__builtins__": {}}, {"x": x, "y": y, "z": z})
        assert data.error(s @ slots[:, k] - T.power_basis(LAMBDA[:, 1:])[:, k], expected, scale=1.0) < TOLERANCE


@pytest.mark.parametrize("c", [None, *FACTORS])
def test_continuity_across_a_face(c, data):
    """Neighbours that share Cartesian slots agree on the shared face, in every order of the second one's corners."""
    rng = np.random.default_rng(3)
    first = _tets()[0]
    apex = first[1:].mean(axis=0) + (first[1:].mean(axis=0) - first[0])
    points = rng.dirichlet(np.ones(3), 20) @ first[1:]  # on the face of corners 2, 3, 4
    nodal = {n: rng.uniform(-1, 1, 4) for n in range(5)}
    centroid = rng.uniform(-1, 1)

    def values(nodes, corners):
        e = np.concatenate([nodal[n] for n in nodes])
        if c is None:
            # the centroid's value goes to the face that leaves corner 0 or the apex out
            shared = [{nodes[n] for n in face} == {1, 2, 3} for face in TET_FACES]
            e = np.concatenate([e, np.where(shared, centroid, rng.uniform(-1, 1, 4))])
        return cartesian(c, corners)(points) @ e

    one = values((0, 1, 2, 3), first)
    everything = np.vstack([first, apex])
    for nodes in itertools.permutations((1, 2, 3, 4)):
        assert data.error(values(nodes, everything[list(nodes)]), one) < TOLERANCE
