"""`warpfea bench --peer`: warpfea beside a peer, the CUDA code of the authors of the papers (Newton + cuDSS, H200).

Each row steps a problem of problems.py from rest with h = 1 ms. ms per step is the median over steps 20 to 120,
with the Newton iterations that |g|_2 < 5e-4 N takes; set-up and compilation are separate. The tip after 0.1 s is
compared with a solve ten times tighter in float64. The peer spreads the bar's 5000 N evenly over the nodes of x = 3,
here it is a uniform traction of the same total. Its unstructured meshes are not published: those here have nearly as
many elements and nodes (Gmsh 4.15.2: surface triangles of one size, and a coarser inside).

Columns, with times in ms or s, the tip in m after 0.1 s (or the last step), forces in N:

unknowns        3 x nodes or slots, as the peer counts
free_unknowns   those that are not clamped; bytes are per free unknown
speedup         peer_ms over ms_per_step; None where a step kept more than FORCE_TOL, as float32 may
required        smallest speedup that will do
residual_force  largest |g|_2 of a step
tip_difference  of the tip from the tighter solve, over the latter
"""

import argparse
import pathlib
import statistics
import time as clock
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.errors import UsageError
from ...mesh import Mesh, check
from ...solvers import NewtonPCG
from ..files import DATA_FOLDER
from .measure import Kind, Row, run_columns, run_once, select_by_label, solver
from .problems import PROBLEMS

__all__ = ["DT", "FORCE_TOL", "LARGE_CASE", "PEER_CASES", "PEER_KIND", "Case", "required_speedup"]

PEER_SOURCE = "the authors' own CUDA code (Newton + cuDSS, fixed sparsity), H200, two Newton iterations per step"
DT = 1e-3
STEPS = 120
FIRST_TIMED_STEP = 20
"""First step whose time counts."""
TIP_STEP = 100
SOLVER_OPTIONS = {"preconditioner_dtype": "float32"}
FORCE_TOL = 5e-4
TIGHTENING = 10.0


@dataclass(frozen=True)
class Case:
    """A row of the peer's table: size as its problem takes it, or a mesh file; unknowns are 3 x its nodes or slots."""

    label: str
    problem: str
    size: Any
    unknowns: int
    peer_ms: float | None


PEER_CASES = (
    Case("bar-3x2x1", "bar", (3, 2, 1), 315, 2.46),
    Case("bar-12x8x4", "bar", (12, 8, 4), 11475, 13.4),
    Case("bar-unstructured-4567", "bar", "bar_4752.npz", 27150, 22.5),
    Case("bar-unstructured-20829", "bar", "bar_20822.npz", 118326, 69.8),
    Case("bar-36x24x12", "bar", (36, 24, 12), 268275, 424.0),
    Case("bar-54x36x18", "bar", (54, 36, 18), 883227, 2131.0),
    Case("beam-30", "beam", 30, 372, 4.1),
    Case("beam-300", "beam", 300, 3612, 4.7),
    Case("beam-1000", "beam", 1000, 12012, 5.9),
    Case("beam-3000", "beam", 3000, 36012, 9.6),
    Case("beam-10000", "beam", 10000, 120012, 50.5),
    Case("plate-16x8", "plate", 8, 1836, 10.7),
    Case("plate-32x16", "plate", 16, 6732, 15.1),
    Case("plate-64x32", "plate", 32, 25740, 42.4),
    Case("plate-128x64", "plate", 64, 100620, 192.0),
)
LARGE_CASE = Case("bar-90x60x30", "bar", (90, 60, 30), 4007883, None)
LARGE_STEPS = 10
COLUMNS = {
    "problem": "", "label": "row 22", "dtype": "dtype 8", "unknowns": "unknowns 8d", "free_unknowns": "",
    "elements": "elements 8d", "peer_ms": "peer, ms 8g", "ms_per_step": "ms/step 9.3f", "speedup": "faster 7.1f",
    "required": "bar 4g", "newton_per_step": "Newton 6.2f", "pcg_per_step": "PCG 6.0f", "residual": "",
    "residual_force": "|g|, N 8.1e", "tip": "tip, m 13.6e", "tip_difference": "tip diff. 9.1e",
    "bytes_per_unknown": "B/unknown 9.0f", "setup_s": "set-up, s 9.1f", "compile_s": "compile, s 10.1f",
}  # fmt: skip


