"""Contact with obstacles as a builder describes it: shapes, colliders, contacts, and the points on faces."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea import elements as families
from warpfea.elements.quadrature import conical_triangle, lobatto_square, triangle_3, triangle_7
from warpfea.model import assembly, shapes
from warpfea.model.contact_points import body_mass_total, contact_points, effective_modulus
from warpfea.model.discretisation import Discretisation
from warpfea.model.handles import SurfaceSet

SIZE = np.array([1.0, 0.8, 0.6])
LAW = wf.SVK(E=1e6, nu=0.3, density=7.0)
C, S = math.cos(0.7), math.sin(0.7)
TURN = np.array([[C, S, 0.0], [-S, C, 0.0], [0.0, 0.0, 1.0]]) @ np.array([[1.0, 0, 0], [0, C, S], [0, -S, C]])


# rules


def exact_on_parent(corners, i, j):
    """The integral of a^i b^j over the unit triangle or square."""
    if corners == 4:
        return 1.0 / ((i + 1) * (j + 1))
    return math.factorial(i) * math.factorial(j) / math.factorial(i + j + 2)


@pytest.mark.parametrize("rule", [triangle_3(), triangle_7()], ids=lambda r: r.name)
def test_triangle_rules(rule):
    def error(degree):
        powers = [(i, degree - i) for i in range(degree + 1)]
        return max(abs(rule.weights @ np.prod(rule.points**p, axis=1) - exact_on_parent(3, *p)) for p in powers)

    assert max(error(d) for d in range(rule.degree + 1)) < 1e-15
    assert error(rule.degree + 1) > 1e-4
    assert {(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)} <= set(map(tuple, rule.points))


def test_area_weights_of_seven_points():
    assert triangle_7().weights * 2 == pytest.approx([1 / 20] * 3 + [2 / 15] * 3 + [9 / 20], rel=1e-15)


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_square_rules(n):
    rule = lobatto_square(n)

    def error(i, j):
        return abs(rule.weights @ np.prod(rule.points ** (i, j), axis=1) - exact_on_parent(4, i, j))

    degree = 2 * n - 3
    assert len(rule.weights) == n * n
    assert max(error(i, j) for i, j in itertools.product(range(degree + 1), repeat=2)) < 1e-14
    assert error(degree + 1, 0) > 1e-6
    assert set(itertools.product((0.0, 1.0), repeat=2)) <= set(map(tuple, rule.points))


# points on bodies: all of them fill the same box


def bulged(X):
    """Nodes inside of the box moved, so that its faces are cut unevenly but stay flat."""
    t = np.asarray(X) / SIZE
    return SIZE * (t + 0.3 * t * (1 - t) * (t - 0.2) * (1 + t[:, [1, 2, 0]]))


def solid(element, moved=True):
    name = element if element in ("T4", "T10", "H3843", "ENMC") else "T4"
    mesh = wf.mesh.box(tuple(SIZE), cells=(3, 2, 2), element=name)
    if moved and name != "T10":
        mesh = replace(mesh, points=bulged(mesh.points))
    return wf.ModelBuilder().add_solid(mesh, material=LAW, element=element)


def beam():
    line = [(0, SIZE[1] / 2, SIZE[2] / 2), (SIZE[0], SIZE[1] / 2, SIZE[2] / 2)]
    section = wf.Rectangle(SIZE[1], SIZE[2])
    return wf.ModelBuilder().add_beam(line, elements=3, section=section, normal=(0, 0, 1), material=LAW)


def shell():
    mesh = wf.mesh.grid((SIZE[0], SIZE[1]), cells=(3, 2))
    mesh = replace(mesh, points=bulged(mesh.points) + (0, 0, SIZE[2] / 2))
    return wf.ModelBuilder().add_shell(mesh, thickness=SIZE[2], material=LAW)


BODIES = {name: lambda name=name: solid(name) for name in ("T4", "T10", "ENMC", "FN", "FN18", "H3843")}
BODIES |= {"beam": beam, "shell": shell}


def whole(body):
    return SurfaceSet(body, body.boundary)


def over_box(powers):
    """The integral of x^i y^j z^k over the surface of the box."""
    along = SIZE ** (np.array(powers) + 1.0) / (np.array(powers) + 1.0)
    total = 0.0
    for k in range(3):
        ends = SIZE[k] ** powers[k] + 0.0 ** powers[k]
        total += ends * np.prod(np.delete(along, k))
    return total


@pytest.mark.parametrize("name", BODIES)
def test_polynomials_over_the_surface(name):
    p = contact_points(whole(BODIES[name]()))
    triangles = p.area.shape[1] == 7
    degree = 3 if triangles else 5
    powers = [q for q in itertools.product(range(degree + 1), repeat=3) if not triangles or sum(q) <= degree]
    for q in powers:
        assert np.sum(p.area * np.prod(p.X**q, axis=2)) == pytest.approx(over_box(q), rel=1e-12), q
    above = (degree + 1, 0, 0)
    assert np.sum(p.area * np.prod(p.X**above, axis=2)) != pytest.approx(over_box(above), rel=1e-9)


@pytest.mark.parametrize("name", BODIES)
def test_closed_surface(name):
    """The normals point outward and sum to nothing, and their divergence theorem gives the volume."""
    body = BODIES[name]()
    p = contact_points(whole(body))
    n = p.normal * p.area[:, :, None]
    assert np.abs(n.sum(axis=(0, 1))).max() < 1e-13
    assert np.sum(n * p.X) / 3 == pytest.approx(np.prod(SIZE), rel=1e-12)
    assert assembly.element_volumes(body).sum() == pytest.approx(np.prod(SIZE), rel=1e-12)
    np.testing.assert_allclose(np.linalg.norm(p.normal, axis=2), 1.0, rtol=1e-14)
    side = np.argmax(np.abs(p.normal), axis=2)
    at = np.take_along_axis(p.X, side[:, :, None], axis=2)[:, :, 0]
    outer = np.take_along_axis(p.normal, side[:, :, None], axis=2)[:, :, 0]
    np.testing.assert_allclose(at, np.where(outer > 0, SIZE[side], 0.0), atol=1e-14)


@pytest.mark.parametrize("name", BODIES)
def test_places_are_linear_in_the_slots(name):
    """The functions give the places, and a uniform pressure the loads that the family's own rule gives."""
    body = BODIES[name]()
    p = contact_points(whole(body))
    X = np.einsum("fpl,flk->fpk", p.shape, body.reference[p.conn]) + body.origin
    np.testing.assert_allclose(X, p.X, atol=1e-14)
    load = np.bincount(p.conn.ravel(), np.einsum("fp,fpl->fl", p.area, p.shape).ravel(), body.slot_count)
    slots, weights = assembly.surface_weights(whole(body))
    wanted = np.zeros(body.slot_count)
    wanted[slots] = weights
    assert np.abs(load - wanted).max() < 1e-13 * np.abs(wanted).max()


