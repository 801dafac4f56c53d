"""One step on the device (predict, solve, accept or halve, energy ledger, report), captured as a graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.launch import Launcher, OnCompile, launch_part, load_modules
from ..base.memory import convert_memory_errors
from ..base.worlds import device_flags, set_rows
from ..kernels.step.adaptive import MAX_LEVEL
from ..kernels.step.energy_ledger import LEDGER_TERM_ROWS
from ..kernels.step.step import step_kernels
from ..kernels.step.step_control import REPORT_COLUMNS
from ..model.state import State
from ..solvers import Jacobi, NewtonPCG, make_solver_loop
from ..terms.checks import check_stored_energy, overrides
from ..terms.protocols import Impacting, Preconditioned
from ..terms.term import StepContext, Term
from ..terms.workspace import Workspace
from .adaptive import AdaptiveOptions, StepSizeControl
from .checks import write_times
from .consistent_initial_conditions import ConsistentInitialConditions
from .energy_growth import EnergyGrowth
from .episodes import Episodes
from .integrators import Integrator
from .predictor import Predictor

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["Stepper"]

CANDIDATE_FIRST_ITERATES = (0, 1, 2)
"""Alternative first iterates, see the kernel `alternative_first_iterate`."""


class Stepper:
    """Launches of a step of all worlds, and the graph that replays them.

    The host writes `work.step.dt` and reads `work.report`; everything between stays on the device. `loop`, `episodes`:
    options of `make_solver_loop` and `Episodes`.
    """

    def __init__(
        self, model: Model, state: State, integrator: Integrator, solver: NewtonPCG | Jacobi, *, ledger: bool, capture:
        bool, loop: Mapping[str, Any], adapt: AdaptiveOptions | None = None, episodes: Mapping[str, bool] | None = None,
        growth: EnergyGrowth | None = None, on_compile: OnCompile | None = None,
    ) -> None:  # fmt: skip
        self.model, self.state, self.integrator, self.solver = model, state, integrator, solver
        self.ledger, self.on_compile = ledger, on_compile
        self.launch, self.terms = Launcher(model.device), model.terms
        self.launch.parts |= model.terms.parts
        if integrator.midpoint and isinstance(solver, Jacobi):
            raise ModelError(f"integrator {integrator.name!r} needs Newton's method: solver=NewtonPCG(...), not Jacobi")
        self.kernels = step_kernels(model.dtype, integrator, model.terms.traits)
        state.sealed = False
        model.terms.time_laws.register(state)
        if integrator.multistep or integrator.accelerated:
            for name in integrator.history_arrays:
                state.register(name, model.types.vec3, (model.slots,))
            state.register("previous_step", wp.float64)
            end, initial = ("acceleration_end", np.nan) if integrator.accelerated else ("previous_end", 0.0)
            state.register(end, wp.float64, initial=initial)
        if ledger:
            state.register("ledger", wp.float64, (len(model.terms.ledger),))
            state.register("ledger_time", wp.float64)
        state.register("status", wp.int32)
        state.register("summed_time", wp.float64)
        self.u_before, self.v_before = (getattr(state, name) for name in integrator.history_arrays)
        midpoint, loss = integrator.midpoint, integrator.dissipation
        self.work = Workspace(model, max_newton=solver.max_newton, ledger=ledger, midpoint=midpoint, dissipation=loss)
        self.ctx = StepContext(
            model, self.work, self.launch, state, self.u_before, inertia=not integrator.static,
            midpoint=midpoint, dissipation=loss, accelerated=integrator.accelerated,
        )  # fmt: skip
        self.terms.allocate(self.work, self.ctx)
        self.newton = make_solver_loop(self.ctx, solver, **loop)
        self.newton.register(state)
        if model.terms.traits.unilateral:  # contact energy, which is not evaluated at rest
            state.register("predictor_potential", wp.float64)
            self.work.newton.strain_energy = state.predictor_potential
        self.predictor: Predictor | None = None
        # round-off would accumulate in single precision, and so would the residual of Jacobi steps
        if not integrator.static and model.dtype == "float64" and isinstance(solver, NewtonPCG):
            more = (self.newton.residual.reduce, state, self.kernels.module)
            self.predictor = Predictor(model, self.work, self.launch, *more, scheme=integrator)
        self.dim = (model.worlds, model.slots)
        if not integrator.static and isinstance(solver, NewtonPCG):
            self.newton.first_iterate_candidates = [
                partial(self.launch, *self._candidate_start(kind)) for kind in CANDIDATE_FIRST_ITERATES
            ]
        self.initial_conditions = (
            ConsistentInitialConditions(self.ctx, self.newton.residual, integrator) if integrator.accelerated else None
        )
        flags = self.work.any_flag
        self.running, self.refused, self.failed = flags[2:3], flags[3:4], flags[4:5]
        self.step_size_control: StepSizeControl | None = None
        if adapt:
            tries = solver.max_halvings
            self.step_size_control = StepSizeControl(self.ctx, self.v_before, integrator, adapt, max_tries=tries)
        self._bind_structs()
        self.energy_growth = growth
        if growth:
            growth.bind(self.work.step, model, state)
        self.episodes = Episodes(model, self.work, self.launch, **(episodes or {"asynchronous": False, "ends": False}))
        self._probe_tables = self._upload_probes() if model.description.probes else []
        state.sealed = True
        self.backup = state.copy() if solver.max_halvings > 0 or self.step_size_control else None
        self._load_modules()
        self.start_terms()
        self._evaluate_potential(None)
        self._parameter_updates = self.terms.parameter_updates, model.parameters.version
        self._changes_applied, self._world_updates = model.parameters.changes.copy(), self.terms.world_updates
        if ledger:
            fresh = ~self.state.ledger.numpy().any(axis=1)
            self.restart_ledger(fresh | (self.state.ledger_time.numpy() != self.state.time.numpy()))
        self.graph: wp.Graph | None = None
        if capture and self.newton.direct is None:  # a direct solver runs on the host
            with wp.ScopedCapture(device=model.device) as recorded:
                self.launch_step()
            self.graph = recorded.graph

    def _bind_structs(self) -> None:
        w, state = self.work, self.state
        w.step.time = state.time
        w.step.status, w.step.summed_time = state.status, state.summed_time
        w.step.gravity = self.terms.dead_loads.gravity
        w.step.any_running, w.step.any_rejected = self.running, w.any_flag[3:5]
        w.step.max_halvings = MAX_LEVEL if self.step_size_control else self.solver.max_halvings
        if isinstance(self.solver, NewtonPCG) and not self.step_size_control:
            w.step.newton_budget = self.solver.newton_budget(bool(self.terms.traits.unilateral))
        w.step.stabilisation = self.integrator.stabilise
        w.step.scheme_parameter = self.integrator.parameter
        if self.integrator.takes_velocity:
            w.step.b = w.array("b", (self.model.worlds,), wp.float64)
        if self.integrator.accelerated:
            w.step.q_a = w.array("q_a", (self.model.worlds,), wp.float64)
        midpoint, terms = self.integrator.midpoint, self.terms.having(Impacting)
        self.impact_terms: list[Impacting] = []
        if self.terms.traits.takes_again(self.integrator):
            self.impact_terms = [term for term in terms if (term.plastic if midpoint else term.impacts)]
            w.step.impact = w.array("impact", (self.model.worlds,), wp.int32)
        if self.impact_terms or self.integrator.accelerated:
            w.step.acceleration_step = w.array("h_before", (self.model.worlds,), wp.float64)
        if self.integrator.multistep or self.integrator.accelerated:
            w.step.previous_h = state.previous_step
            w.step.previous_end_time = state.acceleration_end if self.integrator.accelerated else state.previous_end
        if self.ledger:
            w.step.ledger_time = state.ledger_time
            self.increment_table = self.terms.increment_table(w)

    def start_terms(self, mask: np.ndarray | None = None) -> None:
        """Reinitialise terms after the state of the masked worlds was set."""
        following = [term for term in self.terms if overrides(term, Term.start)]
        if not following and self.terms.dead_loads.gravity_law is None:
            return
        w, state = self.work, self.state
        active = self._world_flags(mask)
        w.step.new_time.assign(state.time)
        w.stage_time.assign(state.time)
        w.step.load_factor.fill_(0.0 if self.integrator.static else 1.0)
        self._evaluate_time_laws(active)
        w.u.assign(state.displacement)
        for term in following:
            term.start(self.ctx, active)

    def restart_ledger(self, mask: np.ndarray) -> None:
        """Restart the ledger of the masked worlds at the present state; accumulated columns stay."""
        m = self.model
        columns = list(m.terms.ledger)
        ledger = self.state.ledger.numpy()
        ledger[mask, :3] = self._stored_energies()[mask]
        for term in self.terms:
            measured = term.stored_energy(self.ctx)
            check_stored_energy(term, measured, m.worlds)
            for name, values in measured.items():
                ledger[mask, columns.index(name)] = values[mask]
        self.state.ledger.assign(ledger)
        self.state.ledger_time.assign(self.state.time)

    def _stored_energies(self) -> np.ndarray:
        """Kinetic energy, strain energy and gravity potential of the state, (worlds, 3), J."""
        m = self.model
        rows = wp.zeros((1, m.worlds, m.slots), dtype=wp.float64, device=m.device)
        kernel = self.newton.residual.gather_kernels.kinetic_terms
        Launcher(m.device)(kernel, self.dim, [m.topology, self.state.velocity, rows])
        u = self.state.displacement.numpy().astype(float)
        pull = -np.einsum("bc,bs,bsc->b", m.terms.dead_loads.gravity.numpy(), m.masses.lumped_in_worlds(m.worlds), u)
        return np.stack([rows.numpy()[0].sum(axis=1), m.strain_energy(self.state), pull], axis=1)

    def invalidate(self, mask: np.ndarray | None = None, *, potential: bool = True) -> None:
        """Invalidate solver history of worlds whose state was set externally.

        `potential`: also the stored potential of the state.
        """
        self.newton.invalidate(self._world_flags(mask))
        if potential or "predictor_potential" not in self.state.names:
            self._evaluate_potential(mask)
        chosen = slice(None) if mask is None else np.asarray(mask, dtype=bool)
        self._changes_applied[chosen] = self.model.parameters.changes[chosen]

    def update_parameters(self) -> None:
        """Apply parameters set since the last step; the energy jump counts as work of fields."""
        parameters = self.model.parameters
        updates = self.terms.parameter_updates, parameters.version
        if self._parameter_updates == updates:
            return
        self._parameter_updates = updates
        if self.energy_growth:
            self.energy_growth.restart_changed()
        mask = parameters.changes > self._changes_applied
        if mask.any():
            self.invalidate(mask)
        if self.terms.named("springs"):  # their energy follows from parameters of terms
            mask |= self.terms.world_updates > self._world_updates
        self._world_updates = self.terms.world_updates
        if self.ledger and mask.any():
            before = self.state.ledger.numpy().copy()
            self.restart_ledger(mask)
            ledger = self.state.ledger.numpy()
            ledger[:, list(self.model.terms.ledger).index("work_fields")] += (ledger - before).sum(axis=1)
            self.state.ledger.assign(ledger)

    def finish_device_reset(self, flags: wp.array, *, restart: bool = True) -> None:
        """Complete a device-side reset; terms and ledger already match the state.

        `restart`: also reset scratch, for a state other than the one it belongs to.
        """
        self.newton.invalidate(flags)
        if "predictor_potential" not in self.state.names:
            self._evaluate_potential(flags)
        if restart:
            self.terms.call(self.ctx, Preconditioned, "reset_scratch", flags)

    def _evaluate_potential(self, flags: np.ndarray | wp.array | None) -> None:
        """Evaluate the strain energy of the state in the chosen worlds, for the choice of first iterates."""
        w = self.work
        active: wp.array = flags if isinstance(flags, wp.array) else self._world_flags(flags)
        w.u_stage.assign(self.state.displacement)
        if self.ctx.midpoint:
            w.v_stage.zero_()
        residual = self.newton.residual
        with self.launch.rare():
            residual.elements.force(self.ctx, active)
            residual.reduce(w.energy_rows, 2, active, w.newton.elem_sums)
        measured = w.newton.elem_sums[0]
        if isinstance(flags, wp.array):
            self.episodes.copy_flagged(flags, measured, w.newton.strain_energy)
        else:
            chosen = active.numpy() != 0
            set_rows(w.newton.strain_energy, chosen, measured.numpy()[chosen])

    def _world_flags(self, mask: np.ndarray | None) -> wp.array:
        """Device mask of worlds, by default all."""
        return device_flags(np.ones(self.model.worlds) if mask is None else mask, self.model.device)

    def modules(self) -> list[wp.Module]:
        """Modules launched by a step, found by recording its launches without execution."""
        from ..kernels.common.reduce import reduce_kernels
        from ..kernels.common.state import state_kernels

        out = {self.kernels.module, reduce_kernels().module}
        out |= self.newton.modules() | self.terms.modules(self.ctx)
        if self.backup is not None:
            out.add(state_kernels().module)
        if self.step_size_control:
            out.add(self.step_size_control.kernels.module)
        out |= self.episodes.modules()
        return sorted(out, key=lambda module: module.name)

    def _load_modules(self) -> None:
        """Compile the modules of a step and of the ledger's initialisation."""
        from ..kernels.step.gather import gather_kernels

        m = self.model
        modules = {module.name: module for module in self.modules()}
        if self.ledger:
            extra = [b.kernels_for(m.dtype, None).module for b in m.blocks] + [gather_kernels(m.dtype).module]
            modules |= {module.name: module for module in extra}
        load_modules(modules, m.device, self.on_compile)

    def bytes(self) -> dict[str, int]:
        """Bytes of scratch and of each array of the state and its backup."""
        owners: dict[str, Any] = {"work": self.work, "state": self.state}
        owners |= {"backup": self.backup} if self.backup else {}
        return {f"{label}.{name}": count for label, owner in owners.items() for name, count in owner.bytes.items()}

    def set_dt(self, dt: Any) -> None:
        """Set the step of all worlds, s, or of each [world]."""
        self.dt_of_step = dt
        write_times(self.work.step.dt, dt)

    def run(self) -> None:
        """Take one step in every running world."""
        if self.initial_conditions is not None:
            self.initial_conditions.prepare(self.dt_of_step)
        with convert_memory_errors("a step", self.model.device):
            if self.graph is not None:
                wp.capture_launch(self.graph)
            else:
                self.launch_step()

    # sequence of launches

    def launch_step(self, attempt: Callable[[], None] | None = None) -> None:
        """Launch all kernels of a step; `attempt` in place of `take_attempt`."""
        m, w, launch = self.model, self.work, self.launch
        w.any_flag[2:5].zero_()
        if self.episodes.ends is not None:
            self.episodes.freeze_finished()
        launch(self.kernels.begin_step, m.worlds, [w.step, w.newton, w.pcg])
        if self.step_size_control:
            assert self.backup is not None
            self.backup.copy_rows(launch, w.step.running, self.state)
            self.step_size_control.begin_interval()
        wp.capture_while(self.running, attempt or self.take_attempt)
        if self.step_size_control:
            self.step_size_control.end_interval()
        self._write_report()

    @launch_part("commit")
    def _write_report(self) -> None:
        """Roll back failed worlds; write the step report."""
        m, w, launch = self.model, self.work, self.launch
        with launch.rare():
            wp.capture_if(self.failed, self._restore_failed)
        launch(self.kernels.write_report, m.worlds, [w.step, w.newton, w.pcg, w.report])
        if m.description.probes:
            self._write_probes()
        self.terms.call(self.ctx, Term, "report")
        if self.episodes.in_use:
            self.episodes.end_step()

    @launch_part("commit")
    def _restore_failed(self) -> None:
        """Restore the state of worlds whose step failed."""
        m, w, launch = self.model, self.work, self.launch
        launch(self.kernels.flag_failed_steps, m.worlds, [w.step, w.newton, w.newton.active])
        if self.backup is not None:
            self.state.copy_rows(launch, w.newton.active, self.backup, skip=("status",))
        self.newton.invalidate(w.newton.active)

    @launch_part("commit")
    def _back_up_state(self) -> None:
        """Back up the state, still that of the step's start, before the first halving."""
        assert self.backup is not None
        self.backup.copy_rows(self.launch, self.work.step.first_rejection, self.state)

    def begin_attempt(self) -> None:
        """Evaluate time laws, predict, and begin the terms: all that precedes the solve."""
        m, w, launch, state = self.model, self.work, self.launch, self.state
        launch(self.kernels.begin_attempt, m.worlds, [w.step, w.newton])
        self._evaluate_time_laws(w.step.running)
        args = [w.step, m.slot_table.is_position_array, m.topology.free, state.displacement, state.velocity]
        args += [self.u_before, self.v_before, w.q_tilde, w.v_tilde, w.u, w.v]
        launch(self.kernels.predict, self.dim, args)
        if self.predictor:
            self.predictor.begin()
        if self.terms.supports.in_use:
            self.terms.supports.drive(self.ctx, w.step.running)
        self.terms.call(self.ctx, Term, "begin", w.step.running)

    def take_attempt(self) -> None:
        """Attempt a substep, and accept it where it converges."""
        self.begin_attempt()
        self.newton.run()
        if self.step_size_control:
            self.step_size_control.check_local_error()
        for term in self.impact_terms:
            term.find_impacts(self.ctx)
        self.launch(self.kernels.end_attempt, self.model.worlds, [self.work.step, self.work.newton])
        if self.step_size_control:
            self.step_size_control.finish_attempt()
        self.accept_attempt()

    def _candidate_start(self, kind: int) -> tuple[wp.Kernel, tuple[int, int], list[Any]]:
        """Launch that writes an alternative first iterate to work.v in worlds that choose one."""
        m, w, state = self.model, self.work, self.state
        args = [w.step, w.newton, kind, m.slot_table.is_position_array, m.topology.free]
        args += [state.displacement, state.velocity, w.q_tilde, w.v_tilde, w.v]
        return self.kernels.alternative_first_iterate, self.dim, args

    @launch_part("commit")
    def accept_attempt(self) -> None:
        """Accept a converged attempt."""
        w, launch, state = self.work, self.launch, self.state
        if self.backup is not None:
            with launch.rare():
                wp.capture_if(self.refused, self._back_up_state)
        if self.ledger:
            self._update_ledger()
        if self.predictor:
            self.predictor.update_history()
        args = [w.step, w.newton, w.u, w.v, state.displacement, state.velocity, self.u_before, self.v_before]
        launch(self.kernels.accept_state, self.dim, args)
        self.terms.call(self.ctx, Term, "commit", w.step.accepted)
        self.newton.store_history(w.step.accepted)

    @launch_part("loads")
    def _evaluate_time_laws(self, active: wp.array) -> None:
        """Evaluate the time laws at the end of the attempt."""
        w = self.work
        laws = self.terms.time_laws
        laws.evaluate(self.launch, self.state, w.step.new_time, w.step.load_factor, active, w.time_law_values)
        if self.ctx.midpoint:
            laws.evaluate(self.launch, self.state, w.stage_time, w.step.load_factor, active, w.time_law_stage_values)
        self.terms.dead_loads.take_gravity(self.launch, w.time_law_stage_values, active)

    def law_values(self, time: float) -> np.ndarray:
        """Values of the time laws at a time, s, or load fraction, (B, laws, 3), without changing those of the step."""
        m, w = self.model, self.work
        changed = (w.step.new_time, w.step.load_factor, w.time_law_values, w.step.gravity)
        kept = [(array, array.numpy().copy()) for array in changed]
        w.step.new_time.fill_(time)
        w.step.load_factor.fill_(time if self.integrator.static else 1.0)
        self._evaluate_time_laws(wp.ones(m.worlds, dtype=wp.int32, device=m.device))
        values = w.time_law_values.numpy().copy()
        for array, before in kept:
            array.assign(before)
        return values

    def _update_ledger(self) -> None:
        m, w, launch, state = self.model, self.work, self.launch, self.state
        accepted, reduce, topo = w.step.accepted, self.newton.residual.reduce, m.topology
        args = [w.step, topo, w.balance, m.masses.lumped_values, state.displacement, state.velocity]
        launch(self.kernels.ledger_terms, self.dim, args)
        reduce(w.rows, LEDGER_TERM_ROWS, accepted, w.ledger_sums)
        if self.terms.ledger_terms:
            self.terms.energy_increments(self.ctx, reduce, accepted)
        args = [w.step, w.newton, w.ledger_sums, self.increment_table, state.ledger]
        launch(self.kernels.update_ledger, m.worlds, args)

    def _upload_probes(self) -> list[wp.array]:
        m = self.model
        start = np.concatenate([[0], np.cumsum([len(p.slots) for p in m.description.probes])])
        slot = np.concatenate([p.body.slot_offset + p.slots for p in m.description.probes])
        weight = np.concatenate([p.weights for p in m.description.probes])
        values = ((start, wp.int32), (slot, wp.int32), (weight, m.types.T))
        return [wp.array(a, dtype=dtype, device=m.device) for a, dtype in values]

    def _write_probes(self) -> None:
        m, w = self.model, self.work
        args = [*self._probe_tables, self.state.displacement, self.state.velocity, len(REPORT_COLUMNS), w.report]
        self.launch(self.kernels.probe_values, (m.worlds, len(m.description.probes)), args)
