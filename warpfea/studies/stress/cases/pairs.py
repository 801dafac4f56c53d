"""Contact between bodies: fast impacts, stiff on soft, vertices, edges and faces, exact touch, thin bodies, extremes.

Criteria for both bodies: in every step the change of momentum equals the impulse of the recorded forces and the
weight; friction is at most mu N; no energy is gained; no centre of mass passes the other body.
"""

from typing import Any

import numpy as np

import warpfea as wf

from ..build import GRAVITY_VECTOR, StepStats, finalize
from ..case import DTYPES, FLOAT32_REFUSAL, Answer, Setting, case
from . import contact
from .contact import DENSITY, GRAVITY, SIDE, ContactScene, bound_for, center_of_mass

GROUP = "pairs"
REFUSAL_TEXTS = {
    dtype: ["through body", "inverted", "J <= 0", *more] for dtype, more in zip(DTYPES, ((), ("float32",)))
}


def cube_on_plate(
    *, E: tuple[float, float] = (1e6, 1e6), density: tuple[float, float] = (DENSITY, DENSITY), across: int = 3,
    gravity: Any = GRAVITY_VECTOR, rotation: np.ndarray | None = None, position: Any = (0.0, 0.0, 0.0),
    thickness: float = SIDE, width: float = 3 * SIDE, clamped: bool = True, shell: bool = False, **options: Any,
) -> ContactScene:  # fmt: skip
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
    pad = b.add_contact(upper, face, name="pad", **options)
    mass = density[0] * SIDE**3
    return ContactScene(b, upper, [pad], mass, mass * GRAVITY * SIDE, lower, clamped)


@case("pairs-impact", GROUP, values=tuple((E, h) for E in (1e6, 1e8, 1e10) for h in (1e-3, 1e-2)), quick="none",
      refusal=REFUSAL_TEXTS)  # fmt: skip
def impact(setting: Setting, value: tuple[float, float]) -> Answer:
    """A cube at 100 m/s onto a free plate a tenth as thick, up to ten sides a step: no penetration."""
    E, h = value
    s = cube_on_plate(
        E=(E, E), gravity=(0, 0, 0), position=(0, 0, 0.3), thickness=0.01, clamped=False, mu=0.3, restitution=0.5
    )
    run = s.release(setting, 8, dt=h, velocity=(0, 0, -contact.FAST_IMPACT))
    return run.answer(setting, max(run.center_depth, 0.0), 0.0, "the centre stays before the plate")


@case("pairs-shell", GROUP, values=(1.0, 20.0, 100.0), quick="none", refusal=REFUSAL_TEXTS)
def thin_shell(setting: Setting, speed: float) -> Answer:
    """A cube hits a shell of a hundredth of its side at 1 to 100 m/s, h = 1 ms: no penetration."""
    s = cube_on_plate(E=(1e6, 1e8), gravity=(0, 0, 0), position=(0, 0, 0.05), thickness=1e-3, shell=True, mu=0.3,
                      restitution=0.5, stiffness=("region", 1e4))  # fmt: skip
    run = s.release(setting, 60, velocity=(0, 0, -speed))
    return run.answer(setting, max(run.center_depth, 0.0), 0.0, "the centre stays before the shell")


MODULUS_PAIRS = tuple((a, b) for a in (1e4, 1e7, 1e10) for b in (1e4, 1e7, 1e10) if a != b)


@case("pairs-stiff", GROUP, values=MODULUS_PAIRS, quick="none", refusal=FLOAT32_REFUSAL)
def stiff_on_soft(setting: Setting, E: tuple[float, float]) -> Answer:
    """A cube of 1e4 to 1e10 Pa falls by a hundredth of its side on a plate of another one, 30 steps of 1 ms."""
    s = cube_on_plate(E=E, position=(0, 0, 0.01 * SIDE), mu=0.5, restitution=0.5)
    return s.release(setting, 30, velocity=(0, 0, -0.3), mu=0.5).impulse_answer(setting)


ROTATIONS: dict[str, Any] = {"face": None, "edge": contact.edge_down(), "vertex": contact.vertex_down()}


