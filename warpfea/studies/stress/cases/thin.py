"""Thin bodies: statics and motion in both precisions, most sensitive to round-off."""

import functools

import numpy as np

import warpfea as wf

from ..build import GRAVITY_VECTOR, REFERENCE_TOL, STEEL, StepStats, bar, beam, relative_error, solve
from ..case import FLOAT32_REFUSAL, Answer, Setting, case

SAG = 0.05
"""Tip deflection by Euler-Bernoulli theory, for the length of 1 m."""
BOUNDS = {"float64": 3e-4, "float32": 6e-3}
"""Bound of the difference from float64 with tol 1e-10: three times the accepted round-off estimates."""
SOLIDS = ("T10-50", "T10-500", "H3843-50", "H3843-500", "T10-incompressible-50")
STRUCTURES = ("3243-500", "3443-5000")
LOAD_STEPS = 3
STEPS = 60
"""Number of steps of the motion."""
REFERENCE = "the same in float64, tol 1e-10"


def thin_body(value: str) -> wf.ModelBuilder:
    """A bar, beam or strip of 1 m and L/t as in `value`, with the tip load for a deflection SAG by Euler's theory."""
    element, slenderness = value.split("-")[0], float(value.split("-")[-1])
    t = 1.0 / slenderness
    E, nu = 2e11, 0.4999 if "incompressible" in value else 0.0 if element == "3443" else 0.3
    law = wf.SVK(E=E, nu=nu, density=7800.0)
    width = 0.25 if element == "3443" else t
    force = 3.0 * E * width * t**3 / 12.0 * SAG  # N
    if element == "3243":
        b, body = beam(16, t, law)
        b.add_point_load(body.end, (0, 0, -force))
        return b
    b, body = bar(element, (16, 4) if element == "3443" else (20, 1, 1), (1.0, width, t), law)
    b.add_traction(body.surface("x+"), (0, 0, -force / (width * t)))
    return b


@functools.cache
def reference_tip(value: str, device: str) -> np.ndarray:
    """Displacement of the tip in float64 with tol 1e-10 (3,), m."""
    return solve(thin_body(value), Setting(device, "float64"), load_steps=LOAD_STEPS, tol=REFERENCE_TOL).tip


@case("thin-static", "thin", values=(*SOLIDS, *STRUCTURES), quick="both", refusal=FLOAT32_REFUSAL)
def thin_static(setting: Setting, value: str) -> Answer:
    """Statics of bodies of slenderness 50 to 5000 bent by 5 % of their length."""
    found = solve(thin_body(value), setting, load_steps=LOAD_STEPS)
    reference = reference_tip(value, setting.device)
    theory = {}
    if "incompressible" not in value:
        theory = {"off Euler and Bernoulli": (abs(found.tip[2] / -SAG - 1.0), 0.05)}
    bound = BOUNDS[setting.dtype]
    error = relative_error(found.tip, reference)
    return found.stats.answer(error, bound, REFERENCE, reported_error=found.stats.last_floor, limits=theory)


def released_bar(value: str, device: str, dtype: str, tol: float | None) -> tuple[np.ndarray, StepStats]:
    """Motion of the tip of a bar released under its weight, for steps of 5 ms (STEPS, 3), m.

    No step may be halved: shorter steps change the motion by a sixth of the sag.
    """
    t = 1.0 / float(value.split("-")[1])
    b, _ = bar("T10", (20, 1, 1), (1.0, t, t), STEEL, GRAVITY_VECTOR)
    solver = wf.NewtonPCG(tol=tol, max_pcg=20000, max_halvings=0)
    sim = wf.Simulation(b.finalize(device=device, dtype=dtype), dt=5e-3, solver=solver)
    stats = StepStats()
    stats.step(sim, STEPS)
    return sim.probe("tip").displacement[0], stats


reference_motion = functools.cache(released_bar)


@case("thin-dynamic", "thin", values=("T10-50", "T10-500"), quick="both", refusal=FLOAT32_REFUSAL)
def thin_dynamic(setting: Setting, value: str) -> Answer:
    """A clamped steel bar released under its weight, 0.3 s."""
    path, stats = released_bar(value, setting.device, setting.dtype, None)
    error = relative_error(path, reference_motion(value, setting.device, "float64", REFERENCE_TOL)[0])
    return stats.answer(error, BOUNDS[setting.dtype], REFERENCE, reported_error=stats.sum_of_floors)
