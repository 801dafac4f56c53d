"""`warpfea study precision`: at which error rounding ends the curve of float32, for each family.

The problem `small_body` with BDF2 in float64 and float32, each with the solver's own tolerance, over a range of steps.
`float64` and `float32` are the errors of the tip against a finer float64 run, the root of the mean square over time
over its travel; `least` is the smallest of float32 over the steps.
tests/results/precision_cpu.json is the committed result.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from ..accuracy import StudyOptions, study
from ..checkout import DATA
from ..reports.parts import run_tables

__all__ = ["FAMILIES", "rows", "run"]

FAMILIES = ("T4", "T10", "ENMC", "FN18", "H3843", "3243", "3443")
STEPS = (1e-3, 2.5e-4, 6.25e-5)
QUICK = (4e-3, 2e-3)
END = 0.02
PROBLEM = str(DATA.parent / "validation" / "problems" / "small_body.py")


def rows(device: Any, quick: bool) -> Iterator[dict[str, Any]]:
    """A row per family and step."""
    steps = QUICK if quick else STEPS
    over = {"dtype": ["float64", "float32"], "dt": steps}
    for family in FAMILIES:
        found = study(
            PROBLEM, over=over, parameters={"family": family}, t_end=END, device=device,
            options=StudyOptions(
                repeat=1, split="none", finer={"method": "energy_momentum", "dt": steps[-1] / 2.0}, progress=False
            ),
        )  # fmt: skip
        by = {(r.setting.dtype, r.setting.dt): r for r in found}
        least = min((by["float32", dt].error or float("inf") for dt in steps), default=None)
        for dt in steps:
            double, single = by["float64", dt], by["float32", dt]
            yield {
                "family": family, "unknowns": single.unknowns, "dt": dt, "float64": double.error,
                "float32": single.error, "status": single.status, "least": least, "seconds_float64": double.seconds,
                "seconds_float32": single.seconds, "own_error": single.own_error,
            }  # fmt: skip


def run(options: argparse.Namespace) -> None:
    """Do `warpfea study precision`."""
    options.device = options.device or "cpu"
    settings = {"steps": list(QUICK if options.quick else STEPS), "t_end": END, "integrator": "bdf2"}
    run_tables(options, {"rows": rows}, settings, device=options.device, quick=options.quick)
