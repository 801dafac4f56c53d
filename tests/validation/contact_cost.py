"""Cost of contact with an obstacle in a step, and in single linear solves.

A block of T10, 1 x 1 x 0.5 m, SVK with E = 1e7 Pa, nu = 0.3, 1000 kg/m^3, under its weight, h = 1 ms. Four scenes, each
beside one without contact:

apart: hung by its upper face, with a floor declared 1 m below its lower one; beside the same without the floor.
resting: let go in exact touch with a floor of mu = 0.5; beside the block whose lower face is clamped.
sliding: at 20 m/s over a floor of mu = 0.3, from 1 s on (reached with h = 10 ms); beside the same.

The simulations of a size take turns, `steps` steps each, `repeat` times; the median step counts, and means of
iterations. Columns of the rows: unknowns: free ones. points: of contact. launches: recorded for a step, each loop once.
bytes: of the model, the workspace and the state. ratio: ms over those of the scene beside; ratio_per_newton: of ms per
Newton iteration; bar: largest ratio wanted. carried: mean normal force over the block's weight.

solves: iterations of single linear solves where they end, beside those of the same body with its contact nodes clamped:
at the iterates of `SOLVED` steps, solves to 1e-8 of their right side with H and the two-level preconditioner of that
very iterate. resting stands beside the block with its lower face clamped; sliding beside the block whose lower face is
held along the normal, pulled by the friction of its weight. Each with the contact's own stiffness and with 100 times
that, where a preconditioner that did not know of it would need 2 to 3 times the iterations. stiffness: over the
contact's own; pcg: of each solve, per_solve their mean; levels: of the preconditioner; ratio: mean over that of the
scene beside.
"""

from __future__ import annotations

import statistics
import time as clock
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import warp as wp
from warpfea.kernels.contact.structs import RECORD_NAMES

import warpfea as wf
from warpfea.base.devices import find_device
from warpfea.contact.colliders import ColliderContact
from warpfea.simulation.simulation import Simulation
from warpfea.solvers.twolevel import TwoLevel
from warpfea.studies.bench.measure import solver

from .table import Row, Run, Table

__all__ = ["BESIDE", "SOLVES", "TABLE", "count_solves", "solve_rows", "start"]

SIZE = (1.0, 1.0, 0.5)
LAW = wf.SVK(E=1e7, nu=0.3, density=1000.0)
WEIGHT = 9.81 * 1000.0 * SIZE[0] * SIZE[1] * SIZE[2]
DT, LONG_DT = 1e-3, 1e-2
SPEED, UNTIL, RUBBING = 20.0, 1.0, 0.3
MOVING = ("sliding", "guided")
WARM_UP, FORCING, SOLVED = 10, 1e-8, 3
SCENES = {"none": None, "clamped": None, "apart": "none", "resting": "clamped", "sliding": "clamped"}
"""Scene -> the one beside."""
BARS = {"apart": {"cpu": 1.3, "cuda": 1.1}, "resting": {"cpu": 2.0, "cuda": 2.0}, "sliding": {"cpu": 3.0, "cuda": 3.0}}
"""Most times the step of the scene beside."""
BESIDE = {"resting": "clamped", "sliding": "guided"}
SOLVES = [("clamped", 1.0), ("guided", 1.0), *((scene, stiffness) for scene in BESIDE for stiffness in (1.0, 100.0))]
"""Scenes of single solves, and the contact's stiffness over its own."""
SOLVE_BAR = 1.3


@dataclass
class _Runner:
    sim: Simulation
    term: ColliderContact | None
    times: list[float]
    carried: float = 0.0
    newton: int = 0
    pcg: int = 0
    halvings: int = 0

    def step(self, count: int, *, counted: bool = True) -> None:
        for _ in range(count):
            start = clock.perf_counter()
            report = self.sim.step()  # reads its report, and so waits for the device
            if counted:
                self.times.append(clock.perf_counter() - start)
                self.newton += int(report.newton[0])
                self.pcg += int(report.pcg[0])
                self.halvings += int(report.halvings[0])
                if self.term is not None:
                    column = self.term.report_offset + RECORD_NAMES.index("normal_force")
                    self.carried += float(self.sim.stepper.work.report.numpy()[0, column]) / WEIGHT


