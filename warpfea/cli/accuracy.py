"""The options of `warpfea study SCENE`."""

from typing import Any

from .arguments import APPEND, ONCE, add_options, finish_command, positive_integer, positive_number

__all__ = ["SCENE_COMMAND", "add_accuracy"]

SCENE_COMMAND = "SCENE"
"""Placeholder for a study's name, inserted before the name of a scene."""

EXAMPLES = """\
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


def add_accuracy(names: Any) -> None:
    """The parser of `warpfea study SCENE`."""
    to = names.add_parser(
        SCENE_COMMAND,
        help="error against run time of a scene, or of file.py[:NAME]: any sweep, with orders and a plot",
        description="Run a scene with every combination of settings, and tell error and run time of each: a table, and "
        "with --out CSV, JSON and a plot. A file of one's own needs a function decorated with @wf.scene, and a probe.",
        epilog=EXAMPLES,
    )
    to.add_argument("what", metavar=SCENE_COMMAND, help="a scene, file.py or file.py:scene")
    add_options(
        to.add_argument_group("the sweep"),
        ("--over", APPEND, "NAME=V1,V2", "repeatable"),
        ("--methods", None, "NAME,NAME", "integrators, with options as name(option=value)"),
        ("--error", None, "X,X", "steps that adapt, to each of these errors"),
    )
    add_options(
        to.add_argument_group("for all runs (defaults are the scene's)"),
        ("--set", APPEND, "NAME=VALUE", "a parameter of the scene"),
        ("--dt", positive_number, "S", "step, s, where it is not swept"),
        ("--t-end", positive_number, "S", "end time, s"),
        ("--tol", positive_number, "X", "relative residual at which a step is accepted"),
        ("--solver", None, "NAME", "newton-pcg (default), jacobi, direct", "newton-pcg"),
        ("--dtype", None, "NAME", "float64 (default) or float32", "float64"),
        ("--device", None, None, "cpu, cuda:0, ...; by default CUDA where there is one"),
    )
    add_options(
        to.add_argument_group("errors"),
        ("--probe", APPEND, "NAME", "whose error counts; repeatable (default: all)", None),
        ("--reference", None, "FILE", "a file of positions, or run for a finer run"),
        ("--finer", APPEND, "NAME=VALUE", "of the finer run"),
        ("--mesh", APPEND, "NAME", "a parameter that refines the mesh; repeatable", None),
        ("--measure", None, "NAME", "error that counts: l2 (default), end, energy, field", "l2"),
        ("--target", positive_number, "X", "name the cheapest setting with at most this error, in time and mesh"),
        ("--split", None, "ROWS", "parts of the error of the best row (default), of all, or none", "best"),
    )
    add_options(
        to,
        ("--repeat", positive_integer, "N", "runs for the times (default 3)", 3),
        ("--limit", positive_number, "S", "s, after which a run is given up"),
        ("--out", ONCE, "FOLDER", "NAME.csv, .json, .png, and what is needed to go on"),
        ("--name", None, "NAME", "of the files (default: the scene's)"),
    )
    finish_command(to, ".study", "accuracy", "no bars, no table")
