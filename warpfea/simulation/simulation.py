"""Simulation: the user interface of the step loop."""

from __future__ import annotations

import dataclasses
import math
import time as clock
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from .. import solvers
from ..base.console import compile_progress_bar, quiet_warp
from ..base.errors import ModelError
from ..base.memory import convert_memory_errors
from ..base.names import check_choice
from ..base.notebook import summary_table
from ..base.worlds import set_rows
from ..kernels.step.step_control import SAME_TIME_FRACTION, STATUS
from ..model.assembly import require_density
from ..model.state import State
from ..solvers import Jacobi, NewtonPCG, SolverPlan
from . import integrators
from .adaptive import adaptive_options, algebraic_tolerance
from .capacity import check_capacity
from .checks import (
    check_constraint_tol,
    check_model,
    check_state,
    check_time,
    check_times,
    write_times,
)
from .controls import Controls
from .discontinuities import warn_early_ends, warn_initial_jumps
from .energy_growth import ENERGY_GROWTH_CHOICES, EnergyGrowth
from .episodes import Resets
from .failures import check_initial_constraints
from .observations import Observations
from .overlap import OverlapCheck
from .plots import plot_run
from .reports import (
    ContactRecord,
    JointRecord,
    PendingReport,
    ProbeRecord,
    RunStatistics,
    StepReport,
    idle_report,
    simulation_table,
    simulation_text,
)
from .results import PartMember, Records, Results
from .run_loop import run_steps
from .stepper import Stepper

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["ContactRecord", "JointRecord", "ProbeRecord", "Simulation", "StepReport"]


