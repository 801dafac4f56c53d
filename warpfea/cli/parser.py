"""Options of all commands, and help with examples."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from typing import Any

from ..base.errors import UsageError
from ..base.names import did_you_mean
from ..simulation.statics import UNSTABLE_CHOICES
from ..solvers import SOLVERS
from .arguments import (
    Parser,
    StoreOnce,
    add_general_options,
    color_range,
    lazy_command,
    load_steps,
    number_pair,
    positive_integer,
    positive_number,
    size,
    step_size,
    vector,
)
from .measuring import add_bench, add_profile, add_stress, add_study, insert_scene_command
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


LATER_COMMANDS = {
    "sweep": "a sweep over parameters on many devices",
}
"""Commands of a later version: not offered, but refused with an explanation."""
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
    add_stress(commands)
    add_profile(commands, _add_model_options)
    if words and words[0] in LATER_COMMANDS:
        raise UsageError(f"{words[0]}: {LATER_COMMANDS[words[0]]} is not part of this version")
    refuse_moved(words)
    arguments, rest = top.parse_known_args(_join_negative_vectors(insert_scene_command(words)))
    if rest:
        known = commands.choices[words[0]]._option_string_actions if words[0] in commands.choices else ()
        hint = did_you_mean(rest[0].partition("=")[0], known) if rest[0].startswith("-") else ""
        raise UsageError(f"unknown option: {' '.join(rest)}{hint} (see warpfea {words[0]} --help)")
    arguments.words = list(words)
    if not hasattr(arguments, "command"):
        top.print_help()
        names = "run, scenes, info, render, bench, study, stress, profile"
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
    """Model and solver options common to run and info."""
    to.add_argument("what", metavar="SCENE", help="a scene, file.py or file.py:scene, or a mesh (.msh, .vtu, .inp)")
    to.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="set a parameter of the scene")
    mesh = to.add_argument_group("for a mesh file (vectors are x,y,z; repeat an option for several groups)")
    mesh.add_argument(
        "--material", action="append", default=[], metavar="[GROUP=]LAW:NAME=VALUE,...", help=MATERIAL_HINT
    )
    mesh.add_argument("--clamp", action="append", default=[], metavar="GROUP", help="hold the nodes of a group")
    mesh.add_argument(
        "--traction", action="append", default=[], metavar="GROUP:x,y,z", help="dead load on a surface, Pa"
    )
    mesh.add_argument(
        "--pressure", action="append", default=[], metavar="GROUP:p", help="follower pressure on a surface, Pa"
    )
    mesh.add_argument("--gravity", type=vector, metavar="x,y,z", help="m/s^2, by default 9.81 downwards")
    mesh.add_argument("--scale", type=positive_number, metavar="S", help="metres per unit of the file, 1e-3 for mm")
    mesh.add_argument("--up-axis", choices=("Y", "Z"), help="by default Z")
    mesh.add_argument(
        "--quadrature", metavar="RULE", help="force rule: tet4, tet5_paper, tet8, tet14 (T10), tet1, tet4 (T4)"
    )
    how = to.add_argument_group("simulation (defaults are the scene's)")
    how.add_argument("--device", help="cpu, cuda:0, ...; by default CUDA where there is one")
    how.add_argument("--dtype", choices=("float64", "float32"), help="precision, by default float64")
    how.add_argument("--dt", type=step_size, metavar="S", help="step, s; auto: as --error asks for")
    how.add_argument(
        "--error", type=positive_number, metavar="X", help="of --dt auto: of positions, over the model's size"
    )
    how.add_argument(
        "--integrator",
        metavar="NAME",
        help="backward_euler, bdf2, energy_momentum or generalized_alpha, also with its option: "
        "generalized_alpha(rho_inf=0.5), energy_momentum(rho_inf=0.8)",
    )
    how.add_argument(
        "--solver",
        choices=tuple(SOLVERS),
        default="newton-pcg",
        help="of a step, by default newton-pcg; jacobi: few cheap iterations, what is left is told; direct: SuperLU",
    )
    how.add_argument("--tol", type=positive_number, metavar="X", help="relative residual at which a step is accepted")
    how.add_argument(
        "--inversion",
        choices=("refuse", "report"),
        default="refuse",
        help="a step that turns an element inside out is refused (default), or passes where the law allows it",
    )
    how.add_argument(
        "--energy-growth",
        choices=("refuse", "warn", "ignore"),
        default="refuse",
        help="energy that the integrator adds: above 1 %% a warning, above 10 %% refused (default), or not",
    )


def _add_run(commands: Any) -> None:
    to = commands.add_parser(
        "run",
        help="simulate a scene or a mesh",
        description="Simulate a scene, your own scene file, or a mesh.",
        epilog=RUN_EXAMPLES,
    )
    _add_model_options(to)
    to.add_argument("--t-end", type=positive_number, metavar="S", help="end time, s (default: the scene's)")
    to.add_argument("--static", action="store_true", help="static equilibrium in place of a motion")
    to.add_argument(
        "--load-steps",
        type=load_steps,
        metavar="N",
        help="of --static (default 10); auto: the whole load at once, halved where it is refused",
    )
    to.add_argument(
        "--stabilise",
        action="store_true",
        help="of --static: springs that fade with the load, for bodies that only contact holds",
    )
    to.add_argument(
        "--unstable",
        choices=UNSTABLE_CHOICES,
        help="of --static: warn of an unstable equilibrium (default), refuse it, or do not judge it",
    )
    out = to.add_argument_group("output (existing files are replaced once the new one is whole)")
    out.add_argument(
        "--usd",
        action=StoreOnce,
        metavar="FILE",
        help="animation (.usdc, .usda) with stress and displacement; validated",
    )
    out.add_argument("--vtu", action=StoreOnce, metavar="FOLDER", help="series of .vtu and a .pvd for ParaView")
    out.add_argument("--png", action=StoreOnce, metavar="FILE", help="picture")
    out.add_argument("--png-time", type=float, metavar="S", help="time of the picture")
    out.add_argument("--gif", action=StoreOnce, metavar="FILE", help="animation")
    _add_picture_options(out)
    out.add_argument("--fps", type=positive_number, metavar="N", help="frames per simulated second of --usd and --vtu")
    out.add_argument("--speed", type=positive_number, metavar="X", help="simulated seconds per second of --gif")
    out.add_argument("--json", action=StoreOnce, metavar="FILE", help="summary of the run; - for stdout")
    out.add_argument(
        "--checkpoint",
        action=StoreOnce,
        metavar="FILE",
        help="state (.npz), written every --every steps and at the end",
    )
    out.add_argument("--every", type=positive_integer, metavar="N", help="steps between checkpoints (default 100)")
    out.add_argument(
        "--resume",
        metavar="FILE",
        help="go on from a checkpoint, with its integrator and precision, and without --dt its dt; a file of --usd or "
        "a series of --vtu that is there goes on too, if it ends where the checkpoint is",
    )
    add_general_options(to)
    to.set_defaults(command=lazy_command("run", "run"))


def _add_picture_options(to: Any) -> None:
    """Options of pictures."""
    to.add_argument(
        "--field",
        metavar="NAME",
        help="field in colour: von_mises (default), displacement, J, strain_energy_density, contact_pressure, gap, or "
        "none",
    )
    to.add_argument("--view", type=number_pair, metavar="AZIMUTH,ELEVATION", help="of the camera, degrees")
    to.add_argument("--range", type=color_range, metavar="LOW,HIGH", help="of the colours, SI units")


def _add_scenes(commands: Any) -> None:
    to = commands.add_parser("scenes", help="list scenes, or the parameters of one", description="List scenes.")
    to.add_argument("what", nargs="?", metavar="SCENE", help="a scene, file.py or file.py:scene: show its parameters")
    add_general_options(to)
    to.set_defaults(command=lazy_command("show", "scenes"))


def _add_info(commands: Any) -> None:
    to = commands.add_parser(
        "info",
        help="what a scene uses, leaves out and costs; the groups of a mesh",
        description="What a scene uses and what was left out, with counts, bytes, kernels and launches per step. "
        "Of a mesh its groups and size, with --material also what it costs.",
    )
    _add_model_options(to)
    to.add_argument("--json", metavar="FILE", help="the same as JSON; - for stdout")
    add_general_options(to)
    to.set_defaults(command=lazy_command("show", "info"))


def _add_render(commands: Any) -> None:
    to = commands.add_parser(
        "render",
        help="draw a USD file written by warpfea",
        description="Draw a USD file written by warpfea to .png or .gif, on the CPU, without a display.",
        epilog="examples:\n  warpfea render hook.usdc -o hook.png --time 0.1\n"
        "  warpfea render hook.usdc -o hook.gif --speed 0.1 --field displacement",
    )
    to.add_argument("file", help="the USD file")
    to.add_argument("-o", "--output", required=True, metavar="FILE", help="picture (.png) or animation (.gif)")
    to.add_argument("--time", type=float, metavar="S", help="time of a .png (default: the last)")
    _add_picture_options(to)
    to.add_argument("--size", type=size, metavar="WxH", help="pixels")
    to.add_argument(
        "--fps", type=positive_number, default=20.0, metavar="N", help="frames per second of a .gif (default 20)"
    )
    to.add_argument(
        "--speed", type=positive_number, default=1.0, metavar="X", help="simulated seconds per second of a .gif"
    )
    add_general_options(to)
    to.set_defaults(command=lazy_command("show", "render"))
