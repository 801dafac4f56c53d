"""Contact with obstacles: fast impacts, stiff bodies, exact touch, edges and vertices, extremes of each parameter.

Criteria for a deformable body: at rest the contacts carry its weight; in every step its change of momentum equals
the impulse of the recorded forces and its weight; friction is at most mu N; no energy is gained.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import warpfea as wf

from ..build import GRAVITY_VECTOR, StepStats, finalize, solve
from ..case import FLOAT32_REFUSAL, Answer, Setting, case

GROUP = "contact"
SIDE, DENSITY, GRAVITY = 0.1, 1000.0, 9.81
MODULI, STEPS = (1e4, 1e6, 1e8, 1e11), (1e-5, 1e-3, 1e-2)
MODULI_AND_STEPS = tuple((E, h) for E in MODULI for h in STEPS)
REFUSAL_TEXTS = ["collider", "inverted", "J <= 0"]
FAST_IMPACT = 100.0
"""Speed of impacts, m/s."""
MAX_NEWTON = 60
"""Maximum iterations of a step with grazing contact."""


def bound_for(setting: Setting, double: float = 1e-7, single: float = 2e-3) -> float:
    """Bound of an error in the precision of the setting."""
    return single if setting.single else double


@dataclass
class ContactScene:
    """A body on obstacles, or on another body.

    Attributes:
        builder: its builder.
        body: the first body of the contacts, a cube.
        contacts: one per obstacle.
        mass: of the cube, kg.
        fall_energy: of a fall by a side, J.
        lower: the second body of the contact, if any.
        clamped: True if the second body is fixed.
    """

    builder: wf.ModelBuilder
    body: wf.Body
    contacts: list[Any]
    mass: float
    fall_energy: float
    lower: wf.Body | None = None
    clamped: bool = True

    def release(
        self, setting: Setting, steps: int, *, dt: float = 1e-3, velocity: Any = None, **options: Any
    ) -> "ContactMotion":
        """Simulate from the initial state, with the cube's velocity, m/s; options as of `simulate`."""
        if velocity is not None:
            self.builder.set_initial(self.body, velocity=velocity)
        return self.simulate(wf.Simulation(finalize(self.builder, setting), dt=dt), steps, **options)

    def simulate(
        self, sim: wf.Simulation, steps: int, *, mu: float | None = None, moves: bool = False
    ) -> "ContactMotion":
        """Step and measure.

        With `mu` friction in a half-space's plane, or in z = 0 between bodies, is compared with mu N; `moves`:
        obstacles do work, and energies are not compared.
        """
        out = ContactMotion(sim, self.lower is not None)
        gravity = np.asarray(self.builder.description.gravity, dtype=float)
        bodies = [(self.body, 1.0)]
        if self.lower is not None and not self.clamped:
            bodies.append((self.lower, -1.0))
        weights = [
            float(sim.model.masses.lumped[0][body.slot_range] @ (body.slot_kind == 0)) * gravity for body, _ in bodies
        ]
        p = [momentum(sim, body) for body, _ in bodies]
        scale = max(float(np.linalg.norm(x)) for x in p)
        first, most = total_energy(sim), self.fall_energy
        for _ in range(steps):
            out.stats.step(sim)
            records = [sim.contact_record(pad) for pad in self.contacts]
            force = sum(record.force[0, -1] for record in records)
            normal = float(sum(record.normal_force[0, -1] for record in records))
            for k, (body, sign) in enumerate(bodies):
                impulse = sim.dt * (sign * force + weights[k])
                now = momentum(sim, body)
                scale = max(scale, float(np.linalg.norm(now)), sim.dt * max(normal, float(np.linalg.norm(weights[k]))))
                out.impulse_error = max(
                    out.impulse_error, float(np.linalg.norm(now - p[k] - impulse)) / max(scale, 1e-300)
                )
                p[k] = now
            if mu is not None:
                out.friction_excess = max(out.friction_excess, self.friction_excess(force, normal, mu))
            most = max(most, float(sim.energies()["kinetic"][0]))
            if not moves:
                out.energy_gain = max(out.energy_gain, (total_energy(sim) - first) / most)
            base = 0.0 if self.lower is None else center_of_mass(sim, self.lower)[2]
            out.center_depth = max(out.center_depth, float(base - center_of_mass(sim, self.body)[2]) / SIDE)
        return out

    def friction_excess(self, force: np.ndarray, normal: float, mu: float) -> float:
        """Friction above mu N, over mu N; 0 without a plane of contact, or a normal force."""
        least = max(mu, 1e-3) * normal
        if self.lower is not None:
            return float(np.linalg.norm(force[:2])) / least - 1.0 if normal > 1e-6 * self.mass * GRAVITY else 0.0
        shape = self.contacts[0].collider.shape
        if len(self.contacts) > 1 or not isinstance(shape, wf.HalfSpace) or normal <= 0.0:
            return 0.0
        n = np.asarray(shape.normal, dtype=float)
        return (float(np.linalg.norm(force - (force @ n) * n)) - mu * normal) / least

    def solve(self, setting: Setting, **options: Any) -> tuple[StepStats, list[Any]]:
        """Statistics of the stabilised equilibrium, and the record of each contact."""
        found = solve(self.builder, setting, stabilise=True, **options)
        return found.stats, [found.result.simulation.contact_record(pad) for pad in self.contacts]


