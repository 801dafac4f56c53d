"""Cost of contact between bodies, in four kinds of rows.

pile: ten cubes of 0.2 m that fall on each other (pair_scenes.py), h = 10 ms, n^3 cells of T4 or T10 with as many nodes,
to a residual of 1e-6 and of 1e-3, beside libuipc 0.0.29 on the same T4 meshes and an H200, which ran with a velocity
tolerance of 1e-3 m/s and a linear one of 1e-6, and with its loose defaults and multilevel preconditioner. ms per step
is the mean of a window, without the first step's compilation and recording. The deepest penetration of any contact at
the end of any step is stated, m; theirs stay 2 mm apart. wanted: times that must be gained on peer_ms. residual:
largest of a step. pairs_share: of contact between bodies in the time of the steps that follow, launch by launch.

solves: PCG iterations of single linear solves to 1e-8, with preconditioners of that very iterate, of 5, 10 and 20 cubes
that rest on a plate: `ratio`, of the mean over that of 5 cubes where that row came before, must not grow by 1.5.

search, core: detection and forces between two layers against their facets, on the device and on one core of the CPU.
search_ms: facets and boxes of the iterate, a look around, and the seats of all points. force_ms: that, forces at the
points and their sums on the slots, as every iterate takes. refit_ms: the tree's boxes made afresh, as the rule asks for
now and then. Each is repeated in one go, on CUDA as a recorded graph; the median counts. facets: of both layers;
touching: points in contact, of all points; goal: of force_ms on CUDA, of refit_ms + search_ms on the CPU;
bytes_per_point: of contact, in the model, the workspace and the state.

worlds: two blocks, and a finger with a block, many times: worlds times steps per second; bytes per world.
"""

from __future__ import annotations

import statistics
import time as clock
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from warpfea.kernels.terms.contact_data import RECORD

import warpfea as wf
from warpfea.base.devices import find_device
from warpfea.simulation.simulation import Simulation
from warpfea.studies.bench.measure import solver
from warpfea.studies.profile.profiling import profile
from warpfea.terms.pairs import Pairs

from .contact_cost import FORCING, SOLVED, count_solves
from .pair_scenes import blocks, finger, layers, pile, resting
from .table import Row, Run, Table

__all__ = ["CASES", "TABLE"]

DT = 1e-2
WINDOWS = {4: 100, 10: 60, 20: 40}
"""Steps by cells of T4 along a side."""
PEER = {("tight", 4): 17.7, ("tight", 10): 44.0, ("tight", 20): 245.0, ("loose", 4): 10.0, ("loose", 10): 18.0,
        ("loose", 20): 60.0}  # fmt: skip
TOL = {"tight": 1e-6, "loose": 1e-3}
WANTED = {"tight": 3.0, "loose": 1.0}
"""Times that a step must be faster than the peer's."""
STIFFNESS = {4: 11.0, 10: 11.0, 20: 15.0}
"""By cells along a side: with it the deepest point stays within `DEEPEST`."""
DEEPEST = 2e-3
GROWTH = 1.5
PROFILED = 3
WORLD_STEPS = 20
WORLD_SCENES: dict[str, tuple[Callable[[], wf.ModelBuilder], float]] = {
    "blocks": (blocks, 1e-2),
    "finger": (finger, 2e-3),
}


GOALS = {"cuda": {1_000: 0.06, 10_000: 0.1, 100_000: 0.5, 1_000_000: 4.0}, "cpu": {10_000: 6.0, 100_000: 60.0}}
"""ms: on CUDA of the force, on one core of refit and search."""
DEPTH = 1e-4
ROUNDS = 7
MOTION = 1e-3


DEPTH, MOTION = 1e-4, 1e-3
"""m: of the layers in each other, and of random displacements over 1e-2."""
ROUNDS = 7


@dataclass(frozen=True)
class Case:
    """A row by its label: its kind and what the kind takes."""

    label: str
    kind: str
    given: tuple[Any, ...]


