"""`warpfea profile`: run time of a step by part and kernel, as a table, JSON and a picture."""

import argparse
import pathlib
import statistics
from typing import Any

from ..base.console import format_number, format_table, progress_bar, quiet_warp, to_json, write_json
from ..base.provenance import machine, versions
from ..base.writer import write_atomically
from ..simulation.simulation import Simulation
from ..studies.profile.profiling import WARM_UP_STEPS, KernelTime, Profile
from ..studies.profile.profiling import profile as measure
from . import DONE
from .run import check_targets
from .source import Source, resolve, show_progress

__all__ = ["JSON_KEYS", "SCHEMA", "profile"]

SCHEMA = 1
JSON_KEYS = (
    "schema", "scene", "parameters", "device", "dtype", "dt", "integrator", "elements", "unknowns", "warm_up", "steps",
    "step_ms", "kernels_ms", "between_ms", "newton_per_step", "pcg_per_step", "launches_per_step", "bytes_per_step",
    "copy_GBps", "empty_launch_us", "compile_s", "parts", "kernels", "machine", "versions",
)  # fmt: skip
STEP_STATISTICS: dict[str, Any] = {"median": statistics.median, "mean": statistics.mean, "min": min, "max": max}
MAX_KERNEL_ROWS = 15
"""Maximum number of kernels listed one by one."""


def profile(options: argparse.Namespace) -> int:
    """Run `warpfea profile SCENE`."""
    check_targets(options)
    if options.png:  # before any work
        from ..base.lazy import require_matplotlib

        require_matplotlib()
    source = resolve(options)
    with quiet_warp():
        show = show_progress(options)
        sim = source.simulation(source.model(), show)
        with progress_bar("profile", "step", WARM_UP_STEPS + 1 + 2 * options.steps, show) as bar:
            found = measure(sim, steps=options.steps, on_step=bar.update)
        content = _content(source, sim, found)
    if options.json:
        write_json(options.json, content)
    if options.png:
        from ..studies.profile.plot import draw

        title = f"{source.label}: {content['unknowns']} unknowns, {content['device']}, {content['dtype']}, "
        title += f"{content['step_ms']['median']:.3g} ms per step"
        write_atomically(pathlib.Path(options.png), lambda path: draw(found, title, path))
    if not options.quiet and options.json != "-":
        print(_profile_text(content, found, [name for name in (options.png, options.json) if name]), flush=True)
    return DONE


def _content(source: Source, sim: Simulation, found: Profile) -> dict[str, Any]:
    """Contents of the JSON."""
    info, device = sim.model.info(), str(sim.model.device)
    content = {
        "schema": SCHEMA, "scene": source.label, "parameters": source.parameters, "device": device,
        "dtype": sim.model.dtype, "dt": sim.dt, "integrator": sim.integrator.label, "elements": info["elements"],
        "unknowns": info["unknowns"], "warm_up": WARM_UP_STEPS, "steps": len(found.step_ms),
        "step_ms": {name: measure(found.step_ms) for name, measure in STEP_STATISTICS.items()},
        "kernels_ms": found.kernels_ms, "between_ms": found.between_ms, "newton_per_step": found.newton,
        "pcg_per_step": found.pcg, "launches_per_step": found.launches,
        "bytes_per_step": sum(k.bytes for k in found.kernels), "copy_GBps": found.copy_GBps,
        "empty_launch_us": found.empty_launch_us, "compile_s": sim.compile_s,
        "parts": {name: _row_content(k, found) for name, k in found.parts.items()},
        "kernels": [{"part": k.part, "kernel": k.kernel} | _row_content(k, found) for k in found.kernels],
        "machine": machine(device), "versions": versions(),
    }  # fmt: skip
    assert tuple(content) == JSON_KEYS
    return {name: to_json(value) for name, value in content.items()}


def _row_content(k: KernelTime, found: Profile) -> dict[str, float | None]:
    """The numbers of a part or a kernel, per step."""
    return {
        "ms": k.ms,
        "share": k.ms / found.total_ms,
        "launches": k.launches,
        "bytes": k.bytes,
        "GBps": k.GBps,
        "copy_share": None if k.GBps is None else k.GBps / found.copy_GBps,
    }


def _profile_text(c: dict[str, Any], found: Profile, wrote: list[str]) -> str:
    """The profile as tables."""
    step, of_step = c["step_ms"], c["step_ms"]["mean"]
    rows = [
        ["scene", f"{c['scene']}: {c['elements']} elements, {c['unknowns']} unknowns"],
        ["device", f"{c['device']}, {c['dtype']}, {c['integrator']}, dt = {format_number(c['dt'])} s"],
        [
            "a step",
            f"{format_number(step['median'])} ms as one graph (median of {c['steps']}, {format_number(step['min'])} to "
            f"{format_number(step['max'])} ms); kernels and set-up before took {c['compile_s']:.1f} s",
        ],
        ["iterations", f"{c['newton_per_step']:.1f} Newton and {c['pcg_per_step']:.0f} PCG per step"],
        [
            "launches",
            f"{c['launches_per_step']:.0f} per step of {len({k.kernel for k in found.kernels})} kernels; an empty one "
            f"takes {format_number(c['empty_launch_us'], 2)} us, which is taken off each",
        ],
        ["copy", f"{format_number(c['copy_GBps'], 3)} GB/s, read and written, for a large array"],
    ]
    parts = [["part", *TABLE_HEADER, ""]]
    parts += [[name, *_cells(k, found), found.about.get(name, "")] for name, k in found.parts.items()]
    gap, share = found.between_ms, 100.0 * found.between_ms / found.total_ms
    cells = [format_number(gap, 3), f"{share:.1f} %"] if gap > 0.0 else ["-", "-"]
    parts.append(["between", *cells, "", "", "", "", BETWEEN_NOTE])
    kernels = [[*TABLE_HEADER, "part", "kernel"]]
    kernels += [[*_cells(k, found), k.part, k.kernel] for k in found.kernels[:MAX_KERNEL_ROWS]]
    lines = [format_table(rows), "", format_table(parts, right=range(1, 7)), "", format_table(kernels, right=range(6))]
    rest = found.kernels[MAX_KERNEL_ROWS:]
    if rest:
        lines.append(
            f"and {len(rest)} more, {format_number(sum(k.ms for k in rest), 2)} ms together (--json lists them)"
        )
    notes = []
    if found.kernels_ms > 1.02 * of_step:
        longer = 100.0 * (found.kernels_ms / of_step - 1.0)
        notes.append(
            f"Timed one by one the kernels took {longer:.0f} % longer than the steps as graphs; shares are of them."
        )
    notes.append("MB are of the arrays that a launch can reach, each once: not its traffic (see --help).")
    lines += ["", *notes]
    lines += [f"wrote {name}" for name in wrote]
    return "\n".join(lines)


BETWEEN_NOTE = "starting of kernels, conditions of loops, reading of the report"
TABLE_HEADER = ("ms/step", "share", "launches", "MB/step", "GB/s", "of copy")


def _cells(k: KernelTime, found: Profile) -> list[str]:
    """The texts under `TABLE_HEADER`."""
    rate = k.GBps
    return [
        format_number(k.ms, 3),
        f"{100.0 * k.ms / found.total_ms:.1f} %",
        f"{k.launches:.0f}" if k.launches >= 10.0 or k.launches % 1.0 == 0.0 else f"{k.launches:.1f}",
        format_number(1e-6 * k.bytes, 3),
        "-" if rate is None else format_number(rate, 3),
        "-" if rate is None else f"{100.0 * rate / found.copy_GBps:.0f} %",
    ]
