"""Joints between very unequal bodies, repeated, at a dead point, and in conflict."""

import functools
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import warpfea as wf

from ..build import STEEL, StepStats, X, Y, Z, finalize, solve, step
from ..case import Answer, Setting, case

GRAVITY = 9.81
SIDE, LINK_LENGTH = 0.05, 0.5
"""Length of a link, m."""
LIGHT, RATIO = 10.0, 1e6
"""Density of the light links, kg/m^3, and the mass ratio of the others."""


def _joint_answer(
    setting: Setting, stats: StepStats, error: float, bound: float, reference: str, note: str = ""
) -> Answer:
    """Answer of a case with joints, whose violation is limited."""
    limits = {"violation": (stats.violation or 0.0, 1e-5 if setting.single else 1e-8)}
    return Answer(error, bound, reference, **stats.answer_fields, limits=limits, note=note)


def _add_links(
    b: wf.ModelBuilder, kind: str, densities: Any, along: np.ndarray, across: Any, E: float
) -> tuple[list[wf.Body], list[Any]]:
    """Beams of one element in a row from the origin, each with a joint to its predecessor."""
    bodies, joints = [], []
    parent: Any = wf.GROUND
    for k, density in enumerate(densities):
        ends = [k * LINK_LENGTH * along, (k + 1) * LINK_LENGTH * along]
        link = b.add_beam(ends, elements=1, section=wf.Rectangle(SIDE, SIDE), normal=across, name=f"link {k}",
                          material=wf.SVK(E=E, nu=0.3, density=density))  # fmt: skip
        joints.append(b.add_joint(kind, parent=parent, child=link.start, axis=Y if kind == "revolute" else None))
        bodies.append(link)
        parent = link.end
    return bodies, joints


def _double_pendulum(masses: Any, angle: float, times: np.ndarray) -> np.ndarray:
    """Angles (times, 2) of two rigid links from rest, from the downward vertical."""
    c = LINK_LENGTH / 2.0
    own = [m * (LINK_LENGTH**2 + SIDE**2) / 12.0 for m in masses]
    A = own[0] + masses[0] * c**2 + masses[1] * LINK_LENGTH**2
    B = masses[1] * LINK_LENGTH * c
    C = own[1] + masses[1] * c**2
    weights = GRAVITY * np.array([masses[0] * c + masses[1] * LINK_LENGTH, masses[1] * c])

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        q, v = y[:2], y[2:]
        sine, cosine = np.sin(q[0] - q[1]), np.cos(q[0] - q[1])
        force = -weights * np.sin(q) - B * sine * np.array([v[1] ** 2, -(v[0] ** 2)])
        return np.append(v, np.linalg.solve([[A, B * cosine], [B * cosine, C]], force))

    return solve_ivp(rates, (0.0, times[-1]), [angle, angle, 0, 0], t_eval=times, rtol=1e-10, atol=1e-12).y[:2].T


@case("mass-ratio", "Joints", values=("light-heavy", "heavy-light"), quick="both",
      refusal={"float32": ("float32 round-off limit reached",)})  # fmt: skip
def mass_ratio(setting: Setting, value: str) -> Answer:
    """Double pendulum with link masses 1 : 1e6, from 45 degrees for 1 s, against rigid links."""
    densities = [LIGHT * (RATIO if word == "heavy" else 1.0) for word in value.split("-")]
    angle = np.pi / 4
    along = np.array([np.sin(angle), 0.0, -np.cos(angle)])
    b = wf.ModelBuilder(gravity=(0, 0, -GRAVITY))
    bodies, _ = _add_links(b, "revolute", densities, along, np.cross(along, Y), 2e12)
    for name, body in zip(("elbow", "tip"), bodies):
        b.add_probe(name, body.end)
    sim, stats = wf.Simulation(finalize(b, setting), dt=1e-3, integrator="bdf2"), StepStats()
    sim.run(1.0, outputs=[stats], progress=False)
    times = sim.probe("tip").time
    angles = _double_pendulum([d * SIDE**2 * LINK_LENGTH for d in densities], angle, np.append(0.0, times))[1:]
    ways = np.stack([np.sin(angles), 0.0 * angles, -np.cos(angles)], axis=-1)
    exact = LINK_LENGTH * np.cumsum(ways, axis=1)
    got = np.stack([sim.probe(name).position[0] for name in ("elbow", "tip")], axis=1)
    error = float(np.linalg.norm(got - exact, axis=2).max() / (2.0 * LINK_LENGTH))
    return _joint_answer(setting, stats, error, 5e-3 if setting.single else 1e-3, "rigid double pendulum by scipy")


def _chain_forces(setting: Setting, kind: str, densities: list[float], load: float) -> Answer:
    """Joint forces of a chain at rest over the weight below, `load` in weights of the first link hung from its end.

    Statics if the joints leave no free mode, else 100 damping steps of 10 ms of backward Euler.
    """
    b = wf.ModelBuilder(gravity=(0, 0, -GRAVITY))
    bodies, joints = _add_links(b, kind, densities, -np.array(Z), X, 2e11)
    weights = np.array(densities) * SIDE**2 * LINK_LENGTH * GRAVITY
    if load:
        b.add_point_load(bodies[-1].end, (0, 0, -load * weights[0]))
    if kind == "fixed":
        found = solve(b, setting, load_steps=1)
        sim, stats = found.result.simulation, found.stats
    else:
        sim, stats = step(b, setting, 100, dt=1e-2)
    below = np.cumsum(weights[::-1])[::-1] + load * weights[0]
    got = np.array([sim.joint_force(joint)[0, :3] for joint in joints])
    error = float((np.linalg.norm(got - below[:, None] * np.array(Z), axis=1) / below).max())
    return _joint_answer(setting, stats, error, 1e-3 if setting.single else 1e-6, "weight below")


