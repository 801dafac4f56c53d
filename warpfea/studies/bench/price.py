"""`warpfea bench --price`: what a step of each scene costs as shipped, and with all that it leaves out forced in.

Forced in are features of `Model.info()["left_out"]`, by instances that do not move the scene: forces, moments,
pressures and fields of zero, gravity and viscosities of 1e-30, a plane with friction far below. What can't act on
the scene's own bodies comes with two small bodies that touch nothing: a free cube of two T4 layers with damping by the
rate, and an H3843 brick, driven on one face, on a joint at the other, damped explicitly. `moved` tells how far the
probes then are from the scene's own, over their travel.

Both simulations of a scene take turns, `--steps` steps each, `--repeat` times; the median step counts.
"""

# mypy: disable-error-code="index"
# (vectors of device functions: Warp does not declare that they can be indexed)

from __future__ import annotations

import argparse
import statistics
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from ... import mesh as meshes
from ...builder.attachments import GROUND
from ...builder.builder import ModelBuilder
from ...builder.scene import Scene, find, names
from ...laws import Control
from ...materials import SVK, KelvinVoigt
from ...model.shapes import HalfSpace
from ...simulation.simulation import Simulation
from ...solvers import NewtonPCG
from .measure import by_label, write
from .scenes import STATED

__all__ = ["PriceCase", "PriceRow", "cases", "force_in", "measure", "price"]

STEPS, REPEAT, WARM_UP = 5, 3, 2
NEXT_TO_NONE = 1e-30
"""Of viscosities, Pa s, and gravity, m/s^2: with 0 gravity is left out."""
STILL = 1e-3
"""Probes that travel less than this part of the model's size are judged by that."""
FAR = 1e3
"""Of the plane, over the model's size."""
SMALL = 0.05
"""Edge of the added bodies, over the model's size."""


@dataclass(frozen=True)
class PriceCase:
    """A scene, by its name as --rows takes it."""

    label: str
    scene: Scene


@dataclass(frozen=True)
class Side:
    """A scene as shipped, or with all features.

    Attributes:
        ms_per_step: the median. newton_per_step, pcg_per_step: means.
        bytes: of the model, the workspace and the state. launches: recorded for a step.
        kernels: launched. modules: of them, each compiled once.
    """

    unknowns: int
    ms_per_step: float
    newton_per_step: float
    pcg_per_step: float
    bytes: int
    launches: int
    kernels: list[str]
    modules: list[str]
    compile_s: float
    methods: dict[str, str]


@dataclass(frozen=True)
class PriceRow:
    """A scene.

    Attributes:
        forced: features that it leaves out and that were forced in. left: those that were not.
        ratio: ms with all over ms as shipped; ratio_per_newton: the same of an iteration of Newton's method, None where
            the scene as shipped takes none in these steps (its bodies fall).
        moved: largest distance of a probe from its place as shipped, over the travel of all, or STILL of the size.
    """

    scene: str
    shipped: Side
    all: Side
    forced: list[str]
    left: list[str]
    ratio: float
    ratio_per_newton: float | None
    moved: float


