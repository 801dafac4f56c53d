"""ANCF bodies in a scene: geometry, points, surfaces, supports, moments, initial values, drawing, fields."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.model import assembly
from warpfea.model.discretisation import element_functions
from warpfea.model.surfaces import reference_points
from warpfea.terms.followers import Followers

E_MODULUS, NU, RHO = 1e6, 0.3, 7.0
SVK = wf.SVK(E=E_MODULUS, nu=NU, density=RHO)
RUBBER = wf.NeoHookean(mu=4e5, k=1e7, density=RHO)
SECTION = wf.Rectangle(0.15, 0.1)
A = np.array([[1.1, 0.3, -0.1], [0.05, 0.9, 0.1], [-0.1, 0.2, 1.2]])


def rotation(angle, axis=(1.0, -2.0, 0.5)):
    """Rotation matrix (Rodrigues), angle in degrees."""
    a, (x, y, z) = math.radians(angle), np.array(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(a) * K + (1 - math.cos(a)) * K @ K


TURN = rotation(50.0, (1.0, 2.0, -0.7))
SHIFT = np.array([2.0, -1.0, 0.5])


def placed(X):
    return X @ TURN.T + SHIFT


def radial(s):
    return np.array([math.cos(1.5 * s), math.sin(1.5 * s), 0.0])


def arc(s):
    """1.5 rad of a circle of radius 1."""
    return placed(radial(s))


def rolled(X):
    """The unit square onto a cylinder of radius 1 about y."""
    return np.column_stack([np.sin(X[:, 0]), X[:, 1], np.cos(X[:, 0])])


def hexes(cells=(3, 2, 2)):
    mesh = wf.mesh.box((1, 0.8, 0.6), cells=cells, element="H3843")
    return replace(mesh, points=placed(mesh.points * (1 + 0.1 * np.prod(mesh.points, axis=1, keepdims=True))))


def tets(element):
    mesh = wf.mesh.box((1, 0.8, 0.6), cells=(2, 1, 1), element=element)
    return replace(mesh, points=placed(mesh.points))


BODIES = {
    "beam": lambda b, **o: b.add_beam(
        [SHIFT, SHIFT + TURN[:, 0]], elements=3, section=SECTION, normal=TURN[:, 2], material=SVK, **o
    ),
    "beam split": lambda b, **o: BODIES["beam"](b, integration="split", **o),
    "beam full": lambda b, **o: BODIES["beam"](b, integration="full", **o),
    "arc": lambda b, **o: b.add_beam(
        arc, elements=6, section=SECTION, normal=lambda s: TURN @ radial(s), material=SVK, **o
    ),
    "plate": lambda b, **o: b.add_shell(
        wf.mesh.grid((1, 0.8), cells=(2, 2), map=placed), thickness=0.1, material=SVK, **o
    ),
    "plate full": lambda b, **o: BODIES["plate"](b, integration="full", **o),
    "roof": lambda b, **o: b.add_shell(
        wf.mesh.grid((1, 1), cells=(4, 2), map=rolled),
        thickness=0.1,
        material=SVK,
        normals=lambda X: X * [1, 0, 1],
        **o,
    ),
    "ENMC": lambda b, **o: b.add_solid(tets("ENMC"), material=SVK, element="ENMC", **o),
    "FN": lambda b, **o: b.add_solid(tets("FN"), material=SVK, element="FN", **o),
    "FN18": lambda b, **o: b.add_solid(tets("FN18"), material=SVK, element="FN18", **o),
    "ball": lambda b, **o: b.add_solid(ball(), material=SVK, element="ENMC", **o),
    "H3843": lambda b, **o: b.add_solid(hexes(), material=SVK, element="H3843", **o),
}
FLAT = [name for name in BODIES if name not in ("arc", "roof", "ball")]
SIDES = ("beam", "arc", "plate", "roof", "ENMC", "ball", "H3843")


def ball():
    return wf.mesh.sphere(0.7, cells=2, center=(3, -2, 1))


def scene(name, gravity=(0, 0, 0), **options):
    b = wf.ModelBuilder(gravity=gravity)
    return b, BODIES[name](b, **options)


def finalize(b):
    return b.finalize(device="cpu")


@functools.cache
def plain(name):
    b, body = scene(name)
    return body, finalize(b)


def affine(body, F, shift=(0, 0, 0)):
    """Slot displacements of x = F X + shift, X from the body's origin."""
    return body.reference @ (F - np.eye(3)).T + (body.slot_kind == 0)[:, None] * shift


def state_of(model, u):
    state = model.state()
    state.displacement.assign(np.asarray(u)[None])
    return state


def reference_at(body, elements, xi):
    s, _ = element_functions(body, elements, xi)
    return np.einsum("eqs,esk->eqk", s, body.reference[body.connectivity[elements]]) + body.origin


def parent_points(family, count=4, seed=0):
    rng = np.random.default_rng(seed)
    if family.parent.low is None:
        return rng.dirichlet(np.ones(4), count)[:, 1:]
    return rng.uniform(family.parent.low, family.parent.high, (count, 3))


# geometry of beams


def add_beam(curve, normal=(0, 0, 1), elements=4, b=None, **options):
    b = b or wf.ModelBuilder()
    options = {"section": SECTION, "material": SVK} | options
    return b.add_beam(curve, elements=elements, normal=normal, **options)


CURVES = {
    "inclined": ([(0, 0, 0), (1, 2, -1)], (0, 0, 1)),
    "points on a line": ([(0, 0, 0), (0.3, 0.6, -0.3), (1, 2, -1)], (0, 3, 1)),
    "function": (lambda s: np.array([s, s**2, math.sin(s)]), (0.1, 0.2, 1)),
    "turning normal": (lambda s: np.array([0, 2 * s, 0]), lambda s: (math.cos(3 * s), 0, math.sin(3 * s))),
    "spline": (wf.spline([(0, 0, 0), (1, 0.5, 0), (2, 0, 1), (3, 0, 1)]), (0, 0, 1)),
}


