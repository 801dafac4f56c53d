"""A soft ball that bounces on a plate."""

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=2e-3, t_end=0.3, tol=1e-6, fps=100.0, speed=0.25, picture=0.11)
def ball_on_plate(
    *,
    radius: float = 0.05,
    drop: float = 0.03,
    width: float = 0.3,
    thickness: float = 0.01,
    cells: int = 2,
    across: int = 4,
    mu: float = 0.4,
    restitution: float = 0.8,
    stiffness: float = 10.0,
    E: float = 2e5,
    nu: float = 0.4,
    density: float = 1000.0,
    plate_E: float = 5e6,
) -> wf.ModelBuilder:
    """A soft ball falls on a plate that is clamped at its sides; both bend and spread, and it rebounds.

    Args:
        radius: of the ball, m.
        drop: height of its lowest point at the start, m.
        width: of the plate, a square, m.
        thickness: of the plate, m.
        cells: across the ball, even.
        across: cells of the plate along each side.
        mu: coefficient of friction.
        restitution: of the contact; vibrations dissipate further energy.
        stiffness: of the contact, over that of the default law.
        E: Young's modulus of the ball (neo-Hookean), Pa.
        nu: Poisson's ratio of both.
        density: of both, kg/m^3.
        plate_E: Young's modulus of the plate (SVK), Pa.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    origin = (-0.5 * width, -0.5 * width, -thickness)
    mesh = wf.mesh.box((width, width, thickness), cells=(across, across, 1), origin=origin)
    plate = b.add_solid(mesh, material=wf.SVK(E=plate_E, nu=nu, density=density), name="plate")
    for side in ("x-", "x+", "y-", "y+"):
        b.clamp(plate.nodes(side))
    top = (0.0, 0.0, drop + radius)
    mesh = wf.mesh.sphere(radius, cells=cells, center=top)
    ball = b.add_solid(mesh, material=wf.NeoHookean.from_E_nu(E=E, nu=nu, density=density), name="ball")
    b.add_contact(
        ball, plate.surface("z+"), mu=mu, restitution=restitution, stiffness=("region", stiffness), name="impact"
    )
    b.add_probe("ball", ball.at(top))
    b.add_probe("plate", plate.at((0.0, 0.0, 0.0)))
    return b