@pytest.mark.parametrize(("name", "points"), [("T10", 3), ("H3843", 4), ("beam", 4)])
def test_too_few_points_miss_a_uniform_pressure(name, points):
    """Mid-side nodes and gradients, whose functions vanish at the corners, get no load at all."""
    body = BODIES[name]()
    p = contact_points(whole(body), points)
    assert p.area.shape[1] == points
    assert p.area.sum() == pytest.approx(2 * (SIZE[0] * SIZE[1] + SIZE[1] * SIZE[2] + SIZE[2] * SIZE[0]), rel=1e-13)
    load = np.bincount(p.conn.ravel(), np.einsum("fp,fpl->fl", p.area, p.shape).ravel(), body.slot_count)
    slots, weights = assembly.surface_weights(whole(body))
    kinds = body.slot_kind[slots]
    least = 0.1 * np.array([np.abs(weights[kinds == k]).max(initial=0.0) for k in range(4)])[kinds]
    assert np.any((np.abs(weights) > np.maximum(least, 1e-12)) & (np.abs(load[slots]) < 1e-12))


@pytest.mark.parametrize("points", [4, 9, 16, 25])
def test_numbers_of_points_on_quadrilaterals(points):
    p = contact_points(shell().surface("top"), points)
    assert p.shape.shape[1] == points
    assert p.area.sum() == pytest.approx(SIZE[0] * SIZE[1], rel=1e-13)
    assert p.X[:, :, 2] == pytest.approx(SIZE[2])


@pytest.mark.parametrize("name", BODIES)
def test_corners_are_points(name):
    p = contact_points(whole(BODIES[name]()))
    corners = SIZE * list(itertools.product((0.0, 1.0), repeat=3))
    distance = np.linalg.norm(p.X.reshape(-1, 1, 3) - corners, axis=2).min(axis=0)
    assert distance.max() < 1e-14


def test_named_surface():
    body = solid("T10")
    p = contact_points(body.surface("x+"))
    assert p.X[:, :, 0] == pytest.approx(SIZE[0])
    assert p.area.sum() == pytest.approx(SIZE[1] * SIZE[2], rel=1e-13)
    np.testing.assert_array_equal(p.faces, body.surface("x+").faces)
    assert p.conn.shape[1] == 6


