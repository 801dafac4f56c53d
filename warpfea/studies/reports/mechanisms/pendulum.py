"""A double pendulum of stiff links against rigid ones."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import warpfea as wf

from .cases import STEEL, Y, place, timed, work
from .rigid import double_pendulum_motion, double_pendulum_places

__all__ = ["double_pendulum"]

LINKS = (0.5, 0.5)
WIDTH = 0.05


def double_pendulum_links(*, kind: str, E: float, angle: float) -> wf.ModelBuilder:
    """Two links 0.5 x 0.05 x 0.05 m with revolute joints in the middle of their end faces, at rest at `angle`."""
    b = wf.ModelBuilder()
    law = wf.SVK(E=E, nu=0.3, density=STEEL)
    along = np.array([np.sin(angle), 0.0, -np.cos(angle)])
    across = np.cross(along, Y)
    at: np.ndarray = np.zeros(3)
    above: Any = wf.GROUND
    top: Any
    low: Any
    for k, length in enumerate(LINKS):
        if kind == "3243":
            link = b.add_beam([at, at + length * along], elements=1, section=wf.Rectangle(WIDTH, WIDTH), normal=across,
                              material=law, name=f"link_{k}")  # fmt: skip
            top, low = link.start, link.end
        else:
            mesh = wf.mesh.box((length, WIDTH, WIDTH), cells=(1, 1, 1), origin=(0.0, -WIDTH / 2, -WIDTH / 2))
            link = b.add_solid(
                mesh, transform=(np.stack([along, Y, across], axis=1), at), material=law, name=f"link_{k}"
            )
            top, low = link.surface("x-"), link.surface("x+")
        b.add_joint("revolute", parent=above, child=top, axis=-Y)
        b.add_probe(("elbow", "tip")[k], low)
        at, above = at + length * along, low
    return b


def double_pendulum(device: Any, quick: bool) -> Iterator[dict[str, Any]]:
    """Two stiff links that swing for 2 s from rest, bdf2, against rigid ones with the boxes' mass, centre and inertia.

    Errors are the largest distances of elbow and tip over the length of both links. From the horizontal (1.571 rad) the
    links swing to -2.19 and 2.07 rad, from 45 degrees (0.785 rad) within 0.83 rad; neither turns over."""
    level, low = np.pi / 2, np.pi / 4
    cases = [("time", "3243", 2e12, dt, level) for dt in (2e-3, 1e-3, 5e-4, 2.5e-4)]
    cases += [("stiffness", "3243", E, 2.5e-4, level) for E in (2e9, 2e10, 2e11)]
    cases += [("low", "3243", 2e11, 5e-4, low), ("solid", "T10", 2e11, 5e-4, low)]
    last: tuple[str, float] | None = None
    mass = [STEEL * WIDTH**2 * length for length in LINKS]
    inertia = [m * (length**2 + WIDTH**2) / 12.0 for m, length in zip(mass, LINKS)]
    for series, kind, E, dt, angle in [("quick", "3243", 2e11, 1e-3, low)] if quick else cases:
        model = double_pendulum_links(kind=kind, E=E, angle=angle).finalize(device=device)
        sim = wf.Simulation(model, dt=dt, integrator="bdf2")
        seconds = timed(sim, round((0.5 if quick else 2.0) / dt))
        times = np.concatenate([[0.0], sim.probe("tip").time])
        angles, _ = double_pendulum_motion(times, masses=mass, lengths=LINKS, centers=[length / 2 for length in LINKS],
                                           inertias=inertia, angles=(angle, angle), rates=(0.0, 0.0))  # fmt: skip
        error = {}
        for name, exact in zip(("elbow", "tip"), double_pendulum_places(angles[1:], LINKS)):
            error[name] = float(np.linalg.norm(place(sim, name) - exact, axis=1).max() / sum(LINKS))
        worst = max(error.values())
        order = float(np.log2(last[1] / worst)) if last and last[0] == series == "time" else None
        last = series, worst
        yield {"series": series, "element": kind, "E": E, "dt": dt, "angle": angle, "elbow_error": error["elbow"],
               "tip_error": error["tip"], "order": order, "swing": [float(angles.min()), float(angles.max())],
               **work(sim, seconds)}  # fmt: skip
