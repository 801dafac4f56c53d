"""Options of the measuring commands: bench, study, sweep, stress, profile."""

import argparse
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

from ..base.errors import UsageError
from ..base.names import did_you_mean
from .arguments import (
    Kind,
    Parser,
    add_options,
    finish_command,
    positive_integer,
    positive_integers,
    positive_number,
)

__all__ = ["add_bench", "add_profile", "add_stress", "add_study", "add_sweep", "insert_scene_command"]

PROFILE_EXAMPLES = """\
examples:
  warpfea profile hook                                  where the time of a step goes
  warpfea profile cantilever --set cells=200 --device cuda:0 --png p.png --json p.json
  warpfea profile my_scenes.py:swing --steps 50 --dtype float32
  warpfea profile part.msh --material svk:E=7e8,nu=0.33,density=2700 --clamp base

parts:
@PARTS@

how to read it:
  A step runs as one recorded graph: its time is that of the graph. The same steps are then done again from the same
  state, launch by launch, each timed alone (on a GPU by events around the kernel, on the CPU by the clock), less the
  time of an empty launch. "between" is what a step takes beyond its kernels; a large share means that the problem is
  too small for the device. On the CPU kernels timed alone take somewhat longer, since caches cool down in between.

  MB are the bytes of the arrays that a launch can reach through its arguments, each array counted once, and GB/s those
  bytes over the time. That is an estimate of the traffic: it is too high for a kernel that touches an array in part
  and too low for one that reads it several times; small problems stay in the caches, and come out above the rate of a
  copy. Where "of copy" is near 100 % for arrays much larger than the caches, memory is the limit; where it is low,
  arithmetic, scattered access or the launch itself is.
"""

STRESS_EXAMPLES = """\
examples:
  warpfea stress --quick                                the fast rows, in both precisions
  warpfea stress --list                                 what there is
  warpfea stress --case elastica --dtype float32        all rows of a case
  warpfea stress --case elastica/1000                   one row
  warpfea stress --json stress.json --resume            all of it; after Ctrl-C the same words go on

outcomes:
  done      the step or equilibrium was accepted, and is right: error within bound, iterations within theirs
  refused   it was refused with an error that names why, where the case allows that
  FAILED    an answer that is wrong, a refusal where an answer is due or for another reason, or another error
  no mesh   it needs a file of --meshes; it counts neither way
Seconds include the compilation of kernels that are not in Warp's cache.

exit codes: 0 every row met its criterion, 3 one did not, 2 bad usage, 130 interrupted (the file is valid)
"""

SWEEP_EXAMPLES = """\
examples:
  warpfea sweep study.toml                              a process per GPU, or per core
  warpfea sweep study.toml --resume                     go on after Ctrl-C, a crash, or a reboot
  warpfea sweep study.toml --scheduler tcp://host:8786  the workers of a dask scheduler

study.toml:
  scene = "cantilever"                                  or file.py:NAME, from the file's folder, as are all paths
  out = "stiffness"                                     record.jsonl, table.csv, times.csv, pictures

  [design]
  kind = "grid"                                         list (file = "designs.csv"), random, lhs, sobol (count, seed)
  [design.over]
  cells = [4, 8]                                        a parameter of the scene: another model
  bar.E = {low = 1e8, high = 1e10, count = 10, log = true}   per world, as Model.set_parameter; gravity.z,
                                                        velocity.BODY.x, control.NAME
  [measures]
  tip = "min probe.tip.displacement.z"                  also contact.NAME.normal_force, joint.NAME.force.norm,
  stress = "field.von_mises"                            energy.strain, or a function of the simulation, file.py:NAME

  further tables: [parameters] of the scene for all designs; [series] quantities kept for every step;
  [run] t_end, dt, integrator, tol, dtype, device, static, ...; [engine] workers, worlds, memory, scheduler;
  [pictures] table = "table.png", pareto = ["tip", "mass"], sheet = "sheet.png", designs = [0, 5], field = "von_mises"

exit codes: 0 every design has a result, 3 one failed, 2 bad usage, 130 interrupted (go on with --resume)
"""

SCENE_COMMAND = "SCENE"
"""Placeholder for a study's name, inserted before the name of a scene."""