@pytest.mark.parametrize("element", ["T10", "ENMC"])
def test_curved_faces_of_a_ball(element):
    """The faces of a ball: normals sum to nothing exactly, area and volume as a rule of high degree gives."""
    mesh = wf.mesh.sphere(0.7, cells=4, center=(3, -2, 1), element="T10")
    body = wf.ModelBuilder().add_solid(mesh, material=LAW, element=element)
    p = contact_points(whole(body))
    fine = assembly.facet_tables(whole(body), rules={3: conical_triangle(7)})
    X, area = assembly.facet_places(body, fine)
    if element == "T10":
        assert np.abs((p.normal * p.area[:, :, None]).sum(axis=(0, 1))).max() < 1e-13
    assert p.area.sum() == pytest.approx(area.sum(), rel=2e-5)
    assert p.area.sum() == pytest.approx(4 * math.pi * 0.7**2, rel=5e-3)
    volume = np.sum(p.normal * p.area[:, :, None] * (p.X - (3, -2, 1))) / 3
    x = body.reference[fine.conn]
    n = np.cross(np.einsum("fqi,fik->fqk", fine.d_a, x), np.einsum("fqi,fik->fqk", fine.d_b, x))
    by_fine = np.sum(n * fine.weights[:, :, None] * (X - (3, -2, 1))) / 3
    assert volume == pytest.approx(by_fine, rel=2e-5)
    assert by_fine == pytest.approx(assembly.element_volumes(body).sum(), rel=1e-6)
    radius = np.linalg.norm(p.X - (3, -2, 1), axis=2)
    assert np.abs(radius[:, :6] / 0.7 - 1).max() < 1e-14  # vertices and mid-sides lie on the sphere
    assert np.einsum("fpk,fpk->fp", p.normal, p.X - (3, -2, 1)).min() > 0


def test_faces_of_both_kinds():
    """A prism, which has triangles and quadrilaterals: faces with fewer points are padded by points without area."""

    def shape(xi, nodes):
        a, b, c = xi.T
        flat = np.stack([1 - a - b, a, b], axis=1)
        d_flat = np.array([(-1.0, -1.0), (1.0, 0.0), (0.0, 1.0)])
        s = np.concatenate([flat * (1 - c)[:, None], flat * c[:, None]], axis=1)
        ds = np.zeros((len(xi), 6, 3))
        ds[:, :3, :2], ds[:, 3:, :2] = d_flat * (1 - c)[:, None, None], d_flat * c[:, None, None]
        ds[:, :3, 2], ds[:, 3:, 2] = -flat, flat
        return s[None], ds[None]

    corner = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1)], dtype=float)
    sides = [(0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)]
    family = replace(
        families.get("T4"),
        name="prism",
        node_slots=((0,),) * 6,
        shape=shape,
        faces=tuple(corner[list(f)] for f in sides),
    )
    points = corner * (2.0, 1.0, 3.0) + (5, 0, 0)
    mesh = SimpleNamespace(points=points, cells=np.arange(6)[None], cell_type="wedge",
                           bounding_box=lambda: (points.min(axis=0), points.max(axis=0)))  # fmt: skip
    body = Discretisation("prism", mesh, family, [("", LAW)], np.zeros(1, dtype=int), "tet1", "tet1")
    p = contact_points(SurfaceSet(body, np.array([(0, k) for k in range(5)])))
    assert p.area.shape == (5, 16)
    assert p.conn.shape == (5, 4)
    assert np.count_nonzero(p.area[:2]) == 14
    assert np.count_nonzero(p.area[2:]) == 48
    assert p.area.sum(axis=1) == pytest.approx([1, 1, 6, 3 * math.sqrt(5), 3], rel=1e-14)
    n = p.normal * p.area[:, :, None]
    assert np.abs(n.sum(axis=(0, 1))).max() < 1e-14
    assert np.sum(n * p.X) / 3 == pytest.approx(3.0, rel=1e-14)
    on_prism = np.abs(p.X[:, :, None] - points).max(axis=3).min(axis=2)
    assert np.all(on_prism[:2, 7:] == on_prism[:2, 6:7])  # padding repeats the last point
    with pytest.raises(wf.ModelError, match=r"points = 16.*triangles"):
        contact_points(SurfaceSet(body, np.array([(0, k) for k in range(5)])), 16)


# what the law needs of a body


