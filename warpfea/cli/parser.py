"""Options of all commands, and help with examples."""

import argparse
import re
from collections.abc import Sequence
from typing import Any

from ..base.errors import UsageError
from ..base.names import did_you_mean
from ..simulation.statics import UNSTABLE_CHOICES
from ..solvers import SOLVERS
from .arguments import (
    Kind,
    Parser,
    add_options,
    color_range,
    finish_command,
    load_steps,
    number_pair,
    positive_integer,
    positive_number,
    size,
    step_size,
    vector,
)
from .measuring import add_bench, add_profile, add_stress, add_study, add_sweep, insert_scene_command
from .moved import refuse_moved

__all__ = ["parse"]

EXAMPLES = """\
examples:
  warpfea run hook --usd hook.usdc --png hook.png       a scene that comes with warpfea
  warpfea run my_scenes.py:swing --set length=2         a scene of your own
  warpfea run part.msh --material svk:E=7e8,nu=0.33,density=2700 \\
      --clamp base --traction tip:0,0,-1e3              a mesh with named groups
  warpfea scenes hook                                   what can be set in a scene
  warpfea info hook                                     what a scene costs, before running it
  warpfea info part.msh                                 groups and size of a mesh

exit codes: 0 done, 1 a defect of warpfea, 2 bad input or usage, 3 a step was refused or joints were not held,
    4 output failed, 130 interrupted (files are valid)
"""

RUN_EXAMPLES = """\
examples:
  warpfea run cantilever --set E=2e9 --set length=1.5 --t-end 1 --gif bend.gif
  warpfea run twist --device cuda:0 --dtype float32 --usd twist.usdc --json -
  warpfea run part.msh --scale 1e-3 --material svk:E=7e8,nu=0.33,density=2700 --clamp base --pressure top:2e4
  warpfea run part.msh --material arm=svk:E=7e8,nu=0.33,density=2700 \\
      --material pad=neo_hookean:mu=4e5,k=1e7,density=1000 --gravity 0,0,-9.81
  warpfea run part.msh --static --load-steps 5 --material svk:E=7e8,nu=0.33 --gravity 0,0,0 --clamp base \\
      --traction tip:0,0,-1e3 --png part.png --field displacement --range 0,1e-3
  warpfea run hook --checkpoint hook.npz                Ctrl-C at any time, then
  warpfea run hook --checkpoint hook.npz --resume hook.npz     (an animation given by --usd or --vtu goes on)

materials:
  svk:E=,nu=,density=                                   St. Venant-Kirchhoff
  neo_hookean:mu=,k=,density=      or  E=,nu=,density=
  mooney_rivlin:mu10=,mu01=,k=,density=  or  E=,nu=,density=
  density may be left out with --static and --gravity 0,0,0
  with damping: add eta= and lambda_v= (Pa s), and form=incremental, rate or explicit

A scene file is Python:
  import warpfea as wf

  @wf.scene(dt=1e-3, t_end=0.5)
  def swing(*, length: float = 1.0) -> wf.ModelBuilder:
      ...
"""