@wp.func
def _nothing(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """A body force, N/kg."""
    return wp.vec3d(wp.float64(0.0) * x[0], wp.float64(0.0) * t, wp.float64(0.0))


def everywhere(X: np.ndarray) -> np.ndarray:
    """All faces or nodes."""
    return np.ones(len(X), dtype=bool)


def _damped(law: Any, form: str) -> Any:
    """A law with next to no viscosity."""
    return replace(law, damping=KelvinVoigt(eta=NEXT_TO_NONE, form=form))


def force_in(b: ModelBuilder, missing: list[str]) -> None:
    """Add the features named, as the module says; `missing` as of `Model.info()["left_out"]`."""
    bodies = list(b.bodies)
    first = bodies[0]
    reference = np.concatenate([body.mesh.points[body.mesh.used_nodes] for body in bodies])
    low, high = reference.min(axis=0), reference.max(axis=0)
    size = float(np.linalg.norm(high - low))
    point = first.at(first.mesh.points[first.mesh.used_nodes[0]])
    on_bodies: dict[str, Callable[[], Any]] = {
        "gravity": lambda: setattr(b, "gravity", (0.0, 0.0, -NEXT_TO_NONE)),
        "dead loads": lambda: b.add_point_load(point, (0.0, 0.0, 0.0)),
        "controls": lambda: b.add_point_load(point, Control("price", 3)),
        "moments": lambda: b.add_moment(point, (0.0, 0.0, 0.0)),
        "follower pressure": lambda: b.add_pressure(first.surface(everywhere), 0.0),
        "body forces": lambda: b.add_body_force(_nothing, bodies=bodies),
    }
    for name in missing:
        on_bodies.get(name, lambda: None)()
    if {"contact", "friction"} & set(missing):
        far = b.add_collider(HalfSpace((0, 0, 1), low[2] - FAR * size), name="price far")
        for body in bodies:
            b.add_contact(body, far, mu=0.5, restitution=0.5, name=f"price {body.name}")
    for body in bodies if "damping incremental" in missing else ():
        body.materials = [(g, law if law.damping else _damped(law, "incremental")) for g, law in body.materials]
    _add_bodies(b, 0.5 * (low + high), SMALL * size, pair="contact between bodies" in missing)


def _add_bodies(b: ModelBuilder, place: np.ndarray, edge: float, *, pair: bool) -> None:
    """Those that touch nothing: they bring what the scene's own bodies can't have."""
    law, side, origin = SVK(E=1e7, nu=0.3, density=1000.0), (edge, edge, edge), tuple(place)
    free = meshes.box(side, cells=(1, 1, 2), element="T4", origin=origin)
    body = b.add_solid(free, material=_damped(law, "rate"), name="price free")
    if pair:
        beside = meshes.box(side, cells=(1, 1, 2), element="T4", origin=tuple(place + FAR * edge))
        other = b.add_solid(beside, material=_damped(law, "rate"), name="price other")
        b.add_contact(other, body, mu=0.5, restitution=0.5, name="price pair")
    brick = meshes.box(side, cells=(1, 1, 1), element="H3843", origin=origin)
    held = b.add_solid(brick, material=_damped(law, "explicit"), element="H3843", name="price held")
    b.drive(held.nodes("x-"), displacement=([0.0, 1e3], [(0, 0, 0), (0, 0, 0)]))
    b.add_joint("spherical", parent=GROUND, child=held.surface("x+"), name="price joint")


def cases() -> list[PriceCase]:
    """All scenes."""
    return [PriceCase(name, find(name)) for name in names()]


class _Runner:
    def __init__(self, b: ModelBuilder, scene: Scene, device: Any) -> None:
        self.model = b.finalize(device=device)
        how = NewtonPCG(tol=scene.tol)
        method = STATED.get(scene.name, scene.integrator)
        self.sim = Simulation(self.model, dt=scene.dt, integrator=method, solver=how)
        self.sim.step(WARM_UP)
        self.times: list[float] = []

    def step(self, steps: int) -> None:
        for _ in range(steps):
            start = clock.perf_counter()
            self.sim.step()  # reads its report, and so waits for the device
            self.times.append(clock.perf_counter() - start)

    def path(self, probes: list[str]) -> np.ndarray:
        """Displacements (probes, steps, 3), m."""
        return np.stack([self.sim.probe(name).displacement[0] for name in probes])

    def side(self) -> Side:
        sim, launch = self.sim, self.sim.stepper.launch
        return Side(
            unknowns=self.model.info()["unknowns"],
            ms_per_step=1e3 * statistics.median(self.times),
            newton_per_step=float(sim.totals["newton"][0]) / sim.steps,
            pcg_per_step=float(sim.totals["pcg"][0]) / sim.steps,
            bytes=sum(sim.bytes().values()),
            launches=launch.launches,
            kernels=sorted(launch.kernels),
            modules=sorted(name.removeprefix("warpfea.kernels.") for name in launch.modules),
            compile_s=sim.compile_s,
            methods=sim.methods,
        )


def measure(case: PriceCase, *, device: Any, steps: int, repeat: int) -> PriceRow:
    """Both simulations of a scene, in turns."""
    shipped = _Runner(case.scene(), case.scene, device)
    missing = list(shipped.model.info()["left_out"])
    b = case.scene()
    force_in(b, missing)
    full = _Runner(b, case.scene, device)
    for _ in range(repeat):
        for runner in (shipped, full):
            runner.step(steps)
    left = list(full.model.info()["left_out"])
    own, everything = shipped.side(), full.side()
    ratio = everything.ms_per_step / own.ms_per_step
    names = [probe.name for probe in shipped.model.probes]
    path, other = shipped.path(names), full.path(names)
    return PriceRow(
        case.label,
        own,
        everything,
        [name for name in missing if name not in left],
        left,
        ratio,
        ratio * own.newton_per_step / everything.newton_per_step if own.newton_per_step else None,
        float(np.abs(other - path).max() / max(np.abs(path).max(), STILL * shipped.model.size)),
    )


def price(options: argparse.Namespace) -> None:
    """Do `warpfea bench --price`: a line per scene, and the file after each."""
    chosen = cases() if options.rows is None else by_label(options.rows, cases())
    steps, repeat = options.steps or STEPS, options.repeat or REPEAT
    settings = {"steps": steps, "repeat": repeat, "warm_up_steps": WARM_UP, "time": "median step"}
    rows: list[PriceRow] = []
    print(HEADER, flush=True)
    for case in chosen:
        rows.append(measure(case, device=options.device, steps=steps, repeat=repeat))
        print(_line(rows[-1]), flush=True)
        write(options, settings, rows)


HEADER = (
    f"{'shipped, all':20} {'ms per step':>15} {'ratio':>6} {'Newton':>11} {'per Newton':>10} {'PCG':>13} {'MB':>13} "
    f"{'modules':>9} {'kernels':>9} {'launches':>9} {'forced':>6} {'moved':>8}"
)


def _line(r: PriceRow) -> str:
    a, z = r.shipped, r.all
    each = "-" if r.ratio_per_newton is None else f"{r.ratio_per_newton:.2f}"
    left = f"  without {', '.join(r.left)}" if r.left else ""
    return (
        f"{r.scene:20} {a.ms_per_step:7.2f} {z.ms_per_step:7.2f} {r.ratio:6.2f} {a.newton_per_step:5.1f} "
        f"{z.newton_per_step:5.1f} {each:>10} {a.pcg_per_step:6.1f} {z.pcg_per_step:6.1f} "
        f"{a.bytes / 1e6:6.2f} {z.bytes / 1e6:6.2f} {len(a.modules):4d} {len(z.modules):4d} {len(a.kernels):4d} "
        f"{len(z.kernels):4d} {a.launches:4d} {z.launches:4d} {len(r.forced):6d} {r.moved:8.1e}{left}"
    )
