"""A crane: a motor turns its boom, a rope of a spring carries a load."""

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene


@scene(dt=1e-2, t_end=3.0, integrator="bdf2", tol=1e-6, fps=50.0, picture=1.6)
def crane(
    *,
    height: float = 2.0,
    reach: float = 1.5,
    rope: float = 1.2,
    load: float = 20.0,
    ballast: float = 60.0,
    stiffness: float = 2e4,
    damping: float = 100.0,
    speed: float = 0.8,
) -> wf.ModelBuilder:
    """A motor of given speed turns a soft boom with a load on an elastic rope, which swings out, and stops.

    Args:
        height: of the mast, m.
        reach: of the boom from the mast to the rope, m.
        rope: its length, m.
        load: kg.
        ballast: point mass at the other end of the boom, kg.
        stiffness: of the rope, N/m.
        damping: of the rope, N s/m.
        speed: of the boom, rad/s.
    """
    b = wf.ModelBuilder()
    top = np.array([0.0, 0.0, height])
    mast = b.add_rigid(wf.Cylinder((0, 0, 0), top, 0.06), density=7850.0, name="mast")
    b.add_joint("fixed", parent=wf.GROUND, child=mast.at((0, 0, 0)), name="foundation")
    turntable = b.add_rigid(wf.Cylinder(top, top + (0, 0, 0.1), 0.12), density=7850.0, name="turntable")
    bearing = b.add_joint("revolute", parent=mast.at(top), child=turntable.at(top), axis=(0, 0, 1), name="bearing")
    b.add_velocity_constraint("speed", bearing, value=([0, 0.5, 2.0, 2.5, 3.0], [0, speed, speed, 0, 0]), name="motor")
    steel = wf.SVK(E=2e10, nu=0.3, density=2000.0)
    axis = top + (0, 0, 0.15)
    boom = b.add_beam([axis - (0.6, 0, 0), axis, axis + (reach, 0, 0)], elements=7, section=wf.Rectangle(0.05, 0.07),
                      normal=(0, 0, 1), material=steel, name="boom")  # fmt: skip
    b.add_joint("fixed", parent=turntable.at(top + (0, 0, 0.1)), child=boom.at(axis), anchor=axis, name="seat")
    b.add_point_mass(boom.start, ballast)
    low = axis + (reach, 0, -rope)
    block = b.add_rigid(wf.Box(low - (0, 0, 0.1), (0.2, 0.2, 0.2)), mass=load, name="load")
    b.add_spring(boom.end, block.at(low), stiffness=stiffness, damping=damping,
                 rest=rope - load * 9.81 / stiffness, name="rope")  # fmt: skip
    b.add_probe("load", block.at(low))
    b.add_probe("tip", boom.end)
    return b
