"""Shapes of colliders: frames, closed meshes, bad input."""

from __future__ import annotations

import math
import pathlib

import numpy as np
import pytest
from warpfea.kernels.contact.collider_shapes import MESH, SHAPE_KINDS

import warpfea as wf
from warpfea.builder.contacts import SHAPE_NAMES
from warpfea.model import shapes
from warpfea.outputs.obstacles import SCALED

C, S = math.cos(0.7), math.sin(0.7)
TURN = np.array([[C, S, 0.0], [-S, C, 0.0], [0.0, 0.0, 1.0]]) @ np.array([[1.0, 0, 0], [0, C, S], [0, -S, C]])
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
    "zero normal": (lambda: wf.HalfSpace((0, 0, 0)), r"HalfSpace: normal = \[0.0, 0.0, 0.0\] is zero; give the"),
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


# all shapes, and one of one's own


def test_every_shape_is_known_everywhere():
    """A shape of the device is public, documented, drawn with an offset, and tested here."""
    page = (pathlib.Path(__file__).parents[1] / "warpfea/builder/CONTACT.md").read_text()
    assert [type(shape).__name__ for shape, *_ in SHAPES.values()] + ["TriMesh"] == list(SHAPE_KINDS)
    for kind, name in enumerate(SHAPE_KINDS):
        assert getattr(wf, name).kind == kind
        assert f"`{name}(" in page
        assert name in SHAPE_NAMES
    assert {*SCALED, shapes.HALF_SPACE, MESH} == {*range(len(SHAPE_KINDS))}


@pytest.mark.parametrize("kind", [None, len(SHAPE_KINDS), -1])
def test_a_shape_without_device_functions_is_refused(kind):
    class Cone(shapes.Shape):
        pass

    if kind is not None:
        Cone.kind = kind
    b = wf.ModelBuilder()
    with pytest.raises(wf.ModelError, match=rf"^add_collider: Cone has no device functions, kind = {kind}; "):
        b.add_collider(Cone())
