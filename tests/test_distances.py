"""Distances of points from the triangles of obstacles, against ipctk."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.contact.collider_mesh import mesh_functions
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
