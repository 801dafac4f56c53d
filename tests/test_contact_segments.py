"""Contact between bodies whose facets cut each other into segments: add_contact(clipping=True)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from contact_runs import DEVICES

import warpfea as wf
from warpfea.model.segments import SegmentContact, area_of, pieces_of

LOAD, SIDE, HEIGHT = 1e3, 0.3, 0.1
ROUND_EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))


def box(b: wf.ModelBuilder, spec: tuple, z: float, nu: float = 0.0, skew: float = 0.0) -> Any:
    """A box (element, cells along x and y, origin x, y, lengths x, y) on the plane at z; straight edges, also skew."""
    element, cells, origin, size = spec
    mesh = wf.mesh.box((*size, HEIGHT), cells=(*cells, 1), element=element, origin=(*origin, z))
    X = mesh.points.copy()
    t = (X[:, :2] - origin) / size
    X[:, :2] += skew * np.prod(np.sin(np.pi * t), axis=1, keepdims=True) * (1.0 + np.sin(5.0 * t))
    if element == "T10":
        for k, (i, j) in enumerate(ROUND_EDGES):
            X[mesh.cells[:, 4 + k]] = 0.5 * (X[mesh.cells[:, i]] + X[mesh.cells[:, j]])
    mesh = replace(mesh, points=X) if skew else mesh
    return b.add_solid(mesh, material=wf.SVK(E=1e6, nu=nu, density=1000.0))


def stresses(
    lower: list, upper: list, *, load: float = LOAD, swap: bool = False, nu: float = 0.0, skew: float = 0.0,
    dtype: str = "float64", device: str = "cpu", tol: float = 1e-12, **options: Any
) -> tuple[np.ndarray, wf.Model]:  # fmt: skip
    """Stress at the nodes of bodies on each other under a uniform load, free to expand, over the load or its mean."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    below, above = [box(b, s, -HEIGHT, nu, skew) for s in lower], [box(b, s, 0.0, nu, -0.7 * skew) for s in upper]
    for body in below:
        slots = "position+gradient-x+gradient-y" if body.family.name == "H3843" else "position"
        b.clamp(body.nodes("z-"), slots=slots, components="z")
    for body in below + above:
        for axis in "xy":
            b.clamp(body.nodes(f"{axis}-"), slots="position", components=axis)
    for body in above:
        b.add_traction(body.surface("z+"), (0, 0, -load))
    for low in below:
        for up in above:
            faces = [up.surface("z-"), low.surface("z+")]
            b.add_contact(*faces[:: -1 if swap else 1], **options)
    model = b.finalize(device=device, dtype=dtype)
    result = wf.solve_static(model, load_steps=1, stabilise=True, tol=tol)
    found = np.concatenate([result.field("von_mises", body)[0] for body in below + above])
    return found / found.mean() if nu else found / load, model


def whole(element: str, *cells: int) -> tuple:
    return element, cells, (0.0, 0.0), (SIDE, SIDE)


def part(element: str, x: float, end: float, *cells: int) -> tuple:
    return element, cells, (x, 0.0), (end - x, SIDE)


UNLIKE = {
    "T10, H3843": (whole("T10", 3, 3), whole("H3843", 2, 2)),
    "T4, T10": (whole("T4", 3, 2), whole("T10", 2, 2)),
    "H3843, T4": (whole("H3843", 3, 2), whole("T4", 2, 3)),
}


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("pair", UNLIKE)
def test_a_uniform_pressure_passes_unlike_meshes(pair, swap):
    """1e-12; 1 % without clipping, 6 % with points on edges."""
    lower, upper = UNLIKE[pair]
    found, model = stresses([lower], [upper], swap=swap, clipping=True)
    assert isinstance(model.description.contacts[0], SegmentContact)
    np.testing.assert_allclose(found, 1.0, atol=1e-8)


def test_without_clipping_it_does_not():
    found, _ = stresses([UNLIKE["T10, H3843"][0]], [UNLIKE["T10, H3843"][1]])
    assert np.abs(found - 1.0).max() > 3e-3


@pytest.mark.parametrize("over", [False, True])
@pytest.mark.parametrize("border", [0.13, 0.1 + 1e-5])
def test_a_uniform_pressure_ends_within_facets(border, over):
    """Two blocks beside each other on one, or below it: each ends within facets of the other side, or overhangs."""
    halves = [part("T4", 0.0, border, 2, 3), part("H3843", border, SIDE, 1, 2)]
    one = [whole("T10", 3, 3)]
    found, _ = stresses(halves if over else one, one if over else halves, clipping=True)
    np.testing.assert_allclose(found, 1.0, atol=1e-8)


@pytest.mark.parametrize("load", [1e3, 1e5])
def test_it_passes_skew_triangles_that_expand(load):
    """Stress uniform at a strain of 10 %, too: facets move with each other."""
    found, _ = stresses([whole("T10", 3, 3)], [whole("T10", 4, 4)], load=load, nu=0.3, skew=0.01, clipping=True)
    np.testing.assert_allclose(found, 1.0, atol=1e-8)


