"""Contact between bodies: fast impacts, stiff on soft, vertices, edges and faces, exact touch, thin bodies, extremes.

Criteria for both bodies: in every step the change of momentum equals the impulse of the recorded forces and the
weight; friction is at most mu N; no energy is gained; no centre of mass passes the other body.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

import warpfea as wf

from ..build import GRAVITY_VECTOR, StepStats, finalize
from ..case import DTYPES, FLOAT32_REFUSAL, Answer, Setting, case
from .contact import ContactMotion, bound_for, edge_down, momentum, total_energy, vertex_down

GROUP = "pairs"
SIDE, DENSITY, GRAVITY = 0.1, 1000.0, 9.81
REFUSAL_TEXTS = {
    dtype: ["through body", "inverted", "J <= 0", *more] for dtype, more in zip(DTYPES, ((), ("float32",)))
}
IMPACT_SPEED = 100.0
"""Speed of impacts, m/s."""


@dataclass
class BodyPair:
    """A body on another one.

    Attributes:
        builder: their builder.
        upper, lower: the first and the second body of the contact.
        contact: between them.
        clamped: True if the lower one is fixed at its sides.
    """

    builder: wf.ModelBuilder
    upper: wf.Body
    lower: wf.Body
    contact: Any
    clamped: bool


def cube_on_plate(
    *, E: tuple[float, float] = (1e6, 1e6), density: tuple[float, float] = (DENSITY, DENSITY), across: int = 3,
    gravity: Any = GRAVITY_VECTOR, rotation: np.ndarray | None = None, position: Any = (0.0, 0.0, 0.0),
    thickness: float = SIDE, width: float = 3 * SIDE, clamped: bool = True, shell: bool = False, **options: Any,
) -> BodyPair:  # fmt: skip
    """A T10 cube whose lowest face, edge or vertex is at `position`, on a plate below z = 0."""
    b = wf.ModelBuilder(gravity=gravity)
    rotation = np.eye(3) if rotation is None else rotation
    corners = np.array([(x, y, z) for x in (0, SIDE) for y in (0, SIDE) for z in (0, SIDE)]) @ rotation.T
    middle = np.array([corners[:, 0].mean(), corners[:, 1].mean(), corners[:, 2].min()])
    laws = [wf.SVK(E=modulus, nu=0.3, density=rho) for modulus, rho in zip(E, density)]
    mesh = wf.mesh.box((SIDE,) * 3, cells=(2,) * 3)
    move = (rotation, np.asarray(position, dtype=float) - middle)
    upper = b.add_solid(mesh, material=laws[0], transform=move, name="upper")
    low = (-0.5 * width, -0.5 * width, -thickness)
    if shell:
        grid = wf.mesh.grid((width, width), cells=(across, across), origin=(*low[:2], -0.5 * thickness))
        lower = b.add_shell(grid, thickness=thickness, material=laws[1], name="lower")
        face: Any = lower.surface("top")
    else:
        mesh = wf.mesh.box((width, width, thickness), cells=(across, across, 1), origin=low)
        lower = b.add_solid(mesh, material=laws[1], name="lower")
        face = lower.surface("z+")
    if clamped:
        for side in ("x-", "x+", "y-", "y+"):
            b.clamp(lower.nodes(side))
    return BodyPair(b, upper, lower, b.add_contact(upper, face, name="pad", **options), clamped)


class PairMotion(ContactMotion):
    """Errors of a motion of two bodies: friction_excess of contact in a plane z = const; center_depth: of the upper
    centre of mass below that of the lower one, over the side.
    """

    def limits(self, setting: Setting) -> dict[str, tuple[float, float]]:
        """Errors that all cases bound: {name: (error, bound)}."""
        return super().limits(setting) | {
            "friction above mu N": (self.friction_excess, 1e-2),
            "centre past the other body": (self.center_depth, 0.0),
        }


def center_of_mass(sim: wf.Simulation, body: wf.Body) -> np.ndarray:
    """Centre of mass (3,), m."""
    m = sim.model.masses.lumped[0][body.slots] * (body.slot_kind == 0)
    x = body.reference + np.where(body.slot_kind[:, None] == 0, body.origin, 0.0)
    return np.asarray(m @ (x + sim.state.displacement.numpy()[0, body.slots]) / m.sum())


def simulate(sim: wf.Simulation, s: BodyPair, steps: int, *, mu: float | None = None) -> PairMotion:
    """Step and measure; with `mu` friction in the plane z = 0 is compared with mu N."""
    out = PairMotion(StepStats())
    bodies = [(s.upper, 1.0)] + ([] if s.clamped else [(s.lower, -1.0)])
    gravity = np.asarray(s.builder.description.gravity, dtype=float)
    mass = [float(sim.model.masses.lumped[0][body.slots] @ (body.slot_kind == 0)) for body, _ in bodies]
    p = [momentum(sim, body) for body, _ in bodies]
    scale = max(float(np.linalg.norm(x)) for x in p)
    first, most = total_energy(sim), mass[0] * GRAVITY * SIDE
    for _ in range(steps):
        out.stats.step(sim)
        record = sim.contact_record(s.contact)
        force, normal = record.force[0, -1], float(record.normal_force[0, -1])
        for k, (body, sign) in enumerate(bodies):
            impulse = sim.dt * (sign * force + mass[k] * gravity)
            now = momentum(sim, body)
            scale = max(scale, float(np.linalg.norm(now)), sim.dt * normal, sim.dt * mass[k] * GRAVITY)
            out.impulse_error = max(out.impulse_error, float(np.linalg.norm(now - p[k] - impulse)) / scale)
            p[k] = now
        if mu is not None and normal > 1e-6 * mass[0] * GRAVITY:
            excess = float(np.linalg.norm(force[:2])) / (max(mu, 1e-3) * normal) - 1.0
            out.friction_excess = max(out.friction_excess, excess)
        most = max(most, float(sim.energies()["kinetic"][0]))
        out.energy_gain = max(out.energy_gain, (total_energy(sim) - first) / most)
        depth = float(center_of_mass(sim, s.lower)[2] - center_of_mass(sim, s.upper)[2])
        out.center_depth = max(out.center_depth, depth / SIDE)
    return out


@case("pairs-impact", GROUP, values=tuple((E, h) for E in (1e6, 1e8, 1e10) for h in (1e-3, 1e-2)), quick="none",
      refusal=REFUSAL_TEXTS)  # fmt: skip
def impact(setting: Setting, value: tuple[float, float]) -> Answer:
    """A cube at 100 m/s onto a free plate a tenth as thick, up to ten sides a step: no penetration."""
    E, h = value
    s = cube_on_plate(
        E=(E, E), gravity=(0, 0, 0), position=(0, 0, 0.3), thickness=0.01, clamped=False, mu=0.3, restitution=0.5
    )
    s.builder.set_initial(s.upper, velocity=(0, 0, -IMPACT_SPEED))
    run = simulate(wf.Simulation(finalize(s.builder, setting), dt=h), s, 8)
    return run.answer(setting, max(run.center_depth, 0.0), 0.0, "the centre stays before the plate")


@case("pairs-shell", GROUP, values=(1.0, 20.0, 100.0), quick="none", refusal=REFUSAL_TEXTS)
def thin_shell(setting: Setting, speed: float) -> Answer:
    """A cube hits a shell of a hundredth of its side at 1 to 100 m/s, h = 1 ms: no penetration."""
    s = cube_on_plate(E=(1e6, 1e8), gravity=(0, 0, 0), position=(0, 0, 0.05), thickness=1e-3, shell=True, mu=0.3,
                      restitution=0.5, stiffness=1e4)  # fmt: skip
    s.builder.set_initial(s.upper, velocity=(0, 0, -speed))
    run = simulate(wf.Simulation(finalize(s.builder, setting), dt=1e-3), s, 60)
    return run.answer(setting, max(run.center_depth, 0.0), 0.0, "the centre stays before the shell")


MODULUS_PAIRS = tuple((a, b) for a in (1e4, 1e7, 1e10) for b in (1e4, 1e7, 1e10) if a != b)


@case("pairs-stiff", GROUP, values=MODULUS_PAIRS, quick="none", refusal=FLOAT32_REFUSAL)
def stiff_on_soft(setting: Setting, E: tuple[float, float]) -> Answer:
    """A cube of 1e4 to 1e10 Pa falls by a hundredth of its side on a plate of another one, 30 steps of 1 ms."""
    s = cube_on_plate(E=E, position=(0, 0, 0.01 * SIDE), mu=0.5, restitution=0.5)
    s.builder.set_initial(s.upper, velocity=(0, 0, -0.3))
    run = simulate(wf.Simulation(finalize(s.builder, setting), dt=1e-3), s, 30, mu=0.5)
    return run.impulse_answer(setting)


ROTATIONS: dict[str, Any] = {"face": None, "edge": edge_down(), "vertex": vertex_down()}


@case("pairs-meet", GROUP, values=tuple((name, at) for name in ROTATIONS for at in ("middle", "border")), quick="both")
def landing(setting: Setting, value: tuple[str, str]) -> Answer:
    """A face, an edge or a vertex lands at 1 m/s on a facet's centre, or on a facet border; 40 steps of 1 ms."""
    name, at = value
    spot = 0.02 if at == "middle" else 0.05
    s = cube_on_plate(rotation=ROTATIONS[name], position=(spot, spot, 0.005), mu=0.3, restitution=0.5, across=3)
    s.builder.set_initial(s.upper, velocity=(0, 0, -1.0))
    run = simulate(wf.Simulation(finalize(s.builder, setting), dt=1e-3), s, 40)
    return run.impulse_answer(setting)