@case("pairs-meet", GROUP, values=tuple((name, at) for name in ROTATIONS for at in ("middle", "border")), quick="both")
def landing(setting: Setting, value: tuple[str, str]) -> Answer:
    """A face, an edge or a vertex lands at 1 m/s on a facet's centre, or on a facet border; 40 steps of 1 ms."""
    name, at = value
    spot = 0.02 if at == "middle" else 0.05
    s = cube_on_plate(rotation=ROTATIONS[name], position=(spot, spot, 0.005), mu=0.3, restitution=0.5, across=3)
    return s.release(setting, 40, velocity=(0, 0, -1.0)).impulse_answer(setting)


@case("pairs-touch", GROUP, values=("plate", "same faces"), quick="both", refusal=FLOAT32_REFUSAL)
def exact_touch(setting: Setting, name: str) -> Answer:
    """A cube in initial exact touch with a plate, or face on face with a cube of its own, under its weight."""
    same: dict[str, Any] = {"width": SIDE, "across": 2} if name == "same faces" else {}
    s = cube_on_plate(mu=0.5, restitution=0.5, **same)
    return s.release(setting, 50, mu=0.5).impulse_answer(setting)


@case("pairs-rest", GROUP, values=(1e-3, 1.0, 1e3), quick="float64", refusal=FLOAT32_REFUSAL)
def mass_ratio(setting: Setting, ratio: float) -> Answer:
    """Statics: a cube 1e3 times lighter or heavier than its plate rests on it; the force is its weight."""
    E = max(1e7, 1e4 * ratio * DENSITY)
    s = cube_on_plate(E=(E, E), density=(ratio * DENSITY, DENSITY), mu=0.5)
    stats, (record,) = s.solve(setting)
    weight = ratio * DENSITY * SIDE**3 * GRAVITY
    error = abs(float(record.force[0, -1, 2]) / weight - 1.0)
    return stats.answer(error, bound_for(setting, 1e-5, 1e-2), "force = m g")


@case("pairs-edge", GROUP, values=(0.0, 0.3), quick="float64")
def over_the_edge(setting: Setting, mu: float) -> Answer:
    """A cube at 2 m/s slides over the edge of a plate, tips and falls free: 120 steps of 1 ms."""
    s = cube_on_plate(position=(SIDE, 0, 0), mu=mu, restitution=0.5)
    run = s.release(setting, 120, velocity=(2.0, 0, 0))
    return run.impulse_answer(setting, limits={"centre past the other body": (0.0, 0.0)})


@case("pairs-mu", GROUP, values=(0.0, 10.0), quick="float64")
def extreme_friction(setting: Setting, mu: float) -> Answer:
    """A cube slides over a smooth plate, or one of mu = 10, at 1 m/s."""
    s = cube_on_plate(position=(-0.5 * SIDE, 0, 0), E=(1e6, 1e8), mu=mu, restitution=0.5)
    return s.release(setting, 50, velocity=(1.0, 0, 0), mu=mu).impulse_answer(setting)


@case("pairs-spin", GROUP, values=(1.0, 30.0), quick="float64")
def spinning_stack(setting: Setting, rate: float) -> Answer:
    """A cube pressed on a free one, both spun about their common axis: they rotate as one, 40 steps of 1 ms."""
    s = cube_on_plate(width=SIDE, across=2, clamped=False, gravity=(0, 0, 0), mu=0.8, restitution=0.5)
    b = s.builder
    assert s.lower is not None
    for body in (s.body, s.lower):
        b.set_initial(body, velocity=lambda X: rate * np.cross((0.0, 0.0, 1.0), X))
    b.add_traction(s.body.surface("z+"), (0, 0, -1e3))
    b.add_traction(s.lower.surface("z-"), (0, 0, 1e3))
    sim = wf.Simulation(finalize(s.builder, setting), dt=1e-3)
    stats = StepStats()
    start = float(sim.energies()["kinetic"][0])
    stats.step(sim, 40)
    e = sim.energies()
    ratio = float(e["kinetic"][0] + e["strain"][0] + e["contact"][0] + e["contact_pairs"][0] - e["work"][0]) / start
    apart = float(np.linalg.norm((center_of_mass(sim, s.body) - center_of_mass(sim, s.lower))[:2])) / SIDE
    limits = {"energy from nowhere": (ratio - 1.0, bound_for(setting, 1e-6, 1e-2))}
    return stats.answer(apart, 1e-3, "one above the other", limits=limits)
