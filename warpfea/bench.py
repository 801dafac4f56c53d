"""`warpfea bench`: time and error of the solver on the problems of `bench_problems`.

Sizes are numbers of unknowns, met as closely as the problem allows. The error of the tip is measured against the same
mesh and steps with a tolerance 100 times tighter in float64, over the largest tip displacement of the reference.
`--peer`, `--growth`, `--product` and `--cpu` are in `bench_peer`, `bench_growth`, `bench_product` and `bench_cpu`.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import math
import os
import pathlib
import platform
import shlex
import statistics
import subprocess
import sys
import time as clock
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import warp as wp

from .bench_problems import PROBLEMS, Problem
from .model import Model
from .simulation import Simulation
from .solvers import NewtonPCG

__all__ = ["Row", "Run", "bench", "check_sizes", "figures", "machine", "measure", "run_once", "solver", "write"]

SCHEMA = 1
WARM_UP = 2
TIGHTER = 100.0
OPTIONS = {
    "table": {"problem", "unknowns", "dtype", "linear", "steps", "repeat", "dt", "tol", "reference_up_to"},
    "peer": {"rows", "large", "meshes", "dtype", "steps"},
    "growth": {"problem", "unknowns"},
    "product": {"problem", "unknowns", "dtype", "repeat"},
    "cpu": {"rows", "steps", "limit"},
}
"""Options of each kind of measurement, besides those of all."""


@dataclass(frozen=True)
class Row:
    """A measurement. Times in ms or s, the tip in m; `tip_error` is None where no reference was made."""

    problem: str
    dtype: str
    linear: str
    unknowns: int
    elements: int
    ms_per_step: float
    newton_per_step: float
    pcg_per_step: float
    bytes_per_unknown: float
    residual: float
    tip: float
    tip_error: float | None
    setup_s: float
    compile_s: float


@dataclass(frozen=True)
class Run:
    """A simulation from rest that has been stepped.

    Attributes:
        sim: the simulation.
        times: s of each step.
        ready_s: s until it could step.
        residual_force: largest |g|_2 over the free components of a step, N.
    """

    sim: Simulation
    times: list[float]
    ready_s: float
    residual_force: float

    def tip(self, axis: int) -> np.ndarray:
        """Displacement of the tip along an axis after each step, m."""
        return self.sim.probe("tip").displacement[0, :, axis]


def solver(tol: float | None, **options: Any) -> NewtonPCG:
    """The solver of all measurements."""
    return NewtonPCG(tol=tol, **({"max_pcg": 20000} | options))


def run_once(model: Model, *, dt: float, steps: int, solver: NewtonPCG, limit: float = math.inf) -> Run:
    """Simulate from rest; the step that brings the time beyond `limit` seconds is the last."""
    began = clock.perf_counter()
    sim = Simulation(model, dt=dt, solver=solver, ledger=False)
    ready = clock.perf_counter() - began
    times: list[float] = []
    largest = 0.0
    for _ in range(steps):
        start = clock.perf_counter()
        report = sim.step()  # reads its report, and so waits for the device
        times.append(clock.perf_counter() - start)
        largest = max(largest, float(report.residual_force.max()))
        if sum(times) > limit:
            break
    return Run(sim, times, ready, largest)


def figures(run: Run, seconds: float) -> dict[str, Any]:
    """The columns that all tables share; `seconds` is what a step takes. Bytes are per free unknown."""
    sim, steps = run.sim, len(run.times)
    info = sim.model.info()
    return {
        "dtype": sim.model.dtype,
        "elements": info["elements"],
        "ms_per_step": 1e3 * seconds,
        "newton_per_step": float(sim.totals["newton"][0]) / steps,
        "pcg_per_step": float(sim.totals["pcg"][0]) / steps,
        "bytes_per_unknown": sum(sim.bytes().values()) / info["unknowns"],
        "residual": float(sim.max_residual),
        "compile_s": run.ready_s,
    }


def measure(
    problem: Problem,
    size: Any,
    dtypes: list[str],
    linear: Sequence[str] = ("pcg",),
    *,
    device: Any,
    steps: int,
    repeat: int,
    dt: float,
    tol: float | None,
    with_reference: bool,
) -> list[Row]:
    """Rows of one mesh, one per precision and linear solver."""
    builder = problem.build(size)
    reference = None
    if with_reference:
        tight = solver(NewtonPCG(tol=tol).tolerance("float64") / TIGHTER)
        reference = run_once(builder.finalize(device=device), dt=dt, steps=steps, solver=tight).tip(problem.axis)
    rows = []
    for dtype, name in itertools.product(dtypes, linear):
        began = clock.perf_counter()
        model = builder.finalize(device=device, dtype=dtype)
        setup = clock.perf_counter() - began
        first = min(WARM_UP, steps - 1)
        how = solver(tol, linear=name)
        run = run_once(model, dt=dt, steps=steps, solver=how)
        times = run.times[first:]
        for _ in range(repeat - 1):
            times += run_once(model, dt=dt, steps=steps, solver=how).times[first:]
        tip = run.tip(problem.axis)
        rows.append(
            Row(
                problem=problem.name,
                linear=name,
                unknowns=model.info()["unknowns"],
                tip=float(tip[-1]),
                tip_error=None if reference is None else float(np.abs(tip - reference).max() / np.abs(reference).max()),
                setup_s=setup,
                **figures(run, statistics.median(times)),
            )
        )
    return rows


def bench(options: argparse.Namespace) -> int:
    """Do `warpfea bench`."""
    from .cli.console import quiet_warp
    from .cli.parser import UsageError
    from .outputs import check_target

    kind = next((name for name in OPTIONS if getattr(options, name, False)), "table")
    for name in sorted(set().union(*OPTIONS.values()) - OPTIONS[kind]):
        if getattr(options, name):
            others = " or ".join(f"--{k}" for k in OPTIONS if name in OPTIONS[k])
            words = f"goes with {others}" if kind == "table" else f"does not go with --{kind}"
            raise UsageError(f"--{name.replace('_', '-')} {words}")
    if options.out is not None:
        if pathlib.Path(options.out).suffix != ".json":
            raise UsageError(f"--out {options.out}: the file name must end in .json")
        check_target(options.out, (".json",))
    from .bench_cpu import cpu
    from .bench_growth import growth
    from .bench_peer import peer
    from .bench_product import product

    with quiet_warp():
        {"table": table, "peer": peer, "growth": growth, "product": product, "cpu": cpu}[kind](options)
    return 0


def table(options: argparse.Namespace) -> None:
    """Time and error in several sizes."""
    problems = [PROBLEMS[name] for name in options.problem or ["bar"]]
    check_sizes(problems, options.unknowns)
    steps = options.steps or 10
    how = {"steps": steps, "repeat": options.repeat or 3, "dt": options.dt or 1e-3, "tol": options.tol}
    settings: dict[str, Any] = {
        "problems": {p.name: list(options.unknowns or p.defaults) for p in problems},
        "dtypes": options.dtype or ["float64", "float32"],
        "linear": options.linear or ["pcg"],
        **how,
        "reference_tolerance_factor": 1.0 / TIGHTER,
        "reference_up_to": max(options.reference_up_to or [100000]),
        "warm_up_steps": min(WARM_UP, steps - 1),
    }
    rows: list[Row] = []
    print(HEADER, flush=True)
    for problem, wanted in ((p, n) for p in problems for n in options.unknowns or p.defaults):
        found = measure(
            problem,
            problem.size_for(wanted),
            settings["dtypes"],
            settings["linear"],
            device=options.device,
            with_reference=wanted <= settings["reference_up_to"],
            **how,
        )
        rows += found
        for row in found:
            print(_line(row), flush=True)
    write(options, settings, rows)


def check_sizes(problems: list[Problem], sizes: list[int]) -> None:
    """Refuse sizes that a problem does not have. UsageError."""
    from .cli.parser import UsageError

    for problem in problems:
        if sizes and min(sizes) < problem.smallest:
            raise UsageError(f"--unknowns {min(sizes)}: the smallest {problem.name} has {problem.smallest}")


def write(options: argparse.Namespace, settings: dict[str, Any], rows: list[Any], **more: Any) -> None:
    """Write rows (dataclasses) with where they come from to --out, if given. OutputError."""
    from .cli.console import write_json

    if options.out is not None:
        content = {
            "schema": SCHEMA,
            "command": shlex.join(["warpfea", *(options.words or ["bench"])]),
            "commit": _commit(),
            "machine": machine(options.device),
            "versions": _versions(),
            "settings": settings,
            **more,
            "rows": [asdict(row) for row in rows],
        }
        write_json(options.out, content)


HEADER = (
    f"{'problem':8} {'dtype':8} {'linear':6} {'unknowns':>9} {'elements':>9} {'ms/step':>10} {'Newton':>7} {'PCG':>7} "
    f"{'B/unknown':>9} {'residual':>9} {'tip, m':>13} {'tip error':>9} {'set-up, s':>9} {'compile, s':>10}"
)


def _line(r: Row) -> str:
    error = "-" if r.tip_error is None else f"{r.tip_error:.1e}"
    return (
        f"{r.problem:8} {r.dtype:8} {r.linear:6} {r.unknowns:9d} {r.elements:9d} {r.ms_per_step:10.2f} "
        f"{r.newton_per_step:7.1f} {r.pcg_per_step:7.0f} {r.bytes_per_unknown:9.0f} {r.residual:9.1e} "
        f"{r.tip:13.6e} {error:>9} {r.setup_s:9.1f} {r.compile_s:10.1f}"
    )


def machine(device: Any) -> dict[str, Any]:
    """The computer: processor, its cores, and the device that was used."""
    used = wp.get_device(device) if device else wp.get_preferred_device()
    out = {"cpu": _cpu_name(), "cores": os.cpu_count(), "system": platform.system(), "device": str(used)}
    if used.is_cuda:
        out |= {"gpu": used.name, "compute_capability": used.arch, "cuda_driver": str(wp.get_cuda_driver_version())}
    return out


def _cpu_name() -> str:
    if sys.platform == "linux":
        for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@functools.cache
def _commit() -> str | None:
    """Commit of the checkout that this runs from, with + if files differ; None without git or outside a checkout.

    Asked once, before results are written into the checkout.
    """
    root = pathlib.Path(__file__).resolve().parent.parent

    def ask(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return ask("rev-parse", "HEAD") + ("+" if ask("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return os.environ.get("WARPFEA_COMMIT")  # a copy without its history is told which commit it is


def _versions() -> dict[str, str]:
    from .cli.summary import versions

    return versions()
