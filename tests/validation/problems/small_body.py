"""A small swaying bar of any family: influence of the precision."""

from __future__ import annotations

import numpy as np

import warpfea as wf

from .plate_vibration import first_mode

LENGTH, SIDE = 0.5, 0.05
"""Size of the bar, m."""


@wf.scene(dt=2e-3, t_end=0.16, integrator="bdf2")
def small_body(*, family: str = "T10", elements: int = 4, E: float = 4e6, speed: float = 1.0) -> wf.ModelBuilder:
    """A bar, clamped at one end, starts with the velocities of a beam's first bending mode.

    Args:
        family: T4, T10, ENMC, FN18, H3843, 3243 or 3443.
        elements: along the bar, one across; of a shell two across.
        E: Young's modulus (SVK), Pa.
        speed: of the free end at t = 0, m/s.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    law = wf.SVK(E=E, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(eta=1e3, form="rate"))
    if family == "3243":
        line, section = [(0, 0, 0), (LENGTH, 0, 0)], wf.Rectangle(SIDE, SIDE)
        bar = b.add_beam(line, elements=elements, section=section, normal=(0, 0, 1), material=law, name="bar")
        b.clamp(bar.start, slots="all")
        b.add_probe("tip", bar.end)
    elif family == "3443":
        bar = b.add_shell(wf.mesh.grid((LENGTH, SIDE), cells=(elements, 2)), thickness=SIDE, material=law, name="bar")
        b.clamp(bar.edge("x-"), slots="position+director")
        b.add_probe("tip", bar.at((LENGTH, 0.5 * SIDE, 0.0)))
    else:
        mesh = wf.mesh.box((LENGTH, SIDE, SIDE), cells=(elements, 1, 1), origin=(0, 0, -0.5 * SIDE), element=family)
        bar = b.add_solid(mesh, material=law, element=family, name="bar")
        b.clamp(bar.nodes("x-"))
        b.add_probe("tip", bar.surface("x+"))

    def velocity(P: np.ndarray) -> np.ndarray:
        w, slope = first_mode(P[:, 0] / LENGTH)
        return speed * np.stack([-P[:, 2] * slope / LENGTH, 0.0 * w, w], axis=1)

    b.set_initial(bar, velocity=velocity)
    return b
