"""A ball that bounces on a floor."""

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=5e-4, t_end=0.6, integrator="bdf2", tol=1e-6, fps=100.0, speed=0.25, picture=0.45)
def bouncing_ball(
    *,
    restitution: float = 0.8,
    drop: float = 0.2,
    radius: float = 0.05,
    cells: int = 4,
    E: float = 1e8,
    nu: float = 0.3,
    density: float = 1100.0,
    stiffness: float = 0.02,
) -> wf.ModelBuilder:
    """A ball falls on a floor and rebounds to restitution^2 of its initial height.

    Contact is lumped (`model="sphere"`) and softer than the ball, so that little energy is lost to vibrations.

    Args:
        restitution: speed after the impact over that before.
        drop: height of the ball's lowest point at the start, m.
        radius: m.
        cells: elements across the diameter, even.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        stiffness: of the contact, over Hertz's.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    mesh = wf.mesh.sphere(radius, cells=cells, center=(0.0, 0.0, drop + radius))
    ball = b.add_solid(mesh, material=wf.SVK(E=E, nu=nu, density=density), name="ball")
    floor = b.add_collider(wf.HalfSpace(normal=(0, 0, 1)), name="floor")
    b.add_contact(
        ball, floor, model="sphere", radius=radius, restitution=restitution, stiffness=stiffness, name="impact"
    )
    b.add_probe("centre", ball.at((0.0, 0.0, drop + radius)))
    return b
