"""Static equilibrium by load steps, with the residual of a step without inertia (h = 1).

Stabilising springs for bodies before contact is established: k (1 - load) M (u - u at the last equilibrium).
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..base.names import check_choice
from ..base.notebook import drawn_page
from ..base.writer import Output, aborted_on_error, writer_for
from ..model.assembly import element_volumes, require_density
from ..model.contact_points import effective_modulus
from ..model.slot_table import check_static_supports
from ..model.state import State
from ..solvers import NewtonPCG, SolverPlan
from .checks import check_model
from .integrators import INTEGRATORS
from .results import PartMember, Records, Results
from .simulation import Simulation, StepReport
from .stability import Stability, check_stability, report_unstable

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["UNSTABLE_CHOICES", "StaticResult", "begin_static", "run_static", "solve_static"]

UNSTABLE_CHOICES = ("warn", "refuse", "ignore")
"""Treatments of an unstable equilibrium."""
FULL_LOAD_TOL = 1e-9
"""Tolerance of the load factor at full load."""
DEFAULT_STIFFNESS_RATIO = 1e-3
"""Default stiffness, over E / (density size^2) of the stiffest body."""


@dataclass(frozen=True, eq=False, repr=False)
class StaticResult:
    """Static solution.

    Attributes:
        state: State at full load, with time 0: initial state of `Simulation(model, static.state, dt=...)`.
        report: StepReport of the last load step.
        simulation: the completed load step loop: positions, displacements, field, reaction, ...
        newton, pcg: iterations of all load steps, [world].
        stabilise: forces of the `stabilise=` springs at the end of each load step; None without.
        stability: stability of each world, reason if unknown, unstable modes; None with unstable="ignore".
    """

    state: State
    report: StepReport
    simulation: Simulation
    newton: np.ndarray
    pcg: np.ndarray
    stabilise: Springs | None = None
    stability: Stability | None = None
    probe = PartMember("simulation", Records.probe)
    displacements = PartMember("simulation", Results.displacements)
    positions = PartMember("simulation", Results.positions)
    pose = PartMember("simulation", Results.pose)
    reaction = PartMember("simulation", Records.reaction)
    reaction_moment = PartMember("simulation", Records.reaction_moment)
    joint_force = PartMember("simulation", Records.joint_force)
    spring_force = PartMember("simulation", Records.spring_force)
    joint_value = PartMember("simulation", Records.joint_value)
    contact_force = PartMember("simulation", Records.contact_force)
    contact_record = PartMember("simulation", Records.contact_record)
    violation = PartMember("simulation", Records.violation)
    node_gradients = PartMember("simulation", Results.node_gradients)
    field = PartMember("simulation", Results.field)
    sample = PartMember("simulation", Results.sample)

    def __repr__(self) -> str:
        count = f"{self.simulation.steps} load step{'s' * (self.simulation.steps != 1)}"
        stable = f", {self.stability.text}" if self.stability else ""
        return f"StaticResult({count}, {int(self.newton.max())} Newton, {int(self.pcg.max())} PCG iterations{stable})"

    def _repr_html_(self) -> str:
        known = self.simulation.fields
        return drawn_page(self.simulation, [name for name in ("von_mises", "displacement") if name in known])

    def write(self, path: str | os.PathLike[str], *, fields: Sequence[str] = ("von_mises",), **options: Any) -> None:
        """Write the equilibrium to one file.

        Args:
            path: its suffix chooses the writer: .vtu, .usdc, .png, .html, ...
            fields: fields that are written; pictures show the first.
            options: of the writer.

        Raises:
            ModelError, OutputError: see the writer; another suffix.
        """
        writer = writer_for(path, [fields] if isinstance(fields, str) else fields, **options)
        with aborted_on_error(writer):
            for call in (writer.open, writer.write, writer.close):
                call(self.simulation)

    def mode(self, body: Any) -> np.ndarray:
        """Unstable mode (B, nodes, 3) of each world, 0 if none; its largest displacement is 1 m.

        Scaled by a size in m and added to the points of a mesh it is an imperfection.
        """
        if self.stability is None:
            raise ModelError("no stability analysis was done (unstable='ignore')")
        results = self.simulation.results
        results.check_body(body, "mode")
        return results.at_mesh_nodes(body, self.stability.mode)

    def perturbed(self, size: float) -> State:
        """Copy of the state displaced by the unstable mode times a size, m: start of a motion off the equilibrium."""
        if self.stability is None:
            raise ModelError("no stability analysis was done (unstable='ignore')")
        out = self.state.copy()
        u = out.displacement.numpy()
        out.displacement.assign((u + size * self.stability.mode).astype(u.dtype))
        return out


def solve_static(
    model: Model,
    *,
    load_steps: int | str = 10,
    tol: float | None = None,
    solver: NewtonPCG | None = None,
    plan: SolverPlan | None = None,
    state: State | None = None,
    constraint_tol: float | None = None,
    inversion: str = "refuse",
    stabilise: bool | float = False,
    unstable: str = "warn",
    outputs: Sequence[Any] = (),
    progress: bool | None = False,
) -> StaticResult:
    """Find the static equilibrium.

    A pseudo-time runs from 0 to 1 in `load_steps` equal parts. Constant loads, gravity, drives and the initial values
        of controls are scaled by it; laws over time are evaluated at it. A failed load step is halved. Viscosity has no
        effect.

    Args:
        load_steps: number of load steps; "auto": the whole load at once, halved after a rejection.
        tol: relative residual, by default the solver's.
        solver: NewtonPCG options; by default with max_pcg = 20000, for slender bodies.
        plan, constraint_tol, inversion: as for Simulation.
        state: initial state, copied; by default model.state().
        stabilise: stabilise bodies restrained by contact alone, or not at all yet: a spring per mass of (1 - load)
            times this many N/m per kg on each part, from the last equilibrium to the next, none at full load. True:
            1e-3 E / (density size^2) of the stiffest body and the model's size. A smaller value lets a body move
            further per load step and close wider gaps, a larger one retards it. Spring forces:
            `StaticResult.stabilise`.
        unstable: stability analysis at full load (`StepReport.stable`): an unstable equilibrium gives a
            StabilityWarning ("warn") or raises a StabilityError ("refuse"); "ignore": no analysis.
        outputs: writers (PNGWriter, USDWriter, VTUWriter, ...), which get each load step as a state; their time is the
            load fraction, 0 to 1, and pictures are labelled "load 100 %".
        progress: show a bar on stderr; None: if stderr is a terminal.

    Raises:
        ModelError: an unsupported body, gravity or `stabilise` with a material without a density, an explicit contact,
            or an option out of range.
        ConvergenceError: a load step was rejected after all halvings.
        ConstraintError: constraints could not be satisfied.
        StabilityError: an unstable equilibrium with unstable="refuse".
        CapacityError: insufficient device memory.
        OutputError: an output can't be written.
        KeyboardInterrupt: after Ctrl-C with load steps left, once outputs are closed.
    """
    check_choice("unstable", unstable, UNSTABLE_CHOICES)
    options: dict[str, Any] = {"load_steps": load_steps, "tol": tol, "solver": solver, "plan": plan}
    options |= {"state": state, "constraint_tol": constraint_tol, "inversion": inversion, "stabilise": stabilise}
    sim = begin_static(model, **options)
    return run_static(sim, outputs=outputs, progress=progress, unstable=unstable)


def begin_static(
    model: Model,
    *,
    load_steps: int | str = 10,
    tol: float | None = None,
    solver: NewtonPCG | None = None,
    state: State | None = None,
    stabilise: bool | float = False,
    **options: Any,
) -> Simulation:
    """Simulation of `solve_static` before its first load step; ModelError as there. `options`: further ones of
    Simulation."""
    count = 1 if isinstance(load_steps, str) and load_steps == "auto" else load_steps
    if isinstance(count, (bool, str)) or not (isinstance(count, (int, np.integer)) and count >= 1):
        raise ModelError(f"solve_static: load_steps = {load_steps!r} must be a positive whole number, or 'auto'")
    check_model(model)
    if model.terms.dead_loads.has_gravity:
        require_density(model.bodies, "gravity")
    for contact in model.description.contacts:
        if contact.treatment == "explicit":
            raise ModelError(
                f"contact {contact.name!r}: treatment = 'explicit' is for dynamics: use 'implicit' in statics"
            )
    springs = spring_stiffness(model, stabilise)
    if not springs:
        check_static_supports(model)
    if not isinstance(solver, (NewtonPCG, type(None))):
        raise ModelError(f"solve_static: solver = {solver!r} must be wf.NewtonPCG(...): an equilibrium is to be found")
    newton = solver or NewtonPCG(max_pcg=20000, max_newton=50)
    if tol is not None:
        if not (math.isfinite(tol) and 0.0 < tol < 1.0):
            raise ModelError(f"solve_static: tol = {tol!r} must lie between 0 and 1")
        newton = replace(newton, tol=tol)
    start = model.state() if state is None else state.copy()
    model.terms.shift_time(start)
    scheme = replace(INTEGRATORS["static"], stabilise=springs)
    return Simulation(
        model, start, dt=1.0 / count, integrator=scheme, solver=newton, ledger=False, on_failure="raise", **options
    )


def run_static(
    sim: Simulation, *, outputs: Sequence[Any] = (), progress: bool | None = False, unstable: str = "warn"
) -> StaticResult:
    """Run the load steps of a `begin_static` simulation; see `solve_static`."""
    springs = Springs(sim.integrator.stabilise) if sim.integrator.stabilise else None
    sim.run(1.0, outputs=[*outputs, *([springs] if springs else [])], progress=progress)
    assert sim.last is not None
    sim._load = sim.time  # load fraction of later output
    found = None
    if unstable != "ignore" and (sim.time >= 1.0 - FULL_LOAD_TOL).all():
        found = check_stability(sim, every=unstable == "refuse")
        sim.last = replace(sim.last, stable=found.stable)
    sim.model.terms.shift_time(sim.state)  # simulations from the equilibrium start at t = 0
    result = StaticResult(sim.state, sim.last, sim, sim.totals["newton"], sim.totals["pcg"], springs, found)
    if found is not None:
        report_unstable(result, refuse=unstable == "refuse")
    return result


def spring_stiffness(model: Model, stabilise: Any) -> float:
    """Spring stiffness of `solve_static(stabilise=)`, N/m per kg; 0: none. ModelError for a bad value or a missing
    density."""
    if stabilise is False or stabilise is None:
        return 0.0
    good = isinstance(stabilise, (bool, int, float, np.integer, np.floating))
    if not good or not (math.isfinite(stabilise) and stabilise > 0.0):
        raise ModelError(
            f"solve_static: stabilise = {stabilise!r} must be True, False or a positive number, N/m per kg"
        )
    require_density(model.bodies, "stabilise")
    if stabilise is not True:
        return float(stabilise)
    stiffest = max(
        effective_modulus(b)[0] * float(element_volumes(b).sum()) / model.masses.total_of_body(b) for b in model.bodies
    )
    return DEFAULT_STIFFNESS_RATIO * stiffest / model.size**2


class Springs(Output):
    """Forces and energy of the springs, one entry per load step; an output of the run.

    Attributes:
        stiffness: N/m per kg at zero load.
    """

    def __init__(self, stiffness: float) -> None:
        self.stiffness = stiffness
        self._rows: list[tuple[np.ndarray, np.ndarray]] = []

    @property
    def force(self) -> np.ndarray:
        """Resultant on the model, (B, load steps, 3), N; 0 at full load."""
        return np.stack([row[0] for row in self._rows], axis=1)

    @property
    def energy(self) -> np.ndarray:
        """Stored energy (B, load steps), J; 0 at full load."""
        return np.stack([row[1] for row in self._rows], axis=1)

    def __repr__(self) -> str:
        largest = float(np.linalg.norm(self.force, axis=2).max(initial=0.0)) if self._rows else 0.0
        return f"Springs({self.stiffness:.3g} N/m per kg, at most {largest:.3g} N)"

    def write(self, sim: Any) -> None:
        """Record the completed load step."""
        if sim.last is None:
            return
        work = sim.stepper.work
        pull = work.inertia.numpy().astype(float)
        moved = work.v.numpy().astype(float)
        force = -np.einsum("bsc,s->bc", pull, sim.model.slot_table.is_position)
        self._rows.append((force, 0.5 * np.einsum("bsc,bsc->b", pull, moved)))
