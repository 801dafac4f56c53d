"""A clamped bar that bends under its own weight."""

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=2.5e-3, t_end=0.5, integrator="bdf2", fps=120.0, speed=0.2, picture=0.2)
def cantilever(
    *,
    length: float = 1.0,
    width: float = 0.1,
    thickness: float = 0.03,
    cells: int = 10,
    E: float = 7e8,
    nu: float = 0.33,
    density: float = 2700.0,
    element: str = "T10",
) -> wf.ModelBuilder:
    """A T10 cantilever, let go at t = 0, bends under gravity.

    The bar lies along x and is clamped at x = 0. Linear beam theory gives a static tip deflection of
    3 density g length^4 / (2 E thickness^2) and a period of 1.787 length^2 sqrt(12 density / (E thickness^2)).

    Args:
        length: of the bar, m.
        width: of its section, m.
        thickness: of its section, along gravity, m.
        cells: along the length; each is cut into tetrahedra.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        element: T10 or T4 (which is far too stiff in bending).
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    mesh = wf.mesh.box((length, width, thickness), cells=(cells, 1, 1), element=element, name="bar")
    bar = b.add_solid(mesh, material=wf.SVK(E=E, nu=nu, density=density))
    b.clamp(bar.nodes("x-"))
    b.add_probe("tip", bar.surface("x+"))
    return b
