"""`warpfea bench --product`: the operator H v alone, in unknowns per second, and which limit of the device binds it.

A product is `Residual.product` with backward Euler's factors for h = 1 ms at a state of small random displacements
(1e-4 of an element), applied to random numbers. "elements": each element does its own part, and slots sum them;
"matrix": the 3x3 blocks assembled at the state. `chosen` marks the one that the solver takes by itself. On CUDA the
products are recorded as one graph and replayed, on the CPU they run in a loop; the median of several counts.

Bytes and operations are counted in cost.py: the share of the bandwidth is of what a copy of a large array reaches
here, the share of arithmetic of the device's peak, where it is known. The larger of both is the limit that binds.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import statistics
import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ...base.devices import find_device
from ...model.model import Model
from ...simulation.simulation import Simulation
from ...solvers.residual import Residual
from ..profile.profiling import copy_bandwidth
from .cost import cost
from .measure import check_sizes, solver, write
from .problems import DENSITY, PROBLEMS

__all__ = ["PEAKS", "ProductRow", "product"]

PROBLEM_SIZES = {"bar": 4_000_000, "beam": 1_000_000, "plate": 1_000_000, "ENMC": 1_000_000, "FN18": 1_000_000}
DT = 1e-3
DISPLACEMENT = 1e-4
PRODUCTS = {"cuda": 20, "cpu": 3}
REPEAT = 9
PEAKS = {"H200": (34.0, 67.0), "H100 80GB HBM3": (34.0, 67.0), "A100": (9.7, 19.5)}
"""1e12 operations per second of float64 and float32 vectors (data sheets), by a part of the GPU's name."""


@dataclass(frozen=True)
class ProductRow:
    """A measurement. Shares are None where the device's peak is not known, and so is the limit.

    Attributes:
        operator: "elements" or "matrix". chosen: whether the solver takes it by itself.
        unknowns: free ones; all figures per unknown are per free unknown.
        ms: of a product.
        bytes_per_unknown, flops_per_unknown: least traffic, and operations, see cost.py.
        GBps, Gflops: 1e9 of them per second.
        limit: "bandwidth" or "arithmetic", the larger share; limit_share: that share.
        memory_per_unknown: bytes of the whole simulation with the default solver and this operator.
        setup_s: s to make model and simulation.
    """

    problem: str
    dtype: str
    operator: str
    chosen: bool
    unknowns: int
    elements: int
    ms: float
    unknowns_per_s: float
    bytes_per_unknown: float
    flops_per_unknown: float
    GBps: float
    copy_GBps: float
    bandwidth_share: float
    Gflops: float
    peak_Gflops: float | None
    arithmetic_share: float | None
    limit: str | None
    limit_share: float | None
    memory_per_unknown: float
    setup_s: float


def peak(device: Any, dtype: str) -> float | None:
    """Operations per second of a device, 1e9; None where it is not known."""
    if device.is_cuda:
        for name, both in PEAKS.items():
            if name in device.name:
                return 1e3 * both[dtype == "float32"]
    return None


def prepare(model: Model, operator: str) -> tuple[Simulation, Residual]:
    """A simulation whose operator stands at a slightly deformed state."""
    sim = Simulation(model, dt=DT, solver=solver(None, operator=operator), ledger=False, capture=False)
    w, residual = sim.stepper.work, sim.stepper.newton.residual
    elements = len(np.concatenate([body.mesh.cells for body in model.bodies]))
    length = (model.lumped_host.sum() / DENSITY / elements) ** (1.0 / 3.0)
    scale = DISPLACEMENT * np.where(model.is_position_host > 0.0, length, 1.0)
    _assign(model, w.u, scale[:, None] * _random(model, 1))
    w.step.dq_dv.fill_(DT)
    w.step.mass_factor.fill_(1.0 / DT)
    residual.take(wp.ones(model.worlds, dtype=wp.int32, device=model.device))
    return sim, residual


def _random(model: Model, seed: int) -> np.ndarray:
    """(slots, 3) numbers, 0 where a component is prescribed."""
    return np.random.default_rng(seed).standard_normal((model.slots, 3)) * model.free_host


def _assign(model: Model, field: wp.array, values: np.ndarray) -> None:
    field.assign(np.tile(values, (model.worlds, 1, 1)).astype(model.dtype))


def apply(model: Model, residual: Residual) -> tuple[Callable[[], None], wp.array, wp.array]:
    """The product as a call, its direction and its result; it has been done once."""
    direction, out = (wp.zeros((model.worlds, model.slots), dtype=model.types.vec3, device=model.device) for _ in "po")
    _assign(model, direction, _random(model, 2))
    active = wp.ones(model.worlds, dtype=wp.int32, device=model.device)

    def call() -> None:
        residual.product(direction, out, active)

    call()
    return call, direction, out