@pytest.mark.parametrize("law", [wf.SVK, wf.NeoHookean, wf.MooneyRivlin])
@pytest.mark.parametrize("nu", [-0.2, 0.0, 0.3, 0.49])
def test_effective_modulus(law, nu):
    body = wf.ModelBuilder().add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), material=law.from_E_nu(E=2e5, nu=nu))
    assert effective_modulus(body) == pytest.approx((2e5, nu), rel=1e-12, abs=1e-14)


def test_the_stiffest_material_at_the_faces_counts():
    mesh = wf.mesh.box((1, 1, 1), cells=(2, 1, 1))
    low = np.flatnonzero(mesh.points[mesh.cells].mean(axis=1)[:, 0] < 0.5)
    high = np.setdiff1d(np.arange(len(mesh.cells)), low)
    mesh = replace(mesh, element_sets={"low": low, "high": high})
    soft, hard = wf.SVK(E=1e5, nu=0.4), wf.NeoHookean.from_E_nu(E=1e7, nu=0.2)
    body = wf.ModelBuilder(gravity=(0, 0, 0)).add_solid(mesh, material={"low": soft, "high": hard})
    assert effective_modulus(body) == pytest.approx((1e7, 0.2))
    assert effective_modulus(body, body.surface("x-")) == pytest.approx((1e5, 0.4))
    assert effective_modulus(body, body.surface("y-")) == pytest.approx((1e7, 0.2))


@pytest.mark.parametrize("name", BODIES)
def test_mass(name):
    body = BODIES[name]()
    assert body_mass_total(body) == pytest.approx(7.0 * np.prod(SIZE), rel=1e-12)
    position = body.slot_kind == 0
    assert body_mass_total(body) == pytest.approx((assembly.body_mass(body) @ position)[position].sum(), rel=1e-12)


def test_mass_of_a_density_that_varies_and_of_none():
    mesh = wf.mesh.box((1, 1, 1), cells=(2, 2, 2))
    varying = wf.SVK(E=1e6, nu=0.3, density=lambda X: 1 + X[:, 0] ** 2)
    assert body_mass_total(wf.ModelBuilder().add_solid(mesh, material=varying)) == pytest.approx(4 / 3, rel=1e-12)
    assert body_mass_total(wf.ModelBuilder().add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3))) == 0.0


# shapes

SHAPES = {
    "half-space": (wf.HalfSpace((0, 2, 2), 0.5), shapes.HALF_SPACE, (0, 0, 0), math.inf),
    "sphere": (wf.Sphere((1, 2, 3), 0.5), shapes.SPHERE, (0.5, 0, 0), 0.5),
    "box": (wf.Box((1, 2, 3), (1, 2, 4), axes=TURN), shapes.BOX, (0.5, 1, 2), math.inf),
    "capsule": (wf.Capsule((0, 0, 1), (2, 1, 3), 0.5), shapes.CAPSULE, (0.5, 1.5, 0), 0.5),
    "cylinder": (wf.Cylinder((0, 0, 1), (2, 1, 3), 0.5), shapes.CYLINDER, (0.5, 1.5, 0), 0.5),
}
CLOSED = [name for name in SHAPES if name != "half-space"]


@pytest.mark.parametrize("name", SHAPES)
def test_frames(name):
    shape, kind, sizes, radius = SHAPES[name]
    center, axes = shape.frame()
    assert shape.kind == kind
    assert shape.sizes == pytest.approx(sizes, rel=1e-15)
    assert shape.radius_of_curvature == radius
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1.0, rel=1e-15)
    wanted = {
        "half-space": ((0, 0.5 / 2**0.5, 0.5 / 2**0.5), (0, 0.5**0.5, 0.5**0.5)),
        "box": ((1, 2, 3), TURN[2]),
        "sphere": ((1, 2, 3), (0, 0, 1)),
    }.get(name, ((1, 0.5, 2), (2 / 3, 1 / 3, 2 / 3)))
    np.testing.assert_allclose(center, wanted[0], atol=1e-15)
    np.testing.assert_allclose(axes[:, 2], wanted[1], atol=1e-15)


def test_axes_of_a_box():
    """Rows given, columns returned; the corners of its mesh are the box's."""
    box = wf.Box((1, 2, 3), (1, 2, 4), axes=TURN)
    np.testing.assert_allclose(box.frame()[1], TURN.T, atol=1e-15)
    local = (box.mesh()[0] - (1, 2, 3)) @ TURN.T
    np.testing.assert_allclose(np.abs(local), np.tile((0.5, 1, 2), (8, 1)), atol=1e-14)
    np.testing.assert_array_equal(wf.Box((0, 0, 0), (1, 1, 1)).frame()[1], np.eye(3))


