"""Points of contact on faces, and what the law needs of a body."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import warpfea as wf
from warpfea import elements as families
from warpfea.elements.quadrature import conical_triangle, lobatto_square, triangle_3, triangle_7
from warpfea.model import assembly
from warpfea.model.contact_points import body_mass_total, contact_points, effective_modulus
from warpfea.model.discretisation import Discretisation
from warpfea.model.handles import SurfaceSet
from warpfea.model.masses import body_mass

SIZE = np.array([1.0, 0.8, 0.6])
LAW = wf.SVK(E=1e6, nu=0.3, density=7.0)


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


def test_areas_of_many_faces_are_those_of_each(monkeypatch):
    """Faces are evaluated in chunks: all in one, and in several of up to seven."""
    surface = whole(solid("T4"))
    whole_areas = contact_points(surface).area
    monkeypatch.setattr(assembly, "MAX_CHUNK_FACETS", 7)
    assert len(whole_areas) > 7
    np.testing.assert_array_equal(contact_points(surface).area, whole_areas)


@pytest.mark.parametrize("element", ["T10", "ENMC"])
def test_curved_faces_of_a_ball(element):
    """The faces of a ball: normals sum to nothing exactly, area and volume as a rule of high degree gives."""
    mesh = wf.mesh.sphere(0.7, cells=4, center=(3, -2, 1), element="T10")
    body = wf.ModelBuilder().add_solid(mesh, material=LAW, element=element)
    p = contact_points(whole(body))
    fine = assembly.facet_tables(whole(body), rules={face: conical_triangle(7) for face in range(4)})
    X, area = assembly.facet_positions(body, fine), assembly.facet_areas(body, fine)
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
        families.get_family("T4"),
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


def test_the_moduli_of_worlds_are_those_of_each():
    """Bit for bit, of the stiffer of two materials in each world."""
    mesh = wf.mesh.box((1, 1, 1), cells=(2, 1, 1))
    mesh = replace(mesh, element_sets={"low": np.arange(6), "high": np.arange(6, len(mesh.cells))})
    b = wf.ModelBuilder()
    laws = {"low": wf.SVK(E=1e5, nu=0.4, density=1.0), "high": wf.MooneyRivlin.from_E_nu(E=1e7, nu=0.2, density=1.0)}
    body = b.add_solid(mesh, material=laws, name="block")
    model = b.finalize(device="cpu", worlds=3)
    assert model.parameters.youngs_modulus(body) == effective_modulus(body)[0]
    model.set_parameter("block.low.E", [1e5, 1e8, 3e6])
    model.set_parameter("block.high.nu", [0.1, 0.2, 0.3])
    each = [model.parameters.modulus(world)(body, None)[0] for world in range(3)]
    assert model.parameters.youngs_modulus(body).tolist() == each
    assert each == pytest.approx([1e7, 1e8, 1e7])


@pytest.mark.parametrize("name", BODIES)
def test_mass(name):
    body = BODIES[name]()
    assert body_mass_total(body) == pytest.approx(7.0 * np.prod(SIZE), rel=1e-12)
    position = body.slot_kind == 0
    assert body_mass_total(body) == pytest.approx((body_mass(body) @ position)[position].sum(), rel=1e-12)


def test_mass_of_a_density_that_varies_and_of_none():
    mesh = wf.mesh.box((1, 1, 1), cells=(2, 2, 2))
    varying = wf.SVK(E=1e6, nu=0.3, density=lambda X: 1 + X[:, 0] ** 2)
    assert body_mass_total(wf.ModelBuilder().add_solid(mesh, material=varying)) == pytest.approx(4 / 3, rel=1e-12)
    assert body_mass_total(wf.ModelBuilder().add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3))) == 0.0
