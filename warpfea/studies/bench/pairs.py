"""`warpfea bench --pairs`: contact between bodies, in four kinds of rows.

pile: ten cubes of 0.2 m that fall on each other (pair_scenes.py), h = 10 ms, n^3 cells of T4 or T10 with as many nodes,
to a residual of 1e-6 and of 1e-3, beside libuipc 0.0.29 on the same T4 meshes and an H200, which ran with a velocity
tolerance of 1e-3 m/s and a linear one of 1e-6, and with its loose defaults and multilevel preconditioner. ms per step
is the mean of a window, without the first step's compilation and recording. The deepest point is stated; theirs stay
2 mm apart.

solves: PCG iterations of single linear solves to 1e-8, with preconditioners of that very iterate, of 5, 10 and 20 cubes
that rest on a plate: they must not grow by 1.5.

search, core: detection and forces by facets (pair_search.py), on the device and on one core of the CPU.

worlds: two blocks, and a finger with a block, many times: worlds times steps per second.
"""

from __future__ import annotations

import argparse
import statistics
import time as clock
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import warp as wp

from ...kernels.terms.contact_data import RECORD
from ...simulation.simulation import Simulation
from ..profile.profiling import profile
from .contact_solves import FORCING, STEPS, count_solves
from .measure import by_label, solver
from .measure import write as write_file
from .pair_scenes import blocks, finger, pile, resting
from .pair_search import SearchRow, search

__all__ = ["CASES", "PileRow", "SolvesRow", "WorldsRow", "pairs"]

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
WORLD_SCENES = {"blocks": (blocks, 1e-2), "finger": (finger, 2e-3)}


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


@dataclass(frozen=True)
class PileRow:
    """A window of a pile.

    Attributes:
        peer_ms: of libuipc, T4 alone. wanted: times that must be gained on it.
        deepest: penetration of any contact at the end of any step, m; limit: most.
        residual: largest of a step.
        pairs_share: of contact between bodies in the time of the steps that follow, launch by launch.
    """

    label: str
    dtype: str
    nodes: int
    elements: int
    tol: float
    steps: int
    ms_per_step: float
    median_ms: float
    peer_ms: float | None
    times_faster: float | None
    wanted: float | None
    newton_per_step: float
    pcg_per_step: float
    halvings: int
    deepest: float
    limit: float
    residual: float
    launches: int
    setup_s: float
    pairs_share: float


@dataclass(frozen=True)
class SolvesRow:
    """Iterations of single solves; `ratio`: mean over that of 5 cubes, where that row came before."""

    label: str
    preconditioner: str
    unknowns: int
    pcg: list[int]
    per_solve: float
    ratio: float | None
    limit: float


@dataclass(frozen=True)
class WorldsRow:
    """Throughput of many worlds; bytes per world."""

    label: str
    dtype: str
    worlds: int
    unknowns: int
    ms_per_step: float
    world_steps_per_s: float
    newton_per_step: float
    pcg_per_step: float
    bytes_per_world: float


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


def measure_pile(
    label: str, n: int, cells: int, element: str, how: str, *, dtype: str, device: Any, limit: int | None
) -> PileRow:  # fmt: skip
    """The row of a pile; at most `limit` steps."""
    began = clock.perf_counter()
    model = pile(cells, element, stiffness=STIFFNESS[n]).finalize(device=device, dtype=dtype)
    sim = Simulation(model, dt=DT, solver=solver(TOL[how]), ledger=False)
    sim.step()  # records it
    sim.reset()
    setup = clock.perf_counter() - began
    before = {name: int(sim.totals[name][0]) for name in ("newton", "pcg")}
    steps = min(WINDOWS[n], limit or WINDOWS[n])
    times, depth, residual, halvings = [], 0.0, 0.0, 0
    for _ in range(steps):
        start = clock.perf_counter()
        report = sim.step()  # reads its report, and so waits for the device
        times.append(clock.perf_counter() - start)
        residual, halvings = max(residual, float(report.residual.max())), halvings + int(report.halvings[0])
        depth = max(depth, deepest(sim))
    ms = 1e3 * statistics.mean(times)
    peer = PEER[how, n] if element == "T4" else None
    spent = {name: int(sim.totals[name][0]) - count for name, count in before.items()}
    return PileRow(
        label, dtype, sum(len(body.mesh.points) for body in model.bodies), model.info()["elements"], TOL[how], steps,
        ms, 1e3 * statistics.median(times), peer, peer / ms if peer else None, WANTED[how] if peer else None,
        spent["newton"] / steps, spent["pcg"] / steps, halvings, depth, DEEPEST, residual,
        sim.stepper.launch.launches, setup, share_of_pairs(sim),
    )  # fmt: skip


def share_of_pairs(sim: Simulation) -> float:
    """Part of a step that goes to contact between bodies."""
    found = profile(sim, steps=PROFILED)
    return found.parts["pairs"].ms / found.total_ms


def measure_solves(label: str, cubes: int, E: float, *, kind: str, device: Any) -> SolvesRow:
    """Iterations of the solves of three steps."""
    model = resting(cubes, 4, "T4", E).finalize(device=device)
    how = solver(None, forcing=FORCING, preconditioner=kind)
    counts = count_solves(Simulation(model, dt=DT, solver=how, ledger=False, capture=False), STEPS)
    mean = statistics.mean(counts)
    return SolvesRow(label, kind, model.info()["unknowns"], counts, mean, None, GROWTH)