def make_scene(
    *shapes: Any, E: float = 1e6, side: float = SIDE, gravity: Any = GRAVITY_VECTOR, rotation: np.ndarray | None = None,
    translation: Any = (0.0, 0.0, 0.0), cells: int = 2, path: Any = None, density: float = DENSITY, **options: Any,
) -> ContactScene:  # fmt: skip
    """A T10 cube with a corner at the origin, rotated about it and moved by `translation`, m; contacts with shapes."""
    b = wf.ModelBuilder(gravity=gravity)
    mesh = wf.mesh.box((side,) * 3, cells=(cells,) * 3)
    law = wf.SVK(E=E, nu=0.3, density=density)
    transform = (np.eye(3) if rotation is None else rotation, np.asarray(translation, dtype=float))
    body = b.add_solid(mesh, material=law, element="T10", transform=transform, name="cube")
    contacts = []
    for k, shape in enumerate(shapes):
        obstacle = b.add_collider(shape, path=path, name=f"obstacle {k}")
        contacts.append(b.add_contact(body, obstacle, name=f"pad {k}", **options))
    mass = density * side**3
    return ContactScene(b, body, contacts, mass, mass * float(np.linalg.norm(gravity)) * SIDE)


FLOOR = wf.HalfSpace((0, 0, 1), 0.0)


def momentum(sim: wf.Simulation, body: wf.Body) -> np.ndarray:
    """Linear momentum (3,), kg m/s."""
    model = sim.model
    v = sim.state.velocity.numpy()[0].astype(float)
    return np.asarray(model.masses.lumped[0][body.slot_range] @ v[body.slot_range])


def center_of_mass(sim: wf.Simulation, body: wf.Body) -> np.ndarray:
    """Centre of mass (3,), m."""
    m = sim.model.masses.lumped[0][body.slot_range] * (body.slot_kind == 0)
    x = body.reference + np.where(body.slot_kind[:, None] == 0, body.origin, 0.0)
    return np.asarray(m @ (x + sim.state.displacement.numpy()[0, body.slot_range]) / m.sum())


@dataclass
class ContactMotion:
    """Errors of a motion with contact.

    Attributes:
        sim: at the end of the motion. pair: True for two bodies. stats: iterations.
        impulse_error: largest difference of a step's change of momentum and its impulse, over the largest impulse.
        friction_excess: largest friction over mu N, less 1; tensile normal forces count as infinite.
        energy_gain: largest energy above the initial one, over the largest kinetic energy, or that of a fall by a side.
        center_depth: largest depth of the centre of mass below a floor at z = 0, or that of the other body, over the
            side.
    """

    sim: wf.Simulation
    pair: bool
    stats: StepStats = field(default_factory=StepStats)
    impulse_error: float = 0.0
    friction_excess: float = 0.0
    energy_gain: float = 0.0
    center_depth: float = -math.inf

    def answer(self, setting: Setting, error: float, bound: float, reference: str, **more: Any) -> Answer:
        """Answer with the limits common to contacts."""
        limits = self.limits(setting) | more.pop("limits", {})
        return self.stats.answer(error, bound, reference, limits=limits, **more)

    def impulse_answer(self, setting: Setting, **more: Any) -> Answer:
        """Answer whose error is that of the impulse."""
        bound = bound_for(setting, 1e-6, 1e-2)
        return self.answer(setting, self.impulse_error, bound, "impulse of the records", **more)

    def limits(self, setting: Setting) -> dict[str, tuple[float, float]]:
        """Errors that all contact cases bound: {name: (error, bound)}."""
        limits = {
            "impulse": (self.impulse_error, bound_for(setting, 1e-6, 1e-2)),
            "friction above mu N": (self.friction_excess, 1e-2 if self.pair else bound_for(setting, 1e-9, 1e-3)),
            "energy from nowhere": (self.energy_gain, bound_for(setting, 1e-6, 1e-2)),
        }
        return limits | ({"centre past the other body": (self.center_depth, 0.0)} if self.pair else {})