def cells_for(unknowns: int) -> int:
    """Cells along the block's length for a free block of about so many unknowns."""
    return min(range(2, 400), key=lambda n: abs(3 * (2 * n + 1) ** 2 * (2 * (n // 2) + 1) - unknowns))


def build(scene: str, cells: int, stiffness: float = 1.0) -> wf.ModelBuilder:
    """A scene with so many cells along the block's length, and so many times the contact's own stiffness."""
    b = wf.ModelBuilder()
    block = b.add_solid(wf.mesh.box(SIZE, cells=(cells, cells, cells // 2)), material=LAW, element="T10", name="block")
    low = block.surface("z-")
    if scene in ("none", "apart"):
        b.clamp(block.nodes("z+"))
    if scene == "clamped":
        b.clamp(block.nodes("z-"))
    if scene == "guided":
        b.clamp(block.nodes("z-"), components="z")
        b.add_traction(low, (-RUBBING * WEIGHT / (SIZE[0] * SIZE[1]), 0.0, 0.0))
    if scene == "apart":
        b.add_contact(low, b.add_collider(wf.HalfSpace((0, 0, 1), -1.0)), mu=0.5)
    if scene in ("resting", "sliding"):
        mu = 0.5 if scene == "resting" else RUBBING
        b.add_contact(
            low, b.add_collider(wf.HalfSpace((0, 0, 1), 0.0)), mu=mu, restitution=1.0, stiffness=("region", stiffness)
        )
    if scene in MOVING:
        b.set_initial(block, velocity=(SPEED, 0.0, 0.0))
    return b


def start(
    scene: str, cells: int, dtype: str, device: Any, tol: float | None, stiffness: float = 1.0
) -> _Runner:  # fmt: skip
    """A scene, stepped to where it counts."""
    model = build(scene, cells, stiffness).finalize(device=device, dtype=dtype)
    term = next((term for term in model.terms if isinstance(term, ColliderContact)), None)
    sim = Simulation(model, dt=DT, solver=solver(tol), ledger=False)
    out = _Runner(sim, term, [])
    if scene in MOVING:
        sim.dt = LONG_DT
        out.step(round(UNTIL / LONG_DT), counted=False)
        sim.dt = DT
    out.step(WARM_UP, counted=False)
    return out


def count_solves(sim: Simulation, steps: int) -> list[int]:
    """Iterations of each linear solve of so many steps, with matrix and preconditioner of that very iterate."""
    loop, work = sim.stepper.newton, sim.stepper.work
    solve, counts, preconditioner = loop.pcg.solve, [], loop.preconditioner
    assert isinstance(preconditioner, TwoLevel)

    def anew(active: wp.array) -> None:
        loop.residual.assemble_matrix(active)
        preconditioner.start(active, rebuild=True)
        solve(active)
        counts.append(int(work.pcg.iterations.numpy()[0]))

    loop.pcg.solve = anew  # type: ignore[method-assign]
    sim.step(steps)
    return counts


def solves(before: Simulation) -> tuple[list[int], int]:
    """Iterations of each linear solve of the steps after those of a simulation, and levels of the preconditioner."""
    options = solver(None, forcing=FORCING, preconditioner="two-level")
    sim = Simulation(before.model, before.state, dt=before.dt, solver=options, ledger=False, capture=False)
    counts, preconditioner = count_solves(sim, SOLVED), sim.stepper.newton.preconditioner
    assert isinstance(preconditioner, TwoLevel)
    return counts, len(preconditioner.levels)


def solve_rows(sims: dict[tuple[str, float], Simulation]) -> list[Row]:
    """Rows of `SOLVES`, which go on from where these simulations are."""
    found = {key: solves(sims[key]) for key in SOLVES}
    mean = {key: statistics.fmean(counts) for key, (counts, _) in found.items()}
    out = []
    for (scene, stiffness), (counts, levels) in found.items():
        model, own, beside = sims[scene, stiffness].model, mean[scene, stiffness], BESIDE.get(scene)
        row = {"scene": scene, "dtype": model.dtype, "unknowns": model.info()["unknowns"], "levels": levels}
        row |= {"stiffness": stiffness, "pcg": counts, "per_solve": own, "beside": beside}
        row["ratio"] = own / mean[beside, 1.0] if beside else None
        out.append(row | {"bar": SOLVE_BAR if beside else None})
    return out


def step_rows(runners: dict[str, _Runner]) -> Iterator[Row]:
    """A row per scene."""
    kind = "cuda" if runners["none"].sim.model.device.is_cuda else "cpu"
    time = {scene: statistics.median(r.times) for scene, r in runners.items()}
    for scene, r in runners.items():
        beside, n = SCENES[scene], len(r.times)
        ratio = time[scene] / time[beside] if beside else None
        per_newton = ratio * max(runners[beside].newton, 1) / max(r.newton, 1) if beside and ratio else None
        yield {
            "scene": scene, "dtype": r.sim.model.dtype, "unknowns": r.sim.model.info()["unknowns"],
            "points": r.term.tables.points if r.term else 0, "ms_per_step": 1e3 * time[scene],
            "newton_per_step": r.newton / n, "pcg_per_step": r.pcg / n, "halvings": r.halvings,
            "launches": r.sim.stepper.launch.launches, "bytes": sum(r.sim.bytes().values()), "beside": beside,
            "ratio": ratio, "ratio_per_newton": per_newton, "bar": BARS[scene][kind] if scene in BARS else None,
            "carried": r.carried / n,
        }  # fmt: skip


def rows(run: Run) -> Iterator[Row]:
    """Steps: rows of each size and precision; single solves are counted after them."""
    device, given, counted = find_device(run.device), run.options, []
    for unknowns in sorted(n or (100_000 if device.is_cuda else 10_000) for n in given["sizes"]):
        for dtype in given["dtypes"]:
            cells, tol = cells_for(unknowns), given["tol"] or None
            runners = {scene: start(scene, cells, dtype, device, tol) for scene in SCENES}
            for _ in range(given["repeat"]):
                for runner in runners.values():
                    runner.step(given["steps"])
            yield from step_rows(runners)
            sims = {(scene, 1.0): runner.sim for scene, runner in runners.items()}
            for scene, stiffness in SOLVES:
                if (scene, stiffness) not in sims:
                    sims[scene, stiffness] = start(scene, cells, dtype, device, tol, stiffness).sim
            counted += solve_rows(sims)
    run.made["solves"] = counted


def after_rows(run: Run) -> list[Row]:
    """Iterations of single linear solves, counted where the steps of `rows` end."""
    return list(run.made["solves"])


TABLE = Table(
    about=__doc__,
    parts={"rows": rows, "solves": after_rows},
    results={
        "contact_cpu.json": "contact_cost --set sizes=10000,100000 --out tests/results/contact_cpu.json",
        "contact_h200.json": "contact_cost --device cuda:0 --out tests/results/contact_h200.json",
    },
    options={"sizes": (0,), "dtypes": ("float64",), "steps": 10, "repeat": 3, "tol": 0.0},
    settings={
        "dt": DT,
        "warm_up_steps": WARM_UP, "time": "median step", "sliding_from_s": UNTIL, "bars": BARS,
    },
    columns=("scene", "dtype", "unknowns", "points", "ms_per_step", "newton_per_step", "pcg_per_step", "launches",
             "stiffness", "per_solve", "ratio", "bar", "carried"),
)  # fmt: skip
