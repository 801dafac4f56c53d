"""`warpfea bench --scenes`: what a step of every scene launches, compiles, holds and iterates; nothing is timed.

Each row steps a scene from rest with the scene's own step, integrator and tolerance. Some scenes are run in float32,
with other solvers and integrators and in three worlds too, and one model has every kind of load at once, with each
form of damping. Launches are counted twice: those that are recorded for a step, with the bodies of its loops once, and
those that two steps do as they run, a mean. The numbers are the same on every machine but for iterations that
rounding decides.
"""

# mypy: disable-error-code="index"
# (vectors of device functions: Warp does not declare that they can be indexed)

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import warp as wp

from ...base.errors import UsageError
from ...builder.builder import ModelBuilder
from ...builder.scene import find, names
from ...elements.sections import Rectangle
from ...materials import SVK, KelvinVoigt
from ...mesh import box
from ...simulation.simulation import Simulation
from ...solvers import Jacobi, NewtonPCG
from ..profile.profiling import replay
from .measure import by_label, write

__all__ = ["STATED", "SceneCase", "SceneRow", "cases", "measure", "scenes"]

STATED = {"cantilever": "backward_euler", "hook": "backward_euler"}
"""Integrators of rows in place of the scenes' own: those that committed results were measured with."""
STEPS = 6
REPLAYED = 2
"""Steps whose launches are counted as they run, after `STEPS` and the warm-up of a profile."""
LOAD_STEPS = 4
VARIED = ("hook", "pendulum", "slider_crank", "twist")
VARIANTS: dict[str, dict[str, Any]] = {
    "f32": {"dtype": "float32"},
    "two-level": {"solver": {"preconditioner": "two-level"}},
    "jacobi3x3": {"solver": {"preconditioner": "block-jacobi"}},
    "direct": {"solver": {"linear": "direct"}},
    "jacobi": {"iterations": 8},
    "bdf2": {"integrator": "bdf2"},
    "outer": {"solver": {"multipliers": "outer"}},
    "deflated": {"solver": {"preconditioner": "deflated"}},
    "worlds": {"worlds": 3},
}
LOAD_SOLVERS: dict[str, dict[str, Any]] = {
    "auto": {},
    "two-level": {"solver": {"preconditioner": "two-level", "operator": "elements"}},
    "direct": {"solver": {"linear": "direct"}, "integrator": "bdf2"},
}


@dataclass(frozen=True)
class SceneCase:
    """A scene and how it is run.

    Attributes:
        label: as --rows takes it.
        make: gives the builder. dt: s; by default the scene's, and so are integrator and tol.
        solver: options of NewtonPCG; iterations: of Jacobi in its place.
        steps: from rest. replay: whether launches are counted as they run, too.
    """

    label: str
    make: Callable[[], ModelBuilder]
    dt: float
    integrator: str
    tol: float | None = None
    dtype: str = "float64"
    worlds: int = 1
    solver: dict[str, Any] = field(default_factory=dict)
    iterations: int | None = None
    steps: int = STEPS
    replay: bool = True


@dataclass(frozen=True)
class SceneRow:
    """What a step takes.

    Attributes:
        launches: recorded for a step. per_step: launches of a step as it runs; None where steps are not replayed.
        modules: of kernels, each compiled once. bytes: that the simulation holds.
        newton, pcg: iterations of all steps and worlds.
    """

    label: str
    launches: int
    per_step: float | None
    modules: int
    bytes: int
    newton: int
    pcg: int


