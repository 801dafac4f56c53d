"""A double pendulum of stiff links against the differential equation of rigid ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import warpfea as wf
from warpfea.studies.reports.mechanisms.cases import STEEL
from warpfea.studies.reports.mechanisms.pendulum import LINKS, WIDTH, double_pendulum_links
from warpfea.studies.reports.mechanisms.rigid import double_pendulum_motion, double_pendulum_places


def rigid_links(angle: float) -> wf.Reference:
    """Lagrange's equations of two rigid boxes, by DOP853 at rtol = 1e-12."""
    mass = [STEEL * WIDTH**2 * length for length in LINKS]
    inertia = [m * (length**2 + WIDTH**2) / 12.0 for m, length in zip(mass, LINKS)]

    def places(k: int) -> Callable[[np.ndarray], np.ndarray]:
        def at(times: np.ndarray) -> np.ndarray:
            angles, _ = double_pendulum_motion(
                np.concatenate([[0.0], times]), masses=mass, lengths=LINKS, centers=[0.5 * x for x in LINKS],
                inertias=inertia, angles=(angle, angle), rates=(0.0, 0.0),
            )  # fmt: skip
            xz = double_pendulum_places(angles[1:], LINKS)[k]
            return np.stack([xz[:, 0], 0.0 * xz[:, 0], xz[:, 1]], axis=1)

        return at

    return wf.Reference({"elbow": places(0), "tip": places(1)}, "rigid links, Lagrange's equations")


@wf.scene(dt=1e-3, t_end=1.0, integrator="bdf2", tol=1e-10, reference=rigid_links)
def rigid_double_pendulum(*, E: float = 2e12, angle: float = 0.5 * np.pi) -> wf.ModelBuilder:
    """Two stiff links of one 3243 element each, on revolute joints, swing from rest.

    Args:
        E: Young's modulus (SVK), Pa; the links are to be so stiff that their deformation does not count.
        angle: of the links from the downward vertical at t = 0, rad.
    """
    return double_pendulum_links(kind="3243", E=E, angle=angle)