SCENE_STUDY_EXAMPLES = """\
examples:
  warpfea study cantilever --over dt=1e-2,5e-3,2.5e-3 --methods backward_euler,bdf2 --out results
  warpfea study cantilever --over cells=4,8,16 --over element=T4,T10 --target 1e-3
  warpfea study pendulum --over dt=5e-3,2.5e-3 --over dtype=float64,float32 --over tol=1e-4,1e-6,1e-8
  warpfea study my_scene.py --over solver=newton-pcg,jacobi,direct --over device=cpu,cuda:0 --repeat 5
  warpfea study my_scene.py:swing --over dt=1e-3,5e-4 --reference tip.csv --probe tip

what is swept:
  --over NAME=V1,V2,... for dt, tol, solver, dtype, device, and every parameter of the scene; --methods for integrators;
  --error for steps that adapt. All combinations are run. Parameters that are whole numbers named cells, elements or
  across refine the mesh (--mesh names others); names and switches, such as an element, are choices for the same
  problem; other parameters change the problem, and each of their values has its own reference. 6x2x1 is a tuple.

what errors are measured against, by the first of these that is there:
  --reference FILE  .csv with the columns t,x,y,z (and probe), or .json {"t": [...], "probes": {"tip": [[x,y,z], ...]},
                    "about": "...", "error": metres}
  the scene's own   @wf.scene(dt=..., t_end=..., reference={"tip": f}) with f(t) -> positions (n, 3) at times t (n,)
  a finer run       an eighth of the smallest step, twice the finest of a swept mesh (--finer chooses), whose own error
                    is estimated from coarser ones. --reference run takes it in any case.
  Errors below ten times that of the reference are marked: "not resolved".

how to read it:
  Errors are of the probes' positions over their largest travel: the root of the mean square over time (l2), and at the
  end. energy is the drift of the balance over the largest energy exchanged. "s" is the median time of all steps, with
  compilation and set-up apart; digits are -log10(error x s); Pareto marks rows that no other beats in both. Parts of
  the error (space, time, algebra, rounding) are differences to a run that is finer in one of them;
  space is in the rows' errors only where the mesh is swept, or they are against a closed form or a file of the true
  motion; otherwise errors are in time, space is told beside them, and --target is for the sum. --split none estimates
  no space: the target is one in time then.
  steps of runs that adapt are those that were accepted; in the CSV their "asked error" stands beside "error".

With --out a study that was stopped by Ctrl-C goes on where it was: the same command again runs what is missing, and the
run that was under way. The reference is run first, and may take longer than all rows.
exit codes: 0 done, 3 nothing reaches --target or the reference was refused, 2 bad usage, 130 interrupted
"""


def add_bench(commands: Any) -> None:
    """`warpfea bench`."""
    to = commands.add_parser(
        "bench",
        help="time and error of the solver on a bar, a beam or a plate",
        description="ms per step, PCG iterations, bytes per unknown, residual and tip error of bodies (SVK, "
        "E = 7e8 Pa, nu = 0.33, 2700 kg/m^3) that are clamped at x = 0 and loaded at the other end. bar: T10, "
        "3 x 2 x 1 m, 5000 N along x. beam: 3243, elements of 0.5 x 0.1 x 0.1 m, 3100 N across. plate: 3443, "
        "4 x 2 x 0.1 m, 1000 N down. ENMC, FN18, H3843: the bar of ANCF solids.",
        epilog="examples:\n  warpfea bench --problem plate --unknowns 1e4,1e5\n"
        "  warpfea bench --linear pcg --linear direct --device cpu --out bench.json\n"
        "  warpfea bench --peer --large --out peer.json\n  warpfea bench --peer --rows 'beam-*,bar-3x2x1'\n"
        "  warpfea bench --worlds --rows 'finger-*,pendulum-auto-64' --dtype float32\n\n"
        "how to read it:\n  residual is relative, tip error is of the tip over its travel, against a much tighter "
        "solve of the same steps.\n  set-up is the model, compile what a simulation takes before its first step.\n\n"
        "The measurements behind the tables of tests/results: python -m tests.validation --list, in a checkout.",
    )
    kind = to.add_mutually_exclusive_group()
    kind.add_argument("--peer", action="store_true", help="120 steps to 5e-4 N on the peer's sizes, beside its times")
    kind.add_argument("--worlds", action="store_true", help="many worlds of small models: error beside run time")
    add_options(
        to,
        ("--problem", Kind.APPEND, ("bar", "beam", "plate", "ENMC", "FN18", "H3843"), "repeatable; default bar", None),
        ("--unknowns --sizes", positive_integers, "N,N,...", "sizes (default: a few per problem)", []),
        ("--device", None, None, "cpu, cuda:0, ...; by default CUDA where there is one"),
        ("--dtype", Kind.APPEND, ("float64", "float32"), "may be repeated; default both, of --peer float64", None),
        ("--linear", Kind.APPEND, ("pcg", "direct"), "linear solver, may be repeated; default pcg", None),
        ("--steps", positive_integer, "N", "steps to simulate (default 10, --peer 120)"),
        ("--repeat", positive_integer, "N", "runs; the median counts (default 3)"),
        ("--dt", positive_number, "S", "step, s (default 1e-3)"),
        ("--tol", positive_number, "X", "relative residual at which a step is accepted"),
        ("--reference-up-to", positive_integers, "N", "largest size that gets a reference with 100 times tighter "
         "tolerance (default 100000)"),
    )  # fmt: skip
    add_options(
        to.add_argument_group("with --peer or --worlds"),
        ("--rows", None, "LABEL,...", "rows by label, with * for any text (default: all)"),
        ("--large", Kind.FLAG, None, "--peer: a bar of 4 million unknowns too, ten steps"),
        ("--meshes", None, "FOLDER", "--peer: unstructured meshes (default: tests/data of the checkout)"),
    )
    add_options(to, ("--out", None, "FILE", "JSON with command, machine, settings and rows"))
    finish_command(to, "..studies.bench.command", "bench", "no bars; the table is what it is for")


