"""A simulation that only moves, for writers."""

from __future__ import annotations

import itertools
import pathlib
from types import SimpleNamespace

import numpy as np

from warpfea.terms.fields import ELEMENT_FIELDS

FAR = np.array([1.0e4, -2.0e4, 3.0e3])


def tet_box(size, cells):
    """Points (N, 3), tetra (M, 4) and outward surface triangles (T, 3) of a box cut into 6 tets per cell."""
    n = np.asarray(cells)
    grid = np.stack(np.meshgrid(*[np.arange(k + 1) for k in n], indexing="ij"), -1).reshape(-1, 3)
    number = {tuple(g): i for i, g in enumerate(grid)}
    tets = []
    for base in itertools.product(*[range(k) for k in n]):
        for order in itertools.permutations(range(3)):
            corner = [np.array(base)]
            for axis in order:
                corner.append(corner[-1] + np.eye(3, dtype=int)[axis])
            tet = [number[tuple(c)] for c in corner]
            d = np.linalg.det(np.array(corner[1:]) - corner[0])
            tets.append(tet if d > 0 else [tet[0], tet[2], tet[1], tet[3]])
    tets = np.array(tets)
    faces = np.concatenate([tets[:, f] for f in ([0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2])])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return grid * (np.asarray(size) / n), tets, faces[first[count == 1]]


def quadratic(points, tets):
    """The same tets with mid-edge nodes in meshio's order."""
    pairs = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
    edges = np.sort(np.stack([tets[:, p] for p in pairs], axis=1).reshape(-1, 2), axis=1)
    unique, where = np.unique(edges, axis=0, return_inverse=True)
    mids = points[unique].mean(axis=1)
    return np.concatenate([points, mids]), np.hstack([tets, where.reshape(-1, 6) + len(points)])


def body(name, size, cells, shift, order=1):
    points, tets, faces = tet_box(size, cells)
    used = np.unique(faces)  # skin points are a selection of the nodes, in another order
    skin = SimpleNamespace(triangles=np.searchsorted(used, faces), nodes=used)
    kind = "tetra"
    if order == 2:
        points, tets = quadratic(points, tets)
        kind = "tetra10"
    mesh = SimpleNamespace(
        points=points + shift, cells=tets, cell_type=kind, element_sets={"half": np.arange(len(tets) // 2)}
    )
    return SimpleNamespace(name=name, skin=skin, mesh=mesh)


class StubSim:
    """Two bodies, B worlds: a bar that twists at a rate of its world, a box that falls 1e4 m away."""

    def __init__(self, worlds=3, dt=0.01, up_axis="Z", far=FAR):
        self.dt = dt
        self.worlds = worlds
        self.bodies = [
            body("bar", (1.0, 0.2, 0.2), (8, 2, 2), np.zeros(3), order=2),
            body("2nd box", (0.3, 0.3, 0.3), (2, 2, 2), np.asarray(far)),
        ]
        self.model = SimpleNamespace(bodies=self.bodies, worlds=worlds, description=SimpleNamespace(up_axis=up_axis))
        self.time = np.zeros(worlds)
        self.spoil = None
        self.fields = ELEMENT_FIELDS

    def step(self):
        self.time = self.time + self.dt

    def positions(self, body):
        X = body.mesh.points
        out = np.repeat(X[None], self.worlds, axis=0)
        for world in range(self.worlds):
            t = self.time[world]
            if body.name == "bar":
                angle = (world + 1.0) * t * 3.0 * X[:, 0]
                y, z = X[:, 1] - 0.1, X[:, 2] - 0.1
                out[world, :, 1] = 0.1 + np.cos(angle) * y - np.sin(angle) * z
                out[world, :, 2] = 0.1 + np.sin(angle) * y + np.cos(angle) * z
            else:
                out[world, :, 2] -= 0.5 * (1.0 + world) * t**2
        if self.spoil is not None:
            out[self.spoil] = np.nan
        return out

    def displacements(self, body):
        return self.positions(body) - body.mesh.points

    def velocities(self, body):
        return np.ones_like(self.positions(body))

    def field(self, name, body):
        if name == "displacement":
            return np.linalg.norm(self.displacements(body), axis=2)
        return 1e6 * (body.mesh.points[:, 0] - body.mesh.points[:, 0].min() + self.time[:, None])

    def skin_points(self, body, worlds=None):
        return self.positions(body)[slice(None) if worlds is None else worlds][:, body.skin.nodes]

    def skin_field(self, name, body, worlds=None):
        return self.field(name, body)[slice(None) if worlds is None else worlds][:, body.skin.nodes]


def drive(sim, writer, steps, watch=None):
    writer.open(sim)
    writer.write(sim)
    if watch:
        watch(sim)
    for _ in range(steps):
        sim.step()
        writer.write(sim)
        if watch:
            watch(sim)
    writer.close(sim)


def left_over(folder):
    return sorted(p.name for p in pathlib.Path(folder).iterdir())