def volume_of(points, triangles):
    p, q, r = (points[triangles[:, k]] for k in range(3))
    return float(np.einsum("tk,tk->t", p, np.cross(q, r)).sum() / 6)


@pytest.mark.parametrize("name", CLOSED)
@pytest.mark.parametrize("resolution", [3, 7, 40])
def test_meshes_are_closed(name, resolution):
    """Each edge is used once in each direction, and no triangle is flat."""
    points, triangles = SHAPES[name][0].mesh(resolution)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    forward, backward = set(map(tuple, edges)), set(map(tuple, edges[:, ::-1]))
    assert len(forward) == len(edges)
    assert forward == backward
    assert len(np.unique(triangles)) == len(points)
    p, q, r = (points[triangles[:, k]] for k in range(3))
    assert np.linalg.norm(np.cross(q - p, r - p), axis=1).min() > 1e-6
    assert len(points) - len(edges) // 2 + len(triangles) == 2


def test_volumes_of_meshes():
    n = 40
    assert volume_of(*SHAPES["box"][0].mesh(n)) == pytest.approx(8.0, rel=1e-14)
    prism = n / 2 * math.sin(2 * math.pi / n) * 0.5**2 * 3
    assert volume_of(*SHAPES["cylinder"][0].mesh(n)) == pytest.approx(prism, rel=1e-13)
    ball = 4 / 3 * math.pi * 0.5**3
    for name, exact in (("sphere", ball), ("capsule", ball + math.pi * 0.5**2 * 3)):
        errors = [exact - volume_of(*SHAPES[name][0].mesh(k)) for k in (n, 2 * n)]
        assert 0 < errors[0] < 0.02 * exact
        assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.02)


@pytest.mark.parametrize("name", ["sphere", "capsule", "cylinder"])
def test_points_of_meshes_lie_on_the_shape(name):
    shape, _, (radius, half, _), _ = SHAPES[name]
    center, axes = shape.frame()
    x = (shape.mesh(20)[0] - center) @ axes
    r = np.hypot(x[:, 0], x[:, 1])
    if name == "cylinder":
        assert np.all(np.isclose(r, radius) & (np.abs(x[:, 2]) <= half + 1e-14) | np.isclose(np.abs(x[:, 2]), half))
    else:
        np.testing.assert_allclose(np.hypot(r, np.maximum(np.abs(x[:, 2]) - half, 0)), radius, rtol=1e-13)


def test_square_of_a_half_space():
    shape = SHAPES["half-space"][0]
    points, triangles = shape.mesh(size=4.0, around=(7, 5, 5))
    assert points @ shape.normal == pytest.approx([0.5] * 4)
    p, q, r = (points[triangles[:, k]] for k in range(3))
    n = np.cross(q - p, r - p)
    assert n @ shape.normal == pytest.approx([16.0, 16.0])
    near = np.array((7, 5, 5)) + (0.5 - np.array((7, 5, 5)) @ shape.normal) * shape.normal
    np.testing.assert_allclose(points.mean(axis=0), near, atol=1e-14)


def test_shapes_do_not_change():
    sphere = wf.Sphere((0, 0, 0), 1.0)
    with pytest.raises(AttributeError):
        sphere.radius = 2.0
    with pytest.raises(ValueError, match="read-only"):
        sphere.center[0] = 1.0
    given = np.zeros(3)
    wf.Sphere(given, 1.0)
    given[0] = 1.0  # a copy was taken


