"""Beams along functions: tangents of helices of any number of turns, speed and size; corners; fields on their slots."""

from __future__ import annotations

import math

import numpy as np
import pytest

import warpfea as wf
from warpfea.builder.beams import beam_geometry

SECTION = wf.Rectangle(0.15, 0.1)
SLOPE = 0.3


def helix(turns, scale, speed):
    """A helix of radius `scale` (m) whose parameter runs faster in its middle, and its derivative."""
    w = 2.0 * math.pi * turns

    def phase(s):
        return w * (s - speed * math.sin(2.0 * math.pi * s) / (2.0 * math.pi))

    def at(s):
        a = phase(s)
        return scale * np.array([math.cos(a), math.sin(a), SLOPE * a])

    def derivative(s):
        a, rate = phase(s), w * (1.0 - speed * math.cos(2.0 * math.pi * s))
        return scale * rate * np.array([-math.sin(a), math.cos(a), SLOPE])

    def normal(s):
        return -np.array([math.cos(phase(s)), math.sin(phase(s)), 0.0])

    return at, derivative, normal


def geometry(curve, elements, normal=(0.1, 0.2, 1.0)):
    return beam_geometry("b", curve, elements, SECTION, normal, "error")


@pytest.mark.parametrize("speed", [0.0, 0.5])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("turns", [1, 10, 160, pytest.param(1000, marks=pytest.mark.slow)])
def test_tangents_of_a_helix(turns, scale, speed):
    curve, derivative, normal = helix(turns, scale, speed)
    elements = 12 * turns
    mesh, axes, local = geometry(curve, elements, normal)
    along = np.einsum("enkl,enl->enk", axes[mesh.cells], local[:, :, :, 0])
    exact = np.array([derivative(s) for s in np.linspace(0.0, 1.0, elements + 1)])[mesh.cells] / elements
    size, length = np.linalg.norm(along, axis=2), np.linalg.norm(exact, axis=2)
    assert np.abs(size / length - 1.0).max() < 1e-8
    assert np.abs(along / size[..., None] - exact / length[..., None]).max() < 1e-8


def test_a_line_joined_to_an_arc():
    """The curvature jumps at a node: the tangents there and beside it are still those of the line and of the arc."""

    def curve(s):
        a = max(s - 0.5, 0.0)
        return (min(s, 0.5) + math.sin(a), 0.0, 1.0 - math.cos(a))

    mesh, axes, local = geometry(curve, 4, (0.0, 1.0, 0.0))
    a = np.maximum(np.linspace(0.0, 1.0, 5) - 0.5, 0.0)
    np.testing.assert_allclose(axes[:, :, 0], np.column_stack([np.cos(a), 0.0 * a, np.sin(a)]), atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(local[..., 0], axis=2), 0.25, rtol=1e-10)


def test_a_jump_of_speed():
    """A straight line passed at two speeds, which change at a node: each element has its own |dX/dxi|."""
    _, axes, local = geometry(lambda s: (s + max(s - 0.5, 0.0), 0.0, 0.0), 4, (0.0, 0.0, 1.0))
    np.testing.assert_allclose(axes[:, :, 0], np.tile([1.0, 0.0, 0.0], (5, 1)), atol=1e-14)
    np.testing.assert_allclose(local[:, :, 0, 0], [[0.25, 0.25]] * 2 + [[0.5, 0.5]] * 2, rtol=1e-12)


def bent(angle, at):
    """A line that turns by `angle` (degrees) at s = at."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    return lambda k: (min(k, at) + c * max(k - at, 0.0), s * max(k - at, 0.0), 0.0)


@pytest.mark.parametrize("elements", [1, 4, 7, 100])
@pytest.mark.parametrize("at", [0.25, 0.4321])
@pytest.mark.parametrize("angle", [11.0, 90.0, 170.0])
def test_corners_are_refused(angle, at, elements):
    """At nodes and within elements."""
    with pytest.raises(wf.ModelError, match=f"corner of {angle:.3g} degrees at s = {at:.3g}; give a smooth curve"):
        geometry(bent(angle, at), elements)


def test_a_rounded_corner_is_none():
    def curve(s):
        a = min(max((s - 0.5) / 0.02, 0.0), 1.0) * math.pi / 2
        r = 0.02 * 2 / math.pi
        return (min(s, 0.5) + r * math.sin(a), max(s - 0.52, 0.0) + r * (1 - math.cos(a)), 0.0)

    assert geometry(curve, 200) is not None


@pytest.mark.parametrize(("turns", "elements"), [(1, 1), (1, 3), (10, 10), (100, 50)])
def test_too_few_elements_are_refused(turns, elements):
    """Also where an element makes whole turns, so that both of its ends point the same way."""
    with pytest.raises(wf.ModelError, match=r"turns by \d+ degrees; use elements = \d+ or more"):
        geometry(helix(turns, 1.0, 0.0)[0], elements)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_curves_that_are_not_finite(bad):
    with pytest.raises(wf.ModelError, match=r"must be finite for every s in \[0, 1\]; it is .* at s = "):
        geometry(lambda s: (s, 0.0, bad if s > 0.5 else 0.0), 4)


def test_a_field_on_a_long_helix():
    """The gradients of a velocity given as a function follow its changes over an element, not over the body."""
    turns = 100
    curve, derivative, normal = helix(turns, 1.0, 0.0)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=1e6, nu=0.3, density=1000.0)
    body = b.add_beam(curve, elements=12 * turns, section=SECTION, normal=normal, material=law)

    def velocity(X):
        return np.column_stack([np.sin(X[:, 2]), X[:, 0], np.cos(X[:, 1])])

    b.set_initial(body, velocity=velocity)
    v = b.finalize(device="cpu").state().velocity.numpy()[0]
    X = body.mesh.points[body.slot_node]
    d = body.reference
    exact = np.column_stack([np.cos(X[:, 2]) * d[:, 2], d[:, 0], -np.sin(X[:, 1]) * d[:, 1]])
    gradient = body.slot_kind > 0
    assert np.abs(v - exact)[gradient].max() < 1e-8
