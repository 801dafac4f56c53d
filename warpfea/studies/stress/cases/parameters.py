"""Parameters that are set in a model of one world, each against a closed form of its value."""

from typing import Any

import numpy as np

import warpfea as wf

from ..build import StepStats, finalize
from ..case import Answer, Setting, case

SIZE = (0.5, 0.1, 0.1)
"""Size of the bar, m."""
INITIAL: dict[str, float] = {"E": 1e6, "nu": 0.3, "eta": 10.0, "density": 1000.0}
"""Values of the model as built; those set later are in `NEW_VALUES`."""
NEW_VALUES: dict[str, float] = {"E": 3e6, "nu": 0.1, "eta": 250.0, "density": 7000.0, "mu": 0.05}
GRAVITY = 9.81


def _bar(gravity: float = 0.0) -> tuple[wf.ModelBuilder, wf.Body]:
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -gravity))
    law = wf.SVK(E=INITIAL["E"], nu=INITIAL["nu"], density=INITIAL["density"], damping=wf.KelvinVoigt(INITIAL["eta"]))
    return b, b.add_solid(wf.mesh.box(SIZE, cells=(3, 1, 1)), material=law, name="body")


def _tension_error(setting: Setting, name: str, stats: StepStats) -> float:
    """Error of the elongation F L / (E A) of a bar on rollers, or of nu from its contraction, in small strain."""
    b, bar = _bar()
    strain = 1e-6
    for axis, face in enumerate(("x-", "y-", "z-")):
        b.clamp(bar.nodes(face), components="xyz"[axis])
    modulus = NEW_VALUES["E"] if name == "E" else INITIAL["E"]
    b.add_traction(bar.surface("x+"), (strain * modulus, 0.0, 0.0))
    model = finalize(b, setting)
    model.set_parameter(f"body.{name}", NEW_VALUES[name])
    u = wf.solve_static(model, load_steps=1, outputs=[stats]).displacements(bar)[0]
    along = float(u[:, 0].max()) / SIZE[0]
    across = -float(u[:, 1].min()) / SIZE[1]
    return abs(along / strain - 1.0) if name == "E" else abs(across / (NEW_VALUES["nu"] * along) - 1.0)


def _dissipation_error(setting: Setting, stats: StepStats) -> float:
    """Error of the viscous power at a uniform stretch rate d: volume times 2 eta d^2 (S = 2 eta dE/dt at rest)."""
    b, bar = _bar()
    model = finalize(b, setting)
    model.set_parameter("body.eta", NEW_VALUES["eta"])
    state = model.state()
    v = np.zeros((1, model.slots, 3))
    v[0, :, 0] = 2.0 * model.slot_table.reference[:, 0]
    state.velocity.assign(v.astype(setting.dtype))
    rate = float(model.evaluation.dissipation_rate(state)[0])
    return abs(rate / (float(np.prod(SIZE)) * NEW_VALUES["eta"] * 2.0 * 4.0) - 1.0)


def _momentum_error(setting: Setting, integrator: str, stats: StepStats) -> float:
    """Errors of the mean speed F t / m of a free bar under a constant pull on one end, and 1/2 m v^2 of its fall."""
    force, steps, h = 4.0, 40, 1e-3
    worst = 0.0
    for gravity in (0.0, GRAVITY):
        b, bar = _bar(gravity)
        if not gravity:
            b.add_traction(bar.surface("x+"), (force / (SIZE[1] * SIZE[2]), 0.0, 0.0))
        model = finalize(b, setting)
        model.set_parameter("body.density", NEW_VALUES["density"])
        mass = NEW_VALUES["density"] * float(np.prod(SIZE))
        sim = wf.Simulation(model, dt=h, integrator=integrator)
        stats.step(sim, steps)
        if gravity:
            got, expected = float(sim.energies()["kinetic"][0]), 0.5 * mass * (GRAVITY * steps * h) ** 2
        else:
            v = sim.state.velocity.numpy()[0].astype(float)
            got, expected = float((model.mass_matrix()[::3, ::3] @ v[:, 0]).sum()), force * steps * h
            worst = max(worst, abs(float(model.mass_matrix().sum()) / (3.0 * mass) - 1.0))
        worst = max(worst, abs(got / expected - 1.0))
    return worst


def _sliding_error(setting: Setting, stats: StepStats) -> float:
    """Error of the speed v - mu g t of a sliding block."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    law = wf.SVK(E=1e6, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(eta=1e3))
    block = b.add_solid(wf.mesh.box((0.1, 0.1, 0.05), cells=(1, 1, 1)), material=law, name="body")
    floor = b.add_collider(wf.HalfSpace((0.0, 0.0, 1.0)), name="floor")
    b.add_contact(block, floor, mu=0.5, name="pad")
    model = finalize(b, setting)
    rest = wf.solve_static(model, stabilise=True, outputs=[stats]).state
    model.set_parameter("pad.mu", NEW_VALUES["mu"])
    v = rest.velocity.numpy()
    v[..., 0] = 1.0
    rest.velocity.assign(v)
    sim = wf.Simulation(model, rest, dt=1e-3)
    stats.step(sim, 200)
    lumped = model.masses.lumped[0] * (block.slot_kind == 0)
    mean = float(lumped @ sim.state.velocity.numpy()[0][:, 0].astype(float)) / float(lumped.sum())
    return abs((1.0 - mean) / (NEW_VALUES["mu"] * GRAVITY * 0.2) - 1.0)


INTEGRATORS = ("backward_euler", "bdf2", "energy_momentum", "generalized_alpha")


@case("one-world-parameter", "Parameters", values=("E", "nu", "eta", "mu", *(f"density-{s}" for s in INTEGRATORS)),
      quick="both")  # fmt: skip
def one_world_parameter(setting: Setting, value: str) -> Answer:
    """A parameter set in a model of one world: elongation, contraction, damping, sliding, momentum and mass have it."""
    stats = StepStats()
    name, _, scheme = value.partition("-")
    if name == "density":
        error = _momentum_error(setting, scheme, stats)
    elif name in ("mu", "eta"):
        error = {"mu": _sliding_error, "eta": _dissipation_error}[name](setting, stats)
    else:
        error = _tension_error(setting, name, stats)
    bounds: dict[str, tuple[float, float]] = {"E": (1e-5, 1e-3), "nu": (1e-5, 1e-3), "mu": (1e-3, 1e-3)}
    bound: Any = bounds.get(name, (1e-9, 1e-5))[setting.single]
    return Answer(error, bound, "closed form", **stats.answer_fields)