def measure_worlds(label: str, name: str, worlds: int, *, dtype: str, device: Any, steps: int) -> WorldsRow:
    """Throughput of so many worlds."""
    build, dt = WORLD_SCENES[name]
    model = build().finalize(device=device, dtype=dtype, worlds=worlds)
    sim = Simulation(model, dt=dt, solver=solver(None), ledger=False)
    sim.step()
    sim.reset()
    before = {key: int(sim.totals[key][0]) for key in ("newton", "pcg")}
    start = clock.perf_counter()
    sim.step(steps)
    time = clock.perf_counter() - start
    spent = {key: int(sim.totals[key][0]) - count for key, count in before.items()}
    return WorldsRow(
        label, dtype, worlds, model.info()["unknowns"], 1e3 * time / steps, worlds * steps / time,
        spent["newton"] / steps, spent["pcg"] / steps, sum(sim.bytes().values()) / worlds,
    )  # fmt: skip


def pairs(options: argparse.Namespace) -> None:
    """Do `warpfea bench --pairs`: a line per row, and the file after each."""
    device = wp.get_device(options.device) if options.device else wp.get_preferred_device()
    options.device = str(device)
    cases = by_label(options.rows, CASES) if options.rows else CASES
    dtypes = options.dtype or ["float64"]
    kinds = ["two-level"] if device.is_cuda else ["banded", "two-level"]
    settings = {
        "rows": [case.label for case in cases], "dtypes": dtypes, "dt": DT, "steps": options.steps or WINDOWS,
        "stiffness": STIFFNESS, "peer": "libuipc 0.0.29, H200", "world_steps": options.steps or WORLD_STEPS,
    }  # fmt: skip
    rows: list[Any] = []
    heads: set[str] = set()
    for case in cases:
        todo: list[Callable[[], Any]]
        more: dict[str, Any]
        if case.kind == "pile":
            more = {"device": device, "limit": options.steps}
            todo = [partial(measure_pile, case.label, *case.given, dtype=d, **more) for d in dtypes]
        elif case.kind == "solves":
            todo = [partial(measure_solves, case.label, *case.given, kind=kind, device=device) for kind in kinds]
        elif case.kind == "search":
            facets, core = case.given
            todo = [partial(search, case.label, facets, "cpu" if core else device)]
        else:
            more = {"device": device, "steps": options.steps or WORLD_STEPS}
            todo = [partial(measure_worlds, case.label, *case.given, dtype=d, **more) for d in dtypes]
        for do in todo:
            row = do()
            if isinstance(row, SolvesRow):
                row = grown(row, rows)
            rows.append(row)
            if case.kind not in heads:
                print(HEADERS[case.kind], flush=True)
                heads.add(case.kind)
            print(_line(row), flush=True)
            write_file(options, settings, rows)


def grown(row: SolvesRow, rows: list[Any]) -> SolvesRow:
    """The row with its ratio to that of 5 cubes."""
    first = row.label.rsplit("-", 1)[0] + "-5"
    same = [r for r in rows if isinstance(r, SolvesRow) and (r.label, r.preconditioner) == (first, row.preconditioner)]
    return SolvesRow(**(asdict(row) | {"ratio": row.per_solve / same[0].per_solve})) if same else row


HEADERS = {
    "pile": f"{'pile':18} {'dtype':8} {'nodes':>7} {'steps':>5} {'ms/step':>9} {'median':>9} {'peer':>6} {'faster':>6} "
    f"{'wanted':>6} {'Newton':>6} {'PCG':>7} {'halved':>6} {'deepest':>8} {'residual':>9} {'set-up':>6} {'pairs':>5}",
    "solves": f"{'solves':18} {'method':10} {'unknowns':>8} {'PCG: most':>9} {'mean':>6} {'ratio':>6} {'limit':>5}",
    "search": f"{'search':18} {'facets':>8} {'points':>9} {'touching':>9} {'search, ms':>10} {'force, ms':>10} "
    f"{'refit, ms':>10} {'goal':>6} {'B/point':>8} {'set-up, s':>9}",
    "worlds": f"{'worlds':20} {'dtype':8} {'unknowns':>8} {'ms/step':>9} {'worlds steps/s':>14} {'Newton':>6} "
    f"{'PCG':>6} {'B/world':>9}",
}


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _line(r: Any) -> str:
    if isinstance(r, PileRow):
        return (
            f"{r.label:18} {r.dtype:8} {r.nodes:7d} {r.steps:5d} {r.ms_per_step:9.2f} {r.median_ms:9.2f} "
            f"{_text(r.peer_ms):>6} {_text(r.times_faster):>6} {_text(r.wanted):>6} {r.newton_per_step:6.2f} "
            f"{r.pcg_per_step:7.1f} {r.halvings:6d} {r.deepest:8.1e} {r.residual:9.1e} {r.setup_s:6.1f} "
            f"{100 * r.pairs_share:4.0f}%"
        )
    if isinstance(r, SolvesRow):
        return (
            f"{r.label:18} {r.preconditioner:10} {r.unknowns:8d} {max(r.pcg):9d} {r.per_solve:6.1f} "
            f"{_text(r.ratio):>6} {r.limit:5.2f}"
        )
    if isinstance(r, SearchRow):
        return (
            f"{r.label:18} {r.facets:8d} {r.points:9d} {r.touching:9d} {r.search_ms:10.3f} {r.force_ms:10.3f} "
            f"{r.refit_ms:10.3f} {_text(r.goal):>6} {r.bytes_per_point:8.0f} {r.setup_s:9.1f}"
        )
    return (
        f"{r.label:20} {r.dtype:8} {r.unknowns:8d} {r.ms_per_step:9.2f} {r.world_steps_per_s:14.1f} "
        f"{r.newton_per_step:6.2f} {r.pcg_per_step:6.1f} {r.bytes_per_world:9.0f}"
    )
