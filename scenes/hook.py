"""A hook of soft rubber, pulled by a sling and let go."""

import pathlib

import warpfea as wf
from warpfea.builder.scene import scene

MESH = pathlib.Path(__file__).with_name("hook.msh")


@scene(dt=1.0 / 240.0, t_end=0.26, integrator="bdf2", tol=1e-3, fps=240.0, speed=0.1, picture=0.15)
def hook(
    *,
    pull: float = 900.0,
    hold: float = 0.11,
    E: float = 1.5e5,
    nu: float = 0.33,
    density: float = 1070.0,
    quadrature: str = "tet4",
) -> wf.ModelBuilder:
    """A crane hook of soft rubber, from a Gmsh mesh, is pulled down by a sling, opens and springs back.

    The mesh (hook.msh, made from the hook.geo beside it) has 3119 T10 elements, straight and curved, and the groups
    "fixed", the top of the shank, and "pull", the saddle where the sling lies. The pull grows, is held, and is released
    within 0.01 s; gravity acts all the time. The animation is in slow motion, at 240 frames per second of the motion.

    Args:
        pull: largest traction of the sling on its saddle (5.6e-4 m^2), Pa.
        hold: time at which the sling is let go, s.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        quadrature: force rule; tet8 costs more and moves the tip at the end by 0.1 percent.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    body = b.add_solid(MESH, material=wf.SVK(E=E, nu=nu, density=density), quadrature=quadrature)
    b.clamp(body.nodes("fixed"))
    down = (0.0, 0.0, -pull)
    rise = 0.5 * hold
    times = [0.0, rise, hold, hold + 0.01, hold + 0.02]
    b.add_traction(body.surface("pull"), (times, [(0, 0, 0), down, down, (0, 0, 0), (0, 0, 0)]))
    b.add_probe("saddle", body.surface("pull"))
    b.add_probe("tip", body.nodes(lambda X: (X[:, 0] > 0.03) & (X[:, 2] > 0.065)))
    return b