@pytest.mark.parametrize("name", CURVES)
def test_axes_of_beams(name):
    """Nodes on the curve at equal parameters; axes along it, across, and the normal's part across it."""
    curve, normal = CURVES[name]
    body = add_beam(curve, normal)
    at = curve if callable(curve) else lambda s: (1 - s) * np.array(curve[0]) + s * np.array(curve[-1])
    s = np.linspace(0, 1, 5)
    np.testing.assert_allclose(body.mesh.points, [at(k) for k in s], atol=1e-14)
    axes = body.node_axes
    np.testing.assert_allclose(np.swapaxes(axes, 1, 2) @ axes, np.tile(np.eye(3), (5, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, rtol=1e-14)
    for k, frame in zip(s, axes):
        h = 1e-5
        tangent = (at(min(k + h, 1)) - at(max(k - h, 0))) / (min(k + h, 1) - max(k - h, 0))
        assert np.abs(frame[:, 0] - tangent / np.linalg.norm(tangent)).max() < 1e-4
        up = np.array(normal(k) if callable(normal) else normal, dtype=float)
        across = up - (up @ frame[:, 0]) * frame[:, 0]
        assert frame[:, 2] @ across == pytest.approx(np.linalg.norm(across), rel=1e-12)
    corner = reference_at(body, np.array([0]), np.array([[0, 0.5, 0.5]]))[0, 0] - body.mesh.points[0]
    np.testing.assert_allclose(axes[0].T @ corner, [0, 0.075, 0.05], atol=1e-14)
    np.testing.assert_array_equal([body.start.indices, body.end.indices], [[0], [4]])


def test_spline():
    points = np.array([(0, 0, 0), (1, 0.5, 0), (2, 0, 1), (1, -1, 1)], dtype=float)
    chord = np.cumsum([0, *np.linalg.norm(np.diff(points, axis=0), axis=1)])
    np.testing.assert_allclose([wf.spline(points)(s) for s in chord / chord[-1]], points, atol=1e-13)
    loop = wf.spline(points, closed=True)
    h = 1e-5
    np.testing.assert_allclose(loop(0.0), loop(1.0), atol=1e-13)
    np.testing.assert_allclose((loop(h) - loop(0)) / h, (loop(1) - loop(1 - h)) / h, atol=2e-3)
    with pytest.raises(wf.ModelError, match="n >= 3"):
        wf.spline(points[:2])
    with pytest.raises(wf.ModelError, match="point 1 repeats"):
        wf.spline(points[[0, 0, 1]])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"normal": (2, 0, 0)}, r"normal .* lies along the beam's axis at s = 0"),
        ({"normal": (0, 0)}, "normal must be three finite numbers"),
        ({"curve": [(0, 0, 0), (1, 0, 0), (1, 1, 0)]}, "corner of 90 degrees at point 1.*corners='weld'"),
        ({"curve": [(0, 0, 0), (1, 0, 0), (0, 0.1, 0)], "corners": "weld"}, "folds back on itself at point 1"),
        ({"curve": [(0, 0, 0), (0, 0, 0)]}, "point 1 of the curve repeats"),
        ({"curve": [(0, 0), (1, 0)]}, r"finite points \(n, 3\)"),
        ({"curve": lambda s: (s, 0)}, "must return three numbers"),
        ({"curve": lambda s: (0.0, 0.0, 0.0)}, "stands still"),
        ({"corners": "round"}, "neither 'error' nor 'weld'"),
        ({"elements": 0}, "positive whole number"),
        ({"section": (0.1, 0.1)}, "must be a Rectangle"),
        ({"integration": "reduced"}, "integration = 'reduced' is none of 'tied', 'split', 'full', '3x2x2'"),
        (
            {"integration": "split", "material": RUBBER},
            "splits the St. Venant-Kirchhoff law; use 'full' with NeoHookean",
        ),
    ],
)
def test_beam_input(options, message):
    options = {"curve": [(0, 0, 0), (1, 0, 0)]} | options
    with pytest.raises(wf.ModelError, match=f"body 'beam': .*{message}|{message}"):
        add_beam(**options)


def test_sections_and_default_integration():
    assert SECTION.area == pytest.approx(0.015)
    for bad in (0.0, -1.0, math.nan, "1"):
        with pytest.raises(wf.ModelError, match=r"height = .* must be a positive"):
            wf.Rectangle(0.1, bad)
    b = wf.ModelBuilder()
    line = [(0, 0, 0), (1, 0, 0)]
    bodies = [add_beam(line, b=b, material=m, name=n) for n, m in (("svk", SVK), ("rubber", RUBBER))]
    bodies += [add_beam(line, b=b, integration=i, name=i) for i in ("full", "3x2x2")]
    mesh = wf.mesh.grid((1, 1), cells=(1, 1))
    bodies += [b.add_shell(mesh, thickness=0.1, material=m, name=f"s{k}") for k, m in enumerate((SVK, RUBBER))]
    assert [body.rule for body in bodies] == ["tied", "full", "full", "3x2x2", "tied", "full"]


def test_welded_corner_of_a_frame():
    """A clamped L under a force at its tip, F (a^3/3 + a^2 b) / EI by beam theory: the corner is stiff and turns."""
    a, c, F, EI = 1.0, 0.8, 1e-3, 1e6 * 0.05**4 / 12
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    stiff = wf.SVK(E=1e6, nu=0.0, density=1.0)
    body = add_beam(
        [(0, 0, 0), (c, 0, 0), (c, a, 0)], elements=16, corners="weld", b=b,
        material=stiff, section=wf.Rectangle(0.05, 0.05),
    )  # fmt: skip
    corner = np.flatnonzero(np.linalg.norm(body.mesh.points - [c, 0, 0], axis=1) < 1e-12)
    assert len(corner) == 1
    b.clamp(body.start, slots="position+section")
    b.add_point_load(body.end, (F, 0, 0))
    static = wf.solve_static(finalize(b), load_steps=1)
    tip = static.displacements(body)[0, -1, 0]
    assert tip == pytest.approx(F * (a**3 / 3 + a**2 * c) / EI, rel=0.03)
    turned = static.simulation.node_gradients(body)[0, corner[0]]
    angle = -F * a * c / EI  # of the corner, about z
    assert turned[1, 0] == pytest.approx(angle, rel=0.03)
    assert turned[0, 1] == pytest.approx(-angle, rel=0.03)


