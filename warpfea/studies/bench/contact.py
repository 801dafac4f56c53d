"""`warpfea bench --contact`: what contact with an obstacle costs in a step.

A block of T10, 1 x 1 x 0.5 m, SVK with E = 1e7 Pa, nu = 0.3, 1000 kg/m^3, under its weight, h = 1 ms. Four scenes, each
beside one without contact:

apart: hung by its upper face, with a floor declared 1 m below its lower one; beside the same without the floor.
resting: let go in exact touch with a floor of mu = 0.5; beside the block whose lower face is clamped.
sliding: at 20 m/s over a floor of mu = 0.3, from 1 s on (reached with h = 10 ms); beside the same.

The simulations of a size take turns, `--steps` steps each, `--repeat` times; the median step counts. Where they end,
single linear solves are counted (contact_solves.py).
"""

from __future__ import annotations

import argparse
import statistics
import time as clock
from dataclasses import asdict, dataclass
from typing import Any

import warp as wp

from ... import mesh as meshes
from ...builder.builder import ModelBuilder
from ...kernels.terms.contact_data import RECORD
from ...materials import SVK
from ...model.shapes import HalfSpace
from ...simulation.simulation import Simulation
from ...terms.contact import Contact
from .contact_solves import SOLVES, SolveRow, solve_rows
from .measure import solver, write

__all__ = ["BARS", "SCENES", "ContactRow", "contact"]

SIZE = (1.0, 1.0, 0.5)
LAW = SVK(E=1e7, nu=0.3, density=1000.0)
WEIGHT = 9.81 * 1000.0 * SIZE[0] * SIZE[1] * SIZE[2]
DT, LONG_DT = 1e-3, 1e-2
SPEED, UNTIL, RUBBING = 20.0, 1.0, 0.3
MOVING = ("sliding", "guided")
STEPS, REPEAT, WARM_UP = 10, 3, 10
BESIDE = {"none": None, "clamped": None, "apart": "none", "resting": "clamped", "sliding": "clamped"}
SCENES = tuple(BESIDE)
BARS = {"apart": {"cpu": 1.3, "cuda": 1.1}, "resting": {"cpu": 2.0, "cuda": 2.0}, "sliding": {"cpu": 3.0, "cuda": 3.0}}
"""Most times the step of the scene beside."""


@dataclass(frozen=True)
class ContactRow:
    """A measurement.

    Attributes:
        scene: of `SCENES`.
        unknowns: free ones.
        points: of contact.
        ms_per_step, newton_per_step, pcg_per_step: medians of times, means of iterations.
        launches: recorded for a step, each loop once.
        bytes: of the model, the workspace and the state.
        ratio: ms over those of the scene beside, or None.
        ratio_per_newton: the same of ms per Newton iteration.
        bar: largest ratio wanted.
        carried: mean normal force over the block's weight.
    """

    scene: str
    dtype: str
    unknowns: int
    points: int
    ms_per_step: float
    newton_per_step: float
    pcg_per_step: float
    halvings: int
    launches: int
    bytes: int
    beside: str | None
    ratio: float | None
    ratio_per_newton: float | None
    bar: float | None
    carried: float


@dataclass
class _Runner:
    sim: Simulation
    term: Contact | None
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
                    column = self.term.report_offset + RECORD.index("normal_force")
                    self.carried += float(self.sim.stepper.work.report.numpy()[0, column]) / WEIGHT


