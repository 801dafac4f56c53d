"""Layers of crossed beams that carry a block."""

from typing import Any

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=4e-3, t_end=0.32, tol=1e-6, fps=60.0, speed=0.25, picture=0.31)
def crossed_beams(
    *,
    layers: int = 2,
    beams: int = 3,
    span: float = 0.3,
    side: float = 0.02,
    elements: int = 4,
    block: float = 0.14,
    gap: float = 0.0002,
    mu: float = 0.3,
    E: float = 2e7,
    nu: float = 0.3,
    density: float = 1200.0,
) -> wf.ModelBuilder:
    """Beams lie on two sleepers and carry crossed ones, which carry a block; all bend.

    At each crossing two bars touch that are narrower than each other's elements.

    Args:
        layers: of beams.
        beams: in a layer.
        span: length of a beam, m.
        side: of a beam's square section, m.
        elements: of a beam.
        block: side of the block, a quarter as high, m.
        gap: between layers at the start, m.
        mu: coefficient of friction.
        E: Young's modulus of the beams (SVK), Pa.
        nu: Poisson's ratio.
        density: of all, kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    damping = wf.KelvinVoigt(eta=5e-3 * E)
    material = wf.SVK(E=E, nu=nu, density=density, damping=damping)
    at = np.linspace(-0.2 * span, 0.2 * span, beams)
    below: list[Any] = [
        b.add_collider(wf.Box((sign * 0.45 * span, 0.0, -side), (side, 1.1 * span, 2 * side)), name=f"sleeper {k + 1}")
        for k, sign in enumerate((-1.0, 1.0))
    ]
    for layer in range(layers):
        along = layer % 2
        here = []
        for k, across in enumerate(at):
            ends = np.zeros((2, 3))
            ends[:, along], ends[:, 1 - along] = (-0.5 * span, 0.5 * span), across
            ends[:, 2] = (layer + 0.5) * side + (layer + 1) * gap
            beam = b.add_beam(
                ends, elements=elements, section=wf.Rectangle(side, side), normal=(0, 0, 1), material=material,
                name=f"beam {layer + 1}.{k + 1}",
            )  # fmt: skip
            here.append(beam)
            for n, other in enumerate(below):
                b.add_contact(beam, other, mu=mu, name=f"crossing {layer + 1}.{k + 1}.{n + 1}")
        below = here
    low = layers * side + (layers + 1) * gap
    mesh = wf.mesh.box((block, block, 0.25 * block), cells=(2, 2, 1), origin=(-0.5 * block, -0.5 * block, low))
    load = b.add_solid(mesh, material=wf.SVK(E=0.1 * E, nu=nu, density=density, damping=damping), name="block")
    for k, top in enumerate(below):
        b.add_contact(load, top, mu=mu, name=f"load {k + 1}")
    b.add_probe("block", load.at((0.0, 0.0, low)))
    return b
