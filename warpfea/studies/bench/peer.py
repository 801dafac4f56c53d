"""`warpfea bench --peer`: warpfea beside a peer, the CUDA code of the authors of the papers (Newton + cuDSS, H200).

Each row steps a problem of problems.py from rest with h = 1 ms. ms per step is the median over steps 20 to 120,
with the Newton iterations that |g|_2 < 5e-4 N takes; set-up and compilation are told apart. The tip after 0.1 s is
compared with a solve ten times tighter in float64. The peer spreads the bar's 5000 N evenly over the nodes of x = 3,
here it is a uniform traction of the same total. Its unstructured meshes are not published: those here have nearly as
many elements and nodes (`warpfea study peer-meshes`).
"""

from __future__ import annotations

import argparse
import pathlib
import statistics
import time as clock
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...base.errors import UsageError
from ...mesh import Mesh, check
from ...solvers import NewtonPCG
from ..checkout import DATA
from .measure import Run, by_label, figures, run_once, solver, write
from .problems import PROBLEMS

__all__ = ["DT", "FORCE_TOL", "LARGE", "PEER", "Case", "PeerRow", "peer", "required"]

SOURCE = "the authors' own CUDA code (Newton + cuDSS, fixed sparsity), H200, two Newton iterations per step"
DT = 1e-3
STEPS = 120
FIRST = 20
"""First step whose time counts."""
TIP_STEP = 100
OPTIONS = {"preconditioner_dtype": "float32"}
FORCE_TOL = 5e-4
TIGHTER = 10.0


@dataclass(frozen=True)
class Case:
    """A row of the peer's table: size as its problem takes it, or a mesh file; unknowns are 3 x its nodes or slots."""

    label: str
    problem: str
    size: Any
    unknowns: int
    peer_ms: float | None


