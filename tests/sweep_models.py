"""Scenes and measures of the sweep's tests, which workers import from this file."""

import os
import resource
import signal
import time

import numpy as np

import warpfea as wf

STEEL = {"nu": 0.3, "density": 1000.0}


@wf.scene(dt=1e-2, t_end=3e-2)
def fall(*, size: float = 1.0) -> wf.ModelBuilder:
    """A tetrahedron in free fall: after n steps of h the scheme gives z = -g h^2 n (n + 1) / 2, exactly."""
    b = wf.ModelBuilder(gravity=(0, 0, -1.0))
    points = size * np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])
    mesh = wf.mesh.Mesh(points, np.array([[0, 1, 2, 3]]), "tetra")
    stone = b.add_solid(mesh, material=wf.SVK(E=1e6, **STEEL), name="stone")
    b.add_probe("p", stone.at(points[0]))
    return b


@wf.scene(dt=5e-3, t_end=5e-2, integrator="bdf2")
def bar(*, E: float = 1e6, thickness: float = 0.1, cells: int = 2, trouble: str = "") -> wf.ModelBuilder:
    """A clamped bar that bends; `trouble` in what it takes to build it.

    Args:
        trouble: "raise", "memory" or "kill".
    """
    if trouble == "raise":
        raise RuntimeError("no such bar")
    if trouble == "memory":
        before = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (4 << 30, before[1]))
        try:
            np.ones(1 << 30)  # 8 GB
        finally:
            resource.setrlimit(resource.RLIMIT_AS, before)
    if trouble == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.box((1, 0.1, thickness), cells=(cells, 1, 1), element="T4")
    body = b.add_solid(mesh, material=wf.SVK(E=E, **STEEL), name="bar")
    b.clamp(body.nodes("x-"))
    b.add_probe("tip", body.surface("x+"))
    return b


def slow(sim):
    """A measure that takes a while."""
    time.sleep(0.05)
    return sim.probe("tip").displacement[:, -1, 2]


def picky(sim):
    """A measure that raises in worlds with a small deflection."""
    z = sim.probe("tip").displacement[:, -1, 2]
    if (z > -2e-3).any():
        raise ValueError("too stiff")
    return z


def slow_fall(sim):
    """Height of the falling stone, after a while."""
    time.sleep(0.2)
    return sim.probe("p").displacement[:, -1, 2]
