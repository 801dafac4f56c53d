"""`warpfea bench --worlds`: many worlds of small models, error beside run time.

Scenes: `pendulum` with 16 elements, h = 2 ms; `slider` (slider_crank), 1 ms; `double` (double_pendulum), 4 ms, and
`rigid`, the same of rigid links; `finger`, a box 0.12 x 0.02 x 0.02 m with 20 x 2 x 2 cells of T10, neo-Hookean, E = 1
MPa, nu = 0.45, 1100 kg/m^3, eta = 300 Pa s, clamped, with a traction that rises to 2 kPa in 0.1 s, 2 ms; `tets`, the
same box with 12 x 2 x 2 cells of five T4 under gravity alone, 2 ms; `gripper`, that scene with 64 nodes (T4), mu = 0.6,
1/240 s: four steps are one of an environment at 60 Hz; `arm`, 20 ms: one of an environment at 50 Hz.

Three steps are not timed, then ten are; after 100 steps ten again. Steps read nothing back (record=False,
on_failure="freeze", no ledger). The tip of world 0 is compared with that of one world in float64 with a tolerance of
1e-11 (1e-10 or 1e-9 where that halves steps), over its travel. `equal`: all worlds have the bits of the first. Methods:
`auto`, the defaults; `banded`, factors of a narrow band by a block of threads per world; `loose` and `rough`, with a
tolerance of 1e-4 and 1e-2, and the factors where the band is narrow. `goal`: world-steps per second that were asked for
at 4096 worlds in float64.

Columns, with times in ms and errors over the tip's travel:

later_ms, later_error   after `LATER` steps
equal                   every world has the bits of the first
whole_ms                of all steps of a scene in `WHOLE_MOTION_STEPS`; its `goal` and `reached` are about them
goal, reached           world-steps per second asked for, and whether they are
note                    why there are no numbers, such as too little memory
"""

import argparse
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ... import mesh
from ...base.errors import CapacityError, ModelError
from ...builder.builder import ModelBuilder
from ...builder.scene import find
from ...materials import KelvinVoigt, NeoHookean
from ...simulation.simulation import Simulation
from ...solvers import NewtonPCG
from .measure import Kind, Row, select_by_label

__all__ = ["CASES", "RATE_GOALS", "WORLDS_KIND", "five_tet_box"]

WORLD_COUNTS = (1, 64, 1024, 4096, 16384)
WARM, TIMED, LATER = 3, 10, 100
RATE_GOALS = {
    "pendulum": 850_000, "slider": 200_000, "double": 100_000, "rigid": 341_000, "finger": 25_000,
    "tets": 1_638_400, "gripper": 74_400, "arm": 20_000,
}  # fmt: skip
"""World-steps/s at 4096 worlds; of `tets` 2.5 ms per step, of `gripper` 18 600 steps of environments per second."""
WHOLE_MOTION_STEPS = {"gripper": 240, "arm": 80}
"""Steps of scenes whose beginning stands for little: the block falls, is gripped and lifted in 1 s."""
METHOD_TOLS = {"auto": None, "banded": None, "loose": 1e-4, "rough": 1e-2}
"""Methods, and their tolerances; None: the default of the precision."""
NARROW_BAND_SCENES = ("pendulum", "slider", "tets")
"""Scenes with a narrow band, which all methods but "auto" factor."""
REFERENCE_TOLS = (1e-11, 1e-10, 1e-9)
"""Tolerances of references; the first that no step is halved for, which would make it another motion."""


