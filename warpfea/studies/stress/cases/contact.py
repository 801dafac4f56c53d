"""Contact with obstacles: fast impacts, stiff bodies, exact touch, edges and vertices, extremes of each parameter.

Criteria for a deformable body: at rest the contacts carry its weight; in every step its change of momentum equals
the impulse of the recorded forces and its weight; friction is at most mu N; no energy is gained.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

import warpfea as wf

from ..build import DOWN, Count
from ..case import DTYPES, Answer, Setting, case

GROUP = "contact"
SIDE, DENSITY, G = 0.1, 1000.0, 9.81
MODULI, STEPS = (1e4, 1e6, 1e8, 1e11), (1e-5, 1e-3, 1e-2)
GRID = tuple((E, h) for E in MODULI for h in STEPS)
REFUSAL_TEXTS = {dtype: ["collider", "inverted", "J <= 0"] for dtype in DTYPES}
SINGLE = {"float32": ["float32"]}
FAST = 100.0
"""Speed of impacts, m/s."""
NEWTON = 60
"""Maximum iterations of a step with grazing contact."""


def exact(setting: Setting, double: float = 1e-7, single: float = 2e-3) -> float:
    """Bound by precision."""
    return single if setting.single else double


@dataclass
class Scene:
    """A cube and its obstacles.

    Attributes:
        builder: its builder.
        body: the cube.
        pads: its contacts.
    """

    builder: wf.ModelBuilder
    body: wf.Body
    pads: list[Any]
    mass: float

    def model(self, setting: Setting) -> wf.Model:
        """Model for the setting's device and precision."""
        return self.builder.finalize(device=setting.device, dtype=setting.dtype)


def scene(
    *shapes: Any, E: float = 1e6, side: float = SIDE, gravity: Any = DOWN, turn: np.ndarray | None = None,
    place: Any = (0.0, 0.0, 0.0), cells: int = 2, path: Any = None, density: float = DENSITY, **options: Any,
) -> Scene:  # fmt: skip
    """A T10 cube with a corner at the origin, rotated about it and moved by `place`, and contacts with the shapes."""
    b = wf.ModelBuilder(gravity=gravity)
    mesh = wf.mesh.box((side,) * 3, cells=(cells,) * 3)
    law = wf.SVK(E=E, nu=0.3, density=density)
    transform = (np.eye(3) if turn is None else turn, np.asarray(place, dtype=float))
    body = b.add_solid(mesh, material=law, element="T10", transform=transform, name="cube")
    pads = []
    for k, shape in enumerate(shapes):
        obstacle = b.add_collider(shape, path=path, name=f"obstacle {k}")
        pads.append(b.add_contact(body, obstacle, name=f"pad {k}", **options))
    return Scene(b, body, pads, density * side**3)


FLOOR = wf.HalfSpace((0, 0, 1), 0.0)


def momentum(sim: wf.Simulation, body: wf.Body) -> np.ndarray:
    """(3,), kg m/s."""
    model = sim.model
    v = sim.state.velocity.numpy()[0].astype(float)
    return np.asarray(model.lumped_host[body.slots] @ v[body.slots])


def middle(sim: wf.Simulation, s: Scene) -> np.ndarray:
    """Centre of mass (3,), m."""
    m = sim.model.lumped_host[s.body.slots]
    return np.asarray(m @ sim.positions(s.body)[0] / m.sum())


@dataclass
class Watched:
    """Results of a motion with contact.

    Attributes:
        count: iterations.
        impulse: largest difference of a step's change of momentum and its impulse, over the largest impulse.
        pulled: largest friction over mu N, less 1; tensile normal forces count as infinite.
        gained: largest energy above the initial one, over the largest kinetic energy, or that of a fall by a side.
        through: largest depth of the centre of mass below a floor at z = 0, over the side.
    """

    count: Count
    impulse: float = 0.0
    pulled: float = 0.0
    gained: float = 0.0
    through: float = -math.inf

    def answer(self, setting: Setting, error: float | None, bound: float, reference: str, **more: Any) -> Answer:
        """Answer with, by default, the error of the impulse, and the limits common to contacts."""
        limits = self.limits(setting) | more.pop("limits", {})
        worst = self.impulse if error is None else error
        return self.count.answer(worst, bound, reference, limits=limits, **more)

    def limits(self, setting: Setting) -> dict[str, tuple[float, float]]:
        """Numbers common to contacts, and their bounds."""
        return {
            "impulse": (self.impulse, exact(setting, 1e-6, 1e-2)),
            "friction above mu N": (self.pulled, exact(setting, 1e-9, 1e-3)),
            "energy from nowhere": (self.gained, exact(setting, 1e-6, 1e-2)),
        }


