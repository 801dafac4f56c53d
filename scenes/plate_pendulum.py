"""A soft plate that swings from a corner."""

from typing import Literal

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=5e-3, t_end=0.9, integrator="bdf2", tol=1e-4, speed=0.3, picture=0.8)
def plate_pendulum(
    *,
    size: float = 0.5,
    thickness: float = 0.01,
    cells: int = 6,
    E: float = 4e6,
    nu: float = 0.3,
    density: float = 1000.0,
    integration: Literal["tied", "full"] = "tied",
) -> wf.ModelBuilder:
    """A square plate of 3443 shells, pinned at one corner and let go from the horizontal, folds as it falls.

    Only the position of the corner node is clamped, so the plate rotates freely there.

    Args:
        size: length of the sides, m.
        thickness: m.
        cells: along each side.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        integration: tied (without locking) or full.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    mesh, law = wf.mesh.grid((size, size), cells=(cells, cells)), wf.SVK(E=E, nu=nu, density=density)
    plate = b.add_shell(mesh, thickness=thickness, material=law, integration=integration, name="plate")
    b.clamp(plate.nodes(lambda X: X[:, 0] + X[:, 1] < 1e-9), slots="position")
    b.add_probe("tip", plate.at((size, size, 0)))
    b.add_probe("side", plate.at((size, 0, 0)))
    return b