LEFT = TURN * [[1], [1], [-1]]
BAD_SHAPES = {
    "zero normal": (lambda: wf.HalfSpace((0, 0, 0)), r"HalfSpace: normal = \[0.0, 0.0, 0.0\] is zero.*out of"),
    "two numbers": (lambda: wf.HalfSpace((0, 1)), r"HalfSpace: normal = \(0, 1\) must be three finite numbers"),
    "text": (lambda: wf.HalfSpace("z"), r"HalfSpace: normal = 'z' must be three finite numbers"),
    "nan normal": (lambda: wf.HalfSpace((0, 0, np.nan)), r"HalfSpace: normal = .*nan.* must be three finite"),
    "nan offset": (lambda: wf.HalfSpace((0, 0, 1), np.nan), r"HalfSpace: offset = nan must be a finite number, m"),
    "nan center": (lambda: wf.Sphere((0, np.inf, 0), 1), r"Sphere: center = .*inf.* must be three finite numbers, m"),
    "radius 0": (lambda: wf.Sphere((0, 0, 0), 0), r"Sphere: radius = 0 must be a positive finite number, m"),
    "radius nan": (lambda: wf.Sphere((0, 0, 0), np.nan), r"Sphere: radius = nan must be a positive"),
    "radius text": (lambda: wf.Sphere((0, 0, 0), "big"), r"Sphere: radius = 'big' must be a positive"),
    "size 0": (lambda: wf.Box((0, 0, 0), (1, 0, 1)), r"Box: size = \[1.0, 0.0, 1.0\] must be three positive"),
    "one size": (lambda: wf.Box((0, 0, 0), 1.0), r"Box: size = 1.0 must be three finite numbers, m"),
    "skew axes": (lambda: wf.Box((0, 0, 0), (1, 1, 1), np.eye(3) + 1e-3), r"Box: axes = .* orthonormal"),
    "left axes": (lambda: wf.Box((0, 0, 0), (1, 1, 1), LEFT), r"Box: axes = .* right-handed"),
    "two axes": (lambda: wf.Box((0, 0, 0), (1, 1, 1), np.eye(3)[:2]), r"Box: axes = .* \(3, 3\) rows"),
    "capsule radius": (lambda: wf.Capsule((0, 0, 0), (0, 0, 1), -1), r"Capsule: radius = -1 must be a positive"),
    "capsule point": (lambda: wf.Capsule((0, 0, 1), (0, 0, 1), 1), r"Capsule: end = \[0.0, 0.0, 1.0\] .*apart"),
    "cylinder point": (lambda: wf.Cylinder((0, 0, 1), (0, 0, 1), 1), r"Cylinder: end = .*apart"),
    "cylinder end": (lambda: wf.Cylinder((0, 0, 1), (0, 1), 1), r"Cylinder: end = \(0, 1\) must be three"),
    "resolution": (lambda: wf.Sphere((0, 0, 0), 1).mesh(2), r"Sphere: resolution = 2 must be .* at least 3"),
    "resolution 3.5": (lambda: wf.Cylinder((0, 0, 0), (0, 0, 1), 1).mesh(3.5), r"Cylinder: resolution = 3.5 must be"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_SHAPES)
def test_bad_shapes(case):
    action, text = BAD_SHAPES[case]
    with pytest.raises(wf.ModelError, match=text):
        action()


# colliders and contacts


@pytest.fixture
def scene():
    """A builder, a block and a floor."""
    return start()


def start():
    b = wf.ModelBuilder()
    block = b.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), material=LAW, name="block")
    floor = b.add_collider(wf.HalfSpace((0, 0, 1), -1.0), name="floor")
    return b, block, floor


def test_colliders(scene):
    b, _, floor = scene
    jaw = b.add_collider(wf.Box((0, 0, 3), (1, 1, 1)), path=([0, 1], [(0, 0, 0), (0, 0, -0.1)]), name="jaw")
    wheel = b.add_collider(wf.Cylinder((0, 0, 3), (0, 1, 3), 0.2),
                           wf.Rotation(anchor=(0, 0, 3), axis=(0, 2, 0), angle=([0, 1], [0.0, 2.0])))  # fmt: skip
    other = b.add_collider(wf.Cylinder((0, 0, 3), (0, 1, 3), 0.2), path=(0, 0, 1))
    assert b.description.colliders == [floor, jaw, wheel, other]
    assert [c.index for c in b.description.colliders] == [0, 1, 2, 3]
    assert [c.name for c in b.description.colliders] == ["floor", "jaw", "cylinder", "cylinder_2"]
    assert [c.moves for c in b.description.colliders] == [False, True, True, True]
    assert b.add_collider(wf.HalfSpace((0, 0, 1))).name == "half_space"
    np.testing.assert_array_equal(jaw.law.values, [(0, 0, 0), (0, 0, -0.1)])
    assert not jaw.law.scalar
    assert jaw.rotation is None
    assert wheel.law is None
    np.testing.assert_array_equal(wheel.rotation.axis, (0, 1, 0))
    np.testing.assert_array_equal(wheel.rotation.anchor, (0, 0, 3))
    assert wheel.rotation.angle.scalar
    assert repr(jaw) == "Collider('jaw', Box, moves)"


def test_a_path_may_be_a_function(scene):
    @wp.func
    def path(t: wp.float64) -> wp.vec3d:
        return wp.vec3d(t, wp.float64(0.0), wp.float64(0.0))

    assert scene[0].add_collider(wf.Sphere((0, 0, 5), 1), path=path).law.function is path


