"""A soft block that slides over a floor of bricks."""

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=4e-3, t_end=0.6, tol=1e-8, fps=60.0, speed=0.25, picture=0.4)
def brick_floor(
    *,
    bricks: int = 20,
    brick: float = 0.05,
    joint: float = 0.002,
    side: float = 0.06,
    speed: float = 1.5,
    cells: int = 2,
    mu: float = 0.0,
    E: float = 1e6,
    nu: float = 0.3,
    density: float = 1000.0,
) -> wf.ModelBuilder:
    """A soft block slides over level bricks with joints between them as over one floor, without a jolt.

    Args:
        bricks: boxes in a row.
        brick: length of a brick, m.
        joint: width of the gap between two bricks, m.
        side: of the block, a cube, m.
        speed: of the block at the start, m/s.
        cells: along each edge of the block.
        mu: coefficient of friction.
        E: Young's modulus of the block (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    mesh = wf.mesh.box((side,) * 3, cells=(cells,) * 3, origin=(0.0, -0.5 * side, 0.0))
    damping = wf.KelvinVoigt(eta=2e-3 * E)
    block = b.add_solid(mesh, material=wf.SVK(E=E, nu=nu, density=density, damping=damping), name="block")
    b.set_initial(block, velocity=(speed, 0.0, 0.0))
    for k in range(bricks):
        center = (k * (brick + joint) + 0.25 * side, 0.0, -0.25 * brick)
        box = b.add_collider(wf.Box(center, (brick, 2.0 * side, 0.5 * brick)), name=f"brick {k + 1}")
        b.add_contact(block, box, mu=mu, name=f"on brick {k + 1}")
    b.add_probe("block", block.at((0.5 * side, 0.0, 0.5 * side)))
    for name in ("x-", "x+"):
        b.add_probe(name, block.surface(name))
    return b
