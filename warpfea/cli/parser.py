"""The options of all commands, and help that teaches by examples."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Sequence
from typing import Any, NoReturn

from ..base.errors import UsageError

__all__ = ["parse"]

EXAMPLES = """\
examples:
  warpfea run hook --usd hook.usdc --png hook.png       a scene that comes with warpfea
  warpfea run my_scenes.py:swing --set length=2         a scene of your own
  warpfea run part.msh --material svk:E=7e8,nu=0.33,density=2700 \\
      --clamp base --traction tip:0,0,-1e3              a mesh with named groups
  warpfea scenes hook                                   what can be set in a scene
  warpfea info hook                                     what a scene costs, before running it

exit codes: 0 done, 2 bad input or usage, 3 a step was refused, 4 output failed, 130 interrupted (files are valid)
"""

RUN_EXAMPLES = """\
examples:
  warpfea run cantilever --set E=2e9 --set length=1.5 --t-end 1 --gif bend.gif
  warpfea run twist --device cuda:0 --dtype float32 --usd twist.usdc --json -
  warpfea run part.msh --scale 1e-3 --material svk:E=7e8,nu=0.33,density=2700 --clamp base --pressure top:2e4
  warpfea run part.msh --material arm=svk:E=7e8,nu=0.33,density=2700 \
      --material pad=neo_hookean:mu=4e5,k=1e7,density=1000 --gravity 0,0,-9.81
  warpfea run hook --checkpoint hook.npz                Ctrl-C at any time, then
  warpfea run hook --checkpoint hook.npz --resume hook.npz

materials:
  svk:E=,nu=,density=                                   St. Venant-Kirchhoff
  neo_hookean:mu=,k=,density=      or  E=,nu=,density=
  mooney_rivlin:mu10=,mu01=,k=,density=  or  E=,nu=,density=
  with damping: add eta= and lambda_v= (Pa s), and form=incremental, rate or explicit

A scene file is Python:
  import warpfea as wf

  @wf.scene(dt=1e-3, t_end=0.5)
  def swing(*, length: float = 1.0) -> wf.ModelBuilder:
      ...
"""

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

LATER = {
    "stress": "the suite of stiff and extreme cases",
    "sweep": "sweeps over parameters on many devices",
}
MATERIAL_HINT = "e.g. svk:E=7e8,nu=0.33,density=2700"


class _Parser(argparse.ArgumentParser):
    def __init__(self, *args: Any, **options: Any) -> None:
        defaults: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}
        super().__init__(*args, **(defaults | options))

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} ({self.prog} --help tells more)")


def positive(text: str) -> float:
    """A positive finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive finite number")
    return value


def count(text: str) -> int:
    """A positive whole number."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive whole number")
    return int(text)


def counts(text: str) -> list[int]:
    """Positive whole numbers with commas; 1e5 counts as one."""
    try:
        values = [float(part) for part in text.split(",")]
        assert all(math.isfinite(v) and v >= 1 and v == int(v) for v in values)
    except (ValueError, AssertionError):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of positive whole numbers") from None
    return [int(v) for v in values]


def numbers(text: str, size: int) -> tuple[float, ...]:
    """Finite numbers with commas."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != size or not all(map(math.isfinite, values)):
        raise argparse.ArgumentTypeError(f"{text!r} is not {size} finite numbers with commas")
    return values


def vector(text: str) -> tuple[float, ...]:
    return numbers(text, 3)


def pair(text: str) -> tuple[float, ...]:
    return numbers(text, 2)


def size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT in pixels."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, such as 960x540")
    return int(match[1]), int(match[2])


