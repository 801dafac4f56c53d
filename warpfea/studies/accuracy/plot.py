"""The plot of a study: error against run time."""

import math
import pathlib
import textwrap
from typing import Any

from ...base.console import format_number
from ...base.lazy import require_matplotlib
from .measure import DONE, REFUSED
from .motion import RESOLVED_RATIO

__all__ = ["draw"]

COLORS = ("#0072b2", "#d55e00", "#009e73", "#e69f00", "#cc79a7", "#56b4e9", "#000000", "#999999")
"""Colour-blind-safe palette (Okabe and Ito)."""
MARKERS = "osD^vP*X"
MAX_OMISSION_LINES = 6
"""Maximum number of lines that list omitted runs."""
AXIS_LABELS = {
    "l2": "error {} (L2 over time) / largest travel",
    "end": "error {} at the end / largest travel",
    "energy": "drift of energy / largest energy exchanged",
    "field": "error {} of the field / its norm",
}


def draw(study: Any, path: pathlib.Path) -> None:
    """Write the plot as PNG: a curve per method, hollow points for errors not resolved by the reference.

    A ring marks the Pareto front; a cross at the upper edge a failed run, at its run time.
    """
    figure = require_matplotlib()(figsize=(8.4, 6.4), layout="constrained")
    axes = figure.subplots()
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(True, which="major", color="0.85", linewidth=0.8)
    axes.set_axisbelow(True)
    for k, (label, rows) in enumerate(study.curves().items()):
        _draw_curve(axes, label, rows, COLORS[k % len(COLORS)], MARKERS[(k // len(COLORS) + k) % len(MARKERS)])
    front = sorted((r.seconds, r.error) for r in study.rows if r.pareto and r.error)
    if front:
        axes.plot(*zip(*front), color="0.6", linewidth=5.0, alpha=0.35, zorder=1, label="Pareto front")
    _set_limits(axes, study)
    _draw_reference_limit(axes, study)
    if study.target is not None:
        axes.axhline(study.target, color="0.3", linestyle="--", linewidth=1.0, label=f"target {study.target:g}")
    failed = [r for r in study.rows if r.status not in (DONE, REFUSED)]
    if failed:
        at = [r.seconds or axes.get_xlim()[0] for r in failed]
        style = {"color": "#c00000", "marker": "x", "linestyle": "none", "markersize": 9, "markeredgewidth": 2}
        axes.plot(at, [0.97] * len(at), transform=axes.get_xaxis_transform(), label="failed", **style)
    axes.set_xlabel("run time of all steps, median, without compilation and set-up, s")
    axes.set_ylabel(AXIS_LABELS[study.measure].format(study.kind))
    about = textwrap.shorten(study.references[0]["about"], 90) if study.references else ""
    axes.set_title(f"{study.name}, against {about}", fontsize=10, wrap=True)
    axes.legend(fontsize=8)
    lines = study.omissions()
    if len(lines) > MAX_OMISSION_LINES:
        lines = [*lines[: MAX_OMISSION_LINES - 1], f"and {len(lines) - MAX_OMISSION_LINES + 1} more"]
    text = "\n".join(textwrap.fill(f"left out: {line}", 125, max_lines=3) for line in lines)
    figure.supxlabel(text or "nothing left out", fontsize=7, x=0.01, ha="left", color="0.25")
    figure.savefig(path, format="png", dpi=100)


def _draw_curve(axes: Any, label: str, rows: list[Any], color: str, marker: str) -> None:
    rows = [r for r in rows if r.status == DONE and r.error and r.seconds]
    if not rows:
        return
    rows.sort(key=lambda r: r.seconds or 0.0)
    axes.plot([r.seconds for r in rows], [r.error for r in rows], color=color, linewidth=1.4, zorder=2)
    for resolved in (True, False):
        some = [r for r in rows if r.resolved is resolved]
        face = {"markerfacecolor": color if resolved else "white"}
        first = resolved or not any(r.resolved for r in rows)
        axes.plot([r.seconds for r in some], [r.error for r in some], color=color, marker=marker, markersize=6,
                  linestyle="none", zorder=3, label=label if first else None, **face)  # fmt: skip
    ring = [r for r in rows if r.pareto]
    axes.plot([r.seconds for r in ring], [r.error for r in ring], marker="o", markersize=12, linestyle="none",
              markerfacecolor="none", markeredgecolor="0.45", zorder=2)  # fmt: skip


def _draw_reference_limit(axes: Any, study: Any) -> None:
    """Line below which the reference does not resolve errors."""
    own = max((ref["own_error"].get(study.measure, 0.0) for ref in study.references), default=0.0)
    if RESOLVED_RATIO * own > axes.get_ylim()[0]:
        text = f"{RESOLVED_RATIO:g} times the error of the reference ({format_number(own, 2)})"
        axes.axhline(RESOLVED_RATIO * own, color="0.4", linestyle=":", linewidth=1.2, label=text)


def _set_limits(axes: Any, study: Any) -> None:
    """Limits with room for the crosses."""
    errors = [r.error for r in study.rows if r.error]
    if errors:
        low, high = math.floor(math.log10(min(errors)) - 0.1), math.ceil(math.log10(max(errors)) + 0.1)
        axes.set_ylim(10.0**low, 10.0 ** (high + 0.3))
