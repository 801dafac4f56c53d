"""A soft arm on a steel block under 1e9 Pa: small forces beside 1e7 times larger ones."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

import warpfea as wf

from ..build import REFINED, Count, off
from ..case import Answer, Setting, case

SOFT, HARD = wf.SVK(E=2e5, nu=0.3, density=1000.0), wf.SVK(E=2.1e11, nu=0.3, density=7850.0)
STRESS = 1e9
"""Tension of the block across the arm, Pa; it reaches the arm only by the block's contraction."""
LENGTH, SIDE, G = 0.4, 0.04, 0.25
"""Size of the arm, m, and its gravity, m/s^2."""
STEPS, H = 300, 0.05
"""Step of backward Euler, which damps the arm: 0.8 % of its first swing remains."""
BOUNDS = {"float64": 1e-6, "float32": 1e-2}
KINDS = ("joint", "weld", "materials", "slender")
SAME = "the same in float64, tol 1e-10"


def pair(kind: str) -> wf.ModelBuilder:
    """Block and arm tied by a fixed joint, welded, or one body of two `materials`; "slender": a strip of steel on a
    joint."""
    b = wf.ModelBuilder(gravity=(0, 0, -G if kind != "slender" else -9.81))
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
        b.add_traction(face, (0, 0, side * STRESS))
    b.add_probe("root", arm.at((0.2, 0, 0)))
    b.add_probe("tip", arm.surface("x+"))
    return b


def sag() -> float:
    """Deflection of the soft arm's tip by Timoshenko's theory, m."""
    weight = SOFT.density * G  # N/m^3
    return weight * (1.5 * LENGTH**4 / SIDE**2 + 1.2 * (1.0 + SOFT.nu) * LENGTH**2) / SOFT.E


def bends(kind: str, motion: bool, device: str, dtype: str, tol: float | None) -> tuple[np.ndarray, Count]:
    """Displacement of the tip relative to the root, (steps, 3), m."""
    model, count = pair(kind).finalize(device=device, dtype=dtype), Count()
    if motion:
        sim = wf.Simulation(model, dt=H, solver=wf.NewtonPCG(tol=tol))
        count.step(sim, STEPS)
    else:
        sim = wf.solve_static(model, load_steps=4, tol=tol, outputs=[count]).simulation
    return sim.probe("tip").displacement[0] - sim.probe("root").displacement[0], count


@functools.cache
def refined(kind: str, motion: bool, device: str) -> np.ndarray:
    """The displacement by a refined solution in float64."""
    return bends(kind, motion, device, "float64", REFINED)[0]


def judged(setting: Setting, kind: str, motion: bool) -> Answer:
    """Answer: bend against float64, and the final one against theory."""
    way, count = bends(kind, motion, setting.device, setting.dtype, None)
    error = off(way, refined(kind, motion, setting.device))
    limits = {}
    if kind != "slender":  # a strip of steel bends by less than the rotation of its uneven root
        limits = {"off Timoshenko": (abs(way[-1, 2] / -sag() - 1.0), 0.05)}
    return count.answer(error, BOUNDS[setting.dtype], SAME, limits=limits)


@case("stiff-beside-soft", "Stiff beside soft", values=KINDS, quick="both", refusal={"float32": ["float32"]})
def statics(setting: Setting, value: str) -> Answer:
    """A soft arm (2e5 Pa), or a slender one of steel, sags on a steel block under 1e9 Pa, in four load steps."""
    return judged(setting, value, False)


@case("stiff-beside-soft-motion", "Stiff beside soft", values=KINDS, quick="none", refusal={"float32": ["float32"]})
def motion(setting: Setting, value: str) -> Answer:
    """The arm released, 300 steps of backward Euler of 50 ms."""
    return judged(setting, value, True)