PEER = (
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
LARGE = Case("bar-90x60x30", "bar", (90, 60, 30), 4007883, None)
LARGE_STEPS = 10


@dataclass(frozen=True)
class PeerRow:
    """A measurement beside the peer's. Times in ms or s, the tip in m after 0.1 s (or the last step), forces in N.

    Attributes:
        unknowns: 3 x nodes or slots, as the peer counts.
        free_unknowns: those that are not clamped; bytes are per free unknown.
        speedup: peer_ms over ms_per_step; None where a step kept more than FORCE_TOL, as float32 may.
        required: smallest speedup that will do.
        residual_force: largest |g|_2 of a step.
        tip_difference: of the tip from the tighter solve, over the latter.
    """

    problem: str
    label: str
    unknowns: int
    free_unknowns: int
    elements: int
    dtype: str
    peer_ms: float | None
    ms_per_step: float
    speedup: float | None
    required: float | None
    newton_per_step: float
    pcg_per_step: float
    residual: float
    residual_force: float
    tip: float
    tip_difference: float | None
    bytes_per_unknown: float
    setup_s: float
    compile_s: float


def required(case: Case) -> float | None:
    """The smallest speedup that will do."""
    if case.peer_ms is None:
        return None
    return 40.0 if case.unknowns >= 800_000 else 10.0 if case.unknowns >= 100_000 else 3.0


def measure(case: Case, dtype: str, *, device: Any, steps: int, meshes: pathlib.Path) -> PeerRow:
    """The row of a case; what has no peer is timed only."""
    problem = PROBLEMS[case.problem]
    size = load(meshes / case.size) if isinstance(case.size, str) else case.size
    began = clock.perf_counter()
    builder = problem.build(size)
    model = builder.finalize(device=device, dtype=dtype)
    setup = clock.perf_counter() - began
    if case.peer_ms is None:
        steps = min(steps, LARGE_STEPS)
    run = run_once(model, dt=DT, steps=steps, solver=solver(None, force_tol=FORCE_TOL, **OPTIONS))
    at = min(steps, TIP_STEP)
    tip = float(run.tip(problem.axis)[at - 1])
    row = PeerRow(
        problem=case.problem,
        label=case.label,
        unknowns=3 * model.slots,
        free_unknowns=model.info()["unknowns"],
        peer_ms=case.peer_ms,
        speedup=None,
        required=required(case),
        residual_force=run.residual_force,
        tip=tip,
        tip_difference=None,
        setup_s=setup,
        **figures(run, statistics.median(run.times[first_counted(steps) - 1 :])),
    )
    if case.peer_ms is None:
        return row
    if dtype != "float64":
        model = builder.finalize(device=device)
    exact = float(tight(model, at).tip(problem.axis)[-1])
    met = row.residual_force <= FORCE_TOL
    speedup = case.peer_ms / row.ms_per_step if met else None
    return replace(row, speedup=speedup, tip_difference=abs(tip - exact) / abs(exact))


def tight(model: Any, steps: int) -> Run:
    """The reference, ten times tighter."""
    tol = NewtonPCG().tolerance("float64") / TIGHTER
    return run_once(model, dt=DT, steps=steps, solver=solver(tol, force_tol=FORCE_TOL / TIGHTER))


def first_counted(steps: int) -> int:
    """The first step, from 1, whose time counts; of short runs those of the second half do."""
    return min(FIRST, steps // 2 + 1)


def load(path: pathlib.Path) -> Mesh:
    """A mesh of T10 stored as points and cells. MeshError."""
    with np.load(path) as data:
        return check(Mesh(data["points"], data["cells"], "tetra10", name=path.stem))


def chosen(rows: str | None, large: bool) -> list[Case]:
    """Cases by label. UsageError for a label that fits none."""
    if rows is None:
        return [*PEER, *([LARGE] if large else [])]
    every = [*PEER, LARGE]
    out = by_label(rows, every)
    return [case for case in every if case in out or (large and case is LARGE)]


def peer(options: argparse.Namespace) -> None:
    """Do `warpfea bench --peer`: a line per row, and the file after each."""
    cases = chosen(options.rows, options.large)
    folder = pathlib.Path(options.meshes or DATA)
    if options.meshes and not folder.is_dir():
        raise UsageError(f"--meshes {options.meshes}: no such folder")
    steps, dtypes = options.steps or STEPS, options.dtype or ["float64"]
    settings = {
        "peer": SOURCE,
        "rows": [case.label for case in cases],
        "dtypes": dtypes,
        "dt": DT,
        "steps": steps,
        "first_step_timed": first_counted(steps),
        "force_tol": FORCE_TOL,
        **OPTIONS,
        "tip_after_step": min(steps, TIP_STEP),
        "reference_tolerance_factor": 1.0 / TIGHTER,
        "steps_without_peer": min(steps, LARGE_STEPS),
    }
    rows: list[PeerRow] = []
    print(HEADER, flush=True)
    for case in cases:
        if isinstance(case.size, str) and not (folder / case.size).is_file():
            print(f"{case.label}: left out, there is no {case.size} in {folder} (--meshes)", flush=True)
            continue
        for dtype in dtypes:
            rows.append(measure(case, dtype, device=options.device, steps=steps, meshes=folder))
            print(_line(rows[-1]), flush=True)
            write(options, settings, rows)
    write(options, settings, rows)


HEADER = (
    f"{'row':22} {'dtype':8} {'unknowns':>8} {'elements':>8} {'peer, ms':>8} {'ms/step':>9} {'faster':>7} {'bar':>4} "
    f"{'Newton':>6} {'PCG':>6} {'|g|, N':>8} {'tip, m':>13} {'tip diff.':>9} {'B/unknown':>9} {'set-up, s':>9} "
    f"{'compile, s':>10}"
)


def _line(r: PeerRow) -> str:
    def text(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    return (
        f"{r.label:22} {r.dtype:8} {r.unknowns:8d} {r.elements:8d} {text(r.peer_ms, 'g'):>8} {r.ms_per_step:9.3f} "
        f"{text(r.speedup, '.1f'):>7} {text(r.required, 'g'):>4} {r.newton_per_step:6.2f} {r.pcg_per_step:6.0f} "
        f"{r.residual_force:8.1e} {r.tip:13.6e} {text(r.tip_difference, '.1e'):>9} "
        f"{r.bytes_per_unknown:9.0f} {r.setup_s:9.1f} {r.compile_s:10.1f}"
    )
