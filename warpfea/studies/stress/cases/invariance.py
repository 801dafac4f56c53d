"""Invariance to position, orientation, and the units of length and stress."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation as Turn

import warpfea as wf

from ..build import StepStats, add_along_x, linear_steps, relative_error, solve, step
from ..case import Answer, Setting, case

ROTATION_VECTORS = ((0.3, 0.0, 0.0), (1.2, -2.1, 0.7), (0.0, np.pi, 0.0))
"""Rotation vectors, rad."""
SIZE = (1.0, 0.1, 0.1)
"""Length of the cantilevers, in the unit of the row."""
HOME = Turn.identity()


def _cantilever(
    element: str, law: wf.SVK, load: float, turn: Turn = HOME, shift: Any = (0.0, 0.0, 0.0), unit: float = 1.0
) -> tuple[wf.ModelBuilder, wf.Body]:
    """A cantilever of length `unit`, rotated about the origin and moved, with a transverse tip load `load` N; probe
    "tip".
    """
    R = turn.as_matrix()
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    cells = {"3243": (4,), "3443": (8, 1)}.get(element, (6, 1, 1))
    body, start, end = add_along_x(b, element, cells, [unit * side for side in SIZE], law, turn=R, shift=shift)
    b.clamp(start)
    b.add_point_load(end, tuple(load * R[:, 2]))
    b.add_probe("tip", end)
    return b, body


@case("frame", "Invariance", values=("T10-1e4", "T10-1e6", "H3843-1e6", "3243-1e4", "3243-1e6", "3443-1e6"),
      quick="both")  # fmt: skip
def frame_invariance(setting: Setting, value: str) -> Answer:
    """A cantilever bent by a third of its length, rotated and moved by 10 or 1000 km, deflects as at the origin.

    In float32 up to the round-off estimates of both reports.
    """
    element, away = value.split("-")
    law = wf.SVK(E=1e9, nu=0.3)
    load = 1e9 * SIZE[1] ** 4 / 12.0
    stats = StepStats()
    tips: list[np.ndarray] = []
    for turn in (HOME, *(Turn.from_rotvec(v) for v in ROTATION_VECTORS)):
        shift = float(away) * np.array([0.6, -0.48, 0.64]) if tips else np.zeros(3)
        b, _ = _cantilever(element, law, load, turn, shift)
        found = solve(b, setting, stats, load_steps=2, tol=None if setting.single else 1e-12)
        tips.append(turn.inv().apply(found.tip))
    worst = max(relative_error(tip, tips[0]) for tip in tips)
    bound = max(1e-4, 3.0 * stats.floor) if setting.single else 1e-8
    return Answer(worst, bound, "the same body at the origin", **stats.answer_fields)


@case("units", "Invariance", values=("mm", "km"), quick="both")
def unit_invariance(setting: Setting, value: str) -> Answer:
    """A cantilever measured in mm and N, and in km and N, has the same relative deflection as in m."""
    unit = {"mm": 1e3, "km": 1e-3}[value]
    stats = StepStats()

    def tip(element: str, per_metre: float) -> np.ndarray:
        law, load = wf.SVK(E=1e9 / per_metre**2, nu=0.3), 1e9 * SIZE[1] ** 4 / 12.0
        b, _ = _cantilever(element, law, load, unit=per_metre)
        return solve(b, setting, stats, load_steps=2, tol=None if setting.single else 1e-12).tip / per_metre

    worst = max(relative_error(tip(element, unit), tip(element, 1.0)) for element in ("T10", "3243", "3443"))
    return Answer(worst, 1e-4 if setting.single else 1e-8, "the same body in m", **stats.answer_fields)


MODULI = ("1e3", "1e6", "1e9", "1e12")


@case("stiffness-static", "Invariance", values=MODULI, quick="both")
def stiffness_static(setting: Setting, value: str) -> Answer:
    """A fixed small load: deflection times E is equal for E from 1 kPa to 1 TPa."""
    load = 1e-6 * 1e3 * SIZE[1] ** 4 / 12.0
    stats = StepStats()

    def scaled_tip(element: str, E: float) -> float:
        b, _ = _cantilever(element, wf.SVK(E=E, nu=0.3), load)
        return E * float(solve(b, setting, stats, load_steps=1, tol=1e-6 if setting.single else 1e-10).tip[2])

    moduli = (float(value), 1e6)
    worst = max(relative_error(*(scaled_tip(element, E) for E in moduli)) for element in ("T10", "3243", "3443"))
    return Answer(worst, 1e-4 if setting.single else 1e-8, "linear statics", **stats.answer_fields)


@case("stiffness-dynamic", "Invariance", values=MODULI, quick="both")
def stiffness_dynamic(setting: Setting, value: str) -> Answer:
    """Steps of 1 ms of backward Euler from rest under a small load, E from 1 kPa to 1 TPa."""
    E, h, steps = float(value), 1e-3, 20
    stats = StepStats()
    worst = 0.0
    for element in ("T10", "3243"):
        law = wf.SVK(E=E, nu=0.3, density=1000.0)
        b, body = _cantilever(element, law, 1.0)
        model = b.finalize(device="cpu")
        force = np.zeros((model.slots, 3))
        for dead in b.description.dead_loads:
            np.add.at(force, body.slot_offset + dead.slots, dead.weights[:, None] * dead.law.values[0])
        exact = linear_steps(model, force, h, steps)
        load = 1e-7 / float(np.abs(exact).max())  # second-order terms: strains of about 1e-7
        b, _ = _cantilever(element, law, load)
        sim, _ = step(b, setting, steps, stats, dt=h, solver=wf.NewtonPCG(tol=None if setting.single else 1e-10))
        worst = max(worst, relative_error(sim.state.displacement.numpy()[0], load * exact))
    return Answer(worst, 1e-4 if setting.single else 1e-6, "linear backward Euler by scipy", **stats.answer_fields)
