"""The plot of a study: error against unknowns and against run time, a line of two panels per problem."""

from __future__ import annotations

import math
import pathlib
from typing import Any

from ..plots import require_matplotlib

__all__ = ["draw"]

STYLES = {  # a colour-blind-safe set (Okabe and Ito)
    "T4": ("#000000", "o"),
    "T10": ("#0072b2", "s"),
    "FN": ("#999999", "v"),
    "FN18": ("#e69f00", "^"),
    "ENMC": ("#d55e00", "D"),
    "H3843": ("#009e73", "P"),
}
TITLES = {
    "rigid": "rigid: stiff bar swinging on a hinge",
    "large": "large: soft bar, static",
    "sudden": "sudden: soft bar in motion",
}


def draw(study: Any, path: pathlib.Path) -> None:
    """Write the plot as PNG."""
    problems = list(study.references)
    figure = require_matplotlib()(figsize=(11.0, 3.9 * len(problems) + 0.6), layout="constrained")
    axes = figure.subplots(len(problems), 2, squeeze=False)
    for (left, right), problem in zip(axes, problems):
        _panel(left, study, problem, "unknowns", "free unknowns")
        _panel(right, study, problem, "seconds", "run time without set-up, s")
        right.sharey(left)
        right.tick_params(labelleft=True)
    handles, names = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=len(names), frameon=False)
    figure.savefig(path, format="png", dpi=110)


def _panel(axes: Any, study: Any, problem: str, against: str, label: str) -> None:
    reference = study.references[problem]
    for element in dict.fromkeys(row.element for row in study.rows):
        rows = study.of(problem, element)
        color, marker = STYLES[element]
        x, y = [getattr(r, against) for r in rows], [r.error for r in rows]
        axes.loglog(x, y, color=color, marker=marker, markersize=6, linewidth=1.6, label=element)
    floor, text = reference.get("time_error"), "time error of the steps, left out of the points"
    if floor is None:
        floor, text = reference["own_error"], "uncertainty of the reference"
    axes.axhline(floor, color="0.4", linestyle=":", linewidth=1.2)
    values = [row.error for row in study.rows if row.problem == problem and row.error > 0.0] + [floor]
    low, high = math.floor(math.log10(min(values)) - 0.1), math.ceil(math.log10(max(values)) + 0.1)
    axes.set_ylim(10.0**low, 10.0**high)
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
    axes.annotate(
        text, (0.02, floor), xycoords=("axes fraction", "data"), xytext=(0, 4), textcoords="offset points",
        ha="left", va="bottom", fontsize=8, color="0.3", bbox=box,
    )  # fmt: skip
    axes.set_title(TITLES[problem], fontsize=11)
    axes.set_xlabel(label)
    axes.set_ylabel("tip error / length of the bar")
    axes.grid(True, which="major", color="0.85", linewidth=0.8)
    axes.grid(True, which="minor", color="0.93", linewidth=0.5)
    axes.set_axisbelow(True)