@pytest.mark.parametrize("section", [SECTION, wf.Rectangle(0.1, 0.2, shear=0.5, torsion=1e-5)])
def test_section_constants(section):
    """Torsion T L/(G J) and bending F L^3/(3 E I) + F L/(k G A) of a short cantilever, its section free to warp."""
    w, h = section.width, section.height
    if section is SECTION:  # Saint-Venant's of 0.15 x 0.1
        n = np.arange(1, 40, 2)
        J = w * h**3 / 3 * (1 - 192 * h / (np.pi**5 * w) * np.sum(np.tanh(n * np.pi * w / 2 / h) / n**5))
        k = 5 / 6
    else:
        J, k = 1e-5, 0.5
    assert section.torsion_ratio == pytest.approx(J / (w * h * (w**2 + h**2) / 12), rel=1e-6)
    L, G, T, F = 0.5, E_MODULUS / (2 * (1 + NU)), 1e-4, 1e-3
    turn, bend = [], []
    for load in ("moment", "force"):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        body = add_beam([(0, 0, 0), (L, 0, 0)], elements=3, b=b, section=section)
        b.clamp(body.start, slots="position+section")
        if load == "moment":
            b.add_moment(body.end, (T, 0, 0))
        else:
            b.add_point_load(body.end, (0, 0, F))
        static = wf.solve_static(finalize(b), load_steps=1)
        spin = static.simulation.node_gradients(body)[0, -1]
        turn.append(0.5 * (spin[2, 1] - spin[1, 2]))
        bend.append(static.displacements(body)[0, -1, 2])
    assert turn[0] == pytest.approx(T * L / (G * J), rel=2e-3)
    deflection = F * L**3 / (3 * E_MODULUS * w * h**3 / 12) + F * L / (k * G * w * h)
    assert bend[1] == pytest.approx(deflection, rel=2e-3)


# geometry of shells


def test_axes_of_shells():
    for name in ("plate", "roof"):
        body, _ = plain(name)
        axes = body.node_axes
        np.testing.assert_allclose(np.swapaxes(axes, 1, 2) @ axes, np.tile(np.eye(3), (len(axes), 1, 1)), atol=1e-14)
        np.testing.assert_allclose(np.linalg.det(axes), 1.0, rtol=1e-14)
        X = body.mesh.points
        director = np.broadcast_to(TURN[:, 2], X.shape) if name == "plate" else X * [1, 0, 1]
        np.testing.assert_allclose(axes[:, :, 2], director, atol=1e-14)


def test_rolled_shell_is_curved():
    """Radius 1 everywhere, better than fourth order; the default normals are exact inside and lean at the ends."""
    errors = []
    for n in (2, 4):
        b = wf.ModelBuilder()
        mesh = wf.mesh.grid((1, 1), cells=(n, 1), map=rolled)
        body = b.add_shell(mesh, thickness=0.1, material=SVK, normals=lambda X: X * [1, 0, 1])
        X = reference_at(body, np.arange(n), np.column_stack([np.linspace(0, 1, 9), np.full(9, 0.3), np.zeros(9)]))
        errors.append(np.abs(np.hypot(X[..., 0], X[..., 2]) - 1).max())
        bare = b.add_shell(mesh, thickness=0.1, material=SVK)
        inner = np.flatnonzero((mesh.points[:, 0] > 1e-9) & (mesh.points[:, 0] < math.sin(1) - 1e-9))
        np.testing.assert_allclose(bare.node_axes[inner, :, 2], mesh.points[inner] * [1, 0, 1], atol=1e-12)
        lean = np.sum(bare.node_axes[0, :, 2] * mesh.points[0] * [1, 0, 1])
        assert lean == pytest.approx(math.cos(0.5 / n), rel=1e-12)
    assert errors[1] < 2e-5
    assert errors[0] / errors[1] > 12


def test_closed_tube():
    """A sheet rolled up shares the nodes of its seam, and its mass is that of the tube."""
    tube = lambda X: np.column_stack([np.cos(2 * np.pi * X[:, 0]), np.sin(2 * np.pi * X[:, 0]), X[:, 1]])  # noqa: E731
    b = wf.ModelBuilder()
    mesh = wf.mesh.grid((1, 2), cells=(32, 2), map=tube)
    assert len(mesh.points) == 3 * 32
    body = b.add_shell(mesh, thickness=0.1, material=SVK)
    np.testing.assert_allclose(body.node_axes[:, :, 2], mesh.points * [1, 1, 0], atol=1e-12)
    assert finalize(b).info()["mass"] == pytest.approx(RHO * 2 * math.pi * 2 * 0.1, rel=4e-3)
    assert len(body.surface("y-")) == 32


def folded(X):
    return np.where(X[:, :1] > 1, np.column_stack([np.ones(len(X)), X[:, 1], X[:, 0] - 1]), X)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, r"has a corner at node \d+: the normal of quad \d+ lies 45 degrees off"),
        ({"corners": "sharp"}, "neither 'error' nor 'weld'"),
        ({"thickness": 0}, "thickness = 0 must be a positive length"),
        ({"normals": np.ones((2, 3))}, r"normals must be finite and of shape \(10, 3\)"),
        ({"normals": lambda X: 0 * X}, "node 0 of plate has no normal"),
        ({"integration": "reduced"}, "integration = 'reduced' is none of 'tied', 'full'"),
        ({"integration": "tied", "material": RUBBER}, "use 'full' with NeoHookean"),
        ({"mesh": wf.mesh.box((1, 1, 1), cells=(1, 1, 1))}, "needs quad cells, .* has tetra10"),
    ],
)
def test_shell_input(options, message):
    mesh = wf.mesh.grid((2, 1), cells=(4, 1), map=folded)
    defaults = {"mesh": mesh, "thickness": 0.1, "material": SVK}
    if "integration" in options:
        defaults["corners"] = "weld"
    with pytest.raises(wf.ModelError, match=message):
        wf.ModelBuilder().add_shell(**(defaults | options))