@pytest.mark.parametrize("device", DEVICES)
def test_float32_passes_it(device):
    found, _ = stresses(*([s] for s in UNLIKE["T4, T10"]), dtype="float32", device=device, tol=1e-5, clipping=True)
    np.testing.assert_allclose(found, 1.0, atol=1e-3)


def test_a_shell_passes_it():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    low = box(b, whole("T10", 3, 3), -HEIGHT)
    mesh = wf.mesh.grid((SIDE, SIDE), cells=(2, 2), origin=(0.0, 0.0, 0.01))
    shell = b.add_shell(mesh, thickness=0.02, material=wf.SVK(E=1e6, nu=0.0, density=1000.0))
    b.clamp(low.nodes("z-"), slots="position")
    b.clamp(shell.nodes(lambda X: X[:, 2] > -1.0), slots="position", components="xy")
    b.add_traction(shell.surface("top"), (0, 0, -LOAD))
    b.add_contact(shell.surface("bottom"), low.surface("z+"), clipping=True)
    result = wf.solve_static(b.finalize(device="cpu"), load_steps=1, stabilise=True, tol=1e-11)
    np.testing.assert_allclose(result.field("von_mises", low)[0], LOAD, rtol=1e-8)


def carried(overhang: float) -> np.ndarray:
    """Force and moment, N, N m, on a block that is pressed into another one, beyond which it reaches."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    low, up = box(b, whole("T4", 2, 2), -HEIGHT), box(b, ("T10", (2, 1), (overhang, 0.03), (SIDE, 0.2)), 0.0)
    b.clamp(low.nodes("z-"))
    b.drive(low.nodes("z+"), displacement=([0.0, 1.0], np.zeros((2, 3))))
    b.drive(up.nodes(lambda X: X[:, 2] > -1.0), displacement=([0.0, 1.0], [(0, 0, 0), (0, 0, -1e-4)]))
    b.add_contact(up.surface("z-"), low.surface("z+"), name="lie", clipping=True, stiffness="region")
    return wf.solve_static(b.finalize(device="cpu"), load_steps=1).contact_force("lie")[0]


@pytest.mark.parametrize("overhang", [0.02, 0.17])
def test_force_on_a_block_that_overhangs(overhang):
    """It is of the area that lies on the other block, and at its centre."""
    force = carried(overhang)
    assert force[2] / carried(0.0)[2] == pytest.approx(1.0 - overhang / SIDE, rel=1e-8)
    assert -force[4] / force[2] == pytest.approx(0.5 * (overhang + SIDE), rel=1e-8)
    assert force[3] / force[2] == pytest.approx(0.13, rel=1e-8)


# geometry, options


@pytest.mark.parametrize(("gap", "cuts"), [(0.01, True), (0.4, False)])
def test_only_what_begins_near_each_other_is_cut(gap, cuts):
    b = wf.ModelBuilder()
    low, up = box(b, whole("T4", 2, 2), -HEIGHT), box(b, whole("T4", 3, 3), gap)
    contact = b.add_contact(up, low, clipping=True)
    assert (isinstance(contact, SegmentContact), contact.edges is None) == (cuts, cuts)


def test_other_points_are_refused():
    b = wf.ModelBuilder()
    low, up = box(b, whole("H3843", 2, 2), -HEIGHT), box(b, whole("H3843", 3, 3), 0.0)
    with pytest.raises(NotImplementedError, match="points = 9"):
        b.add_contact(up, low, points=9, clipping=True)


def test_pieces_fill_a_facet():
    """Random triangles over a facet, alone, beside each other and over each other: areas of parts and of the rest."""
    rng = np.random.default_rng(3)
    square = [0.0, 1.0, 1.0 + 1.0j, 1.0j]
    for _ in range(200):
        others = []
        for _ in range(int(rng.integers(1, 4))):
            a, b, c = (complex(x, y) for x, y in rng.uniform(-0.5, 1.5, (3, 2)))
            others.append([a, b, c] if area_of([a, b, c]) > 0.0 else [a, c, b])
        inside, outside = pieces_of(square, others)
        assert sum(map(area_of, inside + outside)) == pytest.approx(1.0, abs=1e-10)
        x = rng.random((300, 2)) @ (1.0, 1.0j)
        seen = np.any([covers(other, x) for other in others], axis=0)
        assert (np.any([covers(piece, x) for piece in outside] or [0.0 * x.real > 1.0], axis=0) == ~seen).all()
        assert (np.any([covers(piece, x) for piece in inside] or [0.0 * x.real > 1.0], axis=0) == seen).all()


def covers(polygon: list[complex], x: np.ndarray) -> np.ndarray:
    """Points inside of a convex polygon."""
    p = np.array(polygon)
    way = np.roll(p, -1) - p
    return ((way.conj() * (x[:, None] - p)).imag > 0.0).all(axis=1)