def five_tet_box(size: tuple[float, float, float], cells: tuple[int, int, int]) -> Any:
    """A box of T4, five per cell, mirrored from cell to cell so that faces match."""
    n = np.array(cells) + 1
    grid = np.stack(np.meshgrid(*(np.linspace(0.0, s, k) for s, k in zip(size, n)), indexing="ij"), axis=-1)
    number = np.arange(np.prod(n)).reshape(n)
    out = []
    for i, j, k in np.ndindex(*cells):
        odd = (i + j + k) % 2
        c = [number[i + (a ^ odd), j + b, k + d] for a in (0, 1) for b in (0, 1) for d in (0, 1)]
        out += [[c[p] for p in tet] for tet in ((0, 1, 2, 4), (3, 2, 1, 7), (5, 4, 7, 1), (6, 7, 4, 2), (1, 2, 4, 7))]
    points, tets = grid.reshape(-1, 3), np.array(out)
    edges = points[tets[:, 1:]] - points[tets[:, :1]]
    flipped = np.linalg.det(edges) < 0.0
    tets[flipped, 1], tets[flipped, 2] = tets[flipped, 2].copy(), tets[flipped, 1].copy()
    ends = {"x-": np.flatnonzero(points[:, 0] == 0.0), "x+": np.flatnonzero(points[:, 0] == size[0])}
    return mesh.Mesh(points, tets, "tetra", node_sets=ends)


def _finger_model(points: Any, traction: bool) -> ModelBuilder:
    b = ModelBuilder(gravity=(0, 0, -9.81))
    law = NeoHookean.from_E_nu(E=1e6, nu=0.45, density=1100.0, damping=KelvinVoigt(eta=300.0) if traction else None)
    body = b.add_solid(points, material=law, name="finger")
    b.clamp(body.nodes("x-"))
    if traction:
        b.add_traction(body.surface("x+"), ((0.0, 0.1), ((0, 0, 0), (0, 2e3, 0))))
    b.add_probe("tip", body.nodes("x+"))
    return b


SCENES: dict[str, tuple[Callable[[], ModelBuilder], float]] = {
    "pendulum": (lambda: find("pendulum")(elements=16), 2e-3),
    "slider": (lambda: find("slider_crank")(), 1e-3),
    "double": (lambda: find("double_pendulum")(), 4e-3),
    "rigid": (lambda: find("double_pendulum")(rigid=True), 4e-3),
    "finger": (lambda: _finger_model(mesh.box((0.12, 0.02, 0.02), cells=(20, 2, 2)), True), 2e-3),
    "gripper": (lambda: find("gripper")(element="T4"), 1.0 / 240.0),
    "arm": (lambda: find("arm")(), 2e-2),
    "tets": (lambda: _finger_model(five_tet_box((0.12, 0.02, 0.02), (12, 2, 2)), False), 2e-3),
}


@dataclass(frozen=True)
class Case:
    """A row by its label: scene, method, worlds."""

    label: str
    scene: str
    method: str
    worlds: int


def _methods(scene: str) -> list[str]:
    if scene not in NARROW_BAND_SCENES:
        return ["auto", "loose"]
    return list(METHOD_TOLS) if scene == "tets" else ["auto", "banded", "loose"]


CASES = [Case(f"{s}-{m}-{B}", s, m, B) for s in SCENES for m in _methods(s) for B in WORLD_COUNTS]


COLUMNS = {
    "label": "worlds 22", "dtype": "dtype 8", "worlds": "", "unknowns": "unknowns 8d", "ms_per_step": "ms/step 9.2f",
    "world_steps_per_s": "world-steps/s 13.1f", "newton_per_step": "Newton 6.1f", "pcg_per_step": "PCG 6.1f",
    "tip_error": "tip error 9.1e", "later_ms": "later, ms 9.2f", "later_error": "error 8.1e",
    "bytes_per_world": "B/world 9.0f", "equal": "equal 5", "goal": "goal 9.0f", "reached": "", "setup_s": "",
    "methods": "", "whole_ms": "", "note": "",
}  # fmt: skip


