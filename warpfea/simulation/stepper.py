"""One step on the device: predict, solve, accept or halve, book the energy, report. Recorded once, then replayed."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.launch import Launcher, labelled
from ..kernels.step.step import LEDGER, LEDGER_ROWS, REPORT, step_kernels
from ..model.state import State
from ..solvers import Jacobi, NewtonPCG, make_loop
from ..terms.workspace import Workspace
from .integrators import Integrator
from .predictor import Predictor

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["Stepper"]

OnCompile = Callable[[int, int, str], None]


class Stepper:
    """The launches of a step of all worlds, and the graph that replays them.

    The host writes `work.step.dt` and reads `work.report`; everything between stays on the device.
    """

    def __init__(
        self,
        model: Model,
        state: State,
        integrator: Integrator,
        solver: NewtonPCG | Jacobi,
        *,
        ledger: bool,
        capture: bool,
        constraint_tol: float = 0.0,
        on_compile: OnCompile | None = None,
    ) -> None:
        self.model, self.state, self.integrator, self.solver = model, state, integrator, solver
        self.ledger, self.on_compile = ledger, on_compile
        self.launch = Launcher(model.device)
        self.kernels = step_kernels(
            model.dtype,
            integrator.coefficients,
            integrator.static,
            integrator.multistep,
            model.loads.nonpotential,
            model.constraints is not None,
        )
        vec3 = model.types.vec3
        state.sealed = False
        if integrator.multistep:
            state.register("previous_displacement", vec3, (model.slots,))
            state.register("previous_velocity", vec3, (model.slots,))
            state.register("previous_step", wp.float64)
            state.register("previous_end", wp.float64)
        if ledger:
            state.register("ledger", wp.float64, (len(LEDGER),))
            state.register("ledger_time", wp.float64)
        state.register("status", wp.int32)
        if model.constraints:
            state.register("constraint_force", wp.float64, (model.constraints.count,))
            state.register("constraint_target", wp.float64, (model.constraints.count,), np.nan)
        self.work = Workspace(model, max_newton=solver.max_newton, ledger=ledger)
        self.newton = make_loop(
            model, self.work, self.launch, solver, inertia=not integrator.static, constraint_tol=constraint_tol
        )
        self.newton.register(state)
        self.predictor: Predictor | None = None
        # single roundings would grow from step to step, and so would what Jacobi's steps leave
        if not integrator.static and model.dtype == "float64" and isinstance(solver, NewtonPCG):
            more = (self.newton.residual.reduce, state, self.kernels.module)
            self.predictor = Predictor(model, self.work, self.launch, *more, multistep=integrator.multistep)
        self.dim = (model.worlds, model.slots)
        self.running = self.work.any_flag[2:3]
        self._bind()
        self._probe_tables = self._upload_probes() if model.probes else []
        state.sealed = True
        self.backup = state.like() if solver.max_halvings > 0 else None
        self._load_modules()
        if model.constraints:
            self.begin_constraints()
        if ledger:
            fresh = ~self.state.ledger.numpy().any(axis=1)
            self.begin_ledger(fresh | (self.state.ledger_time.numpy() != self.state.time.numpy()))
        # a direct solver takes part on the host
        self.graph = self._record() if capture and self.newton.direct is None else None

    def _bind(self) -> None:
        w, state = self.work, self.state
        w.step.time = state.time
        w.step.status = state.status
        w.step.gravity = self.model.loads.gravity
        w.step.any_running = self.running
        w.step.max_halvings = self.solver.max_halvings
        if self.integrator.multistep:
            w.step.previous_h = state.previous_step
            w.step.previous_end = state.previous_end
        if self.ledger:
            w.step.ledger_time = state.ledger_time
        self.u_before = state.previous_displacement if self.integrator.multistep else state.displacement
        self.v_before = state.previous_velocity if self.integrator.multistep else state.velocity

    def begin_constraints(self) -> None:
        """Right sides at the state's time, where the state does not know them, and the violation at the start."""
        m, w, state = self.model, self.work, self.state
        constraints = self.newton.constraints
        assert constraints is not None
        active = wp.ones(m.worlds, dtype=wp.int32, device=m.device)
        w.step.new_time.assign(state.time)
        w.step.ramp.fill_(0.0 if self.integrator.static else 1.0)
        self._laws(active)
        w.u.assign(state.displacement)
        constraints.start(state.constraint_force, state.constraint_target, active)
        constraints.evaluate(active)
        known = state.constraint_target.numpy()
        state.constraint_target.assign(np.where(np.isnan(known), w.multipliers.target.numpy(), known))

    def begin_ledger(self, mask: np.ndarray) -> None:
        """Measure the ledger of the chosen worlds from the present state; what has added up stays."""
        m = self.model
        rows = wp.zeros((1, m.worlds, m.slots), dtype=wp.float64, device=m.device)
        kernel = self.newton.residual.gather.mass_product
        Launcher(m.device)(kernel, self.dim, [m.topology, self.state.velocity, rows])
        u = self.state.displacement.numpy().astype(float)
        fresh = np.zeros((m.worlds, len(LEDGER)))
        fresh[:, 0] = rows.numpy()[0].sum(axis=1)
        fresh[:, 1] = m.strain_energy(self.state)
        fresh[:, 2] = -np.einsum("bc,s,bsc->b", m.loads.gravity_host, m.lumped_host, u)
        ledger = self.state.ledger.numpy()
        ledger[mask, :3] = fresh[mask, :3]
        self.state.ledger.assign(ledger)
        self.state.ledger_time.assign(self.state.time)

    def forget(self, mask: np.ndarray | None = None) -> None:
        """The state of the chosen worlds was set from elsewhere: what follows it on the device is made anew."""
        m = self.model
        flags = np.ones(m.worlds, dtype=np.int32) if mask is None else np.asarray(mask).astype(np.int32)
        self.newton.forget(wp.array(flags, dtype=wp.int32, device=m.device))

    def _record(self) -> wp.Graph:
        with wp.ScopedCapture(device=self.model.device) as capture:
            self.sequence()
        return capture.graph

    def modules(self) -> list[wp.Module]:
        """Modules a step launches, found by recording the launches without doing them."""
        from ..kernels.common.reduce import reduce_kernels
        from ..kernels.common.state import state_kernels

        m = self.model
        out = {self.kernels.module, reduce_kernels().module}
        out |= self.newton.modules()
        out |= {kernel.module for kernel in m.loads.used_kernels()}
        if self.backup is not None:
            out.add(state_kernels().module)
        if not self.integrator.static:
            out |= {b.kernels.viscous_force.module for b in m.blocks if b.key.damping == "explicit"}
            out |= {b.kernels.strain_history.module for b in m.blocks if b.key.damping == "incremental"}
        if m.constraints:
            assert self.newton.constraints is not None
            out |= {m.constraints.kernels.module, self.newton.constraints.deflation.module}
        return sorted(out, key=lambda module: module.name)

    def _load_modules(self) -> None:
        """Compile what a step launches, and what starts the ledger, on several threads; loaded modules cost nothing."""
        from ..kernels.step.gather import gather_kernels

        m = self.model
        modules = {module.name: module for module in self.modules()}
        if self.ledger:
            extra = [b.kernels_for(m.dtype, None).module for b in m.blocks] + [gather_kernels(m.dtype, False).module]
            modules |= {module.name: module for module in extra}
        with ThreadPoolExecutor(min(os.cpu_count() or 1, 4)) as pool:
            load = partial(wp.force_load, m.device, max_workers=0)
            waiting = {pool.submit(load, [module]): name for name, module in modules.items()}
            for done, future in enumerate(as_completed(waiting)):
                self._raise_of(future, waiting[future])
                if self.on_compile:
                    self.on_compile(done + 1, len(waiting), waiting[future])

    @staticmethod
    def _raise_of(future: Future[Any], name: str) -> None:
        """Errors of compilation; those of a user's function as such."""
        try:
            future.result()
        except Exception as error:
            if ".law_" in name or ".field_" in name:
                reason = str(error).strip().splitlines()[-1]
                raise ModelError(
                    f"Warp can't compile a wp.func given as a time law or field ({name.rpartition('.')[2]}): {reason}; "
                    "write it in the precision of its annotations, such as def f(t: wp.float64) -> wp.float64: return "
                    "wp.float64(2.0) * t"
                ) from error
            raise

    def run(self) -> None:
        """Do one step of every running world."""
        if self.graph is not None:
            wp.capture_launch(self.graph)
        else:
            self.sequence()

    # the sequence of launches

    def sequence(self) -> None:
        """All launches of a step."""
        m, w, launch = self.model, self.work, self.launch
        self.running.zero_()
        launch(self.kernels.begin_step, m.worlds, [w.step, w.newton, w.pcg])
        wp.capture_while(self.running, self._attempt)
        self._report()

    @labelled("commit")
    def _report(self) -> None:
        """Undo a failed step, and tell of the step."""
        m, w, launch = self.model, self.work, self.launch
        launch(self.kernels.failed_now, m.worlds, [w.step, w.newton.active])
        if self.backup is not None:
            self.state.copy_rows(launch, w.newton.active, self.backup, skip=("status",))
        self.newton.forget(w.newton.active)
        launch(self.kernels.write_report, m.worlds, [w.step, w.newton, w.pcg, w.report])
        if m.probes:
            self._probe()
        if m.constraints:
            args = [m.constraints.data, w.multipliers, m.constraints.joint_data, self.state.displacement]
            args += [self.state.constraint_force, len(REPORT) + 6 * len(m.probes), w.report]
            launch(m.constraints.kernels.joint_report, (m.worlds, len(m.constraints.joints)), args)

    def _attempt(self) -> None:
        m, w, launch, state = self.model, self.work, self.launch, self.state
        launch(self.kernels.begin_attempt, m.worlds, [w.step, w.newton])
        running = w.step.running
        args = [
            w.step,
            m.is_position,
            m.topology.free,
            state.displacement,
            state.velocity,
            self.u_before,
            self.v_before,
        ]
        launch(self.kernels.predict, self.dim, [*args, w.q_tilde, w.v_tilde, w.v])
        if self.predictor:
            self.predictor.begin()
        self._loads(running)
        self._damping(running)
        constraints = self.newton.constraints
        if constraints:
            constraints.start(state.constraint_force, state.constraint_target, running)
        self.newton.run()
        launch(self.kernels.end_attempt, m.worlds, [w.step, w.newton])
        self.commit()

    @labelled("commit")
    def commit(self) -> None:
        """Take over an accepted attempt."""
        w, launch, state = self.work, self.launch, self.state
        if self.backup is not None:
            # before the first halving the state is still that of the step's start: keep it
            self.backup.copy_rows(launch, w.step.first_refusal, state)
        if self.ledger:
            self._book()
        if self.predictor:
            self.predictor.commit()
        args = [w.step, w.u, w.v, state.displacement, state.velocity, self.u_before, self.v_before]
        launch(self.kernels.commit, self.dim, args)
        if self.newton.constraints:
            self.newton.constraints.commit(state.constraint_force, state.constraint_target, w.step.accepted)
        self.newton.commit(w.step.accepted)

    @labelled("loads")
    def _loads(self, active: wp.array) -> None:
        self._laws(active)
        m, w, launch, loads = self.model, self.work, self.launch, self.model.loads
        k = loads.kernels
        if loads.has_dead:
            args = [loads.dead_start, loads.dead_law, loads.dead_weight, w.law_value, m.lumped, loads.gravity]
            launch(k.dead_load, self.dim, [*args, w.step.ramp, active, w.dead, w.dead_magnitude])
        if loads.moved:
            d = loads.moved
            args = [d.slot, d.law, w.law_value, w.q_tilde, w.step.dq_dv, active, w.v]
            launch(k.drive_displacement, (m.worlds, d.count), args)
        if loads.turned:
            d = loads.turned
            args = [d.slot, d.law, d.components, d.arm, d.axis, w.law_value, w.q_tilde, w.step.dq_dv, active, w.v]
            launch(k.drive_rotation, (m.worlds, d.count), args)

    def _laws(self, active: wp.array) -> None:
        """Values of the time laws at the end of the attempt."""
        m, w, launch, loads = self.model, self.work, self.launch, self.model.loads
        k = loads.kernels
        if loads.law_count:
            launch(
                k.evaluate_laws,
                (m.worlds, loads.law_count),
                [loads.laws, w.step.new_time, w.step.ramp, active, w.law_value],
            )
            for kernel, law in loads.function_laws:
                launch(kernel, m.worlds, [law, w.step.new_time, active, w.law_value])

    @labelled("loads")
    def _damping(self, active: wp.array) -> None:
        m, w, launch, state = self.model, self.work, self.launch, self.state
        if self.integrator.static:
            return
        explicit = any(b.key.damping == "explicit" for b in m.blocks)
        if explicit:
            w.contribution.zero_()  # the gather below sums the entries of all blocks
        for block in m.blocks:
            dim = (m.worlds, block.count)
            if block.key.damping == "incremental":
                args = [block.data, state.displacement, self.u_before, w.step.a0, w.step.a1, active, w.history]
                launch(block.kernels.strain_history, dim, args)
            elif block.key.damping == "explicit":
                args = [block.data, state.displacement, state.velocity, active, w.contribution, w.explicit_power]
                launch(block.kernels.viscous_force, dim, args)
        if explicit:
            gather = self.newton.residual.gather.gather_force
            launch(gather, self.dim, [m.topology, w.contribution, active, w.explicit])
            launch(m.loads.kernels.add_explicit, self.dim, [w.explicit, active, w.dead])

    def _book(self) -> None:
        m, w, launch, state = self.model, self.work, self.launch, self.state
        accepted = w.step.accepted
        reduce = self.newton.residual.reduce
        topo = m.topology
        args = [w.step, topo, w.balance, m.lumped, state.displacement, state.velocity]
        launch(self.kernels.ledger_rows, self.dim, args)
        reduce(w.rows, LEDGER_ROWS, accepted, w.ledger_sums)
        if any(b.key.damping == "explicit" for b in m.blocks):
            args = [w.explicit, w.u, state.displacement, accepted, w.rows]
            launch(m.loads.kernels.work_rows, self.dim, args)
            reduce(w.rows, 1, accepted, w.explicit_work)
        if self.newton.constraints:
            self.newton.constraints.work_terms(state.displacement, state.constraint_target, accepted)
            reduce(w.multipliers.rows, 2, accepted, w.constraint_work)
        args = [w.step, w.newton, w.ledger_sums, w.explicit_work[0], w.constraint_work, state.ledger]
        launch(self.kernels.ledger_update, m.worlds, args)

    def _upload_probes(self) -> list[wp.array]:
        m = self.model
        start = np.concatenate([[0], np.cumsum([len(p.slots) for p in m.probes])])
        slot = np.concatenate([p.body.slot_offset + p.slots for p in m.probes])
        weight = np.concatenate([p.weights for p in m.probes])
        values = ((start, wp.int32), (slot, wp.int32), (weight, m.types.T))
        return [wp.array(a, dtype=dtype, device=m.device) for a, dtype in values]

    def _probe(self) -> None:
        m, w = self.model, self.work
        args = [*self._probe_tables, self.state.displacement, self.state.velocity, len(REPORT), w.report]
        self.launch(self.kernels.probe_values, (m.worlds, len(m.probes)), args)
