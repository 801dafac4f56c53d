"""Contact between bodies: fast impacts, stiff on soft, vertices, edges and faces, exact touch, thin bodies, extremes.

Criteria for both bodies: in every step the change of momentum equals the impulse of the recorded forces and the
weight; friction is at most mu N; no energy is gained; no centre of mass passes the other body.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

import warpfea as wf

from ..build import DOWN, Count
from ..case import DTYPES, Answer, Setting, case
from .contact import Watched, corner_down, edge_down, exact, momentum, total

GROUP = "pairs"
SIDE, DENSITY, G = 0.1, 1000.0, 9.81
REFUSAL_TEXTS = {dtype: ["through body", "inverted", "J <= 0"] for dtype in DTYPES}
REFUSAL_TEXTS["float32"].append("float32")
SINGLE = {"float32": ["float32"]}
FAST = 100.0
"""Speed of impacts, m/s."""


@dataclass
class Pair:
    """A body on another one.

    Attributes:
        builder: their builder.
        upper, lower: the first and the second body of the contact.
        pad: the contact.
        held: the lower one is clamped.
    """

    builder: wf.ModelBuilder
    upper: wf.Body
    lower: wf.Body
    pad: Any
    held: bool

    def model(self, setting: Setting) -> wf.Model:
        """Model for the setting's device and precision."""
        return self.builder.finalize(device=setting.device, dtype=setting.dtype)


def pair(
    *, E: tuple[float, float] = (1e6, 1e6), density: tuple[float, float] = (DENSITY, DENSITY), gravity: Any = DOWN,
    turn: np.ndarray | None = None, place: Any = (0.0, 0.0, 0.0), thickness: float = SIDE, width: float = 3 * SIDE,
    across: int = 3, held: bool = True, shell: bool = False, **options: Any,
) -> Pair:  # fmt: skip
    """A T10 cube whose lowest face, edge or vertex is at `place`, on a plate below z = 0."""
    b = wf.ModelBuilder(gravity=gravity)
    turn = np.eye(3) if turn is None else turn
    corners = np.array([(x, y, z) for x in (0, SIDE) for y in (0, SIDE) for z in (0, SIDE)]) @ turn.T
    middle = np.array([corners[:, 0].mean(), corners[:, 1].mean(), corners[:, 2].min()])
    laws = [wf.SVK(E=modulus, nu=0.3, density=rho) for modulus, rho in zip(E, density)]
    mesh = wf.mesh.box((SIDE,) * 3, cells=(2,) * 3)
    move = (turn, np.asarray(place, dtype=float) - middle)
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
    if held:
        for side in ("x-", "x+", "y-", "y+"):
            b.clamp(lower.nodes(side))
    return Pair(b, upper, lower, b.add_contact(upper, face, name="pad", **options), held)


class WatchedPair(Watched):
    """Results of a motion of two bodies: pulled for level contact; through: depth of the upper centre of mass below
    that of the lower one, over the side.
    """

    def limits(self, setting: Setting) -> dict[str, tuple[float, float]]:
        """Numbers common to contacts, and their bounds."""
        return super().limits(setting) | {
            "friction above mu N": (self.pulled, 1e-2),
            "centre past the other body": (self.through, 0.0),
        }


def center(sim: wf.Simulation, body: wf.Body) -> np.ndarray:
    """Centre of mass (3,), m."""
    m = sim.model.lumped_host[body.slots] * (body.slot_kind == 0)
    x = body.reference + np.where(body.slot_kind[:, None] == 0, body.origin, 0.0)
    return np.asarray(m @ (x + sim.state.displacement.numpy()[0, body.slots]) / m.sum())