def test_contact_with_its_defaults(scene):
    b, block, floor = scene
    c = b.add_contact(block, floor)
    assert (c.name, c.index, c.body, c.collider) == ("block on floor", 0, block, floor)
    np.testing.assert_array_equal(c.surface.faces, block.boundary)
    assert (c.mu, c.mu_static, c.restitution, c.stiffness) == (0.0, 0.0, 1.0, 1.0)
    assert (c.law, c.treatment, c.model, c.overlap) == ("default", "implicit", "patch", "refuse")
    assert (c.radius, c.points, c.smoothing, c.offset, c.overlap_time) == (None, None, None, 0.0, 0.1)
    assert b.description.contacts == [c]
    assert b.add_contact(block, floor).name == "block on floor_2"
    assert repr(c) == "Contact('block on floor', body 'block' with collider 'floor')"
    assert repr(b) == "ModelBuilder(Body('block', T10, 6 elements), 1 collider, 2 contacts)"


def test_contact_with_options(scene):
    b, block, floor = scene
    c = b.add_contact(
        block.surface("z-"), floor, mu=0.3, restitution=0.5, law="paper", treatment="explicit", stiffness=10,
        model="sphere", radius=0.2, offset=-1e-3, points=7, smoothing=1e-5, overlap="offset", overlap_time=0.2,
        name="pad",
    )  # fmt: skip
    assert (c.mu, c.mu_static, c.restitution, c.stiffness) == (0.3, 0.3, 0.5, 10.0)
    assert (c.law, c.treatment, c.model, c.overlap) == ("paper", "explicit", "sphere", "offset")
    assert (c.radius, c.points, c.smoothing, c.offset, c.overlap_time) == (0.2, 7, 1e-5, -1e-3, 0.2)
    assert c.surface.name == "z-"
    assert b.add_contact(block, floor, mu=0.2, mu_static=0.25).mu_static == 0.25
    assert b.add_contact(block, floor, law="smooth", smoothing=[1.0, 1e-3]).smoothing == (1.0, 1e-3)


def test_a_builder_with_contacts_finalizes(scene):
    b, block, floor = scene
    b.add_contact(block, floor, mu=0.5)
    assert b.finalize(device="cpu").description.contacts[0].collider is floor


def contact(**options):
    def act():
        b, block, floor = start()
        b.add_contact(block.surface("z-"), floor, name="pad", **options)

    return act


def collider(*args, **options):
    return lambda: start()[0].add_collider(*args, **options)


def on(make):
    """add_contact of what `make` returns of a builder, its block and its floor."""

    def act():
        b, block, floor = start()
        b.add_contact(*make(b, block, floor))

    return act


def twice():
    b, block, floor = start()
    b.add_contact(block, floor, name="pad")
    b.add_contact(block, floor, name="pad")


def inner_face(b, block, floor):
    """A face between two elements."""
    outer = set(map(tuple, block.boundary))
    row = next(r for r in itertools.product(range(len(block.mesh.cells)), range(4)) if r not in outer)
    return block.surface(np.array([row])), floor


