"""Steps from 1e-8 to 1e6 s: a long step of backward Euler is a static solution, at the same effort."""

import functools

import numpy as np

import warpfea as wf

from .. import build
from ..build import GRAVITY_VECTOR, REFERENCE_TOL, STEEL, StepStats, bar, finalize, relative_error, solve, step
from ..case import FLOAT32_REFUSAL, Answer, Setting, case

SIZE, CELLS = (1.0, 0.1, 0.1), (10, 1, 1)
STEP_SIZES = tuple(10.0**k for k in range(-8, 7))
"""Step sizes h, s."""
SOFT_LAW = wf.SVK(E=5.74e7, nu=0.3, density=7800.0)
"""Loads with a sag of 20 % of the length."""
MAX_NEWTON = 15
"""Maximum iterations of a step with a sag below a hundredth of the length."""
STATIC_STEP = 1e3
"""Step size, s, above which a step is a static solution: inertia is 1e-12 of the stiffness."""
BOUNDS = {"float64": 1e-6, "float32": 6e-3}
NONLINEARITY_BOUND = 2e-4
"""Tolerance for nonlinear terms at a sag of 6e-5 of the length."""
CUBE_SIZE = 10.0
CUBE_LAWS = {"rubber": wf.SVK(E=1e6, nu=0.3, density=1000.0), "steel": STEEL}


def clamped_bar(law: wf.SVK) -> tuple[wf.ModelBuilder, wf.Body]:
    """A T10 bar under its weight."""
    return bar("T10", CELLS, SIZE, law, GRAVITY_VECTOR)


@functools.cache
def static_tip(E: float, device: str) -> np.ndarray:
    """Static displacement of the tip in float64 (3,), m."""
    law = wf.SVK(E=E, nu=0.3, density=7800.0)
    return solve(clamped_bar(law)[0], Setting(device, "float64"), load_steps=4, tol=REFERENCE_TOL).tip


@functools.cache
def linear_tip(h: float, device: str) -> np.ndarray:
    """Displacement of the tip after three steps of backward Euler, linear, by a factorisation (3,), m."""
    model = clamped_bar(STEEL)[0].finalize(device=device)
    weight = model.mass_matrix() @ np.tile(GRAVITY_VECTOR, model.slots)
    tip = model.description.probes[0]
    return tip.weights @ build.linear_steps(model, weight, h, 3)[tip.slots]


def stepped_tip(law: wf.SVK, h: float, setting: Setting, tol: float | None = None) -> tuple[np.ndarray, StepStats]:
    """Displacement of the tip (3,), m, after three steps h from the straight state at rest."""
    sim, stats = step(clamped_bar(law)[0], setting, 3, dt=h, solver=wf.NewtonPCG(tol=tol, max_pcg=20000))
    return sim.probe("tip").displacement[0, -1], stats


@case("long-steps", "long steps", values=STEP_SIZES, quick="float64")
def long_steps(setting: Setting, h: float) -> Answer:
    """A clamped steel bar under its weight from rest, three steps: a linear problem for any step size."""
    tip, stats = stepped_tip(STEEL, h, setting)
    reference, source, bound = linear_tip(h, setting.device), "linear backward Euler, factorised", NONLINEARITY_BOUND
    if h >= STATIC_STEP:
        reference, source, bound = static_tip(STEEL.E, setting.device), "static solution, float64, tol 1e-10", 0.0
    limits = {"Newton of a step": (stats.worst_newton, MAX_NEWTON), "halvings": (stats.halvings, 0)}
    bound, reported_error = max(bound, BOUNDS[setting.dtype]), stats.sum_of_floors if h >= STATIC_STEP else 0.0
    error = relative_error(tip, reference)
    return stats.answer(error, bound, source, reported_error=reported_error, limits=limits, largest_step=h)


@case("long-stay", "long steps", values=STEP_SIZES, quick="float64")
def stay_in_equilibrium(setting: Setting, h: float) -> Answer:
    """The bar from its static equilibrium, which it keeps."""
    model = finalize(clamped_bar(STEEL)[0], setting)
    state = wf.solve_static(model, load_steps=1).state
    before = tip_displacement(model, state)
    sim = wf.Simulation(model, state, dt=h, solver=wf.NewtonPCG(max_pcg=20000))
    stats = StepStats()
    stats.step(sim, 3)
    error = float(np.abs(tip_displacement(model, sim.state) - before).max() / np.abs(before).max())
    limits = {"Newton of a step": (stats.worst_newton, MAX_NEWTON), "halvings": (stats.halvings, 0)}
    return stats.answer(error, BOUNDS[setting.dtype], "the sag stays", limits=limits, largest_step=h)


def tip_displacement(model: wf.Model, state: wf.State) -> np.ndarray:
    """Displacement of the first probe of a model at a state (3,), m."""
    probe = model.description.probes[0]
    return np.asarray(probe.weights @ state.displacement.numpy()[0, probe.slots].astype(float))


@case("long-soft", "long steps", values=STEP_SIZES, quick="float64")
def soft_bar(setting: Setting, h: float) -> Answer:
    """A bar that sags by a fifth of its length from rest: no step is harder than a single static solution."""
    tip, stats = stepped_tip(SOFT_LAW, h, setting)
    at_once = solve(clamped_bar(SOFT_LAW)[0], setting, load_steps=1).stats.newton
    if h >= STATIC_STEP:
        reference, source = static_tip(SOFT_LAW.E, setting.device), "static solution, float64, tol 1e-10"
    else:
        reference = stepped_tip(SOFT_LAW, h, Setting(setting.device, "float64"), REFERENCE_TOL)[0]
        source = "the same in float64, tol 1e-10"
    limits = {"Newton of a step": (stats.worst_newton, at_once + 2), "halvings": (stats.halvings, 0)}
    error = relative_error(tip, reference)
    floors, bound = stats.sum_of_floors, BOUNDS[setting.dtype]
    return stats.answer(error, bound, source, reported_error=floors, limits=limits, largest_step=h)


@case(
    "free-fall", "long steps", values=tuple((law, 10.0**k) for law in CUBE_LAWS for k in range(-3, 4)), quick="float64",
    refusal=FLOAT32_REFUSAL,
)  # fmt: skip
def free_fall(setting: Setting, value: tuple[str, float]) -> Answer:
    """A free cube of 10 m falls for three steps, up to a million times its size."""
    law, h = value
    b = wf.ModelBuilder(gravity=GRAVITY_VECTOR)
    body = b.add_solid(wf.mesh.box((CUBE_SIZE,) * 3, cells=(2, 2, 2)), material=CUBE_LAWS[law], name="cube")
    sim, stats = step(b, setting, 3, dt=h)
    velocity = np.array(GRAVITY_VECTOR) * 3.0 * h
    error = float(np.abs(sim.velocities(body)[0] - velocity).max() / np.abs(velocity).max())
    bound = 1e-5 if setting.single else 1e-10
    return stats.answer(error, bound, "v = g t", limits={"halvings": (stats.halvings, 0)}, largest_step=h)
