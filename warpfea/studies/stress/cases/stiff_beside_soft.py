"""A soft arm on a steel block under a lateral tension of 1e9 Pa: small forces beside 1e7 times larger ones."""

import functools
from dataclasses import replace

import numpy as np

import warpfea as wf

from ..build import REFERENCE_TOL, StepStats, relative_error
from ..case import FLOAT32_REFUSAL, Answer, Setting, case

SOFT, HARD = wf.SVK(E=2e5, nu=0.3, density=1000.0), wf.SVK(E=2.1e11, nu=0.3, density=7850.0)
BLOCK_TENSION = 1e9
"""Tension of the block across the arm, Pa; it reaches the arm only by the block's contraction."""
LENGTH, SIDE, GRAVITY = 0.4, 0.04, 0.25
"""Size of the arm, m, and its gravity, m/s^2."""
STEPS, DT = 300, 0.05
"""Number and size (s) of the backward Euler steps. The scheme damps the arm: 0.8 % of its first swing remains."""
BOUNDS = {"float64": 1e-6, "float32": 1e-2}
CONNECTIONS = ("joint", "weld", "materials", "slender")
REFERENCE = "the same in float64, tol 1e-10"


def block_and_arm(kind: str) -> wf.ModelBuilder:
    """Block and arm tied by a fixed joint, welded, or one body of two `materials`; "slender": a strip of steel on a
    joint."""
    b = wf.ModelBuilder(gravity=(0, 0, -GRAVITY if kind != "slender" else -9.81))
    size, cells = (0.2, 0.1, 0.1), (2, 1, 1)
    if kind == "materials":
        mesh = wf.mesh.box((0.2 + LENGTH, SIDE, SIDE), cells=(12, 1, 1), origin=(0, -SIDE / 2, -SIDE / 2))
        hard = mesh.points[mesh.cells].mean(axis=1)[:, 0] < 0.2
        mesh = replace(mesh, element_sets={"hard": np.flatnonzero(hard), "soft": np.flatnonzero(~hard)})
        block = arm = b.add_solid(mesh, material={"hard": HARD, "soft": SOFT}, name="bar")
        b.clamp(block.nodes("x-"))
        half = 0.5 * SIDE
    else:
        block = b.add_solid(wf.mesh.box(size, cells=cells, origin=(0, -0.05, -0.05)), material=HARD, name="block")
        b.clamp(block.nodes("x-"))
        height, half = SIDE if kind != "slender" else 0.01, 0.05
        mesh = wf.mesh.box((LENGTH, SIDE, height), cells=(8, 1, 1), origin=(0.2, -SIDE / 2, -height / 2))
        arm = b.add_solid(mesh, material=SOFT if kind != "slender" else HARD, name="arm")
        if kind == "weld":
            b.weld(arm.surface("x-"), block)
        else:
            b.add_joint("fixed", parent=block.surface("x+"), child=arm.surface("x-"))
    for side in (-1.0, 1.0):
        face = block.surface(lambda X, side=side: (abs(X[:, 2] - side * half) < 1e-6) & (X[:, 0] < 0.2))
        b.add_traction(face, (0, 0, side * BLOCK_TENSION))
    b.add_probe("root", arm.at((0.2, 0, 0)))
    b.add_probe("tip", arm.surface("x+"))
    return b


def timoshenko_sag() -> float:
    """Deflection of the soft arm's tip by Timoshenko's theory, m."""
    weight = SOFT.density * GRAVITY  # N/m^3
    return weight * (1.5 * LENGTH**4 / SIDE**2 + 1.2 * (1.0 + SOFT.nu) * LENGTH**2) / SOFT.E


def tip_displacement(
    kind: str, motion: bool, device: str, dtype: str, tol: float | None
) -> tuple[np.ndarray, StepStats]:
    """Displacement of the tip relative to the root, (steps or load steps, 3), m, and statistics of the steps."""
    model, stats = block_and_arm(kind).finalize(device=device, dtype=dtype), StepStats()
    if motion:
        sim = wf.Simulation(model, dt=DT, solver=wf.NewtonPCG(tol=tol))
        stats.step(sim, STEPS)
    else:
        sim = wf.solve_static(model, load_steps=4, tol=tol, outputs=[stats]).simulation
    return sim.probe("tip").displacement[0] - sim.probe("root").displacement[0], stats


reference_displacement = functools.cache(tip_displacement)


def evaluate(setting: Setting, kind: str, motion: bool) -> Answer:
    """Answer: displacement against float64, and the final one against Timoshenko's theory."""
    path, stats = tip_displacement(kind, motion, setting.device, setting.dtype, None)
    error = relative_error(path, reference_displacement(kind, motion, setting.device, "float64", REFERENCE_TOL)[0])
    limits = {}
    if kind != "slender":  # the root of the steel strip rotates by more than its own deflection
        limits = {"off Timoshenko": (abs(path[-1, 2] / -timoshenko_sag() - 1.0), 0.05)}
    return stats.answer(error, BOUNDS[setting.dtype], REFERENCE, limits=limits)


for _name, _motion, _quick, _text in (
    ("stiff-beside-soft", False, "both",
     "A soft arm (2e5 Pa), or a slender one of steel, sags on a steel block under 1e9 Pa across it; four load steps."),
    ("stiff-beside-soft-motion", True, "none", "The arm released, 300 steps of backward Euler of 50 ms."),
):  # fmt: skip
    _trial = functools.partial(evaluate, motion=_motion)
    case(_name, "Stiff beside soft", values=CONNECTIONS, quick=_quick, refusal=FLOAT32_REFUSAL, description=_text)(
        _trial
    )
