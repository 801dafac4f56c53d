"""A rubber bar whose end is turned."""

import math

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=1.0 / 60.0, t_end=1.1, tol=1e-6, speed=0.5)
def twist(
    *,
    length: float = 0.3,
    width: float = 0.06,
    cells: int = 12,
    across: int = 2,
    turns: float = 1.0,
    duration: float = 1.0,
    mu10: float = 3e5,
    mu01: float = 1e5,
    k: float = 1e7,
    density: float = 1000.0,
) -> wf.ModelBuilder:
    """A square Mooney-Rivlin bar is twisted: one end is clamped, the other driven about the bar's axis.

    The axis is x; the driven end keeps its distance, so the bar also comes under tension.

    Args:
        length: of the bar, m.
        width: of its square section, m.
        cells: along the length.
        across: cells along each side of the section.
        turns: of the driven end; 1 is 360 degrees.
        duration: in which the end is turned, s; then it is held.
        mu10: Mooney-Rivlin coefficient, Pa.
        mu01: Mooney-Rivlin coefficient, Pa.
        k: bulk modulus, Pa.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    half = 0.5 * width
    mesh = wf.mesh.box((length, width, width), cells=(cells, across, across), origin=(0.0, -half, -half), name="bar")
    bar = b.add_solid(mesh, material=wf.MooneyRivlin(mu10=mu10, mu01=mu01, k=k, density=density))
    b.clamp(bar.nodes("x-"))
    end = 2.0 * math.pi * turns
    angle = ([0.0, duration, 2.0 * duration], [0.0, end, end])  # then held
    b.drive(bar.nodes("x+"), rotation=wf.Rotation(anchor=(length, 0, 0), axis=(1, 0, 0), angle=angle))
    b.add_probe("corner", bar.at((length, half, half)))
    b.add_probe("middle", bar.at((0.5 * length, half, half)))
    return b