class Simulation:
    """Time integration of a model.

    Args:
        model: from ModelBuilder.finalize.
        state: initial state; by default model.state(). It is advanced in place.
        dt: step, s, of all worlds or of each (worlds,), which may be set later; or "auto": each world takes the steps
            that keep its error to `error`, and all meet at synchronisation points, to which `step` advances.
        t_end: s, of all worlds or of each (worlds,), which may be set later: the last step of a world is shortened to
            meet it; the world is then frozen on the device until a reset. None: no end.
        error: of dt="auto": largest error of a position at the end, over the model's size (`model.size`).
        interval: of dt="auto": largest time between synchronisation points, s: its multiples, output times, kinks of
            time laws and the ends of runs. None: a 64th of the longest run so far, 1/60 s without a run.
        horizon: of dt="auto": time over which the error accumulates, s. None: the longest run so far, or 64 intervals.
        integrator: "backward_euler", "bdf2", "energy_momentum", wf.GeneralizedAlpha(rho_inf=0.5) or
            wf.EnergyMomentum(rho_inf=0.8); also as text: "generalized_alpha(rho_inf=0.5)".
        solver: "newton-pcg", "jacobi" or "direct", or options: wf.NewtonPCG(...), wf.Jacobi(...).
        plan: methods for what the options leave open, `plan` of another simulation: a world alone then has the bits
            that it has among others. None: chosen for the model, see `ModelBuilder.finalize(many=)`.
        constraint_tol: largest constraint violation, over the model's size (`model.size`); by default 1e-8 in float64,
            1e-5 in float32, where violations within the round-off of positions, at most 2e-3 of the size, pass too.
        ledger: compute the energy ledger.
        record: store probe, joint and contact results of every step, else of the last only.
        capture: capture a step as one graph, on the GPU and on the CPU; never with linear="direct".
        on_compile: called with (modules ready, total modules, name) while kernels compile; by default a bar on stderr
            if it is a terminal. Warp's own module messages are hidden, unless its log level was lowered.
        on_failure: "raise" ConvergenceError, or "freeze" the failed worlds; by default raise with one world, and with
            several only once all have failed.
        inversion: a step that inverts an element, J <= 0 at a quadrature point where J was positive, is rejected
            ("refuse"), or accepted if the law allows it ("report", see StepReport.min_J).
        energy_growth: net energy gain of the integrator in a world, over the largest kinetic + strain + contact energy
            plus the sum of |work|: above 1 % a warning, above 10 % steps are rejected ("refuse") or continue ("warn");
            "ignore" and ledger=False: not monitored.
        check_overlap: warn of bodies that cross each other or a collider without a contact, or deeper than theirs sees,
            once for each pair, with the time: after each call of `step`, of a run at about 64 steps (skins on the
            host; see OverlapCheck for pairs left out: connected by a joint, or crossing from the start).

    Attributes:
        overlap_check: crossings `found` with check_overlap, else None.
        results: results of the present state; records: of the last step and over time; statistics: totals over steps;
            resets: resets of worlds. Their public members are the simulation's, too.
        controls: values written by the caller between steps, see Controls.
        compile_s, output_s: time to construct the simulation, kernels included, and of output writers in runs, s.
        energy_growth: description of the energy growth monitor.

    Raises:
        ModelError: dt or an option out of range, a plan that does not fit, or a material without a density.
        ConstraintError: initially violated joints.
        CapacityError: insufficient device memory.
    """

    positions = PartMember("results", Results.positions)
    displacements = PartMember("results", Results.displacements)
    velocities = PartMember("results", Results.velocities)
    pose = PartMember("results", Results.pose)
    angular_velocity = PartMember("results", Results.angular_velocity)
    field = PartMember("results", Results.field)
    sample = PartMember("results", Results.sample)
    fields = PartMember("results", Results.fields)
    field_on = PartMember("results", Results.field_on)
    check_field = PartMember("results", Results.check_field)
    point_positions = PartMember("results", Results.point_positions)
    skin_points = PartMember("results", Results.skin_points)
    skin_field = PartMember("results", Results.skin_field)
    node_gradients = PartMember("results", Results.node_gradients)
    collider_poses = PartMember("results", Results.collider_poses)
    energies = PartMember("records", Records.energies)
    reaction = PartMember("records", Records.reaction)
    reaction_moment = PartMember("records", Records.reaction_moment)
    history = PartMember("records", Records.history)
    probe = PartMember("records", Records.probe)
    joint_record = PartMember("records", Records.joint_record)
    joint_force = PartMember("records", Records.joint_force)
    spring_force = PartMember("records", Records.spring_force)
    joint_value = PartMember("records", Records.joint_value)
    joint_rate = PartMember("records", Records.joint_rate)
    violation = PartMember("records", Records.violation)
    contact_record = PartMember("records", Records.contact_record)
    contact_force = PartMember("records", Records.contact_force)
    reset = PartMember("resets", Resets.reset)
    steps = PartMember("statistics")
    last = PartMember("statistics")
    totals = PartMember("statistics")
    max_residual = PartMember("statistics")
    max_floor = PartMember("statistics")
    max_violation = PartMember("statistics")
    min_J = PartMember("statistics")
    asynchronous = PartMember("statistics")

    def __init__(
        self,
        model: Model,
        state: State | None = None,
        *,
        dt: float | str | np.ndarray | wp.array,
        t_end: float | np.ndarray | wp.array | None = None,
        error: float | None = None,
        interval: float | None = None,
        horizon: float | None = None,
        integrator: str | integrators.Integrator = "backward_euler",
        solver: NewtonPCG | Jacobi | str | None = None,
        plan: SolverPlan | None = None,
        constraint_tol: float | None = None,
        ledger: bool = True,
        record: bool = True,
        capture: bool = True,
        on_failure: str | None = None,
        inversion: str = "refuse",
        energy_growth: str = "refuse",
        check_overlap: bool = False,
        on_compile: Callable[[int, int, str], None] | None = None,
    ) -> None:
        scheme, options = integrators.find_integrator(integrator), solvers.solver_options(solver)
        check_model(model)
        if not scheme.static:
            require_density(model.bodies, "motion")
        check_choice("inversion", inversion, ("refuse", "report"))
        check_choice("energy_growth", energy_growth, ENERGY_GROWTH_CHOICES)
        self.energy_growth = EnergyGrowth(energy_growth, ledger=ledger, static=scheme.static)
        check_choice("on_failure", on_failure, ("raise", "freeze", None))
        times = {"error": error, "interval": interval, "horizon": horizon}
        adapt = adaptive_options(dt, **times, model=model, scheme=scheme, solver=options)
        options = algebraic_tolerance(options, adapt, model.dtype)
        if adapt is None:
            check_times("dt", dt, model, positive=True)
        if t_end is not None:
            if adapt or scheme.static:
                raise ModelError(f"t_end = {t_end!r}: t_end of Simulation needs a fixed dt; use run(t_end)")
            check_times("t_end", t_end, model)
        # initial accelerations are computed on the host
        asynchronous = on_failure == "freeze" and not record and not (adapt or scheme.accelerated or scheme.static)
        if constraint_tol is None:
            constraint_tol = {"float64": 1e-8, "float32": 1e-5}[model.dtype]
        check_constraint_tol(constraint_tol)

        def stepper(model: Model, state: State, capture: bool = False) -> Stepper:
            return Stepper(
                model, state, scheme, options,
                ledger=ledger, capture=capture,
                loop={"plan": plan, "constraint_tol": constraint_tol * model.size, "inversion": inversion},
                adapt=adapt, episodes={"asynchronous": asynchronous, "ends": t_end is not None},
                growth=self.energy_growth, on_compile=on_compile or bar,
            )  # fmt: skip

        self.model = model
        began = clock.perf_counter()
        with quiet_warp(), compile_progress_bar(None if on_compile is None else False) as bar:
            check_capacity(model, stepper)
        self.state = model.state() if state is None else state
        check_state(model, self.state)
        self.integrator, self.solver = scheme, options
        self.on_failure, self.record, self.ended_laws = on_failure, record, set[int]()
        room = convert_memory_errors(f"a simulation of {model.worlds} worlds", model.device)
        with quiet_warp(), room, compile_progress_bar(None if on_compile is None else False) as bar:
            self.stepper = stepper(model, self.state, capture)
        model.parameters.simulated = True
        self.controls = Controls(model, self.state)
        self.compile_s, self.output_s = clock.perf_counter() - began, 0.0
        self.error = adapt.error if adapt else None
        self.statistics = RunStatistics(self, asynchronous)
        self.results = Results(model, self.state)
        self.records = self.results.records = Records(self.results, self.stepper, self.statistics)
        self.resets = Resets(self)
        if not isinstance(dt, str):
            self.dt = dt
        if t_end is not None:
            self.t_end = t_end
        self.overlap_check = OverlapCheck(self) if check_overlap else None
        check_initial_constraints(self)
        warn_initial_jumps(self)
        self._load: np.ndarray | None = None

    def __repr__(self) -> str:
        return simulation_text(self)

    def _repr_html_(self) -> str:
        return summary_table("simulation", simulation_table(self))

    def plot(self, world: int = 0) -> Any:
        """Matplotlib figure of a world: records of probes, joints and contacts, energies, iterations of steps.

        Raises:
            ModelError: no step was taken. OutputError: without matplotlib (extra "plots").
        """
        return plot_run(self, world)

    # stepping

    @property
    def dt(self) -> Any:
        """Step, s, or (worlds,) if set per world; for dt="auto" the synchronisation interval, NaN before the first run
        or step sets it; a longer run sets it again."""
        if self.stepper.step_size_control:
            return self.stepper.step_size_control.sync_times.interval
        return self.stepper.work.step.dt.numpy().copy() if self._dt is None else self._dt

    @dt.setter
    def dt(self, value: Any) -> None:
        if self.stepper.step_size_control:
            raise ModelError(f"dt = {value!r}: this simulation was made with dt = 'auto'")
        check_times("dt", value, self.model, positive=True)
        one = isinstance(value, (int, float, np.floating))
        if not one and (self.integrator.static or self.integrator.accelerated):
            raise ModelError(f"dt = {value!r}: integrator {self.integrator.name!r} takes one step for all worlds")
        self._dt = float(value) if one else None
        self.statistics.times_differ |= not one
        self.stepper.set_dt(self._dt if one else value)
        self.stepper.work.limit_rigid_stiffness(None if self.integrator.static else self._dt)

    @property
    def t_end(self) -> np.ndarray | None:
        """End times (worlds,), s, at which worlds are frozen; None without."""
        ends = self.stepper.episodes.ends
        return None if ends is None else ends.numpy().copy()

    @t_end.setter
    def t_end(self, value: Any) -> None:
        ends = self.stepper.episodes.ends
        if ends is None:
            raise ModelError(f"t_end = {value!r}: this simulation was made without; give t_end to Simulation")
        check_times("t_end", value, self.model)
        self.statistics.times_differ |= not isinstance(value, (int, float, np.floating))
        write_times(ends, value)

    @property
    def time(self) -> np.ndarray:
        """Time [world], s."""
        return self.state.time.numpy().copy()

    @property
    def load(self) -> np.ndarray | None:
        """Load fraction [world], 0 to 1, in statics; None in dynamics."""
        if not self.integrator.static:
            return None
        return self.time if self._load is None else self._load

    @property
    def status(self) -> np.ndarray:
        """Status [world]: 0 running, 1 failed, 2 frozen."""
        return self.state.status.numpy().copy()

    def step(self, count: int = 1) -> StepReport:
        """Advance `count` steps of dt, or to the next synchronisation points; returns the report of the last.

        With record=False and on_failure="freeze" nothing is read back from the device (except with dt="auto",
            generalized-alpha, linear="direct" and capture=False): the report is read on first access to one of its
            arrays, until the next call.

        Raises:
            ConvergenceError: a step was rejected after all halvings (see `on_failure`); the state is restored.
            ConstraintError: constraints could not be satisfied; names them.
            PenetrationError: a ConvergenceError for a body that went through an obstacle; names contact and point.
            ModelError: `count` is not a positive whole number.
        """
        if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
            raise ModelError(f"step({count!r}): the number of steps must be a whole number, at least 1")
        stepper, statistics = self.stepper, self.statistics
        if self.overlap_check:
            self.overlap_check.begin(self)
        for _ in range(count):
            if stepper.step_size_control:
                stepper.step_size_control.set_interval(self.time)
            stepper.update_parameters()
            stepper.run()
            if statistics.asynchronous:
                statistics.steps += 1
                statistics.unsynced = True
            else:
                statistics.add_step(stepper.work.report.numpy())
                for history in self.records.histories:
                    history.record(self)
        if self.overlap_check:
            self.overlap_check.after_step(self)
        return PendingReport(self, statistics.steps) if statistics.asynchronous else statistics.last

    def run(
        self,
        t_end: float,
        *,
        outputs: Sequence[Any] = (),
        on_step: Callable[[Simulation], Any] | None = None,
        progress: bool | None = None,
    ) -> StepReport:
        """Step until t_end (s), writing outputs. Ctrl-C ends after the current step, with valid files.

        Args:
            t_end: end time, s, met exactly: the last step is shortened, and a remainder below 1e-6 dt is skipped. A
                world that arrives before others waits.
            outputs: writers (USDWriter, VTUWriter, Checkpoint, ...).
            on_step: called after each step; a return value of False ends the run.
            progress: show a bar on stderr; by default if stderr is a terminal.

        Raises:
            ModelError: t_end lies in the past.
            ConvergenceError, ConstraintError, OutputError: outputs hold the preceding steps.
            KeyboardInterrupt: after Ctrl-C with steps left, once outputs are closed.
        """
        check_time("t_end", t_end)
        if not isinstance(outputs, (list, tuple)) or not all(hasattr(out, "write") for out in outputs):
            raise ModelError(f"run: outputs must be a list of writers such as USDWriter(path), got {outputs!r}")
        if np.ndim(self.dt) or len(set([] if self.t_end is None else self.t_end)) > 1:
            raise ModelError("run: worlds have times of their own; take step(count), and t_end of Simulation")
        alive = self.status == STATUS["running"]
        now = float(self.time[alive].min()) if alive.any() else t_end
        adaptive = self.stepper.step_size_control
        if t_end < now - (0.0 if adaptive else SAME_TIME_FRACTION * self.dt):
            raise ModelError(f"t_end = {t_end:g} s lies in the past: the simulation is at t = {now:.6g} s")
        if adaptive:
            total = adaptive.count_steps(now, t_end, outputs)
        else:
            total = max(math.ceil((t_end - now) / self.dt - SAME_TIME_FRACTION), 0)
            if total == 0 and t_end != now and self.steps == 0:
                raise ModelError(f"t_end = {t_end:g} s is within {SAME_TIME_FRACTION:g} dt of the start at t = {now:g} "
                                 "s, so no step would be done; take a later t_end")  # fmt: skip
        if not self.integrator.static:
            warn_early_ends(self, t_end)
        self.stepper.episodes.set_run_end(t_end, total)
        if self.overlap_check:
            self.overlap_check.set_run(total)
        try:
            run_steps(self, total, t_end, outputs, on_step, progress)
        finally:
            self.stepper.episodes.set_run_end()
            if self.overlap_check:
                self.overlap_check.set_run()
        if self.last is None:
            self.last = idle_report(self)
        return self.last

    def freeze(self, worlds: Any) -> None:
        """Freeze worlds (indices or mask) in their present state."""
        try:
            set_rows(self.state.status, worlds, STATUS["frozen"])
        except IndexError:
            B = self.model.worlds
            raise ModelError(
                f"freeze: worlds = {worlds!r} must be numbers from 0 to {B - 1}, or ({B},) of True and False"
            ) from None

    def observe(self, *names: str) -> Observations:
        """Observation table of all worlds on the device, see Observations."""
        return Observations(self, names)

    @property
    def methods(self) -> dict[str, str]:
        """Methods chosen for "auto": "solver", and for NewtonPCG "linear", "operator" and "preconditioner"."""
        return self.plan.methods

    @property
    def plan(self) -> solvers.SolverPlan:
        """Methods of the linear systems, chosen or given; `plan=` of another simulation takes them."""
        return self.stepper.newton.plan

    def info(self) -> dict[str, Any]:
        """`Model.info`, "integrator" with its options, "methods", the solver's "plan", the monitoring of
        "energy_growth"."""
        more = {"integrator": self.integrator.label, "methods": self.methods, "plan": dataclasses.asdict(self.plan)}
        return self.model.info() | more | {"energy_growth": str(self.energy_growth)}

    def resume(self, path: Any) -> None:
        """Continue from a checkpoint, bit for bit. Raises CheckpointError for one of another model."""
        from .checkpoint import load_checkpoint

        load_checkpoint(self, path)
        self.resets.initial_state = None
        self.statistics.clear_stepped(np.ones(self.model.worlds, bool))

    def bytes(self) -> dict[str, int]:
        """Bytes on the device: constants, scratch, and each array of the state (twice if steps may be halved)."""
        return {f"model.{k}": v for k, v in self.model.memory.bytes.items()} | self.stepper.bytes()
