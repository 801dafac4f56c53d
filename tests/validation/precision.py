"""Round-off limit of the error in float32, for each family.

The problem `small_body` with BDF2 in float64 and float32, each with the solver's own tolerance, over a range of steps.
`float64` and `float32` are the errors of the tip against a finer float64 run, the root of the mean square over time
over its travel; `least` is the smallest of float32 over the steps.
"""

from __future__ import annotations

from collections.abc import Iterator

from warpfea.studies.accuracy import StudyOptions, study

from .problems.small_body import small_body
from .table import Row, Run, Table

__all__ = ["TABLE"]

FAMILIES = ("T4", "T10", "ENMC", "FN18", "H3843", "3243", "3443")
STEPS = (1e-3, 2.5e-4, 6.25e-5)
QUICK = (4e-3, 2e-3)
END = 0.02


def rows(run: Run) -> Iterator[Row]:
    """A row per family and step."""
    steps = QUICK if run.quick else STEPS
    over = {"dtype": ["float64", "float32"], "dt": steps}
    for family in FAMILIES:
        found = study(
            small_body, over=over, parameters={"family": family}, t_end=END, device=run.device,
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


TABLE = Table(
    about=__doc__,
    parts={"rows": rows},
    results={"precision_cpu.json": "precision --out tests/results/precision_cpu.json"},
    settings={"steps": STEPS, "t_end": END, "integrator": "bdf2"},
)
