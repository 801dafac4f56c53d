"""The same bar, made of five families of elements, side by side."""

from __future__ import annotations

import warpfea as wf
from warpfea.scene import scene


@scene(dt=5e-3, t_end=0.6, integrator="bdf2", tol=1e-4, fps=120.0, speed=0.2, picture=0.25)
def mixed(
    *,
    length: float = 0.5,
    width: float = 0.06,
    height: float = 0.02,
    gap: float = 0.06,
    cells: int = 8,
    E: float = 2e7,
    nu: float = 0.3,
    density: float = 1000.0,
) -> wf.ModelBuilder:
    """Five cantilevers of one size and material bend under gravity: beam 3243, shell 3443, ENMC, H3843 and T10.

    All are bodies of one model, built in at x = 0 and let go at t = 0; their tips (a probe each) move together. Joints
    that connect bodies come with the constraints of a later version.

    Args:
        length: of the bars, m.
        width: of their section, m.
        height: of their section, along gravity, m.
        gap: between two bars, m.
        cells: along the length; of the solids each is one hexahedron or six tetrahedra.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    material = wf.SVK(E=E, nu=nu, density=density)
    step = width + gap
    half = 0.5 * width

    beam = b.add_beam(
        [(0, 0, 0), (length, 0, 0)],
        elements=cells,
        section=wf.Rectangle(width, height),
        normal=(0, 0, 1),
        material=material,
        name="beam",
    )
    b.clamp(beam.start, slots="position+section")
    b.add_probe("beam", beam.end)

    strip = wf.mesh.grid((length, width), cells=(cells, 1), origin=(0, step - half, 0))
    shell = b.add_shell(strip, thickness=height, material=material, name="shell")
    b.clamp(shell.edge("x-"), slots="position+director")
    b.add_probe("shell", shell.edge("x+"))

    for k, element in enumerate(("ENMC", "H3843", "T10"), start=2):
        low = (0.0, k * step - half, -0.5 * height)
        mesh = wf.mesh.box((length, width, height), cells=(cells, 1, 1), element=element, origin=low)
        solid = b.add_solid(mesh, material=material, element=element, name=element)
        b.clamp(solid.nodes("x-"), slots="position")
        b.add_probe(element, solid.surface("x+"))
    return b
