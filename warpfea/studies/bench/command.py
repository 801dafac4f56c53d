"""`warpfea bench`: time and error of the solver on the problems of problems.py.

Sizes are numbers of unknowns, met as closely as the problem allows. The error of the tip is measured against the same
mesh and steps with a tolerance 100 times tighter in float64, over the largest tip displacement of the reference.
The other kinds of measurement are in files of their own: peer.py, growth.py, product.py, cpu.py, scenes.py,
contact.py, price.py, pairs.py, worlds.py.
"""

from __future__ import annotations

import argparse
import pathlib
from typing import Any

from ...base.console import quiet_warp
from ...base.errors import UsageError
from ...base.writer import check_target
from .contact import contact
from .cpu import cpu
from .growth import growth
from .measure import TIGHTER, WARM_UP, Row, check_sizes, measure, write
from .pairs import pairs
from .peer import peer
from .price import price
from .problems import PROBLEMS
from .product import product
from .scenes import scenes
from .worlds import worlds

__all__ = ["OPTIONS", "bench", "table"]

OPTIONS = {
    "table": {"problem", "unknowns", "dtype", "linear", "steps", "repeat", "dt", "tol", "reference_up_to"},
    "peer": {"rows", "large", "meshes", "dtype", "steps"},
    "growth": {"problem", "unknowns"},
    "product": {"problem", "unknowns", "dtype", "repeat"},
    "cpu": {"rows", "steps", "limit"},
    "scenes": {"rows", "before"},
    "contact": {"unknowns", "dtype", "steps", "repeat", "tol"},
    "price": {"rows", "steps", "repeat"},
    "pairs": {"rows", "dtype", "steps"},
    "worlds": {"rows", "dtype"},
}
"""Options of each kind of measurement, besides those of all."""


def bench(options: argparse.Namespace) -> None:
    """Do `warpfea bench`. UsageError for options that do not go together, OutputError for an --out in no folder."""
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
    do = {
        "table": table, "peer": peer, "growth": growth, "product": product, "cpu": cpu, "scenes": scenes,
        "contact": contact, "price": price, "pairs": pairs, "worlds": worlds,
    }  # fmt: skip
    with quiet_warp():
        do[kind](options)


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
