"""A plate on four rods, turned back and forth at its hub."""

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=8e-3, t_end=1.2, integrator="bdf2", tol=1e-4, fps=120.0, speed=0.3, picture=0.51)
def hung_plate(
    *,
    size: float = 0.5,
    thickness: float = 0.01,
    cells: int = 6,
    rod: float = 0.5,
    hub: float = 0.1,
    turn: float = 1.0,
    period: float = 1.0,
    E: float = 1e7,
    nu: float = 0.3,
    density: float = 1000.0,
    eta: float = 1e3,
) -> wf.ModelBuilder:
    """A square plate of 3443 shells hangs by its corners on four rods and is turned back and forth at its middle.

    The rods are distance joints to the ground above the corners; they are not drawn. A driven revolute joint holds the
    hub at its height: as the plate turns, the rods slant and lift the corners. The hub is all nodes within its radius,
    so that the joint drives the rotation of the plate there, and not the shear of a single node.

    Args:
        size: length of the sides, m.
        thickness: m.
        cells: along each side; an even number.
        rod: length of the rods, m.
        hub: its radius, m.
        turn: largest angle of the hub, rad.
        period: in which it turns there and back, s.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        eta: shear viscosity (Kelvin-Voigt), Pa s.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    half = 0.5 * size
    mesh = wf.mesh.grid((size, size), cells=(cells, cells), origin=(-half, -half, 0.0))
    law = wf.SVK(E=E, nu=nu, density=density, damping=wf.KelvinVoigt(eta=eta) if eta else None)
    plate = b.add_shell(mesh, thickness=thickness, material=law, name="plate")
    for k, (x, y) in enumerate(((-half, -half), (half, -half), (half, half), (-half, half))):
        corner = plate.at((x, y, 0.0))
        b.add_joint("distance", parent=wf.GROUND, child=corner, anchor=(x, y, rod), name=f"rod {k + 1}")
    times = np.linspace(0.0, 10.0 * period, 4001)
    angle = 0.5 * turn * (1.0 - np.cos(2.0 * np.pi * times / period))
    middle = plate.nodes(lambda X: np.hypot(X[:, 0], X[:, 1]) < hub)
    b.add_joint("revolute", parent=wf.GROUND, child=middle, axis=(0, 0, 1), drive=(times, angle), name="hub")
    b.add_probe("corner", plate.at((half, half, 0.0)))
    b.add_probe("side", plate.at((half, 0.0, 0.0)))
    return b