class ReferenceTips(dict[str, list[Any]]):
    """Tips of one world with a tight tolerance, by scene: after the timed steps, and after the later ones."""

    def __init__(self, device: Any) -> None:
        self.device = device

    def __missing__(self, scene: str) -> list[Any]:
        """Displacements (3,), m, after `WARM + TIMED` and `LATER + TIMED` steps; None where each tolerance halves."""
        build, dt = SCENES[scene]
        model = build().finalize(device=self.device)
        steps = WARM + TIMED, LATER + TIMED
        found: list[Any] = [None, None]
        for tol in REFERENCE_TOLS:
            sim = Simulation(model, dt=dt, solver=NewtonPCG(tol=tol), ledger=False)
            whole = 0
            while whole < max(steps) and not sim.step().halvings.any():
                whole += 1
            moved = sim.probe(model.description.probes[0].name).displacement[0]
            found = [moved[k - 1] if f is None and k <= whole else f for k, f in zip(steps, found)]
            if whole == max(steps):
                break
        self[scene] = found
        return found

    def error(self, scene: str, which: int, tip: np.ndarray) -> float | None:
        """Distance of a tip from the reference, over its travel; None without one."""
        wanted = self[scene][which]
        return None if wanted is None else float(np.linalg.norm(tip - wanted) / np.linalg.norm(wanted))


def _ms_per_step(sim: Simulation, steps: int = TIMED) -> float:
    """ms per step of the next ones."""
    wp.synchronize_device(sim.model.device)
    began = clock.perf_counter()
    sim.step(steps)
    wp.synchronize_device(sim.model.device)
    return 1e3 * (clock.perf_counter() - began) / steps


def _cases(options: argparse.Namespace) -> list[Case]:
    options.dtype = options.dtype or ["float64", "float32"]
    options.references = ReferenceTips(options.device)
    return select_by_label(options.rows, CASES)


def _settings(options: argparse.Namespace, cases: Sequence[Case]) -> dict[str, Any]:
    return {
        "rows": [case.label for case in cases], "dtypes": options.dtype, "warm_up": WARM, "timed": TIMED,
        "later": LATER, "reference_tol": REFERENCE_TOLS,
    }  # fmt: skip


def _measure(case: Case, dtype: str, options: argparse.Namespace) -> Row:
    """A row; where memory does not suffice, or a method does not serve, it says so."""
    (build, dt), references = SCENES[case.scene], options.references
    began = clock.perf_counter()
    goal = RATE_GOALS[case.scene] if case.worlds == 4096 and dtype == "float64" else None
    row: Row = {"label": case.label, "dtype": dtype, "worlds": case.worlds, "unknowns": 0, "goal": goal}
    try:
        model = build().finalize(device=options.device, dtype=dtype, worlds=case.worlds)
        row["unknowns"] = model.info()["unknowns"]
        banded = case.method != "auto" and case.scene in NARROW_BAND_SCENES
        method = NewtonPCG(tol=METHOD_TOLS[case.method], preconditioner="banded" if banded else "auto")
        sim = Simulation(model, dt=dt, solver=method, ledger=False, record=False, on_failure="freeze")
        sim.step(WARM)
    except (CapacityError, ModelError) as refused:
        return row | {"note": str(refused)}
    row |= {"setup_s": clock.perf_counter() - began, "methods": sim.methods}
    before = {name: int(sim.totals[name][0]) for name in ("newton", "pcg")}
    ms = row["ms_per_step"] = _ms_per_step(sim)
    row |= {f"{name}_per_step": (int(sim.totals[name][0]) - count) / TIMED for name, count in before.items()}
    name = model.description.probes[0].name
    row["tip_error"] = references.error(case.scene, 0, sim.probe(name).displacement[0, -1])
    sim.step(LATER - WARM - TIMED)
    row["later_ms"] = _ms_per_step(sim)
    u = sim.state.displacement.numpy()
    row["later_error"] = references.error(case.scene, 1, sim.probe(name).displacement[0, -1])
    if case.scene in WHOLE_MOTION_STEPS:
        sim.reset()
        ms = row["whole_ms"] = _ms_per_step(sim, WHOLE_MOTION_STEPS[case.scene])
    rate = row["world_steps_per_s"] = 1e3 * case.worlds / ms
    return row | {
        "bytes_per_world": sum(sim.bytes().values()) / case.worlds,
        "equal": bool((u == u[:1]).all()),
        "reached": None if goal is None else rate >= goal,
    }


WORLDS_KIND = Kind(frozenset({"rows", "dtype"}), COLUMNS, _cases, _settings, _measure)
