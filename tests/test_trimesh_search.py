"""Rigid triangle meshes: the search on the device, beside brute force."""

import math

import numpy as np
import pytest
from triangle_meshes import ball, boxed, halved, octahedron, search, sheet

import warpfea as wf


def dented():
    """A closed mesh with ridges, valleys and a saddle."""
    points, triangles = octahedron()
    for _ in range(3):
        points, triangles = halved(points, triangles)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return wf.TriMesh((1.0 + 0.4 * np.prod(np.sin(3.0 * points), axis=1))[:, None] * points, triangles)


def brute(mesh, places):
    """Distances (n,) and nearest places (n, 3), by projection on each face, each edge and each corner."""
    p = mesh.points[mesh.triangles]
    candidates = [np.broadcast_to(corner, (len(places), *corner.shape)) for corner in np.moveaxis(p, 1, 0)]
    y = places[:, None]
    for k in range(3):
        a, d = p[:, k], p[:, (k + 1) % 3] - p[:, k]
        t = np.clip(((y - a) * d).sum(axis=2) / (d**2).sum(axis=1), 0.0, 1.0)
        candidates.append(a + t[:, :, None] * d)
    u, v = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    gram = np.stack(
        [np.stack([(u * u).sum(1), (u * v).sum(1)], -1), np.stack([(u * v).sum(1), (v * v).sum(1)], -1)], -2
    )
    right = np.stack([((y - p[:, 0]) * u).sum(2), ((y - p[:, 0]) * v).sum(2)], -1)
    st = np.einsum("tij,ntj->nti", np.linalg.inv(gram), right)
    inside = (st >= 0.0).all(axis=2) & (st.sum(axis=2) <= 1.0)
    face = p[:, 0] + st[:, :, :1] * u + st[:, :, 1:] * v
    candidates.append(np.where(inside[:, :, None], face, np.inf))
    every = np.concatenate(candidates, axis=1)
    square = ((every - y) ** 2).sum(axis=2)
    best = square.argmin(axis=1)
    return np.sqrt(square[np.arange(len(places)), best]), every[np.arange(len(places)), best]


def winding(mesh, places):
    """Times that a closed mesh runs around each place (van Oosterom and Strackee 1983)."""
    a, b, c = (mesh.points[mesh.triangles[:, k]] - places[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=2) for x in (a, b, c))
    over = (a * np.cross(b, c)).sum(axis=2)
    under = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return np.arctan2(over, under).sum(axis=1) / (2.0 * np.pi)


def blade():
    """An octahedron with edges of 17 degrees and needle tips."""
    points, triangles = octahedron()
    return wf.TriMesh(points * (1.0, 0.15, 1.0), triangles)


CLOSED = {
    "box": lambda: boxed(cells=4),
    "octahedron": lambda: wf.TriMesh(*octahedron()),
    "dented": dented,
    "blade": blade,
}


@pytest.mark.parametrize("name", CLOSED)
def test_nearest_places_and_sides_of_closed_meshes(name):
    mesh = CLOSED[name]()
    center, size = mesh.frame()[0], mesh.sizes[0]
    places = center + 0.7 * np.ptp(mesh.points, axis=0) * np.random.default_rng(3).uniform(-1, 1, (500, 3))
    normal, gap, _ = search(mesh, places, others=(ball(1.0, (0, 0, 0), 1),))
    wanted, near = brute(mesh, places)
    inside = winding(mesh, places) > 0.5
    assert 20 < inside.sum() < 400
    assert np.abs(np.abs(gap) - wanted).max() < 1e-14 * size
    assert ((gap < 0.0) == inside).all()
    assert np.abs(places - gap[:, None] * normal - near).max() < 1e-13 * size


@pytest.mark.cuda
def test_a_deep_tree_is_searched_alike_on_cuda():
    mesh = ball(1.0, (0, 0, 0), 7)
    rng = np.random.default_rng(2).normal(size=(5000, 3))
    ends = rng * (np.linspace(0.5, 2.0, 5000) / np.linalg.norm(rng, axis=1))[:, None]
    starts = 1.3 * ends
    host, device = (search(mesh, ends, starts, device=d) for d in ("cpu", "cuda:0"))
    assert np.abs(device[1] - host[1]).max() < 1e-14
    assert (device[2] == host[2]).mean() > 0.999  # on a border either triangle may be met first


