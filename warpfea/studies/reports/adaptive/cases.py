"""Six small motions that step sizes are adapted to, each with its time scale."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import warpfea as wf

__all__ = ["CASES"]

STEEL = wf.SVK(E=2e11, nu=0.3, density=7800.0)
RUBBER = wf.SVK(E=1e6, nu=0.4, density=1000.0)


def stiff() -> tuple[wf.ModelBuilder, float]:
    """A thin steel beam swings from a pin: its axial waves are ten thousand times faster than the swing."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    line, section = [(0, 0, 0), (1.0, 0, 0)], wf.Rectangle(0.02, 0.02)
    beam = b.add_beam(line, elements=3, section=section, normal=(0, 0, 1), material=STEEL)
    b.clamp(beam.start, slots="position")
    return b, 0.3


def impact() -> tuple[wf.ModelBuilder, float]:
    """A damped free bar at rest is struck at a corner by a load that lasts a hundredth of the run, and flies on."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    damped = wf.SVK(E=1e8, nu=0.4, density=1000.0, damping=wf.KelvinVoigt(eta=1e5, lambda_v=1e5))
    bar = b.add_solid(wf.mesh.box((0.6, 0.3, 0.3), cells=(2, 1, 1)), material=damped)
    end, start, blow = 0.2, 0.0341, 8e4
    times = [0.0, start, start + 0.005 * end, start + 0.01 * end]
    force = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.5 * blow, 0.0, blow), (0.0, 0.0, 0.0)]
    b.add_point_load(bar.at((0.6, 0.3, 0.0)), force=(times, force))
    return b, end


def dead_points() -> tuple[wf.ModelBuilder, float]:
    """A free slider-crank goes by its inertia through a dead point, from 40 degrees before it to about 40 after it."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    crank, rod, speed, angle = 0.15, 0.3, 20.0, np.radians(140.0)
    pin = crank * np.array([np.cos(angle), 0.0, np.sin(angle)])
    tilt = np.arcsin(pin[2] / rod)  # of the rod, downwards to the slider
    end = pin + rod * np.array([np.cos(tilt), 0.0, -np.sin(tilt)])
    turn = speed * crank * np.cos(angle) / (rod * np.cos(tilt))  # d tilt/dt
    arm = b.add_beam(
        [(0, 0, 0), tuple(pin)], elements=1, section=wf.Rectangle(0.02, 0.02), normal=(0, 1, 0), material=STEEL
    )
    link = b.add_beam(
        [tuple(pin), tuple(end)], elements=2, section=wf.Rectangle(0.01, 0.01), normal=(0, 1, 0), material=STEEL
    )
    push = speed * np.array([-pin[2], 0.0, pin[0]])
    b.set_initial(arm, velocity=lambda X: speed * np.column_stack([-X[:, 2], 0.0 * X[:, 1], X[:, 0]]))
    b.set_initial(
        link,
        velocity=lambda X: push + turn * np.column_stack([X[:, 2] - pin[2], 0.0 * X[:, 1], pin[0] - X[:, 0]]),
    )
    b.add_joint("revolute", parent=wf.GROUND, child=arm.start, axis=(0, -1, 0))
    b.add_joint("revolute", parent=arm.end, child=link.start, axis=(0, -1, 0))
    b.clamp(link.end, slots="position", components="yz")
    return b, np.radians(80.0) / speed


def free_flight() -> tuple[wf.ModelBuilder, float]:
    """A soft bar is thrown with a spin."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    bar = b.add_solid(wf.mesh.box((1.0, 0.2, 0.1), cells=(3, 1, 1)), material=RUBBER)
    b.set_initial(bar, velocity=(1.0, 0.0, 2.0), angular_velocity=(1.0, 5.0, 2.0))
    return b, 0.2


def contact() -> tuple[wf.ModelBuilder, float]:
    """A hard damped ball that turns falls on a floor, touches it for a hundredth of the run, and comes up again."""
    hard = wf.SVK(E=1e10, nu=0.3, density=1100.0, damping=wf.KelvinVoigt(eta=1e5, lambda_v=1e5))
    b, ball = _ball(hard, stiffness=0.2)
    b.set_initial(ball, angular_velocity=(0.0, 10.0, 0.0))
    return b, 0.08


def soft_contact() -> tuple[wf.ModelBuilder, float]:
    """A ball falls on a soft floor, stays in it for two fifths of the run, and comes up again."""
    b, _ = _ball(wf.SVK(E=1e8, nu=0.3, density=1100.0), stiffness=0.002)
    return b, 0.08


def _ball(material: wf.SVK, *, stiffness: float) -> tuple[wf.ModelBuilder, wf.Body]:
    """A ball 1 cm above a floor, with the stiffness of the contact over Hertz's."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    radius, drop = 0.05, 0.01
    mesh = wf.mesh.sphere(radius, cells=2, center=(0.0, 0.0, drop + radius))
    ball = b.add_solid(mesh, material=material)
    floor = b.add_collider(wf.HalfSpace(normal=(0, 0, 1)))
    b.add_contact(ball, floor, model="sphere", radius=radius, restitution=1.0, stiffness=stiffness)
    return b, ball


CASES: dict[str, Callable[[], tuple[wf.ModelBuilder, float]]] = {
    f.__name__: f for f in (stiff, impact, dead_points, free_flight, contact, soft_contact)
}
"""Name -> function that gives a scene and its end, s."""
