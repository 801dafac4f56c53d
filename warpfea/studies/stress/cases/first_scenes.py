"""First scenes: a body dropped on, or sliding over, something else, with default options of contact.

A row is one of a covering array: every pair of values of body, other side, motion, E, step and integrator occurs. Soft
bodies and supports, and those with another integrator than backward Euler, have Kelvin-Voigt damping. Criteria: at rest
the contact is at most 1 % of an element or 5 % of the elastic approach deep, the body is at rest within 2 s, and steps
take at most 8 Newton iterations on average. A body that moves by more than half of a shell's thickness in a step may be
refused by name.
"""

from typing import Any

import numpy as np

import warpfea as wf

from ..build import GRAVITY_VECTOR, StepStats, covering_array, finalize
from ..case import Answer, Setting, case
from .contact import FLOOR, GRAVITY, center_of_mass

GROUP = "first scenes"
DENSITY, SIZE, WIDTH = 1000.0, 0.1, 0.4
TIME = 2.0
SUPPORT_MODULUS = 1e7
"""Least Young's modulus, Pa, of a support, which else gives way under any body."""
BODIES = ("cube", "ball", "bar", "shell", "beam")
OTHERS = ("floor", "plate", "shell-5mm", "shell-1mm", "mesh", "second")
MOTIONS = (("drop", 0.1), ("drop", 0.5), ("slide", 0.5))
MODULI, STEPS = (1e4, 1e6, 1e8, 2e11), (1e-3, 1e-2)
INTEGRATORS = ("backward_euler", "bdf2", "generalized_alpha", "energy_momentum")
SELF_DAMPED_MODULUS = 1e6
"""Young's modulus, Pa, from which backward Euler's own dissipation stops a body of this size in 2 s."""
MAX_MEAN_NEWTON = 8.0


COMBINATIONS = tuple((*row[:2], "-".join(map(str, row[2])), *row[3:])
             for row in covering_array(BODIES, OTHERS, MOTIONS, MODULI, STEPS, INTEGRATORS))  # fmt: skip


def material(E: float, damped: bool, size: float = SIZE) -> wf.NeoHookean:
    """Rubber of a Young's modulus, Pa, with a viscosity that stops the slowest vibration of a size, m, in 2 s."""
    damping = wf.KelvinVoigt(eta=size * np.sqrt(E * DENSITY)) if damped else None
    return wf.NeoHookean.from_E_nu(E=E, nu=0.3, density=DENSITY, damping=damping)


def add_body(b: wf.ModelBuilder, kind: str, E: float, height: float, name: str, damped: bool) -> wf.Body:
    """A body of a tenth of a metre whose lowest point is at a height, m."""
    law = material(E, damped)
    origin = (-0.5 * SIZE, -0.5 * SIZE, height)
    if kind == "cube":
        return b.add_solid(wf.mesh.box((SIZE,) * 3, cells=(2,) * 3, origin=origin), material=law, name=name)
    if kind == "ball":
        mesh = wf.mesh.sphere(0.5 * SIZE, cells=4, center=(0, 0, height + 0.5 * SIZE))
        return b.add_solid(mesh, material=law, name=name)
    if kind == "bar":
        mesh = wf.mesh.box((2 * SIZE, 0.02, 0.02), cells=(8, 1, 1), origin=(-SIZE, -0.01, height))
        return b.add_solid(mesh, material=law, name=name)
    if kind == "shell":
        grid = wf.mesh.grid((2 * SIZE, 2 * SIZE), cells=(4, 4), origin=(-SIZE, -SIZE, height + 0.0025))
        return b.add_shell(grid, thickness=0.005, material=law, name=name)
    ends = [(-SIZE, 0.0, height + 0.005), (SIZE, 0.0, height + 0.005)]
    return b.add_beam(ends, elements=8, section=wf.Rectangle(0.01, 0.01), normal=(0, 0, 1), material=law, name=name)


