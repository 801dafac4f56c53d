"""Bushings of unlike stiffness, stiff parts that fall, slender tubes, wheels."""

import numpy as np

import warpfea as wf

from ..build import GRAVITY_VECTOR, StepStats, Y, finalize, solve, step
from ..case import FLOAT32_REFUSAL, Answer, Setting, case


@case("bushing", "mounts", values=[(k, h) for k in (1e-2, 1e2, 1e8) for h in (1e-3, 1e-2)], quick="float64",
      refusal=FLOAT32_REFUSAL)  # fmt: skip
def bushing(setting: Setting, value: tuple[float, float]) -> Answer:
    """Two free parts of 1 kg tumble on a bushing of k N/m and k/100 N m/rad: their energy is kept."""
    k, h = value
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    parts = [b.add_rigid(wf.Box((0.1 * n, 0, 0), (0.1,) * 3), mass=1.0, name=f"part {n}") for n in range(2)]
    b.add_bushing(*(part.at((0.05, 0, 0)) for part in parts), stiffness=k * np.array([1, 2, 3, 0.01, 0.02, 0.03]))
    b.set_initial(parts[0], velocity=(0.1, 0.2, 0.3), angular_velocity=(1, 2, 3))
    sim, stats = wf.Simulation(finalize(b, setting), dt=h, integrator="energy_momentum"), StepStats()
    first = float(sim.energies()["kinetic"][0])
    stats.step(sim, 50)
    e = sim.energies()
    error = abs(float(e["kinetic"][0] + e["springs"][0]) / first - 1.0)
    return stats.answer(error, 1e-3 if setting.single else 1e-7, "energy", lowest_J=None)


@case("fallen-part", "mounts", values=[(1e7, 0.02), (2e11, 0.02), (2e11, 0.5), (2e13, 0.5)], quick="float64",
      refusal=FLOAT32_REFUSAL)  # fmt: skip
def fallen_part(setting: Setting, value: tuple[float, float]) -> Answer:
    """A block of 10 kg falls by h m on a plane and lies on it after 0.5 s, by its place over its side."""
    E, height = value
    b = wf.ModelBuilder(gravity=GRAVITY_VECTOR)
    law = wf.SVK(E=E, nu=0.3, density=1e4)
    block = b.add_rigid(wf.Box((0, 0, 0), (0.1,) * 3), mass=10.0, material=law, name="block")
    b.add_contact(block, b.add_collider(wf.HalfSpace((0, 0, 1), -height - 0.05)), mu=0.3)
    fall = np.sqrt(2.0 * height / -GRAVITY_VECTOR[2])
    sim, stats = step(b, setting, int((fall + 0.5) / 1e-3), dt=1e-3, integrator="bdf2")
    error = abs(float(sim.pose(block)[0][0, 2]) + height) / 0.1
    return stats.answer(error, 1e-3, "rest", lowest_J=None)


@case("tube", "mounts", values=[(wall, L) for wall in (1e-3, 0.5, 0.99) for L in (0.2, 20.0)], quick="float64",
      refusal=FLOAT32_REFUSAL)  # fmt: skip
def tube(setting: Setting, value: tuple[float, float]) -> Answer:
    """A tube of 0.1 m with a wall of so many radii, L m long, under a force at its end: F L^3/(3 E I) + F L/(k G A)."""
    wall, L = value
    section, E = wf.Tube(0.1, 0.1 * wall), 1e9
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    beam = b.add_beam([(0, 0, 0), (L, 0, 0)], elements=8, section=section, normal=(0, 0, 1),
                      material=wf.SVK(E=E, nu=0.3))  # fmt: skip
    b.clamp(beam.start, slots="position+section")
    inertia = np.pi * (0.1**4 - section.bore**4) / 4.0
    exact = L**3 / (3.0 * E * inertia) + L / (section.shear * E / 2.6 * section.area)
    force = 1e-4 * L / exact
    b.add_point_load(beam.end, (0, 0, force))
    b.add_probe("tip", beam.end)
    static = solve(b, setting, load_steps=1)
    error = abs(static.result.probe("tip").displacement[0, -1, 2] / (force * exact) - 1.0)
    return static.stats.answer(float(error), 1e-2 if setting.single else 1e-5, "beam theory", lowest_J=None)


@case("wheel", "mounts", values=[(v, turn, scheme) for v in (1e-3, 1.0, 1e3) for turn, scheme in
                                 ((0.02, "energy_momentum"), (0.2, "bdf2"))],
      quick="float64", refusal=FLOAT32_REFUSAL)  # fmt: skip
