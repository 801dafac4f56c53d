"""Energy and momenta of `energy_momentum` over ten thousand steps and more.

A free body of each family and law is thrown with a spin and stretched at the same time, so that it tumbles and
pulsates with large strains; mechanisms without damping swing under gravity. Errors are the largest of all steps
measured, over the first value; of mechanisms the energy less the work of their drives, over the largest kinetic and
stored energy.
"""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

import warpfea as wf
from warpfea.builder.scene import find
from warpfea.simulation.checkpoint import save_checkpoint

from .table import Part, Row, Run, Table

__all__ = ["CASES", "DT", "FREE", "LAWS", "MECHANISMS", "RATE", "STEPS", "TABLE", "Conserved", "mechanism", "tumble"]

STEPS = 10_000
TURNS = 10_000
DT = 5e-3
AXIS = np.array([0.3, 0.5, 1.0])
RATE = 12.0 * float(np.linalg.norm(AXIS))
"""Angular velocity of the spin, rad/s."""
TOL = 1e-12
CLOSED = 1e-13
"""Tolerance of joints, over the model's size."""
QUICK = 100
"""Fraction of the steps in a trial run."""
EVERY = 10
"""Interval of steps at which momenta and stretches are measured; energies at each."""
LAWS = {
    "svk": wf.SVK(E=1e6, nu=0.3, density=1000.0),
    "mooney_rivlin": wf.MooneyRivlin(mu10=1.5e5, mu01=5e4, k=1e6, density=1000.0),
    "neo_hookean": wf.NeoHookean(mu=4e5, k=1e6, density=1000.0),
}
SOLIDS = ("T4", "T10", "ENMC", "FN", "H3843")
CELLS = {"T4": 2, "H3843": 2}
"""Cells along a solid, one for others; each is cut into six tetrahedra."""
CASES = [
    *((family, law) for family in SOLIDS for law in LAWS),
    *((f"3243 {integration}", "svk") for integration in ("tied", "split", "full")),
    *((f"3443 {integration}", "svk") for integration in ("tied", "full")),
    *((f"{family} full", law) for family in ("3243", "3443") for law in ("mooney_rivlin", "neo_hookean")),
]
"""Family, with its integration if selectable, and law."""
STEEL = {"E": 2e11, "density": 7870.0, "slider_mass": 0.0755}
MECHANISMS: dict[str, tuple[dict[str, Any], float]] = {
    "pendulum": ({"E": 2e7}, 1.25e-3),
    "double_pendulum": ({}, 4e-3),
    "slider_crank": (STEEL, 2e-4),
}
"""Scenes without damping, changed parameters, and steps, s. Softer ones accumulate undamped vibration, until the tip
of the pendulum inverts after 2.5 s.
"""


def _body(b: wf.ModelBuilder, family: str, law: str) -> wf.Body:
    """A body about 1 m long, of a few elements."""
    name, _, integration = family.partition(" ")
    material = LAWS[law]
    if name == "3243":
        line, section = [(0, 0, 0), (1, 0, 0)], wf.Rectangle(0.1, 0.15)
        return b.add_beam(
            line, elements=2, section=section, normal=(0, 0, 1), material=material, integration=integration
        )
    if name == "3443":
        mesh = wf.mesh.grid((1, 0.5), cells=(2, 1))
        return b.add_shell(mesh, thickness=0.1, material=material, integration=integration)
    element = name if name in ("T10", "H3843") else "T4"
    mesh = wf.mesh.box((1, 0.3, 0.2), cells=(CELLS.get(name, 1), 1, 1), element=element)
    if name in ("ENMC", "FN"):
        return b.add_solid(mesh, material=material, element=name)
    return b.add_solid(mesh, material=material)


