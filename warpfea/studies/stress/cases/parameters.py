"""Parameters that are set in a model of one world, each against a closed form of its value."""

from __future__ import annotations

from typing import Any

import numpy as np

import warpfea as wf

from ..build import Count, finalize
from ..case import Answer, Setting, case

SIZE = (0.5, 0.1, 0.1)
"""Of the bar, m."""
BUILT: dict[str, float] = {"E": 1e6, "nu": 0.3, "eta": 10.0, "density": 1000.0}
"""Values of the model as built; those set later are in `SET`."""
SET: dict[str, float] = {"E": 3e6, "nu": 0.1, "eta": 250.0, "density": 7000.0, "mu": 0.05}
G = 9.81


def _bar(gravity: float = 0.0) -> tuple[wf.ModelBuilder, wf.Body]:
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -gravity))
    law = wf.SVK(E=BUILT["E"], nu=BUILT["nu"], density=BUILT["density"], damping=wf.KelvinVoigt(BUILT["eta"]))
    return b, b.add_solid(wf.mesh.box(SIZE, cells=(3, 1, 1)), material=law, name="body")


def _drawn(setting: Setting, name: str, count: Count) -> float:
    """Elongation F L / (E A) of a bar on rollers, or nu from its contraction, in small strain."""
    b, bar = _bar()
    strain = 1e-6
    for axis, face in enumerate(("x-", "y-", "z-")):
        b.clamp(bar.nodes(face), components="xyz"[axis])
    modulus = SET["E"] if name == "E" else BUILT["E"]
    b.add_traction(bar.surface("x+"), (strain * modulus, 0.0, 0.0))
    model = finalize(b, setting)
    model.set_parameter(f"body.{name}", SET[name])
    u = wf.solve_static(model, load_steps=1, outputs=[count]).displacements(bar)[0]
    along = float(u[:, 0].max()) / SIZE[0]
    across = -float(u[:, 1].min()) / SIZE[1]
    return abs(along / strain - 1.0) if name == "E" else abs(across / (SET["nu"] * along) - 1.0)


def _rate(setting: Setting, count: Count) -> float:
    """Power of viscosity at a uniform rate of stretch d: the volume times 2 eta d^2 (S = 2 eta dE/dt at rest)."""
    b, bar = _bar()
    model = finalize(b, setting)
    model.set_parameter("body.eta", SET["eta"])
    state = model.state()
    v = np.zeros((1, model.slots, 3))
    v[0, :, 0] = 2.0 * model.reference[:, 0]
    state.velocity.assign(v.astype(setting.dtype))
    return abs(float(model.dissipation_rate(state)[0]) / (float(np.prod(SIZE)) * SET["eta"] * 2.0 * 4.0) - 1.0)


def _pushed(setting: Setting, integrator: str, count: Count) -> float:
    """Mean speed F t / m of a free bar under a constant pull on one end, and 1/2 m v^2 of its fall."""
    force, steps, h = 4.0, 40, 1e-3
    worst = 0.0
    for gravity in (0.0, G):
        b, bar = _bar(gravity)
        if not gravity:
            b.add_traction(bar.surface("x+"), (force / (SIZE[1] * SIZE[2]), 0.0, 0.0))
        model = finalize(b, setting)
        model.set_parameter("body.density", SET["density"])
        mass = SET["density"] * float(np.prod(SIZE))
        sim = wf.Simulation(model, dt=h, integrator=integrator)
        count.step(sim, steps)
        if gravity:
            got, expected = float(sim.energies()["kinetic"][0]), 0.5 * mass * (G * steps * h) ** 2
        else:
            v = sim.state.velocity.numpy()[0].astype(float)
            got, expected = float((model.mass_matrix()[::3, ::3] @ v[:, 0]).sum()), force * steps * h
            worst = max(worst, abs(float(model.mass_matrix().sum()) / (3.0 * mass) - 1.0))
        worst = max(worst, abs(got / expected - 1.0))
    return worst


def _slid(setting: Setting, count: Count) -> float:
    """Speed v - mu g t of a block that slides."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -G))
    law = wf.SVK(E=1e6, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(eta=1e3))
    block = b.add_solid(wf.mesh.box((0.1, 0.1, 0.05), cells=(1, 1, 1)), material=law, name="body")
    floor = b.add_collider(wf.HalfSpace((0.0, 0.0, 1.0)), name="floor")
    b.add_contact(block, floor, mu=0.5, name="pad")
    model = finalize(b, setting)
    rest = wf.solve_static(model, stabilise=True, outputs=[count]).state
    model.set_parameter("pad.mu", SET["mu"])
    v = rest.velocity.numpy()
    v[..., 0] = 1.0
    rest.velocity.assign(v)
    sim = wf.Simulation(model, rest, dt=1e-3)
    count.step(sim, 200)
    lumped = model.masses.lumped[0] * (block.slot_kind == 0)
    mean = float(lumped @ sim.state.velocity.numpy()[0][:, 0].astype(float)) / float(lumped.sum())
    return abs((1.0 - mean) / (SET["mu"] * G * 0.2) - 1.0)


SCHEMES = ("backward_euler", "bdf2", "energy_momentum", "generalized_alpha")


@case("one-world-parameter", "Parameters", values=("E", "nu", "eta", "mu", *(f"density-{s}" for s in SCHEMES)),
      quick="both")  # fmt: skip
def one_world_parameter(setting: Setting, value: str) -> Answer:
    """A parameter set in a model of one world: elongation, contraction, damping, sliding, momentum and mass have it."""
    count = Count()
    name, _, scheme = value.partition("-")
    if name == "density":
        error = _pushed(setting, scheme, count)
    elif name == "mu":
        error = _slid(setting, count)
    elif name == "eta":
        error = _rate(setting, count)
    else:
        error = _drawn(setting, name, count)
    bounds: dict[str, tuple[float, float]] = {"E": (1e-5, 1e-3), "nu": (1e-5, 1e-3), "mu": (1e-3, 1e-3)}
    bound: Any = bounds.get(name, (1e-9, 1e-5))[setting.single]
    return Answer(error, bound, "closed form", **count.fields)
