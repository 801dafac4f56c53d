"""ANCF bodies in a scene: geometry of beams, shells and solids, material points."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ancf_bodies import (
    BODIES,
    E_MODULUS,
    NU,
    RHO,
    SECTION,
    SVK,
    TURN,
    add_beam,
    ball,
    finalize,
    parent_points,
    plain,
    reference_at,
    rolled,
)

import warpfea as wf
from warpfea.model.surfaces import reference_points

RUBBER = wf.NeoHookean(mu=4e5, k=1e7, density=RHO)


# geometry of beams


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
        ({"curve": lambda s: (0.0, 0.0, 0.0)}, "zero or non-finite tangent"),
        ({"corners": "round"}, "is none of 'error', 'weld'"),
        ({"elements": 0}, "positive whole number"),
        ({"section": (0.1, 0.1)}, "must be a Rectangle, Circle, Tube or Section"),
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
        ({"corners": "sharp"}, "is none of 'error', 'weld'"),
        ({"thickness": 0}, "thickness = 0 must be a positive length"),
        ({"normals": np.ones((2, 3))}, r"normals must be finite and of shape \(10, 3\)"),
        ({"normals": lambda X: 0 * X}, "the normal at node 0 of plate is zero"),
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
