"""Static equilibrium by load steps, with the residual of a step without inertia (h = 1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..model.assembly import require_density
from ..model.state import State
from ..model.topology import check_static_supports
from ..solvers import NewtonPCG
from .checks import check_choice, check_model
from .integrators import INTEGRATORS
from .simulation import Simulation, StepReport
from .stabilise import Springs, spring_stiffness
from .stability import Stability, announce, judge_stability

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["UNSTABLE", "StaticResult", "begin_static", "run_static", "solve_static"]

UNSTABLE = ("warn", "refuse", "ignore")
"""What to do about an unstable equilibrium."""
FULL = 1e-9
"""Part of the load that may lack where all of it counts as acting."""


@dataclass(frozen=True, eq=False, repr=False)
class StaticResult:
    """A static solution.

    Attributes:
        state: State at full load, with time 0: `Simulation(model, static.state, dt=...)` goes on from it.
        report: StepReport of the last load step.
        simulation: the loop that found it: positions, displacements, field, reaction, ...
        newton, pcg: iterations of all load steps, [world].
        stabilise: what the springs of `stabilise=` carried at the end of each load step; None without.
        stability: whether each world is stable, why that can't be known, unstable modes; None with unstable="ignore".
    """

    state: State
    report: StepReport
    simulation: Simulation
    newton: np.ndarray
    pcg: np.ndarray
    stabilise: Springs | None = None
    stability: Stability | None = None

    def __repr__(self) -> str:
        count = f"{self.simulation.steps} load step{'s' * (self.simulation.steps != 1)}"
        stable = f", {self.stability.text}" if self.stability else ""
        return f"StaticResult({count}, {int(self.newton.max())} Newton, {int(self.pcg.max())} PCG iterations{stable})"

    def mode(self, body: Any) -> np.ndarray:
        """(B, nodes, 3) unstable mode of each world, 0 where there is none; its largest displacement is 1 m.

        Added to the points of a mesh, times a size in m, it is an imperfection.
        """
        if self.stability is None:
            raise ModelError("solve_static(unstable='ignore') has looked for no unstable mode")
        self.simulation.check_body(body, "mode")
        return self.simulation._rows(body, self.stability.mode)

    def perturbed(self, size: float) -> State:
        """A copy of the state, moved by the unstable mode times a size, m: where a motion leads off the equilibrium."""
        if self.stability is None:
            raise ModelError("solve_static(unstable='ignore') has looked for no unstable mode")
        out = self.state.like()
        u = out.displacement.numpy()
        out.displacement.assign((u + size * self.stability.mode).astype(u.dtype))
        return out

    def probe(self, name: str) -> Any:
        """The probe `name`, with one entry per load step; the last is at full load."""
        return self.simulation.probe(name)

    def displacements(self, body: Any) -> np.ndarray:
        """(B, nodes, 3) m."""
        return self.simulation.displacements(body)

    def positions(self, body: Any) -> np.ndarray:
        """(B, nodes, 3) m."""
        return self.simulation.positions(body)

    def reaction(self, nodes: Any) -> np.ndarray:
        """Force of the supports, (B, 3), N."""
        return self.simulation.reaction(nodes)

    def joint_force(self, joint: Any) -> np.ndarray:
        """Force and moment of a joint on its child, (B, 6), N and N m."""
        return self.simulation.joint_force(joint)

    def contact_force(self, contact: Any) -> np.ndarray:
        """Force and moment about the origin of a contact on its body, (B, 6), N and N m."""
        return self.simulation.contact_force(contact)

    def violation(self, joint: Any) -> np.ndarray:
        """Largest violation of a joint, (B,), m."""
        return self.simulation.violation(joint)

    def node_gradients(self, body: Any) -> np.ndarray:
        """(B, nodes, 3, 3) deformation gradient at the nodes of a body with gradient slots."""
        return self.simulation.node_gradients(body)

    def field(self, name: str, body: Any) -> np.ndarray:
        """(B, nodes) scalars."""
        return self.simulation.field(name, body)


def solve_static(
    model: Model,
    *,
    load_steps: int | str = 10,
    tol: float | None = None,
    solver: NewtonPCG | None = None,
    state: State | None = None,
    constraint_tol: float | None = None,
    inversion: str = "refuse",
    stabilise: bool | float = False,
    unstable: str = "warn",
    outputs: Sequence[Any] = (),
    progress: bool | None = False,
) -> StaticResult:
    """Find the static equilibrium.

    A pseudo-time runs from 0 to 1 in `load_steps` equal parts. Constant loads, gravity and drives grow in proportion to
    it, and so do the values of controls that the start has; laws over time are taken at it. A load step that fails is
    halved. Viscosity plays no part.

    Args:
        load_steps: number of load steps; "auto": the whole load at once, halved where it is refused.
        tol: relative residual, by default the solver's.
        solver: NewtonPCG options; by default with room for slender bodies, max_pcg = 20000.
        constraint_tol, inversion: as of Simulation.
        state: start; by default model.state(). It is copied.
        stabilise: hold bodies that only contact, or nothing yet, holds: each part of them by a spring per mass of
            (1 - load) times this many N/m per kg, from the last equilibrium to the next, and none at full load. True:
            1e-3 E / (density size^2) of the stiffest body and the model's size. A smaller value moves a body further in
            a load step and closes wider gaps, a larger one lets it lag. `StaticResult.stabilise` tells what the
            springs carried.
        unstable: whether the equilibrium at full load is stable is judged (`StepReport.stable`), and of one that is not
            a StabilityWarning is given ("warn") or a StabilityError raised ("refuse"); "ignore": it is not judged.
        outputs: writers (PNGWriter, USDWriter, VTUWriter, ...), which get each load step as a state; what they say of
            time is the part of the load, 0 to 1, and pictures are labelled "load 100 %".
        progress: show a bar on stderr; None: when stderr is a terminal.

    Raises:
        ModelError: a body is not supported, gravity or `stabilise` meets a material without a density, a contact is
            explicit, or an option is out of range.
        ConvergenceError: a load step was not accepted after all halvings.
        ConstraintError: the same, and it is the constraints that can't be satisfied.
        StabilityError: the equilibrium is unstable, with unstable="refuse".
        CapacityError: the device has too little memory.
        OutputError: an output can't be written.
        KeyboardInterrupt: after Ctrl-C with load steps left, once outputs are closed.
    """
    check_choice("unstable", unstable, *UNSTABLE)
    options: dict[str, Any] = {"load_steps": load_steps, "tol": tol, "solver": solver, "state": state}
    options |= {"constraint_tol": constraint_tol, "inversion": inversion, "stabilise": stabilise}
    sim = begin_static(model, **options)
    return run_static(sim, outputs=outputs, progress=progress, unstable=unstable)


def begin_static(
    model: Model,
    *,
    load_steps: int | str = 10,
    tol: float | None = None,
    solver: NewtonPCG | None = None,
    state: State | None = None,
    constraint_tol: float | None = None,
    inversion: str = "refuse",
    stabilise: bool | float = False,
    on_compile: Callable[[int, int, str], None] | None = None,
) -> Simulation:
    """The loop of `solve_static` before its first load step; ModelError as there. `on_compile` as of Simulation."""
    count = 1 if isinstance(load_steps, str) and load_steps == "auto" else load_steps
    if isinstance(count, (bool, str)) or not (isinstance(count, (int, np.integer)) and count >= 1):
        raise ModelError(f"solve_static: load_steps = {load_steps!r} must be a positive whole number, or 'auto'")
    check_model(model)
    if model.terms.dead.pulls:
        require_density(model.bodies, "gravity")
    for contact in model.description.all_contacts:
        if contact.treatment == "explicit":
            raise ModelError(
                f"contact {contact.name!r}: treatment = 'explicit' takes the force of the last state, which is no "
                "equilibrium; take 'implicit' for statics"
            )
    springs = spring_stiffness(model, stabilise)
    if not springs:
        check_static_supports(model)
    if not isinstance(solver, (NewtonPCG, type(None))):
        raise ModelError(f"solve_static: solver = {solver!r} must be wf.NewtonPCG(...): an equilibrium is to be found")
    options = solver or NewtonPCG(max_pcg=20000, max_newton=50)
    if tol is not None:
        if not (math.isfinite(tol) and 0.0 < tol < 1.0):
            raise ModelError(f"solve_static: tol = {tol!r} must lie between 0 and 1")
        options = replace(options, tol=tol)
    start = model.state() if state is None else state.like()
    model.terms.rewind(start)
    scheme = replace(INTEGRATORS["static"], stabilise=springs)
    return Simulation(
        model, start, dt=1.0 / count, integrator=scheme, solver=options, ledger=False,
        on_failure="raise", constraint_tol=constraint_tol, inversion=inversion, on_compile=on_compile,
    )  # fmt: skip


def run_static(
    sim: Simulation, *, outputs: Sequence[Any] = (), progress: bool | None = False, unstable: str = "warn"
) -> StaticResult:
    """Do the load steps of a simulation made by `begin_static`; see `solve_static`."""
    springs = Springs(sim.integrator.stabilise) if sim.integrator.stabilise else None
    sim.run(1.0, outputs=[*outputs, *([springs] if springs else [])], progress=progress)
    assert sim.last is not None
    sim._load = sim.time  # what is drawn of it later is at this load
    found = None
    if unstable != "ignore" and (sim.time >= 1.0 - FULL).all():
        found = judge_stability(sim, every=unstable == "refuse")
        sim.last = replace(sim.last, stable=found.stable)
    sim.model.terms.rewind(sim.state)  # what starts from the equilibrium starts at t = 0
    result = StaticResult(sim.state, sim.last, sim, sim.totals["newton"], sim.totals["pcg"], springs, found)
    if found is not None:
        announce(result, refuse=unstable == "refuse")
    return result