@case("pairs-touch", GROUP, values=("plate", "same faces"), quick="both", refusal=FLOAT32_REFUSAL)
def exact_touch(setting: Setting, name: str) -> Answer:
    """A cube in initial exact touch with a plate, or face on face with a cube of its own, under its weight."""
    same: dict[str, Any] = {"width": SIDE, "across": 2} if name == "same faces" else {}
    s = cube_on_plate(mu=0.5, restitution=0.5, **same)
    run = simulate(wf.Simulation(finalize(s.builder, setting), dt=1e-3), s, 50, mu=0.5)
    return run.impulse_answer(setting)


@case("pairs-rest", GROUP, values=(1e-3, 1.0, 1e3), quick="float64", refusal=FLOAT32_REFUSAL)
def mass_ratio(setting: Setting, ratio: float) -> Answer:
    """Statics: a cube 1e3 times lighter or heavier than its plate rests on it; the force is its weight."""
    E = max(1e7, 1e4 * ratio * DENSITY)
    s = cube_on_plate(E=(E, E), density=(ratio * DENSITY, DENSITY), mu=0.5)
    stats = StepStats()
    result = wf.solve_static(finalize(s.builder, setting), stabilise=True, outputs=[stats])
    record = result.simulation.contact_record(s.contact)
    weight = ratio * DENSITY * SIDE**3 * GRAVITY
    error = abs(float(record.force[0, -1, 2]) / weight - 1.0)
    return stats.answer(error, bound_for(setting, 1e-5, 1e-2), "force = m g")


