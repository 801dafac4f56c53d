"""A chain of a hundred hinged links that carries a weight a thousand times as heavy as one of them."""

import math
from typing import Any, Literal

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=0.02, t_end=2.0, integrator="bdf2", tol=1e-5, fps=60.0, speed=0.5, picture=0.3)
def chain(
    *,
    links: int = 100,
    joint: Literal["revolute", "spherical"] = "revolute",
    mass_ratio: float = 1000.0,
    length: float = 0.05,
    side: float = 0.025,
    start: float = 1.0,
    E: float = 1e7,
    nu: float = 0.3,
    density: float = 1000.0,
) -> wf.ModelBuilder:
    """A chain, hung from the ground, swings with a heavy weight at its end; each link is one 3243 beam element.

    Revolute hinges turn about y and about the direction across y and the chain, alternately. A chain is a hard case for
    solvers: every joint carries the pull of the weight.

    Args:
        links: number of links.
        joint: kind of the joints between the links.
        mass_ratio: mass of the weight over that of a link.
        length: of a link, m.
        side: of a link's square section, m.
        start: angle of the chain from the downward vertical at t = 0, rad.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: of the links, kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    along = np.array([math.sin(start), 0.0, -math.cos(start)])
    y = np.array([0.0, 1.0, 0.0])
    across = np.cross(along, y)
    section = wf.Rectangle(side, side)
    material = wf.SVK(E=E, nu=nu, density=density)
    mass = mass_ratio * density * length * side**2
    stretch = 9.81 * mass * math.cos(start) / (E * side**2)  # strain of a link under the pull of the weight at t = 0

    def prestretch(X: np.ndarray) -> np.ndarray:
        """Displacement (n, 3), m, of a link under the pull of the weight."""
        distance = X @ along
        return np.outer(stretch * distance, along) - nu * stretch * (X - np.outer(distance, along))

    previous: Any = wf.GROUND
    for k in range(links):
        ends = [k * length * along, (k + 1) * length * along]
        link = b.add_beam(ends, elements=1, section=section, normal=across, material=material, name=f"link {k + 1}")
        b.set_initial(link, displacement=prestretch)
        axis = (across if k % 2 else y) if joint == "revolute" else None
        b.add_joint(joint, parent=previous, child=link.start, axis=axis, name=f"hinge {k + 1}")
        previous = link.end
    size = 0.06 * links * length
    cube = wf.mesh.box((size, size, size), cells=(1, 1, 1), origin=(0.0, -0.5 * size, -0.5 * size), name="weight")
    transform = (np.column_stack([along, y, across]), links * length * along)
    weight = b.add_solid(cube, material=wf.SVK(E=E, nu=nu, density=mass / size**3), transform=transform)
    b.set_initial(weight, displacement=stretch * links * length * along)
    b.add_joint("spherical", parent=previous, child=weight.surface("x-"), name="shackle")
    b.add_probe("weight", weight.surface("x-"))
    return b
