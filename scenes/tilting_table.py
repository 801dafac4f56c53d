"""A block on a table that is tilted until it slips."""

import math

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=1e-2, t_end=2.3, integrator="bdf2", tol=1e-8, fps=50.0, speed=1.0, picture=2.2)
def tilting_table(
    *,
    mu: float = 0.3,
    rate: float = 10.0,
    side: float = 0.1,
    height: float = 0.05,
    E: float = 1e6,
    nu: float = 0.3,
    density: float = 1000.0,
    cells: int = 2,
) -> wf.ModelBuilder:
    """A soft block rests on a table rotating about the y axis, and slips at tan(angle) = mu.

    Args:
        mu: coefficient of friction.
        rate: at which the table tilts, degrees/s.
        side: of the block's square base, m.
        height: of the block, m.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        cells: across the base; half as many over the height.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    mesh = wf.mesh.box((side, side, height), cells=(cells, cells, max(1, cells // 2)), origin=(0.0, -0.5 * side, 0.0))
    block = b.add_solid(mesh, material=wf.SVK(E=E, nu=nu, density=density), name="block")
    turn = wf.Rotation(anchor=(0, 0, 0), axis=(0, 1, 0), angle=([0.0, 10.0], [0.0, math.radians(10.0 * rate)]))
    table = b.add_collider(wf.HalfSpace(normal=(0, 0, 1)), path=turn, name="table")
    b.add_contact(block.surface("z-"), table, mu=mu, restitution=0.3, stiffness="region", name="base")
    b.add_probe("middle", block.at((0.5 * side, 0.0, 0.5 * height)))
    return b
