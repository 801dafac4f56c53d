"""A soft beam that falls over two cylinders."""

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=2e-3, t_end=0.6, tol=1e-6, fps=100.0, speed=0.25, picture=0.5)
def beam_over_cylinders(
    *,
    length: float = 0.6,
    side: float = 0.02,
    span: float = 0.3,
    radius: float = 0.03,
    drop: float = 0.05,
    mu: float = 0.3,
    elements: int = 12,
    E: float = 4e6,
    nu: float = 0.3,
    density: float = 1000.0,
    viscosity: float = 4e4,
) -> wf.ModelBuilder:
    """A beam of 3243 elements falls on two cylinders, bends over them and comes to rest on them.

    Args:
        length: of the beam, m.
        side: of its square section, m.
        span: distance of the cylinders' axes, m.
        radius: of the cylinders, m.
        drop: distance of beam and cylinders at the start, m.
        mu: coefficient of friction.
        elements: of the beam.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        viscosity: Kelvin-Voigt damping in shear, Pa s.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    height = radius + drop + 0.5 * side
    ends, section = [(-0.5 * length, 0, height), (0.5 * length, 0, height)], wf.Rectangle(side, side)
    law = wf.SVK(E=E, nu=nu, density=density, damping=wf.KelvinVoigt(viscosity, 0.0))
    beam = b.add_beam(ends, elements=elements, section=section, normal=(0, 0, 1), material=law, name="beam")
    for name, x in (("left", -0.5 * span), ("right", 0.5 * span)):
        shape = wf.Cylinder(start=(x, -3.0 * side, 0.0), end=(x, 3.0 * side, 0.0), radius=radius)
        cylinder = b.add_collider(shape, name=f"{name} cylinder")
        b.add_contact(beam, cylinder, mu=mu, restitution=0.3, stiffness="region", name=f"{name} rest")
    b.add_probe("middle", beam.at((0.0, 0.0, height)))
    b.add_probe("end", beam.end)
    return b