def watch(sim: wf.Simulation, s: Pair, steps: int, *, mu: float | None = None) -> WatchedPair:
    """Do steps; `mu`: friction in the plane z = 0 is compared."""
    out = WatchedPair(Count())
    bodies = [(s.upper, 1.0)] + ([] if s.held else [(s.lower, -1.0)])
    gravity = np.asarray(s.builder.gravity, dtype=float)
    mass = [float(sim.model.lumped_host[body.slots] @ (body.slot_kind == 0)) for body, _ in bodies]
    p = [momentum(sim, body) for body, _ in bodies]
    scale = max(float(np.linalg.norm(x)) for x in p)
    first, most = total(sim), mass[0] * G * SIDE
    for _ in range(steps):
        out.count.step(sim)
        record = sim.contact_record(s.pad)
        force, normal = record.force[0, -1], float(record.normal_force[0, -1])
        for k, (body, sign) in enumerate(bodies):
            impulse = sim.dt * (sign * force + mass[k] * gravity)
            now = momentum(sim, body)
            scale = max(scale, float(np.linalg.norm(now)), sim.dt * normal, sim.dt * mass[k] * G)
            out.impulse = max(out.impulse, float(np.linalg.norm(now - p[k] - impulse)) / scale)
            p[k] = now
        if mu is not None and normal > 1e-6 * mass[0] * G:
            out.pulled = max(out.pulled, float(np.linalg.norm(force[:2])) / (max(mu, 1e-3) * normal) - 1.0)
        most = max(most, float(sim.energies()["kinetic"][0]))
        out.gained = max(out.gained, (total(sim) - first) / most)
        out.through = max(out.through, float(center(sim, s.lower)[2] - center(sim, s.upper)[2]) / SIDE)
    return out


@case("pairs-impact", GROUP, values=tuple((E, h) for E in (1e6, 1e8, 1e10) for h in (1e-3, 1e-2)), quick="none",
      refusal=REFUSAL_TEXTS)  # fmt: skip
def impact(setting: Setting, value: tuple[float, float]) -> Answer:
    """A cube at 100 m/s onto a free plate a tenth as thick, up to ten sides a step: no penetration."""
    E, h = value
    s = pair(E=(E, E), gravity=(0, 0, 0), place=(0, 0, 0.3), thickness=0.01, held=False, mu=0.3, restitution=0.5)
    s.builder.set_initial(s.upper, velocity=(0, 0, -FAST))
    seen = watch(wf.Simulation(s.model(setting), dt=h), s, 8)
    return seen.answer(setting, max(seen.through, 0.0), 0.0, "the centre stays before the plate")


@case("pairs-shell", GROUP, values=(1.0, 20.0, 100.0), quick="none", refusal=REFUSAL_TEXTS)
def thin_shell(setting: Setting, speed: float) -> Answer:
    """A cube hits a shell of a hundredth of its side at 1 to 100 m/s, h = 1 ms: no penetration."""
    s = pair(E=(1e6, 1e8), gravity=(0, 0, 0), place=(0, 0, 0.05), thickness=1e-3, shell=True, mu=0.3, restitution=0.5,
             stiffness=1e4)  # fmt: skip
    s.builder.set_initial(s.upper, velocity=(0, 0, -speed))
    seen = watch(wf.Simulation(s.model(setting), dt=1e-3), s, 60)
    return seen.answer(setting, max(seen.through, 0.0), 0.0, "the centre stays before the shell")


STIFF = tuple((a, b) for a in (1e4, 1e7, 1e10) for b in (1e4, 1e7, 1e10) if a != b)


@case("pairs-stiff", GROUP, values=STIFF, quick="none", refusal=SINGLE)
def stiff_on_soft(setting: Setting, E: tuple[float, float]) -> Answer:
    """A cube of 1e4 to 1e10 Pa falls by a hundredth of its side on a plate of another one, 30 steps of 1 ms."""
    s = pair(E=E, place=(0, 0, 0.01 * SIDE), mu=0.5, restitution=0.5)
    s.builder.set_initial(s.upper, velocity=(0, 0, -0.3))
    seen = watch(wf.Simulation(s.model(setting), dt=1e-3), s, 30, mu=0.5)
    return seen.answer(setting, None, exact(setting, 1e-6, 1e-2), "impulse of the records")


TURNS: dict[str, Any] = {"face": None, "edge": edge_down(), "vertex": corner_down()}


@case("pairs-meet", GROUP, values=tuple((name, at) for name in TURNS for at in ("middle", "border")), quick="both")
def meet(setting: Setting, value: tuple[str, str]) -> Answer:
    """A face, an edge or a vertex lands at 1 m/s on a facet's centre, or on a facet border; 40 steps of 1 ms."""
    name, at = value
    spot = 0.02 if at == "middle" else 0.05
    s = pair(turn=TURNS[name], place=(spot, spot, 0.005), mu=0.3, restitution=0.5, across=3)
    s.builder.set_initial(s.upper, velocity=(0, 0, -1.0))
    seen = watch(wf.Simulation(s.model(setting), dt=1e-3), s, 40)
    return seen.answer(setting, None, exact(setting, 1e-6, 1e-2), "impulse of the records")