def parse(words: Sequence[str]) -> argparse.Namespace:
    """The arguments, with `command` the function that does them. UsageError; SystemExit after --help."""
    from .. import __version__

    top = _Parser(
        prog="warpfea",
        description="Flexible multibody dynamics with Total Lagrangian finite elements in NVIDIA Warp.",
        epilog=EXAMPLES,
    )
    top.add_argument("--version", action="version", version=f"warpfea {__version__}")
    commands = top.add_subparsers(title="commands", metavar="COMMAND", parser_class=_Parser)
    _add_run(commands)
    _add_scenes(commands)
    _add_info(commands)
    _add_render(commands)
    _add_bench(commands)
    _add_study(commands)
    _add_profile(commands)
    for name, what in LATER.items():
        commands.add_parser(name, help=f"{what} (not part of this version)", add_help=False)
    if words and words[0] in LATER:
        raise UsageError(f"{words[0]}: {LATER[words[0]]} are not part of this version")
    arguments = top.parse_args(_join_negative(words))
    arguments.words = list(words)
    if not hasattr(arguments, "command"):
        top.print_help()
        names = "run, scenes, info, render, bench, study, profile"
        raise UsageError(f"give a command: {names} ({top.prog} --help tells more)")
    return arguments


def _join_negative(words: Sequence[str]) -> list[str]:
    """`--gravity -1,0,0` as `--gravity=-1,0,0`: argparse takes a word that begins with - for an option."""
    out: list[str] = []
    for word in words:
        if out and out[-1] in ("--gravity", "--view") and re.match(r"-[\d.]", word):
            out[-1] += f"={word}"
        else:
            out.append(word)
    return out


def _bench(arguments: argparse.Namespace) -> int:
    from ..studies.bench.bench import bench

    return bench(arguments)


def _call(module: str, function: str) -> Any:
    """The command, imported when it is called."""

    def command(arguments: argparse.Namespace) -> int:
        import importlib

        return int(getattr(importlib.import_module(f"{__package__}.{module}"), function)(arguments))

    return command


def _add_general(to: argparse.ArgumentParser, quiet: str = "no bars and no summary table") -> None:
    group = to.add_argument_group("general")
    group.add_argument("--quiet", action="store_true", help=quiet)
    group.add_argument("--no-progress", action="store_true", help="no bars; there are none without a terminal")
    group.add_argument("--debug", action="store_true", help="errors as Python tracebacks")


def _add_model(to: argparse.ArgumentParser) -> None:
    """What is simulated and how: shared by run and info."""
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
    mesh.add_argument("--scale", type=positive, metavar="S", help="metres per unit of the file, 1e-3 for mm")
    mesh.add_argument("--up-axis", choices=("Y", "Z"), help="by default Z")
    mesh.add_argument(
        "--quadrature", metavar="RULE", help="force rule: tet4, tet5_paper, tet8, tet14 (T10), tet1, tet4 (T4)"
    )
    how = to.add_argument_group("simulation (defaults are the scene's)")
    how.add_argument("--device", help="cpu, cuda:0, ...; by default CUDA where there is one")
    how.add_argument("--dtype", choices=("float64", "float32"), help="precision, by default float64")
    how.add_argument("--dt", type=positive, metavar="S", help="step, s")
    how.add_argument("--integrator", metavar="NAME", help="backward_euler or bdf2")
    how.add_argument(
        "--solver",
        choices=("newton-pcg", "jacobi"),
        default="newton-pcg",
        help="of a step, by default newton-pcg; jacobi: few cheap iterations, what is left is told",
    )
    how.add_argument("--tol", type=positive, metavar="X", help="relative residual at which a step is accepted")