def total_energy(sim: wf.Simulation) -> float:
    """Energy of the model: kinetic, strain, potential and contact, J."""
    e = sim.energies()
    return float(sum(e[name][0] for name in ("kinetic", "strain", "potential", "contact", "contact_pairs")))


def center_velocity(sim: wf.Simulation, s: ContactScene) -> np.ndarray:
    """Velocity of the centre of mass (3,), m/s."""
    return momentum(sim, s.body) / s.mass


OBSTACLES = {
    "half-space": FLOOR,
    "box": wf.Box(center=(SIDE / 2, SIDE / 2, -0.01), size=(0.4, 0.4, 0.02)),
    "sphere": wf.Sphere((SIDE / 2, SIDE / 2, -0.1), 0.1),
}


@case("contact-impact", GROUP, values=tuple((name, E) for name in OBSTACLES for E in (1e6, 1e8)), refusal=REFUSAL_TEXTS)
def impact(setting: Setting, value: tuple[str, float]) -> Answer:
    """A cube at 100 m/s onto a half-space, a thin box, a sphere, ten of its sides a step: no penetration."""
    return strike(setting, OBSTACLES[value[0]], value[1])


def strike(setting: Setting, shape: Any, E: float) -> Answer:
    """A cube hits an obstacle at 100 m/s."""
    s = make_scene(shape, E=E, gravity=(0, 0, 0), translation=(0, 0, 0.3), mu=0.3, restitution=0.5)
    run = s.release(setting, 5, dt=1e-2, velocity=(0, 0, -FAST_IMPACT), mu=0.3)
    return run.answer(setting, max(run.center_depth, 0.0), 0.0, "the centre stays before the obstacle")


def at_rest(setting: Setting, E: float, mu: float) -> tuple[ContactScene, wf.Model, wf.State]:
    """A cube of a modulus at rest on the floor."""
    s = make_scene(FLOOR, E=E, mu=mu, restitution=0.5)
    model = finalize(s.builder, setting)
    return s, model, wf.solve_static(model, stabilise=True).state


@case("contact-rest", GROUP, values=MODULI_AND_STEPS, quick="none", refusal=FLOAT32_REFUSAL)
def rest_on_floor(setting: Setting, value: tuple[float, float]) -> Answer:
    """A cube at rest on the floor, ten steps: it stays, and the floor carries its weight."""
    E, h = value
    s, model, state = at_rest(setting, E, 0.5)
    sim = wf.Simulation(model, state, dt=h)
    before = center_of_mass(sim, s.body)
    run = s.simulate(sim, 10, mu=0.5)
    carried = abs(float(sim.contact_record(s.contacts[0]).normal_force[0, -1]) / (s.mass * GRAVITY) - 1.0)
    moved = float(np.abs(center_of_mass(sim, s.body) - before).max()) / SIDE
    limits = {"moved": (moved, bound_for(setting, 1e-9, 1e-4))}
    return run.answer(setting, carried, bound_for(setting, 1e-6, 1e-2), "sum of normal forces = m g", limits=limits)