CASES = [
    *(Case(f"pile-{n}-{how}", "pile", (n, n, "T4", how)) for n in WINDOWS for how in TOL),
    *(Case(f"pile-{n}-T10-{how}", "pile", (n, n // 2, "T10", how)) for n in WINDOWS for how in TOL),
    *(Case(f"solves-{E:.0e}-{n}".replace("+0", ""), "solves", (n, E)) for E in (1e6, 1e8) for n in (5, 10, 20)),
    *(Case(f"search-{n:.0e}".replace("+0", ""), "search", (n, False)) for n in (1_000, 10_000, 100_000, 1_000_000)),
    *(Case(f"core-{n:.0e}".replace("+0", ""), "search", (n, True)) for n in (10_000, 100_000)),
    *(Case(f"worlds-{name}-{B}", "worlds", (name, B)) for name in WORLD_SCENES for B in (1, 16, 256, 1024, 4096)),
]


def deepest(sim: Simulation) -> float:
    """Deepest point of all contacts at the end of the last step, m."""
    report = sim.stepper.work.report.numpy()
    width, at = len(RECORD), RECORD.index("penetration")
    columns = [
        column
        for term in sim.model.terms
        if term.name in ("contact", "pairs")
        for column in range(term.report_offset + at, term.report_offset + term.report_columns, width)
    ]
    return float(report[:, columns].max())


def spent(sim: Simulation, before: Row, steps: int) -> Row:
    """Iterations per step since `before`, the totals of then."""
    return {f"{name}_per_step": (int(sim.totals[name][0]) - count) / steps for name, count in before.items()}


def started(sim: Simulation) -> Row:
    """Record the launches of a simulation; its totals from then on."""
    sim.step()
    sim.reset()
    return {name: int(sim.totals[name][0]) for name in ("newton", "pcg")}


def pile_row(given: tuple[Any, ...], dtype: str, run: Run) -> Row:
    """A window of a pile."""
    n, cells, element, how = given
    began = clock.perf_counter()
    model = pile(cells, element, stiffness=STIFFNESS[n]).finalize(device=run.device, dtype=dtype)
    sim = Simulation(model, dt=DT, solver=solver(TOL[how]), ledger=False)
    before = started(sim)
    setup = clock.perf_counter() - began
    steps = min(WINDOWS[n], run.options["steps"] or WINDOWS[n])
    times, depth, residual, halvings = [], 0.0, 0.0, 0
    for _ in range(steps):
        start = clock.perf_counter()
        report = sim.step()  # reads its report, and so waits for the device
        times.append(clock.perf_counter() - start)
        residual, halvings = max(residual, float(report.residual.max())), halvings + int(report.halvings[0])
        depth = max(depth, deepest(sim))
    ms, peer = 1e3 * statistics.mean(times), PEER[how, n] if element == "T4" else None
    row = {
        "dtype": dtype, "nodes": sum(len(body.mesh.points) for body in model.bodies),
        "elements": model.info()["elements"], "tol": TOL[how], "steps": steps, "ms_per_step": ms,
        "median_ms": 1e3 * statistics.median(times), "peer_ms": peer, "times_faster": peer / ms if peer else None,
        "wanted": WANTED[how] if peer else None, **spent(sim, before, steps), "halvings": halvings, "deepest": depth,
        "limit": DEEPEST, "residual": residual, "launches": sim.stepper.launch.launches, "setup_s": setup,
    }  # fmt: skip
    found = profile(sim, steps=PROFILED)
    return row | {"pairs_share": found.parts["pairs"].ms / found.total_ms}


def solves_row(given: tuple[Any, ...], kind: str, run: Run) -> Row:
    """Iterations of the solves of a few steps."""
    cubes, E = given
    model = resting(cubes, 4, "T4", E).finalize(device=run.device)
    how = solver(None, forcing=FORCING, preconditioner=kind)
    counts = count_solves(Simulation(model, dt=DT, solver=how, ledger=False, capture=False), SOLVED)
    mean, first = statistics.mean(counts), run.made.setdefault((E, kind), {})
    first[cubes] = mean
    row = {"preconditioner": kind, "unknowns": model.info()["unknowns"], "pcg": counts, "per_solve": mean}
    return row | {"ratio": mean / first[5] if 5 in first else None, "limit": GROWTH}


def worlds_row(given: tuple[Any, ...], dtype: str, run: Run) -> Row:
    """Throughput of so many worlds."""
    name, worlds = given
    (build, dt), steps = WORLD_SCENES[name], run.options["steps"] or WORLD_STEPS
    model = build().finalize(device=run.device, dtype=dtype, worlds=worlds)
    sim = Simulation(model, dt=dt, solver=solver(None), ledger=False)
    before = started(sim)
    start = clock.perf_counter()
    sim.step(steps)
    time = clock.perf_counter() - start
    return {
        "dtype": dtype, "worlds": worlds, "unknowns": model.info()["unknowns"], "ms_per_step": 1e3 * time / steps,
        "world_steps_per_s": worlds * steps / time, **spent(sim, before, steps),
        "bytes_per_world": sum(sim.bytes().values()) / worlds,
    }  # fmt: skip


def search_row(given: tuple[Any, ...], _: str, run: Run) -> Row:
    """Times of so many facets, ms."""
    facets, core = given
    began = clock.perf_counter()
    model = layers(facets).finalize(device="cpu" if core else run.device)
    sim = Simulation(model, dt=1e-3, solver=solver(None, preconditioner="block-jacobi"), ledger=False)
    setup = clock.perf_counter() - began
    at, work = sim.stepper.newton.at, sim.stepper.work
    term: Pairs = model.terms.find(Pairs)
    tables, scratch = term.tables, at.scratch[term.name]
    active = wp.ones(1, dtype=wp.int32, device=model.device)
    work.step.h.fill_(1e-3)
    u = MOTION * 1e-2 * np.random.default_rng(1).standard_normal((1, model.slots, 3))
    u[:, model.part == model.part[-1]] -= (0.0, 0.0, DEPTH)
    term.begin(at, active)
    work.u.assign(u)
    term.force(at, active)
    touching = int((scratch["attempt"].depth.numpy()[scratch["touching"].seat.numpy() >= 0] > 0.0).sum())
    used = sum(v for k, v in sim.bytes().items() if "contact" in k or "pairs" in k)
    return {
        "facets": len(tables.host[0].conn) + tables.facets, "points": tables.points, "touching": touching,
        "search_ms": timed(model.device, lambda: term._seek(at, work.u, active, settling=0.0)),
        "force_ms": timed(model.device, lambda: term.force(at, active)),
        "refit_ms": timed(model.device, lambda: term._refit(at)),
        "goal": GOALS["cuda" if model.device.is_cuda else "cpu"].get(facets),
        "bytes_per_point": used / tables.points, "setup_s": setup,
    }  # fmt: skip


def timed(device: Any, do: Callable[[], Any]) -> float:
    """ms that something takes on a device, without the launches' own on CUDA."""
    repeat = do
    if device.is_cuda:
        with wp.ScopedCapture(device) as capture:
            do()
        graph = capture.graph

        def repeat() -> None:
            wp.capture_launch(graph)

    times = []
    count = 20 if device.is_cuda else 1
    for _ in range(ROUNDS):
        wp.synchronize_device(device)
        start = clock.perf_counter()
        for _ in range(count):
            repeat()
        wp.synchronize_device(device)
        times.append(1e3 * (clock.perf_counter() - start) / count)
    return statistics.median(times)


KINDS: dict[str, Callable[[tuple[Any, ...], str, Run], Row]]
KINDS = {"pile": pile_row, "solves": solves_row, "search": search_row, "worlds": worlds_row}


def rows(run: Run) -> Iterator[Row]:
    """Rows of all kinds, in each precision or with each preconditioner."""
    kinds = ["two-level"] if find_device(run.device).is_cuda else ["banded", "two-level"]
    several = {"solves": kinds, "search": ["float64"]}
    for case in filter(lambda case: run.wants(case.label), CASES):
        for name in several.get(case.kind, run.options["dtypes"]):
            yield {"label": case.label, **KINDS[case.kind](case.given, name, run)}


TABLE = Table(
    about=__doc__,
    parts={"rows": rows},
    results={
        "pairs_h200.json": "pair_cost --device cuda:0 --set dtypes=float64,float32 --out tests/results/pairs_h200.json"
    },
    options={"dtypes": ("float64",), "steps": 0},
    settings={
        "dt": DT, "windows": WINDOWS, "stiffness": STIFFNESS,
        "peer": "libuipc 0.0.29, H200", "world_steps": WORLD_STEPS,
    },
    columns=("label", "dtype", "nodes", "preconditioner", "facets", "worlds", "ms_per_step", "times_faster",
             "newton_per_step", "pcg_per_step", "deepest", "per_solve", "ratio", "search_ms", "force_ms", "refit_ms",
             "world_steps_per_s"),
)  # fmt: skip