def _add_run(commands: Any) -> None:
    to = commands.add_parser(
        "run",
        help="simulate a scene or a mesh",
        description="Simulate a scene, your own scene file, or a mesh.",
        epilog=RUN_EXAMPLES,
    )
    _add_model(to)
    to.add_argument("--t-end", type=positive, metavar="S", help="end time, s (default: the scene's)")
    out = to.add_argument_group("output (existing files are replaced once the new one is whole)")
    out.add_argument("--usd", metavar="FILE", help="animation (.usdc, .usda) with stress and displacement; validated")
    out.add_argument("--vtu", metavar="FOLDER", help="series of .vtu and a .pvd for ParaView")
    out.add_argument("--png", metavar="FILE", help="picture")
    out.add_argument("--png-time", type=float, metavar="S", help="time of the picture")
    out.add_argument("--gif", metavar="FILE", help="animation")
    out.add_argument("--fps", type=positive, metavar="N", help="frames per simulated second of --usd and --vtu")
    out.add_argument("--speed", type=positive, metavar="X", help="simulated seconds per second of --gif")
    out.add_argument("--json", metavar="FILE", help="summary of the run; - for stdout")
    out.add_argument("--checkpoint", metavar="FILE", help="state (.npz), written every --every steps and at the end")
    out.add_argument("--every", type=count, default=100, metavar="N", help="steps between checkpoints (default 100)")
    out.add_argument(
        "--resume",
        metavar="FILE",
        help="go on from a checkpoint, with its integrator and precision, and without --dt its dt",
    )
    _add_general(to)
    to.set_defaults(command=_call("run", "run"))


def _add_scenes(commands: Any) -> None:
    to = commands.add_parser("scenes", help="list scenes, or the parameters of one", description="List scenes.")
    to.add_argument("what", nargs="?", metavar="SCENE", help="a scene, file.py or file.py:scene: show its parameters")
    _add_general(to)
    to.set_defaults(command=_call("show", "scenes"))


def _add_info(commands: Any) -> None:
    to = commands.add_parser(
        "info",
        help="what a scene uses, leaves out and costs",
        description="What a scene uses and what was left out, with counts, bytes, kernels and launches per step.",
    )
    _add_model(to)
    to.add_argument("--json", metavar="FILE", help="the same as JSON; - for stdout")
    _add_general(to)
    to.set_defaults(command=_call("show", "info"))


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
    to.add_argument("--field", metavar="NAME", help="field in colour: von_mises, displacement")
    to.add_argument("--size", type=size, metavar="WxH", help="pixels")
    to.add_argument("--view", type=pair, metavar="AZIMUTH,ELEVATION", help="of the camera, degrees")
    to.add_argument("--fps", type=positive, default=20.0, metavar="N", help="frames per second of a .gif (default 20)")
    to.add_argument("--speed", type=positive, default=1.0, metavar="X", help="simulated seconds per second of a .gif")
    _add_general(to)
    to.set_defaults(command=_call("show", "render"))


