"""`warpfea run`: simulate, write files, summarise."""

import argparse
import pathlib
import shlex
import sys
import time as clock
from collections.abc import Sequence
from typing import Any

from ..base.console import quiet_warp, write_json
from ..base.errors import ConstraintError, ConvergenceError, ModelError, OutputError, StabilityError, UsageError
from ..base.names import did_you_mean
from ..base.writer import Output, check_folder, check_target
from ..kernels.step.step_control import SAME_TIME_FRACTION
from ..model.model import Model
from ..simulation.checkpoint import SUFFIXES as CHECKPOINT_SUFFIXES
from ..simulation.checkpoint import Checkpoint, load_checkpoint, read_meta
from ..simulation.run_loop import interruptible
from ..simulation.simulation import Simulation
from ..simulation.statics import run_static
from ..terms.fields import check_scalar
from . import DONE
from .source import Source, resolve, show_progress
from .summary import summarize, summary_text

__all__ = ["run"]

OUTPUT_SUFFIXES: dict[str, Sequence[str]] = {
    "usd": (".usdc", ".usda", ".usd"),
    "png": (".png",),
    "gif": (".gif",),
    "html": (".html", ".htm"),
    "json": (".json",),
    "checkpoint": CHECKPOINT_SUFFIXES,
}

CHECKPOINT_STEPS = 100
"""Steps between checkpoints."""
ENDS: dict[type[BaseException], str] = {
    StabilityError: "unstable", ConvergenceError: "not converged", ConstraintError: "not converged",
    OutputError: "output failed", KeyboardInterrupt: "interrupted",
}  # fmt: skip
"""Status of a run by the error that ended it; the first that fits."""
STATIC_SPEED = 0.5
"""Load factor per second of an animation of --static."""


def run(options: argparse.Namespace) -> int:
    """Run `warpfea run`."""
    check_targets(options)
    _check_analysis(options)
    _check_output_options(options)
    saved = read_meta(options.resume) if options.resume else None
    began = clock.perf_counter()
    source = resolve(options, saved)
    t_end = options.t_end or source.scene.t_end
    _check_times(options, source, t_end)
    outputs = make_outputs(options, source, t_end)
    before = {file: _file_stamp(file) for file in _output_files(options).values()}
    with quiet_warp():
        model = source.model()
        _check_field(options.field, model)
        sim = source.simulation(model, show_progress(options))
        if options.resume:
            load_checkpoint(sim, options.resume)
            now = float(sim.time.max())
            if now >= t_end - (SAME_TIME_FRACTION * sim.dt if sim.error is None else 0.0):
                raise UsageError(f"{options.resume}: is at t = {now:g} s already, the end is {t_end:g} s; give --t-end")
        setup_s = clock.perf_counter() - began
        status = "failed"
        try:
            if options.static:
                run_static(sim, outputs=outputs, progress=show_progress(options), unstable=options.unstable or "warn")
            else:
                sim.run(t_end, outputs=outputs, progress=show_progress(options))
            status = "done"
        except BaseException as error:
            status = next((text for kind, text in ENDS.items() if isinstance(error, kind)), status)
            raise
        finally:
            with interruptible():  # only the report remains: Ctrl-C must not discard it
                wall_s = clock.perf_counter() - began
                _report_summary(
                    options, sim, summarize(source, sim, status=status, wall_s=wall_s, setup_s=setup_s), before
                )
    return DONE


def _report_summary(
    options: argparse.Namespace, sim: Simulation, summary: dict[str, Any], before: dict[pathlib.Path, Any]
) -> None:
    """Write and print the summary. A failing output here does not hide the error that ended the run.

    `before` are the marks of the outputs before the run.
    """
    if options.json:
        try:
            write_json(options.json, summary)
        except OutputError:
            if summary["status"] == "done":
                raise
    if not options.quiet and options.json != "-":
        print(summary_text(summary, sim, _written_files(options, before)))
        sys.stdout.flush()


def check_targets(options: argparse.Namespace) -> None:
    """Before any work: UsageError for a wrong suffix, OutputError for a missing or read-only folder."""
    for name, suffixes in OUTPUT_SUFFIXES.items():
        value = getattr(options, name, None)
        if value is None or (name == "json" and value == "-"):
            continue
        if pathlib.Path(value).suffix.lower() not in suffixes:
            raise UsageError(f"--{name} {value}: the file name must end in {' or '.join(suffixes)}")
        check_target(value, suffixes)
    if getattr(options, "vtu", None) is not None:
        folder = pathlib.Path(options.vtu)
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"--vtu {folder}: is a file, not a folder")
        check_folder(folder if folder.is_dir() else folder.parent, folder)


STATIC_ONLY = ("load_steps", "stabilise", "unstable")
MOTION_ONLY = ("t_end", "dt", "error", "integrator", "png_time", "checkpoint", "resume")


def _check_analysis(options: argparse.Namespace) -> None:
    """UsageError for options of dynamics with --static, or the reverse."""
    if not options.static:
        for name in STATIC_ONLY:
            if getattr(options, name):
                raise UsageError(f"--{name.replace('_', '-')} is for --static")
        return
    for name in MOTION_ONLY:
        if getattr(options, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} is for a motion; --static finds the equilibrium at full load")
    if options.solver != "newton-pcg":
        raise UsageError(f"--solver {options.solver} is for a motion; --static needs newton-pcg")