def test_welded_corner_of_a_shell():
    """A folded strip clamped at one edge and pulled at the other, as the L of the frame."""
    F, width, EI = 1e-3, 1.0, 1e6 * 0.05**3 / 12
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    stiff = wf.SVK(E=1e6, nu=0.0, density=1.0)
    mesh = wf.mesh.grid((2, width), cells=(8, 1), map=folded)
    body = b.add_shell(mesh, thickness=0.05, material=stiff, corners="weld")
    b.clamp(body.edge("x-"), slots="position+director")
    b.add_point_load(body.edge("x+"), (F, 0, 0))
    static = wf.solve_static(finalize(b), load_steps=1)
    tip = static.displacements(body)[0, body.edge("x+").indices, 0]
    np.testing.assert_allclose(tip, F * (1 / 3 + 1) / EI, rtol=0.04)


# solids


def test_solids_from_meshes():
    t10, t4 = ball(), wf.mesh.sphere(0.7, cells=2, center=(3, -2, 1), element="T4")
    faces = 4 * len(t4.cells) - (4 * len(t4.cells) - len(t4.boundary())) // 2
    for mesh, volume in ((t10, t10.volume()), (t4, t4.volume())):
        for element in ("ENMC", "FN", "FN18"):
            b = wf.ModelBuilder()
            body = b.add_solid(mesh, material=SVK, element=element)
            assert len(body.mesh.points) == len(t4.points) + (faces if element == "ENMC" else 0)
            mass = finalize(b).info()["mass"]
            if element != "FN" or mesh is t4:  # FN holds linear fields only
                assert mass == pytest.approx(RHO * volume, rel=1e-12)
            else:
                assert mass != pytest.approx(RHO * volume, rel=0.01)
    box = wf.mesh.box((1, 1, 1), cells=(2, 1, 1), element="H3843")
    b = wf.ModelBuilder()
    assert b.add_solid(box, material=SVK).family.name == "H3843"
    assert b.add_solid(t10, material=SVK).family.name == "T10"
    for mesh, element, message in (
        (box, "ENMC", "needs tetrahedra, box has hexahedron"),
        (t4, "H3843", "needs hexahedra, sphere has tetra"),
        (t4, "3243", "is not a solid; use add_beam or add_shell"),
        (t4, "FN17", "unknown; there are .*ENMC, FN, FN18, H3843"),
    ):
        with pytest.raises(wf.ModelError, match=message):
            b.add_solid(mesh, material=SVK, element=element)
    with pytest.raises(wf.ModelError, match="not a rule of element ENMC; there are tet14, conical4"):
        b.add_solid(t4, material=SVK, element="ENMC", quadrature="tet4")


# material points