case("mass-ratio-chain", "Joints", values=("fixed", "revolute"), quick="both", description="Six hanging links at rest, "
     "alternately light and 1e6 times as heavy: force of every joint against the weight.")(
    functools.partial(_chain_forces, densities=[LIGHT, RATIO * LIGHT] * 3, load=0.0))  # fmt: skip
case("chain-1e3", "Joints", values=("fixed", "revolute"), quick="both", description="Ten hanging links at rest with a "
     "load of 1000 times a link's weight at their end.")(
    functools.partial(_chain_forces, densities=[1000.0] * 10, load=1000.0))  # fmt: skip


@case("joints", "Joints", values=("redundant", "dead-point"), quick="both")
def joints(setting: Setting, value: str) -> Answer:
    """A door on two coincident hinges; a parallelogram driven through its dead points."""
    return _redundant_hinges(setting) if value == "redundant" else _dead_point(setting)


def _redundant_hinges(setting: Setting) -> Answer:
    """Sum of the hinges' forces on a hanging door at rest, against its weight."""
    b = wf.ModelBuilder(gravity=(0, 0, -GRAVITY))
    mesh = wf.mesh.box((0.4, 0.04, 0.8), cells=(2, 1, 4), origin=(-0.2, -0.02, -0.8))
    door = b.add_solid(mesh, material=wf.SVK(E=1e9, nu=0.3, density=600.0))
    hinges = [b.add_joint("revolute", parent=wf.GROUND, child=door.surface("z+"), axis=Y) for _ in range(2)]
    sim, stats = step(b, setting, 40, dt=1e-2)
    weight = 600.0 * 0.4 * 0.04 * 0.8 * GRAVITY
    total = sum(sim.joint_force(hinge)[0] for hinge in hinges)
    error = float(np.linalg.norm(total[:3] - weight * np.array(Z)) / weight)
    return _joint_answer(setting, stats, error, 1e-3 if setting.single else 1e-6, "weight of the door")


def _dead_point(setting: Setting) -> Answer:
    """A full turn of the crank, at 1 turn/s: at 0 and 180 degrees all pins are collinear, and the follower may go
    either way. Criteria: lengths of cranks and coupler, and prescribed angle of the crank.
    """
    crank, coupler = 0.2, 0.5
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    start = 0.5
    arm = crank * np.array([np.cos(start), 0.0, np.sin(start)])
    span = coupler * np.array(X)
    section = wf.Rectangle(0.02, 0.02)

    def bar(a: Any, c: Any, name: str) -> wf.Body:
        along = np.asarray(c) - np.asarray(a)
        return b.add_beam([a, c], elements=1, section=section, normal=np.cross(along, Y), material=STEEL, name=name)

    first, second = bar(0.0 * arm, arm, "crank"), bar(span, span + arm, "follower")
    rod = bar(arm, span + arm, "coupler")
    turn = ([0.0, 1.0], [0.0, 2.0 * np.pi])
    b.add_joint("revolute", parent=wf.GROUND, child=first.start, axis=-np.array(Y), drive=turn)
    b.add_joint("revolute", parent=wf.GROUND, child=second.start, axis=Y)
    b.add_joint("revolute", parent=first.end, child=rod.start, axis=Y)
    b.add_joint("spherical", parent=second.end, child=rod.end)
    around = 2.0 * np.pi * np.array([0.0, -1.0, 0.0])
    b.set_initial(first, velocity=lambda P: np.cross(around, P))
    b.set_initial(second, velocity=lambda P: np.cross(around, P - span))
    b.set_initial(rod, velocity=tuple(np.cross(around, arm)))
    for name, body in (("pin", first), ("far", second)):
        b.add_probe(name, body.end)
    sim, stats = step(b, setting, 500, dt=2e-3, integrator="bdf2")
    pin, far = (sim.probe(name).position[0] for name in ("pin", "far"))
    lengths = np.stack([np.linalg.norm(far - pin, axis=1) / coupler, np.linalg.norm(far - span, axis=1) / crank])
    angle = start + 2.0 * np.pi * sim.probe("pin").time
    exact = crank * np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1)
    error = max(float(np.abs(lengths - 1.0).max()), float(np.linalg.norm(pin - exact, axis=1).max() / crank))
    away = float(np.linalg.norm(far - pin - span, axis=1).max())
    note = "stays a parallelogram" if away < 1e-2 * coupler else "crosses over"
    return _joint_answer(setting, stats, error, 1e-3, "rigid bars", note)


@case("joints-conflicting", "Joints", quick="both", must_refuse=True, refusal=("constraints could not be satisfied",))
def conflicting_pins(setting: Setting) -> Answer:
    """One point pinned to two positions is refused with the names of the pins."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(1, 1, 1)), material=wf.SVK(E=1e7, nu=0.3, density=1000.0))
    b.clamp(body.nodes("x-"))
    tip = body.at((1, 0.1, 0.1))
    for k, way in enumerate((0.1, 0.2)):
        b.add_constraint("PIN", points=(tip, (1, 0.1, 0.1)), value=([0, 1e-2], [(0, 0, 0), (0, 0, way)]),
                         name=f"pin {k}")  # fmt: skip
    _, stats = step(b, setting, 10, dt=1e-3)
    return Answer(float("nan"), 0.0, "no place satisfies both", **stats.answer_fields)
