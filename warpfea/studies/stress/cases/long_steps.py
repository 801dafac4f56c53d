"""Steps from 1e-8 to 1e6 s: a long step of backward Euler is a static solution, at the same effort."""

from __future__ import annotations

import functools

import numpy as np
import scipy.sparse.linalg

import warpfea as wf

from ..build import DOWN, REFINED, STEEL, Count, bar, off, solve
from ..case import Answer, Setting, case

SIZE, CELLS = (1.0, 0.1, 0.1), (10, 1, 1)
STEPS = tuple(10.0**k for k in range(-8, 7))
"""Step sizes h, s."""
SOFT = wf.SVK(E=5.74e7, nu=0.3, density=7800.0)
"""Loads with a sag of 20 % of the length."""
NEWTON = 15
"""Maximum iterations of a step with a sag below a hundredth of the length."""
LONG = 1e3
"""Step size, s, above which a step is a static solution: inertia is 1e-12 of the stiffness."""
BOUNDS = {"float64": 1e-6, "float32": 6e-3}
LINEAR = 2e-4
"""Tolerance for nonlinear terms at a sag of 6e-5 of the length."""
EDGE = 10.0
FALLING = {"rubber": wf.SVK(E=1e6, nu=0.3, density=1000.0), "steel": STEEL}


def clamped(law: wf.SVK) -> tuple[wf.ModelBuilder, wf.Body]:
    """A T10 bar under its weight."""
    return bar("T10", CELLS, SIZE, law, DOWN)


@functools.cache
def static_tip(E: float, device: str) -> np.ndarray:
    """Static displacement of the tip in float64 (3,), m."""
    law = wf.SVK(E=E, nu=0.3, density=7800.0)
    return solve(clamped(law)[0], Setting(device, "float64"), load_steps=4, tol=REFINED).tip


@functools.cache
def linear_tip(h: float, device: str) -> np.ndarray:
    """Displacement of the tip after three steps of backward Euler, linear, by a factorisation (3,), m."""
    model = clamped(STEEL)[0].finalize(device=device)
    free = np.flatnonzero(model.free_slots.ravel())
    M, K = model.mass_matrix(), model.tangent_matrix(model.state())
    weight = (M @ np.tile(DOWN, model.slots))[free]
    M, K = M[free][:, free], K[free][:, free]
    factor = scipy.sparse.linalg.splu((M + h * h * K).tocsc())
    u = v = np.zeros(len(free))
    for _ in range(3):
        v = factor.solve(M @ v + h * (weight - K @ u))
        u = u + h * v
    full = np.zeros(3 * model.slots)
    full[free] = u
    tip = model.probes[0]
    return tip.weights @ full.reshape(-1, 3)[tip.slots]


def moved(law: wf.SVK, h: float, setting: Setting, tol: float | None = None) -> tuple[np.ndarray, Count]:
    """Displacement of the tip (3,), m, after three steps h from the straight state at rest."""
    sim = wf.Simulation(
        clamped(law)[0].finalize(device=setting.device, dtype=setting.dtype), dt=h,
        solver=wf.NewtonPCG(tol=tol, max_pcg=20000),
    )  # fmt: skip
    count = Count()
    count.step(sim, 3)
    return sim.probe("tip").displacement[0, -1], count


@case("long-steps", "long steps", values=STEPS, quick="float64")
def long_steps(setting: Setting, h: float) -> Answer:
    """A clamped steel bar under its weight from rest, three steps: a linear problem for any step size."""
    tip, count = moved(STEEL, h, setting)
    reference, source, bound = linear_tip(h, setting.device), "linear backward Euler, factorised", LINEAR
    if h >= LONG:
        reference, source, bound = static_tip(STEEL.E, setting.device), "static solution, float64, tol 1e-10", 0.0
    limits = {"Newton of a step": (count.worst_newton, NEWTON), "halvings": (count.halvings, 0)}
    bound, told = max(bound, BOUNDS[setting.dtype]), count.sum_of_floors if h >= LONG else 0.0
    return count.answer(off(tip, reference), bound, source, told=told, limits=limits, largest_step=h)


@case("long-stay", "long steps", values=STEPS, quick="float64")
def long_stay(setting: Setting, h: float) -> Answer:
    """The bar from its static equilibrium, which it keeps."""
    b, _ = clamped(STEEL)
    model = b.finalize(device=setting.device, dtype=setting.dtype)
    state = wf.solve_static(model, load_steps=1).state
    before = tip_of(model, state)
    sim = wf.Simulation(model, state, dt=h, solver=wf.NewtonPCG(max_pcg=20000))
    count = Count()
    count.step(sim, 3)
    error = float(np.abs(tip_of(model, sim.state) - before).max() / np.abs(before).max())
    limits = {"Newton of a step": (count.worst_newton, NEWTON), "halvings": (count.halvings, 0)}
    return count.answer(error, BOUNDS[setting.dtype], "the sag stays", limits=limits, largest_step=h)


def tip_of(model: wf.Model, state: wf.State) -> np.ndarray:
    """Displacement of the first probe of a model at a state (3,), m."""
    probe = model.probes[0]
    return np.asarray(probe.weights @ state.displacement.numpy()[0, probe.slots].astype(float))


@case("long-soft", "long steps", values=STEPS, quick="float64")
def long_soft(setting: Setting, h: float) -> Answer:
    """A bar that sags by a fifth of its length from rest: no step is harder than a single static solution."""
    tip, count = moved(SOFT, h, setting)
    at_once = solve(clamped(SOFT)[0], setting, load_steps=1).count.newton
    if h >= LONG:
        reference, source = static_tip(SOFT.E, setting.device), "static solution, float64, tol 1e-10"
    else:
        reference = moved(SOFT, h, Setting(setting.device, "float64"), REFINED)[0]
        source = "the same in float64, tol 1e-10"
    limits = {"Newton of a step": (count.worst_newton, at_once + 2), "halvings": (count.halvings, 0)}
    error = off(tip, reference)
    return count.answer(
        error, BOUNDS[setting.dtype], source, told=count.sum_of_floors, limits=limits, largest_step=h
    )  # fmt: skip


@case(
    "free-fall", "long steps", values=tuple((law, 10.0**k) for law in FALLING for k in range(-3, 4)), quick="float64",
    refusal={"float32": ["float32"]},
)  # fmt: skip
def free_fall(setting: Setting, value: tuple[str, float]) -> Answer:
    """A free cube of 10 m falls for three steps, up to a million times its size."""
    law, h = value
    b = wf.ModelBuilder(gravity=DOWN)
    mesh = wf.mesh.box((EDGE,) * 3, cells=(2, 2, 2))
    body = b.add_solid(mesh, material=FALLING[law], name="cube")
    sim = wf.Simulation(b.finalize(device=setting.device, dtype=setting.dtype), dt=h)
    count = Count()
    count.step(sim, 3)
    velocity = np.array(DOWN) * 3.0 * h
    error = float(np.abs(sim.velocities(body)[0] - velocity).max() / np.abs(velocity).max())
    bound = 1e-5 if setting.single else 1e-10
    return count.answer(error, bound, "v = g t", limits={"halvings": (count.halvings, 0)}, largest_step=h)
