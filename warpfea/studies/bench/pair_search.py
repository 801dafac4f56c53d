"""Time of detection and of forces between two layers against their facets, for `warpfea bench --pairs`.

search: facets and boxes of the iterate, a look around, and the seats of all points. force: that, forces at the points
and their sums on the slots, what every iterate takes. refit: the tree's boxes made anew, what the rule asks for now
and then. Each is repeated in one go, on CUDA as a recorded graph; the median counts.
"""

from __future__ import annotations

import statistics
import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ...simulation.simulation import Simulation
from ...terms.pairs import Pairs
from .measure import solver
from .pair_scenes import layers

__all__ = ["SearchRow", "search"]

GOALS = {"cuda": {1_000: 0.06, 10_000: 0.1, 100_000: 0.5, 1_000_000: 4.0}, "cpu": {10_000: 6.0, 100_000: 60.0}}
"""ms: on CUDA of the force, on one core of refit and search."""
DEPTH = 1e-4
ROUNDS = 7
MOTION = 1e-3


@dataclass(frozen=True)
class SearchRow:
    """Times in ms.

    Attributes:
        facets: of both layers. touching: points in contact. points: of all.
        goal: of `force_ms` on CUDA, of `refit_ms` + `search_ms` on the CPU.
        bytes_per_point: of contact, in the model, the workspace and the state.
    """

    label: str
    facets: int
    points: int
    touching: int
    search_ms: float
    force_ms: float
    refit_ms: float
    goal: float | None
    bytes_per_point: float
    setup_s: float


def search(label: str, facets: int, device: Any) -> SearchRow:
    """The row of so many facets."""
    began = clock.perf_counter()
    model = layers(facets).finalize(device=device)
    sim = Simulation(model, dt=1e-3, solver=solver(None, preconditioner="block-jacobi"), ledger=False)
    setup = clock.perf_counter() - began
    at, work = sim.stepper.newton.at, sim.stepper.work
    term: Pairs = model.terms.find(Pairs)
    tables, scratch = term.tables, at.scratch[term.name]
    active = wp.ones(1, dtype=wp.int32, device=model.device)
    work.step.h.fill_(1e-3)
    rng = np.random.default_rng(1)
    u = MOTION * 1e-2 * rng.standard_normal((1, model.slots, 3))
    u[:, model.part == model.part[-1]] -= (0.0, 0.0, DEPTH)
    term.begin(at, active)
    work.u.assign(u)
    term.force(at, active)
    touching = int((scratch["attempt"].depth.numpy()[scratch["touching"].seat.numpy() >= 0] > 0.0).sum())
    times = {
        name: timed(model.device, do)
        for name, do in {
            "search": lambda: term._seek(at, work.u, active, settling=0.0),
            "force": lambda: term.force(at, active),
            "refit": lambda: term._refit(at),
        }.items()
    }
    rows = len(tables.host[0].conn) + tables.facets
    goal = GOALS["cuda" if model.device.is_cuda else "cpu"].get(facets)
    used = sum(v for k, v in sim.bytes().items() if "contact" in k or "pairs" in k)
    return SearchRow(
        label, rows, tables.points, touching, times["search"], times["force"], times["refit"], goal,
        used / tables.points, setup,
    )  # fmt: skip


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