def watch(sim: wf.Simulation, s: Scene, steps: int, *, mu: float = 0.0, moves: bool = False) -> Watched:
    """Do steps; `moves`: obstacles do work, and energies are not compared."""
    out = Watched(Count())
    weight = s.mass * np.asarray(s.builder.gravity)
    p = momentum(sim, s.body)
    scale = float(np.linalg.norm(p))
    first, most = total(sim), float(np.linalg.norm(weight)) * SIDE
    for _ in range(steps):
        out.count.step(sim)
        forces = np.array([sim.contact_record(pad).force[0, -1] for pad in s.pads])
        normal = float(sum(sim.contact_record(pad).normal_force[0, -1] for pad in s.pads))
        impulse = sim.dt * (forces.sum(axis=0) + weight)
        now = momentum(sim, s.body)
        scale = max(scale, float(np.linalg.norm(now)), sim.dt * max(normal, float(np.linalg.norm(weight))))
        out.impulse = max(out.impulse, float(np.linalg.norm(now - p - impulse)) / max(scale, 1e-300))
        p = now
        if len(s.pads) == 1 and isinstance(s.pads[0].collider.shape, wf.HalfSpace):
            n = np.asarray(s.pads[0].collider.shape.normal, dtype=float)
            pulled = float(np.linalg.norm(forces[0] - (forces[0] @ n) * n))
            if normal > 0.0:
                out.pulled = max(out.pulled, (pulled - mu * normal) / (max(mu, 1e-3) * normal))
        most = max(most, float(sim.energies()["kinetic"][0]))
        if not moves:
            out.gained = max(out.gained, (total(sim) - first) / most)
        out.through = max(out.through, -middle(sim, s)[2] / SIDE)
    return out


def total(sim: wf.Simulation) -> float:
    """Energy of the model: kinetic, strain, potential and contact, J."""
    e = sim.energies()
    return float(sum(e[name][0] for name in ("kinetic", "strain", "potential", "contact", "contact_pairs")))


def speed_of(sim: wf.Simulation, s: Scene) -> np.ndarray:
    """Velocity of the centre of mass (3,), m/s."""
    return momentum(sim, s.body) / s.mass


OBSTACLES = {
    "half-space": FLOOR,
    "box": wf.Box(center=(SIDE / 2, SIDE / 2, -0.01), size=(0.4, 0.4, 0.02)),
    "sphere": wf.Sphere((SIDE / 2, SIDE / 2, -0.1), 0.1),
}


@case(
    "contact-impact", GROUP, values=tuple((name, E) for name in OBSTACLES for E in (1e6, 1e8)), quick="none",
    refusal=REFUSAL_TEXTS,
)  # fmt: skip
def impact(setting: Setting, value: tuple[str, float]) -> Answer:
    """A cube at 100 m/s onto a half-space, a thin box, a sphere, ten of its sides a step: no penetration."""
    name, E = value
    s = scene(OBSTACLES[name], E=E, gravity=(0, 0, 0), place=(0, 0, 0.3), mu=0.3, restitution=0.5)
    s.builder.set_initial(s.body, velocity=(0, 0, -FAST))
    sim = wf.Simulation(s.model(setting), dt=1e-2)
    seen = watch(sim, s, 5, mu=0.3)
    return seen.answer(setting, max(seen.through, 0.0), 0.0, "the centre stays before the obstacle")


@case("contact-rest", GROUP, values=GRID, quick="none", refusal=SINGLE)
def resting(setting: Setting, value: tuple[float, float]) -> Answer:
    """A cube at rest on the floor, ten steps: it stays, and the floor carries its weight."""
    E, h = value
    s = scene(FLOOR, E=E, mu=0.5, restitution=0.5)
    model = s.model(setting)
    state = wf.solve_static(model, stabilise=True).state
    sim = wf.Simulation(model, state, dt=h)
    before = middle(sim, s)
    seen = watch(sim, s, 10, mu=0.5)
    carried = abs(float(sim.contact_record(s.pads[0]).normal_force[0, -1]) / (s.mass * G) - 1.0)
    moved = float(np.abs(middle(sim, s) - before).max()) / SIDE
    limits = {"moved": (moved, exact(setting, 1e-9, 1e-4))}
    return seen.answer(setting, carried, exact(setting, 1e-6, 1e-2), "sum of normal forces = m g", limits=limits)


