"""Distances of points from the triangles of obstacles, and of edges from edges, against ipctk."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.contact.collider_mesh import mesh_functions
from warpfea.kernels.contact.edges import closest_on_segments
from warpfea.kernels.contact.structs import collider_struct

ipctk = pytest.importorskip("ipctk")
COUNT = 10_000
closest_on_triangle = mesh_functions(collider_struct(True)).closest_on_triangle


@wp.kernel(enable_backward=False, module="unique")
def squared_distances(x: wp.array2d(dtype=wp.vec3d), out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    a, b, c, y = x[i, 0], x[i, 1], x[i, 2], x[i, 3]
    found = closest_on_triangle(a, b, c, wp.normalize(wp.cross(b - a, c - a)), y)
    out[i] = wp.length_sq(y - wp.vec3d(found[0], found[1], found[2]))


def test_distances_of_points_from_triangles(device):
    """Slender triangles, and points in the plane, on edges and at corners, too."""
    rng = np.random.default_rng(7)
    x = rng.uniform(-1.0, 1.0, (COUNT, 4, 3))
    slender = slice(0, COUNT, 4)
    x[slender, 2] = x[slender, 1] + 1e-3 * rng.uniform(-1.0, 1.0, x[slender, 2].shape)
    weights = rng.dirichlet((1.0, 1.0, 1.0), COUNT) * rng.integers(0, 2, (COUNT, 3))
    near = slice(1, COUNT, 4)
    x[near, 3] = np.einsum("nk,nkc->nc", weights[near], x[near, :3])
    x[near, 3] += 1e-2 * rng.normal(size=x[near, 3].shape)
    found = wp.empty(COUNT, dtype=wp.float64, device=device)
    wp.launch(squared_distances, COUNT, [wp.array(x, dtype=wp.vec3d, device=device)], [found], device=device)
    wanted = [ipctk.point_triangle_distance(row[3], *row[:3]) for row in x]
    assert np.abs(np.sqrt(found.numpy()) - np.sqrt(wanted)).max() < 1e-12


@wp.kernel(enable_backward=False, module="unique")
def squared_distances_of_segments(x: wp.array2d(dtype=wp.vec3d), out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    a, b, c, d = x[i, 0], x[i, 1], x[i, 2], x[i, 3]
    part = closest_on_segments(a, b, c, d)
    out[i] = wp.length_sq(a + part[0] * (b - a) - c - part[1] * (d - c))


def test_distances_of_edges_from_edges(device):
    """Parallel edges, some of them in one line, edges that share an end, and short ones, too; nearly parallel ones,
    where ipctk's own round-off is 1e-8, no farther than it finds; points in place of edges, which it does not know,
    against its distances from points."""
    rng = np.random.default_rng(7)
    x = rng.uniform(-1.0, 1.0, (COUNT, 4, 3))
    along, across = x[:, 1] - x[:, 0], rng.normal(size=(COUNT, 3))
    parallel, close, shared, short, first, second = (slice(k, COUNT, 7) for k in range(6))
    stretch = rng.uniform(-2.0, 2.0, (COUNT, 1))
    x[parallel, 2] = np.where(rng.random((COUNT, 1)) < 0.3, x[:, 0] + 0.7 * stretch * along, x[:, 2])[parallel]
    x[parallel, 3] = (x[:, 2] + stretch * along)[parallel]
    x[close, 3] = (x[:, 2] + stretch * along + 10.0 ** rng.uniform(-15.0, -4.0, (COUNT, 1)) * across)[close]
    x[shared, 3] = x[shared, 1]
    x[short, 3] = (x[:, 2] + 1e-6 * across)[short]
    x[first, 1] = x[first, 0]
    x[second, 3] = x[second, 2]
    found = wp.empty(COUNT, dtype=wp.float64, device=device)
    ends = wp.array(x, dtype=wp.vec3d, device=device)
    wp.launch(squared_distances_of_segments, COUNT, [ends], [found], device=device)
    wanted = np.array([ipctk.edge_edge_distance(*row) for row in x])
    wanted[first] = [ipctk.point_edge_distance(row[0], row[2], row[3]) for row in x[first]]
    wanted[second] = [ipctk.point_edge_distance(row[2], row[0], row[1]) for row in x[second]]
    off = np.sqrt(found.numpy()) - np.sqrt(wanted)
    assert off.max() < 1e-12
    assert off[close].min() > -1e-7
    off[close] = 0.0
    assert np.abs(off).max() < 1e-12