def wheel(setting: Setting, value: tuple[float, float, str]) -> Answer:
    """A wheel of 1 m rolls at v m/s by a turn per step, rad, beside a part that is turned as fast: it keeps its line
    and height, and neither gains energy."""
    v, turn, scheme = value
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    part = b.add_rigid(wf.Cylinder((0, -0.1, 1), (0, 0.1, 1), 1.0), mass=1.0, inertia=(0.3, 0.5, 0.3), name="wheel")
    b.add_velocity_constraint("roll", part.at((0, 0, 1)), axis=Y, radius=1.0)
    driven = b.add_rigid(wf.Box((0, 3, 0), (0.2, 0.2, 0.2)), mass=1.0, inertia=(1.0, 1.0, 1.0), name="driven")
    hinge = b.add_joint("revolute", parent=wf.GROUND, child=driven.at((0, 3, 0)), axis=Y, name="hinge")
    b.add_velocity_constraint("speed", hinge, value=v)
    for body, speed in ((part, v), (driven, 0.0)):
        b.set_initial(body, velocity=(speed, 0, 0), angular_velocity=(0, v, 0))
    sim, stats = step(b, setting, 60, dt=turn / v, integrator=scheme)
    place = sim.pose(part)[0][0] - (0, 0, 1)
    energy_gain = float(sim.energies()["kinetic"][0]) / (1.25 * v**2) - 1.0
    error = max(abs(float(place[1])), abs(float(place[2])), energy_gain)
    return stats.answer(error, 1e-3 if setting.single else 1e-7, "its line and energy", lowest_J=None)


@case("knife", "mounts", values=[(m, v, turn, scheme) for m, v in ((1e-6, 1e3), (1.0, 1e-3), (1e6, 10.0)) for turn,
                                 scheme in ((0.02, "energy_momentum"), (0.2, "bdf2"))],
      quick="float64", refusal=FLOAT32_REFUSAL)  # fmt: skip
def knife(setting: Setting, value: tuple[float, float, float, str]) -> Answer:
    """Chaplygin's sleigh of m kg, its centre a = 0.3 m before the edge, from a turn about the edge at v m/s, by a turn
    per step, rad: with k^2 = I/m + a^2 and p = a v t/k^2 its heading is k/a gd(p), the edge's speed v tanh p."""
    mass, v, turn, scheme = value
    a, k = 0.3, np.sqrt(0.25 + 0.09)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    part = b.add_rigid(wf.Box((a, 0, 0), (0.6, 0.2, 0.1)), mass=mass, inertia=(0.15 * mass, 0.2 * mass, 0.25 * mass),
                       com=(a, 0, 0), name="sleigh")  # fmt: skip
    edge = part.at((0, 0, 0))
    b.add_velocity_constraint("knife", edge, axis=Y)
    b.add_probe("edge", edge)
    b.set_initial(part, velocity=(0, a * v / k, 0), angular_velocity=(0, 0, v / k))
    sim, stats = step(b, setting, 60, dt=turn * k / v, integrator=scheme)
    p = a / k * 60 * turn
    z, w = sim.pose(part)[1][0, 2:]
    heading = 2.0 * np.arctan2(float(z), float(w))
    ahead = float(sim.probe("edge").velocity[0, -1] @ (np.cos(heading), np.sin(heading), 0.0))
    error = max(abs(heading / (2.0 * k / a * np.arctan(np.tanh(0.5 * p))) - 1.0), abs(ahead / (v * np.tanh(p)) - 1.0))
    return stats.answer(error, 2e-2 if turn > 0.1 else 1e-3, "k/a gd(a v t/k^2)", lowest_J=None)


@case("fallen-roller", "mounts", values=[("cylinder", 0.0), ("cylinder", 1e-9), ("cylinder", 0.7), ("capsule", 1e-3)],
      quick="float64", refusal=FLOAT32_REFUSAL)  # fmt: skip
def fallen_roller(setting: Setting, value: tuple[str, float]) -> Answer:
    """A cylinder on its face, or a capsule on its end, tilted by so many rad, 0.1 m above a plane: its lowest point
    lies on it after 1.2 s, on a flat end or on its side."""
    kind, tilt = value
    radius, half = 0.1, 0.15
    axis = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    shape = {"cylinder": wf.Cylinder, "capsule": wf.Capsule}[kind](-half * axis, half * axis, radius)
    b = wf.ModelBuilder(gravity=GRAVITY_VECTOR)
    part = b.add_rigid(shape, density=1e3, name=kind)
    b.add_contact(part, b.add_collider(wf.HalfSpace((0, 0, 1), -half - 2.0 * radius)), mu=0.5)
    sim, stats = step(b, setting, 600, dt=2e-3, integrator="backward_euler")
    lowest = float(sim.positions(part)[0][:, 2].min()) + half + 2.0 * radius
    # of what is drawn, whose facets are as far within the surface
    return stats.answer(abs(lowest) / radius, 1e-2, "on the plane", lowest_J=None)