def seconds(call: Callable[[], None], device: Any, repeat: int) -> float:
    """Of one call: the median over `repeat` runs of several."""
    count = PRODUCTS["cuda" if device.is_cuda else "cpu"]
    if device.is_cuda:
        with wp.ScopedCapture(device=device) as capture:
            for _ in range(count):
                call()
        first, last = (wp.Event(device, enable_timing=True) for _ in range(2))
    times = []
    for _ in range(1 + repeat):
        if device.is_cuda:
            device.stream.record_event(first)
            wp.capture_launch(capture.graph)
            device.stream.record_event(last)
            times.append(1e-3 * wp.get_event_elapsed_time(first, last))
        else:
            began = clock.perf_counter()
            for _ in range(count):
                call()
            times.append(clock.perf_counter() - began)
    return statistics.median(times[1:]) / count


def measure(model: Model, problem: str, operator: str, *, setup: float, repeat: int, copy: float) -> ProductRow:
    """The row of an operator ("auto": what the solver takes); `setup` s made the model, a copy moves `copy` GB/s."""
    began = clock.perf_counter()
    sim, residual = prepare(model, operator)
    setup += clock.perf_counter() - began
    call, _, _ = apply(model, residual)
    took = seconds(call, model.device, repeat)
    counted, info = cost(residual), model.info()
    unknowns = info["unknowns"]
    GBps, Gflops = 1e-9 * counted.bytes / took, 1e-9 * counted.flops / took
    top = peak(model.device, model.dtype)
    shares = {} if top is None else {"bandwidth": GBps / copy, "arithmetic": Gflops / top}
    limit = max(shares, key=lambda name: shares[name]) if shares else None
    return ProductRow(
        problem=problem,
        dtype=model.dtype,
        operator="matrix" if residual.by_matrix else "elements",
        chosen=operator == "auto",
        unknowns=unknowns,
        elements=info["elements"],
        ms=1e3 * took,
        unknowns_per_s=unknowns / took,
        bytes_per_unknown=counted.bytes / unknowns,
        flops_per_unknown=counted.flops / unknowns,
        GBps=GBps,
        copy_GBps=copy,
        bandwidth_share=GBps / copy,
        Gflops=Gflops,
        peak_Gflops=top,
        arithmetic_share=shares.get("arithmetic"),
        limit=limit,
        limit_share=shares[limit] if limit else None,
        memory_per_unknown=sum(sim.bytes().values()) / unknowns,
        setup_s=setup,
    )


def product(options: argparse.Namespace) -> None:
    """Do `warpfea bench --product`: a line per row, and the file after each."""
    problems = [PROBLEMS[name] for name in options.problem or PROBLEM_SIZES]
    check_sizes(problems, options.unknowns)
    device = find_device(options.device)
    repeat, dtypes = options.repeat or REPEAT, options.dtype or ["float64", "float32"]
    sizes = {p.name: options.unknowns or [PROBLEM_SIZES.get(p.name, 1_000_000)] for p in problems}
    settings = {
        "problems": sizes,
        "dtypes": dtypes,
        "dt": DT,
        "displacement": DISPLACEMENT,
        "products": PRODUCTS["cuda" if device.is_cuda else "cpu"],
        "repeat": repeat,
    }
    copy = copy_bandwidth(device)
    rows: list[ProductRow] = []
    print(HEADER, flush=True)
    for problem in problems:
        for wanted, dtype in itertools.product(sizes[problem.name], dtypes):
            began = clock.perf_counter()
            model = problem.build(problem.size_for(wanted)).finalize(device=device, dtype=dtype)
            setup = clock.perf_counter() - began
            operators = ["auto"]
            while operators:
                operator = operators.pop()
                rows.append(measure(model, problem.name, operator, setup=setup, repeat=repeat, copy=copy))
                gc.collect()  # a simulation refers to itself: its memory is wanted for the next
                print(_line(rows[-1]), flush=True)
                write(options, settings, rows)
                if rows[-1].chosen and problem.name != "bar":
                    operators.append("elements" if rows[-1].operator == "matrix" else "matrix")
            del model
            gc.collect()
    write(options, settings, rows)


HEADER = (
    f"{'problem':7} {'dtype':8} {'operator':8} {'unknowns':>8} {'elements':>8} {'ms':>8} {'1e9 unknowns/s':>14} "
    f"{'B/unknown':>9} {'flop/unk.':>9} {'GB/s':>6} {'of copy':>7} {'Gflop/s':>7} {'of peak':>7} {'limit':>10} "
    f"{'share':>5} {'memory, B/unk.':>14} {'set-up, s':>9}"
)


def _line(r: ProductRow) -> str:
    def share(value: float | None) -> str:
        return "-" if value is None else f"{value:.0%}"

    return (
        f"{r.problem:7} {r.dtype:8} {r.operator + '*' * r.chosen:9}{r.unknowns:8d} {r.elements:8d} {r.ms:8.3f} "
        f"{1e-9 * r.unknowns_per_s:14.3f} {r.bytes_per_unknown:9.0f} {r.flops_per_unknown:9.0f} {r.GBps:6.0f} "
        f"{share(r.bandwidth_share):>7} {r.Gflops:7.0f} {share(r.arithmetic_share):>7} {r.limit or '-':>10} "
        f"{share(r.limit_share):>5} {r.memory_per_unknown:14.0f} {r.setup_s:9.1f}"
    )
