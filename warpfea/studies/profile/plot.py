"""Picture of a profile: time per step of each part, and its bandwidth over that of a copy."""

import pathlib

from ...base.lazy import require_matplotlib
from .profiling import Profile

__all__ = ["BETWEEN_KERNELS", "draw"]

BETWEEN_KERNELS = "between kernels"
COLORS = {  # colour-blind-safe set (Okabe and Ito), greys for parts without arithmetic
    "residual": "#e69f00",
    "product": "#0072b2",
    "assembly": "#004c7a",
    "preconditioner": "#009e73",
    "build": "#56b4e9",
    "vectors": "#cc79a7",
    "constraints": "#d55e00",
    "loads": "#f0e442",
    "control": "#777777",
    "commit": "#999999",
    BETWEEN_KERNELS: "#cccccc",
}
OTHER_COLOR = "#882255"
"""Parts of terms not listed."""


def draw(found: Profile, title: str, path: pathlib.Path) -> None:
    """Write the picture as PNG. OutputError without matplotlib."""
    parts = found.parts
    names = sorted(parts, key=lambda name: -parts[name].ms)
    times = [parts[name].ms for name in names] + [found.between_ms]
    rates = [parts[name].GBps for name in names]
    shares = [100.0 * (rate or 0.0) / found.copy_GBps for rate in rates]
    figure = require_matplotlib()(figsize=(11.0, 1.9 + 0.36 * len(times)), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    figure.suptitle(title, fontsize=11)
    colors = [COLORS.get(name, OTHER_COLOR) for name in (*names, BETWEEN_KERNELS)]
    rows = range(len(times))
    bars = left.barh(rows, times, color=colors)
    left.bar_label(bars, [_time_text(t, found.total_ms) for t in times], padding=4, fontsize=9)
    left.set_yticks(rows, [*names, BETWEEN_KERNELS])
    left.invert_yaxis()
    left.set_xlim(0.0, 1.3 * max(times))
    left.set_xlabel("time per step, ms")
    bars = right.barh(range(len(names)), shares, color=colors[: len(names)])
    right.bar_label(bars, ["-" if r is None else f"{r:.3g} GB/s" for r in rates], padding=4, fontsize=9)
    right.axvline(100.0, color="0.3", linestyle=":", linewidth=1.2)
    right.set_xlim(0.0, 1.3 * max([*shares, 100.0]))
    right.set_xlabel(f"bytes of its arrays / time, % of a copy ({found.copy_GBps:.3g} GB/s)")
    for axes in (left, right):
        axes.grid(True, axis="x", color="0.88", linewidth=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, format="png", dpi=110)


def _time_text(ms: float, total: float) -> str:
    """Text at a bar."""
    share = 100.0 * ms / total
    if ms == 0.0:
        return "too short to tell"
    return f"{ms:.3g} ms, {share:.0f} %" if share >= 1.0 else f"{ms:.3g} ms, < 1 %"