MATERIAL_HINT = "e.g. svk:E=7e8,nu=0.33,density=2700"


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Parsed arguments, with `command` the function to call. UsageError; SystemExit after --help."""
    from .. import __version__

    top = Parser(
        prog="warpfea",
        description="Flexible multibody dynamics with Total Lagrangian finite elements in NVIDIA Warp.",
        epilog=EXAMPLES,
    )
    top.add_argument("--version", action="version", version=f"warpfea {__version__}")
    commands = top.add_subparsers(title="commands", metavar="COMMAND", parser_class=Parser)
    _add_run(commands)
    _add_scenes(commands)
    _add_info(commands)
    _add_render(commands)
    add_bench(commands)
    add_study(commands)
    add_sweep(commands)
    add_stress(commands)
    add_profile(commands, _add_model_options)
    refuse_moved(words)
    arguments, rest = top.parse_known_args(_join_negative_vectors(insert_scene_command(words)))
    if rest:
        known = commands.choices[words[0]]._option_string_actions if words[0] in commands.choices else ()
        hint = did_you_mean(rest[0].partition("=")[0], known) if rest[0].startswith("-") else ""
        raise UsageError(f"unknown option: {' '.join(rest)}{hint} (see warpfea {words[0]} --help)")
    arguments.words = list(words)
    if not hasattr(arguments, "command"):
        top.print_help()
        names = "run, scenes, info, render, bench, study, sweep, stress, profile"
        raise UsageError(f"give a command: {names} (see {top.prog} --help)")
    return arguments


def _join_negative_vectors(words: Sequence[str]) -> list[str]:
    """`--gravity -1,0,0` as `--gravity=-1,0,0`: argparse treats words that begin with - as options."""
    out: list[str] = []
    for word in words:
        if out and out[-1] in ("--gravity", "--view", "--range") and re.match(r"-[\d.]", word):
            out[-1] += f"={word}"
        else:
            out.append(word)
    return out


def _add_model_options(to: argparse.ArgumentParser) -> None:
    """Model and solver options common to run, info and profile."""
    to.add_argument("what", metavar="SCENE", help="a scene, file.py or file.py:scene, or a mesh (.msh, .vtu, .inp)")
    add_options(to, ("--set", Kind.APPEND, "NAME=VALUE", "set a parameter of the scene"))
    add_options(
        to.add_argument_group("for a mesh file (vectors are x,y,z; repeat an option for several groups)"),
        ("--material", Kind.APPEND, "[GROUP=]LAW:NAME=VALUE,...", MATERIAL_HINT),
        ("--clamp", Kind.APPEND, "GROUP", "hold the nodes of a group"),
        ("--traction", Kind.APPEND, "GROUP:x,y,z", "dead load on a surface, Pa"),
        ("--pressure", Kind.APPEND, "GROUP:p", "follower pressure on a surface, Pa"),
        ("--gravity", vector, "x,y,z", "m/s^2, by default 9.81 downwards"),
        ("--scale", positive_number, "S", "metres per unit of the file, 1e-3 for mm"),
        (
            "--size",
            positive_number,
            "M",
            "mesh a surface (.stl, .obj, .ply) or shape (.step, .iges, .brep, .geo) with edges of this length, m",
        ),
        ("--up-axis", ("Y", "Z"), None, "by default Z"),
        ("--quadrature", None, "RULE", "force rule: tet4, tet5_paper, tet8, tet14 (T10), tet1, tet4 (T4)"),
    )
    add_options(
        to.add_argument_group("simulation (defaults are the scene's)"),
        ("--device", None, None, "cpu, cuda:0, ...; by default CUDA where there is one"),
        ("--dtype", ("float64", "float32"), None, "precision, by default float64"),
        ("--dt", step_size, "S", "step, s; auto: as --error asks for"),
        ("--error", positive_number, "X", "of --dt auto: of positions, over the model's size"),
        ("--integrator", None, "NAME", "backward_euler, bdf2, energy_momentum or generalized_alpha, also with its "
         "option: generalized_alpha(rho_inf=0.5), energy_momentum(rho_inf=0.8)"),
        ("--solver", tuple(SOLVERS), None, "of a step, by default newton-pcg; jacobi: few cheap iterations, what is "
         "left is told; direct: SuperLU", "newton-pcg"),
        ("--tol", positive_number, "X", "relative residual at which a step is accepted"),
        ("--inversion", ("refuse", "report"), None, "a step that turns an element inside out is refused (default), or "
         "passes where the law allows it", "refuse"),
        ("--energy-growth", ("refuse", "warn", "ignore"), None, "energy that the integrator adds: above 1 %% a "
         "warning, above 10 %% refused (default), or not", "refuse"),
    )  # fmt: skip


def _add_run(commands: Any) -> None:
    to = commands.add_parser(
        "run",
        help="simulate a scene or a mesh",
        description="Simulate a scene, your own scene file, or a mesh.",
        epilog=RUN_EXAMPLES,
    )
    _add_model_options(to)
    add_options(
        to,
        ("--t-end", positive_number, "S", "end time, s (default: the scene's)"),
        ("--static", Kind.FLAG, None, "static equilibrium in place of a motion"),
        ("--load-steps", load_steps, "N", "of --static (default 10); auto: the whole load at once, halved where it is "
         "refused"),
        ("--stabilise", Kind.FLAG, None, "of --static: springs that fade with the load, for bodies that contact holds"),
        ("--overlaps", ("warn", "ignore"), None, "bodies that cross each other or a collider without a contact, or "
         "deeper than it sees: a warning (default), or not", "warn"),
        ("--unstable", UNSTABLE_CHOICES, None, "of --static: warn of an unstable equilibrium (default), refuse it, or "
         "do not judge it"),
    )  # fmt: skip
    add_options(
        to.add_argument_group("output (existing files are replaced once the new one is whole)"),
        ("--usd", Kind.ONCE, "FILE", "animation (.usdc, .usda) with stress and displacement; validated"),
        ("--vtu", Kind.ONCE, "FOLDER", "series of .vtu and a .pvd for ParaView"),
        ("--png", Kind.ONCE, "FILE", "picture"),
        ("--png-time", float, "S", "time of the picture"),
        ("--gif", Kind.ONCE, "FILE", "animation"),
        ("--html", Kind.ONCE, "FILE", "page for a browser: turns, plays and cuts the model, with its records"),
        *PICTURE_OPTIONS,
        ("--fps", positive_number, "N", "frames per simulated second of --usd, --vtu and --html"),
        ("--speed", positive_number, "X", "simulated seconds per second of --gif"),
        ("--json", Kind.ONCE, "FILE", "summary of the run; - for stdout"),
        ("--checkpoint", Kind.ONCE, "FILE", "state (.npz), written every --every steps and at the end"),
        ("--every", positive_integer, "N", "steps between checkpoints (default 100)"),
        ("--resume", None, "FILE", "go on from a checkpoint, with its integrator and precision, and without --dt its "
         "dt; a file of --usd or a series of --vtu that is there goes on too, if it ends where the checkpoint is"),
    )  # fmt: skip
    finish_command(to, ".run", "run")


DRAWN = ("axes", "edges", "undeformed", "extremes", "legend", "ground")
"""Options of pictures that are drawn or not."""
PICTURE_OPTIONS = (
    ("--field", None, "NAME", "field in colour: von_mises (default), displacement, J, tresca, pressure, "
     "principal.1, cauchy.xx, contact_pressure, gap, ..., or none"),
    ("--view", number_pair, "AZIMUTH,ELEVATION", "of the camera, degrees"),
    ("--range", color_range, "LOW,HIGH", "of the colours, SI units"),
    ("--draw", Kind.APPEND, DRAWN, "in pictures also: axes, edges of elements, the undeformed shape, extremes, a "
     "legend of bodies, a ground at the lowest point"),
)  # fmt: skip


def _add_scenes(commands: Any) -> None:
    to = commands.add_parser("scenes", help="list scenes, or the parameters of one", description="List scenes.")
    to.add_argument("what", nargs="?", metavar="SCENE", help="a scene, file.py or file.py:scene: show its parameters")
    finish_command(to, ".show", "scenes")


def _add_info(commands: Any) -> None:
    to = commands.add_parser(
        "info",
        help="what a scene uses, leaves out and costs; the groups of a mesh",
        description="What a scene uses and what was left out, with counts, bytes, kernels and launches per step. "
        "Of a mesh its groups and size, with --material also what it costs.",
    )
    _add_model_options(to)
    add_options(to, ("--json", None, "FILE", "the same as JSON; - for stdout"))
    finish_command(to, ".show", "info")


def _add_render(commands: Any) -> None:
    to = commands.add_parser(
        "render",
        help="draw a USD file written by warpfea",
        description="Draw a USD file written by warpfea to .png or .gif, on the CPU, without a display, or to an .html "
        "page.",
        epilog="examples:\n  warpfea render hook.usdc -o hook.png --time 0.1\n"
        "  warpfea render hook.usdc -o hook.gif --speed 0.1 --field displacement",
    )
    to.add_argument("file", help="the USD file")
    to.add_argument(
        "-o", "--output", required=True, metavar="FILE", help="picture (.png), animation (.gif), page (.html)"
    )
    add_options(
        to,
        ("--time", float, "S", "time of a .png (default: the last)"),
        *PICTURE_OPTIONS,
        ("--size", size, "WxH", "pixels"),
        ("--fps", positive_number, "N", "frames per second of a .gif (default 20)", 20.0),
        ("--speed", positive_number, "X", "simulated seconds per second of a .gif", 1.0),
    )
    finish_command(to, ".show", "render")
