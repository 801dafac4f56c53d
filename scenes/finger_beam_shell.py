"""A soft finger that pushes a beam off a shell."""

from typing import Any

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=4e-3, t_end=0.44, tol=1e-6, fps=100.0, speed=0.25, picture=0.22)
def finger_beam_shell(
    *,
    travel: float = 0.08,
    duration: float = 0.5,
    mu: float = 0.3,
    stiffness: float = 10.0,
    finger_E: float = 2e5,
    beam_E: float = 1e7,
    shell_E: float = 1e8,
    density: float = 1000.0,
) -> wf.ModelBuilder:
    """A finger of soft T10 hangs from a carriage, pushes a beam over a shell, bends, and drops it over the edge.

    The shell is clamped along one side.

    Args:
        travel: of the carriage, m.
        duration: of its way, s.
        mu: coefficient of friction.
        stiffness: of the contacts, over that of the default law.
        finger_E: Young's modulus of the finger (neo-Hookean), Pa.
        beam_E: of the beam (SVK), Pa.
        shell_E: of the shell (SVK), Pa.
        density: of all, kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    thickness, height = 0.004, 0.02
    grid = wf.mesh.grid((0.1, 0.16), cells=(4, 4), origin=(-0.05, -0.08, -0.5 * thickness))
    shell = b.add_shell(grid, thickness=thickness, material=wf.SVK(E=shell_E, nu=0.3, density=density), name="shell")
    b.clamp(shell.nodes("x-"))
    beam = b.add_beam(
        [(0.02, -0.06, 0.5 * height), (0.02, 0.06, 0.5 * height)], elements=4, section=wf.Rectangle(height, height),
        normal=(0, 0, 1), material=wf.SVK(E=beam_E, nu=0.3, density=density), name="beam",
    )  # fmt: skip
    mesh = wf.mesh.box((0.015, 0.03, 0.06), cells=(1, 2, 3), origin=(-0.01, -0.015, 0.004))
    finger = b.add_solid(mesh, material=wf.NeoHookean.from_E_nu(E=finger_E, nu=0.4, density=density), name="finger")
    way = ([0.0, 0.1, duration, 2.0], [(0, 0, 0), (0, 0, 0), (travel, 0, 0), (travel, 0, 0)])
    b.drive(finger.nodes("z+"), displacement=way)
    options: dict[str, Any] = {"mu": mu, "restitution": 0.3, "stiffness": ("region", stiffness)}
    b.add_contact(beam, shell.surface("top"), name="table", **options)
    b.add_contact(finger.surface("x+"), beam, name="push", **options)
    b.add_probe("beam", beam.at((0.02, 0.0, 0.5 * height)))
    b.add_probe("fingertip", finger.at((0.0, 0.0, 0.004)))
    return b
