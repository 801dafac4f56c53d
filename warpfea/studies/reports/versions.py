"""`warpfea study versions`: `warpfea bench` of two checkouts, alternated, so that a machine's drift falls on both.

A row of the result has the ms per step of every run, both medians and their ratio. Iterations must be the same.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import shlex
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from typing import Any

from ...base.errors import UsageError
from .parts import Rows, check_out, run_tables

__all__ = ["merge", "run"]

HERE = pathlib.Path(__file__).resolve().parents[3]
COUNTS = ("newton_per_step", "pcg_per_step")


def bench(checkout: pathlib.Path, words: list[str], out: pathlib.Path) -> dict[str, Any]:
    """One `warpfea bench` with the package of a checkout. UsageError where it fails."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(checkout), os.environ.get("PYTHONPATH", "")])}
    if checkout != HERE:
        env.pop("WARPFEA_COMMIT", None)  # that of this version
    command = [sys.executable, "-m", "warpfea", "bench", *words, "--out", str(out)]
    done = subprocess.run(command, env=env, cwd=checkout, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UsageError(f"{checkout}: warpfea bench {shlex.join(words)} ended with {done.stderr.strip()[-400:]}")
    found: dict[str, Any] = json.loads(out.read_text())
    return found


def key(row: dict[str, Any]) -> tuple[str, ...]:
    """What tells rows of a bench apart."""
    return tuple(str(row[name]) for name in ("label", "problem", "solver", "dtype", "unknowns") if name in row)


def merge(before: list[Rows], now: list[Rows]) -> Iterator[dict[str, Any]]:
    """A row for each that both versions have: ms per step of all runs, medians, their ratio, iterations of both."""
    old, new = ([{key(row): row for row in rows} for rows in runs] for runs in (before, now))
    for name, first in old[0].items():
        if any(name not in rows or rows[name].get("ms_per_step") is None for rows in (*old, *new)):
            continue
        times = [[rows[name]["ms_per_step"] for rows in runs] for runs in (old, new)]
        medians = [statistics.median(values) for values in times]
        row = {"label": " ".join(dict.fromkeys(name)), "before_ms": times[0], "now_ms": times[1]}
        row |= {"before": medians[0], "now": medians[1], "ratio": medians[1] / medians[0]}
        for count in COUNTS:
            if count in first:
                row[count] = [first[count], new[0][name].get(count)]
        yield row


def run(options: argparse.Namespace) -> None:
    """Do `warpfea study versions`."""
    check_out(options)
    checkout = pathlib.Path(options.before or "").resolve()
    if not options.before or not (checkout / "warpfea").is_dir():
        raise UsageError("--before: name the checkout of the version that this one is compared with")
    words = shlex.split(options.bench)
    options.device = words[words.index("--device") + 1] if "--device" in words else "cpu"
    runs: dict[pathlib.Path, list[Rows]] = {checkout: [], HERE: []}
    commits: dict[str, Any] = {}
    settings: Any = None
    with tempfile.TemporaryDirectory() as folder:
        for k in range(options.repeat):
            for where, which in ((checkout, "before"), (HERE, "now")):
                found = bench(where, words, pathlib.Path(folder) / "bench.json")
                runs[where].append(found["rows"])
                commits[which], settings = found.get("commit"), found.get("settings")
                print(f"round {k + 1} of {options.repeat}: {which} done", flush=True)
    about = {"bench": options.bench, "rounds": options.repeat, "of a bench": settings, "commits": commits}
    run_tables(options, {"rows": lambda: merge(runs[checkout], runs[HERE])}, about)