@case("contact-slide", GROUP, values=GRID, quick="none", refusal=SINGLE)
def sliding(setting: Setting, value: tuple[float, float]) -> Answer:
    """A cube at rest is given 1 m/s along the floor, ten steps: impulses, and friction mu N against the motion."""
    E, h = value
    s = scene(FLOOR, E=E, mu=0.3, restitution=0.5)
    model = s.model(setting)
    state = wf.solve_static(model, stabilise=True).state
    v = state.velocity.numpy()
    v[:, :, 0] = 1.0
    state.velocity.assign(v)
    sim = wf.Simulation(model, state, dt=h)
    seen = watch(sim, s, 10, mu=0.3)
    record = sim.contact_record(s.pads[0])
    lost = s.mass * (1.0 - speed_of(sim, s)[0])
    rubbed = 0.3 * h * float(record.normal_force[0].sum())
    limits = {"slower than mu N tells": ((lost - rubbed) / (s.mass * 1.0), exact(setting, 1e-9, 1e-4))}
    return seen.answer(setting, None, exact(setting, 1e-6, 1e-2), "impulse of the records", limits=limits)


@case(
    "contact-touch", GROUP, quick="both",
    values=("half-space", "box", "sphere", "capsule", "cylinder", "same faces"),
)  # fmt: skip
def exact_touch(setting: Setting, name: str) -> Answer:
    """A body in initial exact touch, or face on face with a box of its own size, under its weight."""
    shapes = OBSTACLES | {
        "capsule": wf.Capsule((-1, SIDE / 2, -0.05), (1, SIDE / 2, -0.05), 0.05),
        "cylinder": wf.Cylinder((-1, SIDE / 2, -0.05), (1, SIDE / 2, -0.05), 0.05),
        "same faces": wf.Box(center=(SIDE / 2, SIDE / 2, -SIDE / 2), size=(SIDE, SIDE, SIDE)),
    }
    s = scene(shapes[name], mu=0.5, restitution=0.5)
    sim = wf.Simulation(s.model(setting), dt=1e-3)
    seen = watch(sim, s, 50, mu=0.5)
    sunk = float(sim.contact_record(s.pads[0]).penetration[0].max()) / SIDE
    limits = {"sunk": (sunk, 0.05)}
    return seen.answer(setting, None, exact(setting, 1e-6, 1e-2), "impulse of the records", limits=limits)


def corner_down() -> np.ndarray:
    """Rotation of a cube onto its vertex."""
    a = math.atan(math.sqrt(2.0))
    about_z = math.pi / 4
    Rz = np.array([[math.cos(about_z), -math.sin(about_z), 0], [math.sin(about_z), math.cos(about_z), 0], [0, 0, 1]])
    Rx = np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    return Rx @ Rz


def edge_down() -> np.ndarray:
    """Rotation of a cube onto its edge along x."""
    c = math.sqrt(0.5)
    return np.array([[1, 0, 0], [0, c, -c], [0, c, c]])


@case("contact-graze", GROUP, values=(0.0, 1e-12, 1e-9, 1e-6), quick="float64")
def graze(setting: Setting, depth: float) -> Answer:
    """One vertex grazes the floor at 100 m/s: contact of a single point converges."""
    s = scene(
        FLOOR, gravity=(0, 0, 0), turn=corner_down(), place=(0, 0, -depth), mu=0.5, restitution=1.0, overlap="offset",
        overlap_time=1e-3,
    )  # fmt: skip
    s.builder.set_initial(s.body, velocity=(FAST, 0, 0))
    sim = wf.Simulation(s.model(setting), dt=1e-2)
    seen = watch(sim, s, 10, mu=0.5)
    error = float(np.abs(speed_of(sim, s) / FAST - (1, 0, 0)).max())
    limits = {"Newton of a step": (seen.count.worst_newton, NEWTON), "halvings": (seen.count.halvings, 0)}
    return seen.answer(setting, error, exact(setting, 1e-5, 1e-3), "goes on at 100 m/s", limits=limits)


@case("contact-wedge", GROUP, values=(0.0, 0.3), quick="both", refusal=SINGLE)
def wedge(setting: Setting, mu: float) -> Answer:
    """A cube in a trough of 90 degrees, statics: each side carries m g / sqrt(2) if smooth."""
    c = math.sqrt(0.5)
    sides = (wf.HalfSpace((0, c, c), 0.0), wf.HalfSpace((0, -c, c), 0.0))
    s = scene(*sides, turn=edge_down(), mu=mu)
    count = Count()
    result = wf.solve_static(s.model(setting), stabilise=True, outputs=[count])
    records = [result.simulation.contact_record(pad) for pad in s.pads]
    force = sum(r.force[0, -1] for r in records)
    error = float(np.abs(force / (s.mass * G) - (0, 0, 1)).max())
    if mu == 0.0:
        error = max(error, *(abs(r.normal_force[0, -1] / (s.mass * G * c) - 1.0) for r in records))
    return count.answer(error, exact(setting, 1e-6, 1e-3), "sum of forces = m g; each m g cos 45")