BALL = wf.Sphere((0, 0, 5), 1.0)
BAD = {
    "mu": (contact(mu=-0.1), r"contact 'pad': mu = -0.1 must be a friction coefficient, 0 or above"),
    "mu nan": (contact(mu=np.nan), r"'pad': mu = nan must be"),
    "mu text": (contact(mu="rough"), r"'pad': mu = 'rough' must be"),
    "mu_static": (contact(mu=0.3, mu_static=0.2), r"'pad': mu_static = 0.2 must be None, or at least mu = 0.3"),
    "restitution 0": (contact(restitution=0.0), r"'pad': restitution = 0.0 must be above 0 and at most 1"),
    "restitution 1.1": (contact(restitution=1.1), r"'pad': restitution = 1.1 must be above 0 and at most 1"),
    "radius": (contact(radius=0.0), r"'pad': radius = 0.0 must be positive, m"),
    "radius < 0": (contact(model="sphere", radius=-1.0), r"'pad': radius = -1.0 must be positive, m"),
    "sphere": (contact(model="sphere"), r"'pad': model = 'sphere' needs radius=.*depends on it.*mesh does not tell"),
    "stiffness": (contact(stiffness=0.0), r"'pad': stiffness = 0.0 must be a positive factor, or None"),
    "offset": (contact(offset=np.inf), r"'pad': offset = inf must be a finite number, m"),
    "overlap_time": (contact(overlap_time=0.0), r"'pad': overlap_time = 0.0 must be positive, s"),
    "law": (contact(law="papper"), r"law = 'papper' is none of 'default', 'paper', 'smooth'; did you mean 'paper'"),
    "model": (contact(model="points"), r"'pad': model = 'points' is none of 'patch', 'sphere'"),
    "treatment": (contact(treatment="semi"), r"'pad': treatment = 'semi' is none of 'implicit', 'explicit'"),
    "overlap": (contact(overlap="push"), r"'pad': overlap = 'push' is none of 'refuse', 'offset'"),
    "explicit": (contact(treatment="explicit"), r"treatment = 'explicit' is for law = 'paper' only, not 'default'"),
    "points": (contact(points=6), r"'pad': points = 6: the faces of body 'block' \(T10\) are triangles.* 3, 7 points"),
    "points text": (contact(points="many"), r"'pad': points = 'many': the faces"),
    "smoothing": (contact(smoothing=1e-3), r"'pad': smoothing = 0.001: law = 'default' is smooth as it is"),
    "depth": (contact(law="paper", smoothing=0.0), r"'pad': smoothing = 0.0 must be a positive depth, m"),
    "pair": (contact(law="smooth", smoothing=1e-3), r"smoothing = 0.001 must be two positive numbers \(eps in N"),
    "pair of 0": (contact(law="smooth", smoothing=(0, 1)), r"smoothing = \(0, 1\) must be two positive numbers"),
    "no shape": (collider(1.0), r"add_collider: expected a shape \(HalfSpace, Sphere, .*got 1.0"),
    "class": (collider(wf.Sphere), r"add_collider: expected a shape"),
    "nan path": (collider(BALL, path=(0, 0, np.nan)), r"collider 'sphere': path.* not finite"),
    "nan sample": (collider(BALL, path=([0, 1], [(0, 0, 0), (0, np.nan, 0)]), name="jaw"), r"'jaw': path.*not finite"),
    "scalar path": (collider(BALL, path=1.0), r"collider 'sphere': path has shape \(\), expected \(3,\)"),
    "zero axis": (collider(BALL, path=wf.Rotation((0, 0, 0), (0, 0, 0), 1.0)), r"'sphere': path: axis is zero"),
    "nan angle": (collider(BALL, path=wf.Rotation((0, 0, 0), (0, 0, 1), np.nan)), r"path: angle.*not finite"),
    "nan anchor": (collider(BALL, path=wf.Rotation((0, np.nan, 0), (0, 0, 1), 1.0)), r"path: anchor.*three finite"),
    "collider twice": (collider(BALL, name="floor"), r"collider name 'floor' is used twice"),
    "collider name": (collider(BALL, name=3), r"collider name 3 is no text"),
    "contact twice": (twice, r"contact name 'pad' is used twice"),
    "a shape": (on(lambda b, s, f: (s, BALL)), r"add_contact: Sphere is a shape; give the collider that add_collider"),
    "no collider": (on(lambda b, s, f: (s, "floor")), r"add_contact: expected a collider.*got 'floor'"),
    "other builder's": (on(lambda b, s, f: (s, start()[2])), r"collider 'floor' belongs to another builder"),
    "other body": (on(lambda b, s, f: (start()[1], f)), r"body 'block' belongs to another builder"),
    "no body": (on(lambda b, s, f: (f, s)), r"add_contact: expected a handle of a body"),
    "nodes": (on(lambda b, s, f: (s.nodes("z-"), f)), r"add_contact: expected the body or a surface.*got nodes"),
    "empty": (on(lambda b, s, f: (s.surface(lambda X: X[:, 0] > 9), f)), r"selection .* on body 'block' is empty"),
    "inner face": (on(inner_face), r"add_contact: the surface of body 'block': face .* is no outer face"),
    "face twice": (on(lambda b, s, f: (s.surface(s.boundary[[0, 0]]), f)), r"body 'block' has a face twice"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_colliders_and_contacts(case):
    action, text = BAD[case]
    with pytest.raises(wf.ModelError, match=text):
        action()


def test_a_refused_contact_leaves_nothing(scene):
    b, block, floor = scene
    with pytest.raises(wf.ModelError):
        b.add_contact(block, floor, mu=-1.0)
    with pytest.raises(wf.ModelError):
        b.add_collider(BALL, path=(0, 0, np.nan))
    assert b.description.contacts == []
    assert b.description.colliders == [floor]


def test_contact_of_a_body_with_itself_is_a_later_part(scene):
    b, block, _ = scene
    for others in ((), (block,), (block.surface("x-"),)):
        with pytest.raises(NotImplementedError, match="with itself is not part of this version"):
            b.add_contact(block, *others)