def _add_bench(commands: Any) -> None:
    to = commands.add_parser(
        "bench",
        help="time and error of the solver on a bar, a beam or a plate",
        description="ms per step, PCG iterations, bytes per unknown, residual and tip error of bodies (SVK, "
        "E = 7e8 Pa, nu = 0.33, 2700 kg/m^3) that are clamped at x = 0 and loaded at the other end. bar: T10, "
        "3 x 2 x 1 m, 5000 N along x. beam: 3243, elements of 0.5 x 0.1 x 0.1 m, 3100 N across. plate: 3443, "
        "4 x 2 x 0.1 m, 1000 N down. ENMC, FN18, H3843: the bar of ANCF solids.",
        epilog="examples:\n  warpfea bench --problem plate --unknowns 1e4,1e5\n"
        "  warpfea bench --peer --large --out peer.json\n  warpfea bench --peer --rows 'beam-*,bar-3x2x1'\n"
        "  warpfea bench --growth --out growth.json\n  warpfea bench --product --out product.json\n"
        "  warpfea bench --cpu --out cpu.json",
    )
    kind = to.add_mutually_exclusive_group()
    kind.add_argument("--peer", action="store_true", help="120 steps to 5e-4 N on the peer's sizes, beside its times")
    kind.add_argument("--growth", action="store_true", help="PCG iterations of a step for all E, dt and nu, by size")
    kind.add_argument("--product", action="store_true", help="unknowns per second of the operator H v, its limits")
    kind.add_argument("--cpu", action="store_true", help="ms per step of three linear solvers on this CPU, to 5e-4 N")
    to.add_argument(
        "--problem",
        action="append",
        choices=("bar", "beam", "plate", "ENMC", "FN18", "H3843"),
        help="may be repeated; default bar, of --growth and --product several",
    )
    to.add_argument(
        "--unknowns", "--sizes", type=counts, default=[], metavar="N,N,...", help="sizes (default: a few per problem)"
    )
    to.add_argument("--device", help="cpu, cuda:0, ...; by default CUDA where there is one")
    to.add_argument(
        "--dtype",
        action="append",
        choices=("float64", "float32"),
        help="may be repeated; default both, of --peer float64 (--cpu: float64 only)",
    )
    to.add_argument(
        "--linear", action="append", choices=("pcg", "direct"), help="linear solver, may be repeated; default pcg"
    )
    to.add_argument("--steps", type=count, metavar="N", help="steps to simulate (default 10, --peer 120, --cpu 20)")
    to.add_argument("--repeat", type=count, metavar="N", help="runs; the median counts (default 3, --product 9)")
    to.add_argument("--dt", type=positive, metavar="S", help="step, s (default 1e-3)")
    to.add_argument("--tol", type=positive, metavar="X", help="relative residual at which a step is accepted")
    to.add_argument(
        "--reference-up-to",
        type=counts,
        metavar="N",
        help="largest size that gets a reference with 100 times tighter tolerance (default 100000)",
    )
    group = to.add_argument_group("with --peer or --cpu")
    group.add_argument("--rows", metavar="LABEL,...", help="rows by label, with * for any text (default: all)")
    group.add_argument(
        "--limit", type=positive, metavar="S", help="--cpu: s after which a row takes no more steps (default 60)"
    )
    group.add_argument("--large", action="store_true", help="a bar of 4 million unknowns too, ten steps")
    group.add_argument("--meshes", metavar="FOLDER", help="unstructured meshes (default: tests/data of the checkout)")
    to.add_argument("--out", metavar="FILE", help="JSON with command, machine, settings and rows")
    _add_general(to, "no bars; the table is what it is for")
    to.set_defaults(command=_bench)


def _add_study(commands: Any) -> None:
    to = commands.add_parser(
        "study",
        help="error against run time of elements",
        description="ancf-tets: T4, T10, ENMC, FN, FN18 and the brick H3843 on a rigid pendulum and on a soft bar with "
        "large deflection, static and in motion: error against unknowns and run time, as a table and a plot.",
        epilog="examples:\n  warpfea study ancf-tets --quick\n  warpfea study ancf-tets --device cpu --out results",
    )
    to.add_argument("what", metavar="STUDY", help="ancf-tets")
    to.add_argument("--device", help="cpu, cuda:0, ...; by default CUDA where there is one")
    to.add_argument("--sizes", type=counts, metavar="N,N,...", help="unknowns (default 100,300,1000,3000,10000)")
    to.add_argument("--repeat", type=count, default=3, metavar="N", help="runs, of which the median counts (default 3)")
    to.add_argument("--quick", action="store_true", help="a trial: two sizes, few steps, one run")
    to.add_argument("--out", metavar="FOLDER", help="write ancf_tets.json, .csv and .png there")
    _add_general(to)
    to.set_defaults(command=_call("study", "study"))


def _add_profile(commands: Any) -> None:
    from ..base.launch import PARTS

    parts = "\n".join(f"  {name:14}  {text}" for name, text in PARTS.items())
    to = commands.add_parser(
        "profile",
        help="where the time of a step goes",
        description="Time per part of a step and per kernel, iterations, launches, bytes, bandwidth beside that of a "
        "copy, compile time.",
        epilog=PROFILE_EXAMPLES.replace("@PARTS@", parts),
    )
    _add_model(to)
    to.add_argument("--steps", type=count, default=10, metavar="N", help="steps that are timed, after 2 (default 10)")
    out = to.add_argument_group("output (existing files are replaced once the new one is whole)")
    out.add_argument("--png", metavar="FILE", help="picture of the parts (pip install 'warpfea[plots]')")
    out.add_argument("--json", metavar="FILE", help="all numbers, with fixed keys; - for stdout")
    _add_general(to)
    to.set_defaults(command=_call("profile", "profile"))
