"""A spinning top."""

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=5e-4, t_end=2.0, integrator="energy_momentum", tol=1e-8, fps=60.0, speed=0.5, picture=0.8)
def top(
    *, radius: float = 0.1, height: float = 0.15, rate: float = 150.0, tilt: float = 0.35, density: float = 1000.0
) -> wf.ModelBuilder:
    """A rigid disc on a peg spins on its tip, which is held, and its axis goes round: it precesses and nods.

    Args:
        radius: of the disc, m.
        height: of the disc above the tip, m.
        rate: of the spin about its axis, rad/s.
        tilt: of the axis from the vertical at the start, rad.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    thick = 0.1 * height
    profile = [(0.0, 0.0), (thick, 0.9 * height), (radius, 0.9 * height), (radius, 1.1 * height), (0.0, 1.1 * height)]
    body = b.add_rigid(wf.TriMesh(*_turned(np.array(profile), 48)), density=density, name="top")
    b.add_joint("spherical", parent=wf.GROUND, child=body.at((0, 0, 0)), name="tip")
    c, s = np.cos(tilt), np.sin(tilt)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    spin = rate * turn[:, 2]
    b.set_initial(body, displacement=lambda X: X @ turn.T - X, velocity=lambda X: np.cross(spin, X @ turn.T))
    b.add_probe("head", body.at((0, 0, 1.1 * height)))
    return b


def _turned(profile: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Closed surface of a profile (k, 2) of radii and heights, turned about z; its ends lie on the axis."""
    angle = 2.0 * np.pi * np.arange(n) / n
    rings = [np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(n, z)]) for r, z in profile[1:-1]]
    ends = [(0.0, 0.0, profile[0, 1]), (0.0, 0.0, profile[-1, 1])]
    a, b = np.arange(n), (np.arange(n) + 1) % n
    low, high, last = n * len(rings), n * len(rings) + 1, n * (len(rings) - 1)
    triangles = [np.column_stack([np.full(n, low), b, a]), np.column_stack([np.full(n, high), last + a, last + b])]
    for k in range(0, last, n):
        triangles += [np.column_stack([k + a, k + b, k + n + b]), np.column_stack([k + a, k + n + b, k + n + a])]
    return np.concatenate([*rings, ends]), np.concatenate(triangles)