@case("contact-slide", GROUP, values=MODULI_AND_STEPS, quick="none", refusal=FLOAT32_REFUSAL)
def sliding(setting: Setting, value: tuple[float, float]) -> Answer:
    """A cube at rest is given 1 m/s along the floor, ten steps: impulses, and friction mu N against the motion."""
    E, h = value
    s, model, state = at_rest(setting, E, 0.3)
    v = state.velocity.numpy()
    v[:, :, 0] = 1.0
    state.velocity.assign(v)
    sim = wf.Simulation(model, state, dt=h)
    run = s.simulate(sim, 10, mu=0.3)
    record = sim.contact_record(s.contacts[0])
    lost = s.mass * (1.0 - center_velocity(sim, s)[0])
    rubbed = 0.3 * h * float(record.normal_force[0].sum())
    limits = {"slower than mu N tells": ((lost - rubbed) / (s.mass * 1.0), bound_for(setting, 1e-9, 1e-4))}
    return run.impulse_answer(setting, limits=limits)


@case("contact-touch", GROUP, quick="both", values=(*OBSTACLES, "capsule", "cylinder", "same faces"))
def exact_touch(setting: Setting, name: str) -> Answer:
    """A body in initial exact touch, or face on face with a box of its own size, under its weight."""
    shapes = OBSTACLES | {
        "capsule": wf.Capsule((-1, SIDE / 2, -0.05), (1, SIDE / 2, -0.05), 0.05),
        "cylinder": wf.Cylinder((-1, SIDE / 2, -0.05), (1, SIDE / 2, -0.05), 0.05),
        "same faces": wf.Box(center=(SIDE / 2, SIDE / 2, -SIDE / 2), size=(SIDE, SIDE, SIDE)),
    }
    s = make_scene(shapes[name], mu=0.5, restitution=0.5)
    run = s.release(setting, 50, mu=0.5)
    sunk = float(run.sim.contact_record(s.contacts[0]).penetration[0].max()) / SIDE
    return run.impulse_answer(setting, limits={"sunk": (sunk, 0.05)})


def vertex_down() -> np.ndarray:
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
def grazing_vertex(setting: Setting, depth: float) -> Answer:
    """One vertex grazes the floor at 100 m/s: contact of a single point converges."""
    s = make_scene(
        FLOOR, gravity=(0, 0, 0), rotation=vertex_down(), translation=(0, 0, -depth), mu=0.5, restitution=1.0,
        overlap="offset", overlap_time=1e-3,
    )  # fmt: skip
    run = s.release(setting, 10, dt=1e-2, velocity=(FAST_IMPACT, 0, 0), mu=0.5)
    error = float(np.abs(center_velocity(run.sim, s) / FAST_IMPACT - (1, 0, 0)).max())
    limits = {"Newton of a step": (run.stats.worst_newton, MAX_NEWTON), "halvings": (run.stats.halvings, 0)}
    return run.answer(setting, error, bound_for(setting, 1e-5, 1e-3), "goes on at 100 m/s", limits=limits)


@case("contact-wedge", GROUP, values=(0.0, 0.3), quick="both", refusal=FLOAT32_REFUSAL)
def cube_in_trough(setting: Setting, mu: float) -> Answer:
    """A cube in a trough of 90 degrees, statics: each side carries m g / sqrt(2) if smooth."""
    c = math.sqrt(0.5)
    sides = (wf.HalfSpace((0, c, c), 0.0), wf.HalfSpace((0, -c, c), 0.0))
    s = make_scene(*sides, rotation=edge_down(), mu=mu)
    stats, records = s.solve(setting)
    force = sum(r.force[0, -1] for r in records)
    error = float(np.abs(force / (s.mass * GRAVITY) - (0, 0, 1)).max())
    if mu == 0.0:
        error = max(error, *(abs(r.normal_force[0, -1] / (s.mass * GRAVITY * c) - 1.0) for r in records))
    return stats.answer(error, bound_for(setting, 1e-6, 1e-3), "sum of forces = m g; each m g cos 45")


