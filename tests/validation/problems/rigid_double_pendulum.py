"""A double pendulum of stiff links against the differential equation of rigid ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import warpfea as wf

from ..rigid import double_pendulum_motion, double_pendulum_places

STEEL = 7870.0
"""Density, kg/m^3."""
LINKS, WIDTH = (0.5, 0.5), 0.05
"""Lengths and side of the section, m."""
MASS = [STEEL * WIDTH**2 * length for length in LINKS]
INERTIA = [m * (length**2 + WIDTH**2) / 12.0 for m, length in zip(MASS, LINKS)]
Y = np.array([0.0, 1.0, 0.0])


def rigid_links(angle: float) -> wf.Reference:
    """Lagrange's equations of two rigid boxes, by DOP853 at rtol = 1e-12."""

    def places(k: int) -> Callable[[np.ndarray], np.ndarray]:
        def at(times: np.ndarray) -> np.ndarray:
            angles, _ = double_pendulum_motion(
                np.concatenate([[0.0], times]), masses=MASS, lengths=LINKS, centers=[0.5 * x for x in LINKS],
                inertias=INERTIA, angles=(angle, angle), rates=(0.0, 0.0),
            )  # fmt: skip
            xz = double_pendulum_places(angles[1:], LINKS)[k]
            return np.stack([xz[:, 0], 0.0 * xz[:, 0], xz[:, 1]], axis=1)

        return at

    return wf.Reference({"elbow": places(0), "tip": places(1)}, "rigid links, Lagrange's equations")


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


@wf.scene(dt=1e-3, t_end=1.0, integrator="bdf2", tol=1e-10, reference=rigid_links)
def rigid_double_pendulum(*, E: float = 2e12, angle: float = 0.5 * np.pi) -> wf.ModelBuilder:
    """Two stiff links of one 3243 element each, on revolute joints, swing from rest.

    Args:
        E: Young's modulus (SVK), Pa; stiff enough for negligible deformation.
        angle: of the links from the downward vertical at t = 0, rad.
    """
    return double_pendulum_links(kind="3243", E=E, angle=angle)