@pytest.mark.parametrize("name", BODIES)
def test_material_points(name):
    """Points inside are found, with their functions and gradients; points outside are refused."""
    body, _ = plain(name)
    chosen = np.random.default_rng(1).choice(len(body.mesh.cells), 3, replace=False)
    for X in reference_at(body, chosen, parent_points(body.family)).reshape(-1, 3):
        point = body.at(X)
        e = body.reference[point.slots]
        position = body.slot_kind[point.slots] == 0
        assert np.abs(point.weights @ e + body.origin - X).max() < 1e-9
        assert point.weights[position].sum() == pytest.approx(1.0, rel=1e-12)
        np.testing.assert_allclose(e.T @ point.gradients, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(point.axes.T @ point.axes, np.eye(3), atol=1e-12)
    for X in (np.array(body.mesh.bounding_box()[1]) + 0.3, np.array([1e3, 0, 0])):
        with pytest.raises(wf.ModelError, match=r"lies outside of it"):
            body.at(X)
    skin = reference_points(body, body.skin.slot_weights)
    T = body.skin.triangles
    normal = np.cross(skin[T[:, 1]] - skin[T[:, 0]], skin[T[:, 2]] - skin[T[:, 0]])
    k = int(np.linalg.norm(normal, axis=1).argmax())
    middle, outward = skin[T[k]].mean(axis=0), normal[k] / np.linalg.norm(normal[k])
    with pytest.raises(wf.ModelError, match="lies outside"):
        body.at(middle + 0.03 * outward)
    body.at(middle - 0.02 * outward)


# surfaces

NAMED = {
    "beam": {"start": 0.015, "end": 0.015, "side-": 0.1, "side+": 0.1, "normal-": 0.15, "normal+": 0.15},
    "arc": {"start": 0.015, "end": 0.015, "normal-": 1.5 * 0.95 * 0.15, "normal+": 1.5 * 1.05 * 0.15, "side+": 0.15},
    "plate": {"top": 0.8, "bottom": 0.8, "x-": 0.08, "x+": 0.08, "y-": 0.1, "y+": 0.1},
    "roof": {"top": 1.05, "bottom": 0.95, "x-": 0.1, "x+": 0.1, "y-": 0.1, "y+": 0.1},
    "ENMC": {"x-": 0.48, "y+": 0.6, "z-": 0.8},
}


@pytest.mark.parametrize("name", NAMED)
def test_named_surfaces(name):
    """Traction on each: force per reference area, at its centroid; outward normals from the pressure's resultant."""
    force = np.array([3.0, -2.0, 8.0])
    for side, area in NAMED[name].items():
        b, body = scene(name)
        surface = body.surface(side)
        b.add_traction(surface, force)
        b.add_pressure(surface, 5.0)
        load = b.description.dead_loads[0]
        total = load.weights[body.slot_kind[load.slots] == 0].sum()
        assert total == pytest.approx(area, rel=1e-12 if name in FLAT else 6e-3), side
        center = load.weights @ body.reference[load.slots] / total + body.origin
        model = finalize(b)
        pushed = follower_force(model, model.state())
        if name in FLAT:
            outward = center - placed(np.array([0.5, 0.0 if name == "beam" else 0.4, 0.3 * (name == "ENMC")])[None])[0]
            pushed = pushed[body.slot_kind == 0].sum(axis=0)
            assert np.linalg.norm(pushed) == pytest.approx(5.0 * area, rel=1e-10)
            assert pushed @ outward < -0.99 * 5.0 * area * np.linalg.norm(outward)
    with pytest.raises((wf.ModelError, wf.MeshError), match="named 'left'"):
        body.surface("left")


def test_surfaces_by_predicate_and_rows():
    for name in ("beam", "plate"):
        body, _ = plain(name)
        every = body.surface(lambda X: np.ones(len(X), bool))
        assert len(every) == {"beam": 2 + 4 * 3, "plate": 2 * 4 + 8}[name]
        half = body.surface(lambda X: (X - SHIFT) @ TURN[:, 0] > 0.999)
        np.testing.assert_array_equal(half.faces, body.surface("end" if name == "beam" else "x+").faces)
        np.testing.assert_array_equal(body.surface(half.faces).faces, half.faces)
        for bad in ([[99, 0]], [[0, 6]], [0, 1], [[0.0, 1.0]]):
            with pytest.raises(wf.ModelError, match="surface"):
                body.surface(np.array(bad))


def follower_force(model, state):
    """Force of pressures and moments at a state, (slots, 3), by the kernels of a step."""
    return _launched(model, state, "force")


def follower_product(model, state, direction):
    """The kernels' tangent of them times a direction."""
    return _launched(model, state, "product", direction)


def _launched(model, state, what, *fields):
    terms, vec3 = model.terms, model.types.vec3
    values = np.array([law.values[-1] for law in terms.laws.laws])[None]
    values = wp.array(values, dtype=wp.vec3d, device="cpu")
    active = wp.ones(1, dtype=wp.int32, device="cpu")
    out = wp.zeros((1, terms.side_entries), dtype=vec3, device="cpu")
    extra = [wp.array(f[None], dtype=vec3, device="cpu") for f in fields]
    for part in terms.find(Followers).items:
        share = [1.0] if what == "product" else []
        args = [part.data, *share, state.displacement, values, active, *extra, out]
        wp.launch(getattr(part, what), dim=(1, part.count), inputs=args, device="cpu")
    force = np.zeros((model.slots, 3))
    start, entry = terms.side_topology.start.numpy(), terms.side_topology.entry.numpy()
    np.add.at(force, np.repeat(np.arange(model.slots), np.diff(start)), out.numpy()[0][entry])
    return force


def moment_of(body, u, f):
    """Resultant moment about the body's origin: sum of e_i x f_i over all slots."""
    return np.cross(body.reference + u, f).sum(axis=0)


def bent(body, seed=0):
    """Displacements of a large strain and rotation."""
    noise = np.random.default_rng(seed).uniform(-1, 1, body.reference.shape)
    return affine(body, rotation(70.0) @ A, (1.0, 2.0, 3.0)) + np.where(body.slot_kind == 0, 0.01, 0.1)[:, None] * noise


@pytest.mark.parametrize("name", SIDES)
def test_pressure_on_a_closed_surface(name):
    """No resultant, no moment, the volume as its potential, and the exact tangent: it is symmetric."""
    b, body = scene(name)
    b.add_pressure(body.surface(lambda X: np.ones(len(X), bool)), 1e3)
    model = finalize(b)
    u = bent(body)
    f = follower_force(model, state_of(model, u))
    scale = np.abs(f).sum()
    assert np.abs(f[body.slot_kind == 0].sum(axis=0)).max() < 1e-13 * scale
    assert np.abs(moment_of(body, u, f)).max() < 1e-13 * scale * 4
    # a uniform growth about the origin: - p 3 V, with V in the deformed place by the mass rule
    rule = body.family.curved_mass_rule
    _, ds, _, _ = assembly.geometry(body, np.arange(len(body.mesh.cells)), rule.points)
    det = np.linalg.det(np.einsum("esk,eqsl->eqkl", (body.reference + u)[body.connectivity], ds))
    assert np.sum(f * (body.reference + u)) == pytest.approx(-3e3 * np.sum(det * rule.weights), rel=1e-10)
    d = np.random.default_rng(5).uniform(-1, 1, u.shape)
    numeric = difference(lambda t: follower_force(model, state_of(model, u + t * d)), 1e-2)
    assert np.abs(follower_product(model, state_of(model, u), d) - numeric).max() < 1e-10 * np.abs(numeric).max()


def difference(f, h):
    """Derivative at 0 by central differences with an error of O(h^6)."""
    one, two, three = ((f(k * h) - f(-k * h)) / (60 * h) for k in (1, 2, 3))
    return 45 * one - 9 * two + three


# supports


@pytest.mark.parametrize(
    ("name", "slots", "kinds"),
    [
        ("beam", "position", (0,)),
        ("beam", "position+axis", (0, 1)),
        ("beam", "position+section", (0, 2, 3)),
        ("beam", "all", (0, 1, 2, 3)),
        ("plate", "position+surface", (0, 1, 2)),
        ("plate", "director", (3,)),
        ("H3843", "gradients", (1, 2, 3)),
        ("ENMC", "all", (0, 1, 2, 3)),
        ("ENMC", "position", (0,)),
    ],
)
def test_clamped_slots(name, slots, kinds):
    b, body = scene(name)
    nodes = body.start if name == "beam" else body.nodes("x-")
    b.clamp(nodes, slots=slots, components="xz")
    held = ~finalize(b).free_slots
    expected = np.isin(body.slot_kind, kinds) & np.isin(body.slot_node, nodes.indices)
    np.testing.assert_array_equal(held, expected[:, None] & np.array([True, False, True]))
    assert expected.sum() == len(kinds) * len(nodes) or name == "ENMC"  # its face nodes have a position only


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("beam", "3243 knows 'position', 'axis', 'section', 'all'"),
        ("plate", "3443 knows 'position', 'surface', 'director', 'all'"),
        ("FN", "FN knows 'position', 'gradients', .*'all'"),
    ],
)
def test_unknown_slots(name, known):
    b, body = scene(name)
    for call in (b.clamp, functools.partial(b.drive, displacement=(0, 0, 1))):
        with pytest.raises(wf.ModelError, match=f"slots = 'position.twist': element {known}, and several of them"):
            call(body.nodes([0]), slots="position+twist")


