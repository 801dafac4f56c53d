"""Price of a step of each scene as shipped, and with all that it leaves out forced in.

Forced in are features of `Model.info()["left_out"]`, by instances that do not move the scene: forces, moments,
pressures and fields of zero, gravity and viscosities of 1e-30, a plane with friction far below. What can't act on
the scene's own bodies comes with two small bodies that touch nothing: a free cube of two T4 layers with damping by the
rate, and an H3843 brick, driven on one face, on a joint at the other, damped explicitly.

Both simulations of a scene take turns, `steps` steps each, `repeat` times; the median step counts. Rows:

shipped, all    of each: ms_per_step, the median; newton_per_step, pcg_per_step, means; bytes of model, workspace and
                state; launches recorded for a step; kernels launched, and their modules, each compiled once
forced, left    features that it leaves out and that were forced in; those that were not
ratio           ms with all over ms as shipped; ratio_per_newton of a Newton iteration, None where none is taken
moved           largest distance of a probe from its place as shipped, over the travel of all, or STILL of the size
"""

# mypy: disable-error-code="index"
# (vectors of device functions: Warp does not declare that they can be indexed)

from __future__ import annotations

import statistics
import time as clock
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

import warpfea as wf
from warpfea import mesh as meshes
from warpfea.builder.scene import Scene, find, names

from .scene_costs import STATED
from .table import Row, Run, Table

__all__ = ["TABLE", "force_in", "measure"]

WARM_UP = 2
NEXT_TO_NONE = 1e-30
"""Of viscosities, Pa s, and gravity, m/s^2: with 0 gravity is left out."""
STILL = 1e-3
"""Probes that travel less than this part of the model's size are judged by that."""
FAR = 1e3
"""Of the plane, over the model's size."""
SMALL = 0.05
"""Edge of the added bodies, over the model's size."""


