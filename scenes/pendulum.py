"""A soft beam that swings from a pin."""

from typing import Literal

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=1.25e-3, t_end=1.5, integrator="bdf2", tol=1e-6, speed=0.3, picture=0.7)
def pendulum(
    *,
    length: float = 1.0,
    side: float = 0.02,
    elements: int = 12,
    E: float = 2e6,
    nu: float = 0.3,
    density: float = 7200.0,
    integration: Literal["tied", "split", "full"] = "tied",
) -> wf.ModelBuilder:
    """A flexible pendulum of 3243 beams, pinned at one end and released from the horizontal, bends as it falls.

    Only the position of the start node is clamped, so the beam rotates freely there.

    Args:
        length: of the beam, m.
        side: of its square section, m.
        elements: along the length.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        integration: tied (without locking), split or full.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    ends, section, law = [(0, 0, 0), (length, 0, 0)], wf.Rectangle(side, side), wf.SVK(E=E, nu=nu, density=density)
    beam = b.add_beam(
        ends, elements=elements, section=section, normal=(0, 0, 1), material=law, integration=integration, name="beam"
    )
    b.clamp(beam.start, slots="position")
    b.add_probe("tip", beam.end)
    b.add_probe("middle", beam.at((0.5 * length, 0, 0)))
    return b
