"""A bar with a traction that jumps, and simulations of it with dt="auto"."""

from __future__ import annotations

import warpfea as wf

SCHEMES = ("backward_euler", "bdf2")
LAW = wf.SVK(E=1e6, nu=0.3, density=1000.0)
KICK = 0.0123


def bar(*, worlds=1, dtype="float64", gravity=(0, 0, -9.81), kick=False):
    b = wf.ModelBuilder(gravity=gravity)
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=LAW, name="bar")
    b.clamp(body.nodes("x-"))
    if kick:
        pull = [(0, 0, 0), (0, 0, 0), (0, 0, 3e3), (0, 0, 3e3)]
        b.add_traction(body.surface("x+"), ([0, KICK, KICK + 1e-3, 1.0], pull))
    b.add_probe("tip", body.surface("x+"))
    return b.finalize(device="cpu", dtype=dtype, worlds=worlds)


def auto(model=None, error=1e-3, **options):
    return wf.Simulation(model or bar(), dt="auto", error=error, **options)