STUDIES = ("identify",)
"""Studies other than those of scenes; executed by `run` of their module, see cli/study.py."""


def add_study(commands: Any) -> None:
    """`warpfea study`: scenes and `STUDIES`."""
    to = commands.add_parser(
        "study",
        help="error against run time of a scene",
        description="Measure error against run time of a scene or a file of your own (warpfea study SCENE --help).",
        epilog="examples:\n  warpfea study cantilever --over dt=1e-2,5e-3 --methods backward_euler,bdf2 --target 1e-2\n"
        "  warpfea study my_scene.py --help\n  warpfea study identify --quick\n\n"
        "The measurements behind the files of tests/results: python -m tests.validation --list, in a checkout.",
    )
    names = to.add_subparsers(title="studies", metavar="STUDY", dest="study", required=True, parser_class=Parser)
    _add_scene_study(names)
    one = names.add_parser(
        "identify",
        help="stiffness and damping from a recorded, noisy motion, over many worlds",
        description="A finger of rubber is let go under gravity; scipy's differential evolution finds E and eta from "
        "the noisy record of its tip, a generation of candidates at a time, each a world of one model. An example of "
        "parameters per world, written for reading. Minutes on two cores.",
        epilog="example:\n  warpfea study identify",
    )
    add_options(
        one,
        ("--device", None, None, "cpu, cuda:0, ..."),
        ("--worlds", positive_integer, "N", "candidates at a time (default 64)"),
        ("--gradients", Kind.FLAG, None, "from a poor start by gradients, with and without noise"),
        ("--quick", Kind.FLAG, None, "a trial: few and small rows, no result"),
        ("--out", None, "PATH", "JSON with command, machine, settings and rows"),
    )
    finish_command(one, ".study", "study", "no bars, no table")


def _add_scene_study(names: Any) -> None:
    """The parser of `warpfea study SCENE`."""
    to = names.add_parser(
        SCENE_COMMAND,
        help="error against run time of a scene, or of file.py[:NAME]: any sweep, with orders and a plot",
        description="Run a scene with every combination of settings, and tell error and run time of each: a table, and "
        "with --out CSV, JSON and a plot. A file of one's own needs a function decorated with @wf.scene, and a probe.",
        epilog=SCENE_STUDY_EXAMPLES,
    )
    to.add_argument("what", metavar=SCENE_COMMAND, help="a scene, file.py or file.py:scene")
    add_options(
        to.add_argument_group("the sweep"),
        ("--over", Kind.APPEND, "NAME=V1,V2", "repeatable"),
        ("--methods", None, "NAME,NAME", "integrators, with options as name(option=value)"),
        ("--error", None, "X,X", "steps that adapt, to each of these errors"),
    )
    add_options(
        to.add_argument_group("for all runs (defaults are the scene's)"),
        ("--set", Kind.APPEND, "NAME=VALUE", "a parameter of the scene"),
        ("--dt", positive_number, "S", "step, s, where it is not swept"),
        ("--t-end", positive_number, "S", "end time, s"),
        ("--tol", positive_number, "X", "relative residual at which a step is accepted"),
        ("--solver", None, "NAME", "newton-pcg (default), jacobi, direct", "newton-pcg"),
        ("--dtype", None, "NAME", "float64 (default) or float32", "float64"),
        ("--device", None, None, "cpu, cuda:0, ...; by default CUDA where there is one"),
    )
    add_options(
        to.add_argument_group("errors"),
        ("--probe", Kind.APPEND, "NAME", "whose error counts; repeatable (default: all)", None),
        ("--reference", None, "FILE", "a file of positions, or run for a finer run"),
        ("--finer", Kind.APPEND, "NAME=VALUE", "of the finer run"),
        ("--mesh", Kind.APPEND, "NAME", "a parameter that refines the mesh; repeatable", None),
        ("--measure", None, "NAME", "error that counts: l2 (default), end, energy, field", "l2"),
        ("--target", positive_number, "X", "name the cheapest setting with at most this error, in time and mesh"),
        ("--split", None, "ROWS", "parts of the error of the best row (default), of all, or none", "best"),
    )
    add_options(
        to,
        ("--repeat", positive_integer, "N", "runs for the times (default 3)", 3),
        ("--limit", positive_number, "S", "s, after which a run is given up"),
        ("--out", Kind.ONCE, "FOLDER", "NAME.csv, .json, .png, and what is needed to go on"),
        ("--name", None, "NAME", "of the files (default: the scene's)"),
    )
    finish_command(to, ".study", "accuracy", "no bars, no table")


