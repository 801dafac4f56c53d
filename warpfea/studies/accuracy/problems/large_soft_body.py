"""A large neo-Hookean body that sways; errors are against a finer run."""

from __future__ import annotations

import numpy as np

import warpfea as wf

from .plate_vibration import first_mode


@wf.scene(dt=4e-3, t_end=0.32, integrator="bdf2", tol=1e-8)
def large_soft_body(
    *, cells: int = 4, length: float = 1.0, side: float = 0.25, E: float = 2e6, nu: float = 0.4, eta: float = 2e3,
    speed: float = 2.0,
) -> wf.ModelBuilder:  # fmt: skip
    """A soft column of T10, clamped at its foot, starts with the velocities of a beam's first bending mode.

    14 cells across make 285 thousand unknowns.

    Args:
        cells: across the column, four times as many along it.
        length: m.
        side: of the square section, m.
        E: Young's modulus (neo-Hookean), Pa.
        nu: Poisson's ratio.
        eta: shear viscosity (Kelvin-Voigt), Pa s; enough for the waves of shear, little for the bending.
        speed: of the free end at t = 0, m/s.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    damping = wf.KelvinVoigt(eta=eta, form="rate") if eta else None
    law = wf.NeoHookean.from_E_nu(E=E, nu=nu, density=1000.0, damping=damping)
    mesh = wf.mesh.box((length, side, side), cells=(4 * cells, cells, cells), origin=(0.0, -0.5 * side, -0.5 * side))
    column = b.add_solid(mesh, material=law, name="column")
    b.clamp(column.nodes("x-"))

    def velocity(P: np.ndarray) -> np.ndarray:
        w, slope = first_mode(P[:, 0] / length)
        return speed * np.stack([-P[:, 2] * slope / length, 0.0 * w, w], axis=1)

    b.set_initial(column, velocity=velocity)
    b.add_probe("tip", column.surface("x+"))
    return b