def required_speedup(case: Case) -> float | None:
    """The smallest speedup that will do."""
    if case.peer_ms is None:
        return None
    return 40.0 if case.unknowns >= 800_000 else 10.0 if case.unknowns >= 100_000 else 3.0


def first_timed_step(steps: int) -> int:
    """The first step, from 1, whose time counts; of short runs those of the second half do."""
    return min(FIRST_TIMED_STEP, steps // 2 + 1)


def load_mesh(path: pathlib.Path) -> Mesh:
    """A mesh of T10 stored as points and cells. MeshError."""
    with np.load(path) as data:
        return check(Mesh(data["points"], data["cells"], "tetra10", name=path.stem))


def _cases(options: argparse.Namespace) -> list[Case]:
    """Cases by label, and the large one where it is asked for. UsageError."""
    if options.meshes and not pathlib.Path(options.meshes).is_dir():
        raise UsageError(f"--meshes {options.meshes}: no such folder")
    options.steps, options.dtype = options.steps or STEPS, options.dtype or ["float64"]
    every = [*PEER_CASES, LARGE_CASE]
    named = select_by_label(options.rows, every) if options.rows else PEER_CASES
    return [case for case in every if case in named or (options.large and case is LARGE_CASE)]


def _settings(options: argparse.Namespace, cases: Sequence[Case]) -> dict[str, Any]:
    return {
        "peer": PEER_SOURCE, "rows": [case.label for case in cases], "dtypes": options.dtype, "dt": DT,
        "steps": options.steps, "first_step_timed": first_timed_step(options.steps), "force_tol": FORCE_TOL,
        **SOLVER_OPTIONS, "tip_after_step": min(options.steps, TIP_STEP),
        "reference_tolerance_factor": 1.0 / TIGHTENING, "steps_without_peer": min(options.steps, LARGE_STEPS),
    }  # fmt: skip


def _measure(case: Case, dtype: str, options: argparse.Namespace) -> Row | str:
    """The row of a case; what has no peer is timed only."""
    problem, size = PROBLEMS[case.problem], case.size
    if isinstance(size, str):
        path = pathlib.Path(options.meshes or DATA_FOLDER) / size
        if not path.is_file():
            return f"{case.label}: left out, there is no {size} in {path.parent} (--meshes)"
        size = load_mesh(path)
    steps = options.steps if case.peer_ms else min(options.steps, LARGE_STEPS)
    at = min(steps, TIP_STEP)
    began = clock.perf_counter()
    builder = problem.build(size)
    model = builder.finalize(device=options.device, dtype=dtype)
    setup = clock.perf_counter() - began
    run = run_once(model, dt=DT, steps=steps, solver=solver(None, force_tol=FORCE_TOL, **SOLVER_OPTIONS))
    row = {
        "problem": case.problem, "label": case.label, "unknowns": 3 * model.slots, "peer_ms": case.peer_ms,
        "free_unknowns": model.info()["unknowns"], "required": required_speedup(case),
        "residual_force": run.residual_force, "tip": float(run.tip(problem.tip_axis)[at - 1]), "setup_s": setup,
        **run_columns(run, statistics.median(run.times[first_timed_step(steps) - 1 :])),
    }  # fmt: skip
    if case.peer_ms:
        if dtype != "float64":
            model = builder.finalize(device=options.device)
        how = solver(NewtonPCG().tolerance("float64") / TIGHTENING, force_tol=FORCE_TOL / TIGHTENING)
        exact = float(run_once(model, dt=DT, steps=at, solver=how).tip(problem.tip_axis)[-1])
        row["speedup"] = case.peer_ms / row["ms_per_step"] if run.residual_force <= FORCE_TOL else None
        row["tip_difference"] = abs(row["tip"] - exact) / abs(exact)
    return row


PEER_KIND = Kind(frozenset({"rows", "large", "meshes", "dtype", "steps"}), COLUMNS, _cases, _settings, _measure)