def tumble(
    family: str, law: str, device: Any = "cpu", dtype: str = "float64", worlds: int = 1, stretch: float = 10.0
) -> wf.Model:
    """A free body that spins at RATE, translates, and stretches at the given rate, 1/s."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = _body(b, family, law)
    spin = RATE * AXIS / np.linalg.norm(AXIS)

    def velocity(X: np.ndarray) -> np.ndarray:
        arm = X - np.array([0.5, 0.1, 0.1])
        return np.cross(spin, arm) + (1.0, -0.5, 0.3) + stretch * arm * (1.0, 0.0, -0.5)

    b.set_initial(body, velocity=velocity)
    return b.finalize(device=device, dtype=dtype, worlds=worlds)


class Conserved:
    """Energy and both momenta of a free body, and their errors.

    Attributes:
        energy, linear, angular: largest errors so far, over the first values.
        strain: largest strain energy, over the energy.
        stretch: largest change of a distance between two nodes, over the distance.
    """

    def __init__(self, sim: wf.Simulation, start: wf.Simulation | None = None) -> None:
        self.sim, (self.body,) = sim, sim.model.bodies
        self.mass = sim.model.mass_matrix()[::3, ::3]
        start = start or sim
        self.first = self._energy(start), *self._momenta(start)
        self.length = self._distances(sim.model.state())
        self.energy = self.linear = self.angular = self.strain = self.stretch = 0.0

    @staticmethod
    def _energy(sim: wf.Simulation) -> float:
        e = sim.energies()
        return float(e["kinetic"][0] + e["strain"][0])

    def _momenta(self, sim: wf.Simulation) -> tuple[np.ndarray, np.ndarray]:
        u, v = (array.numpy()[0].astype(float) for array in (sim.state.displacement, sim.state.velocity))
        p = self.mass @ v
        return p[self.body.slot_kind == 0].sum(axis=0), np.cross(self.body.reference + u, p).sum(axis=0)

    def _distances(self, state: Any) -> np.ndarray:
        place = self.body.reference + state.displacement.numpy()[0].astype(float)
        x = place[self.body.slot_kind == 0]
        i, j = np.triu_indices(len(x), 1)
        return np.linalg.norm(x[i] - x[j], axis=1)

    def measure(self) -> None:
        """Compare the current values with the initial ones."""
        sim, (energy, linear, angular) = self.sim, self.first
        self.energy = max(self.energy, abs(self._energy(sim) - energy) / energy)
        self.strain = max(self.strain, float(sim.energies()["strain"][0]) / energy)
        if sim.steps % EVERY == 0:
            p, L = self._momenta(sim)
            self.linear = max(self.linear, float(np.linalg.norm(p - linear) / np.linalg.norm(linear)))
            self.angular = max(self.angular, float(np.linalg.norm(L - angular) / np.linalg.norm(angular)))
            change = np.abs(self._distances(sim.state) / self.length - 1.0)
            self.stretch = max(self.stretch, float(change.max()))

    def row(self) -> dict[str, Any]:
        """Largest errors, and the energy assigned to the integrator by the ledger."""
        e, size = self.sim.energies(), self.first[0]
        return {
            "energy": self.energy, "linear": self.linear, "angular": self.angular, "strain": self.strain,
            "stretch": self.stretch, "integrator": abs(float(e["integrator"][0])) / size,
            "ledger_residual": abs(float(e["ledger_residual"][0])) / size,
        }  # fmt: skip


def _sim(model: wf.Model, dt: float, **options: Any) -> wf.Simulation:
    solver = wf.NewtonPCG(tol=TOL)
    return wf.Simulation(model, dt=dt, integrator="energy_momentum", solver=solver, record=False, **options)


def _count(steps: int, quick: bool) -> int:
    return steps // QUICK if quick else steps


def free(run: Run, family: str) -> Iterator[Row]:
    """Largest relative errors of energy, momentum and angular momentum over 1e4 steps: each integration and law."""
    for name, law in CASES:
        if name.split()[0] != family:
            continue
        sim = _sim(tumble(name, law, run.device), DT)
        watch, newton, halvings, began = Conserved(sim), [], 0, clock.perf_counter()
        for _ in range(_count(STEPS, run.quick)):
            report = sim.step()
            newton.append(int(report.newton[0]))
            halvings += int(report.halvings[0])
            watch.measure()
        seconds = clock.perf_counter() - began
        row = {"family": name, "law": law, "steps": sim.steps, "dt": sim.dt, **watch.row()}
        row |= {"newton": float(np.mean(newton)), "newton_max": max(newton), "halvings": halvings}
        yield row | {"ms_per_step": 1e3 * seconds / sim.steps}


def constrained(run: Run) -> Iterator[Row]:
    """Energy of mechanisms less the work of their drives, over the largest kinetic and stored energy, 1e4 steps."""
    for name, (_, dt) in MECHANISMS.items():
        sim = _sim(mechanism(name, run.device), dt, constraint_tol=CLOSED)
        first, size, error, violation, halvings, newton = _mechanical(sim), 0.0, 0.0, 0.0, 0, []
        for _ in range(_count(STEPS, run.quick)):
            report = sim.step()
            newton.append(int(report.newton[0]))
            halvings += int(report.halvings[0])
            e = sim.energies()
            size = max(size, float(e["kinetic"][0] + e["strain"][0]))
            error = max(error, abs(_mechanical(sim) - first))
            violation = max(violation, float(report.violation.max()))
        e = sim.energies()
        yield {
            "scene": name, "steps": sim.steps, "dt": dt, "energy": error / size, "violation": violation,
            "integrator": abs(float(e["integrator"][0])) / size,
            "ledger_residual": abs(float(e["ledger_residual"][0])) / size, "newton": float(np.mean(newton)),
            "newton_max": max(newton), "halvings": halvings,
        }  # fmt: skip


def mechanism(name: str, device: Any = "cpu") -> wf.Model:
    """One of MECHANISMS."""
    scene = find(name)
    return scene.build(scene.resolve(MECHANISMS[name][0])).finalize(device=device)


def _mechanical(sim: wf.Simulation) -> float:
    """Energy of a mechanism less the work done on it, J."""
    e = sim.energies()
    work = sum(float(e[name][0]) for name in ("work_loads", "work_supports", "work_joints") if name in e)
    return sum(float(e[name][0]) for name in ("kinetic", "strain", "potential")) - work


def revolutions(run: Run) -> Iterator[Row]:
    """Errors after 1e4 revolutions of two bodies, and the largest of all hundredths of the run since resumed."""
    for family in ("T10", "3243 tied"):
        start = _sim(tumble(family, "svk", run.device), DT)
        sim = _sim(start.model, DT, state=start.model.state())
        watch = Conserved(sim, start)
        step = RATE * DT
        target = _count(round(TURNS * 2.0 * np.pi / step), run.quick)
        kept = run.checkpoint(family)
        if kept and kept.exists():
            sim.resume(kept)
            print(f"    goes on from step {sim.steps} of {kept}", flush=True)
        resumed, part = sim.steps, max(target // 100, 1)
        while sim.steps < target:
            sim.step(min(part, target - sim.steps))
            watch.measure()
            if kept:
                save_checkpoint(sim, kept)
        yield {"family": family, "law": "svk", "steps": sim.steps, "turns": sim.steps * step / (2.0 * np.pi),
               "resumed_at": resumed, **watch.row()}  # fmt: skip
        if kept:
            kept.unlink(missing_ok=True)


FREE = (*SOLIDS, "3243", "3443")
PARTS: dict[str, Part] = {family: partial(free, family=family) for family in FREE}
TABLE = Table(
    about=__doc__,
    parts=PARTS | {"constrained": constrained, "revolutions": revolutions},
    results={"conservation_cpu.json": "conservation --out tests/results/conservation_cpu.json"},
    takes="an hour",
    apart=True,
)
