"""Gradients of a run: the adjoint of each step, backwards from the last, for all worlds at once on the device.

The tape keeps displacements, velocities, joint forces and controls of every step. Going back, a stepper of its own
linearises each step at its converged state with the code that advanced it; see solvers/adjoint.py for the solve.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.console import compile_progress_bar, quiet_warp
from ..base.errors import ConvergenceError, ModelError, ModelWarning
from ..base.launch import load_modules
from ..base.memory import convert_memory_errors
from ..base.names import did_you_mean, listing
from ..kernels.step.step_control import STATUS
from ..solvers import NewtonPCG
from ..solvers.adjoint import AdjointSolver
from ..solvers.choice import choose_adjoint_operator
from ..terms.gradients import Gradient, StepAdjoint
from ..terms.protocols import Differentiable
from ..terms.shape_gradients import MESH, MeshGradient
from .initial_adjoint import check_initial_conditions, check_names, step_back_to_initial
from .loss import Loss
from .sensitivities import ForwardSensitivities
from .simulation import Simulation
from .statics import StaticResult
from .stepper import Stepper
from .tape import ProbeArrays, Tape

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["Adjoint", "Gradients", "check_simulation", "check_terms"]

INITIAL = ("initial.displacement", "initial.velocity")
MAX_RESIDUAL = 1e-6
"""Largest relative residual of an adjoint solve: beyond, the gradient of a world is refused."""
MAX_PCG, MAX_WORK = 20_000, 2**30
"""Iterations of a solve, as in statics, and of a step, no limit."""


class Gradients(dict[str, wp.array]):
    """Arrays of derivatives by name.

    Attributes:
        switches: (worlds,) points that came into contact in a step, or left it, began to slip or stuck, summed over the
            steps: there the derivative is that of one side.
    """

    switches: np.ndarray


class Adjoint(Tape):
    """Tape of a run, or of an equilibrium, and its gradients.

    Args:
        sim: a Simulation, or a result of `solve_static`.
        with_respect_to: names of `Model.set_parameter`, "gravity", controls, loads and drives, "initial.displacement",
            "initial.velocity", and "mesh.X", the reference values of all slots.
        tol: relative residual of the adjoint solves, in the D^-1 norm.
        budget, folder: as of `Tape`.

    Attributes:
        residual: (worlds,) largest relative residual of the adjoint solves of the last `backward`.
        growth: (worlds,) norm of the right side of the first step over that of the last, of the last `backward`: how
            much a run amplifies what disturbs its start.
        steps, kept, ends, recomputed: as of `Tape`.

    Raises:
        ModelError: an unknown name, or a term, scheme or precision without an adjoint, by name.
        CapacityError: insufficient device memory.
    """

    def __init__(
        self, sim: Simulation | StaticResult, with_respect_to: Sequence[str], *, tol: float = 1e-10,
        budget: int | None = None, folder: str | os.PathLike[str] | None = None,
    ) -> None:  # fmt: skip
        self.static = isinstance(sim, StaticResult)
        if not isinstance(sim, (Simulation, StaticResult)):
            raise ModelError(f"Adjoint: needs a Simulation or a result of solve_static, got {type(sim).__name__}")
        super().__init__(sim.simulation if isinstance(sim, StaticResult) else sim, budget, folder)
        m = self.model
        if not (isinstance(tol, float) and 0.0 < tol < 1.0):
            raise ModelError(f"Adjoint: tol = {tol!r} must lie between 0 and 1")
        self.names = [with_respect_to] if isinstance(with_respect_to, str) else list(with_respect_to or ())
        if not self.names:
            raise ModelError("Adjoint: with_respect_to names no parameter")
        check_simulation(self.sim, self.static)
        check_terms(m, self.sim.stepper.ctx)
        with convert_memory_errors(f"an adjoint of {m.worlds} worlds", m.device):
            with quiet_warp(), compile_progress_bar(None) as bar:
                self._make_solver(tol, bar)
            self.mesh = MeshGradient(self.stepper.ctx) if MESH in self.names else None
            self.outputs = {name: self._sources(name) for name in self.names}
        check_names(self.stepper.initial_conditions, self.names)
        self.residual = self.growth = np.zeros(m.worlds)
        self._forward: ForwardSensitivities | None = None
        self._sums = {name: self.zeros(self.size_of(name)) for name in self.names}
        self._sums |= {MESH: self.mesh.zeros()} if self.mesh else {}
        if self.static:
            # an equilibrium is the step from it to itself
            self.kept += 2 * [self._snapshot() | {"status": wp.clone(self.sim.state.status)}]
            self.ends = [1]

    def __repr__(self) -> str:
        return f"Adjoint({self.steps} steps of {self.model.worlds} worlds, with respect to {', '.join(self.names)})"

    def _make_solver(self, tol: float, on_compile: Any) -> None:
        m, given = self.model, self.sim.solver
        keys = ("preconditioner", "preconditioner_dtype", "penalty", "operator")
        own = {key: getattr(given, key) for key in keys} if isinstance(given, NewtonPCG) else {}
        if own.get("operator") == "auto":
            own["operator"] = choose_adjoint_operator(m, self.sim.plan, m.device.is_cuda)
        options = NewtonPCG(max_pcg=MAX_PCG, max_work=MAX_WORK, max_halvings=0, **own)
        self.state = m.state()
        self.stepper = s = Stepper(
            m, self.state, self.sim.integrator, options, ledger=False, capture=False,
            loop={"plan": None, "constraint_tol": 1e300, "inversion": "report"}, on_compile=on_compile,
        )  # fmt: skip
        s.predictor = None
        driven: wp.array = wp.array(m.terms.supports.driven(), dtype=m.types.vec3, device=m.device)
        self.solver = a = AdjointSolver(s.newton, s.integrator, driven, tol)
        a.reactions = bool(np.any(m.terms.supports.driven())) or not {INITIAL[0], MESH}.isdisjoint(self.names)
        self.end_velocity = s.work.array("adjoint end velocity", (m.worlds, m.slots), m.types.vec3)
        self.impact = wp.zeros(m.worlds, dtype=wp.int32, device=m.device) if s.impact_terms else None
        self.at = StepAdjoint(s.ctx, a, s.work.z, wp.zeros(m.worlds, dtype=wp.int32, device=m.device))
        of_terms = [module for term in m.terms.having(Differentiable) for module in term.prepare_adjoint(self.at)]
        modules = {module.name: module for module in {*a.modules(), *self._term_modules(), *of_terms}}
        load_modules(modules, m.device, on_compile)

    def _term_modules(self) -> list[wp.Module]:
        elements = self.stepper.newton.residual.elements
        ctx = self.stepper.ctx
        forms = ("incremental", "rate") if ctx.inertia and not ctx.midpoint else ()
        own = [kernel for form in forms for _, kernel in elements.history_kernels(form)]
        return [kernel.module for kernel in own + elements.exact_kernels(ctx)]

    def bytes(self) -> dict[str, int]:
        """Bytes on the device: of the state of a "step", of the "states" at hand, of whole states among them
        ("checkpoints"), and of the "solver"."""
        kept, count = self.kept, sum("displacement" in state for state in list.__iter__(self.kept))
        out = {"step": kept.size, "states": count * kept.size, "checkpoints": len(kept.checkpoints) * kept.whole}
        return out | {"solver": sum(self.stepper.bytes().values())}

    # what is differentiated by

    def _sources(self, name: str) -> list[Callable[[], Gradient]]:
        """Makers of the functions that add the derivative by a parameter; none for initial values."""
        if self.mesh and name == MESH:
            return self.mesh.makers
        ctx, terms, laws = self.stepper.ctx, list(self.model.terms), self.model.terms.time_laws
        found = [known[name] for term in terms if name in (known := term.gradients(ctx))]
        if name in INITIAL and not self.static:
            return found
        for law in laws.indices_of(name):
            given = [term.law_gradient(ctx, law) for term in terms]
            given += self.model.terms.supports.law_gradients(law)
            found += [lambda gradient=gradient: gradient for gradient in given if gradient is not None]
        if not found:
            known = [key for term in terms for key in term.gradients(ctx)]
            known += [MESH, *laws.names, *(() if self.static else INITIAL)]
            hint = did_you_mean(name, known) if isinstance(name, str) else ""
            raise ModelError(f"Adjoint: {name!r} has no derivative; there are: {listing(known)}{hint}")
        return found

    def size_of(self, name: str) -> int:
        """Numbers of a parameter in a world and step."""
        bushings = [f"{b.name}.{field}" for b in self.model.description.bushings for field in ("stiffness", "damping")]
        return 6 if name in bushings else 3 if name == "gravity" else self.model.terms.time_laws.size_of(name)

    # backward

    def backward(self, loss: Any = None) -> Gradients:
        """Derivatives of a loss, each world's own, by name.

        Args:
            loss: of `wf.loss`; None: the derivatives by the probes' arrays are in their `.grad`, from the `backward` of
                Warp's tape or of torch.

        Returns:
            arrays [world] of constants, [world, 3] of gravity, [world, step, size] of controls (of statics [world,
                size]), [world, slot] of initial values and "mesh.X"; NaN in worlds that failed or are frozen, but
                for those at their `t_end`.
            Their `switches`: how often contact changed, where derivatives are one-sided.

        Raises:
            ModelError: no step, parameters that changed since, or no probe, or a loss of none, of these steps.
            ConvergenceError: a residual above 1e-6, in all worlds that run.
        """
        m, a = self.model, self.solver
        self.begin()
        self._take_loss(loss)
        sums, series = self._sums, dict[str, wp.array]()
        for array in sums.values():
            array.zero_()
        for name in (name for name in self.names if name in m.terms.time_laws.controls):
            series[name] = self.zeros(self.steps, self.size_of(name))
        last = np.zeros(m.worlds)
        add_probes = self._probe_commands()
        for k in reversed(range(self.steps)):
            self._add_probes(add_probes, k)
            for name in series:
                sums[name].zero_()
            for part in self.parts(k):
                self._step_back(part, sums)
            for name, array in series.items():
                wp.copy(array[:, k], sums[name])
            if not last.any():
                last = a.control.first_norm.numpy().copy()
        self.growth = a.control.first_norm.numpy() / np.where(last > 0.0, last, np.inf)
        failed = self._check_result()
        out = {name: series.get(name) or wp.clone(array) for name, array in sums.items()}
        out |= {name: wp.clone(a.q_bar if name == INITIAL[0] else a.v_bar) for name in self.names if name in INITIAL}
        found = Gradients({name: self._finished(array, failed) for name, array in out.items()})
        found.switches = self.at.switches.numpy()
        return found

    def begin(self) -> None:
        """Begin to go through the steps kept; ModelError without any, or after a change of parameters."""
        if not self.steps:
            raise ModelError("Adjoint: no step to go back; run(steps) first")
        self._check_parameters()
        m, a = self.model, self.solver
        self.stepper.set_dt(1.0)  # of statics; others follow
        self.stepper.newton.invalidate(wp.ones(m.worlds, dtype=wp.int32, device=m.device))
        a.begin()
        self.at.switches.zero_()
        for term in m.terms.having(Differentiable):
            term.begin_adjoint(self.at)

    def forward(self, direction: Mapping[str, Any]) -> dict[str, ProbeArrays]:
        """Changes of the probes along a change of the parameters of the tape, to first order: J times it.

        Args:
            direction: changes by name, in the shapes of the results of `backward`, or what broadcasts to them; others
                are 0.

        Raises:
            ModelError: an unknown name, or a parameter, term or scheme without sensitivities, by name.
            ConvergenceError: a residual above 1e-6, in all worlds that run.
        """
        if self._forward is None or self._forward.updates != self.updates:
            self._forward = ForwardSensitivities(self)
        found = self._forward.run(direction)
        self._check_result()
        return found

    def _take_loss(self, loss: Any) -> None:
        """Write the derivatives of a loss by the probes' arrays to their `.grad`."""
        arrays = [array for probe in self.probes.values() for array in probe.arrays]
        if not arrays:
            raise ModelError("Adjoint: no probe was taken since the last step: probe(name), and a loss of it")
        if loss is not None:
            if isinstance(loss, Loss) and not any(loss.values is array for array in arrays):
                raise ModelError("Adjoint: the loss is not of this tape's probes, taken since its last step")
            if not callable(getattr(loss, "backward", None)):
                raise ModelError(
                    f"Adjoint: a loss is one of wf.loss or a torch scalar, got {type(loss).__name__}; of others, write "
                    "the derivatives to the probes' .grad, then backward()"
                )
            for array in arrays:
                array.grad.zero_()
            loss.backward()

    def zeros(self, *shape: int) -> wp.array:
        """Zeros [world, ...], float64."""
        return wp.zeros((self.model.worlds, *shape), dtype=wp.float64, device=self.model.device)

    def _step_back(self, part: int, sums: dict[str, wp.array]) -> None:
        self.load(part)
        self._graph = self._graph or self._capture(sums)
        wp.capture_launch(self._graph)
        if part in self.restarts:
            step_back_to_initial(self.stepper, self.at, self.restarts[part], self._gradients, sums)

    def _capture(self, sums: dict[str, wp.array]) -> wp.Graph:
        """Graph of one step back, from the state at its start."""
        gradients = [(make(), sums[name]) for name, makers in self.outputs.items() for make in makers]
        with wp.ScopedCapture(device=self.model.device) as recorded:
            self.linearise()
            for term in self.model.terms.having(Differentiable):
                term.linearise_adjoint(self.at)
            self.solver.solve()
            for term in self.model.terms.having(Differentiable):
                term.add_history_gradient(self.at)
            for add, out in gradients:
                add(self.at, out)
        self._gradients = gradients  # owns the arrays of the graph
        return recorded.graph

    def _finished(self, array: wp.array, failed: np.ndarray) -> wp.array:
        """A result in its shape, NaN in failed worlds."""
        if failed.any():
            host = array.numpy()
            host[failed] = np.nan
            array.assign(host)
        if self.static and array.ndim == 3:
            return array[:, 0]
        return array.reshape((len(failed),)) if array.shape == (len(failed), 1) and array.dtype == wp.float64 else array

    def _check_result(self) -> np.ndarray:
        """Flags of the worlds that failed; ConvergenceError for a residual in others."""
        self.residual = self.solver.control.residual.numpy().copy()
        failed = (self.sim.status != STATUS["running"]) & ~self.ended
        worst = np.where(failed, 0.0, self.residual)
        if not (worst <= MAX_RESIDUAL).all():
            world = int(np.argmax(~(worst <= MAX_RESIDUAL)))
            raise ConvergenceError(
                f"Adjoint: the residual of a solve is {worst[world]:.2g} in world {world}: its tangent is singular or "
                "indefinite, or derivatives of the loss are not finite",
                world=world,
            )
        largest = float(np.max(self.growth, initial=0.0))
        if largest * self.solver.control.tol > math.sqrt(MAX_RESIDUAL):
            warnings.warn(
                f"Adjoint: the gradient grows by {largest:.2g} over {self.steps} steps: the run amplifies errors of "
                "its solves as much",
                ModelWarning,
                stacklevel=3,
            )
        return failed

    def _probe_commands(self) -> list[wp.Launch]:
        """Commands of `_add_probes`; their third argument is the step."""
        a, commands = self.solver, list[wp.Launch]()
        for probe in self.probes.values():
            args = [probe.slot, probe.weight, 0, *(array.grad for array in probe.arrays), a.q_bar, a.v_bar]
            dim = (self.model.worlds, len(probe.slot))
            commands.append(wp.launch(a.kernels.probe_bars, dim, args, device=self.model.device, record_cmd=True))
        return commands

    def _add_probes(self, commands: list[wp.Launch], k: int) -> None:
        """Add the derivatives by the probes at the end of a step."""
        for command in commands:
            command.set_param_at_index(2, k)
            command.launch()
        if self.mesh:
            self.mesh.add_probes(self.stepper.launch, self.probes, k, self.end_of_part(self.ends[k]), self._sums[MESH])

    def load(self, part: int) -> None:
        """The state at the start of a part of a step, with the joint forces and velocities at its end."""
        start, end = self.kept[part], self.end_of_part(part + 1)
        for name, array in start.items():
            into = {"dt": self.stepper.work.step.dt, "impact": self.impact}.get(name) or getattr(self.state, name)
            wp.copy(into, end[name] if name == "constraint_force" else array)
        if self.static:
            self.end_velocity.zero_()
            self.state.time.zero_()
            if "summed_time" in self.state.names:
                self.state.summed_time.zero_()
        else:
            wp.copy(self.end_velocity, end["velocity"])

    def linearise(self) -> None:
        """Evaluate the step at its converged end: forces, D, penalties."""
        s, w = self.stepper, self.stepper.work
        s.launch(s.kernels.begin_step, self.model.worlds, [w.step, w.newton, w.pcg])
        if self.impact:  # which steps were taken again with backward Euler
            wp.copy(w.step.impact, self.impact)
        s.begin_attempt()
        wp.copy(w.v, self.end_velocity)
        newton, running = s.newton, w.newton.active
        newton._clear_direction(running)
        if any(s.ctx.traits._replace(midpoint=False)):
            newton._evaluate_first_iterate(running)
            return
        newton.residual.update_positions(running)  # forces leave nothing that tangents take
        newton.preconditioner.start(running)


def check_simulation(sim: Any, static: bool) -> None:
    """ModelError for a simulation whose steps have no adjoint; `static`: of the result of `solve_static`."""
    scheme = sim.integrator
    check_initial_conditions(sim.model, scheme)
    if scheme.static != static:
        raise ModelError("Adjoint: of statics it takes the result of solve_static")
    if sim.model.dtype != "float64":
        raise ModelError("Adjoint: float32 can't resolve the residual of an adjoint; take dtype='float64'")


def check_terms(model: Model, ctx: Any) -> None:
    """ModelError naming a term that has no adjoint in the steps of a context."""
    for term in model.terms:
        if not isinstance(term, Differentiable):
            raise ModelError(f"Adjoint: {term.name!r} has no adjoint: its term is not Differentiable")
        reason = term.not_differentiable(ctx)
        if reason:
            raise ModelError(f"Adjoint: {term.name!r} has no adjoint for {reason}")
