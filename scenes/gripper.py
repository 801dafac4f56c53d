"""A gripper that lifts a soft block by friction."""

from typing import Any

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=5e-3, t_end=1.0, tol=1e-6, fps=60.0, speed=0.5, picture=0.9)
def gripper(
    *,
    mu: float = 0.6,
    squeeze: float = 0.006,
    lift: float = 0.08,
    side: float = 0.06,
    cells: int = 3,
    element: str = "T10",
    E: float = 1e5,
    nu: float = 0.4,
    density: float = 1000.0,
) -> wf.ModelBuilder:
    """Two jaws close on a soft block, hold it by friction and lift it off the floor.

    They close in 0.3 s, and lift from 0.4 s to 0.8 s.

    Args:
        mu: coefficient of friction of the jaws.
        squeeze: by which the jaws are closer than the block is wide, m.
        lift: of the jaws, m.
        side: of the block, a cube, m.
        cells: along each edge of the block.
        element: "T10" or "T4".
        E: Young's modulus (neo-Hookean), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    half = 0.5 * side
    mesh = wf.mesh.box((side,) * 3, cells=(cells,) * 3, origin=(-half, -half, 0.0), element=element)
    material = wf.NeoHookean.from_E_nu(E=E, nu=nu, density=density)
    block = b.add_solid(mesh, material=material, name="block")
    floor = b.add_collider(wf.HalfSpace(normal=(0, 0, 1)), name="floor")
    options: dict[str, Any] = {"restitution": 0.3, "stiffness": "region"}
    b.add_contact(block.surface("z-"), floor, mu=0.3, name="base", **options)
    apart, thick = 0.01, 0.02  # of jaws and block at the start; of a jaw, m
    for name, sign in (("left", -1.0), ("right", 1.0)):
        # the jaws reach beyond the block's top: edges pressing into its side would lift it without friction
        center = (sign * (half + apart + 0.5 * thick), 0.0, 0.65 * side)
        close = -sign * (apart + 0.5 * squeeze)
        path = [(0, 0, 0), (close, 0, 0), (close, 0, 0), (close, 0, lift), (close, 0, lift)]
        plate = wf.Box(center, size=(thick, 0.8 * side, 1.1 * side))
        jaw = b.add_collider(plate, path=([0.0, 0.3, 0.4, 0.8, 2.0], path), name=f"{name} jaw")
        b.add_contact(block.surface("x-" if sign < 0.0 else "x+"), jaw, mu=mu, name=f"{name} grip", **options)
    b.add_probe("middle", block.at((0.0, 0.0, half)))
    return b
