"""A soft dumb-bell that spins freely and tumbles."""

from typing import Literal

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=4e-3, t_end=1.6, integrator="bdf2", tol=1e-5, speed=0.4, picture=0.4)
def spin(
    *,
    size: tuple[float, float, float] = (0.3, 0.14, 0.05),
    waist: float = 0.4,
    cells: tuple[int, int, int] = (6, 2, 1),
    element: Literal["ENMC", "FN", "FN18", "T10"] = "FN18",
    rate: float = 18.0,
    tilt: float = 0.02,
    E: float = 1e5,
    nu: float = 0.3,
    density: float = 1000.0,
    eta: float = 0.0,
) -> wf.ModelBuilder:
    """A soft dumb-bell of ANCF tetrahedra spins about its middle axis of inertia, stretches and turns over.

    Rotation about the axis of the middle moment of inertia (y) is unstable: a slight tilt grows until the body turns
    over, again and again (Dzhanibekov's nut, the tennis racket). No force acts on the body from outside, so its
    angular momentum is constant.

    Args:
        size: of the box around the body, m; the lengths must differ.
        waist: width of the middle over the width of the ends.
        cells: along each direction; each is cut into six tetrahedra.
        element: ENMC, FN, FN18, or T10.
        rate: of the spin, rad/s.
        tilt: of the spin's axis from the body's, rad.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        eta: shear viscosity (Kelvin-Voigt), Pa s; with it the body ends up turning about z.
    """

    def waist_map(X: np.ndarray) -> np.ndarray:
        width_ratio = waist + (1.0 - waist) * np.sin(np.pi * X[:, 0] / size[0]) ** 2
        return X * np.column_stack([np.ones_like(width_ratio), width_ratio, np.ones_like(width_ratio)])

    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    corner = [-0.5 * length for length in size]
    mesh = wf.mesh.box(size, cells=cells, element="T10", origin=corner, map=waist_map, name="dumb-bell")
    material = wf.SVK(E=E, nu=nu, density=density, damping=wf.KelvinVoigt(eta=eta) if eta else None)
    body = b.add_solid(mesh, material=material, element=element)
    b.set_initial(body, angular_velocity=(rate * np.sin(tilt), rate * np.cos(tilt), 0.0))
    b.add_probe("centre", body.at((0, 0, 0)))
    b.add_probe("end", body.surface("x+"))
    return b