@case("contact-corner", GROUP, values=("edge", "vertex"), quick="float64")
def pressed_corner(setting: Setting, which: str) -> Answer:
    """A cube driven rigidly with its edge or vertex into an obstacle: closed-form forces of a penalty per area."""
    depth = SIDE / 4
    rotation = edge_down() if which == "edge" else vertex_down()
    s = make_scene(FLOOR, gravity=(0, 0, 0), rotation=rotation, cells=12 if which == "edge" else 16, mu=0.0,
                   stiffness="region")  # fmt: skip
    s.builder.drive(s.body.nodes(lambda X: np.ones(len(X), bool)), displacement=(0, 0, -depth))
    stats, (record,) = s.solve(setting, load_steps=1)
    area = 6.0 * SIDE**2
    per_area = 4.0 / 3.0 * 1e6 / (1.0 - 0.09) * math.sqrt(area / math.pi) / area
    # integrals of the depth over the reference areas of all faces; the ends of an edge are faces too
    integral = 1.5 * depth**3
    if which == "edge":
        integral = math.sqrt(2.0) * SIDE * depth**2 + 2.0 / 3.0 * depth**3
    wanted = per_area * integral
    return stats.answer(
        abs(float(record.normal_force[0, -1]) / wanted - 1.0), 0.02, "k_A (sqrt(2) w d^2 + 2/3 d^3); k_A 3/2 d^3"
    )


@case("contact-mu", GROUP, values=(0.0, 10.0), quick="float64")
def extreme_friction(setting: Setting, mu: float) -> Answer:
    """A cube slides over a smooth floor, or one of mu = 10, at 1 m/s."""
    s = make_scene(FLOOR, mu=mu, restitution=0.5)
    run = s.release(setting, 50, velocity=(1.0, 0, 0), mu=mu)
    if mu > 0.0:
        return run.impulse_answer(setting)
    error = float(abs(center_velocity(run.sim, s)[0] - 1.0))
    return run.answer(setting, error, bound_for(setting, 1e-7, 1e-3), "nothing slows it down")


@case("contact-restitution", GROUP, values=(1e-3, 1.0), quick="float64")
def extreme_restitution(setting: Setting, e: float) -> Answer:
    """A cube much stiffer than its contact lands flat at 1 m/s: no rebound at e = 0.001, no contact loss at e = 1."""
    s = make_scene(
        FLOOR, E=1e9, gravity=(0, 0, 0), translation=(0, 0, 1e-3), mu=0.0, restitution=e, stiffness=("region", 1e-3)
    )
    run = s.release(setting, 200, dt=1e-4, velocity=(0, 0, -1.0), mu=0.0)
    up, loss = float(center_velocity(run.sim, s)[2]), abs(float(run.sim.energies()["contact_loss"][0])) / (0.5 * s.mass)
    if e == 1.0:
        limits = {
            "faster than it came": (up - 1.0, bound_for(setting, 1e-9, 1e-4)),
            "slower than half": (0.5 - up, 0.0),
        }
        return run.answer(setting, loss, bound_for(setting, 1e-12, 1e-6), "contact loses nothing", limits=limits)
    return run.answer(setting, max(up, 0.0), 0.01, "e = 0.001, and backward Euler's own loss")


@case("contact-jump", GROUP, values=(0.005, 0.05, 0.5), refusal=REFUSAL_TEXTS)
def floor_jump(setting: Setting, height: float) -> Answer:
    """The floor jumps by 5, 50 or 500 mm into a resting cube of 100 mm within a step: above it after, or refused."""
    path = ((0.0, 0.0100001, 0.0100002, 1.0), [(0, 0, z) for z in (0.0, 0.0, height, height)])
    s = make_scene(FLOOR, path=path, mu=0.5, restitution=0.5)
    run = s.release(setting, 20, mu=0.5, moves=True)
    behind = max(height - float(center_of_mass(run.sim, s.body)[2]), 0.0) / SIDE
    return run.answer(setting, behind, 0.0, "the body is above the floor")


@case("contact-scale", GROUP, values=(1e-3, 1.0, 1e3, 1e6), quick="float64", refusal=FLOAT32_REFUSAL)
def length_scales(setting: Setting, side: float) -> Answer:
    """Cubes of a millimetre to 1000 km at rest, of equal relative stiffness: the floor carries their weight."""
    s = make_scene(FLOOR, E=1e4 * DENSITY * GRAVITY * side, side=side, mu=0.5)
    stats, (record,) = s.solve(setting)
    error = abs(float(record.normal_force[0, -1]) / (s.mass * GRAVITY) - 1.0)
    return stats.answer(error, bound_for(setting, 1e-7, 1e-3), "sum of normal forces = m g")
