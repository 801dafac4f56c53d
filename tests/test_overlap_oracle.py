"""Crossings of bodies that the overlap check reports, against intersections of their skins that ipctk finds.

`python tests/test_overlap_oracle.py FRAMES JOBS FILE` counts them in many frames.
"""

from __future__ import annotations

import json
import pathlib
import sys
import warnings
from concurrent.futures import ProcessPoolExecutor
from itertools import combinations

import numpy as np
import pytest
from result_files import content_of

import warpfea as wf
from warpfea.model.surfaces import reference_points
from warpfea.simulation.overlap import MIN_DEPTH_RATIO, OverlapCheck

ipctk = pytest.importorskip("ipctk")
MATERIAL = wf.SVK(E=1e6, nu=0.3, density=1000.0)


def bodies(b):
    """A body of each family, about 0.1 m large, all at the origin."""
    cube = wf.mesh.box((0.1, 0.1, 0.1), cells=(2, 2, 2), origin=(-0.05, -0.05, -0.05))
    bar = wf.mesh.box((0.2, 0.03, 0.03), cells=(4, 1, 1), origin=(-0.1, -0.015, -0.015), element="H3843")
    grid = wf.mesh.grid((0.15, 0.15), cells=(3, 3), origin=(-0.075, -0.075, 0.0))
    ends, section = [(-0.1, 0.0, 0.0), (0.1, 0.0, 0.0)], wf.Rectangle(0.01, 0.02)
    return [
        b.add_solid(cube, material=MATERIAL, name="cube"),
        b.add_solid(wf.mesh.sphere(0.05, cells=4), material=MATERIAL, name="ball"),
        b.add_solid(bar, material=MATERIAL, name="bar"),
        b.add_shell(grid, thickness=0.01, material=MATERIAL, name="shell"),
        b.add_beam(ends, elements=4, section=section, normal=(0, 0, 1), material=MATERIAL, name="beam"),
    ]


def throw(rng, body, u, frame):
    """Turn, stretch by up to a tenth and move a body: displacements of its slots. Each third frame is a drop without a
    turn, each third one squeezes by up to a third."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn[:, 0] *= np.linalg.det(turn)
    A = turn @ (np.eye(3) + 0.05 * rng.uniform(-1.0, 1.0, (3, 3)))
    if frame % 3 == 1:
        A = np.eye(3)
    elif frame % 3 == 2:
        A = turn @ np.diag(1.0 - rng.uniform(-0.1, 0.33, 3))
    e = body.reference + (body.slot_kind == 0)[:, None] * body.origin
    u[body.slots] = e @ (A - np.eye(3)).T + (body.slot_kind == 0)[:, None] * rng.uniform(-0.12, 0.12, 3)


def welded(side, x):
    """Points and triangles of a skin, whose elements share no points."""
    _, first, index = np.unique(x.round(9), axis=0, return_index=True, return_inverse=True)
    return x[first], index.ravel()[side.triangles]


def intersect(one, other):
    """True if ipctk finds that an edge of one skin passes a triangle of the other."""
    points = np.vstack([one[0], other[0]])
    triangles = np.vstack([one[1], other[1] + len(one[0])])
    mesh = ipctk.CollisionMesh(points, ipctk.edges(triangles), triangles)
    return ipctk.has_intersections(mesh, np.asfortranarray(points))


def shrunk(skin, depth):
    """A closed skin with its points moved inward by a depth, m."""
    x, triangles = skin
    a, b, c = np.moveaxis(x[triangles], 1, 0)
    normal = np.zeros_like(x)
    for corner in range(3):
        np.add.at(normal, triangles[:, corner], np.cross(b - a, c - a))
    return x - depth * normal / np.linalg.norm(normal, axis=1, keepdims=True), triangles


def crossings(frames, seed=7):
    """Numbers of reported pairs, all of which intersect; of others that do, but no longer with skins moved in by twice
    the depth that counts; and of those apart."""
    rng = np.random.default_rng(seed)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    of = bodies(b)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    counts = {"reported": 0, "shallow": 0, "apart": 0}
    for frame in range(frames):
        state = sim.model.state()
        u = state.displacement.numpy()
        for body in of:
            throw(rng, body, u[0], frame)
        sim.state.displacement.assign(u)
        check = OverlapCheck(sim)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", wf.ModelWarning)
            check.check(sim)
        reported = {frozenset((crossing.first, crossing.second)) for crossing in check.found}
        sides = {side.thing.name: (side, side.points(u, None)[0]) for side in check._sides}
        for body in of:  # the skins are those of the moved bodies
            weights = body.skin.slot_weights
            expected = reference_points(body, weights) + weights @ u[0, body.slots]
            np.testing.assert_allclose(sides[body.name][1], expected, atol=1e-14)
        for first, second in combinations(sides, 2):
            one, other = welded(*sides[first]), welded(*sides[second])
            if {first, second} in reported:
                counts["reported"] += 1
                assert intersect(one, other), (first, second)
            elif intersect(one, other):
                counts["shallow"] += 1
                depth = 2.0 * MIN_DEPTH_RATIO * min(sides[first][0].thickness, sides[second][0].thickness)
                assert not intersect(shrunk(one, depth), shrunk(other, depth)), (first, second)
            else:
                counts["apart"] += 1
    return counts


@pytest.mark.parametrize("frames", [40, pytest.param(600, marks=pytest.mark.slow)])
def test_crossings_are_those_of_ipctk(frames):
    counts = crossings(frames)
    assert counts["reported"] > frames
    assert counts["apart"] > frames


def test_twenty_thousand_frames():
    """Each reported pair intersects, and others at most as deep as twice what counts, or the command had failed."""
    content = content_of("overlap_cpu.json", "python tests/test_overlap_oracle.py 20000 2")
    assert content["frames"] == 20_000
    assert sum(row["reported"] for row in content["rows"]) > 30_000
    assert sum(sum(row.values()) for row in content["rows"]) == 10 * content["frames"]


if __name__ == "__main__":
    from warpfea.base.provenance import provenance_of

    frames, jobs = map(int, sys.argv[1:3])
    with ProcessPoolExecutor(jobs) as pool:
        rows = list(pool.map(crossings, [-(-frames // jobs)] * jobs, range(jobs)))
    command = " ".join(["python", *sys.argv])
    content = provenance_of([], "cpu") | {"command": command, "frames": -(-frames // jobs) * jobs, "rows": rows}
    pathlib.Path(sys.argv[3]).write_text(json.dumps(content, indent=2) + "\n")