def cells_for(unknowns: int) -> int:
    """Cells along the block's length for a free block of about so many unknowns."""
    return min(range(2, 400), key=lambda n: abs(3 * (2 * n + 1) ** 2 * (2 * (n // 2) + 1) - unknowns))


def build(scene: str, cells: int, stiffness: float = 1.0) -> ModelBuilder:
    """A scene with so many cells along the block's length, and so many times the contact's own stiffness."""
    b = ModelBuilder()
    block = b.add_solid(meshes.box(SIZE, cells=(cells, cells, cells // 2)), material=LAW, element="T10", name="block")
    low = block.surface("z-")
    if scene in ("none", "apart"):
        b.clamp(block.nodes("z+"))
    if scene == "clamped":
        b.clamp(block.nodes("z-"))
    if scene == "guided":
        b.clamp(block.nodes("z-"), components="z")
        b.add_traction(low, (-RUBBING * WEIGHT / (SIZE[0] * SIZE[1]), 0.0, 0.0))
    if scene == "apart":
        b.add_contact(low, b.add_collider(HalfSpace((0, 0, 1), -1.0)), mu=0.5)
    if scene in ("resting", "sliding"):
        mu = 0.5 if scene == "resting" else RUBBING
        b.add_contact(low, b.add_collider(HalfSpace((0, 0, 1), 0.0)), mu=mu, stiffness=stiffness)
    if scene in MOVING:
        b.set_initial(block, velocity=(SPEED, 0.0, 0.0))
    return b


def start(
    scene: str, cells: int, dtype: str, device: Any, tol: float | None, stiffness: float = 1.0
) -> _Runner:  # fmt: skip
    """A scene, stepped to where it counts."""
    model = build(scene, cells, stiffness).finalize(device=device, dtype=dtype)
    term = next((term for term in model.terms if isinstance(term, Contact)), None)
    sim = Simulation(model, dt=DT, solver=solver(tol), ledger=False)
    out = _Runner(sim, term, [])
    if scene in MOVING:
        sim.dt = LONG_DT
        out.step(round(UNTIL / LONG_DT), counted=False)
        sim.dt = DT
    out.step(WARM_UP, counted=False)
    return out


def measure(
    unknowns: int, dtype: str, *, device: Any, steps: int, repeat: int, tol: float | None
) -> tuple[list[ContactRow], list[SolveRow]]:  # fmt: skip
    """Rows of one size and precision, one per scene; and those of single solves."""
    cells = cells_for(unknowns)
    runners = {scene: start(scene, cells, dtype, device, tol) for scene in SCENES}
    for _ in range(repeat):
        for runner in runners.values():
            runner.step(steps)
    kind = "cuda" if runners["none"].sim.model.device.is_cuda else "cpu"
    time = {scene: statistics.median(r.times) for scene, r in runners.items()}
    rows = []
    for scene, r in runners.items():
        other, n = BESIDE[scene], len(r.times)
        ratio = per_newton = None
        if other:
            ratio = time[scene] / time[other]
            per_newton = ratio * max(runners[other].newton, 1) / max(r.newton, 1)
        rows.append(
            ContactRow(
                scene,
                dtype,
                r.sim.model.info()["unknowns"],
                r.term.tables.points if r.term else 0,
                1e3 * time[scene],
                r.newton / n,
                r.pcg / n,
                r.halvings,
                r.sim.stepper.launch.launches,
                sum(r.sim.bytes().values()),
                other,
                ratio,
                per_newton,
                BARS[scene][kind] if scene in BARS else None,
                r.carried / n,
            )
        )
    sims = {(scene, 1.0): runner.sim for scene, runner in runners.items()}
    for scene, stiffness in SOLVES:
        if (scene, stiffness) not in sims:
            sims[scene, stiffness] = start(scene, cells, dtype, device, tol, stiffness).sim
    return rows, solve_rows(sims)


def contact(options: argparse.Namespace) -> None:
    """Do `warpfea bench --contact`: a line per row, and the file after each size."""
    device = wp.get_device(options.device) if options.device else wp.get_preferred_device()
    options.device = str(device)
    sizes = sorted(options.unknowns or [100_000 if device.is_cuda else 10_000])
    steps, repeat = options.steps or STEPS, options.repeat or REPEAT
    dtypes = options.dtype or ["float64"]
    settings = {
        "sizes": sizes, "dtypes": dtypes, "dt": DT, "steps": steps, "repeat": repeat, "tol": options.tol,
        "warm_up_steps": WARM_UP, "time": "median step", "sliding_from_s": UNTIL, "bars": BARS,
    }  # fmt: skip
    rows: list[ContactRow] = []
    solved: list[SolveRow] = []
    for unknowns in sizes:
        for dtype in dtypes:
            found, counted = measure(unknowns, dtype, device=device, steps=steps, repeat=repeat, tol=options.tol)
            rows += found
            solved += counted
            print("\n".join([HEADER, *map(_line, found), SOLVE_HEADER, *map(_solve_line, counted)]), flush=True)
            write(options, settings, rows, solves=list(map(asdict, solved)))


HEADER = (
    f"{'scene':8} {'dtype':8} {'unknowns':>8} {'points':>7} {'ms/step':>9} {'Newton':>6} {'PCG':>6} {'launches':>8} "
    f"{'beside':>8} {'ratio':>6} {'bar':>4} {'per Newton':>10} {'N / m g':>7}"
)
SOLVE_HEADER = (
    f"{'solves':8} {'dtype':8} {'unknowns':>8} {'levels':>7} {'stiffness':>9} {'PCG: most':>9} {'mean':>6} "
    f"{'beside':>8} {'ratio':>6} {'bar':>4}"
)


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _solve_line(r: SolveRow) -> str:
    return (
        f"{r.scene:8} {r.dtype:8} {r.unknowns:8d} {r.levels:7d} {r.stiffness:9g} {max(r.pcg):9d} {r.per_solve:6.1f} "
        f"{r.beside or '-':>8} {_text(r.ratio):>6} {_text(r.bar):>4}"
    )


def _line(r: ContactRow) -> str:
    return (
        f"{r.scene:8} {r.dtype:8} {r.unknowns:8d} {r.points:7d} {r.ms_per_step:9.2f} {r.newton_per_step:6.2f} "
        f"{r.pcg_per_step:6.1f} {r.launches:8d} {r.beside or '-':>8} {_text(r.ratio):>6} {_text(r.bar):>4} "
        f"{_text(r.ratio_per_newton):>10} {r.carried:7.3f}"
    )
