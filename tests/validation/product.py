"""The operator H v alone, in unknowns per second, and the limit of the device that binds it.

A product is `Residual.product` with backward Euler's factors for h = 1 ms at a state of small random displacements
(1e-4 of an element), applied to random numbers. "elements": each element does its own part, and slots sum them;
"matrix": the 3x3 blocks assembled at the state. `chosen` marks the one that the solver takes by itself. On CUDA the
products are recorded as one graph and replayed, on the CPU they run in a loop; the median of several counts.

Bytes and operations are counted in product_cost.py: the share of the bandwidth is of what a copy of a large array
reaches here, the share of arithmetic of the device's peak, where it is known. The larger of both is the limit that
binds. Rows:

unknowns            free ones; all figures per unknown are per free unknown
ms                  of a product
bytes_per_unknown, flops_per_unknown    least traffic, and operations
GBps, Gflops        1e9 of them per second
limit, limit_share  "bandwidth" or "arithmetic", the larger share; None, as the shares, where the peak is not known
memory_per_unknown  bytes of the whole simulation with the default solver and this operator
setup_s             s to make model and simulation
"""

from __future__ import annotations

import gc
import itertools
import statistics
import time as clock
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp

from warpfea.base.devices import find_device
from warpfea.model.model import Model
from warpfea.simulation.simulation import Simulation
from warpfea.solvers.residual import Residual
from warpfea.studies.bench.measure import solver
from warpfea.studies.bench.problems import DENSITY, PROBLEMS
from warpfea.studies.bench.sizes import check_sizes
from warpfea.studies.profile.profiling import copy_bandwidth

from .product_cost import cost
from .table import Row, Run, Table

__all__ = ["PEAKS", "TABLE", "apply", "peak", "prepare"]

PROBLEM_SIZES = {"bar": 4_000_000, "beam": 1_000_000, "plate": 1_000_000, "ENMC": 1_000_000, "FN18": 1_000_000}
DT = 1e-3
DISPLACEMENT = 1e-4
PRODUCTS = {"cuda": 20, "cpu": 3}
PEAKS = {"H200": (34.0, 67.0), "H100 80GB HBM3": (34.0, 67.0), "A100": (9.7, 19.5)}
"""1e12 operations per second of float64 and float32 vectors (data sheets), by a part of the GPU's name."""


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


def measure(model: Model, operator: str, *, repeat: int, copy: float) -> Row:
    """The figures of an operator ("auto": what the solver takes); a copy moves `copy` GB/s."""
    began = clock.perf_counter()
    sim, residual = prepare(model, operator)
    setup = clock.perf_counter() - began
    call, _, _ = apply(model, residual)
    took = seconds(call, model.device, repeat)
    counted, unknowns = cost(residual), model.info()["unknowns"]
    GBps, Gflops = 1e-9 * counted.bytes / took, 1e-9 * counted.flops / took
    top = peak(model.device, model.dtype)
    shares = {} if top is None else {"bandwidth": GBps / copy, "arithmetic": Gflops / top}
    limit = max(shares, key=lambda name: shares[name]) if shares else None
    return {
        "operator": "matrix" if residual.by_matrix else "elements",
        "chosen": operator == "auto",
        "unknowns": unknowns,
        "elements": model.info()["elements"],
        "ms": 1e3 * took,
        "unknowns_per_s": unknowns / took,
        "bytes_per_unknown": counted.bytes / unknowns,
        "flops_per_unknown": counted.flops / unknowns,
        "GBps": GBps,
        "copy_GBps": copy,
        "bandwidth_share": GBps / copy,
        "Gflops": Gflops,
        "peak_Gflops": top,
        "arithmetic_share": shares.get("arithmetic"),
        "limit": limit,
        "limit_share": shares[limit] if limit else None,
        "memory_per_unknown": sum(sim.bytes().values()) / unknowns,
        "setup_s": setup,
    }


def rows(run: Run) -> Iterator[Row]:
    """A row per problem, size, precision and operator."""
    device, chosen = find_device(run.device), run.options
    problems = [PROBLEMS[name] for name in chosen["problems"]]
    given = [size for size in chosen["sizes"] if size]  # 0: those of PROBLEM_SIZES
    check_sizes(problems, given)
    copy = copy_bandwidth(device)
    for problem in problems:
        sizes = given or [PROBLEM_SIZES.get(problem.name, 1_000_000)]
        for wanted, dtype in itertools.product(sizes, chosen["dtypes"]):
            began = clock.perf_counter()
            model = problem.build(problem.size_for(wanted)).finalize(device=device, dtype=dtype)
            setup = clock.perf_counter() - began
            operators = ["auto"]
            while operators:
                row: Row = {"problem": problem.name, "dtype": dtype}
                row |= measure(model, operators.pop(), repeat=chosen["repeat"], copy=copy)
                row["setup_s"] += setup
                gc.collect()  # a simulation refers to itself: its memory is wanted for the next
                yield row
                if row["chosen"] and problem.name != "bar":
                    operators.append("elements" if row["operator"] == "matrix" else "matrix")
            del model
            gc.collect()


GIVEN = "product --device cuda:0 --set problems={} --set sizes={} --out tests/results/{}"
FILES = {
    "product_h200.json": ("bar", "4e6"),
    "product_h200_ancf.json": ("beam,plate", "3e5"),
    "product_h200_tets.json": ("ENMC,FN18", "1e5"),
}
TABLE = Table(
    about=__doc__,
    parts={"rows": rows},
    results={file: GIVEN.format(*of, file) for file, of in FILES.items()},
    options={"problems": tuple(PROBLEM_SIZES), "sizes": (0,), "dtypes": ("float64", "float32"), "repeat": 9},
    settings={
        "dt": DT,
        "displacement": DISPLACEMENT, "products": PRODUCTS,
    },
    columns=("problem", "dtype", "operator", "chosen", "unknowns", "ms", "unknowns_per_s", "bytes_per_unknown", "GBps",
             "bandwidth_share", "Gflops", "arithmetic_share", "limit", "memory_per_unknown"),
)  # fmt: skip
