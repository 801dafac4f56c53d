"""A flexible pendulum of 3243 beams against the spectral solution of its kinematics."""

from __future__ import annotations

import numpy as np

import warpfea as wf
from warpfea.studies.files import reference_data as stored

CASE = "stiff_E5e7_ANCF3243_SVK_nu0"


def spectral() -> wf.Reference:
    """Tip and middle every 20 ms, by a Legendre-Galerkin method of order 18, without elements or time steps."""
    case = stored("S4_pendulum_spectral")["cases"][CASE]
    probes = {name: (case["times"], np.pad(case[key], ((0, 0), (0, 1)))) for name, key in PROBES.items()}
    return wf.Reference(probes, f"S4_pendulum_spectral.json, {CASE}", case["max_change_n14_to_n18_tip"])


PROBES = {"tip": "tip", "middle": "mid"}


@wf.scene(dt=1e-3, t_end=1.0, integrator="bdf2", tol=1e-8, reference=spectral)
def spectral_pendulum(*, elements: int = 16) -> wf.ModelBuilder:
    """A beam, pinned at one end, is let go from the horizontal, and bends as it falls (S4, stiff, nu = 0).

    Args:
        elements: of the beam.
    """
    b = wf.ModelBuilder(gravity=(0.0, -9.81, 0.0))
    beam = b.add_beam(
        [(0, 0, 0), (1, 0, 0)],
        elements=elements,
        section=wf.Rectangle(0.02, 0.02),
        normal=(0, 0, 1),
        material=wf.SVK(E=5e7, nu=0.0, density=1000.0),
        name="beam",
    )
    b.clamp(beam.start, slots="position")
    b.add_probe("tip", beam.end)
    b.add_probe("middle", beam.at((0.5, 0, 0)))
    return b