@case("pairs-edge", GROUP, values=(0.0, 0.3), quick="float64")
def over_the_edge(setting: Setting, mu: float) -> Answer:
    """A cube at 2 m/s slides over the edge of a plate, tips and falls free: 120 steps of 1 ms."""
    s = cube_on_plate(position=(SIDE, 0, 0), mu=mu, restitution=0.5)
    s.builder.set_initial(s.upper, velocity=(2.0, 0, 0))
    run = simulate(wf.Simulation(finalize(s.builder, setting), dt=1e-3), s, 120)
    return run.impulse_answer(setting, limits={"centre past the other body": (0.0, 0.0)})


@case("pairs-mu", GROUP, values=(0.0, 10.0), quick="float64")
def extreme_friction(setting: Setting, mu: float) -> Answer:
    """A cube slides over a smooth plate, or one of mu = 10, at 1 m/s."""
    s = cube_on_plate(position=(-0.5 * SIDE, 0, 0), E=(1e6, 1e8), mu=mu, restitution=0.5)
    s.builder.set_initial(s.upper, velocity=(1.0, 0, 0))
    run = simulate(wf.Simulation(finalize(s.builder, setting), dt=1e-3), s, 50, mu=mu)
    return run.impulse_answer(setting)


@case("pairs-spin", GROUP, values=(1.0, 30.0), quick="float64")
def spinning_stack(setting: Setting, rate: float) -> Answer:
    """A cube pressed on a free one, both spun about their common axis: they rotate as one, 40 steps of 1 ms."""
    s = cube_on_plate(width=SIDE, across=2, clamped=False, gravity=(0, 0, 0), mu=0.8, restitution=0.5)
    b = s.builder
    for body in (s.upper, s.lower):
        b.set_initial(body, velocity=lambda X: rate * np.cross((0.0, 0.0, 1.0), X))
    b.add_traction(s.upper.surface("z+"), (0, 0, -1e3))
    b.add_traction(s.lower.surface("z-"), (0, 0, 1e3))
    sim = wf.Simulation(finalize(s.builder, setting), dt=1e-3)
    stats = StepStats()
    start = float(sim.energies()["kinetic"][0])
    for _ in range(40):
        stats.step(sim)
    e = sim.energies()
    ratio = float(e["kinetic"][0] + e["strain"][0] + e["contact"][0] + e["contact_pairs"][0] - e["work"][0]) / start
    apart = float(np.linalg.norm((center_of_mass(sim, s.upper) - center_of_mass(sim, s.lower))[:2])) / SIDE
    limits = {"energy from nowhere": (ratio - 1.0, bound_for(setting, 1e-6, 1e-2))}
    return stats.answer(apart, 1e-3, "one above the other", limits=limits)
