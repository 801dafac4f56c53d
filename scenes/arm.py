"""A robot arm of seven joints with a gripper of two soft fingers, which lifts a soft box."""

from typing import Any

import numpy as np

import warpfea as wf
from warpfea.builder.scene import scene

SHOULDER, ELBOW, WRIST = np.array([0, 0, 0.30]), np.array([0.22, 0, 0.62]), np.array([0.5, 0, 0.30])
FINGER, BOX = (0.02, 0.015, 0.08), 0.05
"""Sizes of a finger and of the box, m."""
TIMES = np.linspace(0.0, 1.6, 81)
"""Targets at 50 Hz, s."""


def _bend(wrist: np.ndarray) -> np.ndarray:
    """Angles (n, 2) of shoulder and elbow about y, from the reference, that bring the wrist to places (n, 3), y = 0."""
    lengths = np.linalg.norm(ELBOW - SHOULDER), np.linalg.norm(WRIST - ELBOW)

    def angles(reach: np.ndarray) -> np.ndarray:
        x, z = reach[:, 0], reach[:, 2]
        d = np.hypot(x, z)
        inner = np.arccos((lengths[0] ** 2 + d**2 - lengths[1] ** 2) / (2.0 * lengths[0] * d))
        elbow = np.arccos((lengths[0] ** 2 + lengths[1] ** 2 - d**2) / (2.0 * lengths[0] * lengths[1]))
        return np.stack([-np.arctan2(z, x) - inner, np.pi - elbow], axis=1)

    return np.asarray(angles(wrist - SHOULDER) - angles(WRIST[None] - SHOULDER))


def _ramp(start: float, end: float) -> np.ndarray:
    """Smooth rise from 0 to 1 between two times, at `TIMES`."""
    s = np.clip((TIMES - start) / (end - start), 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s**2))


@scene(dt=2e-2, t_end=1.6, integrator="bdf2", tol=1e-4, fps=50.0, speed=0.5, picture=1.2)
def arm(
    *,
    lift: float = 0.2,
    turn: float = -0.7,
    squeeze: float = 0.008,
    mu: float = 0.8,
    kp: float = 2e4,
    kd: float = 400.0,
    grip_kp: float = 2e3,
    E: float = 4e5,
    controlled: bool = False,
) -> wf.ModelBuilder:
    """An arm of seven rigid links grips a soft box with two soft fingers, lifts it and turns it aside.

    All joints have PD controllers with targets at 50 Hz; two slides, one for each finger, close the gripper.

    Args:
        lift: of the box, m.
        turn: of the arm about the vertical, rad.
        squeeze: way of each finger, m; half of it closes the gap.
        mu: coefficient of friction.
        kp: gain of the joints, N m/rad.
        kd: their damping, N m s/rad.
        grip_kp: gain of the slides, N/m.
        E: Young's modulus of fingers and box (neo-Hookean), Pa.
        controlled: the targets are the controls "q1" to "q7" and "grip" in place of a motion.
    """
    b = wf.ModelBuilder()
    up, raised = np.array([0, 0, 1.0]), _ramp(0.5, 1.1)
    bend = _bend(WRIST + lift * raised[:, None] * up)
    zero = np.zeros(len(TIMES))
    motion = [turn * _ramp(0.8, 1.5), bend[:, 0], zero, bend[:, 1], zero, -bend.sum(axis=1), zero]
    flange = WRIST - 0.08 * up
    upper, fore = 0.5 * (SHOULDER + ELBOW), 0.5 * (ELBOW + WRIST)
    places = [np.array([0, 0, 0.02]), SHOULDER, upper, ELBOW, fore, WRIST, flange]
    axes = [up, (0, 1, 0), ELBOW - SHOULDER, (0, 1, 0), WRIST - ELBOW, (0, 1, 0), up]
    ends = [*places[1:], flange - 0.03 * up]
    masses = (3.0, 2.0, 1.5, 1.2, 1.0, 0.6)
    parent: Any = wf.GROUND
    for k in range(7):
        shape = wf.Capsule(places[k], ends[k], 0.035) if k < 6 else wf.Box(flange - 0.04 * up, (0.06, 0.14, 0.03))
        link = b.add_rigid(shape, mass=masses[k] if k < 6 else 0.5, name=f"link {k + 1}")
        joint = b.add_joint("revolute", parent=parent, child=link.at(places[k]), anchor=places[k], axis=axes[k],
                            name=f"joint {k + 1}")  # fmt: skip
        target = wf.Control(f"q{k + 1}") if controlled else (TIMES, motion[k])
        gain = 1.0 if k < 4 else 0.1
        b.add_actuator(joint, wf.PD(gain * kp, gain * kd, target=target), name=f"motor {k + 1}")
        parent = link.at(ends[k])
    soft = wf.NeoHookean.from_E_nu(E=E, nu=0.3, density=400.0, damping=wf.KelvinVoigt(eta=100.0))
    box = b.add_solid(wf.mesh.box((BOX, BOX, BOX), cells=(1, 1, 1), origin=(WRIST[0] - BOX / 2, -BOX / 2, 0),
                                  element="T4"), material=soft, name="box")  # fmt: skip
    top = 0.015 + FINGER[2]
    for side, label in ((1.0, "left"), (-1.0, "right")):
        middle = side * (0.5 * BOX + 0.5 * squeeze + 0.5 * FINGER[1])
        hold = np.array([WRIST[0], middle, top + 0.035])
        carrier = b.add_rigid(wf.Box(hold, (0.03, 0.02, 0.07)), mass=0.1, name=f"{label} jaw")
        origin = (WRIST[0] - FINGER[0] / 2, middle - FINGER[1] / 2, 0.015)
        finger = b.add_solid(wf.mesh.box(FINGER, cells=(1, 1, 3), origin=origin, element="T4"), material=soft,
                             name=f"{label} finger")  # fmt: skip
        b.weld(finger.surface("z+"), carrier)
        slide = b.add_joint("translational", parent=link.at(flange), child=carrier.at(hold), anchor=hold,
                            axis=(0, -side, 0), name=f"{label} slide")  # fmt: skip
        target = wf.Control("grip") if controlled else (TIMES, squeeze * _ramp(0.05, 0.5))
        b.add_actuator(slide, wf.PD(grip_kp, 0.05 * grip_kp, target=target), name=f"{label} grip")
        faces = finger.surface("y-" if side > 0 else "y+"), box.surface("y+" if side > 0 else "y-")
        b.add_contact(*faces, mu=mu, stiffness=2.0, name=label)
    floor = b.add_collider(wf.HalfSpace(normal=(0, 0, 1), offset=0.0), name="floor")
    b.add_contact(box.surface("z-"), floor, mu=mu, name="ground")
    b.add_probe("box", box.at((WRIST[0], 0, BOX / 2)))
    b.add_probe("hand", link.at(flange))
    return b