def test_places_over_edges_and_corners_are_told_in_or_out():
    """A face's own normal may give the wrong side if several triangles are equally near."""
    for mesh in (wf.TriMesh(*octahedron()), dented(), boxed(), blade()):
        p = mesh.points[mesh.triangles]
        middles = 0.5 * (p + np.roll(p, 1, axis=1)).reshape(-1, 3)
        at = np.concatenate([middles, p.reshape(-1, 3)])
        step = np.random.default_rng(5).normal(size=at.shape)
        places = at + 1e-3 * step / np.linalg.norm(step, axis=1, keepdims=True)
        _, gap, _ = search(mesh, places)
        assert ((gap < 0.0) == (winding(mesh, places) > 0.5)).all()


def test_a_sheet_is_felt_from_both_sides():
    mesh = wf.TriMesh(*sheet(height=0.0))
    normal, gap, _ = search(mesh, np.array([(0.1, 0.05, 0.2), (0.1, 0.05, -0.2), (0.4, 0, -0.1), (0.4, 0.0, 0.1)]))
    far = math.hypot(0.1, 0.1)
    assert gap == pytest.approx([0.2, 0.2, far, far], rel=1e-14)
    root = math.sqrt(0.5)
    np.testing.assert_allclose(normal, [(0, 0, 1), (0, 0, -1), (root, 0, -root), (root, 0, root)], atol=1e-13)


def test_motions_through_a_sheet_are_seen():
    mesh = wf.TriMesh(*sheet(height=0.0))
    rng = np.random.default_rng(7)
    a, b = (np.column_stack([rng.uniform(-0.29, 0.29, (300, 2)), z * rng.uniform(1e-9, 0.8, 300)]) for z in (1, -1))
    grid = np.linspace(-0.3, 0.3, 5)[1:-1]
    corners = np.array([(x, y, 0.0) for x in grid for y in grid])  # through corners of triangles
    a, b = (
        np.concatenate([a, corners + (0, 0, 0.3), corners]),
        np.concatenate([b, corners - (0, 0, 0.3), corners - (0, 0, 0.5)]),
    )
    for start, end, behind in ((a, b, 0), (b, a, 1)):
        _, _, side = search(mesh, end, start)
        starts_on_it = start[:, 2] == 0.0
        crossing = ~(end[:, 2] == 0.0) if behind else np.ones(len(a), dtype=bool)
        assert (side[crossing & ~starts_on_it] % 2 == behind).all()
        assert (side[crossing] >= 0).all()
        normal, gap, _ = search(mesh, end, sides=side)
        assert gap[crossing] == pytest.approx(-np.abs(end[crossing, 2]), rel=1e-13, abs=1e-16)
        assert normal[crossing, 2] == pytest.approx(1 - 2 * behind)
    away = np.array([(0.0, 0, 0.1), (1.0, 0, 0.1), (-1.0, 0.2, 0.5)])
    _, _, side = search(mesh, away + ((0, 0, 1), (0, 0, -1), (0, 0, -1)), away)
    assert (side == -1).all()


def test_a_point_that_rounding_has_put_beyond_a_sheet_is_where_it_was():
    mesh = wf.TriMesh(*sheet(height=0.0))
    start = np.array([(0.1, 0.02, -1e-8), (0.1, 0.02, 1e-8)])  # one was in front, one behind
    _, _, side = search(mesh, start + ((0, 0, -1e-3), (0, 0, 1e-3)), start, sides=[-3, -4])
    assert (side >= 0).all()
    assert (side % 2).tolist() == [0, 1]
    _, _, side = search(mesh, start + ((0, 0, 1e-3), (0, 0, -1e-3)), start, sides=[-3, -4])
    assert side.tolist() == [-1, -1]


def test_motions_through_a_plate_are_refused_and_those_over_its_edge_are_not():
    mesh = boxed(size=(1, 1, 0.02), center=(0, 0, -0.01), cells=8)
    start = np.array([(0.1, 0.1, 0.5), (0.1, 0.13, 0.5), (0.495, 0, 0.003), (0.499, 0.2, 0.02), (0.1, 0.1, 0.001)])
    end = np.array([(0.1, 0.2, -0.5), (0.1, 0.2, -0.015), (0.505, 0, -0.005), (0.6, 0.2, -0.1), (0.1, 0.1, -0.001)])
    _, _, side = search(mesh, end, start)
    assert side[0] == -2
    assert side[1] >= 0
    assert (side[2:4] == -1).all()
    assert side[4] >= 0
    _, gap, _ = search(mesh, end, sides=side)
    assert gap[1] == pytest.approx(-0.015)  # from the face that it came through, though the other is nearer
    _, _, further = search(mesh, np.array([(0.1, 0.2, -0.5), (0.1, 0.2, 0.1)]), end[[1, 1]], side[[1, 1]])
    assert further.tolist() == [-2, -1]