@pytest.mark.parametrize("name", ["beam", "plate", "ENMC", "H3843"])
def test_driven_gradients(name):
    """A driven end turns with all its slots; a displacement holds the gradients."""
    axis, anchor = np.array([1.0, 2.0, -1.0]), np.array([0.1, 0.2, 0.3])
    for kind in ("rotation", "displacement"):
        b, body = scene(name)
        nodes = body.start if name == "beam" else body.nodes("x-")
        law = {"displacement": ([0, 1], [(0, 0, 0), (0.3, 0, 0)])}
        if kind == "rotation":
            law = {"rotation": wf.Rotation(anchor, axis, ([0, 1], [0, math.radians(30)]))}
        b.drive(nodes, **law, slots="all")
        model = finalize(b)
        assert model.free_slots[np.isin(body.slot_node, nodes.indices)].sum() == 0
        sim = wf.Simulation(model, dt=0.25)
        sim.step(2)
        R = rotation(15.0, axis) if kind == "rotation" else np.eye(3)
        X = body.mesh.points[nodes.indices]
        x = (X - anchor) @ R.T + anchor if kind == "rotation" else X + [0.15, 0, 0]
        np.testing.assert_allclose(sim.positions(body)[0, nodes.indices], x, atol=1e-13)
        F = sim.node_gradients(body)[0, nodes.indices]
        with_gradients = body.node_slot_count[nodes.indices] == 4
        np.testing.assert_allclose(F[with_gradients], np.broadcast_to(R, F[with_gradients].shape), atol=1e-13)
        assert np.isnan(F[~with_gradients]).all()
        assert (~with_gradients).any() == (name == "ENMC")


# moments


M = np.array([2.0, -3.0, 5.0])


def turned(name):
    """Builder, body, what a moment is put on."""
    if name == "T10 point":
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        body = b.add_solid(tets("T10"), material=SVK)
        return b, body, body.at(body.mesh.points[body.mesh.cells[1]].mean(axis=0))
    b, body = scene(name.split()[0])
    where = {
        "end": lambda: body.end,
        "edge": lambda: body.edge("x+"),
        "node": lambda: body.nodes([body.mesh.cells[0, 1]]),
        "point": lambda: body.at(reference_at(body, np.array([1]), parent_points(body.family, 1))[0, 0]),
    }[name.split()[1]]
    return b, body, where()


PLACES = ["beam end", "arc end", "beam point", "plate edge", "roof edge", "roof point"]
PLACES += ["ENMC node", "ENMC point", "FN node", "H3843 node", "H3843 point", "T10 point"]


@pytest.mark.parametrize("name", PLACES)
def test_moment(name):
    """Its nodal forces have the moment m and no resultant, their work in a rigid rotation is m.omega, and the kernels'
    tangent is the symmetric part of the exact one."""
    b, body, where = turned(name)
    b.add_moment(where, M)
    model = finalize(b)
    u = bent(body)
    f = follower_force(model, state_of(model, u))
    expected = M
    if name.split()[0] in ("plate", "roof"):  # the part along the director does nothing
        if name.endswith("point"):
            d = ((body.reference + u)[where.slots].T @ (where.gradients @ where.axes))[:, 2][None]
        else:
            d = (body.reference + u)[body.node_slot[where.indices] + 3]
        d = d / np.linalg.norm(d, axis=1, keepdims=True)
        expected = np.mean(M - (d @ M)[:, None] * d, axis=0)
    np.testing.assert_allclose(moment_of(body, u, f), expected, atol=1e-12 * np.abs(f).max())
    assert np.abs(f[body.slot_kind == 0].sum(axis=0)).max() < 1e-13 * max(np.abs(f).max(), 1)
    omega = np.array([0.3, 0.7, -1.1])
    velocity = np.cross(omega, body.reference + u) + (body.slot_kind == 0)[:, None] * [5.0, -1.0, 2.0]
    assert np.sum(f * velocity) == pytest.approx(expected @ omega, rel=1e-11)

    used = np.flatnonzero(np.abs(f).max(axis=1) > 0)
    unit = np.zeros((3 * len(used), model.slots, 3))
    unit[np.arange(3 * len(used)), np.repeat(used, 3), np.tile(np.arange(3), len(used))] = 1.0
    state = state_of(model, u)
    force = lambda d, t: follower_force(model, state_of(model, u + t * d))  # noqa: E731
    exact = np.array([difference(functools.partial(force, d), 5e-4)[used].ravel() for d in unit])
    kernel = np.array([follower_product(model, state, d)[used].ravel() for d in unit])
    assert np.abs(kernel - 0.5 * (exact + exact.T)).max() < 1e-8 * np.abs(exact).max()


