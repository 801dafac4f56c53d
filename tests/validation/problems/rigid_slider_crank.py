"""A free slider-crank of stiff bars against its equation of motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import warpfea as wf

from ..rigid import STANDARD, integrate, slider_crank_kinematics, slider_crank_velocities

X, Y, Z = np.eye(3)
CRANK, ROD, SIDE, DENSITY = (STANDARD[name] for name in ("crank", "rod", "side", "density"))
SLIDER_MASS, SLIDER_SIDE = STANDARD["slider_mass"], 0.02


def inertia(angle: np.ndarray) -> np.ndarray:
    """J in T = J(angle) angle'^2 / 2, kg m^2, of square bars and a non-rotating slider."""
    pin, slider, psi = slider_crank_velocities(angle, 1.0, CRANK, ROD)
    middle = 0.5 * (pin + np.stack([slider, 0.0 * slider], axis=-1))
    crank, rod = (DENSITY * SIDE**2 * length for length in (CRANK, ROD))
    return (
        crank * (CRANK**2 / 3.0 + SIDE**2 / 12.0)
        + rod * (middle**2).sum(axis=-1)
        + rod * (ROD**2 + SIDE**2) / 12.0 * psi**2
        + SLIDER_MASS * slider**2
    )


def rigid_bars(speed: float) -> wf.Reference:
    """Conservation of energy, angle' = speed sqrt(J(0) / J(angle)), by DOP853 at rtol = 1e-12."""
    start = inertia(np.zeros(1))

    def rate(_: float, angle: np.ndarray) -> np.ndarray:
        return speed * np.sqrt(start / inertia(angle))

    def places(name: str) -> Callable[[np.ndarray], np.ndarray]:
        def at(times: np.ndarray) -> np.ndarray:
            angle = integrate(rate, np.zeros(1), np.concatenate([[0.0], times]), 1e-12, 1e-12)[1:, 0]
            pin, slider, _ = slider_crank_kinematics(angle, CRANK, ROD)
            x, z = (pin[:, 0], pin[:, 1]) if name == "pin" else (slider, 0.0 * slider)
            return np.stack([x, 0.0 * x, z], axis=1)

        return at

    return wf.Reference({name: places(name) for name in ("pin", "slider")}, "rigid bars, conservation of energy")


@wf.scene(dt=1e-3, t_end=0.4, integrator="bdf2", tol=1e-10, reference=rigid_bars)
def rigid_slider_crank(*, speed: float = 15.0, E: float = 2e13) -> wf.ModelBuilder:
    """A free slider-crank of stiff 3243 bars, started at the stretched position, without gravity.

    Args:
        speed: of the crank at t = 0, rad/s.
        E: Young's modulus (SVK), Pa; stiff enough for negligible deformation.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    reach = CRANK + ROD
    section = wf.Rectangle(SIDE, SIDE)
    law = wf.SVK(E=E, nu=0.3, density=DENSITY)
    crank = b.add_beam([0 * X, CRANK * X], elements=1, section=section, normal=Z, material=law, name="crank")
    rod = b.add_beam([CRANK * X, reach * X], elements=1, section=section, normal=Z, material=law, name="rod")
    half = 0.5 * SLIDER_SIDE
    box = wf.mesh.box((SLIDER_SIDE,) * 3, cells=(1, 1, 1), origin=(reach - half, -half, -half))
    heavy = wf.SVK(E=E, nu=0.3, density=SLIDER_MASS / SLIDER_SIDE**3)
    slider = b.add_solid(box, material=heavy, name="slider")
    whole = slider.nodes(lambda P: P[:, 0] > -1.0)
    b.add_joint("revolute", parent=wf.GROUND, child=crank.start, axis=-Y, name="pivot")
    b.add_joint("revolute", parent=crank.end, child=rod.start, axis=-Y, name="crank pin")
    b.add_joint("revolute", parent=whole, child=rod.end, axis=-Y, anchor=reach * X, name="slider pin")
    b.add_joint("translational", parent=wf.GROUND, child=whole, axis=X, name="guide")
    b.set_initial(crank, velocity=lambda P: speed * np.cross(-Y, P))
    b.set_initial(rod, velocity=lambda P: speed * CRANK * (Z + np.cross(Y, P - CRANK * X) / ROD))
    b.add_probe("pin", crank.end)
    b.add_probe("slider", rod.end)
    return b
