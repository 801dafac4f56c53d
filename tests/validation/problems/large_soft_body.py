"""A large neo-Hookean body that a smooth load bends; errors are against a finer run."""

from __future__ import annotations

import warp as wp

import warpfea as wf

PULL, RISE = 6.0e3, 0.32


@wp.func
def rising(t: wp.float64) -> wp.vec3d:
    """Load per area, Pa, from 0 to `PULL` in `RISE` s, without a kink."""
    s = wp.sin(wp.float64(0.5 * wp.pi / wp.static(RISE)) * t)
    return wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(wp.static(PULL)) * s * s)


@wf.scene(dt=4e-3, t_end=0.32, integrator="bdf2", tol=1e-8)
def large_soft_body(
    *, cells: int = 4, length: float = 1.0, side: float = 0.25, E: float = 2e6, nu: float = 0.4, eta: float = 2e3
) -> wf.ModelBuilder:
    """A soft column of T10, clamped at its foot, is bent by a load on its end that rises from zero.

    14 cells across make 285 thousand unknowns.

    Args:
        cells: across the column, four times as many along it.
        length: m.
        side: of the square section, m.
        E: Young's modulus (neo-Hookean), Pa.
        nu: Poisson's ratio.
        eta: shear viscosity (Kelvin-Voigt), Pa s; enough for the waves of shear, little for the bending.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    damping = wf.KelvinVoigt(eta=eta, form="rate") if eta else None
    law = wf.NeoHookean.from_E_nu(E=E, nu=nu, density=1000.0, damping=damping)
    mesh = wf.mesh.box((length, side, side), cells=(4 * cells, cells, cells), origin=(0.0, -0.5 * side, -0.5 * side))
    column = b.add_solid(mesh, material=law, name="column")
    b.clamp(column.nodes("x-"))
    b.add_traction(column.surface("x+"), rising)
    b.add_probe("tip", column.surface("x+"))
    return b