@wp.func
def _field(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """A body force, N/kg."""
    return wp.vec3d(wp.float64(0.1) * x[1], t, -x[0])


def loads(form: str | None) -> ModelBuilder:
    """A T10 bar and a beam with every kind of load, damped in the form given."""
    damping = KelvinVoigt(eta=30.0, lambda_v=20.0, form=form) if form else None
    b = ModelBuilder()
    law = SVK(E=1e6, nu=0.3, density=1000.0, damping=damping)
    bar = b.add_solid(box((1.0, 0.1, 0.1), cells=(6, 2, 2), element="T10"), material=law, name="box")
    line, section = [(0.0, 1.0, 0.0), (1.0, 1.0, 0.0)], Rectangle(0.05, 0.05)
    law = SVK(E=1e7, nu=0.3, density=1000.0)
    beam = b.add_beam(line, elements=6, section=section, normal=(0, 0, 1), material=law, name="beam")
    b.clamp(bar.nodes("x-"))
    b.clamp(beam.start)
    b.add_pressure(bar.surface("z+"), 2e3)
    b.add_moment(beam.end, (0.0, -1.0, 0.0))
    b.add_body_force(_field, bodies=[bar])
    b.add_traction(bar.surface("x+"), (0.0, 0.0, -1e2))
    b.add_probe("tip", bar.surface("x+"))
    return b


def cases() -> list[SceneCase]:
    """All rows, scene by scene."""
    out = []
    for name in names():
        scene = find(name)
        own: dict[str, Any] = {"make": scene, "dt": scene.dt, "integrator": STATED.get(name, scene.integrator)}
        out.append(SceneCase(name, **own, tol=scene.tol))
        if name in VARIED:
            # a solver of its own has the default tolerance
            tol = {"f32": scene.tol, "bdf2": scene.tol, "worlds": scene.tol}
            for label, how in VARIANTS.items():
                again = label not in ("f32", "direct")  # the direct solver works on the host
                out.append(SceneCase(f"{name} {label}", **(own | how), tol=tol.get(label), replay=again))
    for form in ("explicit", "rate", "incremental", None):
        for label, how in LOAD_SOLVERS.items():
            settings: dict[str, Any] = {
                "dt": 2e-3,
                "integrator": "backward_euler",
                "steps": LOAD_STEPS,
                "replay": False,
            }
            out.append(SceneCase(f"loads {form} {label}", partial(loads, form), **(settings | how)))
    return out


def measure(case: SceneCase, *, device: Any) -> SceneRow:
    """Step the scene; what it takes."""
    model = case.make().finalize(device=device, dtype=case.dtype, worlds=case.worlds)
    how = Jacobi(iterations=case.iterations) if case.iterations else NewtonPCG(tol=case.tol, **case.solver)
    sim = Simulation(model, dt=case.dt, integrator=case.integrator, solver=how)
    held, launch = sum(sim.bytes().values()), sim.stepper.launch
    launches, modules = launch.launches, len(launch.modules)
    for _ in range(case.steps):
        sim.step()
    newton, pcg = (int(sim.totals[name].sum()) for name in ("newton", "pcg"))
    per_step = None
    if case.replay:
        recorder = replay(sim, REPLAYED).recorder
        per_step = sum(row.launches for row in recorder.kernels(REPLAYED, 0.0))
    return SceneRow(case.label, launches, per_step, modules, held, newton, pcg)


def scenes(options: argparse.Namespace) -> None:
    """Do `warpfea bench --scenes`: a line per row, and the file after each."""
    chosen = cases() if options.rows is None else by_label(options.rows, cases())
    before = earlier(options.before) if options.before else None
    was = {row["label"]: row for row in before["rows"]} if before else {}
    settings = {"steps": STEPS, "steps_of_loads": LOAD_STEPS, "steps_replayed": REPLAYED}
    more = {"before": before} if before else {}
    rows: list[SceneRow] = []
    print(HEADER, flush=True)
    for case in chosen:
        rows.append(measure(case, device=options.device))
        print(_line(rows[-1], was.get(case.label)), flush=True)
        if before and case.label not in was:  # a scene that is new is compared with its first row from now on
            before["rows"].insert(len(rows) - 1, dataclasses.asdict(rows[-1]))
        write(options, settings, rows, **more)
    write(options, settings, rows, **more)


def earlier(name: str) -> dict[str, Any]:
    """Commit and rows to compare with, of an earlier file: what it was compared with itself, or its own. UsageError."""
    path = pathlib.Path(name)
    if not path.is_file():
        raise UsageError(f"--before {name}: no such file")
    try:
        content = json.loads(path.read_text())
        content = content.get("before", content)
        return {"commit": content["commit"], "rows": content["rows"]}
    except (json.JSONDecodeError, AttributeError, KeyError) as error:
        raise UsageError(f"--before {name}: is no file of warpfea bench --scenes ({error})") from error


COLUMNS = {"launches": 9, "per_step": 9, "modules": 8, "bytes": 11, "newton": 7, "pcg": 6}
HEADER = f"{'row':26}" + "".join(f" {name.replace('_', ' '):>{width}}" for name, width in COLUMNS.items())


def _line(row: SceneRow, was: dict[str, Any] | None) -> str:
    """The row, and after it what differs from the one before."""

    def text(value: float | None) -> str:
        return "-" if value is None else f"{value:g}" if isinstance(value, float) else str(value)

    now = asdict(row)
    line = f"{row.label:26}" + "".join(f" {text(now[name]):>{width}}" for name, width in COLUMNS.items())
    changed = [name for name in COLUMNS if was and was[name] != now[name]]
    notes = [f"{name.replace('_', ' ')} {text(was[name])}" for name in changed] if was else []
    return line + (f"  before: {', '.join(notes)}" if notes else "")