@case("contact-corner", GROUP, values=("edge", "vertex"), quick="float64")
def corner(setting: Setting, which: str) -> Answer:
    """A cube driven rigidly with its edge or vertex into an obstacle: closed-form forces of a penalty per area."""
    depth = SIDE / 4
    turn = edge_down() if which == "edge" else corner_down()
    s = scene(FLOOR, gravity=(0, 0, 0), turn=turn, cells=12 if which == "edge" else 16, mu=0.0)
    s.builder.drive(s.body.nodes(lambda X: np.ones(len(X), bool)), displacement=(0, 0, -depth))
    count = Count()
    result = wf.solve_static(s.model(setting), load_steps=1, stabilise=True, outputs=[count])
    area = 6.0 * SIDE**2
    per_area = 4.0 / 3.0 * 1e6 / (1.0 - 0.09) * math.sqrt(area / math.pi) / area
    # integrals of the depth over the reference areas of all faces; the ends of an edge are faces too
    integral = 1.5 * depth**3
    if which == "edge":
        integral = math.sqrt(2.0) * SIDE * depth**2 + 2.0 / 3.0 * depth**3
    wanted = per_area * integral
    found = float(result.simulation.contact_record(s.pads[0]).normal_force[0, -1])
    return count.answer(abs(found / wanted - 1.0), 0.02, "k_A (sqrt(2) w d^2 + 2/3 d^3); k_A 3/2 d^3")


@case("contact-mu", GROUP, values=(0.0, 10.0), quick="float64")
def extreme_friction(setting: Setting, mu: float) -> Answer:
    """A cube slides over a smooth floor, or one of mu = 10, at 1 m/s."""
    s = scene(FLOOR, mu=mu, restitution=0.5)
    s.builder.set_initial(s.body, velocity=(1.0, 0, 0))
    sim = wf.Simulation(s.model(setting), dt=1e-3)
    seen = watch(sim, s, 50, mu=mu)
    if mu > 0.0:
        return seen.answer(setting, None, exact(setting, 1e-6, 1e-2), "impulse of the records")
    error = float(abs(speed_of(sim, s)[0] - 1.0))
    return seen.answer(setting, error, exact(setting, 1e-7, 1e-3), "nothing slows it down")


@case("contact-restitution", GROUP, values=(1e-3, 1.0), quick="float64")
def extreme_restitution(setting: Setting, e: float) -> Answer:
    """A cube much stiffer than its contact lands flat at 1 m/s, 200 steps: e = 0.001 gives almost no rebound, e = 1
    no contact loss.
    """
    s = scene(FLOOR, E=1e9, gravity=(0, 0, 0), place=(0, 0, 1e-3), mu=0.0, restitution=e, stiffness=1e-3)
    s.builder.set_initial(s.body, velocity=(0, 0, -1.0))
    sim = wf.Simulation(s.model(setting), dt=1e-4)
    seen = watch(sim, s, 200)
    up, loss = float(speed_of(sim, s)[2]), abs(float(sim.energies()["contact_loss"][0])) / (0.5 * s.mass)
    if e == 1.0:
        limits = {"faster than it came": (up - 1.0, exact(setting, 1e-9, 1e-4)), "slower than half": (0.5 - up, 0.0)}
        return seen.answer(setting, loss, exact(setting, 1e-12, 1e-6), "contact loses nothing", limits=limits)
    return seen.answer(setting, max(up, 0.0), 0.01, "e = 0.001, and backward Euler's own loss")


@case(
    "contact-jump", GROUP, values=(0.005, 0.05, 0.5), quick="none",
    refusal=REFUSAL_TEXTS,
)  # fmt: skip
def jump(setting: Setting, height: float) -> Answer:
    """The floor jumps by 5, 50 or 500 mm into a resting cube of 100 mm within a step: above it after, or refused."""
    path = ((0.0, 0.0100001, 0.0100002, 1.0), [(0, 0, z) for z in (0.0, 0.0, height, height)])
    s = scene(FLOOR, path=path, mu=0.5, restitution=0.5)
    sim = wf.Simulation(s.model(setting), dt=1e-3)
    seen = watch(sim, s, 20, mu=0.5, moves=True)
    behind = max(height - float(middle(sim, s)[2]), 0.0) / SIDE
    return seen.answer(setting, behind, 0.0, "the body is above the floor")


@case("contact-scale", GROUP, values=(1e-3, 1.0, 1e3, 1e6), quick="float64", refusal=SINGLE)
def scales(setting: Setting, side: float) -> Answer:
    """Cubes of a millimetre to 1000 km at rest, of equal relative stiffness: the floor carries their weight."""
    s = scene(FLOOR, E=1e4 * DENSITY * G * side, side=side, mu=0.5)
    count = Count()
    result = wf.solve_static(s.model(setting), stabilise=True, outputs=[count])
    record = result.simulation.contact_record(s.pads[0])
    error = abs(float(record.normal_force[0, -1]) / (s.mass * G) - 1.0)
    return count.answer(error, exact(setting, 1e-7, 1e-3), "sum of normal forces = m g")
