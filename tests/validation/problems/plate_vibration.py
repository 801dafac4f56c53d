"""A plate of 3443 shells that vibrates freely with large rotations; errors are against a finer run."""

from __future__ import annotations

import numpy as np

import warpfea as wf


def first_mode(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shape of a cantilever's first bending mode, 1 at s = 1, and its slope (Timoshenko 1937, eq. 128)."""
    k, r = 1.8751040687119611, 0.7340955137589128
    w = np.cosh(k * s) - np.cos(k * s) - r * (np.sinh(k * s) - np.sin(k * s))
    slope = k * (np.sinh(k * s) + np.sin(k * s) - r * (np.cosh(k * s) - np.cos(k * s)))
    return 0.5 * w, 0.5 * slope


def midline(sim: wf.Simulation) -> np.ndarray:
    """Displacements at eleven points from the clamped to the free edge, (11, 3), m, equal on every mesh."""
    plate = sim.model.bodies[0]
    X = plate.mesh.points
    middle = np.flatnonzero(np.abs(X[:, 1] - 0.5 * X[:, 1].max()) < 1e-9)
    middle = middle[np.argsort(X[middle, 0])]
    u = sim.displacements(plate)[0, middle]
    at = np.linspace(0.0, X[:, 0].max(), 11)
    return np.stack([np.interp(at, X[middle, 0], u[:, k]) for k in range(3)], axis=1)


@wf.scene(dt=2e-3, t_end=0.4, integrator="bdf2", tol=1e-8, field=midline)
def plate_vibration(
    *, length: float = 0.5, width: float = 0.25, thickness: float = 0.01, cells: int = 4, E: float = 4e7,
    nu: float = 0.0, eta: float = 1e3, speed: float = 2.0,
) -> wf.ModelBuilder:  # fmt: skip
    """A cantilever plate, flat and unstressed, starts with the velocities of a beam's first bending mode.

    Its directors rotate with it: other velocities would excite shear waves.

    Args:
        length: from the clamped edge to the free one, m.
        width: m.
        thickness: m.
        cells: along the length, even; half as many along the width.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        eta: shear viscosity (Kelvin-Voigt), Pa s; enough for the remaining shear waves, little for the bending.
        speed: of the free edge at t = 0, m/s.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    plate = b.add_shell(
        wf.mesh.grid((length, width), cells=(cells, max(2, cells // 2))),
        thickness=thickness,
        material=wf.SVK(E=E, nu=nu, density=1000.0, damping=wf.KelvinVoigt(eta=eta, form="rate") if eta else None),
        name="plate",
    )
    b.clamp(plate.edge("x-"), slots="position+director")

    def velocity(P: np.ndarray) -> np.ndarray:
        w, slope = first_mode(P[:, 0] / length)
        return speed * np.stack([-P[:, 2] * slope / length, 0.0 * w, w], axis=1)

    b.set_initial(plate, velocity=velocity)
    b.add_probe("tip", plate.at((length, 0.5 * width, 0.0)))
    b.add_probe("corner", plate.at((length, 0.0, 0.0)))
    return b
