"""`warpfea sweep`: a study in TOML."""

import argparse

from ..base.console import format_table
from ..sweeps import SweepResult, run_study
from . import DONE, NOT_CONVERGED
from .source import show_progress

__all__ = ["sweep"]

SHOWN_FAILURES = 5
"""Number of failed designs listed of more."""


def sweep(options: argparse.Namespace) -> int:
    """Run `warpfea sweep`; 3 if a design failed."""
    chosen = {name: getattr(options, name) for name in ("scheduler", "workers", "device", "out", "resume")}
    result = run_study(options.file, progress=show_progress(options), **chosen)
    if not options.quiet:
        print(summary(result), flush=True)
    return NOT_CONVERGED if result.failures else DONE


def summary(result: SweepResult) -> str:
    """The result as a table: numbers, extremes of the measures, failures."""
    failed = list(result.failures.items())
    rows = [["designs", f"{len(result)}, {len(failed)} failed, {result.retries} tasks lost and done again"]]
    rows.append(["time", f"{result.seconds['run']:.1f} s, start of the workers {result.seconds['start']:.1f} s"])
    if len(failed) < len(result):
        for name in result.measures:
            low, high = result.best(name), result.best(name, largest=True)
            rows.append([name, f"{low[name]:.6g} (design {low['design']}) to {high[name]:.6g} ({high['design']})"])
    rows += [[f"design {index}", reason] for index, reason in failed[:SHOWN_FAILURES]]
    if len(failed) > SHOWN_FAILURES:
        rows.append(["", f"and {len(failed) - SHOWN_FAILURES} more in the table"])
    return format_table([*rows, ["wrote", f"{result.folder / 'table.csv'}"]])