def test_moment_bends_a_beam_into_an_arc():
    """A free section: M at the tip of a clamped beam gives the slope M L / EI exactly."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = add_beam([(0, 0, 0), (1, 0, 0)], elements=8, b=b)
    EI = E_MODULUS * 0.15 * 0.1**3 / 12
    b.clamp(body.start, slots="position+section")
    b.add_moment(body.end, (0, -EI * 0.5, 0))
    static = wf.solve_static(finalize(b), load_steps=2)
    assert static.displacements(body)[0, -1, 2] == pytest.approx((1 - math.cos(0.5)) / 0.5, rel=5e-3)


def test_moments_need_gradients():
    b = wf.ModelBuilder()
    t10 = b.add_solid(tets("T10"), material=SVK)
    enmc = b.add_solid(tets("ENMC"), material=SVK, element="ENMC", name="enmc")
    for body, node in ((t10, 0), (enmc, enmc.mesh.cells[0, 5])):
        with pytest.raises(wf.ModelError, match=r"have no gradients to turn; use a point body\.at"):
            b.add_moment(body.nodes([node]), M)


# initial values


@pytest.mark.parametrize("name", BODIES)
def test_initial_velocity(name):
    """A spin about the centre of mass, and a velocity field, on all slots: e' = L e, so that F' F^-1 = L."""
    spin, L = np.array([3.0, -2.0, 5.0]), np.array([[0.1, 0.4, 0.2], [-0.3, 0.2, 0.5], [0.6, -0.1, 0.3]])
    b, body = scene(name)
    b.set_initial(body, velocity=(1, 2, 3), angular_velocity=spin)
    model = finalize(b)
    v = model.state().velocity.numpy()[0]
    W = np.cross(spin, np.eye(3)).T
    np.testing.assert_allclose(
        (v - v[0])[body.slot_kind == 0], (body.reference - body.reference[0])[body.slot_kind == 0] @ W.T, atol=1e-12
    )
    np.testing.assert_allclose(v[body.slot_kind > 0], body.reference[body.slot_kind > 0] @ W.T, atol=1e-12)
    momentum = model.mass_matrix() @ v.ravel()
    total = momentum.reshape(-1, 3)[body.slot_kind == 0].sum(axis=0)
    np.testing.assert_allclose(total, model.info()["mass"] * np.array([1, 2, 3]), rtol=1e-11)
    b, body = scene(name)
    b.set_initial(body, velocity=lambda X: X @ L.T)
    v = finalize(b).state().velocity.numpy()[0]
    np.testing.assert_allclose(v, (body.reference + (body.slot_kind == 0)[:, None] * body.origin) @ L.T, atol=1e-9)


@pytest.mark.parametrize("name", ["arc", "roof", "ENMC", "FN", "H3843"])
def test_a_spin_has_no_strain_rate(name):
    damped = replace(SVK, damping=wf.KelvinVoigt(eta=1e3, lambda_v=1e3, form="rate"))
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    source, _ = plain(name)
    make = {"ENMC": ("ENMC", tets("ENMC")), "FN": ("FN", tets("FN")), "H3843": ("H3843", hexes())}.get(name)
    if name == "arc":
        body = add_beam(arc, lambda s: TURN @ radial(s), material=damped, b=b)
    elif name == "roof":
        body = b.add_shell(source.mesh, thickness=0.1, material=damped)
    else:
        body = b.add_solid(make[1], material=damped, element=make[0])
    rates = []
    for how in ({"angular_velocity": (3, -2, 5)}, {"velocity": lambda X: X * [3.0, 0.0, 0.0]}):
        b.set_initial(body, **how)
        model = finalize(b)
        rates.append(model.dissipation_rate(model.state())[0])
    assert abs(rates[0]) < 1e-20 * rates[1]


@pytest.mark.parametrize("name", ["beam", "plate", "ENMC", "FN", "H3843"])
def test_initial_place(name):
    """initial= as a function gives positions and gradients; nodal arrays can't say the gradients."""
    b, body = scene(name, initial=lambda X: X @ A.T + [1.0, 2.0, 3.0])
    u = finalize(b).state().displacement.numpy()[0]
    expected = affine(body, A) + (body.slot_kind == 0)[:, None] * (body.origin @ (A - np.eye(3)).T + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(u, expected, atol=1e-9)
    X = body.mesh.points
    for call in (
        lambda: scene(name, initial=X),
        lambda: b.set_initial(body, velocity=X),
        lambda: b.set_initial(body, displacement=X),
    ):
        with pytest.raises(wf.ModelError, match=r"has gradients at its nodes; give a function X"):
            call()
    b.set_initial(body, displacement=(0, 0, 1))
    np.testing.assert_array_equal(
        finalize(b).state().displacement.numpy()[0], (body.slot_kind == 0)[:, None] * [0, 0, 1.0]
    )


# reports, drawing, fields


def test_info():
    b = wf.ModelBuilder()
    names = ["beam", "plate full", "ENMC", "H3843"]
    bodies = [BODIES[n](b, name=n) for n in names]
    b.add_moment(bodies[0].end, M)
    info = finalize(b).info()
    assert [d["element"] for d in info["bodies"]] == ["3243", "3443", "ENMC", "H3843"]
    assert [d["quadrature"] for d in info["bodies"]][:3] == [["tied"], ["full"], ["tet14"]]
    assert [d["elements"] for d in info["bodies"]] == [3, 4, 12, 12]
    assert [d["nodes"] for d in info["bodies"]][:2] == [4, 9]
    assert info["slots"] == 16 + 36 + bodies[2].slot_count + 4 * 36
    assert bodies[2].slot_count == 4 * 12 + len(bodies[2].mesh.points) - 12
    assert "moments" in info["features"]
    assert "follower pressure" in info["left_out"]
    assert {(k["element"], k["elements"]) for k in info["blocks"]} == {
        ("3243", 3),
        ("3443", 4),
        ("ENMC", 12),
        ("H3843", 12),
    }
    volume = 0.015 + 0.08 + 0.48 + bodies[3].mesh.volume()
    assert info["mass"] == pytest.approx(RHO * volume, rel=1e-12)


VOLUMES = {"beam": 0.015, "arc": 1.5 * 0.015, "plate": 0.08, "roof": 0.1, "ENMC": 0.48, "FN": 0.48}


@pytest.mark.parametrize("name", BODIES)
def test_skin_and_drawing(name):
    """The skin is closed, looks outward and encloses the volume; the drawn cells fill it."""
    body, _ = plain(name)
    volume = VOLUMES.get(name.split()[0]) or body.mesh.volume() if name != "ball" else ball().volume()
    skin = body.skin
    points = reference_points(body, skin.slot_weights)
    _, same = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    T = same.ravel()[skin.triangles]
    edges = np.concatenate([T[:, [0, 1]], T[:, [1, 2]], T[:, [2, 0]]])
    forward = {tuple(e) for e in edges}
    assert len(forward) == len(edges)
    assert forward == {(b, a) for a, b in forward}
    x = points[skin.triangles] - points.mean(axis=0)
    enclosed = np.linalg.det(x).sum() / 6
    # the trilinear hexahedra have warped faces, the others are flat or drawn with chords
    tolerance = {"arc": 8e-3, "roof": 8e-3, "ball": 0.08, "H3843": 1e-3}.get(name, 1e-12)
    assert enclosed == pytest.approx(volume, rel=tolerance)
    if name in ("beam", "plate"):  # sharp edges: no point is shared between sides
        side = np.repeat(np.arange(len(skin.triangles)), 3)
        normal = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        first = np.full((len(points), 3), np.nan)
        first[skin.triangles.ravel()] = normal[side]
        assert np.abs(first[skin.triangles] - normal[:, None]).max() < 1e-9
    drawing = body.drawing
    cells = wf.mesh.Mesh(reference_points(body, drawing.slot_weights), drawing.cells, drawing.cell_type)
    assert cells.volumes().min() > 0
    assert cells.volume() == pytest.approx(volume, rel={"ball": 1e-12, "H3843": 1e-12}.get(name, tolerance))
    assert np.bincount(drawing.element).min() == len(body.family.lattice.cells)
    for weights in (skin.node_weights, drawing.node_weights):  # fields of 1 stay 1
        np.testing.assert_allclose(weights @ np.ones(weights.shape[1]), 1.0, rtol=1e-12)


@pytest.mark.parametrize("name", BODIES)
def test_uniform_stress(name):
    """x = F X + c: von Mises stress of the full law at every node and on the skin, and F at the nodes.

    "tied" leaves out the transverse shear, which vanishes at a shell's faces and a beam's edges: there is none here. On
    curved axes the parts of the law have axes that turn, and add up but for the error of their interpolation.
    """
    body, model = plain(name)
    plane = np.array([[1.1, 0.2, 0], [0.2, 0.9, 0], [0, 0, 1.2]])
    stretch = {
        "plate": TURN @ plane @ TURN.T,
        "roof": np.diag([1.2, 0.9, 1.2]),
        "beam": TURN @ plane[::-1, ::-1] @ TURN.T,
        "arc": TURN @ np.diag([1.2, 1.2, 0.9]) @ TURN.T,
    }
    F = rotation(70.0) @ stretch.get(name, A)
    tolerance = 1e-10 if name not in ("arc", "roof") else 1e-3
    sim = wf.Simulation(model, state_of(model, affine(body, F, (1, 2, 3))), dt=1.0)
    strain = 0.5 * (F.T @ F - np.eye(3))
    lam, mu = SVK.lame
    cauchy = F @ (lam * np.trace(strain) * np.eye(3) + 2 * mu * strain) @ F.T / np.linalg.det(F)
    deviator = cauchy - np.trace(cauchy) / 3 * np.eye(3)
    expected = math.sqrt(1.5 * np.sum(deviator**2))
    field = sim.field("von_mises", body)
    assert field.shape == (1, len(body.mesh.points))
    np.testing.assert_allclose(field, expected, rtol=tolerance)
    np.testing.assert_allclose(sim.skin_field("von_mises", body), expected, rtol=tolerance)
    gradients = sim.node_gradients(body)[0]
    corner = body.node_slot_count == 4
    np.testing.assert_allclose(gradients[corner], np.broadcast_to(F, gradients[corner].shape), atol=1e-12)
    moved = sim.skin_points(body)[0]
    X = reference_points(body, body.skin.slot_weights) - body.origin
    np.testing.assert_allclose(moved, X @ F.T + body.origin + [1, 2, 3], atol=1e-12)


def test_node_gradients_need_gradients():
    b = wf.ModelBuilder()
    body = b.add_solid(tets("T10"), material=SVK)
    sim = wf.Simulation(finalize(b), dt=1.0)
    with pytest.raises(wf.ModelError, match="T10 has no gradients at its nodes"):
        sim.node_gradients(body)


def test_probes_and_point_loads_on_gradient_slots():
    """A probe of a material point and the work of a force there use the point's own functions."""
    b, body = scene("plate")
    X = placed(np.array([[0.37, 0.21, 0.04]]))[0]
    point = body.at(X)
    b.add_probe("p", point)
    b.add_probe("top", body.surface("top"))
    b.add_probe("edge", body.edge("x+"))
    b.add_point_load(point, (0, 0, 3.0))
    model = finalize(b)
    sim = wf.Simulation(model, dt=1e-3)
    sim.step(3)
    u = sim.state.displacement.numpy()[0]
    np.testing.assert_allclose(sim.probe("p").position[0, -1], X + point.weights @ u[point.slots], atol=1e-9)
    top = placed(np.array([[0.5, 0.4, 0.05]]))[0]
    record = sim.probe("top")
    np.testing.assert_allclose(record.position[0, -1] - record.displacement[0, -1], top, atol=1e-12)
    np.testing.assert_allclose(
        sim.probe("edge").displacement[0, -1],
        sim.displacements(body)[0, body.edge("x+").indices].mean(axis=0),
        atol=1e-15,
    )
    energies = sim.energies()
    work = sum(np.diff(np.concatenate([[[0, 0, 0]], sim.probe("p").displacement[0]]), axis=0) @ [0, 0, 3.0])
    assert energies["work_loads"][0] == pytest.approx(work, rel=1e-10)


def test_a_checkpoint_of_another_section_is_refused(tmp_path):
    def simulation(torsion):
        b = wf.ModelBuilder()
        section = wf.Rectangle(0.1, 0.1, torsion=torsion)
        beam = b.add_beam(
            [(0, 0, 0), (1, 0, 0)],
            elements=2,
            section=section,
            normal=(0, 0, 1),
            material=wf.SVK(E=1e7, nu=0.3, density=1000.0),
        )
        b.clamp(beam.start)
        return wf.Simulation(b.finalize(device="cpu"), dt=1e-3)

    simulation(None).run(2e-3, outputs=[wf.Checkpoint(tmp_path / "c.npz")], progress=False)
    simulation(None).resume(tmp_path / "c.npz")
    with pytest.raises(wf.CheckpointError):
        simulation(1e-5).resume(tmp_path / "c.npz")
