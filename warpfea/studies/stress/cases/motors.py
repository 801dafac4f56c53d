"""Stiff controllers, stops, friction, and chains of motors."""

from typing import Any

import numpy as np

import warpfea as wf

from ..build import GRAVITY_VECTOR, StepStats, Y, Z, finalize, step
from ..case import FLOAT32_REFUSAL, Answer, Setting, case


def _wheel(inertia: float, rate: float, **options: Any) -> tuple[wf.ModelBuilder, wf.Joint]:
    """A part of so much inertia (kg m^2) about a hinge along z, turning at a rate, rad/s."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    part = b.add_rigid(wf.Box((0, 0, 0), (0.2, 0.2, 0.2)), mass=100.0 * inertia, inertia=(inertia,) * 3, name="part")
    joint = b.add_joint("revolute", parent=wf.GROUND, child=part.at((0, 0, 0)), axis=Z, name="hinge", **options)
    b.set_initial(part, angular_velocity=(0, 0, rate))
    return b, joint


def _row_answer(sim: wf.Simulation, stats: StepStats, error: float, bound: float, reference: str) -> Answer:
    newton = stats.newton / sim.statistics.steps
    limits = {"Newton per step": (newton, 20.0 if sim.model.dtype == "float32" else 6.0)}
    return stats.answer(error, bound, reference, lowest_J=None, limits=limits)


@case(
    "pd", "motors", values=[(kp, h, scheme) for kp in (1.0, 1e5, 1e9, 1e13) for h, scheme in
                            ((1e-3, "energy_momentum"), (0.1, "bdf2"), (1e-2, "backward_euler"))],
    quick="float64", refusal=FLOAT32_REFUSAL,
)  # fmt: skip
def pd(setting: Setting, value: tuple[float, float, str]) -> Answer:
    """A PD of gain kp on 1 kg m^2 that turns at 1 rad/s, its target held: kinetic and its own energy never grow."""
    kp, h, scheme = value
    b, joint = _wheel(1.0, 1.0)
    b.add_actuator(joint, wf.PD(kp, target=wf.Control("q", 1)), name="motor")
    sim, stats = wf.Simulation(finalize(b, setting), dt=h, integrator=scheme), StepStats()
    z = [np.array([1.0, 0.0])]
    for _ in range(30):
        stats.step(sim)
        z.append(np.array([sim.joint_rate(joint)[0], np.sqrt(kp) * sim.joint_value(joint)[0]]))
    states = np.array(z)
    energy = 0.5 * (states**2).sum(axis=1)
    if scheme == "bdf2":  # its own norm
        energy = 0.25 * ((states[1:] ** 2).sum(axis=1) + ((2.0 * states[1:] - states[:-1]) ** 2).sum(axis=1))
    return _row_answer(sim, stats, float(energy.max() / energy[0] - 1.0), 2e-3 if setting.single else 1e-5, "no growth")


@case("stop-speed", "motors", values=[(v, h) for v in (1e-3, 10.0, 1e3) for h in (1e-3, 1e-2)], quick="float64",
      refusal={"float32": ("float32", "try a smaller dt")})  # fmt: skip
def stop_speed(setting: Setting, value: tuple[float, float]) -> Answer:
    """A slide of 1 kg hits its stop at v m/s: never faster back, nor beyond it by more than v sqrt(m/k)."""
    speed, h = value
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    part = b.add_rigid(wf.Box((0, 0, 0), (0.1, 0.1, 0.1)), mass=1.0, name="part")
    way, stiffness = 20.5 * h * speed, 1e4
    joint = b.add_joint("translational", parent=wf.GROUND, child=part.at((0, 0, 0)), axis=(1, 0, 0), name="slide",
                        limits=wf.Stop(-way, way, stiffness=stiffness))  # fmt: skip
    b.set_initial(part, velocity=(speed, 0, 0))
    sim, stats = wf.Simulation(finalize(b, setting), dt=h, integrator="bdf2"), StepStats()
    fastest = deepest = 0.0
    for _ in range(60):
        stats.step(sim)
        fastest = max(fastest, abs(float(sim.joint_rate(joint)[0])))
        deepest = max(deepest, float(sim.joint_value(joint)[0]) - way)
    over = max(fastest / speed - 1.0, deepest / (speed / np.sqrt(stiffness)) - 1.0)
    return _row_answer(sim, stats, over, 0.02, "energy of the impact")


@case("speed", "motors", values=[(inertia, rate, scheme) for inertia, rate in ((1e-9, 1e4), (1.0, 1e-6), (1e9, 1e2))
                                 for scheme in ("energy_momentum", "bdf2")],
      quick="float64", refusal=FLOAT32_REFUSAL)  # fmt: skip
def speed(setting: Setting, value: tuple[float, float, str]) -> Answer:
    """A drive takes so much inertia, kg m^2, to a rate, rad/s, in 3 rad and 50 steps, the last of 0.12 rad: the time is
    T = 6/rate, the torque I rate/T."""
    inertia, rate, scheme = value
    b, joint = _wheel(inertia, 0.0)
    T = 6.0 / rate
    b.add_velocity_constraint("speed", joint, value=([0.0, T], [0.0, rate]), name="motor")
    sim, stats = step(b, setting, 50, dt=0.02 * T, integrator=scheme)
    torque = sim.joint_force("motor")[0, 5] / (inertia * rate / T)
    found = np.array([sim.joint_value(joint)[0] / 3.0, sim.joint_rate(joint)[0] / rate, torque])
    return _row_answer(sim, stats, float(np.abs(found - 1.0).max()), 5e-2, "I rate / T")


@case("friction-ratio", "motors", values=(1e-6, 1.0, 1e6), quick="float64", refusal=FLOAT32_REFUSAL)
def friction_ratio(setting: Setting, value: float) -> Answer:
    """A wheel of so much inertia is stopped by friction of 2 N m per kg m^2 from 1 rad/s, and stays at 0.25 rad."""
    b, joint = _wheel(value, 1.0, friction=2.0 * value)
    sim, stats = step(b, setting, 200, dt=5e-3, integrator="energy_momentum")
    return _row_answer(sim, stats, abs(float(sim.joint_value(joint)[0]) / 0.25 - 1.0), 5e-3, "w^2 I / (2 T)")


@case("held-chain", "motors", values=[(n, kp) for n in (3, 12) for kp in (1e3, 1e7)], quick="float64",
      refusal=FLOAT32_REFUSAL)  # fmt: skip
def held_chain(setting: Setting, value: tuple[int, float]) -> Answer:
    """Rigid links of 1 kg and 0.1 m in a row, held out by damped motors: their torques are those of the weights."""
    count, kp = value
    b = wf.ModelBuilder(gravity=GRAVITY_VECTOR)
    parent: Any = wf.GROUND
    joints = []
    for k in range(count):
        link = b.add_rigid(wf.Box((0.1 * k + 0.05, 0, 0), (0.1, 0.03, 0.03)), mass=1.0, name=f"link {k}")
        at = (0.1 * k, 0.0, 0.0)
        joints.append(b.add_joint("revolute", parent=parent, child=link.at(at), anchor=at, axis=Y, name=f"j{k}"))
        b.add_actuator(joints[-1], wf.PD(kp * count**2, 0.2 * kp * count**2), name=f"m{k}")
        parent = link.at((0.1 * (k + 1), 0, 0))
    sim, stats = step(b, setting, 400, dt=1e-2, integrator="backward_euler")
    angle = np.array([float(sim.joint_value(joint)[0]) for joint in joints])
    lean = np.cumsum(angle)
    x = np.concatenate([[0.0], np.cumsum(0.1 * np.cos(lean))])
    middle = 0.5 * (x[1:] + x[:-1])
    torque = np.array([9.81 * np.sum(middle[k:] - x[k]) for k in range(count)])
    error = float(np.abs(kp * count**2 * angle - torque).max() / torque.max())
    return _row_answer(sim, stats, error, 2e-2 if setting.single else 1e-4, "weights")
