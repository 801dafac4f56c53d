"""Launches, modules, bytes and iterations of a step of every scene; nothing is timed.

Each row steps a scene from rest with the scene's own step, integrator and tolerance. Some scenes are run in float32,
with other solvers and integrators and in three worlds too, and one model has every kind of load at once, with each
form of damping. Launches are counted twice: those that are recorded for a step, with the bodies of its loops once, and
those that two steps do as they run, a mean. The numbers are the same on every machine but for iterations that
rounding decides. Rows:

launches      recorded for a step
per_step      launches of a step as it runs; None where steps are not replayed
modules       of kernels, each compiled once
bytes         that the simulation holds
newton, pcg   iterations of all steps and worlds

`before` holds commit and rows that the rows are compared with: those that the earlier file `beside` was compared with,
or its own.
"""

# mypy: disable-error-code="index"
# (vectors of device functions: Warp does not declare that they can be indexed)

from __future__ import annotations

import json
import pathlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import warp as wp

import warpfea as wf
from warpfea.base.errors import UsageError
from warpfea.builder.scene import find, names
from warpfea.studies.profile.profiling import replay

from .table import Row, Run, Table

__all__ = ["STATED", "STEPS", "TABLE", "SceneCase", "cases", "earlier"]

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
    make: Callable[[], wf.ModelBuilder]
    dt: float
    integrator: str
    tol: float | None = None
    dtype: str = "float64"
    worlds: int = 1
    solver: dict[str, Any] = field(default_factory=dict)
    iterations: int | None = None
    steps: int = STEPS
    replay: bool = True


@wp.func
def _field(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """A body force, N/kg."""
    return wp.vec3d(wp.float64(0.1) * x[1], t, -x[0])


def loads(form: str | None) -> wf.ModelBuilder:
    """A T10 bar and a beam with every kind of load, damped in the form given."""
    damping = wf.KelvinVoigt(eta=30.0, lambda_v=20.0, form=form) if form else None
    b = wf.ModelBuilder()
    law = wf.SVK(E=1e6, nu=0.3, density=1000.0, damping=damping)
    bar = b.add_solid(wf.mesh.box((1.0, 0.1, 0.1), cells=(6, 2, 2), element="T10"), material=law, name="box")
    line, section = [(0.0, 1.0, 0.0), (1.0, 1.0, 0.0)], wf.Rectangle(0.05, 0.05)
    law = wf.SVK(E=1e7, nu=0.3, density=1000.0)
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


def rows(run: Run) -> Iterator[Row]:
    """A row per scene and way to run it."""
    for case in filter(lambda case: run.wants(case.label), cases()):
        model = case.make().finalize(device=run.device, dtype=case.dtype, worlds=case.worlds)
        how = wf.Jacobi(iterations=case.iterations) if case.iterations else wf.NewtonPCG(tol=case.tol, **case.solver)
        sim = wf.Simulation(model, dt=case.dt, integrator=case.integrator, solver=how)
        held, launch = sum(sim.bytes().values()), sim.stepper.launch
        row: Row = {"label": case.label, "launches": launch.launches, "per_step": None}
        row |= {"modules": len(launch.modules), "bytes": held}
        for _ in range(case.steps):
            sim.step()
        row |= {name: int(sim.totals[name].sum()) for name in ("newton", "pcg")}
        if case.replay:
            recorder = replay(sim, REPLAYED).recorder
            row["per_step"] = sum(kernel.launches for kernel in recorder.kernels(REPLAYED, 0.0))
        yield row


def before(run: Run) -> dict[str, Any]:
    """Commit and rows of an earlier file; a row that is new there stands as its own from now on."""
    if not run.options["beside"]:
        return {}
    found = run.made["earlier"]
    known = {row["label"]: row for row in found["rows"]}
    for row in run.made["rows"]:
        changed = {k: v for k, v in known.get(row["label"], row).items() if row[k] != v}
        if changed:
            print(row["label"], "before:", *(f"{k.replace('_', ' ')} {v}" for k, v in changed.items()), flush=True)
    made = [known.get(row["label"], row) for row in run.made["rows"]]
    kept = [row for row in found["rows"] if row not in made] if run.labels else []
    return {"commit": found["commit"], "rows": [*made, *kept]}


def earlier(name: str) -> dict[str, Any]:
    """Commit and rows of an earlier file: those that it was compared with itself, or its own. UsageError."""
    path = pathlib.Path(name)
    if not path.is_file():
        raise UsageError(f"--set beside={name}: no such file")
    try:
        content = json.loads(path.read_text())
        content = content.get("before") or content
        return {"commit": content["commit"], "rows": content["rows"]}
    except (json.JSONDecodeError, AttributeError, KeyError) as error:
        raise UsageError(f"--set beside={name}: is no file of the table scene_costs ({error})") from error


def check(run: Run) -> None:
    """Read the file to stand beside, which --out may replace. UsageError."""
    if run.options["beside"]:
        run.made["earlier"] = earlier(run.options["beside"])


FILE = "tests/results/scenes_cpu.json"
TABLE = Table(
    about=__doc__,
    parts={"rows": rows, "before": before},
    results={"scenes_cpu.json": f"scene_costs --set beside={FILE} --out {FILE}"},
    options={"beside": ""},
    settings={"steps": STEPS, "steps_of_loads": LOAD_STEPS, "steps_replayed": REPLAYED},
    check=check,
)
