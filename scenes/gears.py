"""Two wheels with teeth that mesh."""

import math
from dataclasses import replace

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=2e-3, t_end=0.3, tol=1e-6, fps=100.0, speed=0.25, picture=0.108)
def gears(
    *,
    teeth: int = 6,
    radius: float = 0.05,
    tooth: float = 0.018,
    width: float = 0.02,
    clearance: float = 0.002,
    speed: float = 8.0,
    ramp: float = 0.1,
    mu: float = 0.1,
    stiffness: float = 10.0,
    E: float = 2e7,
    nu: float = 0.35,
    density: float = 1200.0,
) -> wf.ModelBuilder:
    """A driven wheel with a wavy rim drives another one by its teeth.

    Rims are r = R + (tooth/2) cos(n angle); wheels of T10 turn about hinges through their hubs.

    Args:
        teeth: of each wheel, even.
        radius: of the middle of the teeth, m.
        tooth: height of the teeth, m.
        width: of the wheels, m.
        clearance: by which the axes are further apart than twice the radius, m.
        speed: of the driven wheel, rad/s.
        ramp: in which that speed is reached, s.
        mu: coefficient of friction.
        stiffness: of the contact, over that of the default law.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    material = wf.SVK(E=E, nu=nu, density=density)
    apart = 2.0 * radius + clearance
    wheels = []
    # a tooth of the first fits into a gap of the second
    for name, x, phase in (("driver", 0.0, 0.0), ("wheel", apart, math.pi * (teeth + 1))):
        mesh = wf.mesh.cylinder(radius, width, cells=(teeth, 1), name=name)
        r, angle = np.hypot(mesh.points[:, 0], mesh.points[:, 1]), np.arctan2(mesh.points[:, 1], mesh.points[:, 0])
        wave = 1.0 + 0.5 * tooth / radius * (r / radius) ** 2 * np.cos(teeth * angle + phase)
        points = mesh.points * np.column_stack([wave, wave, np.ones(len(wave))]) + (x, 0.0, 0.0)
        wheel = b.add_solid(replace(mesh, points=points), material=material, name=name)
        hub = wheel.nodes(lambda X, x=x: np.hypot(X[:, 0] - x, X[:, 1]) < 0.4 * radius)
        times = np.concatenate([np.linspace(0.0, ramp, 9), [ramp + 10.0]])
        turned = speed * np.where(times < ramp, 0.5 * times**2 / ramp, times - 0.5 * ramp)
        drive = (times, turned) if name == "driver" else None
        b.add_joint("revolute", parent=wf.GROUND, child=hub, anchor=(x, 0.0, 0.5 * width), axis=(0, 0, 1), drive=drive,
                    name=f"{name} axle")  # fmt: skip
        wheels.append(wheel)
    sides = [wheel.surface("side") for wheel in wheels]
    b.add_contact(*sides, mu=mu, restitution=0.2, stiffness=("region", stiffness), name="mesh")
    b.add_probe("tooth", wheels[1].at((apart - 0.8 * radius, 0.0, 0.5 * width)))
    return b