def add_stress(commands: Any) -> None:
    """`warpfea stress`."""
    to = commands.add_parser(
        "stress",
        help="stiff and extreme cases, each against a criterion that can fail",
        description="Run stiff and extreme cases: thin and stiff bodies in both precisions, elements about to turn "
        "inside out, very long steps, large rotations, joints. Each answer is held to a closed form or to a reference.",
        epilog=STRESS_EXAMPLES,
    )
    add_options(
        to,
        ("--case", Kind.APPEND, "NAME", "a case, a row NAME/VALUE or a group; repeatable"),
        ("--list", Kind.FLAG, None, "the cases and what each tries; runs nothing"),
        ("--quick", Kind.FLAG, None, "the fast rows only (minutes)"),
        ("--device", None, None, "cpu, cuda:0, ...; by default CUDA where there is one"),
        ("--dtype", ("float64", "float32", "both"), None, "precision (default both)", "both"),
        ("--meshes", None, "FOLDER", "meshes of the soft solids (mat.msh, ...); without: left out"),
        ("--json", Kind.ONCE, "FILE", "rows with all numbers, kept after each; - for stdout"),
        ("--resume", Kind.FLAG, None, "keep the rows that --json holds, of the same commit"),
    )
    finish_command(to, ".study", "stress", "no bars, no table: which rows failed, and the exit code")


def insert_scene_command(words: Sequence[str]) -> list[str]:
    """Words of `warpfea study NAME`, with the placeholder of scenes inserted unless NAME is a study.

    Raises:
        UsageError: NAME is neither a study, a scene nor a file.
    """
    from ..builder.scene import names

    if len(words) < 2 or words[0] != "study" or words[1].startswith("-") or words[1] in (*STUDIES, SCENE_COMMAND):
        return list(words)
    scenes = names()
    if not pathlib.Path(words[1]).suffix and words[1] not in scenes:
        raise UsageError(
            f"study {words[1]!r} is neither a study ({', '.join(STUDIES)}) nor a scene ({', '.join(scenes)}) nor a "
            f"file{did_you_mean(words[1], [*STUDIES, *scenes])}"
        )
    return [words[0], SCENE_COMMAND, *words[1:]]


def add_profile(commands: Any, add_model: Callable[[argparse.ArgumentParser], None]) -> None:
    """`warpfea profile`; `add_model` adds the options of the model."""
    from ..terms.term_set import profile_parts

    parts = "\n".join(f"  {name:14}  {text}" for name, text in profile_parts().items())
    to = commands.add_parser(
        "profile",
        help="where the time of a step goes",
        description="Time per part of a step and per kernel, iterations, launches, bytes, bandwidth beside that of a "
        "copy, compile time.",
        epilog=PROFILE_EXAMPLES.replace("@PARTS@", parts),
    )
    add_model(to)
    add_options(to, ("--steps", positive_integer, "N", "steps that are timed, after 2 (default 10)", 10))
    add_options(
        to.add_argument_group("output (existing files are replaced once the new one is whole)"),
        ("--png", None, "FILE", "picture of the parts (pip install 'warpfea[plots]')"),
        ("--json", None, "FILE", "all numbers, with fixed keys; - for stdout"),
    )
    finish_command(to, ".profile", "profile")


def add_sweep(commands: Any) -> None:
    """`warpfea sweep`."""
    to = commands.add_parser(
        "sweep",
        help="a scene for many designs, over worlds, cores, GPUs and machines",
        description="Run a scene for each design of a study, and derive one table from what was recorded.",
        epilog=SWEEP_EXAMPLES,
    )
    to.add_argument("file", metavar="FILE", help="the study (.toml)")
    add_options(
        to,
        ("--resume", Kind.FLAG, None, "go on with the record that is there"),
        ("--out", Kind.ONCE, "FOLDER", "in place of the study's"),
        ("--workers", positive_integer, "N", "processes"),
        ("--scheduler", None, "ADDRESS", "of dask.distributed, tcp://host:port, on a trusted network"),
        ("--device", None, None, "cpu, cuda (all GPUs) or cuda:0; by default CUDA where there is one"),
    )
    finish_command(to, ".sweep", "sweep")
