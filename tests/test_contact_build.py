"""Contact with obstacles as a builder describes it: colliders and contacts."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp

import warpfea as wf

LAW = wf.SVK(E=1e6, nu=0.3, density=7.0)


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
    assert (c.mu, c.mu_static, c.restitution, c.stiffness, c.stiffness_of) == (0.0, 0.0, 0.0, 1.0, "elements")
    assert (c.law, c.treatment, c.model, c.overlap) == ("default", "implicit", "patch", "auto")
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
    "restitution below 0": (contact(restitution=-0.1), r"'pad': restitution = -0.1 must be from 0 to 1"),
    "restitution 1.1": (contact(restitution=1.1), r"'pad': restitution = 1.1 must be from 0 to 1"),
    "stiffness of a part": (contact(stiffness=("part", 2.0)), r"stiffness = \('part', 2.0\) must be a positive factor"),
    "stiffness of elements": (contact(stiffness="elements", law="paper"), r"stiffness = 'elements' needs law = 'def"),
    "radius": (contact(radius=0.0), r"'pad': radius = 0.0 must be positive, m"),
    "radius < 0": (contact(model="sphere", radius=-1.0), r"'pad': radius = -1.0 must be positive, m"),
    "sphere": (contact(model="sphere"), r"'pad': model = 'sphere' needs radius= \(m\).*Hertz force"),
    "stiffness": (contact(stiffness=0.0), r"'pad': stiffness = 0.0 must be a positive factor, None for 1, 'region'"),
    "offset": (contact(offset=np.inf), r"'pad': offset = inf must be a finite number, m"),
    "overlap_time": (contact(overlap_time=0.0), r"'pad': overlap_time = 0.0 must be positive, s"),
    "law": (contact(law="papper"), r"law = 'papper' is none of 'default', 'paper', 'smooth'; did you mean 'paper'"),
    "model": (contact(model="points"), r"'pad': model = 'points' is none of 'patch', 'sphere'"),
    "treatment": (contact(treatment="semi"), r"'pad': treatment = 'semi' is none of 'implicit', 'explicit'"),
    "overlap": (contact(overlap="push"), r"'pad': overlap = 'push' is none of 'auto', 'refuse', 'offset'"),
    "explicit": (contact(treatment="explicit"), r"'explicit': law 'default' declares no explicit force; 'paper' does"),
    "points": (contact(points=6), r"'pad': points = 6: the faces of body 'block' \(T10\) are triangles.* 3, 7 points"),
    "points text": (contact(points="many"), r"'pad': points = 'many': the faces"),
    "smoothing": (contact(smoothing=1e-3), r"'pad': smoothing = 0.001: law 'default' declares no.*'paper' or 'smooth'"),
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
    "name of a body": (on(lambda b, s, f: ("block", f)), r"got 'block'; the handle of this body is what add_solid"),
    "name of a set": (on(lambda b, s, f: ("z-", f)), r"got 'z-'; write body.nodes\('z-'\)"),
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