OPTION_OUTPUTS = {
    "field": ("pictures", ("png", "gif", "usd", "html")),
    "range": ("pictures", ("png", "gif", "usd", "html")),
    "view": ("pictures", ("png", "gif", "html")),
    "draw": ("pictures", ("png", "gif")),
    "png_time": ("a picture", ("png",)),
    "fps": ("animations", ("usd", "vtu", "html")),
    "speed": ("an animation", ("gif",)),
    "every": ("checkpoints", ("checkpoint",)),
}
"""Purpose of an option, and the outputs of which one must be given."""


def _check_output_options(options: argparse.Namespace) -> None:
    """UsageError for options of missing outputs, and for outputs that can't be extended after --resume."""
    for name, (what, uses) in OPTION_OUTPUTS.items():
        if getattr(options, name) not in (None, []) and not any(getattr(options, use) for use in uses):
            option, outputs = name.replace("_", "-"), " or ".join(f"--{use}" for use in uses)
            raise UsageError(f"--{option} is for {what}: give {outputs} too")
    for name in ("gif", "html"):
        file = getattr(options, name)
        if options.resume and file and pathlib.Path(file).exists():
            raise UsageError(
                f"--{name} {file}: already exists, and can't be extended after --resume: choose another name, or "
                "render the --usd file with warpfea render"
            )


def _check_times(options: argparse.Namespace, source: Source, t_end: float) -> None:
    """UsageError for an end at the start, and for a picture after the end."""
    fixed = not (options.static or options.resume or isinstance(source.dt, str))
    if fixed and t_end <= SAME_TIME_FRACTION * float(source.dt):
        raise UsageError(
            f"--t-end {t_end:g}: less than {SAME_TIME_FRACTION:g} of a step after the start: give a later end time"
        )
    if options.png_time is not None and not 0.0 <= options.png_time <= t_end * (1.0 + 1e-9):
        raise UsageError(f"--png-time {options.png_time:g}: the run lasts from 0 to t = {t_end:g} s")


def _check_field(name: str | None, model: Model) -> None:
    """UsageError unless --field is a scalar field of the model, a component of one, or none."""
    known = [*model.terms.scalar_fields, "none"]
    if name is None or name in known:
        return
    if name.partition(".")[0] not in model.terms.fields:
        raise UsageError(f"--field {name}: is unknown; there are {', '.join(known)}{did_you_mean(name, known)}")
    try:
        check_scalar(model.terms, name)
    except ModelError as error:
        raise UsageError(f"--field: {error}") from None


def make_outputs(options: argparse.Namespace, source: Source, t_end: float) -> list[Output]:
    """The requested writers; their libraries are imported here."""
    out: list[Output] = []
    fps = options.fps or source.scene.fps
    extend = options.resume is not None
    field = None if options.field == "none" else options.field or "von_mises"
    picture_options: dict[str, Any] = {"field": field, "color_range": options.range}
    if options.view:
        picture_options["view"] = options.view
    command = shlex.join(["warpfea", *options.words])
    drawn: dict[str, Any] = dict.fromkeys(options.draw, True)
    if options.static:
        fps = max(fps, 2.0 * (options.load_steps or 10))  # a frame per load step
    if options.usd:
        from ..outputs.usd import USDWriter

        of_run = {"command": command, "seed": source.parameters.get("seed", "none")}
        out.append(
            USDWriter(options.usd, fps=fps, color=field, color_range=options.range, extend=extend, layer_data=of_run)
        )
    if options.vtu:
        from ..outputs.vtk import VTUWriter

        out.append(VTUWriter(options.vtu, fps=fps, extend=extend))
    if options.png:
        from ..outputs.render import PNGWriter

        time = source.scene.picture if options.png_time is None else options.png_time
        if options.static or (time is not None and time > t_end):
            time = None
        out.append(PNGWriter(options.png, time=time, **picture_options, **drawn))
    if options.gif:
        from ..outputs.render import GIFWriter

        speed = options.speed or (STATIC_SPEED if options.static else source.scene.speed)
        out.append(GIFWriter(options.gif, speed=speed, progress=show_progress(options), **picture_options, **drawn))
    if options.html:
        from ..outputs.html import HTMLWriter

        header: dict[str, Any] = {"title": source.label, "parameters": source.parameters}
        header["command"] = command
        header |= {name: value for name, value in picture_options.items() if name != "field"}
        out.append(HTMLWriter(options.html, fps=fps, color=field, **header))
    if options.checkpoint:
        out.append(Checkpoint(options.checkpoint, every=options.every or CHECKPOINT_STEPS))
    return out


def _output_files(options: argparse.Namespace) -> dict[str, pathlib.Path]:
    """File that proves an output was written, by option; of a series its index."""
    names = ("usd", "vtu", "png", "gif", "html", "checkpoint", "json")
    files = {name: pathlib.Path(getattr(options, name)) for name in names if getattr(options, name) not in (None, "-")}
    if "vtu" in files:
        files["vtu"] /= f"{files['vtu'].resolve().name}.pvd"
    return files


def _file_stamp(file: pathlib.Path) -> tuple[int, int] | None:
    """File identity (inode, time, size), or None: detects whether a writer replaced the file."""
    try:
        stat = file.stat()
    except OSError:
        return None
    return stat.st_ino, stat.st_mtime_ns


def _written_files(options: argparse.Namespace, before: dict[pathlib.Path, Any]) -> list[str]:
    """Outputs written by this run, with their properties; `before`: file identities before it."""
    notes: dict[str, Any] = {
        "usd": "validated, for usdview, Blender, Omniverse",
        "vtu": "for ParaView",
        "html": "for any browser",
    }
    texts = []
    for name, file in _output_files(options).items():
        if _file_stamp(file) not in (None, before[file]):
            texts.append(f"{getattr(options, name)}" + (f"  ({notes[name]})" if name in notes else ""))
    return texts
