"""A bar that falls across the teeth of a comb."""

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=4e-3, t_end=0.4, tol=1e-6, fps=60.0, speed=0.25, picture=0.39)
def comb(
    *,
    teeth: int = 5,
    pitch: float = 0.04,
    length: float = 0.15,
    side: float = 0.01,
    elements: int = 3,
    reach: float = 0.12,
    drop: float = 0.0005,
    mu: float = 0.3,
    E: float = 5e7,
    nu: float = 0.3,
    density: float = 1200.0,
) -> wf.ModelBuilder:
    """A stiff bar falls across slender teeth, each clamped at its root, which share its weight and bend as cantilevers.

    Args:
        teeth: number of beams side by side.
        pitch: distance of two teeth, m.
        length: of a tooth, m.
        side: of a tooth's square section, m; the bar's is twice as wide.
        elements: of a tooth.
        reach: distance of the bar's axis from the roots, m.
        drop: height of the bar over the teeth at the start, m.
        mu: coefficient of friction.
        E: Young's modulus of the teeth (SVK), Pa; the bar's is a hundred times as large.
        nu: Poisson's ratio.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    material = wf.SVK(E=E, nu=nu, density=density, damping=wf.KelvinVoigt(eta=5e-3 * E))
    half, top = 0.5 * teeth * pitch, 0.5 * side + drop
    ends = [(reach, -half, top + side), (reach, half, top + side)]
    bar = b.add_beam(
        ends, elements=2, section=wf.Rectangle(2.0 * side, 2.0 * side), normal=(0, 0, 1),
        material=wf.SVK(E=100.0 * E, nu=nu, density=density), name="bar",
    )  # fmt: skip
    for k, y in enumerate(pitch * (np.arange(teeth) - 0.5 * (teeth - 1))):
        tooth = b.add_beam(
            [(0.0, y, 0.0), (length, y, 0.0)], elements=elements, section=wf.Rectangle(side, side), normal=(0, 0, 1),
            material=material, name=f"tooth {k + 1}",
        )  # fmt: skip
        b.clamp(tooth.start)
        b.add_contact(bar, tooth, mu=mu, name=f"on tooth {k + 1}")
        b.add_probe(f"tip {k + 1}", tooth.end)
    b.add_probe("bar", bar.at((reach, 0.0, top + side)))
    return b