@wp.func
def _nothing(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """A body force, N/kg."""
    return wp.vec3d(wp.float64(0.0) * x[0], wp.float64(0.0) * t, wp.float64(0.0))


def everywhere(X: np.ndarray) -> np.ndarray:
    """All faces or nodes."""
    return np.ones(len(X), dtype=bool)


def _damped(law: Any, form: str) -> Any:
    """A law with next to no viscosity."""
    return replace(law, damping=wf.KelvinVoigt(eta=NEXT_TO_NONE, form=form))


def force_in(b: wf.ModelBuilder, missing: list[str]) -> None:
    """Add the features named, as the module says; `missing` as of `Model.info()["left_out"]`."""
    first, *_ = bodies = list(b.bodies)
    reference = np.concatenate([body.mesh.points[body.mesh.used_nodes] for body in bodies])
    low, high = reference.min(axis=0), reference.max(axis=0)
    size = float(np.linalg.norm(high - low))
    point, other = (first.at(first.mesh.points[first.mesh.used_nodes[k]]) for k in (0, 1))
    on_bodies: dict[str, Callable[[], Any]] = {
        "gravity": lambda: setattr(b.description, "gravity", (0.0, 0.0, -NEXT_TO_NONE)),
        "dead loads": lambda: b.add_point_load(point, (0.0, 0.0, 0.0)),
        "controls": lambda: b.add_point_load(point, wf.Control("price", 3)),
        "moments": lambda: b.add_moment(point, (0.0, 0.0, 0.0)),
        "follower pressure": lambda: b.add_pressure(first.surface(everywhere), 0.0),
        "body forces": lambda: b.add_body_force(_nothing, bodies=bodies),
        "springs": lambda: b.add_spring(point, other, stiffness=NEXT_TO_NONE),
    }
    for name in missing:
        on_bodies.get(name, lambda: None)()
    if {"contact", "friction"} & set(missing):
        far = b.add_collider(wf.HalfSpace((0, 0, 1), low[2] - FAR * size), name="price far")
        for body in bodies:
            b.add_contact(body, far, mu=0.5, restitution=0.5, name=f"price {body.name}")
    for body in bodies if "damping incremental" in missing else ():
        body.materials = [(g, law if law.damping else _damped(law, "incremental")) for g, law in body.materials]
    _add_bodies(b, 0.5 * (low + high), SMALL * size, pair="contact between bodies" in missing)


def _add_bodies(b: wf.ModelBuilder, place: np.ndarray, edge: float, *, pair: bool) -> None:
    """Those that touch nothing: they bring what the scene's own bodies can't have."""
    law, side, origin = wf.SVK(E=1e7, nu=0.3, density=1000.0), (edge, edge, edge), tuple(place)
    free = meshes.box(side, cells=(1, 1, 2), element="T4", origin=origin)
    body = b.add_solid(free, material=_damped(law, "rate"), name="price free")
    if pair:
        beside = meshes.box(side, cells=(1, 1, 2), element="T4", origin=tuple(place + FAR * edge))
        other = b.add_solid(beside, material=_damped(law, "rate"), name="price other")
        b.add_contact(other, body, mu=0.5, restitution=0.5, name="price pair")
    brick = meshes.box(side, cells=(1, 1, 1), element="H3843", origin=origin)
    held = b.add_solid(brick, material=_damped(law, "explicit"), element="H3843", name="price held")
    b.drive(held.nodes("x-"), displacement=([0.0, 1e3], [(0, 0, 0), (0, 0, 0)]))
    b.add_joint("spherical", parent=wf.GROUND, child=held.surface("x+"), name="price joint")
    turned = b.add_solid(free, material=law).surface("z-")
    b.add_actuator(hinge := b.add_joint("revolute", parent=wf.GROUND, child=turned, axis=(0, 0, 1)), 0.0)
    b.add_velocity_constraint("speed", hinge, name="price speed")


class _Runner:
    def __init__(self, b: wf.ModelBuilder, scene: Scene, device: Any) -> None:
        self.model = b.finalize(device=device)
        how = wf.NewtonPCG(tol=scene.tol)
        method = STATED.get(scene.name, scene.integrator)
        self.sim = wf.Simulation(self.model, dt=scene.dt, integrator=method, solver=how)
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

    def side(self) -> Row:
        sim, launch = self.sim, self.sim.stepper.launch
        return {
            "unknowns": self.model.info()["unknowns"],
            "ms_per_step": 1e3 * statistics.median(self.times),
            "newton_per_step": float(sim.totals["newton"][0]) / sim.steps,
            "pcg_per_step": float(sim.totals["pcg"][0]) / sim.steps,
            "bytes": sum(sim.bytes().values()),
            "launches": launch.launches,
            "kernels": sorted(launch.kernels),
            "modules": sorted(name.removeprefix("warpfea.kernels.") for name in launch.modules),
            "compile_s": sim.compile_s,
            "methods": sim.methods,
        }


def measure(scene: Scene, *, device: Any, steps: int, repeat: int) -> Row:
    """The row of a scene: both simulations, in turns."""
    shipped = _Runner(scene(), scene, device)
    missing = list(shipped.model.info()["left_out"])
    b = scene()
    force_in(b, missing)
    full = _Runner(b, scene, device)
    for _ in range(repeat):
        for runner in (shipped, full):
            runner.step(steps)
    left = list(full.model.info()["left_out"])
    own, everything = shipped.side(), full.side()
    ratio, iterations = everything["ms_per_step"] / own["ms_per_step"], own["newton_per_step"]
    probes = [probe.name for probe in shipped.model.description.probes]
    path, other = shipped.path(probes), full.path(probes)
    return {
        "scene": scene.name,
        "shipped": own,
        "all": everything,
        "forced": [name for name in missing if name not in left],
        "left": left,
        "ratio": ratio,
        "ratio_per_newton": ratio * iterations / everything["newton_per_step"] if iterations else None,
        "moved": float(np.abs(other - path).max() / max(np.abs(path).max(), STILL * shipped.model.size)),
    }


def rows(run: Run) -> Iterator[Row]:
    """A row per scene."""
    for name in filter(run.wants, names()):
        yield measure(find(name), device=run.device, steps=run.options["steps"], repeat=run.options["repeat"])


TABLE = Table(
    about=__doc__,
    parts={"rows": rows},
    results={"price_cpu.json": "price --out tests/results/price_cpu.json"},
    options={"steps": 5, "repeat": 3},
    settings={"warm_up_steps": WARM_UP, "time": "median step"},
    columns=("scene", "ratio", "ratio_per_newton", "moved", "forced", "left"),
)