@case("pairs-touch", GROUP, values=("plate", "same faces"), quick="both", refusal=SINGLE)
def exact_touch(setting: Setting, name: str) -> Answer:
    """A cube in initial exact touch with a plate, or face on face with a cube of its own, under its weight."""
    same: dict[str, Any] = {"width": SIDE, "across": 2} if name == "same faces" else {}
    s = pair(mu=0.5, restitution=0.5, **same)
    seen = watch(wf.Simulation(s.model(setting), dt=1e-3), s, 50, mu=0.5)
    return seen.answer(setting, None, exact(setting, 1e-6, 1e-2), "impulse of the records")


@case("pairs-rest", GROUP, values=(1e-3, 1.0, 1e3), quick="float64", refusal=SINGLE)
def mass_ratio(setting: Setting, ratio: float) -> Answer:
    """Statics: a cube 1e3 times lighter or heavier than its plate rests on it; the force is its weight."""
    E = max(1e7, 1e4 * ratio * DENSITY)
    s = pair(E=(E, E), density=(ratio * DENSITY, DENSITY), mu=0.5)
    count = Count()
    result = wf.solve_static(s.model(setting), stabilise=True, outputs=[count])
    record = result.simulation.contact_record(s.pad)
    weight = ratio * DENSITY * SIDE**3 * G
    error = abs(float(record.force[0, -1, 2]) / weight - 1.0)
    return count.answer(error, exact(setting, 1e-5, 1e-2), "force = m g")


@case("pairs-edge", GROUP, values=(0.0, 0.3), quick="float64")
def over_the_edge(setting: Setting, mu: float) -> Answer:
    """A cube at 2 m/s slides over the edge of a plate, tips and falls free: 120 steps of 1 ms."""
    s = pair(place=(SIDE, 0, 0), mu=mu, restitution=0.5)
    s.builder.set_initial(s.upper, velocity=(2.0, 0, 0))
    seen = watch(wf.Simulation(s.model(setting), dt=1e-3), s, 120)
    return seen.answer(setting, None, exact(setting, 1e-6, 1e-2), "impulse of the records",
                       limits={"centre past the other body": (0.0, 0.0)})  # fmt: skip


@case("pairs-mu", GROUP, values=(0.0, 10.0), quick="float64")
def extreme_friction(setting: Setting, mu: float) -> Answer:
    """A cube slides over a smooth plate, or one of mu = 10, at 1 m/s."""
    s = pair(place=(-0.5 * SIDE, 0, 0), E=(1e6, 1e8), mu=mu, restitution=0.5)
    s.builder.set_initial(s.upper, velocity=(1.0, 0, 0))
    seen = watch(wf.Simulation(s.model(setting), dt=1e-3), s, 50, mu=mu)
    return seen.answer(setting, None, exact(setting, 1e-6, 1e-2), "impulse of the records")


@case("pairs-spin", GROUP, values=(1.0, 30.0), quick="float64")
def spinning_stack(setting: Setting, rate: float) -> Answer:
    """A cube on a free one of its own size, pressed together, both spun about their common axis: they turn as one, 40
    steps of 1 ms."""
    s = pair(width=SIDE, across=2, held=False, gravity=(0, 0, 0), mu=0.8, restitution=0.5)
    b = s.builder
    for body in (s.upper, s.lower):
        b.set_initial(body, velocity=lambda X: rate * np.cross((0.0, 0.0, 1.0), X))
    b.add_traction(s.upper.surface("z+"), (0, 0, -1e3))
    b.add_traction(s.lower.surface("z-"), (0, 0, 1e3))
    sim = wf.Simulation(s.model(setting), dt=1e-3)
    count = Count()
    start = float(sim.energies()["kinetic"][0])
    for _ in range(40):
        count.step(sim)
    e = sim.energies()
    gained = float(e["kinetic"][0] + e["strain"][0] + e["contact"][0] + e["contact_pairs"][0] - e["work"][0]) / start
    apart = float(np.linalg.norm((center(sim, s.upper) - center(sim, s.lower))[:2])) / SIDE
    limits = {"energy from nowhere": (gained - 1.0, exact(setting, 1e-6, 1e-2))}
    return count.answer(apart, 1e-3, "one above the other", limits=limits)
