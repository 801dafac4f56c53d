"""The scenes of the table pair_cost: piles of cubes, layers in part one over the other, small worlds.

All of neo-Hookean rubber, nu = 0.4, 1000 kg/m^3, cells of six tetrahedra around the diagonal.
"""

from __future__ import annotations

import numpy as np

import warpfea as wf
from warpfea import mesh as meshes

__all__ = ["CUBES", "SIDE", "blocks", "finger", "layers", "pile", "resting"]

CUBES, SIDE, GAP = 10, 0.2, 0.01
SHIFT = (0.003, 0.002)
"""m, by which each cube of a pile stands beside the one below."""
MU = 0.5
FINGER = (0.12, 0.02, 0.02)
PRESSURE = 2e3


def rubber(E: float) -> wf.NeoHookean:
    """The law of all scenes."""
    return wf.NeoHookean.from_E_nu(E=E, nu=0.4, density=1000.0)


def pile(
    cells: int, element: str = "T4", *, cubes: int = CUBES, E: float = 1e6, gap: float = GAP, stiffness: float = 1.0
) -> wf.ModelBuilder:  # fmt: skip
    """Cubes of cells^3 over each other, with gaps between them and over the ground."""
    b = wf.ModelBuilder()
    below = None
    for k in range(cubes):
        low = (SHIFT[0] * k, SHIFT[1] * k, gap + (SIDE + gap) * k)
        mesh = meshes.box((SIDE,) * 3, cells=(cells,) * 3, element=element, origin=low)
        cube = b.add_solid(mesh, material=rubber(E), element=element, name=f"cube {k}")
        if below is None:
            ground = b.add_collider(wf.HalfSpace((0, 0, 1), 0.0))
            b.add_contact(cube.surface("z-"), ground, mu=MU, stiffness=stiffness)
        else:
            b.add_contact(cube.surface("z-"), below.surface("z+"), mu=MU, stiffness=stiffness)
        below = cube
    return b


def resting(cubes: int, cells: int, element: str, E: float) -> wf.ModelBuilder:
    """The same in exact touch, on a clamped plate."""
    b = wf.ModelBuilder()
    plate = meshes.box((2 * SIDE, 2 * SIDE, 0.1), cells=(2, 2, 1), element=element, origin=(-SIDE, -SIDE, -0.1))
    below = b.add_solid(plate, material=rubber(E), element=element, name="plate")
    b.clamp(below.nodes("z-"))
    for k in range(cubes):
        low = (SHIFT[0] * k - 0.5 * SIDE, SHIFT[1] * k - 0.5 * SIDE, SIDE * k)
        mesh = meshes.box((SIDE,) * 3, cells=(cells,) * 3, element=element, origin=low)
        cube = b.add_solid(mesh, material=rubber(E), element=element, name=f"cube {k}")
        b.add_contact(cube.surface("z-"), below.surface("z+"), mu=MU)
        below = cube
    return b


def layers(facets: int, touching: float = 0.1) -> wf.ModelBuilder:
    """Two layers of T4, one cell thick, with so many facets on the faces between them, of which a part touches."""
    across = max(2, round(np.sqrt(facets / 4.0)))
    size = 0.01 * across
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bodies = []
    for k in range(2):
        low = (k * (1.0 - touching) * size + 0.3e-2 * k, 0.0, 0.01 * k)
        mesh = meshes.box((size, size, 0.01), cells=(across, across, 1), element="T4", origin=low)
        bodies.append(b.add_solid(mesh, material=rubber(1e6), element="T4", name=f"layer {k}"))
    b.clamp(bodies[0].nodes("z-"))
    b.add_contact(bodies[1].surface("z-"), bodies[0].surface("z+"), mu=MU, overlap="offset")
    return b


def blocks() -> wf.ModelBuilder:
    """Two cubes of 2^3 cells of T4 that fall on the ground and each other."""
    return pile(2, cubes=2)


def finger() -> wf.ModelBuilder:
    """A soft finger of T10, clamped at one end, pressed down on a block on the ground."""
    b = wf.ModelBuilder()
    arm = meshes.box(FINGER, cells=(4, 1, 1), origin=(-FINGER[0], -0.5 * FINGER[1], 0.04))
    soft = b.add_solid(arm, material=rubber(1e6), element="T10", name="finger")
    b.clamp(soft.nodes("x-"))
    b.add_traction(soft.surface("z+"), (0.0, 0.0, -PRESSURE))
    cube = meshes.box((0.04,) * 3, cells=(1, 1, 1), origin=(-0.04, -0.02, 0.0))
    block = b.add_solid(cube, material=rubber(1e6), element="T10", name="block")
    b.add_contact(block.surface("z-"), b.add_collider(wf.HalfSpace((0, 0, 1), 0.0)), mu=MU)
    b.add_contact(soft.surface("z-"), block.surface("z+"), mu=MU)
    return b
