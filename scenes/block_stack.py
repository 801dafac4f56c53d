"""Soft blocks that come to rest on each other."""

import math

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=4e-3, t_end=0.4, tol=1e-6, fps=60.0, speed=0.25, picture=0.39)
def block_stack(
    *,
    blocks: int = 4,
    side: float = 0.1,
    turn: float = 12.0,
    gap: float = 0.002,
    cells: int = 1,
    mu: float = 0.5,
    restitution: float = 0.2,
    stiffness: float = 10.0,
    E: float = 1e6,
    nu: float = 0.3,
    density: float = 1000.0,
) -> wf.ModelBuilder:
    """Blocks with gaps fall onto a slab, and form a stack held by friction.

    Each is rotated against the one below: non-matching meshes.

    Args:
        blocks: in the stack.
        side: of a block, a cube, m.
        turn: of each block about the vertical against the one below, degrees.
        gap: between blocks at the start, m.
        cells: along each edge of a block.
        mu: coefficient of friction.
        restitution: of an impact.
        stiffness: of the contacts, over that of the default law.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    material = wf.SVK(E=E, nu=nu, density=density)
    width = 1.6 * side
    slab = wf.mesh.box((width, width, 0.3 * side), cells=(2, 2, 1), origin=(-0.5 * width, -0.5 * width, -0.3 * side))
    below = b.add_solid(slab, material=material, name="slab")
    b.clamp(below.nodes("z-"))
    mesh = wf.mesh.box((side, side, side), cells=(cells,) * 3, origin=(-0.5 * side, -0.5 * side, 0.0))
    for k in range(blocks):
        angle = math.radians((k + 1) * turn)
        c, s = math.cos(angle), math.sin(angle)
        place = (np.array([(c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)]), np.array((0.0, 0.0, k * side + (k + 1) * gap)))
        block = b.add_solid(mesh, material=material, transform=place, name=f"block {k + 1}")
        faces = (block.surface("z-"), below.surface("z+"))
        b.add_contact(*faces, mu=mu, restitution=restitution, stiffness=("region", stiffness), name=f"joint {k + 1}")
        below = block
    b.add_probe("top", below.at((0.0, 0.0, blocks * (side + gap))))
    return b
