"""A beam that an end moment rolls into a circle."""

import math
from typing import Literal

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=0.02, t_end=2.25, tol=1e-5, speed=0.8, picture=1.6)
def rollup(
    *,
    length: float = 1.0,
    width: float = 0.06,
    height: float = 0.02,
    elements: int = 24,
    turns: float = 1.0,
    duration: float = 2.0,
    E: float = 1e9,
    nu: float = 0.3,
    density: float = 1000.0,
    eta: float = 2e6,
    integration: Literal["tied", "split", "full"] = "tied",
) -> wf.ModelBuilder:
    """A built-in beam of 3243 elements is rolled up by a moment at its end, turns x 2 pi E I / length; 1 is a circle.

    The moment grows linearly during `duration` and is then held; damping keeps the motion near equilibrium. The axis of
    the moment is fixed in space, and beyond a quarter of a turn a beam under such a moment would buckle out of its
    plane: here all nodes are constrained to the plane. With nu > 0 integration "full" locks, and the beam stays
    open.

    Args:
        length: of the beam, m.
        width: of its section, m.
        height: of its section, in the plane of bending, m.
        elements: along the length.
        turns: of the end under the full moment, by Euler's beam theory.
        duration: in which the moment grows, s.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        eta: shear viscosity (Kelvin-Voigt), Pa s.
        integration: tied (without locking), split or full.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    ends, section = [(0, 0, 0), (length, 0, 0)], wf.Rectangle(width, height)
    law = wf.SVK(E=E, nu=nu, density=density, damping=wf.KelvinVoigt(eta=eta) if eta else None)
    beam = b.add_beam(
        ends, elements=elements, section=section, normal=(0, 0, 1), material=law, integration=integration, name="beam"
    )
    b.clamp(beam.start, slots="position+section")
    b.clamp(beam.nodes(lambda X: X[:, 0] > -1.0), slots="all", components="y")
    moment = -2.0 * math.pi * turns * E * width * height**3 / 12.0 / length  # about -y the beam rolls up
    b.add_moment(beam.end, ([0.0, duration, 2.0 * duration], [(0, 0, 0), (0, moment, 0), (0, moment, 0)]))
    b.add_probe("end", beam.end)
    b.add_probe("middle", beam.at((0.5 * length, 0, 0)))
    return b
