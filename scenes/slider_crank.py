"""A slider-crank whose rod bends."""

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=2e-4, t_end=0.085, integrator="bdf2", tol=1e-5, fps=1200.0, speed=0.01, picture=0.0546)
def slider_crank(
    *,
    crank: float = 0.15,
    rod: float = 0.30,
    side: float = 0.008,
    speed: float = 150.0,
    E: float = 2e9,
    nu: float = 0.3,
    density: float = 1200.0,
    elements: int = 8,
    slider_mass: float = 0.0075,
    crank_E: float = 2e11,
    gravity: float = 0.0,
) -> wf.ModelBuilder:
    """A crank that turns at a constant speed drives a slider by a rod of 3243 beams, which bends under its own inertia.

    The crank turns about -y in the plane x-z, from the stretched position, with the velocities of the rigid mechanism.
    Steel, as Chu and Pan (1975) and Simeon (1996): E=2e11, density=7870, slider_mass=0.0755, at the same speed.

    Args:
        crank: its length, m.
        rod: its length, m; longer than the crank.
        side: of the rod's square section, m; the crank's is twice as wide and high.
        speed: of the crank, rad/s.
        E: Young's modulus of the rod (SVK), Pa.
        nu: Poisson's ratio of all parts.
        density: of the rod and the crank, kg/m^3.
        elements: of the rod.
        slider_mass: kg.
        crank_E: Young's modulus of crank and slider, Pa.
        gravity: along -z, m/s^2.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -gravity))
    reach = crank + rod

    def bar(name: str, start: float, end: float, count: int, width: float, modulus: float) -> wf.Body:
        ends, section, law = (
            [(start, 0, 0), (end, 0, 0)],
            wf.Rectangle(width, width),
            wf.SVK(E=modulus, nu=nu, density=density),
        )
        return b.add_beam(ends, elements=count, section=section, normal=(0, 0, 1), material=law, name=name)

    arm = bar("crank", 0, crank, 2, 2.0 * side, crank_E)
    link = bar("rod", crank, reach, elements, side, E)
    size = 4.0 * side
    cube = wf.mesh.box((size, size, size), cells=(1, 1, 1), origin=(reach, -0.5 * size, -0.5 * size), name="slider")
    block = b.add_solid(cube, material=wf.SVK(E=crank_E, nu=nu, density=slider_mass / size**3))

    turn = -speed * crank / rod  # of the rod where the mechanism is stretched
    b.set_initial(arm, velocity=lambda X: speed * np.column_stack([-X[:, 2], 0.0 * X[:, 1], X[:, 0]]))
    b.set_initial(link, velocity=lambda X: turn * np.column_stack([-X[:, 2], 0.0 * X[:, 1], X[:, 0] - reach]))

    hinge = (0, -1, 0)
    angle = ([0.0, 1e3], [0.0, 1e3 * speed])
    b.add_joint("revolute", parent=wf.GROUND, child=arm.start, drive=angle, name="motor", axis=hinge)
    b.add_joint("revolute", parent=arm.end, child=link.start, name="crank pin", axis=hinge)
    b.add_joint("revolute", parent=link.end, child=block.surface("x-"), name="slider pin", axis=hinge)
    b.add_joint("translational", parent=wf.GROUND, child=block.surface("z-"), axis=(1, 0, 0), name="guide")
    b.add_probe("slider", block.surface("x-"))
    b.add_probe("middle of rod", link.at((crank + 0.5 * rod, 0, 0)))
    return b
