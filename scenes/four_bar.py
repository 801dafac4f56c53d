"""A four-bar linkage whose coupler bends."""

import math

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=1.25e-3, t_end=0.5, integrator="bdf2", tol=1e-5, fps=240.0, speed=0.08, picture=0.36)
def four_bar(
    *,
    crank: float = 0.12,
    coupler: float = 0.40,
    rocker: float = 0.30,
    ground: float = 0.40,
    side: float = 0.01,
    speed: float = 40.0,
    ramp: float = 0.15,
    start: float = 1.5707963267948966,
    E: float = 4e8,
    nu: float = 0.3,
    density: float = 1200.0,
    elements: int = 8,
) -> wf.ModelBuilder:
    """A crank drives a rocker through a coupler that bends: four revolute joints, three bars of 3243 beams.

    The linkage lies in the plane x-z, at rest until the crank starts to turn about -y, with constant acceleration up to
    its speed. It closes for any angle of the crank if the shortest and the longest bar (the ground counts) together are
    shorter than the other two.

    Args:
        crank: its length, m.
        coupler: its length, m.
        rocker: its length, m.
        ground: distance of the fixed pivots, m.
        side: of the coupler's square section, m; those of crank and rocker are 1.6 times as wide and high.
        speed: of the crank, rad/s.
        ramp: time in which the crank reaches its speed, s.
        start: angle of the crank at t = 0, rad.
        E: Young's modulus (SVK), Pa.
        nu: Poisson's ratio.
        density: kg/m^3.
        elements: of the coupler; crank and rocker have two each.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    pivot = np.array([ground, 0.0, 0.0])
    pin = crank * np.array([math.cos(start), 0.0, math.sin(start)])
    line = pivot - pin
    d = float(np.linalg.norm(line))
    if not abs(coupler - rocker) < d < coupler + rocker:
        raise wf.ModelError(f"four_bar: the bars do not close at start = {start:g} rad")
    along = (d * d + coupler * coupler - rocker * rocker) / (2.0 * d)
    across = np.array([-line[2], 0.0, line[0]]) * math.sqrt(coupler**2 - along**2) / d
    knee = pin + line * along / d + across

    def bar(name: str, ends: list[np.ndarray], width: float, count: int) -> wf.Body:
        section, law = wf.Rectangle(width, width), wf.SVK(E=E, nu=nu, density=density)
        normal = np.cross([0.0, -1.0, 0.0], ends[1] - ends[0])
        return b.add_beam(ends, elements=count, section=section, normal=normal, material=law, name=name)

    arm = bar("crank", [np.zeros(3), pin], 1.6 * side, 2)
    link = bar("coupler", [pin, knee], side, elements)
    swing = bar("rocker", [pivot, knee], 1.6 * side, 2)
    times = np.linspace(0.0, ramp, 201)
    angle = np.append(0.5 * speed * times**2 / ramp, 1e3 * speed)
    drive = (np.append(times, 1e3 + 0.5 * ramp), angle)
    hinge = (0, -1, 0)
    b.add_joint("revolute", parent=wf.GROUND, child=arm.start, drive=drive, name="motor", axis=hinge)
    b.add_joint("revolute", parent=arm.end, child=link.start, name="crank pin", axis=hinge)
    b.add_joint("revolute", parent=link.end, child=swing.end, name="rocker pin", axis=hinge)
    b.add_joint("revolute", parent=wf.GROUND, child=swing.start, name="pivot", axis=hinge)
    b.add_probe("middle of coupler", link.at(0.5 * (pin + knee)))
    b.add_probe("rocker", swing.end)
    return b
