"""Simulation: the step loop as users drive it."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import solvers
from ..base.console import compile_bar, quiet_warp
from ..base.errors import ConstraintError, ConvergenceError, ModelError
from ..base.memory import enough_memory
from ..kernels.step.control import REPORT, STATUS
from ..model.assembly import require_density
from ..model.handles import NodeSet
from ..model.state import State
from ..solvers import Jacobi, NewtonPCG
from . import integrators
from .adaptive import adapt_of
from .checks import check_choice, check_constraint_tol, check_dt, check_model, check_state, check_steps
from .controls import Controls
from .failures import check_closed, step_error
from .records import Records
from .reports import ContactRecord, JointRecord, ProbeRecord, StepReport, describe, idle_report
from .run_loop import run_steps
from .stepper import Stepper

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["ContactRecord", "JointRecord", "ProbeRecord", "Simulation", "StepReport"]


class Simulation(Records):
    """Steps a model through time.

    Args:
        model: from ModelBuilder.finalize.
        state: where it starts; by default model.state(). It is advanced in place.
        dt: step, s, which may be set later; or "auto": each world takes the steps that keep its error to `error`, and
            all meet at common instants, to which `step` goes.
        error: of dt="auto": largest error of a position at the end, over the model's size (`model.size`).
        interval: of dt="auto": s between common instants at most; they are multiples of it, times of outputs, kinks of
            time laws and the ends of runs. None: a 64th of the first run, 1/60 s of steps without one.
        horizon: of dt="auto": s over which the error may build up. None: the first run, or 64 intervals.
        integrator: "backward_euler", "bdf2", "energy_momentum", or wf.GeneralizedAlpha(rho_inf=0.5), as a text
            "generalized_alpha(rho_inf=0.5)".
        solver: "newton-pcg", "jacobi" or "direct", or options: wf.NewtonPCG(...), wf.Jacobi(...).
        constraint_tol: largest violation of a constraint, over the model's size (`model.size`); by default 1e-8 in
            float64, 1e-5 in float32.
        ledger: keep the energy ledger.
        record: keep what probes and joints tell of every step, else of the last alone.
        capture: record a step as one graph, on the GPU and on the CPU; never done with linear="direct".
        on_compile: called with (modules ready, modules in all, name) while kernels compile; by default a bar on stderr
            where that is a terminal. Warp's own lines about modules are not shown, unless its log level was lowered.
        on_failure: "raise" ConvergenceError, or "freeze" the failed worlds; by default raise with one world, and with
            several only once all have failed.
        inversion: a step that turns an element inside out, J <= 0 at a quadrature point where J was positive, is
            refused ("refuse"), or passes where the law allows it ("report": StepReport.min_J tells).

    Attributes:
        controls: what the caller writes between steps, see Controls.

    Raises:
        ModelError: dt or an option out of range, or a material without a density.
        ConstraintError: joints that are open at the start.
        CapacityError: the device has too little memory.
    """

    def __init__(
        self,
        model: Model,
        state: State | None = None,
        *,
        dt: float | str,
        error: float | None = None,
        interval: float | None = None,
        horizon: float | None = None,
        integrator: str | integrators.Integrator = "backward_euler",
        solver: NewtonPCG | Jacobi | str | None = None,
        constraint_tol: float | None = None,
        ledger: bool = True,
        record: bool = True,
        capture: bool = True,
        on_failure: str | None = None,
        inversion: str = "refuse",
        on_compile: Callable[[int, int, str], None] | None = None,
    ) -> None:
        scheme, options = integrators.get(integrator), solvers.get(solver)
        check_model(model)
        if not scheme.static:
            require_density(model.bodies, "motion")
        check_choice("inversion", inversion, "refuse", "report")
        if on_failure is not None:
            check_choice("on_failure", on_failure, "raise", "freeze")
        given = {"error": error, "interval": interval, "horizon": horizon}
        adapt = adapt_of(dt, **given, model=model, scheme=scheme, solver=options)
        if adapt is None:
            check_dt(dt)
        if constraint_tol is None:
            constraint_tol = {"float64": 1e-8, "float32": 1e-5}[model.dtype]
        check_constraint_tol(constraint_tol)

        self.model = model
        self.state = model.state() if state is None else state
        check_state(model, self.state)
        self.integrator, self.solver = scheme, options
        self.on_failure, self.record = on_failure, record
        began = clock.perf_counter()
        room = enough_memory(f"a simulation of {model.worlds} worlds", model.device)
        with quiet_warp(), room, compile_bar(None if on_compile is None else False) as bar:
            self.stepper = Stepper(
                model, self.state, scheme, options,
                ledger=ledger, capture=capture, constraint_tol=constraint_tol * model.size, inversion=inversion,
                adapt=adapt, on_compile=on_compile or bar,
            )  # fmt: skip
        model.parameters.begun = True
        self.controls = Controls(model, self.state)
        self.compile_s = clock.perf_counter() - began
        self.error = adapt.error if adapt else None
        if not isinstance(dt, str):
            self.dt = dt
        check_closed(self)
        self.steps = 0
        self.last: StepReport | None = None
        self.totals = {name: np.zeros(model.worlds, int) for name in ("newton", "pcg", "rough", "floored")}
        if adapt:
            self.totals |= {name: np.zeros(model.worlds, int) for name in ("substeps", "rejected")}
        self.max_residual = 0.0
        self.max_floor = 0.0
        self.min_J = math.inf
        self.max_violation = 0.0
        self._load: np.ndarray | None = None
        self._stepped = np.zeros(model.worlds, dtype=bool)
        self._history: list[np.ndarray] = []

    def __repr__(self) -> str:
        return describe(self)

    # stepping

    @property
    def dt(self) -> float:
        """Step, s; of dt="auto" the interval between common instants, NaN before the first run or step settles it."""
        return self.stepper.adaptive.instants.interval if self.stepper.adaptive else self._dt

    @dt.setter
    def dt(self, value: float) -> None:
        if self.stepper.adaptive:
            raise ModelError(f"dt = {value!r}: this simulation was made with dt = 'auto'")
        check_dt(value)
        self._dt = float(value)
        self.stepper.set_dt(self._dt)

    @property
    def time(self) -> np.ndarray:
        """[world], s."""
        return self.state.time.numpy().copy()

    @property
    def load(self) -> np.ndarray | None:
        """Part of the load that acts, 0 to 1, [world], of statics; None of a motion."""
        if not self.integrator.static:
            return None
        return self.time if self._load is None else self._load

    @property
    def methods(self) -> dict[str, str]:
        """What "auto" stands for here: "solver", and of NewtonPCG "linear", "operator" and "preconditioner"."""
        return dict(self.stepper.newton.methods)

    @property
    def status(self) -> np.ndarray:
        """[world]: 0 running, 1 failed, 2 frozen."""
        return self.state.status.numpy().copy()

    def step(self, count: int = 1) -> StepReport:
        """Advance `count` steps of dt, or to the next common instants; the report is that of the last.

        Raises:
            ConvergenceError: a step was not accepted after all halvings (see `on_failure`); the state is as before it.
            ConstraintError: the same, and it is the constraints that can't be satisfied; it names them.
            PenetrationError: a ConvergenceError where a body went through an obstacle; it names contact and point.
            ModelError: `count` is not a positive whole number.
        """
        check_steps(count)
        for _ in range(count):
            if self.stepper.adaptive:
                self.stepper.adaptive.aim(self.time)
            self.stepper.take_parameters()
            self.stepper.run()
            report = self.stepper.work.report.numpy()
            self._digest(report)
        assert self.last is not None
        return self.last

    def _digest(self, rows: np.ndarray) -> None:
        column = {name: rows[:, k] for k, name in enumerate(REPORT)}
        status = column["status"].astype(int)
        before = self.last.status if self.last is not None else np.zeros(len(rows), int)
        fresh = (status == STATUS["failed"]) & (before != STATUS["failed"])
        self.last = StepReport(
            converged=(status == STATUS["running"]) & (column["rough"] == 0.0),
            newton=column["newton"].astype(int),
            pcg=column["pcg"].astype(int),
            residual=column["residual"].copy(),
            halvings=column["halvings"].astype(int),
            status=status,
            min_J=column["min_J"].copy(),
            time=column["time"].copy(),
            failure=column["failure"].astype(int),
            violation=column["violation"].copy(),
            outer=column["outer"].astype(int),
            residual_force=column["residual_force"].copy(),
            floor=column["floor"].copy(),
            **(self.stepper.adaptive.counts() if self.stepper.adaptive else {}),
        )
        self.steps += 1
        good = status == STATUS["running"]
        self._stepped |= good
        self._stepped &= status != STATUS["failed"]
        if self.stepper.adaptive:
            self.totals["substeps"] += self.last.substeps
            self.totals["rejected"] += self.last.rejected
        self.totals["newton"] += self.last.newton
        self.totals["pcg"] += self.last.pcg
        self.totals["rough"] += good & ~self.last.converged
        self.totals["floored"] += good & (self.last.floor > 0.0)
        if good.any():
            self.max_residual = max(self.max_residual, float(self.last.residual[good].max()))
            self.max_floor = max(self.max_floor, float(self.last.floor[good].max()))
            self.max_violation = max(self.max_violation, float(self.last.violation[good].max()))
            self.min_J = min(self.min_J, float(self.last.min_J[good].min()))
        if self._recorded:
            if not self.record:
                self._history.clear()
            self._history.append(self._row(rows))
        if fresh.any():
            fatal = self.on_failure == "raise" or (self.on_failure is None and not good.any())
            if fatal:
                if not good.any():  # no world advanced
                    self.steps -= 1
                    if self._recorded:
                        self._history.pop()
                raise self._failure(int(np.flatnonzero(fresh)[0]))

    def _row(self, rows: np.ndarray) -> np.ndarray:
        """What is kept of a report: time, probes, and what of terms a world that did not step does not tell."""
        row = rows[:, [REPORT.index("time"), *range(len(REPORT), rows.shape[1])]].copy()
        row[~self._stepped, 1 + 6 * len(self.model.probes) :] = np.nan
        return row

    @property
    def _recorded(self) -> bool:
        """Whether there is anything to record of each step."""
        return self.model.terms.report_width > len(REPORT)

    def _failure(self, world: int) -> ConvergenceError | ConstraintError:
        """The error for a failed world; its status is cleared so that a caller may try again with another dt."""
        error = step_error(self, world)
        status = self.state.status.numpy()
        status[status == STATUS["failed"]] = STATUS["running"]
        self.state.status.assign(status)
        self.last = None
        return error

    def run(
        self,
        t_end: float,
        *,
        outputs: Sequence[Any] = (),
        on_step: Callable[[Simulation], Any] | None = None,
        progress: bool | None = None,
    ) -> StepReport:
        """Step until t_end (s), writing outputs. Ctrl-C ends after the step in hand, with valid files.

        Args:
            t_end: end time, s; the number of steps is rounded to the nearest, so the end may differ by half a step.
                With dt="auto" it is met.
            outputs: writers (USDWriter, VTUWriter, Checkpoint, ...).
            on_step: called after each step; ends the run when it returns False.
            progress: show a bar on stderr; by default when stderr is a terminal.

        Raises:
            ModelError: t_end lies in the past, or is so close to the start that no step would be done.
            ConvergenceError, ConstraintError, OutputError: the outputs hold what came before.
            KeyboardInterrupt: after Ctrl-C, once outputs are closed; not when no step was left to do.
        """
        if not math.isfinite(t_end):
            raise ModelError(f"t_end = {t_end!r} must be finite")
        if not isinstance(outputs, (list, tuple)) or not all(hasattr(out, "write") for out in outputs):
            raise ModelError(f"run: outputs must be a list of writers such as USDWriter(path), got {outputs!r}")
        alive = self.status == STATUS["running"]
        now = float(self.time[alive].min()) if alive.any() else t_end
        adaptive = self.stepper.adaptive
        total = adaptive.steps_to(now, t_end, outputs) if adaptive else round((t_end - now) / self._dt)
        if total < 0:
            raise ModelError(f"t_end = {t_end:g} s lies in the past: the simulation is at t = {now:.6g} s")
        # who has stepped may be as close to t_end as whole steps come; a start is not
        if total == 0 and t_end != now and (self.steps == 0 or now == 0.0):
            away = f"t_end = {t_end:g} s is at most half a step from the start at t = {now:g} s"
            raise ModelError(f"{away}, so no step would be done; take dt < {self.dt:g} s or a later t_end")
        run_steps(self, total, t_end, outputs, on_step, progress)
        if self.last is None:
            self.last = idle_report(self)
        return self.last

    def freeze(self, worlds: Any) -> None:
        """Leave worlds (indices or mask) as they are from now on."""
        status = self.state.status.numpy()
        status[worlds] = STATUS["frozen"]
        self.state.status.assign(status)

    def reset(self, mask: Any = None, state: State | None = None) -> None:
        """Set worlds back to a state, by default to the model's initial one; mask [world], by default all."""
        B = self.model.worlds
        mask = np.ones(B, bool) if mask is None else np.asarray(mask, dtype=bool)
        if mask.shape != (B,):
            raise ModelError(f"reset: mask has shape {mask.shape}, expected ({B},)")
        source = self.model.state() if state is None else state
        fresh = source.numpy()
        values = self.state.numpy()
        for name, array in values.items():
            spec = self.state.specs[name]
            array[mask] = fresh[name][mask] if name in fresh else np.asarray(spec.initial)
        self.state.load(values)
        self.stepper.forget(mask)
        self._stepped[mask] = False
        self.stepper.start_terms(mask)
        if self.model.constraints:
            check_closed(self, mask)
        if self.stepper.ledger:
            self.stepper.begin_ledger(mask)

    # results of the whole run; more in Records, those of the present state in Results

    def energies(self) -> dict[str, np.ndarray]:
        """Energy ledger, each (B,), J.

        work_joints is the force at the end of each substep times the drive's travel, as the scheme has it; `integrator`
        takes what that differs from the exact work, and may be negative.

        kinetic, strain and potential (of gravity, from the reference) are current values. work (by loads, supports,
        fields and driven joints, also given apart), viscous, contact, friction and integrator add up from the start;
        ledger_residual is change of energy + losses - work, which equals `unbalanced`, the sum of g . dq that the
        solver's tolerance left.
        """
        if not self.stepper.ledger:
            raise ModelError("energies: the simulation was made with ledger=False")
        return self.model.terms.energies(self.state.ledger.numpy())

    def reaction(self, nodes: NodeSet) -> np.ndarray:
        """Force of the supports on the prescribed components of nodes at the last accepted step, (B, 3), N.

        NaN for a world whose last step was refused, or that was reset or resumed and has not stepped since.
        """
        if not isinstance(nodes, NodeSet):
            raise ModelError(f"reaction: expected nodes (body.nodes), got {nodes!r}")
        self.check_body(nodes.body, "reaction")
        g = self.stepper.work.g.numpy() * (1.0 - self.model.free_host)
        first = nodes.body.node_slot[nodes.indices]
        rows = nodes.body.slot_offset + first[first >= 0]
        total = g[:, rows].sum(axis=1).astype(float)
        total[~self._stepped] = np.nan
        return total

    def resume(self, path: Any) -> None:
        """Continue from a checkpoint, bit for bit. Raises CheckpointError if it is of another model."""
        from .checkpoint import load_checkpoint

        load_checkpoint(self, path)
        self._stepped[:] = False

    def bytes(self) -> dict[str, int]:
        """Bytes on the device: constants, scratch, and each array of the state (twice where steps may be halved)."""
        out = {f"model.{k}": v for k, v in self.model.bytes.items()}
        out |= {f"work.{k}": v for k, v in self.stepper.work.bytes.items()}
        for label, state in (("state", self.state), ("backup", self.stepper.backup)):
            if state is not None:
                out |= {f"{label}.{k}": v for k, v in state.bytes.items()}
        return out
