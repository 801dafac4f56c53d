"""An arch of blocks that stands by friction."""

import math
from typing import Any

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=1e-2, t_end=0.6, tol=1e-6, fps=50.0, speed=0.5, picture=0.59)
def arch(
    *,
    blocks: int = 9,
    radius: float = 1.0,
    thickness: float = 0.15,
    depth: float = 0.2,
    mu: float = 0.6,
    ramp: float = 0.4,
    stiffness: float = 10.0,
    E: float = 1e8,
    nu: float = 0.2,
    density: float = 2000.0,
) -> wf.ModelBuilder:
    """A half circle of blocks without mortar carries itself while its gravity grows.

    With nine blocks and a thickness of 0.15 of the radius it needs a friction of 0.334 (limit analysis); below that a
    joint slides.

    Args:
        blocks: of the arch.
        radius: of its middle line, m.
        thickness: of the blocks along the radius, m.
        depth: of the blocks across, m.
        mu: coefficient of friction, in joints and on the ground.
        ramp: time in which gravity comes on, s.
        stiffness: of the contacts, over that of the default law.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=([0.0, ramp, 2.0 * ramp], [(0.0, 0.0, 0.0), (0.0, 0.0, -9.81), (0.0, 0.0, -9.81)]))
    material = wf.SVK(E=E, nu=nu, density=density)
    ground = b.add_collider(wf.HalfSpace(normal=(0, 0, 1)), name="ground")
    contact_options: dict[str, Any] = {"mu": mu, "restitution": 0.1, "stiffness": ("region", stiffness)}
    block_angle = math.pi / blocks

    def polar_map(X: np.ndarray) -> np.ndarray:
        """From (angle, depth, radius), angles from the left foot; sides stay planes."""
        return np.column_stack([-X[:, 2] * np.cos(X[:, 0]), X[:, 1], X[:, 2] * np.sin(X[:, 0])])

    previous: wf.Body | None = None
    for k in range(blocks):
        origin = (k * block_angle, -0.5 * depth, radius - 0.5 * thickness)
        mesh = wf.mesh.box((block_angle, depth, thickness), cells=(2, 1, 1), origin=origin, map=polar_map)
        block = b.add_solid(mesh, material=material, name=f"block {k + 1}")
        if previous is None:
            b.add_contact(block.surface("x-"), ground, name="left foot", **contact_options)
        else:
            b.add_contact(previous.surface("x+"), block.surface("x-"), name=f"joint {k}", **contact_options)
        previous = block
    b.add_contact(block.surface("x+"), ground, name="right foot", **contact_options)
    middle = b.bodies[blocks // 2]
    angle = 0.5 * math.pi if blocks % 2 else 0.5 * math.pi + 0.5 * block_angle
    b.add_probe("crown", middle.at(polar_map(np.array([(angle, 0.0, radius)]))[0]))
    return b
