"""The same bar, made of five families of elements, side by side."""

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=5e-3, t_end=0.44, integrator="bdf2", tol=1e-4, fps=120.0, speed=0.15, picture=0.2)
def mixed(
    *,
    length: float = 0.36,
    width: float = 0.045,
    height: float = 0.03,
    gap: float = 0.09,
    cells: int = 4,
    E: float = 4e6,
    nu: float = 0.3,
    density: float = 1000.0,
) -> wf.ModelBuilder:
    """Five cantilevers of one size and material bend under gravity: beam 3243, shell 3443, ENMC, H3843 and T10.

    All are bodies of one model, built in at x = 0 and let go at t = 0; their tips (a probe each) move together. The
    wall clamps all slots except the gradient along the bar, the strain there, which a wall does not prescribe.

    Args:
        length: of the bars, m.
        width: of their section, m.
        height: of their section, along gravity, m.
        gap: between two bars, m.
        cells: along the length; of the solids each is one hexahedron or six tetrahedra, of the T10 bar there are twice
            as many.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    material = wf.SVK(E=E, nu=nu, density=density)

    ends, section = [(0, 0, 0), (length, 0, 0)], wf.Rectangle(width, height)
    beam = b.add_beam(ends, elements=cells, section=section, normal=(0, 0, 1), material=material, name="beam")
    b.clamp(beam.start, slots="position+section")
    b.add_probe("beam", beam.end)

    low = np.array([0.0, width + gap - 0.5 * width, 0.0])
    plate = wf.mesh.grid((length, width), cells=(cells, 1), origin=low)
    shell = b.add_shell(plate, thickness=height, material=material, name="shell")
    b.clamp(shell.edge("x-"), slots="position+director")
    b.add_probe("shell", shell.edge("x+"))

    low[2] = -0.5 * height
    for element in ("ENMC", "H3843", "T10"):
        low[1] += width + gap
        plain = element == "T10"
        along = 2 * cells if plain else cells
        mesh = wf.mesh.box((length, width, height), cells=(along, 1, 1), element=element, origin=low)
        solid = b.add_solid(mesh, material=material, element=element, name=element)
        b.clamp(solid.nodes("x-"), slots="position" if plain else "position+gradient-y+gradient-z")
        b.add_probe(element, solid.surface("x+"))
    return b
