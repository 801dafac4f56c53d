"""A belt that starts moving under a block."""

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=2.5e-3, t_end=0.6, tol=1e-8, fps=100.0, speed=0.5, picture=0.5)
def belt(
    *,
    mu: float = 0.3,
    speed: float = 0.6,
    start: float = 0.1,
    side: float = 0.1,
    height: float = 0.05,
    cells: int = 2,
    E: float = 1e6,
    nu: float = 0.3,
    density: float = 1000.0,
) -> wf.ModelBuilder:
    """A belt starts under a block at rest; friction mu m g drags the block until it moves with the belt.

    Its final lag behind the belt is speed^2 / (2 mu g).

    Args:
        mu: coefficient of friction.
        speed: of the belt from its start on, m/s.
        start: time at which it starts, s.
        side: of the block's square base, m.
        height: of the block, m.
        cells: across the base; half as many over the height.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    low = (-0.5 * side, -0.5 * side, 0.0)
    mesh = wf.mesh.box((side, side, height), cells=(cells, cells, max(1, cells // 2)), origin=low)
    block = b.add_solid(mesh, material=wf.SVK(E=E, nu=nu, density=density), name="block")
    shape = wf.Box(center=(0.0, 0.0, -0.01), size=(8.0 * side, 2.0 * side, 0.02))
    path = ([0.0, start, start + 10.0], [(0, 0, 0), (0, 0, 0), (10.0 * speed, 0, 0)])
    moving = b.add_collider(shape, path=path, name="belt")
    b.add_contact(block.surface("z-"), moving, mu=mu, restitution=0.3, stiffness="region", name="base")
    b.add_probe("middle", block.at((0.0, 0.0, 0.5 * height)))
    return b