def add_support(b: wf.ModelBuilder, other: str, body: str, E: float, damped: bool) -> tuple[Any, Any]:
    """The other side with its top at z = 0: what the contact names, and the body if it has one."""
    if other == "floor":
        return b.add_collider(FLOOR, name="floor"), None
    half = 0.5 * WIDTH
    if other == "mesh":
        x, y = np.meshgrid(*[np.linspace(-half, half, 9)] * 2, indexing="ij")
        points = np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size)))
        at = np.arange(81).reshape(9, 9)
        first = np.column_stack([c.ravel() for c in (at[:-1, :-1], at[1:, :-1], at[1:, 1:])])
        second = np.column_stack([c.ravel() for c in (at[:-1, :-1], at[1:, 1:], at[:-1, 1:])])
        return b.add_collider(wf.TriMesh(points, np.vstack((first, second))), name="mesh"), None
    law = material(max(E, SUPPORT_MODULUS), damped, WIDTH)
    if other == "second":
        depth = {"cube": SIZE, "ball": SIZE, "bar": 0.02, "shell": 0.005, "beam": 0.01}[body]
        support = add_body(b, body, max(E, SUPPORT_MODULUS), -depth, "support", damped)
        b.clamp(support.nodes(lambda X: np.abs(X[:, 0]) > 0.9 * SIZE) if body in ("bar", "shell", "beam")
                else support.nodes(lambda X: X[:, 2] < -0.8 * SIZE))  # fmt: skip
        return support, support
    if other == "plate":
        mesh = wf.mesh.box((WIDTH, WIDTH, 0.02), cells=(8, 8, 1), origin=(-half, -half, -0.02))
        support, edges = b.add_solid(mesh, material=law, name="support"), "nodes"
    else:
        thickness = float(other[6]) * 1e-3
        grid = wf.mesh.grid((WIDTH, WIDTH), cells=(8, 8), origin=(-half, -half, -0.5 * thickness))
        support, edges = b.add_shell(grid, thickness=thickness, material=law, name="support"), "edge"
    for side in ("x-", "x+", "y-", "y+"):
        b.clamp(getattr(support, edges)(side))
    return support, support


@case("first-scenes", GROUP, values=COMBINATIONS, quick="none", dtypes=("float64",), refusal=("went through",))
def first_scene(setting: Setting, row: tuple[str, str, str, float, float, str]) -> Answer:
    """A body is dropped on, or slides over, another or an obstacle with default options, and comes to rest."""
    kind, other, motion, E, h, integrator = row
    how, amount = motion.split("-")
    b = wf.ModelBuilder(gravity=GRAVITY_VECTOR)
    damped = integrator != "backward_euler" or E < SELF_DAMPED_MODULUS or other.startswith("shell")
    side, support = add_support(b, other, kind, E, damped)
    drop = float(amount) if how == "drop" else 0.0
    body = add_body(b, kind, E, drop, "body", damped)
    pad = b.add_contact(body, side, mu=0.3, name="pad")
    if how == "slide":
        b.set_initial(body, velocity=(float(amount), 0.0, 0.0))
    sim, stats = wf.Simulation(finalize(b, setting), dt=h, integrator=integrator), StepStats()
    depth, kinetic, start = 0.0, [], float(center_of_mass(sim, body)[2])
    mass = float(sim.model.masses.lumped[0][body.slot_range] @ (body.slot_kind == 0))
    steps = round(TIME / h)
    for k in range(steps):
        stats.step(sim)
        depth = max(depth, float(sim.last.penetration.max()))
        if k >= 0.9 * steps:
            kinetic.append(float(sim.energies()["kinetic"][0]))
    fell = start - float(center_of_mass(sim, body)[2])
    scale = mass * GRAVITY * max(drop, SIZE)
    rolls = kind == "ball" and how == "slide"
    limits = {
        "Newton iterations a step": (stats.newton / steps, MAX_MEAN_NEWTON),
        "kinetic energy at rest": (0.0 if rolls else float(np.mean(kinetic)) / scale, 1e-6),
        "centre past the other side": (fell - drop, 0.5 * SIZE if support is None else WIDTH),
    }
    allowed = max(0.01 * sim.records.element_size(pad), 0.05 * (fell - drop))
    at_rest = float(sim.contact_record(pad).penetration[0, -1])
    return stats.answer(
        at_rest / allowed, 1.0, "1 % of an element, or 5 % of the elastic approach", lowest_J=None, limits=limits,
        note=f"at most {100 * depth:.2g} % of an element deep on the way",
    )  # fmt: skip
